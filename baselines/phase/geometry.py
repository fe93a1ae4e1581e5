"""The geometry of one carrier and of two: from phase and fringe order to depth, in closed form, for
any rig.

With ``a = R (x, y, 1)`` the projector sees the pixel's point at ``(Z a_i + t_i) / (Z a_2 + t_2)``,
and the point at infinity at ``a_i / a_2``. The residual phase is the absolute phase minus that of
the point at infinity, ``psi = (2 pi f_p / P) (t_i - t_2 a_i / a_2) / (Z a_2 + t_2)``, for the
paper's rig ``-2 pi f_p C / (P Z)``. It varies as slowly as 1 / Z does, and gives depth back without
subtracting large numbers, so that float32 is enough.

Two carriers share the *nearness* ``q = 1 / (Z a_2 + t_2)``, for a projector beside the camera 1 /
Z: without lens distortion every projector coordinate is affine in it, so that carrier k shows
``phase_k = infinity_k + gain_k q``. A lens bends that by a hundredth of a projector px over a
working range; `Carriers.depth_mm` corrects it.

Windows, steps of the grid of orders and filters of a network have a size in pixels of the fringe.
So an image whose fringe period is far longer than the one that the route was made for is shrunk, and
what is measured is sampled back (`Resampling`): one with a period of 116 px is measured at 22.6 px.
A longer period loses nothing: a local fit averages over a quarter of it anyway, and the image is
shrunk by averaging.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt

from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.constants import GREY_LEVELS, MM_PER_M, TAU
from fpp_ml_bench.decoding.triangulation import FIXED_POINT_STEPS, rotated_ray
from fpp_ml_bench.errors import DecodeError, PredictionError
from fpp_ml_bench.optics.pinhole import Coefficients, Maps, distortion_polynomial, is_distorted
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import DIRECTIONS, Direction

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
Crop = tuple[slice, slice]

LEAST_RANGE_RAD = 1.0
"""Least change of the joint phase over the working range for crossed fringes to tell a depth at
all."""
RESAMPLED_JUMP_RAD = 1.0
"""Difference of residual phase from which on a pixel lies beside a jump, and nothing is
interpolated."""
SETTLED_RAD = 1e-9
"""Change in rad below which the iteration that removes the projector's distortion ends: a millionth
of what float32 keeps of a depth."""
CLIPPED_SHARE = 0.1
"""Of an averaged pixel: what makes it saturated."""
BEST_PX = 22.56
"""Image px a period at which the constants of the phase route were chosen."""
LONGEST_PX = 1.4 * BEST_PX
"""Longest period of an image that stays as it is; beyond it is resampled to `BEST_PX`. On two
validation rigs of 32 and 36 px `crossed` has 2.66 per mille of answered pixels resampled, and 2.89
in twice the time as they are; fringe-net has 1.14 and 1.13."""
NODES_PER_PERIOD = 7.5
"""Grid points along a period on which orders are chosen: every third pixel at 960 px."""


def wrapped(phase_rad: NDArray) -> NDArray:
    """``phase_rad`` less the nearest whole number of periods, in [-pi, pi]."""
    return phase_rad - TAU * np.rint(phase_rad / TAU)


@dataclass(frozen=True)
class Orders:
    """Orders whose depth lies in the working range: ``first, first + 1, ..., first + count - 1``,
    int32 (H, W) each; where none does, ``count`` is 0, and ``first`` is the order nearest to the
    range's middle."""

    first: NDArray[np.int32]
    count: NDArray[np.int32]


@dataclass(frozen=True)
class CalibrationLayer:
    """Constants of one rig and fringe direction for every pixel: float64 maps of the image's shape,
    or torch tensors. ``infinity_rad`` in [-pi, pi) and ``infinity_order``: absolute phase of a
    point infinitely far away, as wrapped phase and order. ``gain`` rad m, ``forward`` = a_2,
    ``back_m`` = t_2: psi = gain / (forward Z + back_m). ``rad_per_unit``: phase of one normalised
    projector unit along u and along v, 2 pi f_p / P and 0 for fringes of one direction. Of a
    projector whose lens distorts, its coefficients ``lens``, t in metres, and ``rays``: the maps
    a."""

    infinity_rad: Any
    infinity_order: Any
    gain: Any
    forward: Any
    back_m: float
    rad_per_unit: tuple[float, float]
    translation_m: tuple[float, float, float]
    lens: Coefficients | None = None
    rays: tuple[Any, ...] = ()

    @classmethod
    def of(cls, rig: Rig, direction: Direction, rays: Maps | None = None) -> "CalibrationLayer":
        """The layer of ``rig`` for ``direction`` at all its camera's pixels, or at normalised
        ``rays`` (x, y). Raises `DecodeError` for an unknown direction."""
        if direction not in DIRECTIONS:
            raise DecodeError(f"direction: expected horizontal or vertical, got {direction!r}")
        frequency = 1 / rig.pitch(direction)
        return cls.of_carrier(
            rig, (frequency, 0.0) if direction == "vertical" else (0.0, frequency), rays
        )

    @classmethod
    def of_carrier(
        cls, rig: Rig, cycles_per_px: tuple[float, float], rays: Maps | None = None
    ) -> "CalibrationLayer":
        """The layer of a fringe of any angle, with frequencies (f_u, f_v) in cycles a projector px,
        as those of `coding.Crossed.cycles_per_px`; its phase is 2 pi (f_u u + f_v v)."""
        where, device = rig.camera.rays() if rays is None else rays, rig.projector
        a = (rotated_ray(where, rig, 0), rotated_ray(where, rig, 1), rotated_ray(where, rig, 2))
        along_u, along_v = cycles_per_px
        rad_per_unit = TAU * device.fx * along_u, TAU * device.fy * along_v
        infinity: Any = TAU * (device.cx * along_u + device.cy * along_v)
        gain: Any = 0.0
        for axis, per_unit in enumerate(rad_per_unit):
            if per_unit:
                infinity = infinity + per_unit * (a[axis] / a[2])
                gain = gain + per_unit * (rig.t[axis] - rig.t[2] * a[axis] / a[2])
        order = np.floor(infinity / TAU + 0.5)
        maps = (
            infinity - TAU * order,
            order,
            gain,
            a[2],
            float(rig.t[2]),
            rad_per_unit,
            rig.translation_m,
        )
        distorts = device.is_distorted and is_distorted(device.distortion)
        return cls(*maps, device.distortion, a) if distorts else cls(*maps)

    @property
    def maps(self) -> tuple[Any, ...]:
        """All maps: the four of the pinhole model, and the rays where the projector's lens
        distorts."""
        return (self.infinity_rad, self.infinity_order, self.gain, self.forward, *self.rays)

    def with_maps(self, maps: Iterable[Any]) -> "CalibrationLayer":
        """The same constants with other ``maps``, in the order of `maps`."""
        infinity, order, gain, forward, *rays = maps
        return replace(
            self,
            infinity_rad=infinity,
            infinity_order=order,
            gain=gain,
            forward=forward,
            rays=tuple(rays),
        )

    def at(self, where: Any) -> "CalibrationLayer":
        """The layer of a part of the image: ``where`` indexes the maps (slices, a mask)."""
        return self.with_maps(values[where] for values in self.maps)

    def tensors(self, dtype: Any = None, device: Any = None) -> "CalibrationLayer":
        """The layer on torch tensors; gradients flow through depth to the phase. ``dtype`` float32
        (None) keeps a micrometre; float64 equals the NumPy layer to 1e-6 mm."""
        import torch

        return self.with_maps(
            torch.tensor(m, dtype=dtype or torch.float32, device=device) for m in self.maps
        )

    def shifted(self, shift_rad: float) -> "CalibrationLayer":
        """The layer of fringes that are shifted by ``shift_rad`` (NumPy only)."""
        if not shift_rad:
            return self
        infinity = self.infinity_rad + shift_rad
        turns = np.floor(infinity / TAU + 0.5)
        maps = (infinity - TAU * turns, self.infinity_order + turns, *self.maps[2:])
        return self.with_maps(maps)

    def residual_phase(self, phase_rad: Any, order: Any) -> Any:
        """psi in rad from wrapped phase (rad) and order (whole numbers): small numbers are
        subtracted, then whole periods counted, so that float32 keeps its digits."""
        return (phase_rad - self.infinity_rad) + TAU * (order - self.infinity_order)

    def absolute_phase(self, depth_mm: ArrayLike) -> NDArray[np.float64]:
        """Absolute phase Phi in rad that a point at ``depth_mm`` on each pixel's ray shows, float64
        (NumPy only)."""
        residual = self.residual_of_depth(np.asarray(depth_mm, dtype=np.float64))
        return residual + self.infinity_rad + TAU * self.infinity_order  # type: ignore[no-any-return]

    def residual_of_depth(self, depth_mm: Any) -> Any:
        """psi in rad of a point at ``depth_mm`` on each pixel's ray: an array or a tensor, as the
        maps."""
        z = depth_mm / MM_PER_M
        residual = self.gain / (self.forward * z + self.back_m)
        return residual if self.lens is None else residual + self._lens_shift(z)

    def depth_mm(self, phase_rad: Any, order: Any) -> Any:
        """Depth in mm, the camera's z, from wrapped phase in rad and fringe order: arrays or
        tensors of the maps' shape (leading dimensions may be more). Not bounded: a point behind a
        device gets a negative or infinite depth."""
        return self.depth_of_residual_mm(self.residual_phase(phase_rad, order))

    def depth_of_residual_mm(self, residual_rad: Any) -> Any:
        """Depth in mm from the residual phase psi in rad."""
        ideal = residual_rad
        if self.lens is not None:
            for _ in range(FIXED_POINT_STEPS):
                before = ideal
                z = (self.gain / ideal - self.back_m) / self.forward
                ideal = residual_rad - self._lens_shift(z)
                if not (abs(ideal - before) > SETTLED_RAD).any():
                    break
        return (self.gain / ideal - self.back_m) / self.forward * MM_PER_M

    # In the plane of the projector's centre a point has no image: what follows is no number, and out
    # of the range.
    @np.errstate(divide="ignore", invalid="ignore", over="ignore")
    def _lens_shift(self, z: Any) -> Any:
        """Phase by which the projector's lens displaces a point at z metres on the ray."""
        x, y, ahead = (z * ray + t for ray, t in zip(self.rays, self.translation_m, strict=True))
        point = x / ahead, y / ahead
        moved = distortion_polynomial(*point, self.lens)  # type: ignore[arg-type]
        shifts = zip(self.rad_per_unit, moved, point, strict=True)
        return sum(per_unit * (after - before) for per_unit, after, before in shifts if per_unit)

    def orders_in_range(self, phase_rad: ArrayLike, range_mm: tuple[float, float]) -> Orders:
        """The fringe orders that put each pixel of ``phase_rad`` (H, W) within ``range_mm``; NaN
        phases have none."""
        phase = np.asarray(phase_rad, dtype=np.float64)
        ends = [self.absolute_phase(end) for end in range_mm]
        low, high = np.minimum(*ends), np.maximum(*ends)
        defined = np.isfinite(phase) & np.isfinite(low) & np.isfinite(high)
        phase, low, high = (np.where(defined, values, 0.0) for values in (phase, low, high))
        first, last = np.ceil((low - phase) / TAU), np.floor((high - phase) / TAU)
        count = np.where(defined, np.maximum(last - first + 1, 0), 0)
        first = np.where(count > 0, first, np.rint(((low + high) / 2 - phase) / TAU))
        return Orders(first.astype(np.int32), count.astype(np.int32))


@dataclass(frozen=True)
class Carriers:
    """The two carriers of ``rig`` at the pixels ``crop`` of its image. ``infinity_rad`` float32 (2,
    h, w), wrapped; ``gain`` float32 (2, h, w), rad m; ``forward`` float32 (h, w) and ``back_m``:
    a_2 and t_2; ``step_rad`` (2, 2): change of each phase per px along x and y, on a plane at the
    standoff."""

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
        """The carriers of a whole image. Raises `PredictionError` for carriers that hardly change
        with depth."""
        x, y = rig.camera.rays()
        forward, back_m = rotated_ray((x, y), rig, 2), float(rig.t[2])
        ends_m = [depth_mm / MM_PER_M for depth_mm in rig.working_range_mm]
        far_q, near_q = (1 / (forward * end + back_m) for end in reversed(ends_m))
        near_rad, far_rad = (_phases(rig, family, x, y, end) for end in ends_m)
        gain = (near_rad - far_rad) / (near_q - far_q)
        infinity = near_rad - gain * near_q
        standoff = infinity + gain / (forward * rig.standoff_m + back_m)
        step = np.array(
            [[np.diff(phase, axis=axis).mean() for axis in (1, 0)] for phase in standoff]
        )
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
                f"crossed: over the working range {rig.working_range_mm[0]:g} to "
                f"{rig.working_range_mm[1]:g} mm the "
                f"carriers change by {span:.2g} rad, too little for a depth: turn them towards the "
                f"line between camera "
                "and projector, or make them finer (fpp-bench patterns --design)"
            )
        return carriers

    def at(self, where: Crop) -> "Carriers":
        """The carriers of a part of a whole image."""
        maps = self.infinity_rad[:, *where], self.gain[:, *where], self.forward[where]
        return replace(self, crop=where, infinity_rad=maps[0], gain=maps[1], forward=maps[2])

    @property
    def period_px(self) -> float:
        """Image px a period of the longer carrier, on a plane at the standoff: windows have a size
        in it."""
        return float((TAU / np.linalg.norm(self.step_rad, axis=1)).max())

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
        """Depth in mm, float64 (h, w), from q; corrected for a projector lens that distorts. NaN
        where q is not in front of both devices."""
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


def _phases(
    rig: Rig, family: Crossed, x: NDArray, y: NDArray, depth_m: ArrayLike
) -> NDArray[np.float64]:
    """Phases (2, h, w) in rad, not wrapped, of points ``depth_m`` away on the rays (x, y), by the
    rig's own projection; those of the family's first frame."""
    u, v = rig.project(
        np.stack([x * depth_m, y * depth_m, np.broadcast_to(depth_m, x.shape)], axis=-1)
    )
    shifts = np.radians(family.shifts_deg[0])
    pairs = zip(family.cycles_per_px, shifts, strict=True)
    return np.stack(
        [TAU * (along_u * u + along_v * v) + shift for (along_u, along_v), shift in pairs]
    )


def main_carrier(gain: NDArray) -> int:
    """Which of two carriers, whose gains are (2, ...), changes more with depth."""
    return int(np.median(np.abs(gain[1])) > np.median(np.abs(gain[0])))


def stride_of(period_px: float) -> int:
    """Image px a step of the grid on which orders are chosen."""
    return max(1, round(period_px / NODES_PER_PERIOD))


def grid_of(stride: int, crop: Crop = (slice(None), slice(None))) -> Crop:
    """Every ``stride``-th row and column of ``crop``."""
    return slice(crop[0].start, crop[0].stop, stride), slice(crop[1].start, crop[1].stop, stride)


def repeated(coarse: NDArray, stride: int, shape: tuple[int, ...]) -> NDArray:
    """Maps (..., h', w') of every ``stride``-th pixel as maps of all (..., h, w); ``shape`` (...,
    h, w)."""
    return coarse.repeat(stride, axis=-2).repeat(stride, axis=-1)[..., : shape[-2], : shape[-1]]


def nearest_inside(inside: Mask) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns (h, w) of the pixel of ``inside`` that is nearest to every pixel; every
    pixel's own where ``inside`` has none."""
    if inside.all() or not inside.any():
        places: NDArray = np.indices(inside.shape)
    else:
        places = distance_transform_edt(~inside, return_distances=False, return_indices=True)
    return places[0], places[1]


@dataclass(frozen=True)
class Resampling:
    """From the images of ``captured`` to those of ``rig``, the same rig with a camera of another
    size, and back; equal rigs where nothing is to be done."""

    captured: Rig
    rig: Rig

    @classmethod
    def of(cls, rig: Rig, seen_px: float) -> "Resampling":
        """What brings fringes of ``seen_px`` image px a period to `LONGEST_PX` and less."""
        camera = rig.camera
        if seen_px <= LONGEST_PX:
            return cls(rig, rig)
        width, height = (
            max(1, round(length * BEST_PX / seen_px)) for length in (camera.width, camera.height)
        )
        # Rounding to whole pixels makes the scales of width and height a little different.
        down = height / camera.height
        resized = replace(
            camera.scaled(width),
            height=height,
            fy=camera.fy * down,
            cy=(camera.cy + 0.5) * down - 0.5,
        )
        return cls(rig, replace(rig, camera=resized))

    @property
    def needed(self) -> bool:
        return self.captured is not self.rig

    def image(self, grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Captured grey levels uint8 (H, W) in the size of ``rig``; a pixel stays saturated where a
        part of it is."""
        if not self.needed:
            return grey
        size = self.rig.camera.width, self.rig.camera.height

        clipped = cv2.resize(
            (grey == GREY_LEVELS).astype(np.float32), size, interpolation=cv2.INTER_AREA
        )
        resized = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        return np.where(clipped > CLIPPED_SHARE, np.uint8(GREY_LEVELS), resized)

    def mask(self, mask: Mask) -> Mask:
        """A mask (H, W) of the captured image in the size of ``rig``."""
        if not self.needed:
            return mask
        size = self.rig.camera.width, self.rig.camera.height
        return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5  # type: ignore[no-any-return]

    def captured_crop(self, crop: Crop) -> Crop:
        """The part of the captured image that ``crop`` of the resampled one shows."""
        whole, part = self.captured.camera, self.rig.camera
        rows, columns = (
            slice(place.start * full // less, -(-place.stop * full // less))
            for place, full, less in zip(
                crop, (whole.height, whole.width), (part.height, part.width), strict=True
            )
        )
        return rows, columns

    def restored(
        self, psi: NDArray[np.float64], inside: Mask
    ) -> tuple[Mask, NDArray[np.float64], Callable[[NDArray], NDArray]]:
        """A phase in rad without wraps, (h, w), at the captured pixels: where they are object, the
        phase (H, W), and how any map is taken from the nearest object pixel. The phase is
        interpolated, but not across jumps."""
        size = self.captured.camera.width, self.captured.camera.height
        places = nearest_inside(inside)

        def nearest(image: NDArray) -> NDArray:
            """From the nearest object pixel."""
            return cv2.resize(image[places], size, interpolation=cv2.INTER_NEAREST_EXACT)

        psi = np.where(inside, psi, 0.0)
        weight, total = (
            cv2.resize(v, size, interpolation=cv2.INTER_LINEAR)
            for v in (inside.astype(np.float64), psi)
        )
        # A pixel that mixes two surfaces takes the phase of the nearest one.
        lowest, highest = (
            cv2.morphologyEx(np.where(inside, psi, beyond), operation, np.ones((3, 3), np.uint8))
            for operation, beyond in ((cv2.MORPH_ERODE, np.inf), (cv2.MORPH_DILATE, -np.inf))
        )
        step = np.subtract(highest, lowest, out=np.zeros_like(psi), where=inside)
        beside_jump = nearest((step > RESAMPLED_JUMP_RAD).astype(np.uint8)) > 0
        return (
            weight > 0.5,
            np.where(beside_jump, nearest(psi), total / np.maximum(weight, 1e-6)),
            nearest,
        )
