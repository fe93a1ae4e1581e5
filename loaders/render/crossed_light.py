"""The projector's light of crossed fringes: a table over the phases of both carriers.

Crossed fringes vary along rows and columns, but their light depends on two phases alone, so that one small table serves
every pixel and every shift. It is a sum of harmonics ``cos 2 pi (m t1 + n t2)`` of the carriers' turns t1, t2: (1, 0)
and (0, 1) alone if light is proportional to the pattern's level. Each has a frequency on the pattern, and blur takes
exp(-2 pi^2 q F^2) of it, as of a sinusoid of a single direction. Between the centres of projector pixels light is
linear, as in `PatternLight`. The pattern's rounding to 8 bits, 0.3 grey levels RMS, is left out.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.machine import njit
from fpp_ml_bench.portable import cosine_of_turns, exponential, sine_of_turns

SIDE = 128
"""Entries a turn: linear interpolation between them costs 0.02% of a carrier's modulation."""
HARMONICS = 16
"""The highest m and n of a response that is no line; a projector gamma of 2.2 leaves 2e-6 of the light beyond."""
_LEAST = 1e-9


def carrier_waves(crossed: Crossed, frame: int) -> NDArray[np.float64]:
    """Of both carriers in ``frame``: cycles per projector px along u and v, and turns at pixel (0, 0); (2, 3)."""
    shifts = crossed.shifts_deg[frame]
    return np.array([[*cycles, shift / 360] for cycles, shift in zip(crossed.cycles_per_px, shifts, strict=True)])


def phase_table(
    crossed: Crossed,
    light_of_level: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    variance_px2: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Light in [0, 1] over the carriers' turns, float32 (S, SIDE + 1, SIDE + 1), the first entry repeated at the end.
    ``light_of_level`` maps pattern levels in [0, 1] to linear light; ``variance_px2`` (S, 2): of the blur along u and
    v."""
    turns, orders = np.arange(SIDE) / SIDE, range(HARMONICS + 1)
    cosine, sine = (function(np.array(orders)[:, None] * turns) for function in (cosine_of_turns, sine_of_turns))
    first, second = (weight * cosine[1] for weight in crossed.weights)
    share = _cosine_series(light_of_level(np.clip(0.5 + 0.5 * (first[:, None] + second), 0.0, 1.0)), cosine)
    table = np.zeros((len(variance_px2), SIDE, SIDE))
    for n in orders:  # in order, on every processor
        even, odd = np.zeros((2, len(variance_px2), SIDE))
        for m in (m for m in orders if abs(share[m, n]) > _LEAST):
            summed, differing = (_kept(crossed, m, sign * n, variance_px2)[:, None] for sign in (1, -1))
            even += share[m, n] / 2 * (summed + differing) * cosine[m]
            odd += share[m, n] / 2 * (differing - summed) * sine[m]
        if even.any():
            table += even[:, :, None] * cosine[n] + odd[:, :, None] * sine[n]
    return np.pad(np.clip(table, 0.0, 1.0), ((0, 0), (0, 1), (0, 1)), mode="wrap").astype(np.float32)


def _cosine_series(values: NDArray[np.float64], cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients c of ``values[k, l] = sum c[m, n] cos(2 pi m k / K) cos(2 pi n l / K)``; (M, N)."""
    for _ in range(2):  # first over the rows, then over what were the columns
        total = np.zeros((len(cosine), values.shape[1]))
        for row, weights in zip(values, cosine.T, strict=True):
            total += weights[:, None] * row
        total *= np.where(np.arange(len(cosine)) > 0, 2.0, 1.0)[:, None] / SIDE
        values = total.T
    return values


def _kept(crossed: Crossed, m: int, n: int, variance_px2: NDArray[np.float64]) -> NDArray[np.float64]:
    """What blur and the interpolation between pixels leave of the harmonic (m, n); float64 (S,)."""
    kept = np.zeros(len(variance_px2))
    for axis in (0, 1):
        frequency = m * crossed.cycles_per_px[0][axis] + n * crossed.cycles_per_px[1][axis]
        kept -= 2 * math.pi**2 * frequency**2 * variance_px2[:, axis]
    kept = exponential(np.maximum(kept, -20.0))
    for axis in (0, 1):
        frequency = m * crossed.cycles_per_px[0][axis] + n * crossed.cycles_per_px[1][axis]
        if frequency != 0:
            kept *= (float(sine_of_turns(frequency / 2)) / (math.pi * frequency)) ** 2
    return kept


@njit
def fill_crossed(  # type: ignore[no-untyped-def]
    light, table, waves, per_px, u_index, u_weight, v_index, v_weight, level, level_weight
):
    """Pattern light of n points in a crossed frame: fills ``light`` (n,) from a `phase_table` and the frame's
    `carrier_waves`."""
    side = table.shape[1] - 1
    for k in range(light.size):
        u, v = (u_index[k] + np.float64(u_weight[k])) / per_px, (v_index[k] + np.float64(v_weight[k])) / per_px
        first = waves[0, 0] * u + waves[0, 1] * v + waves[0, 2]
        second = waves[1, 0] * u + waves[1, 1] * v + waves[1, 2]
        first, second = (first - np.floor(first)) * side, (second - np.floor(second)) * side
        i, j = min(np.int64(first), side - 1), min(np.int64(second), side - 1)
        a, b = first - i, second - j
        low = 0 if table.shape[0] == 1 else np.int64(level[k])
        sharp = table[low]
        value = _between(sharp, i, j, a, b)
        if table.shape[0] > 1:
            value += level_weight[k] * (_between(table[low + 1], i, j, a, b) - value)
        light[k] = value


@njit
def _between(sheet, i, j, a, b):  # type: ignore[no-untyped-def]
    top = sheet[i, j] + b * (sheet[i, j + 1] - sheet[i, j])
    bottom = sheet[i + 1, j] + b * (sheet[i + 1, j + 1] - sheet[i + 1, j])
    return top + a * (bottom - top)
