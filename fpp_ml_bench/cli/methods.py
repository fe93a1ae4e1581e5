"""Commands that take a METHOD: its options on the command line are the fields of its class, whoever wrote it."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import click

from fpp_ml_bench.baselines import registry
from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.baselines.training.weights import training_data_warning
from fpp_ml_bench.cli.options import (
    AT_LEAST_ONE,
    Command,
    flags_of,
    given_in,
    parameter_of,
    parse_value,
    parser_of,
    row_of,
)
from fpp_ml_bench.errors import FppBenchError, PredictionError
from fpp_ml_bench.options import argument, flag_of, option, options_of

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.method import Photographed

_METHODS = "methods"
NO_OPTIONS = [("no options", "")]


@dataclass(frozen=True, kw_only=True)
class OfMethods:
    """``texts`` of the options that the command line gives of methods, by their flag."""

    texts: Mapping[str, Any] = field(default_factory=dict)

    def of(self, method: type[Method], name: str, part: str = "Options") -> dict[str, Any]:
        """Fields of a method's ``part`` (``Options`` or ``Training``) that are given; ``name``: what the user calls the
        method. Raises `PredictionError` for options of others, and for text that is no value of its option."""
        own = {flag_of(entry): entry for entry in options_of(getattr(method, part))}
        given: dict[str, Any] = {}
        for flag, text in self.texts.items():
            if flag not in own:
                owners = [label_of(other) for other in _known_methods() if flag in _flags(other, part)]
                raise PredictionError(f"{flag} is an option of {', '.join(owners)}, not of {name}; leave it out")
            try:
                value = text if isinstance(text, bool) else parse_value(flag, text, parser_of(own[flag]))
            except ValueError as error:
                raise PredictionError(str(error)) from None
            given[own[flag].name] = value
        return given


@dataclass(frozen=True, kw_only=True)
class MethodSettings(OfMethods):
    """Which method a command runs, and how."""

    name: str = argument(
        "one of those below with their options, the name of weights that come with the package, a .safetensors file, a "
        "recipe that fpp-bench reproduce has trained (loss/l1), or file.py:Class, a method of yours; that file is "
        "executed",
        "METHOD",
    )
    threads: int = option(1, "threads a sample (default: 1)", "N", parse=AT_LEAST_ONE)

    def load(self, dataset: "Photographed", warn: bool = True) -> Method:
        """The method for the rig of ``dataset``. Unless told not to, warns on standard error about weights that were
        trained on another version of the dataset's benchmark. Raises FppBenchError for an unknown method, and for an
        option that belongs to another one."""
        kind = registry.find(self.name).method
        given = self.of(kind, self.name)
        if "threads" in {entry.name for entry in fields(kind.Options)}:
            given["threads"] = self.threads
        method = registry.load_method(self.name, dataset, **given)
        config = method.weights_config
        warning = None if config is None else training_data_warning(config, dataset.manifest)
        if warn and config is not None and warning is not None:
            print(f"warning: {config.name} was {warning}", file=sys.stderr)
        return method


class MethodCommand(Command):
    """A command whose options are also those of all methods, and of a ``file.py:Class`` among its words. It gives
    them to the `OfMethods` among its parameters."""

    part = "Options"

    def methods(self, words: Sequence[str]) -> list[type[Method]]:
        """The methods, the user's own first: where two share a flag, the first says whether a value stands behind
        it."""
        own = [registry.find(word).method for word in words if registry.FILE_MARK in word and word[0] != "-"]
        return [method for method in (*own, *_known_methods()) if getattr(method, self.part) is not None]

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        taken, by_method = flags_of(ctx), {}
        for method in self.methods(args):
            params = _flags(method, self.part)
            clash = [flag for flag in params if flag in taken]
            if clash and any(method.name == word or registry.FILE_MARK in word for word in args):
                raise PredictionError(
                    f"{method.name}: its option {clash[0]} is one of {ctx.command_path}; give it another flag"
                )
            by_method[method] = {flag: param for flag, param in params.items() if flag not in clash}
        ctx.meta[_METHODS] = by_method
        return super().parse_args(ctx, args)

    def of_methods(self, ctx: click.Context) -> dict[str, click.Option]:
        """The options of methods by their flag."""
        found: dict[str, click.Option] = {}
        for params in ctx.meta.get(_METHODS, {}).values():
            found = {**params, **found}
        return found

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        return [*super().get_params(ctx), *self.of_methods(ctx).values()]

    def values(self, ctx: click.Context) -> dict[str, Any]:
        values, of_methods = super().values(ctx), self.of_methods(ctx)
        texts = {flag: ctx.params[str(p.name)] for flag, p in of_methods.items() if given_in(ctx, p.name)}
        return {
            name: replace(value, texts=texts) if isinstance(value, OfMethods) else value
            for name, value in values.items()
        }

    def sections(self, ctx: click.Context) -> dict[str, list[tuple[str, str]]]:
        listed = {
            f"{label_of(method)} ({method.purpose})": [row_of(param, ctx) for param in params.values()] or NO_OPTIONS
            for method, params in ctx.meta[_METHODS].items()
        }
        return {**super().sections(ctx), **listed}

    def invoke(self, ctx: click.Context) -> int:
        try:
            return super().invoke(ctx)
        except FppBenchError:
            raise
        except Exception as error:
            if (failure := registry.failure_in_file(error)) is None:
                raise
            raise PredictionError(f"a method of yours failed: {failure}") from error


def _known_methods() -> list[type[Method]]:
    return [*registry.methods().values(), registry.network_method()]


def _flags(method: type[Method], part: str) -> dict[str, click.Option]:
    """The options of a method by their flag, which leave their text as it is. They are listed below the method, so
    hidden where a command lists its own."""
    made: dict[str, click.Option] = {}
    for entry in options_of(getattr(method, part)):
        flag = flag_of(entry)
        param = made[flag] = parameter_of(entry, name=f"of_method{flag.replace('-', '_')}", parse=str)
        param.hidden = True
    return made


def label_of(method: type[Method]) -> str:
    """What a method is called in help and messages."""
    return "trained networks" if method is registry.network_method() else method.name
