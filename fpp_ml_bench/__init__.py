"""FPP-ML-Bench: data, strict evaluation, baselines and leaderboard for single-shot fringe projection profilometry.

This package is the core: rig, patterns, phase, triangulation. The subpackages build on it in the order
``loaders <- evaluation <- baselines <- leaderboard``; each imports only the core and the packages to its left.
Nothing heavy is imported until it is used: ``import fpp_ml_bench`` takes a few milliseconds.
"""

from pathlib import Path as _Path
from typing import TYPE_CHECKING

__version__ = "0.2.0"

_ROOT = _Path(__file__).resolve().parent.parent
if (_ROOT / "pyproject.toml").is_file() and (_ROOT / "loaders" / "__init__.py").is_file():
    # A source checkout: the subpackages are folders beside this one. An editable install finds them by itself. When the
    # checkout is only the current folder it shadows an installed wheel; core and subpackages must not mix the two.
    __path__.append(str(_ROOT))

if TYPE_CHECKING:
    from fpp_ml_bench.loaders import load_dataset as load_dataset

_LAZY = {"load_dataset": "fpp_ml_bench.loaders"}


def __getattr__(name: str) -> object:
    if name in _LAZY:
        from importlib import import_module

        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'fpp_ml_bench' has no attribute {name!r}")
