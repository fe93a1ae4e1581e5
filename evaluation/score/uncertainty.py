"""Intervals of means over samples by a bootstrap over objects, and ranks with ties.

Views of the same object are not independent, so whole objects are resampled, and the mean of a resample is the plain
mean over the samples of the objects drawn. With few objects the plain percentile interval is too short, because it
takes the spread of five objects as exact. The levels are therefore widened as in Hesterberg's expanded percentile
interval (The American Statistician 69:371, 2015): alpha' / 2 = Phi(-sqrt(n / (n - 1)) t_{alpha / 2, n - 1}).
"""

import math
from collections.abc import Hashable, Mapping, Sequence
from functools import cache
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.evaluation.protocol import BOOTSTRAP_RESAMPLES, BOOTSTRAP_SEED, CONFIDENCE

Interval = tuple[float, float]


def object_interval(values: Sequence[float | None], objects: Sequence[Hashable]) -> Interval | None:
    """The 95% interval of the mean of ``values`` (one per sample, None left out), resampled over ``objects``.
    Deterministic: fixed seed, and a generator whose stream does not change between versions of NumPy. Objects count in
    the order in which they first appear. None with fewer than two objects that have a value."""
    sums: dict[Hashable, list[float]] = {}
    for value, name in zip(values, objects, strict=True):
        if value is not None:
            sums.setdefault(name, []).append(value)
    if len(sums) < 2:
        return None
    totals = np.array([math.fsum(group) for group in sums.values()])
    counts = np.array([len(group) for group in sums.values()], dtype=np.float64)
    drawn = _draws(len(sums))
    if (counts == counts[0]).all():
        means = totals.take(drawn).mean(axis=1) / counts[0]
    else:
        means = totals.take(drawn).sum(axis=1) / counts.take(drawn).sum(axis=1)
    low, high = np.quantile(means, _levels(len(sums)))
    return float(low), float(high)


@cache
def _draws(objects: int) -> NDArray[np.intp]:
    """Which objects each resample holds, (resamples, objects)."""
    raw = np.random.PCG64(BOOTSTRAP_SEED).random_raw(BOOTSTRAP_RESAMPLES * objects)
    return (raw % np.uint64(objects)).astype(np.intp).reshape(BOOTSTRAP_RESAMPLES, objects)


@cache
def _levels(objects: int) -> tuple[float, float]:
    widened = -math.sqrt(objects / (objects - 1)) * _student_quantile(0.5 + CONFIDENCE / 2, objects - 1)
    tail = NormalDist().cdf(widened)
    return tail, 1 - tail


def _student_quantile(level: float, freedom: int) -> float:
    """Quantile of Student's t for a whole number of degrees of freedom, by halving an interval around it. SciPy has it
    too, but its last digits differ, which would move intervals, and importing it takes longer than scoring a test
    split."""
    low, high = 0.0, 1e4
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if _student_cdf(middle, freedom) < level else (low, middle)
    return (low + high) / 2


def _student_cdf(t: float, freedom: int) -> float:
    """The closed form for whole degrees of freedom (Abramowitz and Stegun 26.7.3 and 26.7.4)."""
    angle = math.atan(t / math.sqrt(freedom))
    cosine, sine = math.cos(angle), math.sin(angle)
    odd = freedom % 2
    term = total = 1.0
    for k in range(2 + odd, freedom - 1, 2):
        term *= (k - 1) / k * cosine * cosine
        total += term
    inside = (angle + (sine * cosine * total if freedom > 1 else 0.0)) * 2 / math.pi if odd else sine * total
    return 0.5 + inside / 2


def caution(objects: int) -> str | None:
    """A warning about an interval over so few objects that resampling can't cover the truth in 95% of cases, or None.
    An interval of resampled means is between the smallest and the largest object; the truth (the median, for a
    symmetric spread) is outside of all n objects in 2^(1 - n) of cases."""
    if objects < 2 or (reach := 1 - 2.0 ** (1 - objects)) >= 0.9:
        return None
    return f"With {objects} objects an interval can cover the truth in at most {100 * reach:.0f}% of cases."


def intervals_over_objects(
    rows: Sequence[Mapping[str, float | None]], objects: Sequence[Hashable], keys: Sequence[str]
) -> dict[str, Interval | None]:
    """`object_interval` of each of ``keys`` over per-sample ``rows``."""
    return {key: object_interval([row[key] for row in rows], objects) for key in keys}


def ranks_with_ties(values: Sequence[float | None], intervals: Sequence[Interval | None]) -> list[int | None]:
    """Rank of each entry where smaller is better: 1 plus the number of entries that are clearly better.

    An entry is clearly better when its interval ends below the start of the other interval. An entry without interval
    counts with its value alone; an entry without value has no rank. The order of the entries does not matter.

    >>> ranks_with_ties([1.0, 1.2, 3.0, None], [(0.8, 1.3), (1.1, 1.4), (2.5, 3.5), None])
    [1, 1, 3, None]
    """
    pairs = zip(values, intervals, strict=True)
    spans = [None if value is None else interval or (value, value) for value, interval in pairs]
    ends = [span[1] for span in spans if span is not None]
    return [None if span is None else 1 + sum(end < span[0] for end in ends) for span in spans]
