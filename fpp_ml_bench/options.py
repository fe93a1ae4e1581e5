"""Options that describe themselves: fields of a dataclass which carry their help, for the command
line and the docs.

>>> from dataclasses import dataclass
>>> @dataclass(frozen=True)
... class Options:
...     steps: int = option(4, "phase steps", metavar="N")
>>> (steps,) = options_of(Options)
>>> Options().steps, flag_of(steps), described(steps).help
(4, '--steps', 'phase steps')
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass
from difflib import get_close_matches
from typing import Any

from fpp_ml_bench.files import printable

_KEY = "fpp_ml_bench.option"
MOST_LISTED = 80
REQUIRED: Any = MISSING
"""In place of a default: the command line must give it."""


@dataclass(frozen=True)
class Description:
    """What the command line says of an option: ``help``, ``metavar`` of its value, the ``choices``
    that there are (a ``Literal`` annotation says them itself), and ``flag``, its spelling where
    that is not made of the field's name. ``parse`` makes a value of its text where the field's type
    does not say how; it raises ValueError with what it expected. ``many``: may be given again, the
    field is a tuple. ``positional``: an argument without a flag."""

    help: str
    metavar: str | None = None
    choices: tuple[str, ...] = ()
    flag: str | None = None
    parse: Callable[[str], Any] | None = None
    many: bool = False
    positional: bool = False


def option(
    default: Any,
    help: str,
    metavar: str | None = None,
    choices: Collection[str] = (),
    flag: str | None = None,
    parse: Callable[[str], Any] | None = None,
    many: bool = False,
) -> Any:
    """A dataclass field that is an option of the command line: its ``default``, and the rest as of
    `Description`."""
    description = Description(help, metavar, tuple(choices), flag, parse, many)
    return field(default=default, metadata={_KEY: description})


def argument(
    help: str,
    metavar: str,
    default: Any = REQUIRED,
    choices: Collection[str] = (),
    many: bool = False,
) -> Any:
    """A dataclass field that is an argument of the command line, given by its position; else as
    `option`."""
    description = Description(help, metavar, tuple(choices), many=many, positional=True)
    return field(default=default, metadata={_KEY: description})


def options_of(settings: Any) -> "list[Field[Any]]":
    """The fields of a dataclass that are options of the command line, in order; its other fields
    are for code alone."""
    return [
        entry
        for entry in (fields(settings) if is_dataclass(settings) else ())
        if _KEY in entry.metadata
    ]


def described(entry: "Field[Any]") -> Description:
    """What the command line says of a field that is an option."""
    description: Description = entry.metadata[_KEY]
    return description


def flag_of(entry: "Field[Any]") -> str:
    """Its spelling on the command line: ``--its-name``, or what it says itself."""
    return described(entry).flag or f"--{entry.name.replace('_', '-')}"


def nearest(name: str, known: Collection[str] | Mapping[str, Any], count: int = 1) -> list[str]:
    """The known names, at most ``count``, that an unknown ``name`` is probably meant as; none that
    is far from it."""
    return get_close_matches(name, known, n=count)


def did_you_mean(name: str, known: Collection[str] | Mapping[str, Any]) -> str:
    """How a message about an unknown ``name`` ends: the nearest known one, or all of them, up to
    `MOST_LISTED`.

    >>> did_you_mean("clasical", ["classical", "phase"])
    "did you mean 'classical'?"
    >>> did_you_mean("x", ["classical", "phase"])
    'there are classical, phase'
    """
    meant = nearest(name, known)
    if meant:
        return f"did you mean {printable(meant[0])!r}?"
    listed = [*known][:MOST_LISTED] + ["..."] * (len(known) > MOST_LISTED)
    return f"there are {', '.join(listed) or 'none'}"
