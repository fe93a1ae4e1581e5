"""Datasets: generate or import fringe stacks, store them as Arrow shards, read them. ``load_dataset(FOLDER, CONFIG,
split=...)`` gives a ``datasets.Dataset`` on the memory-mapped shards; ``DatasetFolder`` gives single images as NumPy
views; ``FringeDepthDataset`` gives torch tensors for training."""
