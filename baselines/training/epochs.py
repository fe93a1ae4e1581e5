"""The epochs of a training: their (view, frame) pairs, how a batch is read, and the learning rate.

The order of an epoch depends on the seed and its number alone, so that a resumed training gives the same result as one
that never stopped.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.optim import SGD
from torch.optim.lr_scheduler import LambdaLR, ReduceLROnPlateau
from torch.utils.data import DataLoader, Dataset, Sampler

from fpp_ml_bench.baselines.training.recipe import Linear, Plateau, Recipe
from fpp_ml_bench.errors import TrainingError
from fpp_ml_bench.loaders.training import FringeDepth, FringeDepthDataset

_GOLDEN = (5**0.5 - 1) / 2


def epoch_order(pairs: int, drawn: int | None, seed: int, epoch: int) -> list[int]:
    """Indices of epoch ``epoch`` (from 0): all ``pairs`` in a new order, or the next ``drawn`` of one shuffled round of
    all pairs after the other: every pair comes once before any comes twice."""
    drawn = min(drawn or pairs, pairs)
    first = epoch * drawn
    order: list[int] = []
    for turn in range(first // pairs, (first + drawn - 1) // pairs + 1):
        shuffled = np.random.default_rng([seed, turn]).permutation(pairs)
        start = max(0, first - turn * pairs)
        order += shuffled[start : first + drawn - turn * pairs].tolist()
    return order


def spread(pairs: int, drawn: int | None) -> list[int]:
    """``drawn`` indices (all, if None) evenly over ``pairs``, always the same: each in its own stretch of the pairs, at
    a place that walks through it by the golden ratio, so that views and the frames within them come evenly."""
    if drawn is None or drawn >= pairs:
        return list(range(pairs))
    return [int((place + place * _GOLDEN % 1) * pairs / drawn) for place in range(drawn)]


class BatchRead(Dataset[FringeDepth]):
    """`FringeDepthDataset` read a batch at a time, as torch's loader asks of what offers ``__getitems__``."""

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


def training_loader(source: FringeDepthDataset, sampler: EpochSampler, batch: int, pin: bool) -> DataLoader:
    """Batches in the sampler's order, read in this process (that takes less time than a step), as `BatchRead` gives
    them: there is nothing to collate."""
    return DataLoader(BatchRead(source), batch_size=batch, sampler=sampler, collate_fn=lambda b: b, pin_memory=pin)


def open_data(recipe: Recipe, dataset: Path) -> tuple[FringeDepthDataset, FringeDepthDataset]:
    """Training and validation pairs. TrainingError for another image size than the recipe's, or an empty split."""
    datasets = []
    for split in ("train", "validation"):
        data = FringeDepthDataset(dataset, split, recipe.frames, recipe.normalisation, recipe.background_removed)
        if data.source.size != (recipe.size, recipe.size):
            height, width = data.source.size
            raise TrainingError(
                f"{dataset}: holds images of {width} x {height} px, recipe {recipe.name} with preset {recipe.preset} "
                f"expects {recipe.size} x {recipe.size}; build the size it needs: fpp-bench build --out DIR "
                f"--preset full --size {recipe.size}"
            )
        if not len(data):
            raise TrainingError(f"{dataset}: split {split} holds no sample; training needs train and validation")
        datasets.append(data)
    return datasets[0], datasets[1]


_RELATIVE = 1e-9
"""1e-4 x 0.1 x 0.1 is 1.0000000000000002e-06: a rate this near to its minimum has reached it."""


class Schedule:
    """``rate`` of the coming epoch, of all optimisers: that of one without parameters, scheduled by torch."""

    def __init__(self, rule: Plateau | Linear, rate: float) -> None:
        self.rule, self.epochs = rule, 0
        self._holder = SGD([torch.zeros(1)], lr=rate)
        self._scheduler: Any
        if isinstance(rule, Plateau):
            # eps: below 1e-8, its default, no step would be taken any more and the minimum never reached.
            self._scheduler = ReduceLROnPlateau(
                self._holder, factor=rule.factor, patience=rule.patience, min_lr=rule.minimum, eps=0.0
            )
        else:
            length = rule.constant + rule.decay
            self._scheduler = LambdaLR(self._holder, lambda epoch: min(1.0, max(0, length - epoch) / rule.decay))

    @property
    def rate(self) -> float:
        return float(self._holder.param_groups[0]["lr"])

    @property
    def finished(self) -> bool:
        """The rate is at its minimum (plateau), or all epochs are over (linear)."""
        if isinstance(self.rule, Linear):
            return self.epochs >= self.rule.constant + self.rule.decay
        return self.rate <= self.rule.minimum * (1 + _RELATIVE)

    def step(self, validation_loss: float) -> None:
        """An epoch with this validation loss has ended."""
        self.epochs += 1
        self._holder.step()  # no effect; torch warns unless it runs before the scheduler
        if isinstance(self.rule, Linear):
            self._scheduler.step()
        else:
            self._scheduler.step(validation_loss)

    def state(self) -> dict[str, Any]:
        if isinstance(self.rule, Linear):
            return {"epochs": self.epochs}
        best = self._scheduler.best if math.isfinite(self._scheduler.best) else None
        return {"epochs": self.epochs, "rate": self.rate, "bad": self._scheduler.num_bad_epochs, "best": best}

    def restore(self, state: dict[str, Any]) -> None:
        if isinstance(self.rule, Linear):
            for _ in range(state["epochs"]):
                self.step(0.0)
            return
        self.epochs = state["epochs"]
        self._holder.param_groups[0]["lr"] = state["rate"]
        self._scheduler.num_bad_epochs, self._scheduler.last_epoch = state["bad"], state["epochs"]
        self._scheduler.best = math.inf if state["best"] is None else state["best"]
