"""Scores of one sample: MAE and RMSE over the pixel sets, how the object's error is distributed,
and what a stated uncertainty is worth.

The overall score is composed of object and background, so that overall MAE = f object + (1 - f)
background, with f the object's share of the pixels, holds by construction.

Numerical contract: differences are formed in float64 whatever the input; every sum is float64 over
blocks of `BLOCK` pixels that fit into the cache, and the block sums are added exactly
(`math.fsum`). Errors above 1e140 are refused. Errors so small that their squares underflow are
divided by the largest before they are squared, so that an RMSE is never 0 by underflow.

Of a stated uncertainty: how often its intervals hold, how narrow they are, and whether the pixels
that a method is least sure of are those that are most wrong (sparsification: Ilg et al., ECCV
2018). Intervals are central ones of a Gaussian: error within quantile x sigma. The area between two
curves is accurate to 1e-12 of the error that it compares.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.depth import edge_jump_mm, object_box, object_mask, object_near_edges
from fpp_ml_bench.depth_readings import Glance
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation import protocol
from fpp_ml_bench.evaluation.metrics import METRICS, UNCERTAINTY
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX, WIDE_BAND_PX

BLOCK = 9600
"""Pixels per block. OpenBLAS spreads dot products over its threads from 10,000 elements on, and the
rounding of the sum would then depend on the number of cores. Below that a score depends on the type
of processor only."""

_BLOCKS_AT_ONCE = 8
_HALF_LOG_2_PI = 0.9189385332046727
_SQUARES_LOST = 1e-280
"""Mean square below which squares may have lost digits: the smallest normal number is 2e-308, and
an image has about a million pixels."""
NOT_FINITE = "the errors are not finite, or too large to square (above about 1e140)"

Map = NDArray[np.floating]
Errors = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ErrorStats:
    """Mean absolute and root mean square error in mm over ``pixels`` pixels; both None for an empty
    set, never 0."""

    pixels: int
    mae_mm: float | None
    rmse_mm: float | None


EMPTY = ErrorStats(0, None, None)


def combine(*parts: ErrorStats) -> ErrorStats:
    """Statistics of the union of disjoint pixel sets, without overflow or underflow; exact for one
    non-empty part."""
    filled = [
        (s.pixels, s.mae_mm, s.rmse_mm)
        for s in parts
        if s.mae_mm is not None and s.rmse_mm is not None
    ]
    if not filled:
        return EMPTY
    total = sum(n for n, _, _ in filled)
    if len(filled) == 1:
        return ErrorStats(total, filled[0][1], filled[0][2])
    mae = math.fsum(n * mae for n, mae, _ in filled) / total
    largest = max(rmse for _, _, rmse in filled)
    squares = math.fsum(n * (rmse / largest) ** 2 for n, _, rmse in filled) if largest else 0.0
    return ErrorStats(total, mae, largest * math.sqrt(squares / total))


def stats_of(errors: Errors) -> ErrorStats:
    """Statistics of float64 errors (n,), in blocks."""
    blocks = [errors[start : start + BLOCK] for start in range(0, errors.size, BLOCK)]
    squares = [float(block.dot(block)) for block in blocks]
    absolute = [float(np.abs(block).sum()) for block in blocks]
    return _from_sums(errors.size, absolute, squares, lambda: errors)


def mean_of(errors: Errors) -> float | None:
    """Mean of float64 values (n,) of either sign, in the same blocks; None for no values."""
    if errors.size == 0:
        return None
    return (
        math.fsum(float(errors[i : i + BLOCK].sum()) for i in range(0, errors.size, BLOCK))
        / errors.size
    )


def _from_sums(
    pixels: int, absolute: list[float], squares: list[float], errors: Callable[[], Errors]
) -> ErrorStats:
    """Statistics from the sums of the blocks; ``errors`` gives the errors (n,), needed where the
    squares underflow. Raises PredictionError where a sum is not finite."""
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


def _background(
    prediction: Map, target: Map, void: NDArray[np.bool_] | None
) -> tuple[ErrorStats, int, NDArray[np.bool_]]:
    """Statistics of every pixel that is neither object nor void, by setting the errors of those to
    0, how many of them are predicted above 0, and the mask of the object; all (n,). Not overall
    minus object: that would leave rounding errors where the background is perfect. Everything is
    done block by block, while the block is in the cache."""
    inside = np.empty(target.shape, dtype=bool)
    buffer = np.zeros((_BLOCKS_AT_ONCE, BLOCK))
    flat, step = buffer.reshape(-1), buffer.size
    pixels = invented = 0
    absolute: list[float] = []
    squares: list[float] = []
    for start in range(0, target.size, step):
        part = slice(start, start + step)
        excluded = inside[part] = object_mask(target[part])
        if void is not None:
            excluded = excluded | void[part]
        errors = flat[: excluded.size]
        np.copyto(errors, prediction[part])
        # A target without negative values is exactly 0 on the background: there the prediction is
        # the error.
        if not target[part].min() >= 0:
            errors -= target[part]
        scored = excluded.size - int(np.count_nonzero(excluded))
        invented += int(np.count_nonzero((prediction[part] > 0) & ~excluded))
        if scored < excluded.size:
            np.copyto(errors, 0.0, where=excluded)
        pixels += scored
        flat[errors.size :] = 0.0
        squares += [float(block.dot(block)) for block in buffer]
        np.abs(buffer, out=buffer)
        absolute += buffer.sum(axis=1).tolist()

    def errors_outside() -> Errors:
        outside = ~inside if void is None else ~(inside | void)
        return prediction[outside].astype(np.float64) - target[outside]

    return _from_sums(pixels, absolute, squares, errors_outside), invented, inside


_EDGE, _WIDE, _MISSING = 1, 2, 4


def _zones(bits: int, value: int) -> cached_property[ErrorStats]:
    """The statistics of the union of all zones whose ``bits`` have this ``value``."""
    return cached_property(
        lambda self: combine(*(stats for zone, stats in self.zones.items() if zone & bits == value))
    )


@dataclass(frozen=True)
class SampleScores:
    """What the metrics of a sample are made of. ``prediction_mm`` and ``target_mm`` (H, W) as they
    were scored, ``surface``: where the target has a depth, ``void_mask``: which pixels are in no
    set, None by rules without void; and ``errors``: prediction minus target in mm on the object's
    pixels, float64 (n,), of which those in ``predicted`` (bool (n,)) were measured.

    Statistics of the background and of the object's zones. A zone's number is a sum of 1 (nearer to
    a depth edge than the edge band), 2 (nearer than the wide band) and 4 (not measured: predicted 0
    mm or less); every MAE and RMSE of the object is that of a union of zones. ``unlit``: statistics
    of the unlit pixels, ``unlit_valid`` of those that were measured; ``scores_unlit``: whether the
    rules know them. ``range_mm``: largest minus smallest depth of the object. ``invented``: how
    many background pixels are predicted above 0; ``charge_mm``: what one of them and a pixel that
    was not measured costs in `two_sided_mm`, None by rules without it; ``void_surface`` and
    ``void_surface_valid``: statistics of void pixels whose target has a depth, and of those of them
    that were measured."""

    prediction_mm: Map
    target_mm: Map
    surface: NDArray[np.bool_]
    void_mask: NDArray[np.bool_] | None
    background: ErrorStats
    unlit: ErrorStats
    unlit_valid: ErrorStats
    scores_unlit: bool
    errors: Errors
    predicted: NDArray[np.bool_]
    zones: dict[int, ErrorStats]
    range_mm: float
    invented: int = 0
    charge_mm: float | None = None
    void_surface: ErrorStats = EMPTY
    void_surface_valid: ErrorStats = EMPTY

    object = _zones(0, 0)
    interior, edge = _zones(_EDGE, 0), _zones(_EDGE, _EDGE)
    wide_interior, wide_band = _zones(_WIDE, 0), _zones(_WIDE, _WIDE)
    valid = _zones(_MISSING, 0)
    interior_valid = _zones(_EDGE | _MISSING, 0)

    @cached_property
    def inside(self) -> NDArray[np.bool_]:
        """The object's pixels, (H, W)."""
        return self.surface if self.void_mask is None else self.surface & ~self.void_mask

    @cached_property
    def void(self) -> int | None:
        """How many pixels are in no set."""
        return None if self.void_mask is None else int(np.count_nonzero(self.void_mask))

    @property
    def missing(self) -> int:
        """Object pixels that were not measured."""
        return int(self.object.pixels - self.valid.pixels)

    @cached_property
    def overall(self) -> ErrorStats:
        return combine(self.object, self.background)

    @property
    def invented_share(self) -> float | None:
        """Background pixels predicted above 0 over the object's pixels; None by rules without a
        charge."""
        return (
            None
            if self.charge_mm is None or not self.object.pixels
            else self.invented / self.object.pixels
        )

    def two_sided_mm(self, with_void: bool = False) -> float | None:
        """Errors of the measured pixels of the object, and the charge for each that was not
        measured and for each invented one, over the object's pixels; ``with_void``: void surface
        belongs to the object."""
        whole, valid = self.object, self.valid
        if with_void:
            whole, valid = (
                combine(whole, self.void_surface),
                combine(valid, self.void_surface_valid),
            )
        if self.charge_mm is None or not whole.pixels:
            return None
        charged = whole.pixels - valid.pixels + self.invented
        return (
            math.fsum(((valid.mae_mm or 0.0) * valid.pixels, self.charge_mm * charged))
            / whole.pixels
        )

    @cached_property
    def magnitudes(self) -> Errors:
        """The object's absolute errors in mm, ascending."""
        return np.sort(np.abs(self.errors))

    def quantile(self, level: float) -> float | None:
        """A quantile of the object's absolute errors in mm, by linear interpolation."""
        return _quantile(self.magnitudes, level)

    def within(self, limit_mm: float) -> float | None:
        """Share of the object whose absolute error is at most ``limit_mm``."""
        count = self.errors.size
        return (
            float(np.searchsorted(self.magnitudes, limit_mm, side="right")) / count
            if count
            else None
        )

    @property
    def bias_mm(self) -> float | None:
        return mean_of(self.errors)

    @property
    def valid_bias_mm(self) -> float | None:
        """That of the measured pixels."""
        return mean_of(self.errors[self.predicted])

    @property
    def shift_free_mae_mm(self) -> float | None:
        """MAE of the object once the median of its errors is subtracted."""
        offset = _quantile(np.sort(self.errors), 0.5)
        return None if offset is None else mean_of(np.abs(self.errors - offset))

    def metrics(self) -> dict[str, float | None]:
        """Every metric by its key: None where the pixel set is empty, and those that a file may
        leave out left out."""
        values = {key: metric.value(self) for key, metric in METRICS.items()}
        return {
            key: value
            for key, value in values.items()
            if value is not None or not METRICS[key].optional
        }

    def pixels(self) -> dict[str, int | None]:
        """How many pixels each set of a result's row has; None for a set that the rules do not
        know."""
        unlit = self.unlit.pixels if self.scores_unlit else None
        counts = {
            "object": self.object.pixels,
            "background": self.background.pixels,
            "void": self.void,
            "unlit": unlit,
        }
        return {f"{name}_pixels": count for name, count in counts.items()}


@np.errstate(over="ignore")  # an overflow is no warning here: `_from_sums` refuses it
def score_sample(
    prediction_mm: Map,
    target_mm: Map,
    edge_band_px: int = EDGE_BAND_PX,
    void: NDArray[np.bool_] | None = None,
    unlit_mm: Map | None = None,
    charge_mm: float | None = None,
) -> SampleScores:
    """Score one depth map against its target.

    ``prediction_mm`` (H, W) float16, float32 or float64 in mm; ``target_mm`` (H, W) float in mm, 0
    = background. Pixel sets after paper Section 5.3.2 (`fpp_ml_bench.depth`): object where the
    target is above 0, else background. Pixels in ``void`` (bool (H, W)) are in neither; they still
    take part in finding the depth edges. ``unlit_mm`` (H, W): true depth in mm of the pixels that
    are scored as a set of their own, 0 elsewhere. ``charge_mm``: what a pixel costs that is missing
    or invented; without it the two-sided scores are None.

    Raises PredictionError for shapes that differ, dtypes that are not real floats, errors that are
    not finite, and a charge that is none.

    >>> import numpy as np
    >>> target = np.array([[0.0, 1800.0]])
    >>> score_sample(target + 2.0, target).overall
    ErrorStats(pixels=2, mae_mm=2.0, rmse_mm=2.0)
    """
    if prediction_mm.shape != target_mm.shape or target_mm.ndim != 2 or target_mm.size == 0:
        expected = f"expected a prediction of the target's shape {target_mm.shape} (H, W)"
        raise PredictionError(f"{expected}, got {prediction_mm.shape}")
    if prediction_mm.dtype.kind != "f" or target_mm.dtype.kind != "f":
        raise PredictionError(
            f"expected real floats, got {prediction_mm.dtype} against {target_mm.dtype}"
        )
    if charge_mm is not None and not 0 < charge_mm <= protocol.LARGEST_MM:
        raise PredictionError(
            f"charge_mm: expected mm above 0, half of the rig's working range; got {charge_mm}"
        )
    for name, part in (("void", void), ("unlit_mm", unlit_mm)):
        if part is not None and part.shape != target_mm.shape:
            raise PredictionError(f"{name}: expected a map of {target_mm.shape}, got {part.shape}")
    prediction = prediction_mm.ravel()
    flat_void = None if void is None else void.ravel()
    background, invented, flat_inside = _background(prediction, target_mm.ravel(), flat_void)
    unlit, measured = (
        (EMPTY, EMPTY) if unlit_mm is None else _surface_stats(prediction, unlit_mm.ravel())
    )
    void_surface = EMPTY, EMPTY
    if charge_mm is not None and flat_void is not None:
        void_surface = _surface_stats(prediction, np.where(flat_void, target_mm.ravel(), 0))
    inside = flat_inside.reshape(target_mm.shape)
    box = object_box(inside) or np.s_[:0, :0]
    index = np.flatnonzero(inside[box] if void is None else inside[box] & ~void[box])
    depths = prediction_mm[box].ravel().take(index)
    true_mm = target_mm[box].ravel().take(index)
    errors = _errors(depths, true_mm)
    predicted = depths > 0
    near, wide = object_near_edges(
        target_mm[box], (edge_band_px, WIDE_BAND_PX), edge_jump_mm(target_mm.shape[1])
    )
    zone = near.ravel().take(index).view(np.uint8) * np.uint8(_EDGE)
    zone |= wide.ravel().take(index).view(np.uint8) * np.uint8(_WIDE)
    zone |= (~predicted).view(np.uint8) * np.uint8(_MISSING)
    within = {code: zone == code for code in range(_EDGE + _WIDE + _MISSING + 1)}
    range_mm = float(true_mm.max()) - float(true_mm.min()) if true_mm.size else 0.0
    return SampleScores(
        prediction_mm,
        target_mm,
        inside,
        void,
        background,
        unlit,
        measured,
        unlit_mm is not None,
        errors,
        predicted,
        {code: stats_of(errors[pixels]) for code, pixels in within.items() if pixels.any()},
        range_mm
        if range_mm > 1e-150
        else 0.0,  # else an error may exceed it by more than a float64 can hold
        invented,
        charge_mm,
        *void_surface,
    )


def _errors(depths: Map, true_mm: Map) -> Errors:
    """Errors of ``depths`` (n,) in float64. Raises PredictionError where they are not finite."""
    errors = depths.astype(np.float64)
    errors -= true_mm
    if not np.isfinite(errors).all():
        raise PredictionError(NOT_FINITE)
    return errors


def _surface_stats(prediction: Map, surface_mm: Map) -> tuple[ErrorStats, ErrorStats]:
    """Statistics of the errors (n,) where ``surface_mm`` is above 0, and of those of them that were
    measured."""
    index = np.flatnonzero(object_mask(surface_mm))
    depths = prediction.take(index)
    errors = _errors(depths, surface_mm.take(index))
    return stats_of(errors), stats_of(errors[depths > 0])


def _quantile(ascending: Errors, level: float) -> float | None:
    """A quantile of ascending values (n,) by linear interpolation, NumPy's default; None for no
    values."""
    if not ascending.size:
        return None
    below, part = divmod(level * (ascending.size - 1), 1.0)
    low, high = ascending[int(below)], ascending[min(int(below) + 1, ascending.size - 1)]
    return float(low + (high - low) * part)


@dataclass(frozen=True, slots=True)
class SigmaSample:
    """Of one sample, what its scores are made of: the share of object pixels that state no sigma;
    of the others mean and median sigma in mm, and the mean negative log-likelihood; ``observed``:
    the share of stated pixels within the interval of each of `protocol.NOMINAL`; ``curves``: the
    errors in mm after each of `protocol.LEFT_OUT` has been left out, ``mae_mm`` and ``rmse_mm`` by
    sigma, ``best_*`` by the error itself. None where there is no such pixel."""

    curves: dict[str, list[float]] | None = None
    unstated_share: float | None = None
    observed: list[float] | None = None
    sigma_mean_mm: float | None = None
    sigma_median_mm: float | None = None
    nll: float | None = None

    @property
    def scores(self) -> dict[str, float | None]:
        """Every metric of a stated uncertainty by its key."""
        return {key: metric.value(self) for key, metric in UNCERTAINTY.items()}

    def within(self, percent: int) -> float | None:
        """Share of the stated pixels within the interval of one of `protocol.COVERED`."""
        return (
            None if self.observed is None else self.observed[protocol.NOMINAL.index(percent / 100)]
        )

    def sure_mm(self, error: str) -> float | None:
        """``mae_mm`` or ``rmse_mm`` of the object without its least sure pixels."""
        return (
            None
            if self.curves is None
            else self.curves[error][protocol.LEFT_OUT.index(protocol.SURE_LEFT_OUT)]
        )

    def area_mm(self, error: str) -> float | None:
        """Mean distance of the two curves of ``mae_mm`` or ``rmse_mm``. Never below 0 but by
        rounding: no order leaves smaller errors than that of the errors themselves."""
        if self.curves is None:
            return None
        return mean_of(
            np.maximum(np.array(self.curves[error]) - np.array(self.curves[f"best_{error}"]), 0.0)
        )


@dataclass(frozen=True)
class Scored:
    """A scored sample of an object: its ``row`` (the other keys of `SampleResult`), the scores of
    its stated uncertainty, None without, the hashes of what it was scored against by column, and of
    some samples a glance."""

    name: str
    object: str
    row: dict[str, Any]
    stated: SigmaSample | None
    hashes: dict[str, str]
    seen: Glance | None = None


@cache
def gaussian_quantile(coverage: float) -> float:
    """Half the width, in sigmas, of the central interval of a Gaussian that holds ``coverage`` of
    it."""
    return NormalDist().inv_cdf((1 + coverage) / 2)


def states_sigma(depth_mm: Map, sigma_mm: Map) -> NDArray[np.bool_]:
    """Pixels that state an uncertainty: they have an answer, and a sigma above 0 (both of any same
    shape, in mm)."""
    return (depth_mm > 0) & (sigma_mm > 0)


def score_sigma(
    prediction_mm: Map,
    target_mm: Map,
    sigma_mm: Map,
    void: NDArray[np.bool_] | None = None,
    charge_mm: float | None = None,
) -> SigmaSample:
    """Score the stated standard uncertainty ``sigma_mm`` of ``prediction_mm`` over the object
    pixels of ``target_mm`` that are not ``void``; all (H, W), in mm, sigma of 0 and more. With
    ``charge_mm`` that is the error of a pixel without an answer, and the invented pixels of the
    background, whose error it is too, are left out or kept with the object's."""
    surface = object_mask(target_mm)
    inside = surface if void is None else surface & ~void
    depth, sigma = (np.asarray(values[inside], np.float64) for values in (prediction_mm, sigma_mm))
    magnitude = np.abs(depth - target_mm[inside])
    if not magnitude.size:
        return SigmaSample()
    stated = states_sigma(depth, sigma)
    charged, unsure = magnitude, np.where(stated, sigma, np.inf)
    if charge_mm is not None:
        outside = ~surface & (prediction_mm > 0)
        invented = sigma_mm[outside if void is None else outside & ~void].astype(np.float64)
        charged = np.append(
            np.where(depth > 0, magnitude, charge_mm), np.full(invented.size, charge_mm)
        )
        unsure = np.append(unsure, np.where(invented > 0, invented, np.inf))
    curves = _curves(charged, unsure, magnitude.size)
    unstated = 1 - np.count_nonzero(stated) / stated.size
    if not stated.any():
        return SigmaSample(curves, unstated)
    magnitude, sigma = magnitude[stated], sigma[stated]
    observed = [
        float(np.mean(magnitude <= gaussian_quantile(level) * sigma)) for level in protocol.NOMINAL
    ]
    likelihood = mean_of(_negative_log_likelihood(magnitude, sigma))
    return SigmaSample(
        curves, unstated, observed, mean_of(sigma), float(np.median(sigma)), likelihood
    )


def _negative_log_likelihood(magnitude: Errors, sigma: Errors) -> Errors:
    """Of each error under a Gaussian, in nats with sigma in mm. Sigma is at least
    `NLL_LEAST_SIGMA_MM`, and the error at most `NLL_LARGEST_RATIO` sigmas, so that neither an error
    of 0 nor a wrong order decides the mean."""
    floored = np.maximum(sigma, protocol.NLL_LEAST_SIGMA_MM)
    ratio = np.minimum(magnitude / floored, protocol.NLL_LARGEST_RATIO)
    return np.log(floored) + _HALF_LOG_2_PI + 0.5 * ratio * ratio


def _curves(magnitude: Errors, sigma: Errors, pixels: int) -> dict[str, list[float]]:
    """The curves of `SigmaSample` of an object of so many ``pixels``, behind whose errors those of
    invented pixels may stand: left out are shares of the object's pixels, and means are over its
    others. Of pixels of the same sigma an equal part of each is left out, so that the order of the
    pixels does not matter; a pixel at the cut counts in part."""
    over = pixels * (1 - np.array(protocol.LEFT_OUT))
    kept = over + (magnitude.size - pixels)
    curves = {}
    for prefix, key in (("", sigma), ("best_", magnitude)):
        order = np.argsort(key, kind="stable")
        ascending = key[order]
        last = np.flatnonzero(
            np.append(ascending[1:] != ascending[:-1], True)
        )  # of each run of equal keys
        for name, values in (("mae_mm", magnitude[order]), ("rmse_mm", magnitude[order] ** 2)):
            sums = np.concatenate([[0.0], np.cumsum(values)[last]])
            means = np.interp(kept, np.concatenate([[0], last + 1]), sums) / over
            curves[prefix + name] = (np.sqrt(means) if name == "rmse_mm" else means).tolist()
    whole, more = stats_of(magnitude), magnitude.size / pixels
    for prefix in ("", "best_"):  # nothing left out: MAE and RMSE to the last digit
        curves[f"{prefix}mae_mm"][0] = more * (whole.mae_mm or 0.0)
        curves[f"{prefix}rmse_mm"][0] = math.sqrt(more) * (whole.rmse_mm or 0.0)
    return curves
