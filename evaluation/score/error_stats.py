"""MAE and RMSE over a set of pixels, accurate sums, and unions of sets.

Numerical contract: differences are formed in float64 whatever the input; every sum is float64 over blocks of
`BLOCK` pixels that fit into the cache, and the block sums are added exactly (`math.fsum`). Errors above 1e140 are
refused. Errors so small that their squares underflow are divided by the largest before they are squared, so that an
RMSE is never 0 by underflow.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import PredictionError

BLOCK = 9600
"""Pixels per block. OpenBLAS spreads dot products over its threads from 10,000 elements on, and the rounding of the sum
would then depend on the number of cores. Below that a score depends on the type of processor only."""

_SQUARES_LOST = 1e-280
"""Mean square below which squares may have lost digits: the smallest normal number is 2e-308, and an image has about a
million pixels."""
NOT_FINITE = "the errors are not finite, or too large to square (above about 1e140)"


@dataclass(frozen=True, slots=True)
class ErrorStats:
    """Mean absolute and root mean square error in mm over ``pixels`` pixels; both None for an empty set, never 0."""

    pixels: int
    mae_mm: float | None
    rmse_mm: float | None


EMPTY = ErrorStats(0, None, None)


def combine(*parts: ErrorStats) -> ErrorStats:
    """Statistics of the union of disjoint pixel sets, without overflow or underflow; exact for one non-empty part."""
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
    return stats_of_sums(errors.size, absolute, squares, lambda: errors)


def mean_of(errors: NDArray[np.float64]) -> float | None:
    """Mean of float64 values (n,) of either sign, in the same blocks; None for no values."""
    if errors.size == 0:
        return None
    return math.fsum(float(errors[i : i + BLOCK].sum()) for i in range(0, errors.size, BLOCK)) / errors.size


def stats_of_sums(
    pixels: int, absolute: list[float], squares: list[float], errors: Callable[[], NDArray[np.float64]]
) -> ErrorStats:
    """Statistics from the sums of the blocks; ``errors`` gives the errors (n,), needed where the squares underflow.

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
