"""The pixels that an examination looks at: some rows and columns of the image, whose pixels have neighbours."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding import MIN_MODULATION

LINES, MOST_PX = 40, 150_000
LEAST_LIT_GREY = 3 * MIN_MODULATION
"""A pixel is lit where its grey levels differ by so much from frame to frame."""
_LOOKED_AT_PX = 40_000


@dataclass(frozen=True)
class Lines:
    """``levels`` (F, n) of n pixels at ``column`` and ``row``, line after line. ``joined``: the next pixel is the
    neighbour on the same line; ``across``: the line is a row; ``lit`` pixels change from frame to frame."""

    levels: NDArray
    column: NDArray[np.intp]
    row: NDArray[np.intp]
    joined: NDArray[np.bool_]
    across: NDArray[np.bool_]
    lit: NDArray[np.bool_]

    def part(self, most_px: int) -> "Lines":
        """The lit pixels of some of the lines, ``most_px`` and up to a line more."""
        starts = np.flatnonzero(np.append(True, ~self.joined[:-1]))
        line = np.cumsum(np.append(True, ~self.joined[:-1])) - 1
        step = max(1, int(self.lit.sum() // most_px))
        # Every step-th row and every step-th column: both kinds stay.
        order = np.arange(len(starts))
        picked = np.flatnonzero(self.lit & (order % step == step // 2)[line])
        joined = self.joined[picked] & np.append(np.diff(picked) == 1, False)
        return Lines(
            self.levels[:, picked], self.column[picked], self.row[picked], joined, self.across[picked], self.lit[picked]
        )


def take_lines(frames: NDArray | Sequence[NDArray], mask: NDArray[np.bool_] | None = None) -> Lines:
    """The lines of ``frames`` (F, H, W) that hold the most lit pixels, evenly spread; those in ``mask`` alone count."""
    stack = frames if isinstance(frames, np.ndarray) else np.stack(list(frames))
    height, width = stack.shape[1:]
    step = max(1, int(np.sqrt(height * width / _LOOKED_AT_PX)))
    coarse = np.ptp(stack[:, ::step, ::step], axis=0) >= LEAST_LIT_GREY
    if mask is not None:
        coarse &= mask[::step, ::step]
    count = max(4, min(LINES, MOST_PX // (height + width)))
    parts, of_rows = [], coarse.sum(axis=1)
    for counts, across in ((of_rows, True), (coarse.sum(axis=0), False)):
        cumulated = np.cumsum(counts) / max(counts.sum(), 1)
        chosen = np.unique(np.searchsorted(cumulated, (np.arange(count) + 0.5) / count).clip(0, len(counts) - 1)) * step
        along = np.arange(width if across else height)
        fixed, moving = np.repeat(chosen, len(along)), np.tile(along, len(chosen))
        parts.append((fixed, moving, across) if across else (moving, fixed, across))
    row, column = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    across_all = np.concatenate([np.full(len(part[0]), part[2]) for part in parts])
    ends = np.concatenate([(part[1] == width - 1) if part[2] else (part[0] == height - 1) for part in parts])
    levels = stack[:, row, column]
    lit = np.ptp(levels, axis=0) >= LEAST_LIT_GREY
    if mask is not None:
        lit &= mask[row, column]
    return Lines(levels, column, row, ~ends, across_all, lit)
