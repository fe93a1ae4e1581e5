"""The object mask: pixels whose grey level the empty scene does not explain.

Twice a period the object's fringe is as bright as the plane's would be, and a single pixel there does not show which it
is. Inside the object closing by a quarter of a period fills these stripes. At the silhouette two predictions compete:
the empty scene's, and that of the object's own fringe, extrapolated from the local fit beside it
(`fpp_ml_bench.baselines.phase_route.local_fit`). The prediction nearer to the pixel's grey level wins.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route.empty_scene import Background
from fpp_ml_bench.decoding import MIN_MODULATION

DIFFERENT_SIGMAS = 3.5
"""A pixel this far from the empty scene is not background; noise alone reaches it at isolated pixels, 1 in 2,000."""
CLOSING_PERIODS = 0.27
OBJECT_BONUS = 4.0
"""Added to the plane's squared misfit, in sigmas: a pixel that both predictions explain is object."""
UNLIT_PERIODS = 0.8
UNLIT_SIGMAS = 4.0
"""Brightest grey level, above ambient light, of what counts as unlit."""
DARKEST_GREY = MIN_MODULATION / 4
"""An object pixel with less modulation has no fringe: it lies in shadow or faces away, and gets no depth."""
LEAST_AREA_PERIODS = 0.1
"""Smallest object, and largest hole that is closed, in squares of one period."""


def disk(radius_px: float) -> NDArray[np.uint8]:
    """Disk as a structuring element of odd size."""
    half = max(1, round(radius_px))
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    return (x * x + y * y <= (half + 0.5) ** 2).astype(np.uint8)


def without_small(mask: NDArray[np.bool_], least_px: float) -> NDArray[np.bool_]:
    """``mask`` (H, W) without its 8-connected components of fewer than ``least_px`` pixels."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    keep = stats[:, cv2.CC_STAT_AREA] >= least_px
    keep[0] = False
    return keep[labels] if count > 1 else mask


def different(background: Background) -> NDArray[np.bool_]:
    """Pixels (H, W) whose own grey level the empty scene does not explain."""
    return np.abs(background.residual) > DIFFERENT_SIGMAS * background.noise_grey


def object_region(background: Background, period_px: float) -> NDArray[np.bool_]:
    """First mask (H, W): pixels that differ, closed over the stripes where object and plane are equally bright."""
    differing = different(background).astype(np.uint8)
    closed = cv2.morphologyEx(differing, cv2.MORPH_CLOSE, disk(CLOSING_PERIODS * period_px)) > 0
    area = LEAST_AREA_PERIODS * period_px**2
    region = without_small(closed, area)
    return region | ~without_small(~region, area)


def unlit(grey: NDArray[np.float32], ambient: float, noise: float, period_px: float) -> NDArray[np.bool_]:
    """Pixels (H, W) in ambient light alone over most of a period: closing fills the dark stripes of a fringe first."""
    size = 2 * round(UNLIT_PERIODS * period_px / 2) + 1
    filled = cv2.morphologyEx(grey, cv2.MORPH_CLOSE, np.ones((size, size), np.uint8), borderType=cv2.BORDER_REPLICATE)
    return filled < ambient + UNLIT_SIGMAS * noise


def refined(
    region: NDArray[np.bool_],
    background: Background,
    predicted: NDArray[np.float32],
    grey: NDArray[np.float32],
    fringe_noise: NDArray[np.floating],
    reach_px: float,
) -> NDArray[np.bool_]:
    """Mask (H, W) by the better of the two predictions within ``reach_px`` of the silhouette.

    ``predicted`` grey levels of the object's fringe, NaN where nothing near predicts it; ``fringe_noise``: its
    uncertainty in grey levels, beside the image's own noise.
    """
    noise = background.noise_grey
    as_plane = (background.residual / noise) ** 2
    with np.errstate(invalid="ignore"):
        as_object = (grey - predicted) ** 2 / (noise**2 + fringe_noise**2)
        nearer = as_object < as_plane + OBJECT_BONUS
    ring = cv2.dilate(region.astype(np.uint8), disk(reach_px)) > 0
    clear = different(background)
    # Pixels that differ stay. The others at the rim are object where the object's fringe explains them better.
    inner = cv2.erode(region.astype(np.uint8), disk(reach_px)) > 0
    votes = (clear & region) | inner | (ring & nearer)
    votes = without_small(votes, 4)
    smooth = cv2.medianBlur(votes.astype(np.uint8), 3) > 0
    return (smooth | (clear & region)) & ring
