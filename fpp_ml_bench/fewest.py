"""The fewest frames that a rig's working range needs: phase steps for a noise, Gray bits for the orders that can occur.

A pixel's ray crosses only a few fringe periods within the working range (2.4 and 1.9 with the paper's rig), while the
Gray code tells all periods of the pattern apart. Two ways to need less of it:

- A bit that is the same on every cell the camera can see, at any depth between the near end of the range and the
  background, says nothing (`gray_bits_in_view`). Bits that turn over somewhere in view are all needed by one direction
  alone: without one of them, the cells on either side of its edge are mirror images, and a phase at a cell's edge fits
  both.
- With both directions no bit may be needed at all (`orders_from_phases`): the two fringes' periods along the ray
  differ, and together they are unambiguous over their beat, as in two-frequency unwrapping. For every pair of orders
  that the range allows, the measured (u, v) must lie on the pixel's epipolar line, and a wrong pair misses it by px.

Own derivation.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decode_blocks import MAX_DISAGREEMENT_PX
from fpp_ml_bench.frames import DIRECTIONS, Direction
from fpp_ml_bench.gray_code import binary_to_gray, cell_count, cell_of
from fpp_ml_bench.rig import Rig
from fpp_ml_bench.triangulation import depth_noise_mm

_GRID = 33
"""Rays a side that stand for the image: projections are smooth, and the outermost rays are among them."""
CODE_MARGIN_CELLS = 1
AXES: tuple[Direction, Direction] = ("vertical", "horizontal")
"""The direction that measures the projector's u, and the one that measures its v."""
LEAST_TOLERANCE_PX = 1.0
"""Projector px that noise may put a pixel off its epipolar line; the decoder's worst case (3 steps, least modulation)
has a sigma of 0.5 px, usual pixels have 0.02."""


@dataclass(frozen=True)
class Reach:
    """What the range spans on the projector, over a grid of the image's rays: px at its near and its far end."""

    near_px: dict[Direction, np.ndarray]
    far_px: dict[Direction, np.ndarray]
    background_px: dict[Direction, np.ndarray]


def reach_of(rig: Rig) -> Reach:
    """Projector coordinates of the camera's rays at the ends of the working range and on the background plane; NaN
    where the projector shows nothing."""
    rows = np.linspace(0, rig.camera.height - 1, _GRID).round().astype(int)
    columns = np.linspace(0, rig.camera.width - 1, _GRID).round().astype(int)
    x, y = (axis[np.ix_(rows, columns)].ravel() for axis in rig.camera.rays())

    def seen(depth_m: float) -> dict[Direction, np.ndarray]:
        u, v = rig.project(np.stack([x * depth_m, y * depth_m, np.full_like(x, depth_m)], axis=-1))
        return {"vertical": u, "horizontal": v}

    near_m, far_m = (limit / MM_PER_M for limit in rig.working_range_mm)
    return Reach(seen(near_m), seen(far_m), seen(rig.background_m))


@lru_cache(maxsize=16)
def gray_bits_in_view(rig: Rig, direction: Direction) -> tuple[int, ...]:
    """Gray bits of one direction (0 = most significant frame) that turn over where the camera can see; the others are
    the same on every cell in view, of the working range and of the background."""
    reach, bits = reach_of(rig), rig.sequence.bits(direction)
    seen = np.concatenate([ends[direction] for ends in (reach.near_px, reach.far_px, reach.background_px)])
    seen = seen[np.isfinite(seen)]
    last = cell_count(rig.pattern_length(direction), rig.pitch(direction)) - 1
    if not seen.size:
        return tuple(range(bits))
    low, high = (int(cell_of(edge, rig.pitch(direction))) for edge in (seen.min(), seen.max()))
    cells = np.arange(max(low - CODE_MARGIN_CELLS, 0), min(high + CODE_MARGIN_CELLS, last) + 1)
    code = binary_to_gray(cells if cells.size else np.arange(last + 1))
    return tuple(bit for bit in range(bits) if np.ptp(code >> (bits - 1 - bit) & 1))


@dataclass(frozen=True)
class JointCode:
    """What both directions' phases say together, in projector px across the epipolar line.

    ``least_gap_px``: nearest that a wrong pair of orders comes to a right one within the range; ``background_gap_px``:
    nearest that the background plane comes to looking like something within the range. ``driver``: the direction of
    which a ray crosses more periods within the range, ``most_periods`` at most.
    """

    least_gap_px: float
    background_gap_px: float
    driver: Direction = "vertical"
    most_periods: float = 0.0

    @property
    def tolerance_px(self) -> float:
        """How far from the epipolar line a pixel may lie: half the gap, and never more than the decoder allows."""
        return min(MAX_DISAGREEMENT_PX, self.least_gap_px / 2)

    @property
    def unambiguous(self) -> bool:
        """Whether the phases alone will do: `LEAST_TOLERANCE_PX` for noise, and the background stays out of it."""
        return self.tolerance_px >= LEAST_TOLERANCE_PX and self.background_gap_px > self.tolerance_px


@lru_cache(maxsize=8)
def orders_from_phases(rig: Rig) -> JointCode:
    """How well two wrapped phases alone give the orders of both directions within the working range.

    A wrong pair is i periods off in u and j in v, with (i, j) not (0, 0); both stay within the range's stretch along
    the epipolar line, lengthened by the decoder's tolerance at either end. Its distance from the line is
    ``|i P_u e_v - j P_v e_u|``, e the line's unit direction. Only for projectors without distortion: with it nothing is
    known of curved lines, and both gaps are 0.
    """
    if rig.projector.is_distorted:
        return JointCode(0.0, 0.0)
    reach = reach_of(rig)
    near, far, behind = (
        np.stack([ends["vertical"], ends["horizontal"]]) for ends in (reach.near_px, reach.far_px, reach.background_px)
    )
    line = far - near
    usable = np.isfinite(line).all(axis=0) & np.isfinite(behind).all(axis=0) & (np.hypot(*line) > 0)
    if not usable.any():
        return JointCode(0.0, 0.0)
    near, far, behind, line = near[:, usable], far[:, usable], behind[:, usable], line[:, usable]
    e = line / np.hypot(*line)
    pitch = np.array([[rig.pitch("vertical")], [rig.pitch("horizontal")]])
    span = (np.abs(line) + 2 * MAX_DISAGREEMENT_PX) / pitch
    low = (np.minimum(near, far) - MAX_DISAGREEMENT_PX - behind) / pitch
    high = (np.maximum(near, far) + MAX_DISAGREEMENT_PX - behind) / pitch
    most = int(np.ceil(max(span.max(), np.abs(low).max(), np.abs(high).max())))
    least = {"range": math.inf, "background": math.inf}
    for i in range(-most, most + 1):
        for j in range(-most, most + 1):
            off = np.abs(i * pitch[0] * e[1] - j * pitch[1] * e[0])
            inside = (abs(i) <= span[0]) & (abs(j) <= span[1]) & ((i, j) != (0, 0))
            from_behind = (low[0] <= i) & (i <= high[0]) & (low[1] <= j) & (j <= high[1])
            for name, possible in (("range", inside), ("background", from_behind)):
                if possible.any():
                    least[name] = min(least[name], float(off[possible].min()))
    periods = (np.abs(line) / pitch).max(axis=1)
    driver = AXES[int(periods[1] > periods[0])]
    return JointCode(least["range"], least["background"], driver, float(periods.max()))


def fewest_gray_bits(rig: Rig, direction: Direction | str) -> dict[Direction, tuple[int, ...]]:
    """Gray bits that must be captured for ``direction`` "vertical", "horizontal" or "both", per direction."""
    if direction == "both":
        if orders_from_phases(rig).unambiguous:
            return {"horizontal": (), "vertical": ()}
        return {one: gray_bits_in_view(rig, one) for one in DIRECTIONS}
    one: Direction = "vertical" if direction == "vertical" else "horizontal"
    return {one: gray_bits_in_view(rig, one)}


def fewest_steps(
    rig: Rig, direction: Direction | str, depth_mm_sigma: float, modulation: float, noise_grey: float
) -> int | None:
    """Fewest phase steps at which noise moves depth by no more than ``depth_mm_sigma`` (standard deviation, mm) at the
    far end of the range on the optical axis; None where not even all of the sequence's do.

    ``modulation`` there and ``noise_grey`` in grey levels; see `triangulation.depth_noise_mm`.
    """
    far_mm = rig.working_range_mm[1]
    for steps in range(3, rig.sequence.steps + 1):
        if float(depth_noise_mm(rig, far_mm, direction, steps, modulation, noise_grey)) <= depth_mm_sigma:
            return steps
    return None
