"""Commands made of dataclasses: the fields of a command's settings are its arguments and options, and its function gets
an instance."""

import json
import shlex
import sys
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from dataclasses import MISSING, Field, dataclass
from functools import partial
from inspect import getdoc, signature
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from textwrap import indent
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import click
from click.core import ParameterSource

from fpp_ml_bench.errors import FppBenchError, PoolError
from fpp_ml_bench.files import printable, write_atomically
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.options import described, did_you_mean, flag_of, option, options_of

if TYPE_CHECKING:
    from fpp_ml_bench.skipping import Explanation

SPLITS = ("train", "validation", "test", "all")
HELP_WIDTH, LEFT_COLUMN = 110, 28
STANDARD_OUTPUT = "-"
OPTIONS = "options"
"""Heading of the options of a settings class that has no ``HEADING`` of its own."""

T = TypeVar("T")


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


def parser_of(entry: "Field[Any]") -> Callable[[str], Any]:
    """What makes the value of a field of its text: its own ``parse``, else by its choices or its type."""
    about = described(entry)
    if about.parse is not None:
        return about.parse
    if about.choices:
        return partial(_choice, about.choices)
    kinds = _kinds(entry)
    plain = {"float": value("a number", float), "int": value("a whole number", int), "Path": Path}
    return str if "str" in kinds else next((plain[kind] for kind in plain if kind in kinds), str)


def _choice(choices: tuple[str, ...], text: str) -> str:
    if text in choices:
        return text
    raise ValueError(did_you_mean(text, choices))


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

    HEADING = "where it runs"
    workers: int | None = option(None, "processes (default: as many as there are processors)", "N", parse=AT_LEAST_ONE)
    cluster: str | None = option(
        None,
        "all CPUs of a Ray cluster instead: ray://HOST:10001, or HOST:6379 on one of its nodes; they must share the "
        "output folder, or write to a URL (docs/data.md)",
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

    def check(self) -> None:
        """Raises `FppBenchError`, before any work, for a JSON file that can't be written."""
        path = self.explain_json
        if path is not None and (path.is_dir() or not path.absolute().parent.is_dir()):
            raise FppBenchError(
                f"--explain-json {path}: expected a file in an existing folder; create the folder first"
            )

    def say(self, account: Callable[[], "Explanation"]) -> None:
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
    return [flag_of(entry) for entry in options_of(part) if getattr(settings, entry.name) != entry.default]


def command_line(**changed: Any) -> str:
    """The command that runs, with all it was given, but for the parameters ``changed``; None leaves one out."""
    ctx = click.get_current_context()
    values = {name: value for name, value in ctx.params.items() if given_in(ctx, name)} | changed
    words = ctx.command_path.split()
    for param in ctx.command.get_params(ctx):
        value = values.get(str(param.name))
        many = getattr(param, "multiple", False) or param.nargs != 1
        for one in () if value is None else value if many else (value,):
            flag = [] if isinstance(param, click.Argument) else param.opts[:1]
            words += flag if isinstance(one, bool) else [*flag, _text_of(one)]
    return shlex.join(words)


def _text_of(value: Any) -> str:
    if isinstance(value, tuple):
        return ",".join(map(_text_of, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


# ---- commands


class Option(click.Option):
    """An option, and the ``heading`` above it in the help."""

    heading = OPTIONS


def parameter_of(
    entry: "Field[Any]", name: str = "", heading: str = OPTIONS, parse: Callable[[str], Any] | None = None
) -> Any:
    """The `Option` or click.Argument that a field is, of the field's name if it has no other, and with the field's way
    to ``parse`` its text if there is no other. Its default stays with the field."""
    about, required = described(entry), entry.default is MISSING
    kind = _Value(parse or parser_of(entry))
    if about.positional:
        count = -1 if about.many else 1
        return click.Argument([entry.name], required, about.help, type=kind, nargs=count, metavar=about.metavar)
    words = [flag_of(entry), name or entry.name]
    if _kinds(entry) == {"bool"}:
        made = Option(words, is_flag=True, flag_value=not entry.default, help=about.help)
    else:
        shown = about.metavar or "|".join(about.choices)
        made = Option(words, type=kind, multiple=about.many, required=required, metavar=shown, help=about.help)
    made.heading = heading
    return made


class Command(click.Command):
    """A command that runs ``function``. Its keyword parameters are arguments and options by their defaults, made with
    `argument` and `option`, or dataclasses of such fields, of which it gets an instance. With ``--json -`` standard
    output gets the JSON alone."""

    def __init__(self, function: Callable[..., int | None], examples: str) -> None:
        self.function, self.examples = function, examples
        self.defaults: dict[str, Any] = {}
        self.groups: dict[str, Any] = {}
        params = []
        for name, parameter in signature(function).parameters.items():
            if isinstance(entry := parameter.default, Field):
                entry.name, entry.type = name, parameter.annotation
                self.defaults[name] = entry.default
                params.append(parameter_of(entry))
            else:
                group = self.groups[name] = parameter.annotation
                params += [parameter_of(entry, heading=heading_of(group, entry.name)) for entry in options_of(group)]
        look = {"terminal_width": HELP_WIDTH, "help_option_names": ["-h", "--help"]}
        super().__init__(function.__name__, look, params=params, help=getdoc(function))

    def values(self, ctx: click.Context) -> dict[str, Any]:
        """The function's arguments by what the command line gives."""
        given = {name: value for name, value in ctx.params.items() if given_in(ctx, name)}
        values = {name: given.get(name, default) for name, default in self.defaults.items()}
        for name, group in self.groups.items():
            values[name] = group(**{key: given[key] for key in group.__dataclass_fields__ if key in given})
        return values

    def invoke(self, ctx: click.Context) -> int:
        values = self.values(ctx)
        if str(values.get("json")) != STANDARD_OUTPUT:
            return self.function(**values) or 0
        with TemporaryDirectory(prefix="fpp-bench-") as folder:
            file = Path(folder) / "standard-output.json"
            with redirect_stdout(StringIO()):
                status = self.function(**{**values, "json": file}) or 0
            if file.exists():
                sys.stdout.write(file.read_text(encoding="utf-8"))
        return status

    def usage(self, ctx: click.Context) -> str:
        """The words behind the command's name: arguments, and the options that it must be given."""
        pieces = ["[options]"]
        for param in self.get_params(ctx):
            shown = row_of(param, ctx)[0] + " ..." * (param.nargs != 1)
            if isinstance(param, click.Argument) or param.required:
                pieces.append(shown if param.required else f"[{shown}]")
        return " ".join(pieces)

    def format_help(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        formatter.write_usage(ctx.command_path, self.usage(ctx), "usage: ")
        formatter.write_paragraph()
        formatter.write_text((self.help or "").split("\n\n")[0])
        write_sections(self.sections(ctx), formatter)
        formatter.write(f"\nexamples:\n{indent(self.examples, '  ')}")

    def sections(self, ctx: click.Context) -> dict[str, list[tuple[str, str]]]:
        """What the help lists: terms and what they mean, by heading."""
        found: dict[str, list[tuple[str, str]]] = {"arguments": [], OPTIONS: []}
        for param in self.get_params(ctx):
            if not getattr(param, "hidden", False):
                heading = "arguments" if isinstance(param, click.Argument) else getattr(param, "heading", OPTIONS)
                found.setdefault(heading, []).append(row_of(param, ctx))
        return found


def heading_of(group: type, name: str) -> str:
    """What stands above an option in the help: ``HEADING`` of the class whose field it is."""
    owner = next(base for base in group.__mro__ if name in vars(base).get("__annotations__", {}))
    return str(vars(owner).get("HEADING", OPTIONS))


def given_in(ctx: click.Context, name: str | None) -> bool:
    """Whether the command line gives a parameter."""
    return ctx.get_parameter_source(str(name)) is ParameterSource.COMMANDLINE


def row_of(param: click.Parameter, ctx: click.Context) -> tuple[str, str]:
    """What a parameter is called in help and messages, with the metavar of its value, and what it is."""
    flags = ", ".join(param.opts) if isinstance(param, click.Option) else ""
    shown = flags if getattr(param, "is_flag", False) else f"{flags} {param.make_metavar(ctx)}".strip()
    return shown, getattr(param, "help", None) or ""


def write_sections(sections: dict[str, list[tuple[str, str]]], formatter: click.HelpFormatter) -> None:
    """Headings with lists of terms and what they mean."""
    for heading, rows in sections.items():
        if not rows:
            continue
        with formatter.section(heading):
            formatter.write_dl(rows, LEFT_COLUMN)


def command(examples: str, kind: type[Command] = Command) -> Callable[[Callable[..., int | None]], Command]:
    """Make a `Command` of a function. Its help begins with the first paragraph of the function's docstring and ends
    with ``examples``. The function returns its exit status, None for 0."""
    return lambda function: kind(function, examples)


def flags_of(ctx: click.Context) -> list[str]:
    """Flags of the options of the command that is parsed."""
    return [flag for param in ctx.command.get_params(ctx) for flag in param.opts if flag.startswith("--")]


def problem_of(error: click.ClickException) -> str:
    """What is wrong with a command line, as a message of this package."""
    ctx = getattr(error, "ctx", None)
    if isinstance(error, click.NoSuchOption) and ctx is not None:
        return f"unknown option {printable(error.option_name)!r}; {did_you_mean(error.option_name, flags_of(ctx))}"
    if isinstance(error, click.MissingParameter) and ctx is not None and error.param is not None:
        return " is missing: ".join(row_of(error.param, ctx))
    return error.format_message()
