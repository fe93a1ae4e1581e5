"""What training chooses on whole validation views: the threshold of the mask, and the lead of the base order."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Protocol

import numpy as np

from fpp_ml_bench.baselines.phase_route import Mask

TYPICAL_MM = 1800.0
"""Depth error that a missed or invented pixel counts with."""


class Truth(Protocol):
    """``target``: object pixels; ``void``: pixels that are neither object nor background; both (h, w)."""

    @property
    def target(self) -> Mask: ...
    @property
    def void(self) -> Mask: ...


def mean_scores(rows: Iterable[Mapping[str, float | None]]) -> dict[str, float]:
    """Mean of each score over the rows that have it; a score that none has is left out."""
    known: dict[str, list[float]] = {}
    for row in rows:
        for key, value in row.items():
            if value is not None:
                known.setdefault(key, []).append(value)
    return {key: float(np.mean(values)) for key, values in known.items()}


def chosen_threshold(
    views: Iterable[tuple[Truth, Callable[[float], Mask]]],
    thresholds: Sequence[float],
    pixels: int,
    tolerance_mm: float = 0.0,
) -> float:
    """The threshold, out of the rising ``thresholds`` on the mask's logit, with the least sum of object and background
    error: a missed object pixel and an invented background pixel are off by the same distance, each divided by the
    number of pixels of its kind. ``views``: each with the mask that it gets by a threshold; ``pixels``: of a whole
    image. Among the thresholds within ``tolerance_mm`` of the least, the lowest: it misses the fewest pixels."""
    costs = []
    for truth, decided in views:
        object_px, row = max(int(truth.target.sum()), 1), []
        for threshold in thresholds:
            inside = decided(threshold)
            missed, invented = (truth.target & ~inside).sum(), (inside & ~truth.target & ~truth.void).sum()
            row.append(TYPICAL_MM * (missed / object_px + invented / (pixels - object_px)))
        costs.append(row)
    means = np.mean(costs, axis=0)
    return thresholds[int(np.flatnonzero(means <= means.min() + tolerance_mm)[0])]


def chosen_lead(wrong_percent: Callable[[float], float], leads: Sequence[float]) -> float:
    """The lead (see `Answers.with_lead`) out of ``leads`` by which the fewest orders are wrong."""
    return leads[int(np.argmin([wrong_percent(lead) for lead in leads]))]
