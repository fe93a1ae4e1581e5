"""Commands made of dataclasses: the fields of a command's settings are its arguments and options, and its function gets
an instance."""

import json
import shlex
import sys
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout, suppress
from dataclasses import MISSING, Field, dataclass, fields, replace
from io import StringIO
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from textwrap import indent
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import click
from click.core import ParameterSource

from fpp_ml_bench.errors import FppBenchError, PoolError
from fpp_ml_bench.files import printable, write_atomically
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.options import Description, described, did_you_mean, flag_of, option

if TYPE_CHECKING:
    from fpp_ml_bench.skipping import Explanation

SPLITS = ("train", "validation", "test", "all")
HELP_WIDTH, LEFT_COLUMN = 110, 28
STANDARD_OUTPUT = "-"
OPTIONS = "options"
"""Heading of the options of a settings class that has no ``HEADING`` of its own."""

T = TypeVar("T")
Settings = TypeVar("Settings")


# ---- how the text of an option becomes its value


def value(expected: str, parse: Callable[[str], T], sound: Callable[[T], bool] = lambda result: True) -> Any:
    """``parse`` of an option: text that ``parse`` makes a ``sound`` value of, without ValueError; else it says what was
    ``expected``."""

    def parsed(text: str) -> T:
        with suppress(ValueError):
            if sound(result := parse(text)):
                return result
        raise ValueError(f"expected {expected}")

    return parsed


def names(text: str) -> tuple[str, ...]:
    """Names with commas between them."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def number_pair(text: str) -> tuple[float, float]:
    """Two numbers with a comma between them."""
    first, second = (float(part) for part in text.split(","))
    return first, second


def whole(least: int, most: int, unit: str = "") -> Any:
    """A whole number from ``least`` to ``most``."""
    expected = f"{least} to {most}" if unit else f"a whole number from {least} to {most}"
    return value(f"{expected} {unit}".strip(), int, lambda number: least <= number <= most)


COUNT = whole(1, 100_000)
AT_LEAST_ONE = value("1 or more", int, lambda number: number >= 1)
POSITIVE = value("a number above 0", float, lambda number: 0 < number < 1e6)
MINUTES = value("minutes above 0", float, lambda minutes: 0 < minutes < 1e6)
WORKING_RANGE = value("NEAR,FAR in mm such as 350,450", number_pair, lambda ends: 0 < ends[0] < ends[1] < 1e9)


def parser_of(entry: "Field[Any]", about: Description) -> Callable[[str], Any]:
    """What makes the value of a field of its text: its own ``parse``, else by its choices or its type."""
    if about.parse is not None:
        return about.parse
    if about.choices:

        def chosen(text: str) -> str:
            if text not in about.choices:
                raise ValueError(did_you_mean(text, about.choices))
            return text

        return chosen
    kinds = _kinds(entry)
    plain = {"float": value("a number", float), "int": value("a whole number", int), "Path": Path}
    return str if "str" in kinds else next((plain[kind] for kind in plain if kind in kinds), str)


def _kinds(entry: "Field[Any]") -> set[str]:
    """Names of the types in a field's annotation, which may name types that only a type checker imports."""
    annotation = entry.type
    if isinstance(annotation, str):
        return {part.strip() for part in annotation.split("|")}
    return {getattr(kind, "__name__", "") for kind in get_args(annotation) or (annotation,)}


def parse_value(flag: str, text: str, parse: Callable[[str], T]) -> T:
    """The value of an option; ValueError with its flag and text."""
    try:
        return parse(text)
    except ValueError as error:
        raise ValueError(f"{flag} {printable(text)}: {error}") from None


class _Value(click.ParamType[Any]):
    name = "value"

    def __init__(self, parse: Callable[[str], Any]) -> None:
        self.parse = parse

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if param is None or ctx is None:
            return value
        called = param.opts[0] if isinstance(param, click.Option) else param.make_metavar(ctx)
        if value in flags_of(ctx):
            raise click.UsageError(f"{called}: expected a value behind it, got the option {value}", ctx)
        try:
            return parse_value(called, value, self.parse)
        except ValueError as error:
            raise click.UsageError(str(error), ctx) from None


# ---- settings that several commands have


@dataclass(frozen=True, kw_only=True)
class Pool:
    """Settings of a command whose work may go to several processes or machines."""

    workers: int | None = option(None, "processes (default: as many as there are processors)", "N", parse=AT_LEAST_ONE)
    cluster: str | None = option(
        None,
        "all CPUs of a Ray cluster instead: ray://HOST:10001, or HOST:6379 on one of its nodes; they must share the "
        "output folder, or write to a URL (docs/scale.md)",
        "ADDRESS",
    )

    @property
    def processes(self) -> int:
        """Processes of this machine. Raises `PoolError` for a number beside a cluster."""
        if self.workers is not None and self.cluster is not None:
            raise PoolError("--workers counts processes of this machine, --cluster takes a cluster; give one of them")
        return self.workers or usable_cores()


@dataclass(frozen=True, kw_only=True)
class Explain:
    """Settings of a command that tells which work it left out."""

    HEADING = "skipped work"
    explain: bool = option(False, "print which work was left out and what that saved (takes a moment)")
    explain_json: Path | None = option(None, "write the same as JSON into FILE; implies --explain", "FILE")

    def check_explain_file(self) -> None:
        """Raises `FppBenchError`, before any work, for a JSON file that can't be written."""
        path = self.explain_json
        if path is not None and (path.is_dir() or not path.absolute().parent.is_dir()):
            raise FppBenchError(
                f"--explain-json {path}: expected a file in an existing folder; create the folder first"
            )

    def say_explanation(self, account: Callable[[], "Explanation"]) -> None:
        """Print the account as a table with the rules for the seconds below, and write it as JSON, if asked for."""
        if self.explain or self.explain_json:
            from fpp_ml_bench.cli.console import explanation_table, show  # imports rich, which --help must not

            explanation = account()
            show(explanation_table(explanation))
        if self.explain_json is not None:
            text = json.dumps(explanation.to_dict(), indent=1, allow_nan=False)
            write_atomically(self.explain_json, (text + "\n").encode("utf-8"))
            print(f"Written: {self.explain_json}")


def given(settings: Any, part: type) -> list[str]:
    """Flags of the options of the base class ``part`` that don't have their default."""
    options = described(part)
    known = {entry.name: entry.default for entry in fields(part)}
    return [flag_of(name, about) for name, about in options.items() if getattr(settings, name) != known[name]]


def command_line(name: str, settings: Any, of_method: Mapping[str, Any] = MappingProxyType({})) -> str:
    """The command that runs with these settings, and a method's own options by their flag."""
    words, options = ["fpp-bench", name], []
    for entry in fields(settings):
        about, value = described(type(settings)).get(entry.name), getattr(settings, entry.name)
        if about is None or value == entry.default:
            continue
        values = value if about.many else [",".join(value) if isinstance(value, tuple) else value]
        if about.positional:
            words += map(str, values)
        else:
            options += [(flag_of(entry.name, about), one) for one in values]
    for flag, one in (*options, *of_method.items()):
        words += [flag] if isinstance(one, bool) else [flag, f"{one:g}" if isinstance(one, float) else str(one)]
    return shlex.join(words)


# ---- commands


class Option(click.Option):
    """An option, and the ``heading`` above it in the help; empty for one that the command lists itself."""

    heading = OPTIONS


def parameter(entry: "Field[Any]", about: Description, name: str = "", heading: str = OPTIONS) -> Option:
    """The option of click that a field is. Its default stays with the dataclass."""
    words = [flag_of(entry.name, about), name or entry.name]
    if _kinds(entry) == {"bool"}:
        made = Option(words, is_flag=True, flag_value=not entry.default, help=about.help)
    else:
        shown, required = about.metavar or "|".join(about.choices), entry.default is MISSING
        kind = _Value(parser_of(entry, about))
        made = Option(words, type=kind, multiple=about.many, required=required, metavar=shown, help=about.help)
    made.heading = heading
    return made


def _parameters(settings: type) -> list[click.Parameter]:
    """Arguments in the order of the fields, then options, those of the settings' own class before those it shares."""
    arguments: list[click.Parameter] = []
    options: dict[type, list[click.Parameter]] = {base: [] for base in settings.__mro__}
    for name, about in described(settings).items():
        entry = next(entry for entry in fields(settings) if entry.name == name)
        if about.positional:
            kind, count = _Value(parser_of(entry, about)), -1 if about.many else 1
            required = entry.default is MISSING
            arguments.append(
                click.Argument([name], required, about.help, type=kind, nargs=count, metavar=about.metavar)
            )
        else:
            owner = next(base for base in settings.__mro__ if name in vars(base).get("__annotations__", {}))
            options[owner].append(parameter(entry, about, heading=vars(owner).get("HEADING", OPTIONS)))
    return [*arguments, *chain.from_iterable(options.values())]


class Command(click.Command):
    """A command that runs ``function`` with an instance of ``settings``; with ``--json -`` standard output gets
    the JSON alone."""

    def __init__(self, name: str, function: Callable[[Any], int | None], settings: type, examples: str) -> None:
        look = {"terminal_width": HELP_WIDTH, "help_option_names": ["-h", "--help"]}
        super().__init__(name, look, params=_parameters(settings), help=function.__doc__)  # type: ignore[arg-type]
        self.function, self.settings, self.examples = function, settings, examples

    def values(self, ctx: click.Context) -> dict[str, Any]:
        """The fields that the command line gives."""
        return {key: ctx.params[key] for key in ctx.params if given_in(ctx, key)}

    def invoke(self, ctx: click.Context) -> int:
        settings = self.settings(**self.values(ctx))
        if str(getattr(settings, "json", None)) != STANDARD_OUTPUT:
            return self.function(settings) or 0
        with TemporaryDirectory(prefix="fpp-bench-") as folder:
            file = Path(folder) / "standard-output.json"
            with redirect_stdout(StringIO()):
                status = self.function(replace(settings, json=file)) or 0
            if file.exists():
                sys.stdout.write(file.read_text(encoding="utf-8"))
        return status

    def collect_usage_pieces(self, ctx: click.Context) -> list[str]:
        pieces = ["[options]"]
        for param in self.get_params(ctx):
            if isinstance(param, click.Argument):
                shown = f"{param.make_metavar(ctx)}{' ...' if param.nargs != 1 else ''}"
                pieces.append(shown if param.required else f"[{shown}]")
            elif param.required and isinstance(param, click.Option):
                pieces.append(f"{param.opts[0]} {param.make_metavar(ctx)}")
        return pieces

    def format_usage(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        formatter.write_usage(ctx.command_path, " ".join(self.collect_usage_pieces(ctx)), "usage: ")

    def format_help_text(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        formatter.write_paragraph()
        formatter.write_text((self.help or "").split("\n\n")[0])

    def sections(self, ctx: click.Context) -> dict[str, list[tuple[str, str]]]:
        """What the help lists: terms and what they mean, by heading."""
        found: dict[str, list[tuple[str, str]]] = {"arguments": [], OPTIONS: []}
        for param in self.get_params(ctx):
            if isinstance(param, click.Argument):
                found["arguments"].append((param.make_metavar(ctx), param.help or ""))
            elif isinstance(param, click.Option) and not param.hidden:
                found.setdefault(getattr(param, "heading", OPTIONS), []).append(row_of(param, ctx))
        return found

    def format_arguments(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Nothing: they are among the sections."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        write_sections(self.sections(ctx), formatter)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        formatter.write(f"\nexamples:\n{indent(self.examples, '  ')}")


def given_in(ctx: click.Context, name: str) -> bool:
    """Whether the command line gives a parameter."""
    return ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE


def row_of(param: click.Option, ctx: click.Context) -> tuple[str, str]:
    """Flags of an option with its value, and its help."""
    flags = ", ".join(param.opts)
    return (flags if param.is_flag else f"{flags} {param.make_metavar(ctx)}"), param.help or ""


def write_sections(sections: dict[str, list[tuple[str, str]]], formatter: click.HelpFormatter) -> None:
    """Headings with lists of terms and what they mean."""
    for heading, rows in sections.items():
        if not rows:
            continue
        with formatter.section(heading):
            formatter.write_dl(rows, LEFT_COLUMN)


def command(examples: str, kind: type[Command] = Command) -> Callable[[Callable[[Any], int | None]], Command]:
    """Make a command of a function of its settings, a dataclass of `option` and `argument` fields. Its help begins with
    the first paragraph of the function's docstring and ends with ``examples``. It returns its exit status, None for
    0."""

    def made(function: Callable[[Any], int | None]) -> Command:
        settings = function.__annotations__["settings"]
        return kind(function.__name__, function, settings, examples)

    return made


def flags_of(ctx: click.Context) -> list[str]:
    """Flags of the options of the command that is parsed."""
    return [flag for param in ctx.command.get_params(ctx) for flag in param.opts if flag.startswith("--")]


def problem_of(error: click.ClickException) -> str:
    """What is wrong with a command line, as a message of this package."""
    ctx = getattr(error, "ctx", None)
    if isinstance(error, click.NoSuchOption) and ctx is not None:
        return f"unknown option {printable(error.option_name)!r}; {did_you_mean(error.option_name, flags_of(ctx))}"
    if isinstance(error, click.MissingParameter) and ctx is not None and error.param is not None:
        shown = row_of(error.param, ctx)[0] if isinstance(error.param, click.Option) else error.param.make_metavar(ctx)
        return f"{shown} is missing: {getattr(error.param, 'help', '')}"
    return error.format_message()
