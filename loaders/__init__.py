"""Datasets: generate or import fringe stacks, store them as Arrow shards, read them.
``load_dataset(FOLDER, CONFIG, split=...)`` gives a ``datasets.Dataset`` on the memory-mapped
shards; ``DatasetFolder`` gives single images as NumPy arrays; ``FringeDepthDataset`` gives torch
tensors for training."""


def __getattr__(name: str) -> object:
    if name != "FringeDepthDataset":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from fpp_ml_bench.loaders.training import FringeDepthDataset  # needs torch

    return FringeDepthDataset
