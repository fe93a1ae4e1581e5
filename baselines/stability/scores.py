"""Normalisation of flat, tiny and extreme depth ranges; metrics of 1e10 pixels, of magnitudes from
1e-30 to 1e30 and beyond, of subnormals, and of cancelling errors."""

import math
from collections.abc import Iterable
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.stability.cases import (
    U32,
    U64,
    Floats,
    Outcome,
    family,
    gamma,
    high_precision,
    wide,
    worst,
    wrong,
)
from fpp_ml_bench.depth import Normalisation, denormalise, normalise, object_mask
from fpp_ml_bench.evaluation.score.sample_scores import (
    BLOCK,
    EMPTY,
    ErrorStats,
    combine,
    mean_of,
    stats_of,
)

RANDOM = 6.0
"""Roundings of unrelated numbers add up like a random walk: n of them stay within 6 sqrt(n) u but
for one case in a hundred million (Higham and Mary 2019). Where the numbers are all alike the worst
case n u is used."""
_TINY = 2.0**-149
"""Smallest number of float32 above 0."""
_STREAM_BLOCK = 1_000_000
"""Pixels in a block of the streamed case."""
_STREAM_KINDS = 20
"""Kinds of blocks in the streamed case; each is summed once."""


def depth_map(low_mm: float, span_mm: float, stored: str) -> NDArray:
    """A depth map of 24 x 24 px in mm: the object's depths from ``low_mm`` to ``low_mm +
    span_mm``."""
    depth = np.zeros((24, 24))
    depth[3:21, 5:19] = low_mm + span_mm * np.linspace(0, 1, 252).reshape(18, 14)
    return depth.astype(stored)


@family(
    "normalisation",
    "round trip",
    "mm",
    against="the depth",
    bound="4 u32 (D - D_min) individually: 3 roundings; 2 u32 D else; 4 u D for the way back",
    name=("global", "individual"),
    low_mm=(1700.0, 0.0),
    stored=("float64", "float32"),
    span_mm=(0.0, 1e-300, 1e-40, 1e-6, 200.0, 1e6),
)
def round_trip(name: Normalisation, low_mm: float, span_mm: float, stored: str) -> Outcome:
    """depth to float32 representation and back"""
    depth = depth_map(low_mm, span_mm, stored)
    inside = object_mask(depth)
    exact = depth.astype(np.float64)
    high = float(exact.max())
    low = float(exact.min(where=inside, initial=high))
    representation = normalise(depth, name, low, high)
    bound = 2 * U32 * exact + 4 * U64 * exact + _TINY * 1000
    if name == "individual":
        bound = 4 * U32 * (exact - low) + 4 * U64 * exact + _TINY * (high - low)
        if not ((representation >= 0) & (representation <= 1)).all():
            return wrong("a representation that is not in [0, 1]")
    error = np.where(inside, denormalise(representation, name, low, high) - exact, representation)
    return worst(error, np.where(inside, bound, 0.0))


@family(
    "normalisation",
    "range from a file",
    "1",
    against="the quotient (D - D_min) / (D_max - D_min) in 80-bit arithmetic",
    bound="4 u32 of the value: difference, range and quotient round once each",
    low_mm=(1700.0, 1700.1),
    span_mm=(1e-6, 1e-2, 1.0, 200.0, 1e6),
)
def forward(low_mm: float, span_mm: float) -> Outcome:
    """individual depth with a range that is not a float32 number"""
    depth = depth_map(low_mm, span_mm, "float32")
    low, high = low_mm + span_mm * 1e-9, low_mm + span_mm * (1 - 1e-9)
    exact = (depth.astype(np.longdouble) - low) / (np.longdouble(high) - low)
    error = np.asarray(normalise(depth, "individual", low, high) - exact, float)
    inside = object_mask(depth)
    return worst(error[inside], np.asarray(4 * U32 * np.abs(exact[inside]), float) + _TINY)


def exact_scores(parts: Iterable[tuple[Floats, int]]) -> tuple[float, float]:
    """MAE and RMSE of arrays repeated so many times: sums of positive numbers in 50 digits."""
    pixels, absolute, squares = 0, 0, 0
    for array, times in parts:
        values, counts = np.unique(np.abs(array), return_counts=True)
        exact, weights = wide(values), wide(counts * times)
        pixels += array.size * times
        absolute, squares = absolute + weights @ exact, squares + weights @ exact**2
    return float(absolute / pixels), float(high_precision().sqrt(squares / pixels))


def _compared(stats: ErrorStats, exact: tuple[float, float], operations: float) -> Outcome:
    """Relative errors of MAE and RMSE; below the normal numbers a whole last place counts."""
    measured = np.array([stats.mae_mm, stats.rmse_mm], float)  # NaN for a score that is missing
    reference = np.maximum(exact, 2.0**-1074)
    return worst((measured - exact) / reference, operations * U64 + 2 * 2.0**-1074 / reference)


@family(
    "metrics",
    "streamed pixels",
    "relative",
    against="exact sums",
    bound="6 sqrt(9600 + 6 merges) u: random roundings, 6 a merge, since a state is a rounded mean",
    scale_mm=(1e-30, 1.0, 1e30),
    pixels=(1e6, 1e8, 1e10),
)
def streamed(pixels: float, scale_mm: float) -> Outcome:
    """MAE and RMSE of merged states of 10^6 px, 20 kinds of block"""
    # Each kind of block is summed once, for it would give the same state every time, and its state
    # is merged as often as it comes: what grows with the number of pixels is the merging, all of it
    # done here.
    rng, blocks = np.random.default_rng(11), round(pixels / _STREAM_BLOCK)
    levels = scale_mm * rng.lognormal(0, 3, 64)
    kinds = [levels[rng.integers(0, 64, _STREAM_BLOCK)] for _ in range(_STREAM_KINDS)]
    states = [stats_of(kind) for kind in kinds]
    total = reduce(combine, (states[number % _STREAM_KINDS] for number in range(blocks)), EMPTY)
    times = [
        blocks // _STREAM_KINDS + (kind < blocks % _STREAM_KINDS) for kind in range(_STREAM_KINDS)
    ]
    if total.pixels != blocks * _STREAM_BLOCK:
        return wrong(f"{total.pixels} pixels counted, {blocks * _STREAM_BLOCK} streamed")
    return _compared(
        total, exact_scores(zip(kinds, times, strict=True)), RANDOM * math.sqrt(BLOCK + 6 * blocks)
    )


@family(
    "metrics",
    "magnitude",
    "relative",
    against="exact sums",
    bound="6 sqrt(9600) u: a block of 9600 px in float64, random roundings; blocks are added exactly; squares"
    " above 1e308 refused",
    expects=lambda scale_mm, **_: "number" if scale_mm <= 1e140 else "either",
    decades=(0, 30),
    scale_mm=(1.0, 1e-30, 1e30, 1e-130, 1e140, 1e-160, 5e-324, 1e-310, 1e200, 1e306),
)
def magnitude(scale_mm: float, decades: int) -> Outcome:
    """MAE and RMSE of 20,000 errors up to 999 x scale_mm, over so many powers of ten down"""
    rng = np.random.default_rng(3)
    errors = (
        scale_mm * rng.integers(-999, 1000, 20_000) / 10.0 ** rng.integers(0, decades + 1, 20_000)
    )
    return _compared(stats_of(errors), exact_scores([(errors, 1)]), RANDOM * math.sqrt(BLOCK))


@family(
    "metrics",
    "one large error",
    "relative",
    against="exact sums",
    bound="9600 u: one float64 block's worst case; blocks are added exactly",
    large_mm=(1.0, 1.7e7, 1e8, 1e12, 1e16),
)
def one_large(large_mm: float) -> Outcome:
    """MAE and RMSE of 10^7 errors, all but this one 1 mm"""
    errors = np.ones(10_000_000)  # summed naively in float32 the small ones vanish from 2^24 on
    errors[0] = large_mm
    return _compared(
        stats_of(errors), exact_scores([(errors[:1], 1), (errors[1:2], errors.size - 1)]), BLOCK
    )


@family(
    "metrics",
    "cancelling errors",
    "mm",
    against="exact sum",
    bound="gamma of (log2 9600 + 16) x mean |e|: pairwise sums in a block, blocks exactly",
    large_mm=(1.0, 1e6, 1e12, 1e16),
)
def cancelling(large_mm: float) -> Outcome:
    """bias of positive and negative errors that nearly cancel"""
    half = np.random.default_rng(7).uniform(0.5, 1.0, 100_000) * large_mm
    errors = np.random.default_rng(8).permutation(np.concatenate([half, -half])) + 1e-3
    exact = math.fsum(errors.tolist()) / errors.size
    # NumPy's pairwise sum: log2(n) + 16 roundings of sums no larger than the sum of magnitudes.
    bound = gamma(math.log2(BLOCK) + 16) * float(np.abs(errors).mean())
    return worst(np.array(mean_of(errors), float) - exact, bound, condition=large_mm / 1e-3)
