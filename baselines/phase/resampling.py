"""Images with a fringe period far from the one that a method was made for: resampled, and the result sampled back.

Windows, steps of the grid of orders and filters of a network have a size in pixels of the fringe. So an image with a
period of 116 px is measured at 22.6 px, and a network that learnt from 22.6 px gets an image of 6 px enlarged. A
longer period loses nothing: a local fit averages over a quarter of it anyway, and the image is shrunk by averaging.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import TAU, CalibrationLayer, Candidates, Image, Mask
from fpp_ml_bench.baselines.phase.object_mask import Crop
from fpp_ml_bench.baselines.phase.observation import Measurement, Reason
from fpp_ml_bench.baselines.phase.orders import nearest_inside
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import Direction

JUMP_RAD = 1.0  # difference of residual phase from which on a pixel lies beside a jump, and nothing is interpolated
CLIPPED_SHARE = 0.1  # of an averaged pixel that makes it saturated


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
    def of(cls, rig: Rig, direction: Direction, periods: Periods) -> "Resampling":
        """What brings the fringes of ``direction`` into ``periods``."""
        return cls.to(rig, rig.image_px_per_period(direction), periods)

    @classmethod
    def to(cls, rig: Rig, seen_px: float, periods: Periods) -> "Resampling":
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

    def restored_phase(
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

    def restored(
        self,
        measured: Measurement,
        layer: CalibrationLayer,
        captured_layer: CalibrationLayer,
        range_mm: tuple[float, float],
    ) -> Measurement:
        """The measurement in the size of the captured image. The residual phase, order included, is interpolated (it
        has no wraps), but not across jumps; depth, wrapped phase and order follow from it at every pixel of the
        captured image. The other maps are taken from the nearest pixel. ``range_mm``: the range of the candidates."""
        inside = np.isfinite(measured.wrapped_phase_rad)
        psi = np.where(inside, layer.residual_phase(measured.wrapped_phase_rad, measured.order), 0.0)
        on_object, phases, nearest = self.restored_phase(psi, inside)
        part = captured_layer.at(on_object)
        residual = phases[on_object]
        absolute = residual + part.infinity_rad + TAU * part.infinity_order
        order = np.rint(absolute / TAU)
        phase = (absolute - TAU * order).astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth_mm = part.depth_of_residual_mm(residual)
        outside = ~self.captured.in_range(depth_mm)
        depth_mm[outside | (nearest(measured.depth_mm)[on_object] == 0)] = 0.0
        allowed = part.orders_in_range(phase, range_mm)

        def paste(values: NDArray, dtype: type, outside: float = 0) -> NDArray:
            image: NDArray = np.full(on_object.shape, outside, dtype=dtype)
            image[on_object] = values
            return image

        def pasted(image: Image) -> Image:
            return paste(nearest(image)[on_object], np.float32)

        reasons = nearest(measured.reason)[on_object]
        reasons[outside & ((reasons == Reason.MEASURED) | (reasons > Reason.OUT_OF_RANGE))] = Reason.OUT_OF_RANGE
        reason = paste(reasons, np.uint8, Reason.BACKGROUND)
        counts = np.bincount(reason.ravel(), minlength=len(Reason))
        return replace(
            measured,
            wrapped_phase_rad=paste(phase, np.float32, np.nan),
            order=paste(order, np.int32),
            candidates=Candidates(paste(allowed.first, np.int32), paste(allowed.count, np.int32)),
            depth_mm=paste(depth_mm, np.float32),
            reason=reason,
            counts={code.name.lower(): int(counts[code]) for code in Reason},
            modulation_grey=pasted(measured.modulation_grey),
            confidence=pasted(measured.confidence),
            expected_error_mm=pasted(measured.expected_error_mm),
            order_doubt_mm=pasted(measured.order_doubt_mm),
        )
