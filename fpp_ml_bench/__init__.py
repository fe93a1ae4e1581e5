"""FPP-ML-Bench: data, strict evaluation, baselines and leaderboard for single-shot fringe
projection profilometry.

The front door is the seven functions of `fpp_ml_bench.api`. Behind it: ``optics`` and ``decoding``
(rig, patterns, phase, triangulation), then the subpackages ``loaders <- evaluation <- baselines <-
leaderboard``; each imports only the core and those to its left. Nothing heavy is imported until it
is used: ``import fpp_ml_bench`` takes milliseconds.
"""

import sys as _sys
from importlib import import_module as _import_module
from importlib.machinery import ModuleSpec as _ModuleSpec
from importlib.machinery import PathFinder as _PathFinder
from pathlib import Path as _Path

__version__ = "0.4.0"
RELEASED = "2026-11-28"
"""Date of the release, as in CITATION.cff."""

_ROOT = _Path(__file__).resolve().parent.parent
_ROOMS = frozenset(
    f"{__name__}.{room}" for room in ("loaders", "evaluation", "baselines", "leaderboard")
)


class _Checkout:
    """Finds the four subpackages of a source checkout, which are folders beside this one, and
    nothing else there. When the checkout is only the current folder, it shadows an installed wheel;
    the two must not mix."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> _ModuleSpec | None:
        return _PathFinder.find_spec(name, [str(_ROOT)]) if name in _ROOMS else None


if (_ROOT / "pyproject.toml").is_file() and (_ROOT / "loaders" / "__init__.py").is_file():
    _sys.meta_path.insert(0, _Checkout)  # type: ignore[arg-type]

__all__ = [
    "Method",
    "compare",
    "decode",
    "evaluate",
    "load_dataset",
    "load_method",
    "open_dataset",
    "rank",
]


def __getattr__(name: str) -> object:
    """The front door's names, imported when one is used."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = "baselines.method" if name == "Method" else "api"
    value = globals()[name] = getattr(_import_module(f"{__name__}.{module}"), name)
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
