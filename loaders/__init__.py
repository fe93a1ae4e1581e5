"""Datasets: generate or import fringe stacks, store them as Arrow shards, read them.

``load_dataset(FOLDER, CONFIG, split=...)`` gives a ``datasets.Dataset`` on the memory-mapped shards; ``DatasetFolder``
gives single images as NumPy views; ``FringeDepthDataset`` gives torch tensors for training.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.joined import load_dataset as load_dataset
    from fpp_ml_bench.loaders.store import DatasetFolder as DatasetFolder
    from fpp_ml_bench.loaders.training import FringeDepthDataset as FringeDepthDataset

_LAZY = {"load_dataset": "joined", "DatasetFolder": "store", "FringeDepthDataset": "training"}
__all__ = ["DatasetFolder", "FringeDepthDataset", "load_dataset"]


def __getattr__(name: str) -> object:
    if name in _LAZY:
        from importlib import import_module

        return getattr(import_module(f"fpp_ml_bench.loaders.{_LAZY[name]}"), name)
    raise AttributeError(f"module 'fpp_ml_bench.loaders' has no attribute {name!r}")
