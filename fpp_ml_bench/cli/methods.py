"""Commands that take a METHOD: its options on the command line are the fields of its class, whoever
wrote it."""

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import Field, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fpp_ml_bench.baselines import registry
from fpp_ml_bench.baselines.from_hub import FILE_MARK, SCHEME
from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.baselines.training.weights import shipped_names, training_data_warning
from fpp_ml_bench.cli.options import AT_LEAST_ONE, Command, Row, flags_of, parameter_of, row_of
from fpp_ml_bench.errors import FppBenchError, PredictionError
from fpp_ml_bench.files import is_file
from fpp_ml_bench.loaders.storage.manifest import MANIFEST
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.options import argument, flag_of, option, options_of

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.method import Photographed

_OF_METHODS = "options of methods"
NO_OPTIONS = [("no options", "")]
TRUST = "--trust"


@dataclass(frozen=True, kw_only=True)
class MethodSettings:
    """Which method a command runs, and how. ``options``: those of the method that the command line
    gives, by the names of its fields."""

    name: str = argument(
        "one of those below, the name of weights that come with the package, a .safetensors file, "
        "a recipe that fpp-bench reproduce has trained (loss/l1), hf://OWNER/NAME, a model of the "
        "Hub, or file.py:Class, a method of yours; that file is executed",
        "METHOD",
    )
    threads: int = option(1, "threads a sample (default: 1)", "N", parse=AT_LEAST_ONE)
    trust: bool = option(False, "run the code that a repository hf://OWNER/NAME brings")
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def method(self) -> type[Method]:
        return registry.find(self.name, self.trust).method

    def load(self, dataset: "Photographed | Rig", warn: bool = True) -> Method:
        """The method for the rig of ``dataset``, or for a rig. Unless told not to, warns on standard error about
        weights that were trained on another version of the dataset's benchmark. Raises
        FppBenchError for an unknown method."""
        known = [entry.name for entry in fields(self.method.Options)]
        threads = {"threads": self.threads} if "threads" in known else {}
        method = registry.load_method(
            self.name, dataset, trust=self.trust, **self.options, **threads
        )
        config = method.weights_config
        manifest = None if isinstance(dataset, Rig) else dataset.manifest
        warning = (
            None if config is None or manifest is None else training_data_warning(config, manifest)
        )
        if warn and config is not None and warning is not None:
            print(f"warning: {config.name} was {warning}", file=sys.stderr)
        return method


class MethodCommand(Command):
    """A command whose first argument names a method, and whose options are also those of all
    methods, and of a ``file.py:Class`` among its words. Those that are given of the method named
    are ``options`` of its function or of a dataclass among its parameters."""

    part = "Options"

    def methods(self, words: Sequence[str]) -> dict[str, type[Method]]:
        """The methods by what the command line calls them, the user's own first: where two share a
        flag, the first says whether a value stands behind it."""
        trust = TRUST in words
        own = {
            word: registry.find(word, trust).method
            for word in words
            if (FILE_MARK in word and word[0] != "-") or word.startswith(SCHEME)
        }
        every = {**own, **registry.methods(), "": registry.network_method()}
        return {
            name: method for name, method in every.items() if getattr(method, self.part) is not None
        }

    def fields_of(self, method: type[Method]) -> "dict[str, Field[Any]]":
        """The options of a method by their flag."""
        return {flag_of(entry): entry for entry in options_of(getattr(method, self.part))}

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        methods, of_command = self.methods(args), flags_of(ctx)
        of_methods: dict[str, Any] = {}
        for flag, entry in (
            entry for method in methods.values() for entry in self.fields_of(method).items()
        ):
            if flag not in (*of_command, *of_methods):
                # Its text stays as it is until METHOD is known; sections of their own list it.
                made = of_methods[flag] = parameter_of(entry)
                made.name, made.type, made.default, made.hidden = (
                    flag,
                    click.UNPROCESSED,
                    None,
                    True,
                )
        ctx.meta[_OF_METHODS] = [*of_methods.values()]
        super().parse_args(ctx, args)
        name, *others = (
            str(ctx.params[str(p.name)]) for p in self.params if isinstance(p, click.Argument)
        )
        known = {*methods, *shipped_names()}
        if name not in known and others and (is_file(Path(name) / MANIFEST) or others[0] in known):
            said = shlex.join([others[0], name])
            raise PredictionError(
                f"{name}: expected the method first, then the dataset: {ctx.command_path} {said}"
            )
        method = methods.get(name, methods.get(""))
        own = {} if method is None else self.fields_of(method)
        if clash := [flag for flag in own if flag in of_command]:
            raise PredictionError(
                f"{name}: its option {clash[0]} is one of {ctx.command_path}; give it another flag"
            )
        given = {flag: text for flag in of_methods if (text := ctx.params[flag]) not in (None, ())}
        if of_others := [flag for flag in given if flag not in own]:
            if name not in methods and FILE_MARK not in name:
                registry.find(name)  # says what else was probably meant
            owners = [
                label_of(other)
                for other in methods.values()
                if of_others[0] in self.fields_of(other)
            ]
            raise PredictionError(
                f"{of_others[0]} is an option of {', '.join(owners)}, not of {name}; leave it out"
            )
        ctx.params["options"] = {
            own[flag].name: parameter_of(own[flag]).type_cast_value(ctx, text)
            for flag, text in given.items()
        }
        return []

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        return [*super().get_params(ctx), *ctx.meta.get(_OF_METHODS, ())]

    def sections(self, ctx: click.Context) -> dict[str, list[Row]]:
        """The options of the method that the command line names; without one, what methods there
        are."""
        sections = super().sections(ctx)
        methods = self.methods(ctx.obj)
        named = next((word for word in ctx.obj if methods.get(word) is not None), None)
        if named is None:
            how = f"methods ({ctx.command_path} METHOD --help shows the options of one)"
            sections[how] = [(label_of(method), method.purpose) for method in methods.values()]
            return sections
        method = methods[named]
        params = [parameter_of(entry) for entry in self.fields_of(method).values()]
        sections[f"{label_of(method)} ({method.purpose})"] = [
            row_of(p, ctx) for p in params
        ] or NO_OPTIONS
        return sections

    def invoke(self, ctx: click.Context) -> int:
        try:
            return super().invoke(ctx)
        except FppBenchError:
            raise
        except Exception as error:
            if (failure := registry.failure_in_file(error)) is None:
                raise
            raise PredictionError(f"a method of yours failed: {failure}") from error


def label_of(method: type[Method]) -> str:
    """What a method is called in help and messages."""
    return "trained networks" if method is registry.network_method() else method.name
