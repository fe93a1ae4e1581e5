"""The fixed calibration layer: wrapped phase and fringe order to depth, in closed form, for any rig.

With ``a = R (x, y, 1)`` the projector sees the pixel's point at ``(Z a_i + t_i) / (Z a_2 + t_2)``, and
the point at infinity at ``a_i / a_2``. The residual phase is the absolute phase minus that of the point at infinity,
``psi = (2 pi f_p / P) (t_i - t_2 a_i / a_2) / (Z a_2 + t_2)``, for the paper's rig ``-2 pi f_p C / (P Z)``. It varies
as slowly as 1 / Z does, and gives depth back without subtracting large numbers, so that float32 is enough.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding.triangulation import FIXED_POINT_STEPS, rotated_ray
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics.pinhole import Coefficients, Maps, distortion_polynomial, is_distorted
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import DIRECTIONS, Direction

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

TAU = 2 * np.pi


def wrapped(phase_rad: NDArray) -> NDArray:
    """``phase_rad`` less the nearest whole number of periods, in [-pi, pi]."""
    return phase_rad - TAU * np.rint(phase_rad / TAU)


@dataclass(frozen=True)
class Lens:
    """Constants of a distorted projector: ``rays`` a (three maps), ``t`` in metres."""

    rays: tuple[Any, Any, Any]
    t: tuple[float, float, float]
    coefficients: Coefficients


@dataclass(frozen=True)
class Candidates:
    """Orders whose depth lies in the working range: ``first, first + 1, ..., first + count - 1``, int32 (H, W) each;
    where none does, ``count`` is 0, and ``first`` is the order nearest to the range's middle."""

    first: NDArray[np.int32]
    count: NDArray[np.int32]


@dataclass(frozen=True)
class CalibrationLayer:
    """Constants of one rig and fringe direction for every pixel: float64 maps of the image's shape, or torch tensors.
    ``infinity_rad`` in [-pi, pi) and ``infinity_order``: absolute phase of a point infinitely far away, as wrapped
    phase and order. ``gain`` rad m, ``forward`` = a_2, ``back_m`` = t_2: psi = gain / (forward Z + back_m).
    ``rad_per_unit``: phase of one normalised projector unit along u and along v, 2 pi f_p / P and 0 for fringes of one
    direction."""

    infinity_rad: Any
    infinity_order: Any
    gain: Any
    forward: Any
    back_m: float
    rad_per_unit: tuple[float, float]
    lens: Lens | None = None

    @classmethod
    def of(cls, rig: Rig, direction: Direction, rays: Maps | None = None) -> "CalibrationLayer":
        """The layer of ``rig`` for ``direction`` at all its camera's pixels, or at normalised ``rays`` (x, y). Raises
        `DecodeError` for an unknown direction."""
        if direction not in DIRECTIONS:
            raise DecodeError(f"direction: expected horizontal or vertical, got {direction!r}")
        device, pitch_px = rig.projector, rig.pitch(direction)
        if direction == "vertical":
            return cls._along(rig, (TAU * device.fx / pitch_px, 0.0), TAU * device.cx / pitch_px, rays)
        return cls._along(rig, (0.0, TAU * device.fy / pitch_px), TAU * device.cy / pitch_px, rays)

    @classmethod
    def of_carrier(cls, rig: Rig, cycles_per_px: tuple[float, float], rays: Maps | None = None) -> "CalibrationLayer":
        """The layer of a fringe of any angle, with frequencies (f_u, f_v) in cycles a projector px, as those of
        `coding.Crossed.cycles_per_px`; its phase is 2 pi (f_u u + f_v v)."""
        device, (along_u, along_v) = rig.projector, cycles_per_px
        per_unit = TAU * device.fx * along_u, TAU * device.fy * along_v
        return cls._along(rig, per_unit, TAU * (device.cx * along_u + device.cy * along_v), rays)

    @classmethod
    def _along(
        cls, rig: Rig, rad_per_unit: tuple[float, float], centre_rad: float, rays: Maps | None
    ) -> "CalibrationLayer":
        where, device = rig.camera.rays() if rays is None else rays, rig.projector
        a = (rotated_ray(where, rig, 0), rotated_ray(where, rig, 1), rotated_ray(where, rig, 2))
        infinity: Any = centre_rad
        gain: Any = 0.0
        for axis, per_unit in enumerate(rad_per_unit):
            if per_unit:
                infinity = infinity + per_unit * (a[axis] / a[2])
                gain = gain + per_unit * (rig.t[axis] - rig.t[2] * a[axis] / a[2])
        order = np.floor(infinity / TAU + 0.5)
        lens = None
        if device.is_distorted and is_distorted(device.distortion):
            lens = Lens(a, rig.translation_m, device.distortion)
        return cls(infinity - TAU * order, order, gain, a[2], float(rig.t[2]), rad_per_unit, lens)

    @property
    def maps(self) -> tuple[Any, ...]:
        """All maps: the four of the pinhole model, and the rays where the projector's lens distorts."""
        rays = self.lens.rays if self.lens is not None else ()
        return (self.infinity_rad, self.infinity_order, self.gain, self.forward, *rays)

    def with_maps(self, maps: Iterable[Any]) -> "CalibrationLayer":
        """The same constants with other ``maps``, in the order of `maps`."""
        infinity, order, gain, forward, *rays = maps
        lens = replace(self.lens, rays=tuple(rays)) if self.lens is not None else None
        return CalibrationLayer(infinity, order, gain, forward, self.back_m, self.rad_per_unit, lens)

    def at(self, where: Any) -> "CalibrationLayer":
        """The layer of a part of the image: ``where`` indexes the maps (slices, a mask)."""
        return self.with_maps(values[where] for values in self.maps)

    def tensors(self, dtype: Any = None, device: Any = None) -> "CalibrationLayer":
        """The layer on torch tensors; gradients flow through depth to the phase. ``dtype`` float32 (None) keeps a
        micrometre; float64 equals the NumPy layer to 1e-6 mm."""
        import torch

        return self.with_maps(torch.tensor(m, dtype=dtype or torch.float32, device=device) for m in self.maps)

    def residual_phase(self, phase_rad: Any, order: Any) -> Any:
        """psi in rad from wrapped phase (rad) and order (whole numbers): small numbers are subtracted, then whole
        periods counted, so that float32 keeps its digits."""
        return (phase_rad - self.infinity_rad) + TAU * (order - self.infinity_order)

    def absolute_phase(self, depth_mm: ArrayLike) -> NDArray[np.float64]:
        """Absolute phase Phi in rad that a point at ``depth_mm`` on each pixel's ray shows, float64 (NumPy only)."""
        residual = self.residual_of_depth(np.asarray(depth_mm, dtype=np.float64))
        return residual + self.infinity_rad + TAU * self.infinity_order  # type: ignore[no-any-return]

    def residual_of_depth(self, depth_mm: Any) -> Any:
        """psi in rad of a point at ``depth_mm`` on each pixel's ray: an array or a tensor, as the maps."""
        z = depth_mm / MM_PER_M
        residual = self.gain / (self.forward * z + self.back_m)
        return residual if self.lens is None else residual + self._lens_shift(self.lens, z)

    def depth_mm(self, phase_rad: Any, order: Any) -> Any:
        """Depth in mm, the camera's z, from wrapped phase in rad and fringe order: arrays or tensors of the maps' shape
        (leading dimensions may be more). Not bounded: a point behind a device gets a negative or infinite depth."""
        return self.depth_of_residual_mm(self.residual_phase(phase_rad, order))

    def depth_of_residual_mm(self, residual_rad: Any) -> Any:
        """Depth in mm from the residual phase psi in rad."""
        ideal = residual_rad
        if self.lens is not None:
            for _ in range(FIXED_POINT_STEPS):
                ideal = residual_rad - self._lens_shift(self.lens, (self.gain / ideal - self.back_m) / self.forward)
        return (self.gain / ideal - self.back_m) / self.forward * MM_PER_M

    def _lens_shift(self, lens: Lens, z: Any) -> Any:
        """Phase by which the projector's lens displaces a point at z metres on the ray."""
        ahead = z * lens.rays[2] + lens.t[2]
        point = [(z * lens.rays[i] + lens.t[i]) / ahead for i in range(2)]
        moved = distortion_polynomial(point[0], point[1], lens.coefficients)
        shifts = zip(self.rad_per_unit, moved, point, strict=True)
        return sum(per_unit * (after - before) for per_unit, after, before in shifts if per_unit)

    def orders_in_range(self, phase_rad: ArrayLike, range_mm: tuple[float, float]) -> Candidates:
        """The fringe orders that put each pixel of ``phase_rad`` (H, W) within ``range_mm``; NaN phases have none."""
        phase = np.asarray(phase_rad, dtype=np.float64)
        ends = [self.absolute_phase(end) for end in range_mm]
        low, high = np.minimum(*ends), np.maximum(*ends)
        defined = np.isfinite(phase) & np.isfinite(low) & np.isfinite(high)
        phase, low, high = (np.where(defined, values, 0.0) for values in (phase, low, high))
        first, last = np.ceil((low - phase) / TAU), np.floor((high - phase) / TAU)
        count = np.where(defined, np.maximum(last - first + 1, 0), 0)
        first = np.where(count > 0, first, np.rint(((low + high) / 2 - phase) / TAU))
        return Candidates(first.astype(np.int32), count.astype(np.int32))
