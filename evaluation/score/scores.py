"""Scores of one sample: MAE and RMSE over the pixel sets, and how the object's error is distributed, in float64.

The overall score is composed of object and background, so that overall MAE = f object + (1 - f) background, with f the
object's share of the pixels, holds by construction. Accurate sums: `fpp_ml_bench.evaluation.error_stats`.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.depth import object_mask, object_near_edges
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX, WIDE_BAND_PX, WITHIN, WITHIN_MM
from fpp_ml_bench.evaluation.score import error_stats
from fpp_ml_bench.evaluation.score.error_stats import (
    EMPTY,
    NOT_FINITE,
    ErrorStats,
    combine,
    mean_of,
    stats_of,
    stats_of_sums,
)

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


_EDGE, _WIDE, _MISSING = 1, 2, 4


@dataclass(frozen=True, slots=True)
class Distribution:
    """The object's error in mm beyond its mean: order statistics of |e|, shares of pixels, signed means.

    All None for an empty object. ``shift_free_mae_mm`` is the MAE after the median of e has been subtracted.
    """

    median_mm: float | None = None
    p95_mm: float | None = None
    max_mm: float | None = None
    within: tuple[float | None, ...] = (None,) * len(WITHIN_MM)
    bias_mm: float | None = None
    valid_bias_mm: float | None = None
    shift_free_mae_mm: float | None = None


@dataclass(frozen=True, slots=True)
class SampleScores:
    """Scores of one sample: statistics of the background and of the object's zones.

    A zone's number is a sum of 1 (nearer to a depth edge than the edge band), 2 (nearer than the wide band) and 4 (not
    measured: predicted 0 mm or less); every score of the object is a union of zones.
    """

    background: ErrorStats
    zones: dict[int, ErrorStats]
    distribution: Distribution

    def _union(self, bits: int = 0, value: int = 0) -> ErrorStats:
        return combine(*(stats for zone, stats in self.zones.items() if zone & bits == value))

    @property
    def object(self) -> ErrorStats:
        return self._union()

    @property
    def interior(self) -> ErrorStats:
        return self._union(_EDGE, 0)

    @property
    def edge(self) -> ErrorStats:
        return self._union(_EDGE, _EDGE)

    @property
    def wide_interior(self) -> ErrorStats:
        return self._union(_WIDE, 0)

    @property
    def wide_band(self) -> ErrorStats:
        return self._union(_WIDE, _WIDE)

    @property
    def valid(self) -> ErrorStats:
        return self._union(_MISSING, 0)

    @property
    def interior_valid(self) -> ErrorStats:
        return self._union(_EDGE | _MISSING, 0)

    @property
    def edge_valid(self) -> ErrorStats:
        return self._union(_EDGE | _MISSING, _EDGE)

    @property
    def missing(self) -> int:
        """Object pixels that were not measured."""
        return self.object.pixels - self.valid.pixels

    @property
    def overall(self) -> ErrorStats:
        return combine(self.object, self.background)

    def metrics(self) -> dict[str, float | None]:
        """The keys of ``protocol.METRICS``; None where the pixel set is empty."""
        overall, whole, valid, inside = self.overall, self.object, self.valid, self.interior
        inside_valid, band, spread = self.interior_valid, self.wide_band, self.distribution
        return {
            "overall_mae_mm": overall.mae_mm,
            "overall_rmse_mm": overall.rmse_mm,
            "object_mae_mm": whole.mae_mm,
            "object_rmse_mm": whole.rmse_mm,
            "background_mae_mm": self.background.mae_mm,
            "background_rmse_mm": self.background.rmse_mm,
            "object_interior_mae_mm": inside.mae_mm,
            "object_interior_rmse_mm": inside.rmse_mm,
            "object_edge_mae_mm": self.edge.mae_mm,
            "object_edge_rmse_mm": self.edge.rmse_mm,
            "object_valid_mae_mm": valid.mae_mm,
            "object_interior_valid_mae_mm": inside_valid.mae_mm,
            "object_edge_share": _share(self.edge.pixels, whole.pixels),
            "object_missing_share": _share(whole.pixels - valid.pixels, whole.pixels),
            "object_interior_missing_share": _share(inside.pixels - inside_valid.pixels, inside.pixels),
            "object_median_mm": spread.median_mm,
            "object_p95_mm": spread.p95_mm,
            "object_max_mm": spread.max_mm,
            **dict(zip(WITHIN, spread.within, strict=True)),
            "object_bias_mm": spread.bias_mm,
            "object_valid_bias_mm": spread.valid_bias_mm,
            "object_shift_free_mae_mm": spread.shift_free_mae_mm,
            "object_wide_band_mae_mm": band.mae_mm,
            "object_wide_interior_mae_mm": self.wide_interior.mae_mm,
            "object_wide_band_share": _share(band.pixels, whole.pixels),
        }


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


@np.errstate(over="ignore")  # an overflow is no warning here: `error_stats` refuses it
def score_sample(
    prediction_mm: NDArray[np.floating[Any]],
    target_mm: NDArray[np.floating[Any]],
    edge_band_px: int = EDGE_BAND_PX,
) -> SampleScores:
    """Score one depth map against its target.

    ``prediction_mm`` (H, W) float16, float32 or float64 in mm; ``target_mm`` (H, W) float in mm, 0 = background. Pixel
    sets after paper Section 5.3.2 (`fpp_ml_bench.depth`): object where the target is above 0, else background.

    Raises PredictionError for shapes that differ, dtypes that are not real floats, and errors that are not finite.

    >>> import numpy as np
    >>> target = np.array([[0.0, 1800.0]])
    >>> score_sample(target + 2.0, target).overall
    ErrorStats(pixels=2, mae_mm=2.0, rmse_mm=2.0)
    """
    errors = object_errors(prediction_mm, target_mm)
    if not errors.pixels.size:
        return SampleScores(errors.background, {}, Distribution())
    near, wide = object_near_edges(target_mm, (edge_band_px, WIDE_BAND_PX))
    zone = near.ravel().take(errors.pixels).view(np.uint8) * np.uint8(_EDGE)
    zone |= wide.ravel().take(errors.pixels).view(np.uint8) * np.uint8(_WIDE)
    zone |= errors.missing.view(np.uint8) * np.uint8(_MISSING)
    present = np.flatnonzero(np.bincount(zone)).tolist()
    zones = {code: stats_of(errors.errors[zone == code]) for code in present}
    return SampleScores(errors.background, zones, _distribution(errors))


def _distribution(measured: ObjectErrors) -> Distribution:
    errors = measured.errors
    magnitude = np.abs(errors)
    within = tuple(np.count_nonzero(magnitude <= limit) / errors.size for limit in WITHIN_MM)
    largest = float(magnitude.max())
    median, p95 = _quantiles(magnitude, 0.5, 0.95)
    signed = errors.copy()
    offset = _quantiles(signed, 0.5)[0]
    np.subtract(errors, offset, out=signed)
    np.abs(signed, out=signed)
    return Distribution(
        median_mm=median,
        p95_mm=p95,
        max_mm=largest,
        within=within,
        bias_mm=mean_of(errors),
        valid_bias_mm=mean_of(errors[~measured.missing] if measured.missing.any() else errors),
        shift_free_mae_mm=mean_of(signed),
    )


def _quantiles(values: NDArray[np.float64], *levels: float) -> list[float]:
    """Ascending quantiles by linear interpolation (NumPy's default); reorders ``values``.

    One partition per quantile: NumPy's partition is vectorised for a single position, not for several.
    """
    quantiles, first = [], 0
    for level in levels:
        position = level * (values.size - 1)
        low = int(position)
        upper = values[first:]
        upper.partition(low - first)
        below = float(values[low])
        above = float(values[low + 1 :].min()) if low + 1 < values.size else below
        quantiles.append(below + (above - below) * (position - low))
        first = low
    return quantiles
