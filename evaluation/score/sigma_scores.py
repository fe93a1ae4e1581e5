"""What a stated uncertainty is worth: how often its intervals hold, how narrow they are, and whether the pixels that a
method is least sure of are those that are most wrong (sparsification: Ilg et al., ECCV 2018).

Intervals are central ones of a Gaussian: error within quantile x sigma. Sums are float64; the area between two curves
is accurate to 1e-12 of the error that it compares.
"""

from dataclasses import dataclass
from functools import cache
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation import protocol
from fpp_ml_bench.evaluation.metrics import UNCERTAINTY
from fpp_ml_bench.evaluation.score.sample_scores import mean_of, stats_of

Map = NDArray[np.floating[Any]]
Values = NDArray[np.float64]
_HALF_LOG_2_PI = 0.9189385332046727


@dataclass(frozen=True, slots=True)
class SigmaSample:
    """Of one sample, what its scores are made of: the share of object pixels that state no sigma; of the others mean
    and median sigma in mm, and the mean negative log-likelihood; ``observed``: the share of stated pixels within the
    interval of each of `protocol.NOMINAL`; ``curves``: the errors in mm after each of `protocol.LEFT_OUT` has been left
    out, ``mae_mm`` and ``rmse_mm`` by sigma, ``best_*`` by the error itself. None where there is no such pixel."""

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
        return self.observed and self.observed[protocol.NOMINAL.index(percent / 100)]

    def sure_mm(self, error: str) -> float | None:
        """``mae_mm`` or ``rmse_mm`` of the object without its least sure pixels."""
        return self.curves and self.curves[error][protocol.LEFT_OUT.index(protocol.SURE_LEFT_OUT)]

    def area_mm(self, error: str) -> float | None:
        """Mean distance of the two curves of ``mae_mm`` or ``rmse_mm``. Never below 0 but by rounding: no order leaves
        smaller errors than that of the errors themselves."""
        return self.curves and mean_of(
            np.maximum(np.array(self.curves[error]) - np.array(self.curves[f"best_{error}"]), 0.0)
        )


@cache
def gaussian_quantile(coverage: float) -> float:
    """Half the width, in sigmas, of the central interval of a Gaussian that holds ``coverage`` of it."""
    return NormalDist().inv_cdf((1 + coverage) / 2)


def states_sigma(depth_mm: Map, sigma_mm: Map) -> NDArray[np.bool_]:
    """Pixels that state an uncertainty: they have an answer, and a sigma above 0 (both of any same shape, in mm)."""
    return (depth_mm > 0) & (sigma_mm > 0)


def score_sigma(
    prediction_mm: Map, target_mm: Map, sigma_mm: Map, void: NDArray[np.bool_] | None = None
) -> SigmaSample:
    """Score the stated standard uncertainty ``sigma_mm`` of ``prediction_mm`` over the object pixels of ``target_mm``
    that are not ``void``; all (H, W), in mm, sigma of 0 and more. Raises PredictionError for another shape."""
    if not prediction_mm.shape == target_mm.shape == sigma_mm.shape:
        raise PredictionError(f"sigma: expected a map of {target_mm.shape}, got {sigma_mm.shape}")
    inside = object_mask(target_mm) if void is None else object_mask(target_mm) & ~void
    depth, sigma = (np.asarray(values[inside], np.float64) for values in (prediction_mm, sigma_mm))
    magnitude = np.abs(depth - target_mm[inside])
    if not magnitude.size:
        return SigmaSample()
    stated = states_sigma(depth, sigma)
    curves = _curves(magnitude, np.where(stated, sigma, np.inf))
    unstated = 1 - np.count_nonzero(stated) / stated.size
    if not stated.any():
        return SigmaSample(curves, unstated)
    magnitude, sigma = magnitude[stated], sigma[stated]
    observed = [float(np.mean(magnitude <= gaussian_quantile(level) * sigma)) for level in protocol.NOMINAL]
    likelihood = mean_of(_negative_log_likelihood(magnitude, sigma))
    return SigmaSample(curves, unstated, observed, mean_of(sigma), float(np.median(sigma)), likelihood)


def _negative_log_likelihood(magnitude: Values, sigma: Values) -> Values:
    """Of each error under a Gaussian, in nats with sigma in mm. Sigma is at least `NLL_LEAST_SIGMA_MM`, and the error
    at most `NLL_LARGEST_RATIO` sigmas, so that neither an error of 0 nor a wrong order decides the mean."""
    floored = np.maximum(sigma, protocol.NLL_LEAST_SIGMA_MM)
    ratio = np.minimum(magnitude / floored, protocol.NLL_LARGEST_RATIO)
    return np.log(floored) + _HALF_LOG_2_PI + 0.5 * ratio * ratio


def _curves(magnitude: Values, sigma: Values) -> dict[str, list[float]]:
    """The curves of `SigmaSample`. Of pixels of the same sigma an equal part of each is left out, so that the order of
    the pixels does not matter; a pixel at the cut counts in part."""
    kept = magnitude.size * (1 - np.array(protocol.LEFT_OUT))
    curves = {}
    for prefix, key in (("", sigma), ("best_", magnitude)):
        order = np.argsort(key, kind="stable")
        ascending = key[order]
        last = np.flatnonzero(np.append(ascending[1:] != ascending[:-1], True))  # of each run of equal keys
        for name, values in (("mae_mm", magnitude[order]), ("rmse_mm", magnitude[order] ** 2)):
            sums = np.concatenate([[0.0], np.cumsum(values)[last]])
            means = np.interp(kept, np.concatenate([[0], last + 1]), sums) / kept
            curves[prefix + name] = (np.sqrt(means) if name == "rmse_mm" else means).tolist()
    whole = stats_of(magnitude)
    for prefix in ("", "best_"):  # nothing left out: the object's MAE and RMSE, to the last digit
        curves[f"{prefix}mae_mm"][0], curves[f"{prefix}rmse_mm"][0] = whole.mae_mm or 0.0, whole.rmse_mm or 0.0
    return curves
