"""Rivals of the true order: other depths at which two wrapped phases are nearly the same, along a
rig's epipolar lines.

As depth goes through the working range, a pixel's ray runs on a straight line of the pattern, and
along it every carrier's phase grows evenly. So a rig is, for its orders, no more than the vector
from the near to the far end of that line, for a grid of pixels, and the place of the background on
it (`EpipolarLines`).

Over the range a pixel's pair of phases runs along a line on the torus and winds around it. A rival
is another turn of that line. Unwrapped, the pair grows from 0 to ``turns`` (two numbers), and the
rivals of a depth are the points (m, n) of the whole numbers but (0, 0), as near as the line comes
to them.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.constants import MM_PER_M, TAU
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.optics.rig import Rig

GRID = 5
"""Pixels along each side of the image, corners included."""
_STEP_M = 1e-4
_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class EpipolarLines:
    """The lines of n pixels, in projector px (u, v); those of pixels that see the same are kept
    once.

    ``across_px`` float64 (n, 2): from the near to the far end of the range. ``far_px_per_mm`` (n,
    2): the change with depth at the far end. ``background`` (n,): the place of the background plane
    on the line, 0 at the near end and 1 at the far end, so above 1; None where no background is
    known. ``range_mm``: the depths of both ends.
    """

    across_px: NDArray[np.float64]
    far_px_per_mm: NDArray[np.float64]
    background: NDArray[np.float64] | None
    range_mm: tuple[float, float]

    @classmethod
    def of(cls, rig: Rig) -> "EpipolarLines":
        """The lines of a grid of pixels that see the pattern at the standoff; a lens that bends
        them is taken as straight between their ends. Raises `RigError` where no pixel sees it over
        the whole range."""
        width, height = rig.camera.width, rig.camera.height
        columns, rows = (np.linspace(0, size - 1, GRID) for size in (width, height))
        u, v = (
            np.append(np.tile(columns, GRID), (width - 1) / 2),
            np.append(np.repeat(rows, GRID), (height - 1) / 2),
        )
        rays = rig.camera.normalised(u, v)
        near_m, far_m = rig.range_m
        depths = [near_m, far_m, rig.standoff_m, far_m - _STEP_M, far_m + _STEP_M]
        depths += [] if rig.background_m is None else [rig.background_m]
        near, far, middle, before, behind, *beyond = (
            np.stack(rig.seen(rays, depth), axis=1) for depth in depths
        )
        seen = np.isfinite(near).all(axis=1) & np.isfinite(far).all(axis=1)
        seen &= rig.projector.holds(*middle.T)
        if not seen.any():
            raise RigError(
                "no pixel sees the pattern over the whole working range: check pose and range"
            )
        across, slope = (far - near)[seen], ((behind - before) / (2 * _STEP_M * MM_PER_M))[seen]
        parts = [across, slope]
        if beyond:
            place = ((beyond[0] - near)[seen] * across).sum(axis=1) / (across**2).sum(axis=1)
            parts.append(place[:, None])
        kept: NDArray[np.float64] = np.unique(np.round(np.concatenate(parts, axis=1), 6), axis=0)
        background = kept[:, 4] if beyond else None
        return cls(kept[:, :2], kept[:, 2:4], background, rig.working_range_mm)

    @property
    def flat_angle_deg(self) -> float:
        """The angle of a carrier that runs along the line and tells no depth, -90 to 90 degrees: of
        the longest."""
        u_px, v_px = self.across_px[np.argmax((self.across_px**2).sum(axis=1))]
        return float(np.degrees(np.arctan2(-v_px, u_px) if u_px > 0 else np.arctan2(v_px, -u_px)))

    def turns(self, crossed: Crossed) -> NDArray[np.float64]:
        """Turns of both carriers' phases from the near to the far end, float64 (n, 2)."""
        return self.across_px @ np.array(crossed.cycles_per_px).T

    def places(self, depth_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Places of depths (n,) on a line, 0 at the near and 1 at the far end: even in 1 / depth,
        as they are where the baseline is square to the projector's axis, and nearly so
        elsewhere."""
        near_mm, far_mm = self.range_mm
        return (1 / near_mm - 1 / depth_mm) / (1 / near_mm - 1 / far_mm)

    def depths_mm(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `places`."""
        near_mm, far_mm = self.range_mm
        return 1 / (1 / near_mm - places * (1 / near_mm - 1 / far_mm))


def nearest(
    turns: NDArray[np.float64],
    low: NDArray[np.float64] | float,
    high: NDArray[np.float64] | float,
    own: bool = False,
) -> NDArray[np.float64]:
    """Distance in rad from the line ``turns`` x place, place from ``low`` to ``high``, to the
    nearest whole numbers (m, n); with ``own`` (0, 0) counts too. ``turns`` float64 (..., 2),
    ``low`` and ``high`` that broadcast to (...); returns (...)."""
    least = np.full(np.broadcast_shapes(turns.shape[:-1], np.shape(low), np.shape(high)), np.inf)
    for distance, _ in _distances(turns, low, high, own):
        np.minimum(least, distance, out=least)
    return least


def _distances(
    turns: NDArray[np.float64],
    low: NDArray[np.float64] | float,
    high: NDArray[np.float64] | float,
    own: bool,
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Distances in rad from the line, as in `nearest`, to the whole numbers beside it: along the
    axis that grows faster all that the line passes, and across the three next to it; and the places
    on the line that are nearest."""
    steep = np.abs(turns[..., 1]) > np.abs(turns[..., 0])
    fast, slow = (
        np.where(steep, turns[..., 1], turns[..., 0]),
        np.where(steep, turns[..., 0], turns[..., 1]),
    )
    fast, slow = np.abs(fast), np.where(fast < 0, -slow, slow)  # (m, n) and (-m, -n) are alike
    fast = np.maximum(fast, _TINY)
    square, slope, most = fast * fast + slow * slow, slow / fast, float(fast.max())
    start, stop = (
        math.floor(min(float(np.min(low)), 0.0) * most),
        math.ceil(float(np.max(high)) * most),
    )
    for m in range(start - 1, stop + 2):
        middle = np.rint(m * slope)
        for n in (middle - 1, middle, middle + 1):
            place = np.clip((m * fast + n * slow) / np.maximum(square, _TINY), low, high)
            distance = TAU * np.hypot(m - fast * place, n - slow * place)
            yield np.where(n == 0, np.inf, distance) if m == 0 and not own else distance, place


def rival_distance(turns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance in rad of the nearest rival of any depth in the range, for ``turns`` (..., 2): what
    an error of the two phases must cross half of to choose a wrong order."""
    return nearest(turns, 0.0, 1.0)


def background_distance(
    turns: NDArray[np.float64], background: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distance in rad of the background's phases from those of every depth in the range;
    ``background``: its place on the line (`EpipolarLines`), which broadcasts to (...)."""
    return nearest(turns, background - 1.0, background, own=True)


def wrong_orders(
    lines: EpipolarLines,
    turns: NDArray[np.float64],
    sigma: NDArray[np.float64] | float,
    share: float = 1.0,
    surfaces: tuple[float, float] = (0.0, 1.0),
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Expected share of pixels with a wrong order, for ``turns`` (..., 2) on ``lines``, where no
    neighbour helps, and the error in mm that they add to the mean: means over depths at
    ``surfaces`` of the range (places on the line, evenly) and sums over rivals.

    Errors of a single frame's phase are mostly edges, texture and the other carrier, with heavy
    tails: across the line a ``share`` of the pixels has two-sided exponential ones with a standard
    deviation of ``sigma`` rad, (...) or one for all. A rival at distance d is chosen with the
    probability of an error above d / 2, ``share exp(-sqrt(2) d / (2 sigma)) / 2``.
    """
    places = np.linspace(*surfaces, 41)
    true_mm = lines.depths_mm(places)
    line, spread = turns[..., None, :], 2 * np.asarray(sigma, dtype=np.float64)[..., None]
    rate, error_mm = np.zeros((2, *np.broadcast_shapes(line.shape[:-1], places.shape)))
    for distance, away in _distances(line, -places, 1.0 - places, own=False):
        chance = share * np.exp(-math.sqrt(2) * distance / spread) / 2
        rate += chance
        error_mm += chance * np.abs(lines.depths_mm(np.clip(places + away, 0.0, 1.0)) - true_mm)
    return np.minimum(rate, 1.0).mean(axis=-1), error_mm.mean(axis=-1)
