"""What the network sees of a decoded view: maps without a distance, a direction or a grey level."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import Image, Mask

CHANNELS = (
    "found",
    "against the mean of near neighbours",
    "against the mean of far neighbours",
    "sigma",
    "modulation",
    "slope",
    "spread",
)
NEAR_PX, FAR_PX = 1.0, 3.0
"""Standard deviations of the Gaussians over which neighbours are averaged."""
MARGIN_PX = 8  # of the crop around the found pixels
FURTHEST = 8.0  # sigmas at which a deviation is clipped
TINY = 1e-6


@dataclass(frozen=True)
class DepthScene:
    """The part ``crop`` of a decoded view, float32 maps (h, w): ``depth_mm``, less its median ``middle_mm``, and
    ``sigma_mm``, both 0 where nothing is ``found``; ``modulation`` in grey levels, 0 where there is none. ``unit_mm``:
    median of sigma, and ``bright``: of the modulation, over the found pixels of the view."""

    crop: tuple[slice, slice]
    depth_mm: Image
    sigma_mm: Image
    modulation: Image
    found: Mask
    middle_mm: float
    unit_mm: float
    bright: float

    @classmethod
    def of(cls, depth_mm: Image, sigma_mm: Image, modulation: Image) -> "DepthScene | None":
        """From maps (H, W), of which a depth of 0 is none; None where nothing was found."""
        found = (depth_mm > 0) & (sigma_mm > 0)
        if not found.any():
            return None
        crop = tuple(
            slice(max(int(places[0]) - MARGIN_PX, 0), int(places[-1]) + 1 + MARGIN_PX)
            for places in (np.flatnonzero(found.any(axis=1)), np.flatnonzero(found.any(axis=0)))
        )
        rows, columns = crop
        found = found[rows, columns]
        middle = float(np.median(depth_mm[rows, columns][found]))
        relative = np.where(found, depth_mm[rows, columns] - np.float32(middle), 0).astype(np.float32)
        sigma = np.where(found, sigma_mm[rows, columns], 0).astype(np.float32)
        light = np.nan_to_num(modulation[rows, columns]).astype(np.float32)
        unit, bright = (float(np.median(maps[found])) for maps in (sigma, light))
        return cls((rows, columns), relative, sigma, light, found, middle, unit, max(bright, TINY))

    def with_maps(self, change: Callable[[NDArray], NDArray]) -> "DepthScene":
        """The same with every map changed alike; ``crop`` stays."""
        names = "depth_mm", "sigma_mm", "modulation", "found"
        maps: dict[str, Any] = {name: np.ascontiguousarray(change(getattr(self, name))) for name in names}
        return replace(self, **maps)


def channels(scene: DepthScene) -> NDArray[np.float32]:
    """Input of the network (`CHANNELS`, h, w) float32, the same for any orientation of the image."""
    found, depth, sigma = scene.found, scene.depth_mm, scene.sigma_mm
    weight = np.zeros_like(depth)
    np.divide(1.0, np.square(sigma), out=weight, where=found)
    typical = np.float32(scene.unit_mm)
    unit = np.where(found, sigma, typical)
    near, far = (_mean(depth, weight, px) for px in (NEAR_PX, FAR_PX))
    spread = np.sqrt(np.maximum(_mean(np.square(depth - near), weight, NEAR_PX), 0)) / unit
    across, down = (cv2.Sobel(near, cv2.CV_32F, *axes, scale=1 / 8) for axes in ((1, 0), (0, 1)))
    slope = np.hypot(across, down) / unit
    detail = [np.clip((depth - mean) / unit, -FURTHEST, FURTHEST) / 2 * found for mean in (near, far)]
    relative = np.log(np.maximum(scene.modulation, TINY) / np.float32(scene.bright))
    maps = (
        found,
        *detail,
        np.log(unit / typical),
        np.clip(relative, -3, 3),
        np.log1p(slope),
        np.log1p(spread),
    )
    return np.stack([np.asarray(one, dtype=np.float32) for one in maps])


def _mean(values: Image, weight: Image, px: float) -> Image:
    """Mean of ``values`` under a Gaussian of ``px`` and by ``weight``; 0 where there is no weight near."""
    total = cv2.GaussianBlur(values * weight, (0, 0), px)
    of_weight = cv2.GaussianBlur(weight, (0, 0), px)
    mean: Image = np.divide(total, of_weight, out=np.zeros_like(total), where=of_weight > 0)
    return mean
