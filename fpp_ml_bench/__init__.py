"""FPP-ML-Bench: data, strict evaluation, baselines and leaderboard for single-shot fringe projection profilometry.

The core (rig, patterns, phase, triangulation) lives here; the rooms that build on it are the subpackages
``loaders <- evaluation <- baselines <- leaderboard``, each importing only what stands left of it.
Nothing heavy is imported until it is used: ``import fpp_ml_bench`` costs a few milliseconds.
"""

from pathlib import Path as _Path
from typing import TYPE_CHECKING

__version__ = "0.1.0"

_ROOT = _Path(__file__).resolve().parent.parent
if (_ROOT / "pyproject.toml").is_file() and (_ROOT / "loaders" / "__init__.py").is_file():
    # A source checkout: the rooms are folders beside this one. An editable install finds them by itself; when the
    # checkout is merely the current folder it shadows an installed wheel, and core and rooms must come from one place.
    __path__.append(str(_ROOT))

if TYPE_CHECKING:
    from fpp_ml_bench.loaders import load_dataset as load_dataset

_LAZY = {"load_dataset": "fpp_ml_bench.loaders"}


def __getattr__(name: str) -> object:
    if name in _LAZY:
        from importlib import import_module

        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'fpp_ml_bench' has no attribute {name!r}")
