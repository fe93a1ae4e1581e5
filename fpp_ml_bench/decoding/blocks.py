"""Decoding a block of pixels: the stages, each compiled or in NumPy, then a depth or a reason for every pixel.

`fpp_ml_bench.decoding` cuts the image into blocks that fit the processor's cache and calls `decode_direction` and
`depth_and_reason` here.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import GREY_LEVELS, MM_PER_M
from fpp_ml_bench.decoding.phase import choose_steps, minus_atan2, phase_weights, weighted_sums
from fpp_ml_bench.decoding.triangulation import depth_from_both, depth_from_coordinate, rotated_ray
from fpp_ml_bench.machine import numba_enabled
from fpp_ml_bench.optics import (
    AMBIGUOUS_FRACTION,
    INCONSISTENT_RAD,
    Direction,
    Maps,
    Rig,
    absolute_phase,
    cell_centres_rad,
    decode_cells,
)

MIN_MODULATION = 5.0
"""Grey levels. At a read noise of 1 grey level and only 3 steps the phase noise is then 0.16 rad: a tenth of the pi/2
that the fringe order tolerates, and about 7 mm of depth at 1.8 m. A smaller modulation means shadow, glare or no
projector light."""
CLIPPED_STEPS_DIVISOR = 9
"""A pixel may be saturated in N // 9 of its N steps (2 of 18, none below 9). With so many steps a clipped crest
distorts the phase by under 5 mrad, since N steps cancel harmonics up to N - 2; with few steps it would bias it by tens
of mrad."""
MAX_DISAGREEMENT_PX = 1.5
"""Projector px between a pixel's measured (u, v) and its epipolar line. Noise at the least modulation and 3 steps
gives a sigma of 0.5 px; a fringe order that is wrong by 1 shifts an 18 px fringe by more than 10 px."""


class Reason(IntEnum):
    """Why a pixel has no depth. Where several reasons apply, the lowest code is stored.

    NO_RAY: the camera's lens model has no inverse at this pixel, or the ray does not meet the measured projector plane
    in front of both devices. NOT_ASKED: the pixel is outside the mask.
    """

    DECODED = 0
    NO_RAY = 1
    LOW_MODULATION = 2
    SATURATED = 3
    INCONSISTENT_ORDER = 4
    OUTSIDE_PATTERN = 5
    DIRECTIONS_DISAGREE = 6
    OUTSIDE_RANGE = 7
    NOT_ASKED = 8


@dataclass(frozen=True)
class Limits:
    """Conditions that a decoded pixel meets; the defaults are explained beside their constants."""

    min_modulation: float = MIN_MODULATION
    max_clipped_steps: int | None = None
    max_disagreement_px: float = MAX_DISAGREEMENT_PX
    ambiguous_fraction: float = AMBIGUOUS_FRACTION


@dataclass(frozen=True)
class DirectionPlan:
    """What decoding a direction needs besides the grey levels; the same for every pixel."""

    direction: Direction
    sinusoids: tuple[int, ...]
    gray: tuple[int, ...]
    weights: NDArray[np.float64]
    centres_rad: NDArray[np.float64]
    pitch_px: float
    length_px: int
    max_clipped_steps: int
    constant_levels: Mapping[int, int] = field(default_factory=dict)
    """Grey level by frame index of the frames that need not be captured: the same at every pixel the camera sees."""

    @property
    def rows(self) -> tuple[int, ...]:
        """Frame indices in the order in which `decode_direction` takes the grey levels."""
        return self.sinusoids + self.gray

    @property
    def frames(self) -> tuple[int, ...]:
        """Indices of the frames that must be captured and read."""
        return tuple(index for index in self.rows if index not in self.constant_levels)


def plan_direction(rig: Rig, direction: Direction, steps: int, limits: Limits) -> DirectionPlan:
    """Plan for a direction with ``steps`` of the rig's sinusoids; raises `DecodeError` for an impossible number."""
    chosen = choose_steps(rig.sequence.steps, steps)
    available = rig.sequence.sinusoids(direction)
    pitch, length = rig.pitch(direction), rig.pattern_length(direction)
    allowed = limits.max_clipped_steps
    return DirectionPlan(
        direction=direction,
        sinusoids=tuple(available[i] for i in chosen),
        gray=tuple(rig.sequence.gray(direction)),
        weights=phase_weights(2 * np.pi * np.array(chosen) / rig.sequence.steps),
        centres_rad=cell_centres_rad(length, pitch),
        pitch_px=pitch,
        length_px=length,
        max_clipped_steps=steps // CLIPPED_STEPS_DIVISOR if allowed is None else allowed,
    )


@dataclass(frozen=True)
class Coordinates:
    """A block's measurement in one direction: coordinate (px), modulation (grey levels) and phase (rad), float64 (n,)
    each, and the reason codes, uint8 (n,)."""

    coordinate_px: NDArray[np.float64]
    modulation: NDArray[np.float64]
    phase: NDArray[np.float64]
    reason: NDArray[np.uint8]

    def at(self, indices: NDArray[np.intp]) -> "Coordinates":
        """The coordinates of the pixels at ``indices`` only."""
        return Coordinates(
            self.coordinate_px[indices], self.modulation[indices], self.phase[indices], self.reason[indices]
        )


_STAGE_REASONS = (
    Reason.LOW_MODULATION,
    Reason.SATURATED,
    Reason.INCONSISTENT_ORDER,
    Reason.OUTSIDE_PATTERN,
)


def decode_direction(grey: NDArray[np.uint8], plan: DirectionPlan, limits: Limits) -> Coordinates:
    """Projector coordinate of a block from its grey levels, uint8 (frames of the plan, n)."""
    if numba_enabled():
        from fpp_ml_bench.decoding.kernels import decode_block

        count = grey.shape[1]
        coordinates = Coordinates(np.empty(count), np.empty(count), np.empty(count), np.empty(count, dtype=np.uint8))
        thresholds = (
            float(limits.min_modulation),
            float(plan.max_clipped_steps),
            float(limits.ambiguous_fraction),
            INCONSISTENT_RAD,
        )
        codes = tuple(float(code) for code in _STAGE_REASONS)
        decode_block(
            grey, plan.weights, len(plan.gray), plan.centres_rad, plan.pitch_px, float(plan.length_px), thresholds,
            codes, coordinates.coordinate_px, coordinates.modulation, coordinates.phase, coordinates.reason,
        )  # fmt: skip
        return coordinates
    steps = len(plan.sinusoids)
    mean, cosine, sine = weighted_sums(grey[:steps], plan.weights)
    modulation = np.sqrt(cosine * cosine + sine * sine)
    phase = minus_atan2(sine, cosine)
    cells, trusted = decode_cells(grey[steps:], mean, modulation, limits.ambiguous_fraction)
    absolute, consistent = absolute_phase(phase, cells, plan.centres_rad)
    coordinate = absolute * (plan.pitch_px / (2 * np.pi))
    clipped = (grey[:steps] == GREY_LEVELS).sum(axis=0)
    faults = (
        modulation < limits.min_modulation,
        clipped > plan.max_clipped_steps,
        ~(trusted & consistent),
        (coordinate < -0.5) | (coordinate > plan.length_px - 0.5),
    )
    reason = np.zeros(grey.shape[1], dtype=np.uint8)
    for code, fault in reversed(list(zip(_STAGE_REASONS, faults, strict=True))):
        reason[fault] = code
    return Coordinates(coordinate, modulation, phase, reason)


def _depth_from_coordinate(rays: Maps, coordinates: Coordinates, plan: DirectionPlan, rig: Rig) -> NDArray[np.float64]:
    if rig.projector.is_distorted or not numba_enabled():
        return depth_from_coordinate(rays, coordinates.coordinate_px, rig, plan.direction)
    from fpp_ml_bench.decoding.kernels import depth_from_coordinate_kernel

    device, depth_mm = rig.projector, np.empty(len(coordinates.reason))
    axis = 0 if plan.direction == "vertical" else 1
    focal, centre = (device.fx, device.fy)[axis], (device.cx, device.cy)[axis]
    depth_from_coordinate_kernel(*rays, coordinates.coordinate_px, rig.R, rig.t, axis, focal, centre, depth_mm)
    return depth_mm


def _depth_from_both(
    rays: Maps, coordinates: dict[Direction, Coordinates], rig: Rig
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    u, v = coordinates["vertical"], coordinates["horizontal"]
    # 1 / sigma is proportional to modulation over pitch: both directions have the same number of steps.
    weight_u, weight_v = u.modulation / rig.pitch("vertical"), v.modulation / rig.pitch("horizontal")
    if rig.projector.is_distorted or not numba_enabled():
        squared = weight_u * weight_u, weight_v * weight_v
        return depth_from_both(rays, u.coordinate_px, v.coordinate_px, rig, *squared)
    from fpp_ml_bench.decoding.kernels import depth_from_both_kernel

    device, depth_mm, disagreement = rig.projector, np.empty(len(u.reason)), np.empty(len(u.reason))
    focal, centre = (device.fx, device.fy), (device.cx, device.cy)
    depth_from_both_kernel(
        *rays, u.coordinate_px, v.coordinate_px, weight_u, weight_v, rig.R, rig.t, focal, centre, depth_mm, disagreement
    )
    return depth_mm, disagreement


def depth_and_reason(
    coordinates: dict[Direction, Coordinates], rays: Maps, plans: list[DirectionPlan], rig: Rig, limits: Limits
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Depth in mm, float32 (n,), 0 = none, and reason, uint8 (n,), of a block, from the coordinates by direction."""
    first = coordinates[plans[0].direction]
    if len(plans) == 1:
        reason = first.reason.copy()
        depth_mm = _depth_from_coordinate(rays, first, plans[0], rig)
    else:
        second = coordinates[plans[1].direction]
        lower, upper = np.minimum(first.reason, second.reason), np.maximum(first.reason, second.reason)
        reason = np.where(lower == 0, upper, lower)
        depth_mm, disagreement = _depth_from_both(rays, coordinates, rig)
        reason[(reason == 0) & (disagreement > limits.max_disagreement_px)] = Reason.DIRECTIONS_DISAGREE
    near, far = rig.working_range_mm
    missing = np.isnan(depth_mm)
    with np.errstate(invalid="ignore"):
        outside = ~missing & ((depth_mm < near) | (depth_mm > far))
    reason[(reason == 0) & outside] = Reason.OUTSIDE_RANGE
    reason[((reason == 0) & missing) | np.isnan(rays[0])] = Reason.NO_RAY
    return np.where(reason == 0, depth_mm, 0.0).astype(np.float32), reason


SLACK_PX = 1e-3
"""Allowance for rounding: coordinates and residuals are exact to about 1e-9 px."""


def reach_is_bounded(rig: Rig) -> bool:
    """Whether `within_reach` can rule pixels out: the bound holds for projectors without distortion."""
    return not rig.projector.is_distorted


def within_reach(
    coordinate_px: NDArray[np.float64], rays: Maps, plan: DirectionPlan, rig: Rig, limits: Limits
) -> NDArray[np.bool_]:
    """Pixels that may still get a depth from both directions; bool (n,).

    ``coordinate_px`` (n,) of the direction of ``plan``, ``rays`` the pixels' normalised (x, y), (n,) each. Pixels that
    can't be ruled out are True, those with NaN rays too.
    """
    axis = 0 if plan.direction == "vertical" else 1
    near_m, far_m = (limit / MM_PER_M for limit in rig.working_range_mm)
    if numba_enabled():
        from fpp_ml_bench.decoding.kernels import reach

        device, reached = rig.projector, np.empty(len(coordinate_px), dtype=np.bool_)
        reach(
            *rays, coordinate_px, rig.R, rig.t, axis, (device.fx, device.fy), (device.cx, device.cy), (near_m, far_m),
            float(limits.max_disagreement_px), SLACK_PX, reached,
        )  # fmt: skip
        return reached
    rotated = [rotated_ray(rays, rig, i) for i in range(3)]
    with np.errstate(all="ignore"):
        projections = [_projected(rotated, depth_m, rig) for depth_m in (near_m, far_m)]
        along, across = (projections[1][i] - projections[0][i] for i in (axis, 1 - axis))
        margin = limits.max_disagreement_px * np.sqrt(along * along + across * across) / np.abs(across) + SLACK_PX
        low = np.minimum(projections[0][axis], projections[1][axis]) - margin
        high = np.maximum(projections[0][axis], projections[1][axis]) + margin
        ahead = (near_m * rotated[2] + rig.t[2] > 0) & (far_m * rotated[2] + rig.t[2] > 0)
        return ~(((coordinate_px < low) | (coordinate_px > high)) & ahead)


def _projected(rotated: list[NDArray[np.float64]], depth_m: float, rig: Rig) -> list[NDArray[np.float64]]:
    """Projector px (u, v) of the rays' points at depth ``depth_m``."""
    device, forward = rig.projector, depth_m * rotated[2] + rig.t[2]
    return [
        focal * (depth_m * rotated[i] + rig.t[i]) / forward + centre
        for i, (focal, centre) in enumerate(((device.fx, device.cx), (device.fy, device.cy)))
    ]
