"""Targets of the probes, from the true depth: edges, depth, and the fringe's phase and order at every pixel."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route import TAU
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.depth import normalise, object_mask
from fpp_ml_bench.optics import Direction, Rig

Image = NDArray[np.float32]


@dataclass(frozen=True)
class Truth:
    """Ground truth of a sample, each map (H, W).

    ``inside``: the object mask. ``edges``: `edge_map`, [0, 1]. ``depth``: normalised to the sample's own range,
    background 0 (the paper's target). ``depth_mm``. ``sine``, ``cosine``: of the wrapped phase, 0 outside the object.
    ``order``: the fringe order minus that of a plane at the rig's standoff, 0 outside the object; the plane's order
    follows from the pixel's position alone.
    """

    inside: NDArray[np.bool_]
    edges: Image
    depth: Image
    depth_mm: Image
    sine: Image
    cosine: Image
    order: Image


def truth(depth_mm: Image, rig: Rig, direction: Direction) -> Truth:
    """`Truth` of a depth map (H, W) in mm, 0 = background, seen by ``rig`` under fringes of ``direction``.

    Raises ``ValueError`` for a map without an object.
    """
    inside = object_mask(depth_mm)
    if not inside.any():
        raise ValueError("expected a depth map with an object, got background throughout")
    object_depths = depth_mm[inside]
    periods = np.where(inside, periods_at(depth_mm, rig, direction), 0.0)
    phase = TAU * (periods - np.floor(periods))
    order = np.floor(periods) - np.where(inside, np.floor(_standoff_periods(rig, direction)), 0.0)
    return Truth(
        inside,
        edge_map(depth_mm),
        normalise(depth_mm, "individual", float(object_depths.min()), float(object_depths.max())),
        np.asarray(depth_mm, dtype=np.float32),
        np.where(inside, np.sin(phase), 0.0).astype(np.float32),
        np.where(inside, np.cos(phase), 0.0).astype(np.float32),
        order.astype(np.float32),
    )


def edge_map(depth_mm: NDArray) -> Image:
    """Sobel gradient magnitude (3 x 3) of a depth map (H, W), divided by its largest value: float32 in [0, 1].

    The paper specifies only "Sobel filtering of the ground truth depth"; the scale is ours. A constant map gives 0.
    """
    import cv2

    depth = np.asarray(depth_mm, dtype=np.float32)
    across = cv2.Sobel(depth, cv2.CV_32F, 1, 0, ksize=3)
    down = cv2.Sobel(depth, cv2.CV_32F, 0, 1, ksize=3)
    strength = np.hypot(across, down).astype(np.float32)
    top = float(strength.max())
    return (strength / top).astype(np.float32) if top > 0 else strength


def fringe_variation(grey: NDArray[np.uint8], period_px: float) -> Image:
    """Standard deviation of a fringe image (H, W) over a square window of one period, in grey levels, float32.

    The window side is the smallest odd number of px that covers ``period_px``, at least 3; the image is mirrored at its
    border.
    """
    import cv2

    side = max(3, 2 * int(np.ceil((period_px - 1) / 2)) + 1)
    image = np.asarray(grey, dtype=np.float64)
    mean = cv2.blur(image, (side, side), borderType=cv2.BORDER_REFLECT_101)
    square = cv2.blur(image * image, (side, side), borderType=cv2.BORDER_REFLECT_101)
    return np.sqrt(np.maximum(square - mean * mean, 0)).astype(np.float32)


def periods_at(depth_mm: NDArray, rig: Rig, direction: Direction) -> NDArray[np.float64]:
    """Position of each pixel's surface point on the pattern, in fringe periods from the projector's first px, (H, W).

    The fraction is the wrapped phase / 2 pi and the integer part the fringe order. NaN where depth is 0.
    """
    x, y = rig.camera.rays()
    z = np.where(depth_mm > 0, depth_mm, np.nan).astype(np.float64) / MM_PER_M
    projected = rig.project(np.stack([x * z, y * z, z], axis=-1))
    return projected[0 if direction == "vertical" else 1] / rig.pitch(direction)


@lru_cache(maxsize=2)
def _standoff_periods(rig: Rig, direction: Direction) -> NDArray[np.float64]:
    plane = np.full((rig.camera.height, rig.camera.width), rig.standoff_m * MM_PER_M)
    return periods_at(plane, rig, direction)
