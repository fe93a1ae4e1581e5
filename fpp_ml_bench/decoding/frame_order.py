"""Frames in a wrong place: which two, exchanged, would make a capture decodable."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding import MIN_MODULATION, Limits, Reason, phase_weights, weighted_sums
from fpp_ml_bench.decoding.blocks import plan_direction
from fpp_ml_bench.optics import Direction, Rig

POOR, GOOD, FEWER = 0.8, 0.9, 3.0
"""Shares of the lit pixels that get a coordinate: below the first something may be wrong (where a phase is mirrored,
two thirds still fit some order), above the second it is right, if so many times fewer pixels are left without one."""
LARGEST_MISFIT = 0.2
"""Largest RMS distance of grey levels from their sinusoid, in modulations, where four steps and more tell."""
_LOOKED_AT_PX = 200_000
_SAMPLED_PX, _LEAST_PX, _LEAST_LIT_GREY = 4000, 200, 4 * MIN_MODULATION


def exchanged_frames(frames: Sequence[NDArray], rig: Rig) -> tuple[int, int] | None:
    """Indices of two frames that seem to have changed places: as they are, fewer than `POOR` of the lit pixels fit the
    code, and exchanged more than `GOOD` do. None where the frames fit, or where no exchange of two makes them."""
    flat = [np.asarray(frame).reshape(-1) for frame in frames]
    levels = np.stack([frame[:: max(frame.size // _LOOKED_AT_PX, 1)] for frame in flat])
    lit = np.flatnonzero(np.ptp(levels, axis=0) >= _LEAST_LIT_GREY)
    if len(lit) < _LEAST_PX:
        return None
    levels = levels[:, lit[:: -(-len(lit) // _SAMPLED_PX)]]
    shares = {direction: _share(levels, rig, direction) for direction in rig.directions}
    if min(shares.values()) >= POOR:
        return None
    poor = [direction for direction, share in shares.items() if share < POOR]
    involved = {index for direction in poor for index in plan_direction(rig, direction, None, Limits()).rows}
    best, pair = max(GOOD, 1 - (1 - min(shares.values())) / FEWER), None
    for first, second in combinations(range(len(frames)), 2):
        if not involved & {first, second}:
            continue
        exchanged = levels.copy()
        exchanged[[first, second]] = levels[[second, first]]
        share = min(_share(exchanged, rig, direction) for direction in rig.directions)
        if share > best:
            best, pair = share, (first, second)
    return pair


def _share(levels: NDArray, rig: Rig, direction: Direction) -> float:
    """Share of the pixels with modulation that fit the direction's code; 0 where few have any."""
    plan = plan_direction(rig, direction, None, Limits())
    reason = plan.decode(levels[list(plan.rows)], Limits()).reason
    lit, fits = reason != Reason.LOW_MODULATION, reason == Reason.DECODED
    for name, indices, turns in rig.sequence.equal_steps():
        if name == direction and len(turns) > 3:
            sinusoids, angles = levels[list(indices)].astype(np.float64), 2 * np.pi * turns[:, None]
            mean, cosine, sine = weighted_sums(sinusoids, phase_weights(angles[:, 0]))
            misfit = sinusoids - mean - cosine * np.cos(angles) - sine * np.sin(angles)
            fits &= (misfit**2).mean(axis=0) <= LARGEST_MISFIT**2 * (cosine**2 + sine**2)
    return float(fits[lit].mean()) if lit.sum() >= len(reason) / 4 else 0.0
