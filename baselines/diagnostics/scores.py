"""How well a probe did: squared error, share of the variance it explains, and how sure that is."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from fpp_ml_bench.evaluation.uncertainty import Interval, object_interval


@dataclass(frozen=True)
class Score:
    """``mse``: mean over samples and seeds. ``r2``: 1 - mse / that of predicting the training samples' mean everywhere;
    1 is perfect, 0 no better than that mean. Intervals: 95%, resampled over objects; that of r2, a ratio of two means,
    to first order. ``seeds``: r2 of each seed. ``mse_of_mean``: the error of that mean."""

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

    Raises ``ValueError`` where the reference error is 0: a target that is constant can't be explained.
    """
    table = np.asarray(errors, dtype=np.float64)
    known = float(np.mean(reference))
    if not known > 0:
        raise ValueError("the target is the same everywhere, so there is nothing to explain")
    each = table.mean(axis=0)
    mse = float(each.mean())
    r2 = 1 - mse / known
    # Of a resample, r2 differs from this by -mean(each - (1 - r2) reference) / known, to first order: large objects
    # have large errors either way, and that cancels.
    swing = object_interval(((each - (1 - r2) * np.asarray(reference)) / known).tolist(), objects)
    span = None if swing is None else (r2 - swing[1], r2 - swing[0])
    interval = object_interval(each.tolist(), objects)
    return Score(mse, interval, r2, span, tuple((1 - table.mean(axis=1) / known).tolist()), known)


TRAINED, UNTRAINED, CONTROLS = "trained", "untrained", "controls"
Layers = Mapping[str, Mapping[str, Score]]
"""Scores by layer, then target."""
Scores = dict[str, dict[str, dict[str, Score]]]
"""Scores by `TRAINED`, `UNTRAINED` or `CONTROLS`, then layer, then target."""


def ratio(layer: Mapping[str, Score]) -> float:
    """The paper's: MSE of the depth probe over that of the edge probe."""
    return layer["depth"].mse / layer["edges"].mse


def mean_ratio(layers: Layers) -> float:
    """The paper's average: mean MSE of depth over mean MSE of edges."""
    return float(
        np.mean([layer["depth"].mse for layer in layers.values()])
        / np.mean([layer["edges"].mse for layer in layers.values()])
    )


def ratio_of_means(layer: Mapping[str, Score]) -> float:
    """The paper's ratio of a probe that has learned nothing and predicts the means: of variances, not of knowledge."""
    return layer["depth"].mse_of_mean / layer["edges"].mse_of_mean
