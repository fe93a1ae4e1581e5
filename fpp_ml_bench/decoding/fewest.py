"""The fewest frames that a rig's working range needs: phase steps for a noise, Gray bits for the
orders that can occur.

A ray crosses few fringe periods within the range, but the Gray code tells all apart. A bit that is
the same on every cell in view can be left out (`gray_levels_in_view`); no other can, as a phase at
the edge of a cell where a bit changes fits two cells without it. With both directions often no bit
is needed (`orders_from_phases`): as in two-frequency unwrapping the two periods are unambiguous
over their beat, and only the right pair of orders lies on the epipolar line.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.code import MAX_DISAGREEMENT_PX, Coordinates, Limits, Reason
from fpp_ml_bench.coding.gray_code import binary_to_gray, cell_count, cell_of
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.decoding.blocks import CodePlan
from fpp_ml_bench.decoding.triangulation import depth_noise_mm, geometry
from fpp_ml_bench.optics.pinhole import Maps
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import AXES, Direction

_GRID = 33
"""Rays per image side that represent the image: projections are smooth, and the outermost rays are
included."""
CODE_MARGIN_CELLS = 1
"""Gray cells that are added on both sides of what is in view, since noise may move a pixel into the
next one."""
LEAST_TOLERANCE_PX = 1.0
"""Distance in projector px that noise may move a pixel off its epipolar line. The decoder's worst
case (3 steps, least modulation) has a sigma of 0.5 px, usual pixels have 0.02 px."""


def reach_of(rig: Rig) -> NDArray[np.float64]:
    """Projector px of a grid of the camera's rays at the near and far end of the range and on the
    background plane (at the far end where none is known), (3, 2 `AXES`, n); NaN outside the
    projector's view."""
    rows = np.linspace(0, rig.camera.height - 1, _GRID).round().astype(int)
    columns = np.linspace(0, rig.camera.width - 1, _GRID).round().astype(int)
    x, y = (axis[np.ix_(rows, columns)].ravel() for axis in rig.camera.rays())
    near_m, far_m = rig.range_m
    background_m = far_m if rig.background_m is None else rig.background_m
    return np.array([rig.seen((x, y), depth_m) for depth_m in (near_m, far_m, background_m)])


@lru_cache(maxsize=16)
def gray_levels_in_view(rig: Rig, direction: Direction) -> tuple[int | None, ...]:
    """Grey level of each Gray bit (0 = most significant) that is the same everywhere in the
    camera's view, at any depth in the range and on the background; None for a bit that changes."""
    in_view, bits = reach_of(rig)[:, AXES.index(direction)], len(rig.sequence.gray(direction))
    in_view = in_view[np.isfinite(in_view)]
    if not in_view.size:
        return (None,) * bits
    last = cell_count(rig.pattern_length(direction), rig.pitch(direction)) - 1
    low, high = (
        int(cell_of(edge, rig.pitch(direction))) for edge in (in_view.min(), in_view.max())
    )
    cells = np.arange(max(low - CODE_MARGIN_CELLS, 0), min(high + CODE_MARGIN_CELLS, last) + 1)
    code = binary_to_gray(cells if cells.size else np.arange(last + 1))
    values = (code >> shift & 1 for shift in reversed(range(bits)))
    return tuple(None if np.ptp(value) else int(value[0]) * GREY_LEVELS for value in values)


@dataclass(frozen=True)
class JointCode:
    """How well both directions' phases together fix the orders, in projector px across the epipolar
    line. ``least_gap_px``: smallest distance of a wrong pair of orders from the right one;
    ``background_gap_px``: smallest at which the background could pass for a point in range.
    ``driver``: the direction of which a ray crosses more periods within the range, ``most_periods``
    at most."""

    least_gap_px: float
    background_gap_px: float
    driver: Direction = "vertical"
    most_periods: float = 0.0

    @property
    def tolerance_px(self) -> float:
        """Largest accepted distance from the epipolar line: half the gap, and never more than the
        decoder allows."""
        return min(MAX_DISAGREEMENT_PX, self.least_gap_px / 2)

    @property
    def unambiguous(self) -> bool:
        """Whether the phases alone suffice: `LEAST_TOLERANCE_PX` left for noise, and clear of the
        background."""
        return (
            self.tolerance_px >= LEAST_TOLERANCE_PX and self.background_gap_px > self.tolerance_px
        )


@lru_cache(maxsize=8)
def orders_from_phases(rig: Rig) -> JointCode:
    """How well two wrapped phases alone give the orders of both directions within the working
    range. A wrong pair is i periods off in u and j in v, not both 0, within the segment that the
    range and the decoder's tolerance cover on the epipolar line. Its distance from the line is ``|i
    P_u e_v - j P_v e_u|``, e the line's unit direction. Own derivation; a distorted projector's
    epipolar lines are not straight, and both gaps are 0."""
    near, far, background = reach_of(rig)
    line = far - near
    usable = (
        np.isfinite(line).all(axis=0) & np.isfinite(background).all(axis=0) & (np.hypot(*line) > 0)
    )
    if rig.projector.is_distorted or not usable.any():
        return JointCode(0.0, 0.0)
    near, far, background, line = (part[:, usable] for part in (near, far, background, line))
    e = line / np.hypot(*line)
    pitch = np.array([[rig.pitch(direction)] for direction in AXES])
    span = (np.abs(line) + 2 * MAX_DISAGREEMENT_PX) / pitch
    low = (np.minimum(near, far) - MAX_DISAGREEMENT_PX - background) / pitch
    high = (np.maximum(near, far) + MAX_DISAGREEMENT_PX - background) / pitch
    most_orders = int(np.ceil(max(span.max(), np.abs(low).max(), np.abs(high).max())))
    range_gap = background_gap = math.inf
    for i, j in product(range(-most_orders, most_orders + 1), repeat=2):
        distance_px = np.abs(i * pitch[0] * e[1] - j * pitch[1] * e[0])
        if (i, j) != (0, 0):
            inside = (abs(i) <= span[0]) & (abs(j) <= span[1])
            range_gap = distance_px.min(where=inside, initial=range_gap)
        on_background = (low[0] <= i) & (i <= high[0]) & (low[1] <= j) & (j <= high[1])
        background_gap = distance_px.min(where=on_background, initial=background_gap)
    periods = (np.abs(line) / pitch).max(axis=1)
    driver = AXES[int(periods[1] > periods[0])]
    return JointCode(float(range_gap), float(background_gap), driver, float(periods.max()))


def fewest_steps(
    rig: Rig,
    direction: Direction | str,
    depth_mm_sigma: float,
    modulation: float,
    noise_grey: float,
) -> int | None:
    """Fewest phase steps with which noise moves depth by at most ``depth_mm_sigma`` (standard
    deviation, mm) at the far end of the range on the optical axis; None where all steps of the
    sequence are too few. ``modulation`` at that depth and ``noise_grey`` in grey levels; see
    `triangulation.depth_noise_mm`."""
    far_mm = rig.working_range_mm[1]
    for steps in range(3, rig.sequence.steps + 1):
        if (
            float(depth_noise_mm(rig, far_mm, direction, steps, modulation, noise_grey))
            <= depth_mm_sigma
        ):
            return steps
    return None


def fewest_plans(rig: Rig, plans: list[CodePlan]) -> tuple[list[CodePlan], JointCode | None]:
    """The plans with only the Gray frames that the working range needs, and the joint code if it
    replaces them all; those of codes that are not the paper's kind as they are."""
    joint = (
        orders_from_phases(rig)
        if len(plans) == 2 and all(plan.sinusoids for plan in plans)
        else None
    )
    if joint is not None and joint.unambiguous:
        return [replace(plan, rows=plan.sinusoids) for plan in plans], joint
    fewer: list[CodePlan] = []
    for plan in plans:
        levels = gray_levels_in_view(rig, plan.direction) if plan.sinusoids else ()
        same = {
            frame: level
            for frame, level in zip(plan.gray, levels, strict=False)
            if level is not None
        }
        fewer.append(replace(plan, constant_levels=same))
    return fewer, None


def decode_wrapped(grey: NDArray[np.uint8], plan: CodePlan, limits: Limits) -> Coordinates:
    """Phase and modulation of a block without Gray frames; reasons that depend on a fringe order
    are cleared."""
    coordinates = plan.decode(grey, limits)
    reason = coordinates.reason
    reason[(reason == Reason.INCONSISTENT_ORDER) | (reason == Reason.OUTSIDE_PATTERN)] = 0
    return coordinates


def nearest_pair(
    measured: dict[Direction, Coordinates], rays: Maps, rig: Rig, joint: JointCode
) -> tuple[dict[Direction, NDArray[np.float64]], NDArray[np.float64]]:
    """The pair of fringe orders that lies nearest to the epipolar line, for every pixel. Returns
    the orders of each direction, whole numbers as float64 (n,), and the pair's distance from the
    line in projector px, inf where no order lies in the range."""
    from fpp_ml_bench.decoding import kernels

    a = AXES.index(joint.driver)
    b, tolerance_px = 1 - a, joint.tolerance_px
    first, second = measured[AXES[a]].phase, measured[AXES[b]].phase
    pitches = rig.pitch(AXES[a]), rig.pitch(AXES[b])
    tries = math.ceil(joint.most_periods + 2 * tolerance_px / pitches[0]) + 1
    order_a, order_b, nearest = (
        np.zeros(first.shape),
        np.zeros(first.shape),
        np.full(first.shape, np.inf),
    )
    orders = {AXES[a]: order_a, AXES[b]: order_b}
    results, search = (order_a, order_b, nearest), (tolerance_px, tries)
    kernels.joint_orders(
        rays, (first, second), a, geometry(rig), rig.range_m, pitches, search, results
    )
    return orders, nearest


def with_order(
    coordinates: Coordinates, order: NDArray[np.float64], rig: Rig, direction: Direction
) -> Coordinates:
    """Coordinates of a direction from its wrapped phase and its fringe orders (n,), as with Gray
    code."""
    coordinate = (coordinates.phase + 2 * np.pi * order) * (rig.pitch(direction) / (2 * np.pi))
    reason = coordinates.reason.copy()
    outside = (coordinate < -0.5) | (coordinate > rig.pattern_length(direction) - 0.5)
    reason[(reason == 0) & outside] = Reason.OUTSIDE_PATTERN
    return Coordinates(coordinate, coordinates.modulation, coordinates.phase, reason)
