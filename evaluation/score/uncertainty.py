"""Intervals of means over samples by a bootstrap over objects, and a test of paired differences
over objects.

Views of the same object are not independent, so whole objects are resampled, and the mean of a
resample is the plain mean over the samples of the objects drawn. With few objects the plain
percentile interval is too short, because it takes the spread of five objects as exact. The levels
are therefore widened as in Hesterberg's expanded percentile interval (The American Statistician
69:371, 2015): alpha' / 2 = Phi(-sqrt(n / (n - 1)) t_{alpha / 2, n - 1}).

Two methods are told apart by a sign-flip test (Fisher's randomisation test for pairs): if they were
equally good, the difference of each object could as well have the other sign. Where many pairs are
tested, Holm's correction (Scandinavian Journal of Statistics 6:65, 1979) keeps the chance of any
false verdict among them at 5%.
"""

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from statistics import NormalDist, fmean

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.evaluation.protocol import BOOTSTRAP_RESAMPLES, BOOTSTRAP_SEED, CONFIDENCE

Interval = tuple[float, float]

SIGNIFICANT = 0.05
"""A p value up to this tells two methods apart."""
FEWEST_OBJECTS = 6
"""With fewer objects no result of the sign-flip test is `SIGNIFICANT`: all n differences have the
same sign in 2^(1 - n) of the flips, and 2^-4 is 6.25%."""
_AT_ONCE = 50_000
"""Pairs whose differences are held at once."""
_EXACT_OBJECTS = 32
_FLIPS = 100_000
_ROUNDING = 1e-12
"""Sums of flips that differ by less than this share of the sum of magnitudes are equal but for
rounding."""


def mean_of(values: Iterable[float | None]) -> float | None:
    """Mean of ``values`` other than None; None where there are none."""
    defined = [value for value in values if value is not None]
    return fmean(defined) if defined else None


def object_interval(values: Sequence[float | None], objects: Sequence[Hashable]) -> Interval | None:
    """The 95% interval of the mean of ``values`` (one per sample, None left out), resampled over
    ``objects``. Deterministic: fixed seed, and a generator whose stream does not change between
    versions of NumPy. Objects count in the order in which they first appear. None with fewer than
    two objects that have a value."""
    sums: dict[Hashable, list[float]] = {}
    for value, name in zip(values, objects, strict=True):
        if value is not None:
            sums.setdefault(name, []).append(value)
    if len(sums) < 2:
        return None
    totals = np.array([math.fsum(group) for group in sums.values()])
    counts = np.array([len(group) for group in sums.values()], dtype=np.float64)
    drawn = _draws(len(sums))
    means = totals.take(drawn).sum(axis=1) / counts.take(drawn).sum(axis=1)
    low, high = np.quantile(means, _levels(len(sums)))
    return float(low), float(high)


def interval_over_seeds(values: Sequence[Mapping[str, float]]) -> Interval | None:
    """The 95% interval of the mean of ``values``, an object's for each seed of a training,
    resampled over objects and, independently, over seeds (the pigeonhole bootstrap: Owen, Annals of
    Applied Statistics 1:386, 2007). With one seed the `object_interval` of equally many views of
    each object. None with fewer than two objects."""
    names = list(values[0]) if values else []
    if len(names) < 2:
        return None
    table = np.array([[of_seed[name] for name in names] for of_seed in values])
    means = np.zeros(BOOTSTRAP_RESAMPLES)
    drawn = _draws(len(names))
    raw = np.random.PCG64(BOOTSTRAP_SEED + 1).random_raw(BOOTSTRAP_RESAMPLES * len(table))
    for seeds in (
        (raw % np.uint64(len(table))).astype(np.intp).reshape(len(table), BOOTSTRAP_RESAMPLES)
    ):
        means += table[seeds[:, None], drawn].mean(axis=1) / len(table)
    low, high = np.quantile(means, _levels(len(names)))
    return float(low), float(high)


@cache
def _draws(objects: int) -> NDArray[np.intp]:
    """Which objects each resample holds, (resamples, objects)."""
    raw = np.random.PCG64(BOOTSTRAP_SEED).random_raw(BOOTSTRAP_RESAMPLES * objects)
    return (raw % np.uint64(objects)).astype(np.intp).reshape(BOOTSTRAP_RESAMPLES, objects)


@cache
def _levels(objects: int) -> tuple[float, float]:
    widened = -math.sqrt(objects / (objects - 1)) * _student_quantile(
        0.5 + CONFIDENCE / 2, objects - 1
    )
    tail = NormalDist().cdf(widened)
    return tail, 1 - tail


def _student_quantile(level: float, freedom: int) -> float:
    """Quantile of Student's t for a whole number of degrees of freedom, by halving an interval
    around it. SciPy has it too, but its last digits differ, which would move intervals, and
    importing it takes longer than scoring a test split."""
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
    inside = (
        (angle + (sine * cosine * total if freedom > 1 else 0.0)) * 2 / math.pi
        if odd
        else sine * total
    )
    return 0.5 + inside / 2


def caution(objects: int) -> str | None:
    """A warning about an interval over so few objects that resampling can't cover the truth in 95%
    of cases, or None. An interval of resampled means is between the smallest and the largest
    object; the truth (the median, for a symmetric spread) is outside of all n objects in 2^(1 - n)
    of cases."""
    if objects < 2 or (reach := 1 - 2.0 ** (1 - objects)) >= 0.9:
        return None
    return (
        f"With {objects} objects an interval can cover the truth in at most {100 * reach:.0f}% of "
        f"cases."
    )


def intervals_over_objects(
    rows: Sequence[Mapping[str, float | None]], objects: Sequence[Hashable], keys: Sequence[str]
) -> dict[str, Interval | None]:
    """`object_interval` of each of ``keys`` over per-sample ``rows``."""
    return {key: object_interval([row[key] for row in rows], objects) for key in keys}


def sign_flip_p(differences: Sequence[float]) -> float:
    """The two-sided p value of paired ``differences`` (one per object, finite): the share of all
    sign flips whose sum is at least as far from 0 as the sum of the differences. 1.0 without any.

    Exact for up to 32 objects: the sums of all flips of one half are counted against the sorted
    sums of the other half. Beyond, 100,000 flips from a fixed seed, themselves counted as one: (1 +
    far) / (1 + flips).

    >>> sign_flip_p([1.0, 2.0, 3.0, 1.5, 0.5])
    0.0625
    """
    threshold = abs(math.fsum(differences)) - _ROUNDING * math.fsum(map(abs, differences))
    if threshold <= 0:
        return 1.0
    values = np.array(differences, dtype=np.float64)
    if len(values) > _EXACT_OBJECTS:
        sums = np.zeros(_FLIPS)
        for value, flipped in zip(values, _flips(len(values)), strict=True):
            sums += np.where(flipped, -value, value)
        return (1 + int(np.count_nonzero(np.abs(sums) >= threshold))) / (1 + _FLIPS)
    half = len(values) // 2
    first, second = _flipped_sums(values[:half]), np.sort(_flipped_sums(values[half:]))
    far = len(second) - np.searchsorted(second, threshold - first, side="left")
    return 2 * int(far.sum()) / 2 ** len(values)  # as many sums are as far on the other side


def sign_flip_bounds(
    differences: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bounds of `sign_flip_p` for each row of ``differences`` (pairs, objects): two arrays
    (pairs,), equal where they give it. They take a small part of its time.

    The differences of the rarer sign add up to some magnitude. A flip of some objects is as far
    from 0 as no flip where their magnitudes add up to at most that. If the m smallest do, so does
    each choice of them, and no choice of more than m objects does."""
    pairs, objects = differences.shape
    if objects > _EXACT_OBJECTS:
        return np.full(pairs, 1 / (1 + _FLIPS)), np.ones(pairs)
    magnitudes = np.sort(np.abs(differences), axis=1)
    whole = magnitudes.sum(axis=1)
    rarer = ((whole - np.abs(differences.sum(axis=1)) + _ROUNDING * whole) / 2)[:, None]
    together = (np.cumsum(magnitudes, axis=1) <= rarer).sum(axis=1)
    alone = (magnitudes <= rarer).sum(axis=1)
    choices = np.cumsum(
        [[math.comb(n, k) for k in range(objects + 1)] for n in range(objects + 1)], axis=1
    )
    share = 2.0 ** (1 - objects)
    low, high = np.maximum(2.0**together, 1 + alone), choices[alone, together]
    return np.minimum(share * low, 1.0), np.minimum(share * high, 1.0)


def _flipped_sums(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The sums under every choice of signs, (2 ** len(values),)."""
    sums = np.zeros(1)
    for value in values:
        sums = np.concatenate([sums + value, sums - value])
    return sums


@cache
def _flips(objects: int) -> NDArray[np.bool_]:
    """Which objects each of `_FLIPS` flips, (objects, flips)."""
    words = -(-objects // 64)
    raw = np.random.PCG64(BOOTSTRAP_SEED).random_raw(words * _FLIPS).reshape(words, _FLIPS)
    return np.array(
        [raw[k // 64] >> np.uint64(k % 64) & np.uint64(1) for k in range(objects)], dtype=np.bool_
    )


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's adjusted p values, in the order given: a hypothesis is rejected at a level that its
    value does not exceed.

    >>> [round(p, 6) for p in holm([0.01, 0.04, 0.03])]
    [0.03, 0.06, 0.06]
    """
    order = np.argsort(p_values)
    adjusted = np.sort(p_values) * np.arange(len(order), 0, -1)
    return np.minimum(np.maximum.accumulate(adjusted), 1.0)[np.argsort(order)].tolist()  # type: ignore[no-any-return]


@dataclass(frozen=True)
class Pair:
    """Two rows by their short names, the smaller error first: the mean of second minus first over
    the ``objects`` (at least 0), its 95% interval, the sign-flip test's p value, and that value
    after Holm's correction over all pairs of the table. ``behind``: whether the second is behind
    the first, the corrected value being at most 5%."""

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
    """Who is behind whom, as `pairs` says: ``errors`` (rows, objects), smaller is better, gives
    (rows, rows), [i, j] True where row j is behind row i. A pair is tested by itself only where the
    bounds of its p value don't decide."""
    first, second = np.triu_indices(len(errors), 1)
    low, high = np.empty(len(first)), np.empty(len(first))
    for start in range(0, len(first), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        low[part], high[part] = sign_flip_bounds(errors[second[part]] - errors[first[part]])
    apart, left = np.zeros(len(first), bool), len(first)
    while left:  # Holm's procedure: with each pair that differs, fewer are left, and the next may have a larger p
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
    """Best and worst rank that the tests allow each row of ``errors``, as `behind` takes them.
    Best: 1 and the number of rows that it is behind. Worst: the number of all rows without those
    behind it."""
    is_behind = behind(errors)
    best, worst = 1 + is_behind.sum(axis=0), len(errors) - is_behind.sum(axis=1)
    return list(zip(best.tolist(), worst.tolist(), strict=True))
