"""MAE and RMSE over a set of pixels, sums that keep their digits, and unions of sets.

Numerical contract: differences are formed in float64 whatever the input; every sum is float64 over blocks of
`BLOCK` pixels that stay in the cache, the block sums added exactly (`math.fsum`). Errors above 1e140 are refused, and
errors so small that their squares vanish are squared as parts of the largest, so that an RMSE is never 0 by underflow.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import PredictionError

BLOCK = 9600
"""Pixels a block. OpenBLAS spreads dot products over its threads from 10,000 elements on, and the rounding of the sum
would then depend on the number of cores; below that a score is the same on every machine of one kind."""

_SQUARES_LOST = 1e-280
"""Mean square below which squares have lost digits, the smallest normal number being 2e-308 and an image a million
pixels."""
NOT_FINITE = "the errors are not finite, or too large to square (above about 1e140)"


@dataclass(frozen=True, slots=True)
class ErrorStats:
    """Mean absolute and root mean square error in mm over ``pixels`` pixels; both None for an empty set, never 0."""

    pixels: int
    mae_mm: float | None
    rmse_mm: float | None


EMPTY = ErrorStats(0, None, None)


def combine(*parts: ErrorStats) -> ErrorStats:
    """Statistics of the union of disjoint pixel sets. Exact for one non-empty part; no square leaves its scale."""
    filled = [(s.pixels, s.mae_mm, s.rmse_mm) for s in parts if s.mae_mm is not None and s.rmse_mm is not None]
    if not filled:
        return EMPTY
    total = sum(n for n, _, _ in filled)
    if len(filled) == 1:
        return ErrorStats(total, filled[0][1], filled[0][2])
    mae = math.fsum(n * mae for n, mae, _ in filled) / total
    largest = max(rmse for _, _, rmse in filled)
    squares = math.fsum(n * (rmse / largest) ** 2 for n, _, rmse in filled) if largest else 0.0
    return ErrorStats(total, mae, largest * math.sqrt(squares / total))


def stats_of(errors: NDArray[np.float64]) -> ErrorStats:
    """Statistics of float64 errors (n,), in blocks."""
    absolute, squares = [], []
    for start in range(0, errors.size, BLOCK):
        block = errors[start : start + BLOCK]
        squares.append(float(block.dot(block)))
        absolute.append(float(np.abs(block).sum()))
    return finish(errors.size, absolute, squares, lambda: errors)


def mean_of(errors: NDArray[np.float64]) -> float | None:
    """Mean of float64 values (n,) of either sign, with the same blocks; None of none."""
    if errors.size == 0:
        return None
    return math.fsum(float(errors[i : i + BLOCK].sum()) for i in range(0, errors.size, BLOCK)) / errors.size


def finish(
    pixels: int, absolute: list[float], squares: list[float], errors: Callable[[], NDArray[np.float64]]
) -> ErrorStats:
    """Statistics from the blocks' sums; ``errors`` gives the errors themselves (n,) where the squares underflow.

    Raises PredictionError where a sum is not finite.
    """
    if pixels == 0:
        return EMPTY
    try:
        mae, mean_square = math.fsum(absolute) / pixels, math.fsum(squares) / pixels
    except (OverflowError, ValueError):  # fsum of huge values, or of inf and -inf
        mae = mean_square = math.inf
    if not math.isfinite(mae) or not math.isfinite(mean_square):
        raise PredictionError(NOT_FINITE)
    if mean_square < _SQUARES_LOST and any(absolute):
        small = errors()
        largest = float(np.abs(small).max())
        return ErrorStats(pixels, mae, largest * (stats_of(small / largest).rmse_mm or 0.0))
    return ErrorStats(pixels, mae, math.sqrt(mean_square))
