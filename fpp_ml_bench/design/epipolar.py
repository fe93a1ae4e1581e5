"""What a rig shows to two carriers: where a pixel's ray runs on the pattern as depth goes through the working range.

It is a straight line, and along it every carrier's phase grows evenly. So a rig is, for its orders, no more than the
vector from the near to the far end of that line, for a grid of pixels, and the place of the background on it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding import Crossed
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.optics import Rig

GRID = 5
"""Pixels along each side of the image, corners included."""
_STEP_M = 1e-4


@dataclass(frozen=True)
class EpipolarLines:
    """The lines of n pixels, in projector px (u, v); those of pixels that see the same are kept once.

    ``across_px`` float64 (n, 2): from the near to the far end of the range. ``far_px_per_mm`` (n, 2): the change with
    depth at the far end. ``background`` (n,): the place of the background plane on the line, 0 at the near end and 1 at
    the far end, so above 1; None where no background is known. ``range_mm``: the depths of both ends.
    """

    across_px: NDArray[np.float64]
    far_px_per_mm: NDArray[np.float64]
    background: NDArray[np.float64] | None
    range_mm: tuple[float, float]

    @classmethod
    def of(cls, rig: Rig) -> "EpipolarLines":
        """The lines of a grid of pixels that see the pattern at the standoff; a lens that bends them is taken as
        straight between their ends. Raises `RigError` where no pixel sees it over the whole range."""
        width, height = rig.camera.width, rig.camera.height
        columns, rows = (np.linspace(0, size - 1, GRID) for size in (width, height))
        u, v = np.append(np.tile(columns, GRID), (width - 1) / 2), np.append(np.repeat(rows, GRID), (height - 1) / 2)
        x, y = rig.camera.normalised(u, v)
        rays = np.column_stack([x, y, np.ones_like(x)])
        near_m, far_m = (limit / MM_PER_M for limit in rig.working_range_mm)
        depths = [near_m, far_m, rig.standoff_m, far_m - _STEP_M, far_m + _STEP_M]
        depths += [] if rig.background_m is None else [rig.background_m]
        near, far, middle, before, behind, *beyond = (np.stack(rig.project(rays * depth), axis=1) for depth in depths)
        seen = np.isfinite(near).all(axis=1) & np.isfinite(far).all(axis=1)
        inside = (middle >= -0.5) & (middle <= np.array([rig.projector.width, rig.projector.height]) - 0.5)
        seen &= inside.all(axis=1)
        if not seen.any():
            raise RigError("no pixel sees the pattern over the whole working range: check pose and range")
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
        """The angle of a carrier that runs along the line and tells no depth, -90 to 90 degrees: of the longest."""
        u_px, v_px = self.across_px[np.argmax((self.across_px**2).sum(axis=1))]
        return float(np.degrees(np.arctan2(-v_px, u_px) if u_px > 0 else np.arctan2(v_px, -u_px)))

    def turns(self, crossed: Crossed) -> NDArray[np.float64]:
        """Turns of both carriers' phases from the near to the far end, float64 (n, 2)."""
        return self.across_px @ np.array(crossed.cycles_per_px).T

    def places(self, depth_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Places of depths (n,) on a line, 0 at the near and 1 at the far end: even in 1 / depth, as they are where the
        baseline is square to the projector's axis, and nearly so elsewhere."""
        near_mm, far_mm = self.range_mm
        return (1 / near_mm - 1 / depth_mm) / (1 / near_mm - 1 / far_mm)

    def depths_mm(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `places`."""
        near_mm, far_mm = self.range_mm
        return 1 / (1 / near_mm - places * (1 / near_mm - 1 / far_mm))
