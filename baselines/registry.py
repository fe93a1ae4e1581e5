"""Finding a method: those of this package and of installed packages by name, one of a file as
``mine.py:Mine``, and trained networks by the name or path of their weights.

An installed package offers methods by the entry point group `GROUP`:

    [project.entry-points."fpp_ml_bench.methods"]
    mine = "my_package.methods:Mine"
"""

import ast
import inspect
import os
import pickle
import sys
import sysconfig
import traceback
from dataclasses import fields
from functools import cache
from hashlib import file_digest, sha256
from importlib import import_module, metadata
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any, NamedTuple

from fpp_ml_bench.baselines.from_hub import FILE_MARK, SCHEME, fetched
from fpp_ml_bench.baselines.method import Method, Photographed, Setting, is_built_in
from fpp_ml_bench.errors import FppBenchError, PredictionError, WeightsError
from fpp_ml_bench.files import is_file, printable
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.options import did_you_mean

GROUP = "fpp_ml_bench.methods"
PACKAGE = __name__.partition(".")[0]
BUILT_IN = (
    "classical:ClassicalMethod",
    "phase.method:PhaseMethod",
    "phase.method:CrossedMethod",
    "learned.method:FringeNetMethod",
    "trivial:ConstantMethod",
    "trivial:NearestMethod",
)
"""The classes of this package, below `fpp_ml_bench.baselines`. Their names are their own."""
NEEDED = ("name", "title", "frames_used")
"""What a method has beside `predict` or `answer`."""
NETWORKS = "networks.network_method:NetworkMethod"
"""The class that trained networks from image to depth are made with, by their weights."""


WEIGHTS = (
    ".bin",
    ".ckpt",
    ".h5",
    ".joblib",
    ".mat",
    ".npy",
    ".npz",
    ".onnx",
    ".pkl",
    ".pt",
    ".pth",
    ".safetensors",
)
"""How files of weights end: those that the code of a method names are a part of it."""


class Found(NamedTuple):
    """A method's class, and the options that its name already says."""

    method: type[Method]
    options: dict[str, Any]


def methods() -> dict[str, type[Method]]:
    """The methods by name: those of this package, then those of installed ones. What an installed
    package offers and can't be used is left out here; `find` says why when it is asked for."""
    return {**{method.name: method for method in map(_built_in, BUILT_IN)}, **_installed()[0]}


def network_method() -> type[Method]:
    """The class of trained networks from image to depth."""
    return _built_in(NETWORKS)


def find(name: str | Path, trust: bool = False) -> Found:
    """The class that ``name`` means: a method's name, ``file.py:Class`` (the file is executed), or
    weights that come with the package or in a ``.safetensors`` file, or a recipe that ``fpp-bench
    reproduce`` has trained, or ``hf://OWNER/NAME``, a repository of the Hub, whose code is executed
    only with ``trust``. Raises `PredictionError`, for an unknown name with what it might have
    meant."""
    text = str(name)
    if text.startswith(SCHEME):
        place = fetched(text, trust)
        found = find(place.name)
        return Found(found.method, {**found.options, **place.options})
    if text.endswith(".py"):
        text += ":"
    if FILE_MARK in text:
        method = _checked(load_from_file(text), text)
        path, _, attribute = text.rpartition(":")
        _let_workers_have(method, f"{Path(path).absolute()}:{attribute}")
        return Found(method, {})
    known = methods()
    if text in known:
        return Found(known[text], {})
    if text in (unusable := _installed()[1]):
        raise PredictionError(unusable[text])
    from fpp_ml_bench.baselines.training.recipe import TABLES
    from fpp_ml_bench.baselines.training.weights import shipped_names, weights_path

    try:
        if text.endswith((".yaml", ".yml")) or (
            text.split("/")[0] in TABLES and not text.endswith(".safetensors")
        ):
            return Found(network_method(), {"recipe": text})
        return Found(network_method(), {"weights": weights_path(name)})
    except WeightsError:
        hint = did_you_mean(text, [*known, *shipped_names()])
        raise PredictionError(
            f"unknown method {printable(text, 200)!r}; {hint}. A method is a name, file.py:Class, "
            f"or a .safetensors "
            "file of trained weights"
        ) from None


def load_method(
    name: str | Path, source: Photographed | Rig, *, trust: bool = False, **options: object
) -> Method:
    """The method that ``name`` means (see `find`), for a dataset, or for images of a rig.

    ``options`` are the fields of its class's ``Options``; a network also takes ``device`` (``cpu``, ``cuda``, ...).
    >>> from fpp_ml_bench.baselines.registry import load_method
    >>> depth_mm = load_method("phase", dataset).predict(frames)    # doctest: +SKIP

    Raises `PredictionError` for an unknown name, and what the method refuses: unusable weights,
    invalid options.
    """
    method, preset = find(name, trust)
    own_answer = method.answer is not Method.answer
    if method.predict is Method.predict and not own_answer:
        raise PredictionError(f"{name}: does not define predict, or answer, which a method needs")
    if own_answer and is_built_in(method.answer) and not is_built_in(method.predict):
        raise PredictionError(
            f"{name}: what it inherits answers without its predict; define answer instead"
        )
    shown = source.without_truth() if isinstance(source, DatasetFolder) else source
    make = method.for_rig if isinstance(shown, Rig) else method.for_dataset
    made = make(shown, **{**preset, **options})  # type: ignore[arg-type]
    if missing := [key for key in NEEDED if not hasattr(made, key)]:
        raise PredictionError(
            f"{name}: has no {missing[0]}, which a method needs; set it in the class: "
            f"name, title, frames_used = 'mine', 'what it is called in a table', (0,)"
        )
    given = {**{entry.name: entry.default for entry in fields(method.Options)}, **options}
    files = {key: Path(value) for key, value in given.items() if isinstance(value, str | Path)}
    settings: dict[str, Setting] = {
        f"{key}_sha256": _sha256(path) for key, path in files.items() if is_file(path)
    }
    settings |= made.settings
    if str(name).startswith(SCHEME):
        settings["repository"] = fetched(str(name), trust).source
    if (digest := source_sha256(method)) is not None:
        made.code, settings["source_sha256"] = code_of(method), digest
    try:
        made.settings = settings
    except AttributeError:
        raise PredictionError(
            f"{name}: settings is read only; set it in __init__, as a dictionary"
        ) from None
    return made


def load_from_file(text: str) -> Any:
    """The object that ``file.py:name`` means; the file is executed once. `PredictionError` where
    that fails."""
    path_text, _, name = text.rpartition(":")
    module = _module_of(Path(path_text).absolute())
    try:
        return getattr(module, name)
    except AttributeError:
        own = [
            key
            for key, value in vars(module).items()
            if getattr(value, "__module__", "") == module.__name__
        ]
        wrong = (
            f"has no {printable(name)!r}"
            if name
            else f"expected {path_text}:NAME, which says what of it"
        )
        raise PredictionError(f"{path_text}: {wrong}; {did_you_mean(name, own)}") from None


def code_of(method: type[Method]) -> dict[str, str]:
    """`code_in` the file of a class; empty for one of this package, whose version says what it
    is."""
    file = None if is_built_in(method) else inspect.getsourcefile(method)
    return {} if file is None else code_in(Path(file), method.__module__.partition(".")[0])


def source_sha256(method: type[Method]) -> str | None:
    """SHA-256 of a class's name and code; None for one of this package."""
    code = code_of(method)
    return sha256(f"{method.__qualname__} {code}".encode()).hexdigest() if code else None


@cache
def code_in(file: Path, package: str = "") -> dict[str, str]:
    """What ``file`` is made of: by their path from its folder the SHA-256 of itself, of what is
    imported from beside it or from its ``package``, and of files of `WEIGHTS` that a text in these
    names. What the code puts together while it runs is not seen. Read once, as the file is executed
    once."""
    paths = {file}
    for name, module in sys.modules.copy().items():
        top, path = name.partition(".")[0], Path(getattr(module, "__file__", None) or "")
        beside = path.is_relative_to(file.parent) and "site-packages" not in path.parts
        beside = beside and not path.is_relative_to(sysconfig.get_path("stdlib"))
        if top == package or (beside and top != "__main__" and not top.startswith(PACKAGE)):
            paths.add(path)
    for path in [path for path in paths if path.suffix == ".py"]:
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.Constant) and str(node.value).endswith(WEIGHTS):
                paths |= {path.parent / str(node.value), Path(str(node.value)).resolve()}
    return {
        os.path.relpath(path, file.parent): _sha256(path) for path in sorted(paths) if is_file(path)
    }


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()


def failure_in_file(error: BaseException) -> str | None:
    """Where and why code of a file given as ``file.py:Class`` failed, for a message; None for any
    other error."""
    own = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if Path(frame.filename) in _FILES
    ]
    return (
        f"{own[-1].filename}, line {own[-1].lineno}, in {own[-1].name}: {_cause(error)}"
        if own
        else None
    )


def _let_workers_have(method: type[Method], place: str) -> None:
    """Instances of a class of a file go to other processes with its ``place``, for its module can't
    be imported there by name."""

    def reduced(self: Method, protocol: object) -> tuple[Any, ...]:
        return _of_file, (place, pickle.dumps(vars(self)))

    method.__reduce_ex__ = reduced  # type: ignore[assignment]


def _of_file(place: str, state: bytes) -> Method:
    """The instance that `_let_workers_have` sent."""
    method = find(place).method
    instance = method.__new__(method)
    vars(instance).update(pickle.loads(state))  # of the parent process
    return instance


_FILES: set[Path] = set()
"""The files that were executed."""


@cache
def _module_of(path: Path) -> Any:
    if not path.is_file():
        raise PredictionError(f"{path}: no such file; expected FILE.py:NAME")
    name = f"fpp_ml_bench_user_{path.stem}_{sha256(str(path).encode()).hexdigest()[:8]}"  # of two mine.py, each its own
    spec = spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise PredictionError(f"{path}: is no Python file; expected FILE.py:NAME")
    module = module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    _FILES.add(path)
    sys.path.insert(0, str(path.parent))  # for what it imports from beside it
    try:
        spec.loader.exec_module(module)
    except FppBenchError:
        raise
    except (Exception, SystemExit) as error:  # the user's code can raise anything
        own = [
            frame
            for frame in traceback.extract_tb(error.__traceback__)
            if frame.filename == str(path)
        ]
        line = f" (line {own[-1].lineno})" if own else ""
        raise PredictionError(f"{path}: importing it failed: {_cause(error)}{line}") from error
    finally:
        sys.path.remove(str(path.parent))
    return module


@cache
def _built_in(place: str) -> type[Method]:
    module, _, name = place.partition(":")
    method: type[Method] = getattr(import_module(f"fpp_ml_bench.baselines.{module}"), name)
    return method


@cache
def _installed() -> tuple[dict[str, type[Method]], dict[str, str]]:
    """Methods of installed packages by name, and what is wrong with those that can't be used, by
    the name offered."""
    taken = {method.name for method in map(_built_in, BUILT_IN)}
    usable: dict[str, type[Method]] = {}
    unusable: dict[str, str] = {}
    for entry in metadata.entry_points(group=GROUP):
        where = f"{entry.value} of the installed package {entry.dist.name if entry.dist else '?'}"
        try:
            method = _checked(entry.load(), where)
        except PredictionError as error:
            unusable[entry.name] = str(error)
        except Exception as error:  # whatever a stranger's package does when it is imported
            unusable[entry.name] = (
                f"{where} can't be imported: {_cause(error)}; repair or uninstall it"
            )
        else:
            if method.name in taken or method.name in usable:
                unusable[entry.name] = (
                    f"{where}: the name {method.name!r} is taken; uninstall one of the two"
                )
            else:
                usable[method.name] = method
    return usable, unusable


def _checked(method: Any, where: str) -> type[Method]:
    """``method`` if it is a class of methods that says what it must."""
    if not (isinstance(method, type) and issubclass(method, Method)):
        raise PredictionError(
            f"{where}: expected a subclass of fpp_ml_bench.Method, got {type(method).__name__}"
        )
    name = getattr(method, "name", None)
    if (
        not isinstance(name, str)
        or not name
        or printable(name) != name
        or any(c in name for c in " /:\\")
    ):
        raise PredictionError(
            f"{where}: its name is {name!r}; expected text without spaces, slashes and colons"
        )
    return method


def _cause(error: BaseException) -> str:
    return f"{type(error).__name__}: {printable(str(error), 300)}"
