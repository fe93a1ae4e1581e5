"""Decoding a block of pixels: the stages, each compiled or in NumPy, then a depth or a reason for every pixel."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench import optics
from fpp_ml_bench.constants import GREY_LEVELS, MM_PER_M
from fpp_ml_bench.decoding.phase import choose_steps, compiled_kernels, minus_atan2, phase_weights, weighted_sums
from fpp_ml_bench.decoding.triangulation import depth_from_both, depth_from_coordinate
from fpp_ml_bench.optics import AXES, Direction, Maps, Rig

MIN_MODULATION = 5.0
"""Grey levels. At a read noise of 1 grey level and only 3 steps the phase noise is then 0.16 rad: a tenth of the pi/2
that the fringe order tolerates, about 7 mm of depth at 1.8 m. Less means shadow, glare or no projector light."""
CLIPPED_STEPS_DIVISOR = 9
"""A pixel may be saturated in N // 9 of its N steps (2 of 18, none below 9). N steps cancel harmonics up to N - 2, so
that a clipped crest then distorts the phase by under 5 mrad; with few steps it would be tens of mrad."""
MAX_DISAGREEMENT_PX = 1.5
"""Projector px between a pixel's measured (u, v) and its epipolar line. Noise at the least modulation and 3 steps
gives a sigma of 0.5 px; a fringe order that is wrong by 1 shifts an 18 px fringe by more than 10 px."""
SLACK_PX = 1e-3
"""Allowance for rounding: coordinates and residuals are exact to about 1e-9 px."""


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


_STAGE_REASONS = (Reason.LOW_MODULATION, Reason.SATURATED, Reason.INCONSISTENT_ORDER, Reason.OUTSIDE_PATTERN)


@dataclass(frozen=True)
class Limits:
    """Conditions that a decoded pixel meets; the defaults are explained beside their constants."""

    min_modulation: float = MIN_MODULATION
    max_clipped_steps: int | None = None
    max_disagreement_px: float = MAX_DISAGREEMENT_PX
    ambiguous_fraction: float = optics.AMBIGUOUS_FRACTION


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
        direction, sinusoids=tuple(available[i] for i in chosen), gray=tuple(rig.sequence.gray(direction)),
        weights=phase_weights(2 * np.pi * np.array(chosen) / rig.sequence.steps),
        centres_rad=optics.cell_centres_rad(length, pitch), pitch_px=pitch, length_px=length,
        max_clipped_steps=steps // CLIPPED_STEPS_DIVISOR if allowed is None else allowed,
    )  # fmt: skip


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
        return Coordinates(*(values[indices] for values in vars(self).values()))


def geometry(rig: Rig) -> tuple[NDArray, NDArray, tuple[float, float], tuple[float, float]]:
    """The rig as the kernels take it: R, t, and the projector's focal lengths and principal point."""
    return rig.R, rig.t, rig.projector.focal, rig.projector.centre


def range_m(rig: Rig) -> tuple[float, float]:
    """The near and far end of the working range in m."""
    near_mm, far_mm = rig.working_range_mm
    return near_mm / MM_PER_M, far_mm / MM_PER_M


def projected(rays: Maps, depth_m: float, rig: Rig) -> Maps:
    """Projector px (u, v) of the rays' points at ``depth_m``; NaN behind the projector."""
    x, y = rays
    return rig.project(np.stack([x * depth_m, y * depth_m, np.full_like(x, depth_m)], axis=-1))


def decode_direction(grey: NDArray[np.uint8], plan: DirectionPlan, limits: Limits) -> Coordinates:
    """Projector coordinate of a block from its grey levels, uint8 (frames of the plan, n)."""
    steps, count = len(plan.sinusoids), grey.shape[1]
    if kernels := compiled_kernels():
        results = np.empty(count), np.empty(count), np.empty(count), np.empty(count, dtype=np.uint8)
        thresholds = float(limits.min_modulation), float(plan.max_clipped_steps), float(limits.ambiguous_fraction)
        code = len(plan.gray), plan.centres_rad, plan.pitch_px, float(plan.length_px)
        reasons = tuple(float(reason) for reason in _STAGE_REASONS)
        kernels.decode_block(grey, plan.weights, code, (*thresholds, optics.INCONSISTENT_RAD), reasons, results)
        return Coordinates(*results)
    mean, cosine, sine = weighted_sums(grey[:steps], plan.weights)
    modulation = np.sqrt(cosine * cosine + sine * sine)
    phase = minus_atan2(sine, cosine)
    cells, trusted = optics.decode_cells(grey[steps:], mean, modulation, limits.ambiguous_fraction)
    absolute, consistent = optics.absolute_phase(phase, cells, plan.centres_rad)
    coordinate = absolute * (plan.pitch_px / (2 * np.pi))
    faults = (
        modulation < limits.min_modulation,
        (grey[:steps] == GREY_LEVELS).sum(axis=0) > plan.max_clipped_steps,
        ~(trusted & consistent),
        (coordinate < -0.5) | (coordinate > plan.length_px - 0.5),
    )
    reason = np.select(faults, [np.uint8(code) for code in _STAGE_REASONS], np.uint8(0))
    return Coordinates(coordinate, modulation, phase, reason)


def depth_and_reason(
    measured: dict[Direction, Coordinates], rays: Maps, rig: Rig, limits: Limits
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Depth in mm, float32 (n,), 0 = none, and reason, uint8 (n,), of a block, from one direction or both."""
    reasons = [coordinates.reason for coordinates in measured.values()]
    kernels = None if rig.projector.is_distorted else compiled_kernels()
    depth_mm = np.empty(len(reasons[0]))
    if len(measured) == 1:
        ((direction, coordinates),) = measured.items()
        reason, coordinate_px = coordinates.reason.copy(), coordinates.coordinate_px
        if kernels:
            kernels.depth_from_coordinate(rays, coordinate_px, AXES.index(direction), geometry(rig), depth_mm)
        else:
            depth_mm = depth_from_coordinate(rays, coordinate_px, rig, direction)
    else:
        lower = np.minimum(*reasons)
        reason = np.where(lower == 0, np.maximum(*reasons), lower)
        u, v = (measured[direction].coordinate_px for direction in AXES)
        # 1 / sigma is proportional to modulation over pitch: both directions have the same number of steps.
        weights = tuple(measured[direction].modulation / rig.pitch(direction) for direction in AXES)
        disagreement_px = np.empty(len(reason))
        if kernels:
            kernels.depth_from_both(rays, (u, v), weights, geometry(rig), (depth_mm, disagreement_px))
        else:
            depth_mm, disagreement_px = depth_from_both(rays, u, v, rig, *(weight * weight for weight in weights))
        reason[(reason == 0) & (disagreement_px > limits.max_disagreement_px)] = Reason.DIRECTIONS_DISAGREE
    near, far = rig.working_range_mm
    missing = np.isnan(depth_mm)
    with np.errstate(invalid="ignore"):
        outside = ~missing & ((depth_mm < near) | (depth_mm > far))
    reason[(reason == 0) & outside] = Reason.OUTSIDE_RANGE
    reason[((reason == 0) & missing) | np.isnan(rays[0])] = Reason.NO_RAY
    return np.where(reason == 0, depth_mm, 0.0).astype(np.float32), reason


def within_reach(coordinate_px: NDArray, rays: Maps, direction: Direction, rig: Rig, limits: Limits) -> NDArray:
    """Pixels that may still get a depth from both directions; bool (n,). For projectors without distortion only.
    ``coordinate_px`` (n,) of ``direction``, ``rays`` the pixels' normalised (x, y), (n,) each. Pixels that can't be
    ruled out are True, those with NaN rays too."""
    axis = AXES.index(direction)
    if kernels := compiled_kernels():
        reached = np.empty(len(coordinate_px), dtype=np.bool_)
        allowance = float(limits.max_disagreement_px), SLACK_PX
        kernels.reach(rays, coordinate_px, axis, geometry(rig), range_m(rig), allowance, reached)
        return reached
    with np.errstate(all="ignore"):
        near_px, far_px = (projected(rays, depth_m, rig) for depth_m in range_m(rig))
        along, across = (far_px[i] - near_px[i] for i in (axis, 1 - axis))
        margin = limits.max_disagreement_px * np.sqrt(along * along + across * across) / np.abs(across) + SLACK_PX
        low = np.minimum(near_px[axis], far_px[axis]) - margin
        high = np.maximum(near_px[axis], far_px[axis]) + margin
        return ~((coordinate_px < low) | (coordinate_px > high))
