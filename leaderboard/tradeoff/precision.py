"""The classical decoder's formulas in float32 or float64: the difference in depth, and in time.

The package decodes in float64. This is the same arithmetic (paper Eqs. 1 and 2, fringe order, triangulation from one
projector coordinate) in plain NumPy, with every array of the same type, so that two runs differ only in the type.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding import MIN_MODULATION, DirectionPlan, Limits, plan_direction
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.leaderboard.tradeoff.views import Frames
from fpp_ml_bench.optics import Direction, Rig, decode_cells


@dataclass
class DecodeInType(Method):
    """Decoding of one direction with ``steps`` steps in ``dtype`` (``float32`` or ``float64``). A pixel that is too
    dark, has an ambiguous code, or lies outside the working range gets 0.

    Raises `DecodeError` for a distorted projector, whose inverse is iterated in float64.
    """

    rig: Rig
    direction: Direction
    steps: int
    dtype: str

    name = "classical"

    def __post_init__(self) -> None:
        if self.rig.projector.is_distorted:
            raise DecodeError("float32 against float64 is compared for a projector without distortion; this rig's has")
        self.title = f"NumPy in {self.dtype}, {self.steps}-step, {self.direction} fringes"
        self.frames_used = ClassicalMethod(self.rig, self.direction, self.steps).frames_used
        self.settings = {"direction": self.direction, "steps": self.steps, "dtype": self.dtype}

    @cached_property
    def _plan(self) -> DirectionPlan:
        return plan_direction(self.rig, self.direction, self.steps, Limits())

    @cached_property
    def _rays(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Components of R (x, y, 1) across the fringes and forward, (H, W) in ``dtype``."""
        x, y = (axis.astype(self.dtype) for axis in self.rig.camera.rays())
        rotation = self.rig.R.astype(self.dtype)
        rows = (0 if self.direction == "vertical" else 1), 2
        across, forward = (rotation[row, 0] * x + rotation[row, 1] * y + rotation[row, 2] for row in rows)
        return across, forward

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        """Depth float32 (H, W) in mm, 0 = not measured."""
        plan, number = self._plan, np.dtype(self.dtype).type
        grey = [frame for frame in (frames[index] for index in plan.frames) if frame is not None]
        if len(grey) != len(plan.frames):
            raise DecodeError(f"expected the {len(plan.frames)} frames {plan.frames}, {len(grey)} were captured")
        sums = np.zeros((3, *grey[0].shape), self.dtype)
        for image, weights in zip(grey, plan.weights.T.astype(self.dtype), strict=False):
            levels = image.astype(self.dtype)
            for total, weight in zip(sums, weights, strict=True):
                total += weight * levels
        mean, cosine, sine = sums
        modulation = np.sqrt(cosine * cosine + sine * sine)
        cells, trusted = decode_cells(np.stack(grey[len(plan.sinusoids) :]), mean, modulation)
        turn = number(2 * np.pi)
        phase = -np.arctan2(sine, cosine)
        centre = plan.centres_rad.astype(self.dtype)[np.minimum(cells, len(plan.centres_rad) - 1)]
        absolute = phase + turn * np.floor((centre - phase) / turn + number(0.5))
        return self._depth(absolute * number(plan.pitch_px / (2 * np.pi)), trusted & (modulation >= MIN_MODULATION))

    def _depth(self, coordinate_px: NDArray[Any], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
        number = np.dtype(self.dtype).type
        axis, device = (0 if self.direction == "vertical" else 1), self.rig.projector
        ideal = (coordinate_px - number((device.cx, device.cy)[axis])) / number((device.fx, device.fy)[axis])
        across, forward = self._rays
        with np.errstate(all="ignore"):
            depth = (ideal * number(self.rig.t[2]) - number(self.rig.t[axis])) / (across - ideal * forward)
            depth_mm = depth * number(MM_PER_M)
            near, far = self.rig.working_range_mm
            valid = valid & (depth_mm >= near) & (depth_mm <= far)
        return np.where(valid, depth_mm, 0).astype(np.float32)
