"""Normalisation of flat, tiny, full, empty and extreme depth maps; metrics of 1e10 pixels, of magnitudes from 1e-30 to
1e30 and beyond, of subnormals, of cancelling errors and of merged states."""

import math
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.stability import cases
from fpp_ml_bench.baselines.stability.cases import U32, U64, Floats, Group, Outcome, gamma, wide, worst, wrong
from fpp_ml_bench.depth import Normalisation, denormalise, normalise, object_mask
from fpp_ml_bench.errors import DatasetError, PredictionError
from fpp_ml_bench.evaluation.score.check import scored_pair
from fpp_ml_bench.evaluation.score.sample_scores import (
    BLOCK,
    EMPTY,
    ErrorStats,
    combine,
    mean_of,
    score_sample,
    stats_of,
)

NORMALISATION = Group("normalisation")
METRICS = Group(
    "metrics", "exact sums", "6 sqrt(9600) u: a block of 9600 px in float64, random roundings; blocks are added exactly"
)
NAMES = ("raw", "global", "individual")
STORED = ("float64", "float32")
SPANS = (1e-6, 1e-3, 1.0, 200.0, 1e3, 1e6)
LIKELY = 6.0
"""Roundings of unrelated numbers add up like a random walk: n of them stay within 6 sqrt(n) u but for one case in a
hundred million (Higham and Mary 2019). Where the numbers are all alike the worst case n u is used."""
RANDOM = LIKELY * math.sqrt(BLOCK)
_TINY = 2.0**-149
_STREAM_BLOCK, _STREAM_KINDS = 1_000_000, 20


def depth_map(kind: str, low_mm: float, span_mm: float) -> Floats:
    """A depth map of 24 x 24 px in mm: the object's depths from ``low_mm`` to ``low_mm + span_mm``."""
    depth = np.zeros((24, 24))
    part = depth[
        {
            "one pixel": np.s_[7:8, 11:12],
            "flat plane": np.s_[4:20, 4:20],
            "full frame": np.s_[:, :],
            "part": np.s_[3:21, 5:19],
            "empty": np.s_[:0, :0],
        }[kind]
    ]
    sloped = kind in ("full frame", "part")
    part[...] = low_mm + (span_mm * np.linspace(0, 1, part.size).reshape(part.shape) if sloped else 0.0)
    return depth


def _range(depth: NDArray) -> tuple[float, float]:
    inside = depth[object_mask(depth)]
    return (float(inside.min()), float(inside.max())) if inside.size else (0.0, 0.0)


def round_trip(name: Normalisation, kind: str, low_mm: float, span_mm: float, stored: str) -> Outcome:
    """depth to float32 representation and back; against the depth; bound: 4 u32 (D - D_min) individually: 3 roundings;
    2 u32 D else; 4 u D for the way back"""
    depth = depth_map(kind, low_mm, span_mm).astype(stored)
    low, high = _range(depth)
    representation, inside, individual = normalise(depth, name, low, high), object_mask(depth), name == "individual"
    between = (representation >= 0) & (representation <= 1)
    if not (np.isfinite(representation) & (inside | (representation == 0)) & (between | (not individual))).all():
        return wrong("a representation that is not finite, not 0 outside or not in [0, 1]")
    if not inside.any():
        return worst(representation)
    exact = depth[inside].astype(np.float64)
    bound = 2 * U32 * exact + 2 * U64 * exact + _TINY * (1000.0 if name == "global" else 1.0)
    if individual:
        bound = 4 * U32 * (exact - low) + 4 * U64 * exact + _TINY * (high - low)
    return worst(denormalise(representation, name, low, high)[inside] - exact, bound)


NORMALISATION.family("range", "mm", name=NAMES, kind=("part",), low_mm=(1700.0,), stored=STORED, span_mm=SPANS)(
    round_trip
)
NORMALISATION.family(
    "depth_min = 0",
    "mm",
    name=NAMES,
    kind=("full frame",),
    low_mm=(0.0,),
    stored=STORED,
    span_mm=(1e-30, 1e-6, 1.0, 1e6),
)(round_trip)
NORMALISATION.family(
    "shape of the object",
    "mm",
    name=NAMES,
    low_mm=(1700.0,),
    span_mm=(200.0,),
    stored=("float32",),
    kind=("flat plane", "one pixel", "full frame", "empty"),
)(round_trip)


@NORMALISATION.family("individual, forward", "1", kind=("part",), low_mm=(1700.0, 1700.1), stored=STORED, span_mm=SPANS)
def forward(low_mm: float, span_mm: float, kind: str = "part", stored: str = "") -> Outcome:
    """(D - D_min) / (D_max - D_min) in float32; against the quotient in 80-bit arithmetic; bound: 4 u32 of the value:
    difference, range and quotient round once each"""
    depth = depth_map(kind, low_mm, span_mm).astype(stored or "float32")
    low, high = _range(depth) if stored else (low_mm + span_mm * 1e-9, low_mm + span_mm * (1 - 1e-9))
    inside = object_mask(depth)
    exact = (depth[inside].astype(np.longdouble) - low) / (np.longdouble(high) - low) if high > low else 0.0
    representation = normalise(depth, "individual", low, high)[inside]
    bound = np.asarray(4 * U32 * np.abs(exact), float) + _TINY
    return worst(np.asarray(representation - exact, float), bound)


NORMALISATION.family(
    "range from a file",
    "1",
    low_mm=(1700.1,),
    span_mm=(1e-2, 1.0, 200.0, 1e3),
    about="individual depth with a range "
    "that is not a float32 number; against the quotient in 80-bit arithmetic; bound: 4 u32 of the value",
)(forward)
NORMALISATION.family(
    "subnormal range",
    "mm",
    name=("individual",),
    kind=("full frame",),
    low_mm=(0.0,),
    stored=("float64",),
    span_mm=(1e-40, 1e-60, 1e-300),
)(round_trip)
NORMALISATION.family(
    "impossible range",
    "1",
    expects="refusal",
    refuses=ValueError,
    about="depth with an invalid range; against there is no such representation; bound: must be refused",
    low_mm=(1600.0, math.nan, -math.inf),
    high_mm=(1500.0, math.inf, math.nan),
)(lambda low_mm, high_mm: normalise(depth_map("part", 1500.0, 100.0), "individual", low_mm, high_mm))


@NORMALISATION.family(
    "scored",
    "mm",
    refuses=DatasetError,
    mode=("standard", "paper"),
    kind=("part", "full frame", "flat plane", "one pixel", "empty"),
    expects=lambda mode, kind: "number" if kind in ("part", "full frame") else "either",
)
def scored(kind: str, mode: str) -> Outcome:
    """normalised predictions as the evaluator scores them; against the affine map, closed form; bound: 4 u D; no range
    to go back through is refused"""
    target = depth_map(kind, 1700.0, 200.0).astype(np.float32)
    inside = object_mask(target)
    values = np.where(inside, np.float32(0.5), np.float32(0.0))
    prediction, _ = scored_pair(values, target, "normalised", mode, "sample")  # type: ignore[arg-type]
    low, high = _range(target)
    exact = 0.5 * (high - low) + (low if mode == "standard" else 0.0)
    return worst(prediction[inside] - exact, 4 * U64 * high) if inside.any() else worst(prediction)


def _exact(*parts: tuple[Floats, int]) -> tuple[float, float]:
    """MAE and RMSE of arrays repeated so many times: exact sums (integers of 2^-1074) in 50 digits."""
    digits = 700  # every product of two float64, added without rounding
    pixels, absolute, squares = 0, 0, 0
    for array, times in parts:
        values, counts = np.unique(np.abs(array), return_counts=True)
        exact, weights = wide(values, digits), wide(counts * times, digits)
        pixels += array.size * times
        absolute, squares = absolute + weights @ exact, squares + weights @ exact**2
    return float(absolute / pixels), float(cases.high_precision(digits).sqrt(squares / pixels))


def _compared(stats: ErrorStats, exact: tuple[float, float], operations: float = RANDOM) -> Outcome:
    """Relative errors of MAE and RMSE; below the normal numbers a whole last place counts."""
    if stats.mae_mm is None or stats.rmse_mm is None:
        return wrong("no score of pixels that there are")
    measured, reference = np.array([stats.mae_mm, stats.rmse_mm]), np.array(exact)
    if not reference.any():
        return worst(measured)
    least = 2.0**-1074 / np.maximum(reference, 2.0**-1074)
    return worst((measured - reference) / reference, operations * U64 + 2 * least)


def _scored(errors: Floats, operations: float = RANDOM) -> Outcome:
    return _compared(stats_of(errors), _exact((errors, 1)), operations)


@METRICS.family("streamed pixels", "relative", scale_mm=(1e-30, 1.0, 1e30), pixels=(1e6, 1e8, 1e10))
def streamed(pixels: float, scale_mm: float) -> Outcome:
    """MAE and RMSE of merged states of 10^6 px, 20 kinds of block; bound: 6 sqrt(9600 + 6 merges) u: random roundings,
    6 a merge, since a state is a rounded mean"""
    # Each kind of block is summed once, for it would give the same state every time, and its state is merged as often
    # as it comes: what grows with the number of pixels is the merging, all of it done here.
    rng, blocks = np.random.default_rng(11), round(pixels / _STREAM_BLOCK)
    levels = scale_mm * rng.lognormal(0, 3, 64)
    kinds = [levels[rng.integers(0, 64, _STREAM_BLOCK)] for _ in range(_STREAM_KINDS)]
    states = [stats_of(kind) for kind in kinds]
    total = reduce(combine, (states[number % _STREAM_KINDS] for number in range(blocks)), EMPTY)
    times = [blocks // _STREAM_KINDS + (kind < blocks % _STREAM_KINDS) for kind in range(_STREAM_KINDS)]
    if total.pixels != blocks * _STREAM_BLOCK:
        return wrong(f"{total.pixels} pixels counted, {blocks * _STREAM_BLOCK} streamed")
    return _compared(total, _exact(*zip(kinds, times, strict=True)), LIKELY * math.sqrt(BLOCK + 6 * blocks))


@METRICS.family(
    "magnitude",
    "relative",
    refuses=PredictionError,
    expects=lambda scale_mm: "number" if scale_mm <= 1e140 else "either",
    scale_mm=(1.0, 1e-30, 1e30, 1e-130, 1e140, 1e-160, 5e-324, 1e-310, 1e200, 1e306),
)
def magnitude(scale_mm: float) -> Outcome:
    """MAE and RMSE of 20,000 errors up to 999 x scale_mm; bound: 6 sqrt(9600) u: a block of 9600 px in float64, random
    roundings; blocks are added exactly; squares above 1e308 refused"""
    return _scored(scale_mm * np.random.default_rng(3).integers(-999, 1000, 20_000).astype(np.float64))


@METRICS.family("mixed magnitudes", "relative", low_mm=(1e-30, 1e-6), high_mm=(1e-5, 1.0, 1e30))
def mixed(low_mm: float, high_mm: float) -> Outcome:
    """MAE and RMSE of magnitudes from low_mm to high_mm"""
    levels = np.logspace(math.log10(low_mm), math.log10(high_mm), 300)
    return _scored(np.random.default_rng(4).choice(levels, 30_000))


@METRICS.family("one large error", "relative", large_mm=(1.0, 1.7e7, 1e8, 1e12, 1e16))
def one_large(large_mm: float) -> Outcome:
    """MAE and RMSE of 10^7 errors, all but this one 1 mm; bound: 9600 u: one float64 block's worst case; blocks are
    added exactly"""
    errors = np.ones(10_000_000)  # summed naively in float32 the small ones vanish from 2^24 on
    errors[0] = large_mm
    return _scored(errors, BLOCK)


@METRICS.family(
    "sample",
    "relative",
    refuses=PredictionError,
    stored=("float32", "float64"),
    scale_mm=(1.0, 1e-30, 1e30, 1e-43, 1e-160, 1e-300),
)
def sample(scale_mm: float, stored: str) -> Outcome:
    """object and background MAE and RMSE of 100 x 100 px"""
    errors = scale_mm * np.random.default_rng(5).integers(1, 1000, (100, 100))
    target = np.zeros((100, 100), stored)
    target[20:70, 30:80] = max(scale_mm, 1.0) if scale_mm > 1e-6 else scale_mm
    prediction = (target.astype(np.float64) + errors).astype(stored)
    scores = score_sample(prediction, target)
    outcomes = []
    for stats, where in ((scores.object, target > 0), (scores.background, ~(target > 0))):
        if where.any():
            outcomes.append(_compared(stats, _exact((prediction[where].astype(np.float64) - target[where], 1))))
        elif stats != EMPTY:  # a target of 1e-160 mm is 0 in float32
            return wrong()
    return max(outcomes, key=lambda outcome: outcome.ratio or 0.0)


@METRICS.family("distribution", "mm", scale_mm=(1.0, 1e-30, 1e30, 1e-300))
def distribution(scale_mm: float) -> Outcome:
    """median, 95th percentile, largest, bias, shift-free MAE; against sorted values and exact sums; bound: gamma_9600
    mean |e| + 4 u"""
    errors = scale_mm * np.random.default_rng(6).integers(-500, 1000, (100, 100)).astype(np.float64)
    target = np.full((100, 100), 4096.0 * scale_mm)
    prediction = target + errors
    measured = score_sample(prediction, target).metrics()
    exact = np.sort((prediction - target).ravel())
    size, last = np.sort(np.abs(exact)), exact.size - 1
    parts = (exact, 0.5), (size, 0.5), (size, 0.95)
    median, middle, p95 = (float(np.interp(share * last, np.arange(last + 1), part)) for part, share in parts)
    means = (math.fsum(values.tolist()) / exact.size for values in (exact, np.abs(exact - median)))
    expected = np.array([middle, p95, size[-1], *means])
    computed = [measured[f"object_{name}_mm"] for name in ("median", "p95", "max", "bias", "shift_free_mae")]
    bound = gamma(BLOCK) * float(np.abs(exact).mean()) + 4 * U64 * np.abs(expected)
    return worst(np.array(computed, float) - expected, bound)


@METRICS.family("cancelling errors", "mm", large_mm=(1.0, 1e6, 1e12, 1e16))
def cancelling(large_mm: float) -> Outcome:
    """bias of positive and negative errors that nearly cancel; against exact sum; bound: gamma of (log2 9600 + 16) x
    mean |e|: pairwise sums in a block, blocks exactly"""
    half = np.random.default_rng(7).uniform(0.5, 1.0, 100_000) * large_mm
    errors = np.concatenate([half, -half]) + 1e-3
    np.random.default_rng(8).shuffle(errors)
    bias_mm = mean_of(errors)
    exact = math.fsum(errors.tolist()) / errors.size
    # NumPy's pairwise sum: log2(n) + 16 roundings of sums no larger than the sum of magnitudes.
    bound = gamma(math.log2(BLOCK) + 16) * float(np.abs(errors).mean())
    return worst(math.inf if bias_mm is None else bias_mm - exact, bound, condition=large_mm / 1e-3)


@METRICS.family("merging order", "relative", order=("one by one", "as a tree, backwards"))
def merged(order: str) -> Outcome:
    """200 states of 1e-30 to 1e30 mm merged; against all at once; bound: 6 sqrt(6 merges) u"""
    rng = np.random.default_rng(9)
    sized = [10.0 ** rng.uniform(-30, 30) * rng.uniform(0.5, 1, int(rng.integers(1, 2000))) for _ in range(200)]
    parts = [stats_of(errors) for errors in sized]
    whole = combine(*parts)
    total, level = reduce(combine, parts, EMPTY), parts[::-1]
    if order == "as a tree, backwards":
        while len(level) > 1:
            level = [combine(*level[i : i + 2]) for i in range(0, len(level), 2)]
        total = level[0]
    if whole.mae_mm is None or whole.rmse_mm is None or total.pixels != whole.pixels:
        return wrong("pixels lost")
    return _compared(total, (whole.mae_mm, whole.rmse_mm), LIKELY * math.sqrt(6 * len(parts)))


METRICS.family(
    "not a number",
    "mm",
    expects="refusal",
    refuses=PredictionError,
    value=(math.nan, math.inf, -math.inf, 1e300),
    about="a score of a prediction with a pixel of this value; against there is none; bound: must be refused",
)(lambda value: score_sample(np.array([[1800.0, value]]), np.full((1, 2), 1800.0)))


@METRICS.family("perfect and empty", "mm")
def flawless() -> Outcome:
    """scores of a perfect prediction and of an empty set; against 0, and none; bound: exact"""
    target = np.pad(np.full((30, 30), 1234.567, np.float32), 17)
    scores, empty = score_sample(target, target), score_sample(*np.zeros((2, 4, 4))).object
    parts = scores.overall, scores.object, scores.background
    good = all(part.mae_mm == 0 and part.rmse_mm == 0 for part in parts) and empty == EMPTY
    return Outcome(0.0) if good else wrong()
