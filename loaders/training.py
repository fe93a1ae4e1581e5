"""Training samples as torch tensors: pairs of a fringe image and a depth map in a chosen
representation."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.depth import (
    NORMALISATIONS,
    Normalisation,
    RangeRule,
    depth_range_mm,
    normalise,
    object_mask,
)
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.loaders.storage.store import DatasetFolder


class FringeDepth(NamedTuple):
    """A training sample, or a batch of samples with a leading axis B. ``fringe`` float32 (1, H, W)
    in [0, 1]; ``depth`` float32 (1, H, W) in the chosen representation, 0 = background;
    ``depth_range_mm`` float32 (2,), D_min and D_max of the sample; ``row`` and ``frame`` int64, the
    sample's row in the split and the frame index."""

    fringe: torch.Tensor
    depth: torch.Tensor
    depth_range_mm: torch.Tensor
    row: torch.Tensor
    frame: torch.Tensor


class FringeDepthDataset(Dataset[FringeDepth]):
    """Pairs of a frame and the depth map of its sample (paper Sections 3.3 and 5.4).

    ``config``: the frames that form pairs: ``single_shot`` (frame 0), ``horizontal``, ``vertical``,
    ``sinusoidal`` or ``all``. The full set has 240, 4,320, 4,320, 8,640 and 12,480 training pairs.
    ``normalisation``: ``raw`` (mm), ``global`` (m) or ``individual`` ([0, 1] from the sample's own
    D_min and D_max).
    ``background_removed``: set the fringe to 0 where the depth is 0 (paper Section 5.3.4).
    ``range_rule``: D_min and D_max are those of the object's pixels that are not void (``valid``),
    or of all of them (``object``: the stored columns, and the paper's). Void pixels often are wrong
    by centimetres, and an end of the range is then; by ``valid``, individual depth beyond it is cut
    to [0, 1].
    ``samples``: these, of any split, instead of those of ``split``.

    Works with ``torch.utils.data.DataLoader`` and any number of workers: each maps the files
    itself, and sends batches through shared memory (/dev/shm), which must be writable and hold
    some. In a single process `batches` is faster, as it reuses its buffers, and needs none. Raises
    `DatasetError` for a missing folder, split or config.
    """

    def __init__(
        self,
        folder: str | Path,
        split: str,
        config: str = "single_shot",
        normalisation: Normalisation = "individual",
        background_removed: bool = False,
        range_rule: RangeRule = "valid",
        samples: Sequence[str] | None = None,
    ) -> None:
        self.source = DatasetFolder(folder)
        if config not in self.source.configs:
            raise DatasetError(
                f"{folder}: no configuration {config!r}; there are {', '.join(self.source.configs)}"
            )
        if normalisation not in NORMALISATIONS:
            raise DatasetError(
                f"unknown normalisation {normalisation!r}; there are {', '.join(NORMALISATIONS)}"
            )
        self.samples = self.source.samples(split) if samples is None else list(samples)
        self.frames = self.source.sequence.config(config)
        self.normalisation: Normalisation = normalisation
        self.background_removed = background_removed
        self.range_rule: RangeRule = range_rule
        self._ranges_mm: dict[str, tuple[float, float]] = {}

    def __len__(self) -> int:
        return len(self.samples) * len(self.frames)

    def pair(self, index: int) -> tuple[int, int]:
        """Row and frame of item ``index``: all frames of a row, then the next row."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"item {index} of {len(self)}")
        row, position = divmod(index % len(self), len(self.frames))
        return row, self.frames[position]

    def __getitem__(self, index: int) -> FringeDepth:
        return FringeDepth(*(tensor[0] for tensor in self.read([index])))

    def read(self, indices: Sequence[int], out: FringeDepth | None = None) -> FringeDepth:
        """Items ``indices`` as a batch, fringe and depth (B, 1, H, W); into ``out``, of the same B,
        if given."""
        batch = self.empty(len(indices)) if out is None else out
        if len(batch.fringe) != len(indices):
            raise ValueError(
                f"out holds {len(batch.fringe)} items, expected {len(indices)}, one for each index"
            )
        fringes, depths = batch.fringe.numpy(), batch.depth.numpy()
        for position, index in enumerate(indices):
            row, frame = self.pair(index)
            sample = self.samples[row]
            depth_mm = self.source.depth_mm(sample)
            low, high = self.depth_range_mm(sample)
            unit_range(self.source.frame(sample, frame), fringes[position, 0])
            if self.background_removed:
                fringes[position, 0] *= object_mask(depth_mm)
            normalise(depth_mm, self.normalisation, low, high, out=depths[position, 0])
            if self.normalisation == "individual" and self.range_rule == "valid":
                np.clip(depths[position, 0], 0, 1, out=depths[position, 0])
            batch.depth_range_mm[position, 0], batch.depth_range_mm[position, 1] = low, high
            batch.row[position], batch.frame[position] = row, frame
        return batch

    def depth_range_mm(self, sample: str) -> tuple[float, float]:
        """D_min and D_max of a sample by ``range_rule``; read once."""
        if sample not in self._ranges_mm:
            measured = self.source.measured(sample)
            stored = measured["depth_min_mm"], measured["depth_max_mm"]
            # A sample without an object has none; its stored range is 0 to 0.
            by_rule = self.range_rule == "object" or not stored[1]
            void = None if by_rule else self.source.void(sample)
            self._ranges_mm[sample] = (
                stored if by_rule else depth_range_mm(self.source.depth_mm(sample), void)
            )
        return self._ranges_mm[sample]

    def empty(self, size: int) -> FringeDepth:
        """Buffers for a batch of ``size`` items."""
        image = (size, 1, *self.source.size)
        return FringeDepth(
            torch.empty(image),
            torch.empty(image),
            torch.empty(size, 2),
            torch.empty(size, dtype=torch.int64),
            torch.empty(size, dtype=torch.int64),
        )

    def batches(self, size: int, order: Sequence[int] | None = None) -> Iterator[FringeDepth]:
        """Batches of ``size`` items (the last may be smaller) in ``order``, default ascending. The
        tensors are views of a buffer that the next batch overwrites: copy data that is needed
        longer (moving a batch to a GPU copies it)."""
        order = range(len(self)) if order is None else order
        buffer = self.empty(size)
        for start in range(0, len(order), size):
            indices = order[start : start + size]
            yield self.read(indices, FringeDepth(*(tensor[: len(indices)] for tensor in buffer)))


def unit_range(grey: NDArray[np.uint8], out: NDArray[np.float32]) -> None:
    """Grey levels / 255 into ``out``: a product with the float32 reciprocal, within 1 unit in the
    last place."""
    np.multiply(grey, np.float32(1 / GREY_LEVELS), out=out)
