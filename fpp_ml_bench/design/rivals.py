"""Rivals of the true order: other depths at which two wrapped phases are nearly the same.

Over the working range a pixel's pair of phases runs along a line on the torus and winds around it. A rival is another
turn of that line. Unwrapped, the pair grows from 0 to ``turns`` (two numbers), and the rivals of a depth are the
points (m, n) of the whole numbers but (0, 0), as near as the line comes to them.
"""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

TAU = 2 * math.pi
_TINY = float(np.finfo(np.float64).tiny)


def nearest(
    turns: NDArray[np.float64], low: NDArray[np.float64] | float, high: NDArray[np.float64] | float, own: bool = False
) -> NDArray[np.float64]:
    """Distance in rad from the line ``turns`` x place, place from ``low`` to ``high``, to the nearest whole numbers
    (m, n); with ``own`` (0, 0) counts too. ``turns`` float64 (..., 2), ``low`` and ``high`` that broadcast to (...);
    returns (...)."""
    least = np.full(np.broadcast_shapes(turns.shape[:-1], np.shape(low), np.shape(high)), np.inf)
    for distance in _distances(turns, low, high, own):
        np.minimum(least, distance, out=least)
    return least


def _distances(
    turns: NDArray[np.float64], low: NDArray[np.float64] | float, high: NDArray[np.float64] | float, own: bool
) -> Iterator[NDArray[np.float64]]:
    """Distances in rad from the line, as in `nearest`, to the whole numbers beside it: along the axis that grows
    faster all that the line passes, and across the three next to it."""
    steep = np.abs(turns[..., 1]) > np.abs(turns[..., 0])
    fast, slow = np.where(steep, turns[..., 1], turns[..., 0]), np.where(steep, turns[..., 0], turns[..., 1])
    fast, slow = np.abs(fast), np.where(fast < 0, -slow, slow)  # (m, n) and (-m, -n) are alike
    fast = np.maximum(fast, _TINY)
    square, slope, most = fast * fast + slow * slow, slow / fast, float(fast.max())
    start, stop = math.floor(min(float(np.min(low)), 0.0) * most), math.ceil(float(np.max(high)) * most)
    for m in range(start - 1, stop + 2):
        middle = np.rint(m * slope)
        for n in (middle - 1, middle, middle + 1):
            place = np.clip((m * fast + n * slow) / np.maximum(square, _TINY), low, high)
            distance = TAU * np.hypot(m - fast * place, n - slow * place)
            yield np.where(n == 0, np.inf, distance) if m == 0 and not own else distance


def rival_distance(turns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance in rad of the nearest rival of any depth in the range, for ``turns`` (..., 2): what an error of the two
    phases must cross half of to choose a wrong order."""
    return nearest(turns, 0.0, 1.0)


def background_distance(turns: NDArray[np.float64], background: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance in rad of the background's phases from those of every depth in the range; ``background``: its place on
    the line (`EpipolarLines`), which broadcasts to (...)."""
    return nearest(turns, background - 1.0, background, own=True)


def wrong_order_rate(
    turns: NDArray[np.float64], sigma: NDArray[np.float64] | float, surfaces: tuple[float, float] = (0.0, 1.0)
) -> NDArray[np.float64]:
    """Expected share of pixels with a wrong order, for ``turns`` (..., 2), where no neighbour helps: the mean over
    depths at ``surfaces`` of the range (places on the line, evenly) and the sum over rivals.

    Errors of a single frame's phase are mostly edges, texture and the other carrier, with heavy tails: across the line
    they are taken as two-sided exponential with a standard deviation of ``sigma`` rad, (...) or one for all. A rival at
    distance d is chosen with the probability of an error above d / 2, ``exp(-sqrt(2) d / (2 sigma)) / 2``.
    """
    places = np.linspace(*surfaces, 41)
    low, high = -places, 1.0 - places
    line, spread = turns[..., None, :], 2 * np.asarray(sigma, dtype=np.float64)[..., None]
    total = np.zeros(np.broadcast_shapes(line.shape[:-1], places.shape))
    for distance in _distances(line, low, high, own=False):
        total += np.exp(-math.sqrt(2) * distance / spread) / 2
    return np.minimum(total, 1.0).mean(axis=-1)  # type: ignore[no-any-return]
