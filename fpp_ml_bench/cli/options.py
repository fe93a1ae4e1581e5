"""Commands made of dataclasses: the fields of a command's settings are its arguments and options,
and its function gets an instance."""

import json
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import MISSING, Field, dataclass
from functools import partial
from inspect import get_annotations, getdoc, signature
from io import StringIO
from pathlib import Path
from shutil import get_terminal_size
from tempfile import TemporaryDirectory
from textwrap import indent
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

import click

from fpp_ml_bench.errors import PoolError
from fpp_ml_bench.files import printable, write_atomically
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.options import described, did_you_mean, flag_of, option, options_of

if TYPE_CHECKING:
    from fpp_ml_bench.skipping import Explanation

SPLITS = ("train", "validation", "test", "all")
HELP_WIDTH, NARROWEST, LEFT_COLUMN = 110, 60, 28
STANDARD_OUTPUT = "-"
OPTIONS = "options"
"""Heading of the options of a settings class that has no ``HEADING`` of its own."""

Row = tuple[str, str]
"""A line of the help: a term, and what it means."""


# ---- how the text of an option becomes its value


def value(
    expected: str, parse: Callable[[str], Any], sound: Callable[[Any], bool] = lambda result: True
) -> Any:
    """``parse`` of an option: text that ``parse`` makes a ``sound`` value of, without ValueError;
    else it says what was ``expected``."""

    def parsed(text: str) -> Any:
        with suppress(ValueError):
            if sound(result := parse(text)):
                return result
        raise ValueError(f"expected {expected}")

    return parsed


def names(text: str) -> tuple[str, ...]:
    """Names with commas between them."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def some_of(choices: Sequence[str]) -> Any:
    """Some of the ``choices``, with commas between them."""
    listed = f"some of {', '.join(choices)}"
    return value(listed, names, lambda some: some != () and set(some) <= {*choices})


def number_pair(text: str) -> tuple[float, float]:
    """Two numbers with a comma between them."""
    first, second = (float(part) for part in text.split(","))
    return first, second


def new_file(text: str) -> Path:
    """A file that may be written: no folder, and in one that is there."""
    path = Path(text)
    if path.is_dir():
        raise ValueError("expected a file to write, found a folder")
    if not path.absolute().parent.is_dir():
        raise ValueError(f"the folder {path.parent} does not exist; make it first")
    return path


def new_folder(text: str) -> Path:
    """A folder to write into, which need not be there."""
    path = Path(text)
    if path.exists() and not path.is_dir():
        raise ValueError("expected a folder to write into, found a file")
    return path


def whole(least: int, most: int, unit: str = "") -> Any:
    """A whole number from ``least`` to ``most``."""
    expected = f"{least} to {most}" if unit else f"a whole number from {least} to {most}"
    return value(f"{expected} {unit}".strip(), int, lambda number: least <= number <= most)


COUNT = whole(1, 100_000)
AT_LEAST_ONE = value("1 or more", int, lambda number: number >= 1)
MINUTES = value("minutes above 0", float, lambda minutes: 0 < minutes < 1e6)
WORKING_RANGE = value(
    "NEAR,FAR in mm such as 350,450", number_pair, lambda ends: 0 < ends[0] < ends[1] < 1e9
)


def parser_of(entry: "Field[Any]") -> Callable[[str], Any]:
    """What makes the value of a field of its text: its own ``parse``, else by its choices or its
    type."""
    about, kinds = described(entry), _kinds(entry)
    if about.parse is not None:
        return about.parse
    if choices := choices_of(entry):
        return partial(_choice, choices)
    plain = {
        "str": str,
        "float": value("a number", float),
        "int": value("a whole number", int),
        "Path": Path,
    }
    return next((plain[kind] for kind in plain if kind in kinds), str)


def choices_of(entry: "Field[Any]") -> tuple[str, ...]:
    """The values that a field may have: those that it says, or those of a ``Literal`` in its
    annotation."""
    literal = next(
        (kind for kind in (entry.type, *get_args(entry.type)) if get_origin(kind) is Literal), None
    )
    return described(entry).choices or get_args(literal)


def _choice(choices: tuple[str, ...], text: str) -> str:
    if text in choices:
        return text
    raise ValueError(did_you_mean(text, choices))


def _kinds(entry: "Field[Any]") -> set[str]:
    """Names of the types in a field's annotation, which may name types that only a type checker
    imports."""
    annotation = entry.type
    if isinstance(annotation, str):
        return {part.strip() for part in annotation.split("|")}
    return {getattr(kind, "__name__", "") for kind in get_args(annotation) or (annotation,)}


class _Value(click.ParamType[Any]):
    """The value that ``parse`` makes of the text of an option or argument. Defaults are values
    already."""

    name = "value"

    def __init__(self, parse: Callable[[str], Any]) -> None:
        self.parse = parse

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not isinstance(value, str) or param is None or ctx is None:
            return value
        called = param.opts[0] if isinstance(param, click.Option) else param.make_metavar(ctx)
        if value in flags_of(ctx):
            raise click.UsageError(
                f"{called}: expected a value behind it, got the option {value}", ctx
            )
        try:
            return self.parse(value)
        except ValueError as error:
            raise click.UsageError(f"{called} {printable(value)}: {error}", ctx) from None


# ---- settings that several commands have


@dataclass(frozen=True, kw_only=True)
class Pool:
    """Settings of a command whose work may go to several processes or machines."""

    HEADING = "where it runs"
    workers: int | None = option(
        None, "processes (default: as many as there are processors)", "N", parse=AT_LEAST_ONE
    )
    cluster: str | None = option(
        None,
        "all CPUs of a Ray cluster instead: ray://HOST:10001, or HOST:6379 on one of its nodes; "
        "they must share the "
        "output folder, or write to a URL (docs/data.md)",
        "ADDRESS",
    )

    @property
    def processes(self) -> int:
        """Processes of this machine. Raises `PoolError` for a number beside a cluster."""
        if self.workers is not None and self.cluster is not None:
            raise PoolError(
                "--workers counts processes of this machine, --cluster takes a cluster; give one "
                "of them"
            )
        return self.workers or usable_cores()


@dataclass(frozen=True, kw_only=True)
class Explain:
    """Settings of a command that tells which work it left out."""

    HEADING = "skipped work"
    explain: bool = option(False, "print which work was left out, and how much of it")
    explain_json: Path | None = option(
        None, "write the same as JSON into FILE; implies --explain", "FILE", parse=new_file
    )

    def say(self, account: Callable[[], "Explanation"]) -> None:
        """Print the account as a table, and write it as JSON, if asked for."""
        if self.explain or self.explain_json:
            from fpp_ml_bench.cli.console import (
                explanation_table,
                show,
            )  # imports rich, which --help must not

            explanation = account()
            show(explanation_table(explanation))
        if self.explain_json is not None:
            text = json.dumps(explanation.to_dict(), indent=1, allow_nan=False)
            write_atomically(self.explain_json, (text + "\n").encode("utf-8"))
            print(f"Written: {self.explain_json}")


def given(settings: Any, part: type) -> list[str]:
    """Flags of the options of the base class ``part`` that don't have their default."""
    return [
        flag_of(entry)
        for entry in options_of(part)
        if getattr(settings, entry.name) != entry.default
    ]


def command_line() -> str:
    """The command that runs, as it was typed."""
    ctx = click.get_current_context()
    return shlex.join([*ctx.command_path.split(), *ctx.obj])


# ---- commands


def parameter_of(entry: "Field[Any]", heading: str = OPTIONS) -> Any:
    """The click.Option or click.Argument that a field is, listed in the help below ``heading``."""
    about, required, words = (
        described(entry),
        entry.default is MISSING,
        [flag_of(entry), entry.name],
    )
    keywords: dict[str, Any] = (
        {"help": about.help} if required else {"help": about.help, "default": entry.default}
    )
    shown = about.metavar or "|".join(choices_of(entry))
    valued = {"type": _Value(parser_of(entry)), "required": required, "metavar": shown, **keywords}
    if about.positional:
        made: Any = click.Argument([entry.name], nargs=-1 if about.many else 1, **valued)
    elif _kinds(entry) == {"bool"}:
        made = click.Option(words, is_flag=True, flag_value=not entry.default, **keywords)
    else:
        made = click.Option(words, multiple=about.many, **valued)
    made.heading = "arguments" if about.positional else heading
    return made


class Command(click.Command):
    """A command that runs ``function``. Its keyword parameters are arguments and options by their
    defaults, made with `argument` and `option`, or dataclasses of such fields, of which it gets an
    instance. With ``--json -`` standard output gets the JSON alone."""

    def __init__(self, function: Callable[..., int | None], examples: str) -> None:
        self.function, self.examples = function, examples
        self.kinds: dict[str, Any] = {}
        params = []
        for name, parameter in signature(function).parameters.items():
            group = self.kinds[name] = parameter.annotation
            if isinstance(entry := parameter.default, Field):
                entry.name, entry.type = name, group
                params.append(parameter_of(entry))
            else:
                params += [
                    parameter_of(entry, heading_of(group, entry.name))
                    for entry in options_of(group)
                ]
        look = {"help_option_names": ["-h", "--help"]}
        super().__init__(function.__name__, look, params=params, help=getdoc(function))

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        ctx.obj = [*args]
        return super().parse_args(ctx, args)

    def values(self, ctx: click.Context) -> dict[str, Any]:
        """The function's arguments by what the command line gives."""
        given = ctx.params
        return {
            name: given[name]
            if name in given
            else kind(**{key: given[key] for key in kind.__dataclass_fields__ if key in given})
            for name, kind in self.kinds.items()
        }

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

    def get_help(self, ctx: click.Context) -> str:
        purpose = (self.help or "").split("\n\n")[0]
        return help_text(
            [(ctx.command_path, self.usage(ctx))],
            purpose,
            self.sections(ctx),
            self.examples.rstrip("\n"),
        )

    def sections(self, ctx: click.Context) -> dict[str, list[Row]]:
        """What the help lists: terms and what they mean, by heading."""
        sections: dict[str, list[Row]] = {"arguments": [], OPTIONS: []}
        for param in self.get_params(ctx):
            if not getattr(param, "hidden", False):
                sections.setdefault(getattr(param, "heading", OPTIONS), []).append(
                    row_of(param, ctx)
                )
        return sections


def heading_of(group: type, name: str) -> str:
    """What stands above an option in the help: ``HEADING`` of the class whose field it is."""
    owner = next(base for base in group.__mro__ if name in get_annotations(base))
    return str(vars(owner).get("HEADING", OPTIONS))


def row_of(param: click.Parameter, ctx: click.Context) -> Row:
    """What a parameter is called in help and messages, with the metavar of its value, and what it
    is."""
    shown = param.get_help_spec(ctx) if isinstance(param, click.Option) else param.make_metavar(ctx)
    return shown, param.help or ""


def help_text(
    usages: Sequence[Row], purpose: str, sections: Mapping[str, Sequence[Row]], examples: str
) -> str:
    """The help of a program or command: how it is run (its name, and the words behind it), its
    purpose, terms and what they mean by heading, and examples."""
    shown = get_terminal_size((HELP_WIDTH, 0)).columns
    formatter = click.HelpFormatter(width=max(min(shown, HELP_WIDTH), NARROWEST))
    for name, words in usages:
        formatter.write_usage(name, words, "usage: ")
    formatter.write_paragraph()
    formatter.write_text(purpose)
    for heading, rows in sections.items():
        if rows:
            with formatter.section(heading):
                formatter.write_dl(rows, LEFT_COLUMN)
    return f"{formatter.getvalue()}\nexamples:\n{indent(examples, '  ')}"


def command(
    examples: str, kind: type[Command] = Command
) -> Callable[[Callable[..., int | None]], Command]:
    """Make a `Command` of a function. Its help begins with the first paragraph of the function's
    docstring and ends with ``examples``. The function returns its exit status, None for 0."""
    return lambda function: kind(function, examples)


def flags_of(ctx: click.Context) -> list[str]:
    """Flags of the options of the command that is parsed."""
    return [
        flag
        for param in ctx.command.get_params(ctx)
        for flag in param.opts
        if flag.startswith("--")
    ]


def problem_of(error: click.ClickException) -> str:
    """What is wrong with a command line, as a message of this package."""
    ctx = getattr(error, "ctx", None)
    if isinstance(error, click.NoSuchOption) and ctx is not None:
        return (
            f"unknown option {printable(error.option_name)!r}; "
            f"{did_you_mean(error.option_name, flags_of(ctx))}"
        )
    if isinstance(error, click.MissingParameter) and ctx is not None and error.param is not None:
        _, words, _ = ctx.command.make_parser(ctx).parse_args(
            [*ctx.obj]
        )  # those that no argument takes
        meant = f"; did you mean {error.param.opts[0]} {printable(words[0])}?" if words else ""
        return " is missing: ".join(row_of(error.param, ctx)) + meant
    return error.format_message()
