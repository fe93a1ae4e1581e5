"""Scores of a probe: squared error, explained share of the variance, and their intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from fpp_ml_bench.evaluation.score import Interval, object_interval


@dataclass(frozen=True)
class Score:
    """``mse``: mean over samples and seeds. ``mse_of_mean``: error of predicting the training samples' mean everywhere.

    ``r2`` = 1 - mse / mse_of_mean: 1 is perfect, 0 is no better than the mean. Intervals: 95%, resampled over objects;
    that of r2, a ratio of two means, to first order. ``seeds``: r2 of each seed.
    """

    mse: float
    mse_interval: Interval | None
    r2: float
    r2_interval: Interval | None
    seeds: tuple[float, ...]
    mse_of_mean: float

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def score(errors: Sequence[Sequence[float]], reference: Sequence[float], objects: Sequence[str]) -> Score:
    """`Score` of ``errors`` (seeds, samples), squared, against those of the mean, ``reference`` (samples,).

    Raises ``ValueError`` where the reference error is 0, so for a constant target.
    """
    table = np.asarray(errors, dtype=np.float64)
    mean_error = float(np.mean(reference))
    if not mean_error > 0:
        raise ValueError("the target is constant, so there is nothing to explain")
    sample_means = table.mean(axis=0)
    mse = float(sample_means.mean())
    r2 = 1 - mse / mean_error
    # To first order, r2 of a resample differs by -mean(sample_means - (1 - r2) reference) / mean_error. Large objects
    # have large errors in both terms, which cancels.
    deviation = object_interval(((sample_means - (1 - r2) * np.asarray(reference)) / mean_error).tolist(), objects)
    r2_interval = None if deviation is None else (r2 - deviation[1], r2 - deviation[0])
    interval = object_interval(sample_means.tolist(), objects)
    return Score(mse, interval, r2, r2_interval, tuple((1 - table.mean(axis=1) / mean_error).tolist()), mean_error)


TRAINED, UNTRAINED, CONTROLS = "trained", "untrained", "controls"
Layers = Mapping[str, Mapping[str, Score]]
"""Scores by layer, then target."""
Scores = dict[str, dict[str, dict[str, Score]]]
"""Scores by `TRAINED`, `UNTRAINED` or `CONTROLS`, then layer, then target."""


def ratio(layer: Mapping[str, Score]) -> float:
    """The paper's ratio: MSE of the depth probe over that of the edge probe."""
    return layer["depth"].mse / layer["edges"].mse


def mean_ratio(layers: Layers) -> float:
    """The paper's average: mean MSE of depth over mean MSE of edges."""
    return float(
        np.mean([layer["depth"].mse for layer in layers.values()])
        / np.mean([layer["edges"].mse for layer in layers.values()])
    )


def ratio_of_means(layer: Mapping[str, Score]) -> float:
    """The paper's ratio for a probe that predicts the means, so the ratio of the targets' variances."""
    return layer["depth"].mse_of_mean / layer["edges"].mse_of_mean
