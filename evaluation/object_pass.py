"""The first pass over a sample: the errors of the object's pixels, and the error statistics of the background."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation import error_stats
from fpp_ml_bench.evaluation.error_stats import EMPTY, NOT_FINITE, ErrorStats, stats_of_sums
from fpp_ml_bench.pixel_sets import object_mask

_BLOCKS_AT_ONCE = 8


class ObjectErrors(NamedTuple):
    """The object's n pixels: flat indices (n,), errors in mm float64 (n,), which were not measured (n,); and the
    error statistics of all other pixels."""

    pixels: NDArray[np.intp]
    errors: NDArray[np.float64]
    missing: NDArray[np.bool_]
    background: ErrorStats


@np.errstate(over="ignore")  # an overflow is no warning here: `stats_of_sums` refuses it
def object_errors(prediction_mm: NDArray[np.floating[Any]], target_mm: NDArray[np.floating[Any]]) -> ObjectErrors:
    """Split a sample into its object and its background (paper Section 5.3.2).

    ``prediction_mm`` and ``target_mm`` (H, W) real floats in mm. Raises PredictionError for shapes that differ, dtypes
    that are not real floats, and errors that are not finite.
    """
    prediction, target = _flat(prediction_mm, target_mm)
    index = np.flatnonzero(object_mask(target))
    depths = prediction.take(index)
    errors = depths.astype(np.float64)
    errors -= target.take(index)
    if not np.isfinite(errors).all():
        raise PredictionError(NOT_FINITE)
    return ObjectErrors(index, errors, depths <= 0, _background_stats(prediction, target, index))


def _flat(
    prediction_mm: NDArray[np.floating[Any]], target_mm: NDArray[np.floating[Any]]
) -> tuple[NDArray[np.floating[Any]], NDArray[np.floating[Any]]]:
    if prediction_mm.shape != target_mm.shape or target_mm.ndim != 2 or target_mm.size == 0:
        raise PredictionError(
            f"expected a prediction of the target's shape {target_mm.shape} (H, W), got {prediction_mm.shape}"
        )
    if prediction_mm.dtype.kind != "f" or target_mm.dtype.kind != "f":
        raise PredictionError(f"expected real floats, got {prediction_mm.dtype} against {target_mm.dtype}")
    return prediction_mm.ravel(), target_mm.ravel()


def _background(prediction: NDArray[np.floating[Any]], target: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    outside = ~object_mask(target)
    return prediction[outside].astype(np.float64) - target[outside]


def _background_stats(
    prediction: NDArray[np.floating[Any]], target: NDArray[np.floating[Any]], index: NDArray[np.intp]
) -> ErrorStats:
    """Statistics of every pixel but the object's at ``index`` (sorted), by setting the object's errors to 0.

    Not overall minus object: that would leave rounding errors where the background is perfect.
    """
    pixels = prediction.size - index.size
    if pixels == 0:
        return EMPTY
    # A target without negative values is exactly 0 on the background: there the prediction is the error.
    target_is_zero = bool(target.min() >= 0)
    signed = not (target_is_zero and bool(prediction.min() >= 0))
    buffer = np.zeros((_BLOCKS_AT_ONCE, error_stats.BLOCK))
    flat, step = buffer.reshape(-1), buffer.size
    absolute: list[float] = []
    squares: list[float] = []
    starts = range(0, prediction.size, step)
    cuts = [*np.searchsorted(index, list(starts)).tolist(), index.size]
    for number, start in enumerate(starts):
        errors = flat[: min(step, prediction.size - start)]
        np.copyto(errors, prediction[start : start + step])
        if not target_is_zero:
            errors -= target[start : start + step]
        errors[index[cuts[number] : cuts[number + 1]] - start] = 0.0
        flat[errors.size :] = 0.0
        squares += [float(block.dot(block)) for block in buffer]
        if signed:
            np.abs(buffer, out=buffer)
        absolute += buffer.sum(axis=1).tolist()
    return stats_of_sums(pixels, absolute, squares, lambda: _background(prediction, target))
