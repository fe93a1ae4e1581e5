"""Decoding a block of pixels: the stages, then a depth or a reason for every pixel."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.code import (
    CLIPPED_STEPS_DIVISOR,
    STAGE_REASONS,
    Code,
    Coordinates,
    Limits,
    Reason,
)
from fpp_ml_bench.coding.gray_code import INCONSISTENT_RAD, cell_centres_rad
from fpp_ml_bench.coding.phase_shift import Fringes, PhaseShift, choose_steps, phase_weights
from fpp_ml_bench.decoding.triangulation import depth_from_both, depth_from_coordinate, geometry
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics.pinhole import Maps
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import AXES, Direction, Sequence

SLACK_PX = 1e-3
"""Allowance for rounding: coordinates and residuals are exact to about 1e-9 px."""


@dataclass(frozen=True)
class CodePlan:
    """What decoding a direction needs besides the grey levels; the same for every pixel. ``rows``
    are the frame indices in the order in which `decode` takes the grey levels. Of the paper's kind
    of code, which has compiled kernels, ``rows`` begins with some of its ``sinusoids``, with their
    ``weights`` (3, N) in mean, cosine and sine."""

    direction: Direction
    code: Code
    length_px: int
    rows: tuple[int, ...]
    sinusoids: tuple[int, ...] = ()
    weights: NDArray[np.float64] = field(default_factory=lambda: np.zeros((3, 0)))
    constant_levels: Mapping[int, int] = field(default_factory=dict)
    """Grey level by frame index of the frames that need not be captured: the same at every pixel
    the camera sees."""

    @property
    def frames(self) -> tuple[int, ...]:
        """Indices of the frames that must be captured and read."""
        return tuple(index for index in self.rows if index not in self.constant_levels)

    @property
    def gray(self) -> tuple[int, ...]:
        return self.rows[len(self.sinusoids) :]

    def decode(self, grey: NDArray, limits: Limits) -> Coordinates:
        """Projector coordinate of a block from its grey levels, uint8 or float32 (rows, n)."""
        if not self.sinusoids or grey.dtype != np.uint8:
            code = self.code
            if isinstance(code, PhaseShift) and not self.gray:
                code = replace(code, gray=None)
            return code.decode(grey, self.length_px, limits)
        from fpp_ml_bench.coding import kernels

        count, steps, pitch_px = (
            grey.shape[1],
            len(self.sinusoids),
            float(self.code.pitch_px or 0.0),
        )
        results = np.empty(count), np.empty(count), np.empty(count), np.empty(count, dtype=np.uint8)
        most = (
            steps // CLIPPED_STEPS_DIVISOR
            if limits.max_clipped_steps is None
            else limits.max_clipped_steps
        )
        thresholds = (
            float(limits.min_modulation),
            float(most),
            float(limits.ambiguous_fraction),
            INCONSISTENT_RAD,
        )
        cells = (
            len(self.gray),
            cell_centres_rad(self.length_px, pitch_px),
            pitch_px,
            float(self.length_px),
        )
        reasons = tuple(float(reason) for reason in STAGE_REASONS)
        kernels.decode_block(grey, self.weights, cells, thresholds, reasons, results)
        return Coordinates(*results)


def plan_direction(rig: Rig, direction: Direction, steps: int | None) -> CodePlan:
    """Plan for a direction with ``steps`` of the rig's sinusoids, all with None. Raises
    `DecodeError` for an impossible number, and for some of the steps of a code of another kind than
    the paper's."""
    code, length, rows = (
        rig.code(direction),
        rig.pattern_length(direction),
        rig.sequence.coded(direction),
    )
    if not isinstance(code, PhaseShift) or not code.is_plain:
        if steps is not None:
            raise DecodeError(
                f"steps: some of the steps can be chosen only with sinusoids of one period in "
                f"equal steps from pixel 0 "
                f"and Gray code in half periods; the {direction} code of this rig is another: "
                f"leave steps out"
            )
        flat = (rig.sequence.black, rig.sequence.white) if code.needs_flat else ()
        return CodePlan(
            direction, code, length, (*rows, *(index for index in flat if index is not None))
        )
    available = rig.sequence.sinusoids(direction)
    chosen = choose_steps(len(available), len(available) if steps is None else steps)
    sinusoids, (fringes,) = tuple(available[i] for i in chosen), code.fringes
    chosen_code = replace(
        code, fringes=(Fringes(code.pitch_px, tuple(fringes.shifts_deg[i] for i in chosen)),)
    )
    weights = phase_weights(2 * np.pi * np.array(chosen) / len(available))
    return CodePlan(
        direction,
        chosen_code,
        length,
        (*sinusoids, *rig.sequence.gray(direction)),
        sinusoids,
        weights,
    )


def depth_and_reason(
    measured: dict[Direction, Coordinates], rays: Maps, rig: Rig, limits: Limits
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Depth in mm, float32 (n,), 0 = none, and reason, uint8 (n,), of a block, from one direction
    or both."""
    reasons = [coordinates.reason for coordinates in measured.values()]
    if len(measured) == 1:
        ((direction, coordinates),) = measured.items()
        reason = coordinates.reason.copy()
        depth_mm = depth_from_coordinate(rays, coordinates.coordinate_px, rig, direction)
    else:
        lower = np.minimum(*reasons)
        reason = np.where(lower == 0, np.maximum(*reasons), lower)
        u, v = (measured[direction].coordinate_px for direction in AXES)
        weights = (_relative_weight(measured[direction], rig, direction) for direction in AXES)
        depth_mm, disagreement_px = depth_from_both(rays, u, v, rig, *weights)
        reason[(reason == 0) & (disagreement_px > limits.max_disagreement_px)] = (
            Reason.DIRECTIONS_DISAGREE
        )
    missing = np.isnan(depth_mm)
    reason[(reason == 0) & ~missing & ~rig.in_range(depth_mm)] = Reason.OUTSIDE_RANGE
    reason[((reason == 0) & missing) | np.isnan(rays[0])] = Reason.NO_RAY
    return np.where(reason == 0, depth_mm, 0.0).astype(np.float32), reason


def _relative_weight(measured: Coordinates, rig: Rig, direction: Direction) -> NDArray[np.float64]:
    """1 / sigma^2 of a coordinate, up to a factor that both directions share."""
    with np.errstate(divide="ignore"):
        if isinstance(rig.sequence, Sequence):
            precision = measured.modulation / rig.pitch(
                direction
            )  # both directions have the same number of steps
        else:
            precision = 1.0 / rig.code(direction).sigma_px(measured.modulation, 1.0)
    precision *= precision
    return precision


def within_reach(
    coordinate_px: NDArray, rays: Maps, direction: Direction, rig: Rig, limits: Limits
) -> NDArray:
    """Pixels that may still get a depth from both directions; bool (n,). For projectors without
    distortion only. ``coordinate_px`` (n,) of ``direction``, ``rays`` the pixels' normalised (x,
    y), (n,) each. Pixels that can't be ruled out are True, those with NaN rays too."""
    from fpp_ml_bench.decoding import kernels

    reached = np.empty(len(coordinate_px), dtype=np.bool_)
    allowance = float(limits.max_disagreement_px), SLACK_PX
    kernels.reach(
        rays, coordinate_px, AXES.index(direction), geometry(rig), rig.range_m, allowance, reached
    )
    return reached
