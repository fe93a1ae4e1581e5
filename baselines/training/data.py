"""The (view, frame) pairs of an epoch and of validation, and how a batch of them is read.

The order of an epoch depends on the seed and its number alone, so that a resumed training gives the same result as one
that never stopped.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.data import DataLoader, Dataset, Sampler

from fpp_ml_bench.baselines.training.recipe import Recipe
from fpp_ml_bench.errors import TrainingError
from fpp_ml_bench.loaders.training import FringeDepth, FringeDepthDataset

_GOLDEN = (5**0.5 - 1) / 2


def epoch_order(pairs: int, drawn: int | None, seed: int, epoch: int) -> list[int]:
    """Indices of epoch ``epoch`` (from 0): all ``pairs`` in a new order, or ``drawn`` of them without repetition.

    With ``drawn`` the epochs walk through one shuffled round of all pairs after the other: every pair comes once before
    any comes twice.
    """
    drawn = min(drawn or pairs, pairs)
    first = epoch * drawn
    order: list[int] = []
    for turn in range(first // pairs, (first + drawn - 1) // pairs + 1):
        shuffled = np.random.default_rng([seed, turn]).permutation(pairs)
        start = max(0, first - turn * pairs)
        order += shuffled[start : first + drawn - turn * pairs].tolist()
    return order


def spread(pairs: int, drawn: int | None) -> list[int]:
    """``drawn`` indices (all, if None) evenly over ``pairs``; always the same ones.

    Each lies in its own stretch of the pairs, at a place that walks through it by the golden ratio: views come evenly,
    and so do the frames within a view.
    """
    if drawn is None or drawn >= pairs:
        return list(range(pairs))
    return [int((place + place * _GOLDEN % 1) * pairs / drawn) for place in range(drawn)]


class BatchRead(Dataset[FringeDepth]):
    """`FringeDepthDataset` read a batch at a time, as torch's loader asks when the dataset offers ``__getitems__``."""

    def __init__(self, source: FringeDepthDataset) -> None:
        self.source = source

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: int) -> FringeDepth:
        return self.source[index]

    def __getitems__(self, indices: list[int]) -> FringeDepth:
        return self.source.read(indices)


class EpochSampler(Sampler[int]):
    """`epoch_order` as a sampler; set ``epoch`` before each pass."""

    def __init__(self, pairs: int, drawn: int | None, seed: int) -> None:
        self.pairs, self.drawn, self.seed, self.epoch = pairs, drawn, seed, 0

    def __len__(self) -> int:
        return min(self.drawn or self.pairs, self.pairs)

    def __iter__(self) -> Iterator[int]:
        return iter(epoch_order(self.pairs, self.drawn, self.seed, self.epoch))


def _as_read(batch: Any) -> FringeDepth:
    """`BatchRead` gives whole batches, so there is nothing to collate."""
    return batch


def training_loader(source: FringeDepthDataset, sampler: EpochSampler, batch: int, pin: bool) -> DataLoader:
    """Batches in the sampler's order, read in this process: a batch takes less time than a step."""
    return DataLoader(BatchRead(source), batch_size=batch, sampler=sampler, collate_fn=_as_read, pin_memory=pin)


def open_data(recipe: Recipe, dataset: Path) -> tuple[FringeDepthDataset, FringeDepthDataset]:
    """Training and validation pairs. TrainingError for another image size than the recipe's, or an empty split."""
    datasets = []
    for split in ("train", "validation"):
        data = FringeDepthDataset(dataset, split, recipe.data_config, recipe.normalisation, recipe.background_removed)
        if data.source.size != (recipe.size, recipe.size):
            height, width = data.source.size
            raise TrainingError(
                f"{dataset}: holds images of {width} x {height} px, recipe {recipe.name} with preset {recipe.preset} "
                f"expects {recipe.size} x {recipe.size}; build the size it needs: fpp-bench build DIR --preset full "
                f"--size {recipe.size}"
            )
        if not len(data):
            raise TrainingError(f"{dataset}: split {split} holds no sample; training needs train and validation")
        datasets.append(data)
    return datasets[0], datasets[1]
