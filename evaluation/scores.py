"""Scores of one sample: MAE and RMSE over the three pixel sets, in float64, in one pass over the image.

Numerical contract: differences are formed in float64 whatever the input; every sum is float64 over blocks of
`BLOCK` pixels that stay in the cache, the block sums added exactly (`math.fsum`). Error magnitudes from 1e-140 to 1e140
neither overflow nor underflow. The overall score is composed of object and background, so that
overall MAE = f object + (1 - f) background, with f the object's share of the pixels, holds by construction.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX
from fpp_ml_bench.pixel_sets import object_mask, object_near_edge

BLOCK = 9600
"""Pixels a block. OpenBLAS spreads dot products over its threads from 10,000 elements on, and the rounding of the sum
would then depend on the number of cores; below that a score is the same on every machine of one kind."""

_NOT_FINITE = "the errors are not finite, or too large to square (above about 1e140)"


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
    mae = math.fsum(n / total * mae for n, mae, _ in filled)
    rmse = math.hypot(*(math.sqrt(n / total) * rmse for n, _, rmse in filled))
    return ErrorStats(total, mae, rmse)


@dataclass(frozen=True, slots=True)
class SampleScores:
    """Scores of one sample; ``object`` is ``interior`` and ``edge`` together.

    ``interior_valid`` and ``edge_valid`` are those pixels of the two that were measured (predicted above 0 mm).
    """

    object: ErrorStats
    background: ErrorStats
    interior: ErrorStats
    edge: ErrorStats
    interior_valid: ErrorStats
    edge_valid: ErrorStats

    @property
    def valid(self) -> ErrorStats:
        return combine(self.interior_valid, self.edge_valid)

    @property
    def missing(self) -> int:
        """Object pixels that were not measured."""
        return self.object.pixels - self.valid.pixels

    @property
    def overall(self) -> ErrorStats:
        return combine(self.object, self.background)

    def metrics(self) -> dict[str, float | None]:
        """The keys of ``protocol.METRICS``; None where the sample has no pixel to say anything about."""
        overall, valid, inside, pixels = self.overall, self.valid, self.interior, self.object.pixels
        return {
            "overall_mae_mm": overall.mae_mm,
            "overall_rmse_mm": overall.rmse_mm,
            "object_mae_mm": self.object.mae_mm,
            "object_rmse_mm": self.object.rmse_mm,
            "background_mae_mm": self.background.mae_mm,
            "background_rmse_mm": self.background.rmse_mm,
            "object_interior_mae_mm": self.interior.mae_mm,
            "object_interior_rmse_mm": self.interior.rmse_mm,
            "object_edge_mae_mm": self.edge.mae_mm,
            "object_edge_rmse_mm": self.edge.rmse_mm,
            "object_valid_mae_mm": valid.mae_mm,
            "object_interior_valid_mae_mm": self.interior_valid.mae_mm,
            "object_edge_share": _share(self.edge.pixels, pixels),
            "object_missing_share": _share(pixels - valid.pixels, pixels),
            "object_interior_missing_share": _share(inside.pixels - self.interior_valid.pixels, inside.pixels),
        }


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


@np.errstate(over="ignore")  # an overflow is no warning here: _finish refuses it
def score_sample(
    prediction_mm: NDArray[np.floating[Any]],
    target_mm: NDArray[np.floating[Any]],
    edge_band_px: int = EDGE_BAND_PX,
) -> SampleScores:
    """Score one depth map against its target.

    ``prediction_mm`` (H, W) float16, float32 or float64 in mm; ``target_mm`` (H, W) float in mm, 0 = background. Pixel
    sets after paper Section 5.3.2 (`fpp_ml_bench.pixel_sets`): object where the target is above 0, else background.

    Raises PredictionError for shapes that differ, dtypes that are not real floats, and errors that are not finite.

    >>> import numpy as np
    >>> target = np.array([[0.0, 1800.0]])
    >>> score_sample(target + 2.0, target).overall
    ErrorStats(pixels=2, mae_mm=2.0, rmse_mm=2.0)
    """
    if prediction_mm.shape != target_mm.shape or target_mm.ndim != 2 or target_mm.size == 0:
        raise PredictionError(
            f"expected a prediction of the target's shape {target_mm.shape} (H, W), got {prediction_mm.shape}"
        )
    if prediction_mm.dtype.kind != "f" or target_mm.dtype.kind != "f":
        raise PredictionError(f"expected real floats, got {prediction_mm.dtype} against {target_mm.dtype}")
    prediction, target = prediction_mm.ravel(), target_mm.ravel()
    index = np.flatnonzero(object_mask(target))
    measured = prediction.take(index)
    errors = measured.astype(np.float64)
    errors -= target.take(index)
    if not np.isfinite(errors).all():
        raise PredictionError(_NOT_FINITE)
    missing = measured <= 0
    near = object_near_edge(target_mm, edge_band_px).ravel().take(index)
    if missing.any():
        interior_valid, edge_valid = _stats(errors[~(near | missing)]), _stats(errors[near & ~missing])
        interior = combine(interior_valid, _stats(errors[missing & ~near]))
        edge = combine(edge_valid, _stats(errors[missing & near]))
    else:
        interior, edge = interior_valid, edge_valid = _stats(errors[~near]), _stats(errors[near])
    return SampleScores(
        object=combine(interior, edge),
        background=_background_stats(prediction, target, index),
        interior=interior,
        edge=edge,
        interior_valid=interior_valid,
        edge_valid=edge_valid,
    )


def _stats(errors: NDArray[np.float64]) -> ErrorStats:
    """Statistics of float64 errors (n,), in blocks; overwrites them by their magnitudes."""
    absolute, squares = [], []
    for start in range(0, errors.size, BLOCK):
        block = errors[start : start + BLOCK]
        squares.append(float(block.dot(block)))
        np.abs(block, out=block)
        absolute.append(float(block.sum()))
    return _finish(errors.size, absolute, squares)


def _background_stats(
    prediction: NDArray[np.floating[Any]], target: NDArray[np.floating[Any]], index: NDArray[np.intp]
) -> ErrorStats:
    """Statistics of every pixel but the object's at ``index`` (sorted), by setting the object's errors to 0.

    Not overall minus object: that would leave rounding dust where the background is perfect.
    """
    pixels = prediction.size - index.size
    if pixels == 0:
        return EMPTY
    # A target without negative values is exactly 0 on the background: there the prediction is the error.
    target_is_zero = bool(target.min() >= 0)
    signed = not (target_is_zero and bool(prediction.min() >= 0))
    buffer = np.empty(min(BLOCK, prediction.size))
    absolute, squares = [], []
    starts = range(0, prediction.size, BLOCK)
    cuts = [*np.searchsorted(index, list(starts)).tolist(), index.size]
    for number, start in enumerate(starts):
        block = buffer[: min(BLOCK, prediction.size - start)]
        np.copyto(block, prediction[start : start + BLOCK])
        if not target_is_zero:
            block -= target[start : start + BLOCK]
        block[index[cuts[number] : cuts[number + 1]] - start] = 0.0
        squares.append(float(block.dot(block)))
        if signed:
            np.abs(block, out=block)
        absolute.append(float(block.sum()))
    return _finish(pixels, absolute, squares)


def _finish(pixels: int, absolute: list[float], squares: list[float]) -> ErrorStats:
    if pixels == 0:
        return EMPTY
    try:
        mae, mean_square = math.fsum(absolute) / pixels, math.fsum(squares) / pixels
    except (OverflowError, ValueError):  # fsum of huge values, or of inf and -inf
        mae = mean_square = math.inf
    if not math.isfinite(mae) or not math.isfinite(mean_square):
        raise PredictionError(_NOT_FINITE)
    return ErrorStats(pixels, mae, math.sqrt(mean_square))
