"""Two carriers as a camera sees them: the phase of each is affine in a nearness q that both share.

With ``a = R (x, y, 1)`` a point at depth Z on a pixel's ray has, in the projector, the nearness ``q = 1 / (a_2 Z +
t_2)``, for a projector beside the camera 1 / Z. Without lens distortion every projector coordinate is affine in q, so
that carrier k shows ``phase_k = infinity_k + gain_k q``. A lens bends that by a hundredth of a projector px over a
working range; `Carriers.depth_mm` corrects it.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import TAU, Image, wrapped
from fpp_ml_bench.baselines.phase.object_mask import Crop
from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding.triangulation import rotated_ray
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.optics.rig import Rig

LEAST_RANGE_RAD = 1.0
"""Least change of the joint phase over the working range for crossed fringes to tell a depth at all."""


@dataclass(frozen=True)
class Carriers:
    """The two carriers of ``rig`` at the pixels ``crop`` of its image. ``infinity_rad`` float32 (2, h, w), wrapped;
    ``gain`` float32 (2, h, w), rad m; ``forward`` float32 (h, w) and ``back_m``: a_2 and t_2; ``step_rad`` (2, 2):
    change of each phase per px along x and y, on a plane at the standoff."""

    rig: Rig
    family: Crossed
    crop: Crop
    infinity_rad: Image
    gain: Image
    forward: Image
    back_m: float
    step_rad: NDArray[np.float64]

    @classmethod
    def of(cls, rig: Rig, family: Crossed) -> "Carriers":
        """The carriers of a whole image. Raises `PredictionError` for carriers that hardly change with depth."""
        x, y = rig.camera.rays()
        forward, back_m = rotated_ray((x, y), rig, 2), float(rig.t[2])
        ends_m = [depth_mm / MM_PER_M for depth_mm in rig.working_range_mm]
        far_q, near_q = (1 / (forward * end + back_m) for end in reversed(ends_m))
        near_rad, far_rad = (_phases(rig, family, x, y, end) for end in ends_m)
        gain = (near_rad - far_rad) / (near_q - far_q)
        infinity = near_rad - gain * near_q
        standoff = infinity + gain / (forward * rig.standoff_m + back_m)
        step = np.array([[np.diff(phase, axis=axis).mean() for axis in (1, 0)] for phase in standoff])
        everywhere = slice(None), slice(None)
        carriers = cls(
            rig,
            family,
            everywhere,
            wrapped(infinity).astype(np.float32),
            gain.astype(np.float32),
            forward.astype(np.float32),
            back_m,
            step,
        )
        span = float(np.median(carriers.joint_gain * np.abs(near_q - far_q)))
        if not span >= LEAST_RANGE_RAD:
            raise PredictionError(
                f"crossed: over the working range {rig.working_range_mm[0]:g} to {rig.working_range_mm[1]:g} mm the "
                f"carriers change by {span:.2g} rad, too little for a depth: turn them towards the line between camera "
                "and projector, or make them finer (fpp-bench patterns --design)"
            )
        return carriers

    def at(self, where: Crop) -> "Carriers":
        """The carriers of a part of a whole image."""
        maps = self.infinity_rad[:, *where], self.gain[:, *where], self.forward[where]
        return replace(self, crop=where, infinity_rad=maps[0], gain=maps[1], forward=maps[2])

    @property
    def weights(self) -> tuple[float, float]:
        """Modulation over mean of each carrier, as projected."""
        return self.family.weights[0], self.family.weights[1]

    @property
    def periods_px(self) -> NDArray[np.float64]:
        """Image px a period of each carrier, on a plane at the standoff, float64 (2,)."""
        return TAU / np.linalg.norm(self.step_rad, axis=1)

    @property
    def period_px(self) -> float:
        """The longer of `periods_px`: windows have a size in it."""
        return float(self.periods_px.max())

    @cached_property
    def joint_gain(self) -> Image:
        """Change in rad of both phases together, as the length of a vector, a unit of q, (h, w)."""
        return np.hypot(*self.gain)  # type: ignore[no-any-return]

    def phases(self, nearness: NDArray) -> NDArray:
        """Phases (2, h, w) in rad, not wrapped, at the nearness q (h, w)."""
        return self.infinity_rad + self.gain * nearness

    def nearness(self, depth_mm: ArrayLike) -> NDArray:
        """q of a depth in mm."""
        return 1 / (self.forward * np.asarray(depth_mm) / MM_PER_M + self.back_m)

    def depth_mm(self, nearness: NDArray) -> NDArray[np.float64]:
        """Depth in mm, float64 (h, w), from q; corrected for a projector lens that distorts. NaN where q is not in
        front of both devices."""
        q = nearness.astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth_m = np.where(q > 0, (1 / q - self.back_m) / self.forward, np.nan)
            if any(self.rig.projector.distortion):
                x, y = (axis[self.crop] for axis in self.rig.camera.rays())
                exact = _phases(self.rig, self.family, x, y, depth_m)
                misfit = wrapped(self.phases(q) - exact)
                q = q + (misfit * self.gain).sum(axis=0) / self.joint_gain**2
                depth_m = np.where(q > 0, (1 / q - self.back_m) / self.forward, np.nan)
        return np.where(depth_m > 0, depth_m * MM_PER_M, np.nan)

    def mm_per_rad(self, depth_mm: NDArray) -> NDArray:
        """Change of depth in mm a rad of the joint phase, at ``depth_mm`` (h, w)."""
        ahead = self.forward * depth_mm / MM_PER_M + self.back_m
        return np.abs(ahead**2 / (self.joint_gain * self.forward)) * MM_PER_M


def _phases(rig: Rig, family: Crossed, x: NDArray, y: NDArray, depth_m: ArrayLike) -> NDArray[np.float64]:
    """Phases (2, h, w) in rad, not wrapped, of points ``depth_m`` away on the rays (x, y), by the rig's own projection;
    those of the family's first frame."""
    u, v = rig.project(np.stack([x * depth_m, y * depth_m, np.broadcast_to(depth_m, x.shape)], axis=-1))
    shifts = np.radians(family.shifts_deg[0])
    pairs = zip(family.cycles_per_px, shifts, strict=True)
    return np.stack([TAU * (along_u * u + along_v * v) + shift for (along_u, along_v), shift in pairs])
