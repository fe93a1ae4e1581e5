"""Methods that turn fringes into depth, and running them over a dataset.

A method takes the frames it names and gives ``depth_mm``; `fpp_ml_bench.baselines.methods` lists what there is, and
`fpp_ml_bench.baselines.prediction` runs one over a split and writes predictions that ``fpp-eval`` scores.

>>> from fpp_ml_bench.baselines import build, load
>>> network = build("unet")                              # bare and untrained    # doctest: +SKIP
>>> model = load("unet-individual-hybrid_l1_0.7")        # trained    # doctest: +SKIP
>>> depth_mm = model.predict(fringe)                     # doctest: +SKIP

Importing this package does not import torch; using these two names does.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.model import load as load
    from fpp_ml_bench.baselines.networks import build as build

_LAZY = {"build": "fpp_ml_bench.baselines.networks", "load": "fpp_ml_bench.baselines.model"}


def __getattr__(name: str) -> object:
    if name in _LAZY:
        from importlib import import_module

        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'fpp_ml_bench.baselines' has no attribute {name!r}")
