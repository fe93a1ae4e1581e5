"""The brightness that each candidate order predicts: fall-off with distance, and the slope of the surface.

The phase fixes how fast 1/Z changes along the surface whatever the order; the order fixes Z itself. Together they give
distance and normal of every candidate, and so the brightness of a matte surface there: cos(theta) / r^2 of the light
that the background plane has calibrated. A surface one order nearer is closer to the lamp and also turned more towards
it, so the candidates differ by a third in brightness. This cue assumes the same albedo for plane and objects, which is
true of the paper's scenes (Section 2.2) but not of painted objects: `PhaseMethod(shading=False)` works without it.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route.calibration_layer import TAU, CalibrationLayer
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.optics import Rig

Image = NDArray[np.float32]
Crop = tuple[slice, slice]

STEEPEST_RAD_PER_PX = 0.5
"""Largest change of the residual phase a px that counts as slope; the carrier itself changes by 0.28."""


def wrapped(phase_rad: NDArray) -> NDArray:
    """``phase_rad`` less the nearest whole number of periods, in [-pi, pi]."""
    return phase_rad - TAU * np.rint(phase_rad / TAU)


def phase_slopes(residual_rad: Image, inside: NDArray[np.bool_], smooth_px: float) -> tuple[Image, Image]:
    """Change of the residual phase a px along x and y, float32 (H, W), averaged under a Gaussian inside the mask."""
    size = 2 * int(np.ceil(2.5 * smooth_px)) + 1
    weight = cv2.erode(inside.astype(np.float32), np.ones((3, 3), np.uint8))
    total = np.maximum(cv2.GaussianBlur(weight, (size, size), smooth_px, borderType=cv2.BORDER_CONSTANT), 1e-3)
    slopes: list[Image] = []
    for axis in (1, 0):
        change: NDArray = wrapped(np.roll(residual_rad, -1, axis) - np.roll(residual_rad, 1, axis)) / 2
        change = np.clip(change, -STEEPEST_RAD_PER_PX, STEEPEST_RAD_PER_PX).astype(np.float32) * weight
        smooth = cv2.GaussianBlur(change, (size, size), smooth_px, borderType=cv2.BORDER_CONSTANT)
        slopes.append((smooth / total).astype(np.float32))
    return slopes[0], slopes[1]


def irradiance(
    layer: CalibrationLayer, residual_rad: NDArray, slopes: tuple[Image, Image], rig: Rig, crop: Crop
) -> Image:
    """cos(theta) / r^2 in 1/m^2 that a matte surface receives from the projector, float32 (H, W); below 0: turned away.

    ``residual_rad`` (H, W) of one candidate on the pixels ``crop`` of the image, ``slopes`` its change a px.
    """
    x, y = (axis[crop].astype(np.float32) for axis in rig.camera.rays())
    z = (layer.depth_of_residual_mm(residual_rad) / MM_PER_M).astype(np.float32)
    if layer.lens is None:
        rate = -layer.gain / (residual_rad * residual_rad * layer.forward)
    else:
        rate = (layer.depth_of_residual_mm(residual_rad + 1e-3) / MM_PER_M - z) / 1e-3
    # At a fixed psi depth still changes with the pixel where the projector is rotated against the camera.
    zx, zy = (
        (rate * slope + _drift(layer, residual_rad, z, axis, crop)).astype(np.float32)
        for axis, slope in ((1, slopes[0]), (0, slopes[1]))
    )
    dx, dy = np.float32(1 / rig.camera.fx), np.float32(1 / rig.camera.fy)
    # Tangents of the surface Z (x, y, 1) along the image's rows and columns, and their cross product.
    ax, ay, az = zx * x + z * dx, zx * y, zx
    bx, by, bz = zy * x, zy * y + z * dy, zy
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    cx, cy, cz = (np.float32(c) for c in -rig.R.T @ rig.t)
    lx, ly, lz = cx - z * x, cy - z * y, cz - z
    squared = lx * lx + ly * ly + lz * lz
    length = np.sqrt((nx * nx + ny * ny + nz * nz) * squared)
    return -(nx * lx + ny * ly + nz * lz) / (length * squared)


def _drift(layer: CalibrationLayer, residual_rad: NDArray, z: Image, axis: int, crop: Crop) -> NDArray | float:
    """Change of depth in m a px along ``axis`` at a fixed residual phase."""
    if min(layer.gain.shape) < 2:
        return 0.0
    step = crop[axis].step or 1
    gain, forward = (np.gradient(values, axis=axis) / step for values in (layer.gain, layer.forward))
    if not gain.any() and not forward.any():
        return 0.0
    return (gain / residual_rad - z * forward) / layer.forward
