"""How well a probe did: squared error, share of the variance it explains, and how sure that is."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from fpp_ml_bench.evaluation.uncertainty import Interval, object_interval


@dataclass(frozen=True)
class Score:
    """``mse``: mean over samples and seeds. ``r2``: 1 - mse / that of predicting the training samples' mean everywhere;
    1 is perfect, 0 no better than that mean. Intervals: 95%, resampled over objects (the reference error is taken as
    known). ``seeds``: r2 of each seed."""

    mse: float
    mse_interval: Interval | None
    r2: float
    r2_interval: Interval | None
    seeds: tuple[float, ...]

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
    interval = object_interval(each.tolist(), objects)
    gain = None if interval is None else (1 - interval[1] / known, 1 - interval[0] / known)
    mse = float(each.mean())
    return Score(mse, interval, 1 - mse / known, gain, tuple((1 - table.mean(axis=1) / known).tolist()))


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
