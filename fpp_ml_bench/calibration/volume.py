"""How far a rig's depth is from another's, over the working volume: what a calibration's error does to depth."""

from typing import NamedTuple

import numpy as np

from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding import depth_from_both, depth_from_coordinate
from fpp_ml_bench.errors import CalibrationError
from fpp_ml_bench.optics import AXES, Rig

ACROSS, DEPTHS = 24, 9
"""Points across the image, along each side, and along the range."""


class VolumeError(NamedTuple):
    """Depth by one rig minus depth by the true one: ``rms_mm``, ``worst_mm``, and ``scale``, the factor between the two
    by least squares (0.95 where a board's spacing was given 5% too small)."""

    rms_mm: float
    worst_mm: float
    scale: float


def volume_error_mm(rig: Rig, true_rig: Rig) -> VolumeError:
    """Depth error of ``rig`` where ``true_rig`` captures: a grid of points of the true working range, seen from the
    centres of as many parts of the image, goes to image and projector px by the true rig and back to depth by the
    other. Both are depths along the camera's axis, each of its own. Points beside the pattern don't count.

    Raises `CalibrationError` for images or patterns of different sizes, and where no point is left or one has no depth
    by ``rig``."""
    for device in ("camera", "projector"):
        sizes = [(part.width, part.height) for part in (getattr(rig, device), getattr(true_rig, device))]
        if sizes[0] != sizes[1]:
            (w, h), (true_w, true_h) = sizes
            raise CalibrationError(f"{device}: expected {true_w} x {true_h} px as in the true rig, got {w} x {h} px")
    camera, projector = true_rig.camera, true_rig.projector
    sides = ((np.arange(ACROSS) + 0.5) * (length / ACROSS) - 0.5 for length in (camera.width, camera.height))
    column, row = (axis.ravel() for axis in np.meshgrid(*sides))
    x, y = camera.normalised(column, row)
    near_m, far_m = (limit / MM_PER_M for limit in true_rig.working_range_mm)
    depth_m = np.linspace(near_m, far_m, DEPTHS)[:, None]
    u, v = true_rig.project(np.stack([x * depth_m, y * depth_m, np.broadcast_to(depth_m, (DEPTHS, x.size))], axis=-1))
    shown = (u >= -0.5) & (u <= projector.width - 0.5) & (v >= -0.5) & (v <= projector.height - 0.5)
    if not shown.any():
        raise CalibrationError("no point of the true rig's working range is on both image and pattern; check that rig")
    rays = rig.camera.normalised(column, row)
    if len(rig.directions) == 2:
        weights = (1.0 / true_rig.code(direction).sigma_px(1.0, 1.0) ** 2 for direction in AXES)  # as the decoder's
        found_mm = depth_from_both(rays, u, v, rig, *weights).depth_mm
    else:
        (direction,) = rig.directions
        found_mm = depth_from_coordinate(rays, u if direction == "vertical" else v, rig, direction)
    true_mm = np.broadcast_to(depth_m * MM_PER_M, u.shape)[shown]
    found_mm = found_mm[shown]
    lost = int(np.isnan(found_mm).sum())
    if lost:
        raise CalibrationError(
            f"{lost} of {len(found_mm)} points of the true rig's working range have no depth by the other rig, so the "
            "two have nothing in common; check rotation, translation and the sign of the axes"
        )
    error = found_mm - true_mm
    scale = float((found_mm * true_mm).sum() / (true_mm * true_mm).sum())
    return VolumeError(float(np.sqrt((error * error).mean())), float(np.abs(error).max()), scale)
