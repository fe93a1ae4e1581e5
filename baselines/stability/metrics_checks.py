"""What the metrics cases compute: MAE, RMSE and bias of very many, very large, very small and cancelling errors."""

import math

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.stability.case import Outcome, worst
from fpp_ml_bench.baselines.stability.roundoff import U64, gamma, high_precision
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.score import BLOCK, EMPTY, ErrorStats, combine, mean_of, score_sample, stats_of

_STREAM_BLOCK = 1_000_000
_STREAM_KINDS = 20
SIDE = 100
LIKELY = 6.0
"""Roundings of unrelated numbers add up like a random walk: n of them stay within 6 sqrt(n) u but for one case in a
hundred million (Higham and Mary 2019). Where the numbers are all alike the worst case n u is used."""


def _exact(parts: list[tuple[NDArray[np.float64], int]]) -> tuple[float, float]:
    """MAE and RMSE of arrays repeated so many times: exact sums (integers of 2^-1074) in 50 digits."""
    mp = high_precision()
    mp.prec = 2300  # every product of two float64, added without rounding
    pixels = sum(array.size * times for array, times in parts)
    absolute, squares = mp.mpf(0), mp.mpf(0)
    for array, times in parts:
        values, counts = np.unique(np.abs(array), return_counts=True)
        for value, count in zip(values.tolist(), counts.tolist(), strict=True):
            absolute += mp.mpf(value) * (count * times)
            squares += mp.mpf(value) ** 2 * (count * times)
    return float(absolute / pixels), float(mp.sqrt(squares / pixels))


def _compared(stats: ErrorStats, exact: tuple[float, float], operations: float) -> Outcome:
    """Relative errors of MAE and RMSE; below the normal numbers a whole last place counts."""
    if stats.mae_mm is None or stats.rmse_mm is None:
        return Outcome(math.inf, 0.0, note="no score of pixels that there are")
    reference = np.array(exact)
    if not reference.any():
        return worst(np.array([stats.mae_mm, stats.rmse_mm]), 0.0)
    least = 2.0**-1074 / np.maximum(reference, 2.0**-1074)
    return worst((np.array([stats.mae_mm, stats.rmse_mm]) - reference) / reference, operations * U64 + 2 * least)


def streamed(pixels: float, scale_mm: float) -> Outcome:
    """So many pixels in blocks of a million, as states merged one after the other, as they would be in a stream.

    There are `_STREAM_KINDS` different blocks. Each is summed once, for it would give the same state every time, and
    its state is merged as often as it comes: what grows with the number of pixels is the merging, all of it done here.
    """
    rng = np.random.default_rng(11)
    levels = scale_mm * rng.lognormal(0, 3, 64)
    kinds = [levels[rng.integers(0, 64, _STREAM_BLOCK)] for _ in range(_STREAM_KINDS)]
    blocks = round(pixels / _STREAM_BLOCK)
    states = [stats_of(kind) for kind in kinds]
    total = EMPTY
    for number in range(blocks):
        total = combine(total, states[number % _STREAM_KINDS])
    times = [blocks // _STREAM_KINDS + (kind < blocks % _STREAM_KINDS) for kind in range(_STREAM_KINDS)]
    if total.pixels != blocks * _STREAM_BLOCK:
        return Outcome(math.inf, 0.0, note=f"{total.pixels} pixels counted, {blocks * _STREAM_BLOCK} streamed")
    exact = _exact(list(zip(kinds, times, strict=True)))
    return _compared(total, exact, LIKELY * math.sqrt(BLOCK + 6 * blocks))


def magnitude(scale_mm: float) -> Outcome:
    errors = scale_mm * np.random.default_rng(3).integers(-999, 1000, 20_000)
    try:
        stats = stats_of(errors.astype(np.float64))
    except PredictionError as error:
        return Outcome(None, flagged=1.0, note=str(error))
    return _compared(stats, _exact([(errors.astype(np.float64), 1)]), LIKELY * math.sqrt(BLOCK))


def mixed(low_mm: float, high_mm: float) -> Outcome:
    """Magnitudes from one end to the other in one image, log-uniform."""
    levels = np.logspace(math.log10(low_mm), math.log10(high_mm), 300)
    errors = np.random.default_rng(4).choice(levels, 30_000)
    return _compared(stats_of(errors), _exact([(errors, 1)]), LIKELY * math.sqrt(BLOCK))


def one_large(large_mm: float) -> Outcome:
    """One large error among 9,999,999 of 1 mm: summed naively in float32 the small ones vanish from 2^24 on."""
    errors = np.ones(10_000_000)
    errors[0] = large_mm
    return _compared(stats_of(errors), _exact([(errors, 1)]), BLOCK)


def sample(scale_mm: float, stored: str) -> Outcome:
    """A whole sample through the evaluator: object and background, errors of one magnitude."""
    rng = np.random.default_rng(5)
    errors = scale_mm * rng.integers(1, 1000, (SIDE, SIDE))
    target = np.zeros((SIDE, SIDE), stored)
    target[20:70, 30:80] = max(scale_mm, 1.0) if scale_mm > 1e-6 else scale_mm
    prediction = (target.astype(np.float64) + errors).astype(stored)
    try:
        scores = score_sample(prediction, target)
    except PredictionError as error:
        return Outcome(None, flagged=1.0, note=str(error))
    outcomes = []
    inside = target > 0
    for stats, where in zip((scores.object, scores.background), (inside, ~inside), strict=True):
        if not where.any():  # a target of 1e-160 mm is 0 in float32
            outcomes.append(Outcome(0.0 if stats == EMPTY else math.inf, 0.0))
            continue
        exact = prediction[where].astype(np.float64) - target[where]
        outcomes.append(_compared(stats, _exact([(exact, 1)]), LIKELY * math.sqrt(BLOCK)))
    return max(outcomes, key=lambda outcome: outcome.ratio or 0.0)


def distribution(scale_mm: float) -> Outcome:
    """Median, percentile, bias and shift-free error of the object at one magnitude, against exact order statistics."""
    rng = np.random.default_rng(6)
    errors = scale_mm * rng.integers(-500, 1000, (SIDE, SIDE)).astype(np.float64)
    target = np.full((SIDE, SIDE), 4096.0 * scale_mm)
    prediction = target + errors
    measured = score_sample(prediction, target).distribution
    exact = np.sort((prediction - target).ravel())
    size = np.sort(np.abs(exact))

    def quantile(values: NDArray[np.float64], level: float) -> float:
        place = level * (len(values) - 1)
        low = int(place)
        return float(values[low] + (values[low + 1] - values[low]) * (place - low))

    median = quantile(exact, 0.5)
    expected = [quantile(size, 0.5), quantile(size, 0.95), float(size[-1]), math.fsum(exact.tolist()) / exact.size,
              math.fsum(np.abs(exact - median).tolist()) / exact.size]  # fmt: skip
    computed = [measured.median_mm, measured.p95_mm, measured.max_mm, measured.bias_mm, measured.shift_free_mae_mm]
    bound = gamma(BLOCK) * float(np.abs(exact).mean()) + 4 * U64 * np.abs(expected)
    return worst(np.array(computed, float) - np.array(expected), bound)


def cancelling(large_mm: float) -> Outcome:
    """A bias of 1e-3 mm under errors of +-large: condition number large / bias."""
    half = np.random.default_rng(7).uniform(0.5, 1.0, 100_000) * large_mm
    errors = np.concatenate([half, -half]) + 1e-3
    np.random.default_rng(8).shuffle(errors)
    bias_mm = mean_of(errors)
    exact = math.fsum(errors.tolist()) / errors.size
    # NumPy's pairwise sum: log2(n) + 16 roundings of sums no larger than the sum of magnitudes.
    bound = gamma(math.log2(BLOCK) + 16) * float(np.abs(errors).mean())
    return worst(np.array([math.inf if bias_mm is None else bias_mm - exact]), bound, condition=large_mm / 1e-3)


def merged(order: str) -> Outcome:
    """States of very unequal weight and size merged in different orders: the order must not matter."""
    rng = np.random.default_rng(9)
    parts = [
        stats_of(10.0 ** rng.uniform(-30, 30) * rng.uniform(0.5, 1, int(rng.integers(1, 2000)))) for _ in range(200)
    ]
    whole = combine(*parts)
    if order == "one by one":
        total = EMPTY
        for part in parts:
            total = combine(total, part)
    else:
        level = parts[::-1]
        while len(level) > 1:
            level = [combine(*level[i : i + 2]) for i in range(0, len(level), 2)]
        total = level[0]
    if whole.mae_mm is None or whole.rmse_mm is None or total.pixels != whole.pixels:
        return Outcome(math.inf, 0.0, note="pixels lost")
    return _compared(total, (whole.mae_mm, whole.rmse_mm), LIKELY * math.sqrt(6 * len(parts)))


def not_a_number(value: float) -> Outcome:
    target = np.full((8, 8), 1800.0)
    prediction = target.copy()
    prediction[3, 4] = value
    try:
        scores = score_sample(prediction, target)
    except PredictionError as error:
        return Outcome(None, flagged=1.0, note=str(error))
    return Outcome(scores.overall.mae_mm, 0.0)


def flawless() -> Outcome:
    """A perfect prediction scores exactly 0, and an empty set nothing, never 0."""
    target = np.zeros((64, 64), np.float32)
    target[10:40, 10:40] = 1234.567
    scores = score_sample(target, target)
    empty = score_sample(np.zeros((4, 4)), np.zeros((4, 4))).object
    parts = scores.overall, scores.object, scores.background
    good = all(part.mae_mm == 0 and part.rmse_mm == 0 for part in parts) and empty == EMPTY
    return Outcome(0.0 if good else math.inf, 0.0)
