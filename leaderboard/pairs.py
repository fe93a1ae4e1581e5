"""Which row of a table is behind which: paired differences over the objects, a sign-flip test of each pair, Holm's
correction over all pairs of the table, and the ranks that follow."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.evaluation.score import (
    SIGNIFICANT,
    Interval,
    holm,
    object_interval,
    sign_flip_bounds,
    sign_flip_p,
)

_AT_ONCE = 50_000
"""Pairs whose differences are held at once."""


@dataclass(frozen=True)
class Pair:
    """Two rows by their short names, the smaller error first: the mean of second minus first over the ``objects`` (at
    least 0), its 95% interval, the sign-flip test's p value, and that value after Holm's correction over all pairs of
    the table. ``behind``: whether the second is behind the first, the corrected value being at most 5%."""

    first: str
    second: str
    objects: int
    difference: float
    interval: Interval | None
    p: float
    p_holm: float
    behind: bool


def pairs(errors: Mapping[str, Mapping[str, float]]) -> list[Pair]:
    """Every pair of the rows by name, whose errors by object are ``errors``; smaller is better."""
    compared = []
    for first, second in combinations(errors, 2):
        differences = [errors[second][name] - errors[first][name] for name in errors[first]]
        if fmean(differences) < 0:
            first, second, differences = second, first, [-value for value in differences]
        compared.append((first, second, differences, sign_flip_p(differences)))
    adjusted = holm([p for *_, p in compared])
    return [
        Pair(
            first,
            second,
            len(differences),
            fmean(differences),
            object_interval(differences, range(len(differences))),
            p,
            p_holm,
            p_holm <= SIGNIFICANT,
        )
        for (first, second, differences, p), p_holm in zip(compared, adjusted, strict=True)
    ]


def behind(errors: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Who is behind whom, as `pairs` says: ``errors`` (rows, objects), smaller is better, gives (rows, rows), [i, j]
    True where row j is behind row i. A pair is tested by itself only where the bounds of its p value don't decide."""
    first, second = np.triu_indices(len(errors), 1)
    low, high = np.empty(len(first)), np.empty(len(first))
    for start in range(0, len(first), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        low[part], high[part] = sign_flip_bounds(errors[second[part]] - errors[first[part]])
    apart, left = np.zeros(len(first), bool), len(first)
    while left:  # Holm's procedure: with each pair that is told apart, fewer are left, and the next may have a larger p
        for pair in np.flatnonzero((left * low <= SIGNIFICANT) & (left * high > SIGNIFICANT)):
            low[pair] = high[pair] = sign_flip_p(errors[second[pair]] - errors[first[pair]])
        apart = left * high <= SIGNIFICANT
        if (now_left := len(first) - int(np.count_nonzero(apart))) == left:
            break
        left = now_left
    means = errors.mean(axis=1)
    is_behind = np.zeros((len(errors), len(errors)), bool)
    second_ahead = means[second] < means[first]
    better, worse = np.where(second_ahead, second, first), np.where(second_ahead, first, second)
    is_behind[better[apart], worse[apart]] = True
    return is_behind


def rank_ranges(errors: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Best and worst rank that the tests allow each row of ``errors``, as `behind` takes them. Best: 1 and the number
    of rows that it is behind. Worst: the number of all rows without those behind it."""
    is_behind = behind(errors)
    best, worst = 1 + is_behind.sum(axis=0), len(errors) - is_behind.sum(axis=1)
    return list(zip(best.tolist(), worst.tolist(), strict=True))
