"""Maps of every n-th pixel, and images with a fringe period far from the one that a method was made for: these are
resampled, and the result is sampled back.

Windows, steps of the grid of orders and filters of a network have a size in pixels of the fringe. So an image with a
period of 116 px is measured at 22.6 px, and a network that learnt from 22.6 px gets an image of 6 px enlarged. A
longer period loses nothing: a local fit averages over a quarter of it anyway, and the image is shrunk by averaging.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from fpp_ml_bench.baselines.phase.calibration_layer import Crop, Mask
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.optics.rig import Rig

JUMP_RAD = 1.0  # difference of residual phase from which on a pixel lies beside a jump, and nothing is interpolated
CLIPPED_SHARE = 0.1  # of an averaged pixel that makes it saturated
NODES_PER_PERIOD = 7.5  # grid points along a period: every third pixel at 960 px


def stride_of(period_px: float) -> int:
    """Image px a step of the grid on which orders are chosen."""
    return max(1, round(period_px / NODES_PER_PERIOD))


def grid_of(stride: int, crop: Crop = (slice(None), slice(None))) -> Crop:
    """Every ``stride``-th row and column of ``crop``."""
    return slice(crop[0].start, crop[0].stop, stride), slice(crop[1].start, crop[1].stop, stride)


def repeated(coarse: NDArray, stride: int, shape: tuple[int, ...]) -> NDArray:
    """Maps (..., h', w') of every ``stride``-th pixel as maps of all (..., h, w); ``shape`` (..., h, w)."""
    return coarse.repeat(stride, axis=-2).repeat(stride, axis=-1)[..., : shape[-2], : shape[-1]]


def nearest_inside(inside: Mask) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns (h, w) of the pixel of ``inside`` that is nearest to every pixel; every pixel's own where
    ``inside`` has none."""
    if inside.all() or not inside.any():
        places: NDArray = np.indices(inside.shape)
    else:
        places = distance_transform_edt(~inside, return_distances=False, return_indices=True)
    return places[0], places[1]


@dataclass(frozen=True)
class Periods:
    """Fringe periods in image px: from ``shortest`` to ``longest`` an image stays as it is; beyond it is resampled to a
    period of ``best``. The defaults are those of the phase route, whose constants were chosen at 22.56 px."""

    shortest: float = 0.0
    best: float = 22.56
    longest: float = 2.2 * 22.56


@dataclass(frozen=True)
class Resampling:
    """From the images of ``captured`` to those of ``rig``, the same rig with a camera of another size, and back; equal
    rigs where nothing is to be done."""

    captured: Rig
    rig: Rig

    @classmethod
    def of(cls, rig: Rig, seen_px: float, periods: Periods) -> "Resampling":
        """What brings fringes of ``seen_px`` image px a period into ``periods``."""
        camera = rig.camera
        if periods.shortest <= seen_px <= periods.longest:
            return cls(rig, rig)
        width, height = (max(1, round(length * periods.best / seen_px)) for length in (camera.width, camera.height))
        across, down = width / camera.width, height / camera.height
        # Pixel areas scale, not centres; rounding to whole pixels makes the two scales a little different.
        resized = replace(
            camera,
            width=width,
            height=height,
            fx=camera.fx * across,
            fy=camera.fy * down,
            cx=(camera.cx + 0.5) * across - 0.5,
            cy=(camera.cy + 0.5) * down - 0.5,
        )
        return cls(rig, replace(rig, camera=resized))

    @property
    def needed(self) -> bool:
        return self.captured is not self.rig

    def image(self, grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Captured grey levels uint8 (H, W) in the size of ``rig``; a pixel stays saturated where a part of it is."""
        if not self.needed:
            return grey
        size = self.rig.camera.width, self.rig.camera.height
        if size[0] > grey.shape[1]:
            return cv2.resize(grey, size, interpolation=cv2.INTER_CUBIC)  # type: ignore[return-value]
        clipped = cv2.resize((grey == GREY_LEVELS).astype(np.float32), size, interpolation=cv2.INTER_AREA)
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
        if not self.needed:
            return crop
        lengths = (
            (self.captured.camera.height, self.rig.camera.height),
            (self.captured.camera.width, self.rig.camera.width),
        )
        ends = [
            (s.start * full // less, -(-s.stop * full // less)) for s, (full, less) in zip(crop, lengths, strict=True)
        ]
        return slice(*ends[0]), slice(*ends[1])

    def restored(
        self, psi: NDArray[np.float64], inside: Mask
    ) -> tuple[Mask, NDArray[np.float64], Callable[[NDArray], NDArray]]:
        """A phase in rad without wraps, (h, w), at the captured pixels: where they are object, the phase (H, W), and
        how any map is taken from the nearest object pixel. The phase is interpolated, but not across jumps."""
        size = self.captured.camera.width, self.captured.camera.height
        places = nearest_inside(inside)

        def nearest(image: NDArray) -> NDArray:
            """From the nearest object pixel."""
            return cv2.resize(image[places], size, interpolation=cv2.INTER_NEAREST_EXACT)

        psi = np.where(inside, psi, 0.0)
        weight, total = (cv2.resize(v, size, interpolation=cv2.INTER_LINEAR) for v in (inside.astype(np.float64), psi))
        # A pixel that mixes two surfaces takes the phase of the nearest one.
        lowest, highest = (
            cv2.morphologyEx(np.where(inside, psi, beyond), operation, np.ones((3, 3), np.uint8))
            for operation, beyond in ((cv2.MORPH_ERODE, np.inf), (cv2.MORPH_DILATE, -np.inf))
        )
        step = np.subtract(highest, lowest, out=np.zeros_like(psi), where=inside)
        beside_jump = nearest((step > JUMP_RAD).astype(np.uint8)) > 0
        return weight > 0.5, np.where(beside_jump, nearest(psi), total / np.maximum(weight, 1e-6)), nearest
