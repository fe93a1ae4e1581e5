"""Normalisation of flat, tiny, full, empty and extreme depth maps; metrics of 1e10 pixels, of magnitudes from 1e-30 to
1e30 and beyond, of subnormals, of cancelling errors and of merged states."""

import math

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.stability.cases import U32, U64, Floats, Group, Outcome, gamma, high_precision, worst, wrong
from fpp_ml_bench.depth import Normalisation, denormalise, normalise, object_mask
from fpp_ml_bench.errors import DatasetError, PredictionError
from fpp_ml_bench.evaluation import score

NORMALISATION, METRICS = Group("normalisation"), Group("metrics")
NAMES = ("raw", "global", "individual")
STORED = ("float64", "float32")
SPANS = (1e-6, 1e-3, 1.0, 200.0, 1e3, 1e6)
LIKELY = 6.0
"""Roundings of unrelated numbers add up like a random walk: n of them stay within 6 sqrt(n) u but for one case in a
hundred million (Higham and Mary 2019). Where the numbers are all alike the worst case n u is used."""
RANDOM = LIKELY * math.sqrt(score.BLOCK)
_TINY = 2.0**-149
_STREAM_BLOCK, _STREAM_KINDS = 1_000_000, 20
_SIDE = 100


def depth_map(kind: str, low_mm: float, span_mm: float) -> Floats:
    """A depth map of 24 x 24 px in mm: the object's depths from ``low_mm`` to ``low_mm + span_mm``."""
    depth = np.zeros((24, 24))
    if kind == "one pixel":
        depth[7, 11] = low_mm
    elif kind == "flat plane":
        depth[4:20, 4:20] = low_mm
    elif kind in ("full frame", "part"):
        inside = np.s_[:, :] if kind == "full frame" else np.s_[3:21, 5:19]
        shape = depth[inside].shape
        depth[inside] = low_mm + span_mm * np.linspace(0, 1, shape[0] * shape[1]).reshape(shape)
    return depth


def _range(depth: NDArray) -> tuple[float, float]:
    inside = depth[object_mask(depth)]
    return (float(inside.min()), float(inside.max())) if inside.size else (0.0, 0.0)


def round_trip(name: Normalisation, kind: str, low_mm: float, span_mm: float, stored: str) -> Outcome:
    """depth to float32 representation and back; against the depth; bound: 4 u32 (D - D_min) individually: 3 roundings;
    2 u32 D else; 4 u D for the way back"""
    depth = depth_map(kind, low_mm, span_mm).astype(stored)
    low, high = _range(depth)
    representation = normalise(depth, name, low, high)
    inside = object_mask(depth)
    legal = np.isfinite(representation).all() and (representation[~inside] == 0).all()
    if name == "individual":
        legal &= bool((representation >= 0).all() and (representation <= 1).all())
    if not legal:
        return wrong("a representation that is not finite, not 0 outside or not in [0, 1]")
    if not inside.any():
        return worst(representation)
    exact = depth[inside].astype(np.float64)
    if name == "individual":
        bound = 4 * U32 * (exact - low) + 4 * U64 * exact + _TINY * (high - low)
    else:
        bound = 2 * U32 * exact + 2 * U64 * exact + _TINY * (1000.0 if name == "global" else 1.0)
    return worst(denormalise(representation, name, low, high)[inside] - exact, bound)


NORMALISATION.family("range", "mm", name=NAMES, kind=("part",), low_mm=(1700.0,), stored=STORED, span_mm=SPANS)(
    round_trip
)
NORMALISATION.family(
    "depth_min = 0", "mm", name=NAMES, kind=("full frame",), low_mm=(0.0,), stored=STORED,
    span_mm=(1e-30, 1e-6, 1.0, 1e6),
)(round_trip)  # fmt: skip
NORMALISATION.family(
    "shape of the object", "mm", name=NAMES, low_mm=(1700.0,), span_mm=(200.0,), stored=("float32",),
    kind=("flat plane", "one pixel", "full frame", "empty"),
)(round_trip)  # fmt: skip


def _quotient_error(depth: NDArray, low: float, high: float) -> Outcome:
    """The individual representation of the object against the quotient in 80-bit arithmetic, within 4 u32."""
    inside = object_mask(depth)
    exact = (depth[inside].astype(np.longdouble) - low) / (np.longdouble(high) - low) if high > low else 0.0
    representation = normalise(depth, "individual", low, high)[inside]
    bound = np.asarray(4 * U32 * np.abs(exact), float) + _TINY
    return worst(np.asarray(representation - exact, float), bound)


@NORMALISATION.family("individual, forward", "1", kind=("part",), low_mm=(1700.0, 1700.1), stored=STORED, span_mm=SPANS)
def forward(kind: str, low_mm: float, span_mm: float, stored: str) -> Outcome:
    """(D - D_min) / (D_max - D_min) in float32; against the quotient in 80-bit arithmetic; bound: 4 u32 of the value:
    difference, range and quotient round once each"""
    depth = depth_map(kind, low_mm, span_mm).astype(stored)
    return _quotient_error(depth, *_range(depth))


@NORMALISATION.family("range from a file", "1", low_mm=(1700.1,), span_mm=(1e-2, 1.0, 200.0, 1e3))
def foreign_range(low_mm: float, span_mm: float) -> Outcome:
    """individual depth with a range that is not a float32 number; against the quotient in 80-bit arithmetic; bound: 4
    u32 of the value"""
    depth = depth_map("part", low_mm, span_mm).astype(np.float32)
    return _quotient_error(depth, low_mm + span_mm * 1e-9, low_mm + span_mm * (1 - 1e-9))


NORMALISATION.family(
    "subnormal range", "mm", name=("individual",), kind=("full frame",), low_mm=(0.0,), stored=("float64",),
    span_mm=(1e-40, 1e-60, 1e-300),
)(round_trip)  # fmt: skip


@NORMALISATION.family(
    "impossible range", "1", expects="refusal", refuses=ValueError,
    low_mm=(1600.0, float("nan"), float("-inf")), high_mm=(1500.0, float("inf"), float("nan")),
)  # fmt: skip
def impossible_range(low_mm: float, high_mm: float) -> Outcome:
    """depth with an invalid range; against there is no such representation; bound: must be refused"""
    normalise(depth_map("part", 1500.0, 100.0), "individual", low_mm, high_mm)
    return Outcome(0.0)


@NORMALISATION.family(
    "scored", "mm", refuses=DatasetError,
    expects=lambda mode, kind: "number" if kind in ("part", "full frame") else "either",
    mode=("standard", "paper-individual"), kind=("part", "full frame", "flat plane", "one pixel", "empty"),
)  # fmt: skip
def scored(kind: str, mode: str) -> Outcome:
    """normalised predictions as the evaluator scores them; against the affine map, closed form; bound: 4 u D; no range
    to go back through is refused"""
    target = depth_map(kind, 1700.0, 200.0).astype(np.float32)
    inside = object_mask(target)
    values = np.where(inside, np.float32(0.5), np.float32(0.0))
    prediction, _ = score.scored_pair(values, target, "normalised", mode, "sample")  # type: ignore[arg-type]
    low, high = _range(target)
    exact = 0.5 * (high - low) + (low if mode == "standard" else 0.0)
    return worst(prediction[inside] - exact, 4 * U64 * high) if inside.any() else worst(prediction)


def _exact(*parts: tuple[Floats, int]) -> tuple[float, float]:
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


def _compared(stats: score.ErrorStats, exact: tuple[float, float], operations: float = RANDOM) -> Outcome:
    """Relative errors of MAE and RMSE; below the normal numbers a whole last place counts."""
    if stats.mae_mm is None or stats.rmse_mm is None:
        return wrong("no score of pixels that there are")
    measured, reference = np.array([stats.mae_mm, stats.rmse_mm]), np.array(exact)
    if not reference.any():
        return worst(measured)
    least = 2.0**-1074 / np.maximum(reference, 2.0**-1074)
    return worst((measured - reference) / reference, operations * U64 + 2 * least)


@METRICS.family("streamed pixels", "relative", scale_mm=(1e-30, 1.0, 1e30), pixels=(1e6, 1e8, 1e10))
def streamed(pixels: float, scale_mm: float) -> Outcome:
    """MAE and RMSE of merged states of 10^6 px, 20 kinds of block; against exact sums; bound: 6 sqrt(9600 + 6 merges)
    u: random roundings, 6 a merge, since a state is a rounded mean"""
    # Each kind of block is summed once, for it would give the same state every time, and its state is merged as often
    # as it comes: what grows with the number of pixels is the merging, all of it done here.
    rng = np.random.default_rng(11)
    levels = scale_mm * rng.lognormal(0, 3, 64)
    kinds = [levels[rng.integers(0, 64, _STREAM_BLOCK)] for _ in range(_STREAM_KINDS)]
    blocks = round(pixels / _STREAM_BLOCK)
    states = [score.stats_of(kind) for kind in kinds]
    total = score.EMPTY
    for number in range(blocks):
        total = score.combine(total, states[number % _STREAM_KINDS])
    times = [blocks // _STREAM_KINDS + (kind < blocks % _STREAM_KINDS) for kind in range(_STREAM_KINDS)]
    if total.pixels != blocks * _STREAM_BLOCK:
        return wrong(f"{total.pixels} pixels counted, {blocks * _STREAM_BLOCK} streamed")
    return _compared(total, _exact(*zip(kinds, times, strict=True)), LIKELY * math.sqrt(score.BLOCK + 6 * blocks))


@METRICS.family(
    "magnitude", "relative", refuses=PredictionError,
    expects=lambda scale_mm: "number" if scale_mm <= 1e140 else "either",
    scale_mm=(1.0, 1e-30, 1e30, 1e-130, 1e140, 1e-160, 5e-324, 1e-310, 1e200, 1e306),
)  # fmt: skip
def magnitude(scale_mm: float) -> Outcome:
    """MAE and RMSE of 20,000 errors up to 999 x scale_mm; against exact sums; bound: 6 sqrt(9600) u: a block of 9600 px
    in float64, random roundings; blocks are added exactly; squares above 1e308 refused"""
    errors = scale_mm * np.random.default_rng(3).integers(-999, 1000, 20_000).astype(np.float64)
    return _compared(score.stats_of(errors), _exact((errors, 1)))


@METRICS.family("mixed magnitudes", "relative", low_mm=(1e-30, 1e-6), high_mm=(1e-5, 1.0, 1e30))
def mixed(low_mm: float, high_mm: float) -> Outcome:
    """MAE and RMSE of magnitudes from low_mm to high_mm; against exact sums; bound: 6 sqrt(9600) u: a block of 9600 px
    in float64, random roundings; blocks are added exactly"""
    levels = np.logspace(math.log10(low_mm), math.log10(high_mm), 300)
    errors = np.random.default_rng(4).choice(levels, 30_000)
    return _compared(score.stats_of(errors), _exact((errors, 1)))


@METRICS.family("one large error", "relative", large_mm=(1.0, 1.7e7, 1e8, 1e12, 1e16))
def one_large(large_mm: float) -> Outcome:
    """MAE and RMSE of 10^7 errors, all but this one 1 mm; against exact sums; bound: 9600 u: one float64 block's worst
    case; blocks are added exactly"""
    errors = np.ones(10_000_000)  # summed naively in float32 the small ones vanish from 2^24 on
    errors[0] = large_mm
    return _compared(score.stats_of(errors), _exact((errors, 1)), score.BLOCK)


@METRICS.family(
    "sample", "relative", refuses=PredictionError, stored=("float32", "float64"),
    scale_mm=(1.0, 1e-30, 1e30, 1e-43, 1e-160, 1e-300),
)  # fmt: skip
def sample(scale_mm: float, stored: str) -> Outcome:
    """object and background MAE and RMSE of 100 x 100 px; against exact sums; bound: 6 sqrt(9600) u: a block of 9600 px
    in float64, random roundings; blocks are added exactly"""
    errors = scale_mm * np.random.default_rng(5).integers(1, 1000, (_SIDE, _SIDE))
    target = np.zeros((_SIDE, _SIDE), stored)
    target[20:70, 30:80] = max(scale_mm, 1.0) if scale_mm > 1e-6 else scale_mm
    prediction = (target.astype(np.float64) + errors).astype(stored)
    scores = score.score_sample(prediction, target)
    outcomes = []
    for stats, where in ((scores.object, target > 0), (scores.background, ~(target > 0))):
        if where.any():
            exact = prediction[where].astype(np.float64) - target[where]
            outcomes.append(_compared(stats, _exact((exact, 1))))
        else:  # a target of 1e-160 mm is 0 in float32
            outcomes.append(Outcome(0.0) if stats == score.EMPTY else wrong())
    return max(outcomes, key=lambda outcome: outcome.ratio or 0.0)


@METRICS.family("distribution", "mm", scale_mm=(1.0, 1e-30, 1e30, 1e-300))
def distribution(scale_mm: float) -> Outcome:
    """median, 95th percentile, largest, bias, shift-free MAE; against sorted values and exact sums; bound: gamma_9600
    mean |e| + 4 u"""
    errors = scale_mm * np.random.default_rng(6).integers(-500, 1000, (_SIDE, _SIDE)).astype(np.float64)
    target = np.full((_SIDE, _SIDE), 4096.0 * scale_mm)
    prediction = target + errors
    measured = score.score_sample(prediction, target).distribution
    exact = np.sort((prediction - target).ravel())
    size = np.sort(np.abs(exact))

    def quantile(values: Floats, level: float) -> float:
        place = level * (len(values) - 1)
        low = int(place)
        return float(values[low] + (values[low + 1] - values[low]) * (place - low))

    median = quantile(exact, 0.5)
    expected = [quantile(size, 0.5), quantile(size, 0.95), float(size[-1]), math.fsum(exact.tolist()) / exact.size,
                math.fsum(np.abs(exact - median).tolist()) / exact.size]  # fmt: skip
    computed = [measured[f"object_{name}_mm"] for name in ("median", "p95", "max", "bias", "shift_free_mae")]
    bound = gamma(score.BLOCK) * float(np.abs(exact).mean()) + 4 * U64 * np.abs(expected)
    return worst(np.array(computed, float) - np.array(expected), bound)


@METRICS.family("cancelling errors", "mm", large_mm=(1.0, 1e6, 1e12, 1e16))
def cancelling(large_mm: float) -> Outcome:
    """bias of positive and negative errors that nearly cancel; against exact sum; bound: gamma of (log2 9600 + 16) x
    mean |e|: pairwise sums in a block, blocks exactly"""
    half = np.random.default_rng(7).uniform(0.5, 1.0, 100_000) * large_mm
    errors = np.concatenate([half, -half]) + 1e-3
    np.random.default_rng(8).shuffle(errors)
    bias_mm = score.mean_of(errors)
    exact = math.fsum(errors.tolist()) / errors.size
    # NumPy's pairwise sum: log2(n) + 16 roundings of sums no larger than the sum of magnitudes.
    bound = gamma(math.log2(score.BLOCK) + 16) * float(np.abs(errors).mean())
    return worst(math.inf if bias_mm is None else bias_mm - exact, bound, condition=large_mm / 1e-3)


@METRICS.family("merging order", "relative", order=("one by one", "as a tree, backwards"))
def merged(order: str) -> Outcome:
    """200 states of 1e-30 to 1e30 mm merged; against all at once; bound: 6 sqrt(6 merges) u"""
    rng = np.random.default_rng(9)
    sized = [10.0 ** rng.uniform(-30, 30) * rng.uniform(0.5, 1, int(rng.integers(1, 2000))) for _ in range(200)]
    parts = [score.stats_of(errors) for errors in sized]
    whole = score.combine(*parts)
    if order == "one by one":
        total = score.EMPTY
        for part in parts:
            total = score.combine(total, part)
    else:
        level = parts[::-1]
        while len(level) > 1:
            level = [score.combine(*level[i : i + 2]) for i in range(0, len(level), 2)]
        total = level[0]
    if whole.mae_mm is None or whole.rmse_mm is None or total.pixels != whole.pixels:
        return wrong("pixels lost")
    return _compared(total, (whole.mae_mm, whole.rmse_mm), LIKELY * math.sqrt(6 * len(parts)))


@METRICS.family(
    "not a number", "mm", expects="refusal", refuses=PredictionError,
    value=(float("nan"), float("inf"), float("-inf"), 1e300),
)  # fmt: skip
def not_a_number(value: float) -> Outcome:
    """a score of a prediction with a pixel of this value; against there is none; bound: must be refused"""
    target = np.full((8, 8), 1800.0)
    prediction = target.copy()
    prediction[3, 4] = value
    return Outcome(score.score_sample(prediction, target).overall.mae_mm)


@METRICS.family("perfect and empty", "mm")
def flawless() -> Outcome:
    """scores of a perfect prediction and of an empty set; against 0, and none; bound: exact"""
    target = np.zeros((64, 64), np.float32)
    target[10:40, 10:40] = 1234.567
    scores = score.score_sample(target, target)
    empty = score.score_sample(np.zeros((4, 4)), np.zeros((4, 4))).object
    parts = scores.overall, scores.object, scores.background
    good = all(part.mae_mm == 0 and part.rmse_mm == 0 for part in parts) and empty == score.EMPTY
    return Outcome(0.0) if good else wrong()
