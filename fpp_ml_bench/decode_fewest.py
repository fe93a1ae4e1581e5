"""Decoding with the fewest Gray frames: constant bits are filled in, or both phases together give the fringe orders.

`fpp_ml_bench.fewest` works out which frames a rig's working range needs; the decoder's share of the work is here.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.acceleration import numba_enabled
from fpp_ml_bench.constants import GREY_LEVELS, MM_PER_M
from fpp_ml_bench.decode_blocks import Coordinates, DirectionPlan, Limits, Reason, decode_direction
from fpp_ml_bench.fewest import AXES, JointCode, gray_bits_in_view, orders_from_phases, reach_of
from fpp_ml_bench.frames import Direction
from fpp_ml_bench.gray_code import binary_to_gray, cell_of
from fpp_ml_bench.pinhole import Maps
from fpp_ml_bench.rig import Rig


def fewest_plans(rig: Rig, plans: list[DirectionPlan]) -> tuple[list[DirectionPlan], JointCode | None]:
    """The plans with only the Gray frames that the working range needs, and the joint code if it replaces them all."""
    joint = orders_from_phases(rig) if len(plans) == 2 else None
    if joint is not None and joint.unambiguous:
        return [replace(plan, gray=()) for plan in plans], joint
    return [replace(plan, constant_levels=_constant_levels(rig, plan)) for plan in plans], None


def _constant_levels(rig: Rig, plan: DirectionPlan) -> dict[int, int]:
    """Grey level of each Gray frame that is the same on every cell in view, by frame index."""
    needed = gray_bits_in_view(rig, plan.direction)
    reach = reach_of(rig).near_px[plan.direction]
    in_view = reach[np.isfinite(reach)]
    if not in_view.size:
        return {}
    last = plan.length_px - 1
    code = int(binary_to_gray(cell_of(np.clip(in_view[0], 0, last), plan.pitch_px)))
    bits = len(plan.gray)
    return {
        frame: (code >> (bits - 1 - bit) & 1) * GREY_LEVELS for bit, frame in enumerate(plan.gray) if bit not in needed
    }


def decode_wrapped(grey: NDArray[np.uint8], plan: DirectionPlan, limits: Limits) -> Coordinates:
    """Phase and modulation of a block without Gray frames; reasons that depend on a fringe order are cleared."""
    coordinates = decode_direction(grey, plan, limits)
    order_faults = (coordinates.reason == Reason.INCONSISTENT_ORDER) | (coordinates.reason == Reason.OUTSIDE_PATTERN)
    coordinates.reason[order_faults] = 0
    return coordinates


def nearest_pair(
    coordinates: dict[Direction, Coordinates], rays: Maps, rig: Rig, tolerance_px: float
) -> tuple[dict[Direction, NDArray[np.float64]], NDArray[np.float64]]:
    """The pair of fringe orders that lies nearest to the epipolar line, for every pixel.

    Returns the orders of each direction, whole numbers as float64 (n,), and the pair's distance from the line in
    projector px, inf where no order lies in the range.
    """
    joint = orders_from_phases(rig)
    a, b = (0, 1) if joint.driver == "vertical" else (1, 0)
    first, second = coordinates[AXES[a]].phase, coordinates[AXES[b]].phase
    pitches = rig.pitch(AXES[a]), rig.pitch(AXES[b])
    near_m, far_m = (limit / MM_PER_M for limit in rig.working_range_mm)
    tries = math.ceil(joint.most_periods + 2 * tolerance_px / pitches[0]) + 1
    order_a, order_b = np.zeros(first.shape), np.zeros(first.shape)
    nearest = np.full(first.shape, np.inf)
    if numba_enabled():
        from fpp_ml_bench.decode_kernels import joint_orders

        device = rig.projector
        joint_orders(
            *rays, first, second, rig.R, rig.t, a, (device.fx, device.fy), (device.cx, device.cy), (near_m, far_m),
            pitches, tolerance_px, tries, order_a, order_b, nearest,
        )  # fmt: skip
        return {AXES[a]: order_a, AXES[b]: order_b}, nearest
    x, y = rays
    near, far = (rig.project(np.stack([x * z, y * z, np.full_like(x, z)], axis=-1)) for z in (near_m, far_m))
    with np.errstate(all="ignore"):
        line = far[0] - near[0], far[1] - near[1]
        slope, share = line[b] / line[a], np.abs(line[a]) / np.hypot(*line)
        low, high = np.minimum(near[a], far[a]) - tolerance_px, np.maximum(near[a], far[a]) + tolerance_px
        start = np.ceil(low / pitches[0] - first / (2 * np.pi))
        for step in range(tries):
            first_order = start + step
            position_px = (first + 2 * np.pi * first_order) * (pitches[0] / (2 * np.pi))
            predicted = near[b] + (position_px - near[a]) * slope
            second_order = np.floor(predicted / pitches[1] - second / (2 * np.pi) + 0.5)
            distance_px = np.abs((second + 2 * np.pi * second_order) * (pitches[1] / (2 * np.pi)) - predicted) * share
            better = (distance_px < nearest) & (position_px <= high)
            nearest[better], order_a[better], order_b[better] = (
                distance_px[better],
                first_order[better],
                second_order[better],
            )
    return {AXES[a]: order_a, AXES[b]: order_b}, nearest


def with_order(coordinates: Coordinates, order: NDArray[np.float64], rig: Rig, direction: Direction) -> Coordinates:
    """Coordinates of a direction from its wrapped phase and its fringe orders (n,), as with Gray code."""
    absolute = coordinates.phase + 2 * np.pi * order
    coordinate = absolute * (rig.pitch(direction) / (2 * np.pi))
    reason = coordinates.reason.copy()
    outside = (coordinate < -0.5) | (coordinate > rig.pattern_length(direction) - 0.5)
    reason[(reason == 0) & outside] = Reason.OUTSIDE_PATTERN
    return Coordinates(coordinate, coordinates.modulation, coordinates.phase, reason)
