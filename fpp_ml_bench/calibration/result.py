"""What a calibration found: both devices, the pose between them, errors, and how sure it is of each."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.calibration.lens import Lens
from fpp_ml_bench.constants import MAD_TO_SIGMA, MM_PER_M
from fpp_ml_bench.optics import Pinhole

SPOILER_SIGMAS, SPOILER_SHARE = 3.5, 1.2
"""A pose is named when its held-out error lies above the median by this many robust sigmas and by half of the median,
and its error in the fit is this many times the median: one that is only unlike the others predicts badly, but fits."""


@dataclass(frozen=True)
class Device:
    """Camera or projector: size in px, intrinsics in px with their standard uncertainties ``sigma`` (fx, fy, cx, cy; 0
    = not estimated), OpenCV's distortion coefficients (5, or 8 of the rational model) with theirs."""

    lens: Lens
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...]
    sigma: tuple[float, ...]
    distortion_sigma: tuple[float, ...]

    def pinhole(self) -> Pinhole:
        """As a part of the package's `Rig`. Raises `RigError` where it can't be one."""
        return Pinhole(self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.distortion)  # type: ignore[arg-type]


@dataclass(frozen=True)
class FittedPose:
    """A pose of the board: rotation vector (rad) and translation (mm) to the camera's frame, its RMS errors, and the
    residuals, projected less measured (n, 2) px, NaN where not measured. ``held_out_rms_px``: the RMS over both devices
    when the rig comes from the other poses and only the board's pose from this one; NaN where that was not computed."""

    name: str
    rotation_vector: tuple[float, ...]
    translation_mm: tuple[float, ...]
    camera_rms_px: float
    projector_rms_px: float
    stereo_rms_px: float
    held_out_rms_px: float
    corners_px: NDArray[np.float64] = field(repr=False, compare=False)
    projector_px: NDArray[np.float64] = field(repr=False, compare=False)
    camera_residuals_px: NDArray[np.float64] = field(repr=False, compare=False)
    projector_residuals_px: NDArray[np.float64] = field(repr=False, compare=False)


@dataclass(frozen=True)
class Calibration:
    """A calibrated rig. A point goes from the camera's frame to the projector's by ``X_p = rotation X_c +
    translation_mm``; ``rotation_sigma_rad`` is the uncertainty of a small turn about the axes of OpenCV's rotation
    vector. RMS errors are OpenCV's, the root of the mean squared distance over all points: of the joint fit, and
    ``alone_rms_px`` of cv2.calibrateCamera for camera and projector each on its own with a perfect board.
    ``noise_px``: standard deviations of camera and projector coordinates that the residuals show, with whose inverse
    squares they were weighted. ``board_mm``: the board's points (n, 3), estimated or given. Uncertainties take the
    residuals for independent: errors that all poses share, such as those of a board that is taken for perfect, make
    them too small."""

    camera: Device
    projector: Device
    rotation: tuple[tuple[float, float, float], ...]
    translation_mm: tuple[float, float, float]
    rotation_sigma_rad: tuple[float, ...]
    translation_sigma_mm: tuple[float, ...]
    baseline_sigma_mm: float
    spacing_mm: float
    scale: str
    camera_rms_px: float
    projector_rms_px: float
    stereo_rms_px: float
    alone_rms_px: tuple[float, float]
    noise_px: tuple[float, float]
    bic: float
    board_estimated: bool
    board_mm: NDArray[np.float64] = field(repr=False, compare=False)
    poses: tuple[FittedPose, ...] = field(repr=False)

    @property
    def baseline_mm(self) -> float:
        return float(np.linalg.norm(self.translation_mm))

    @property
    def translation_m(self) -> tuple[float, float, float]:
        """For the package's `Rig`, with `rotation` and the pinholes of `camera` and `projector`."""
        x, y, z = (length / MM_PER_M for length in self.translation_mm)
        return x, y, z

    @property
    def held_out_rms_px(self) -> float:
        """Root mean square of the poses' held-out errors: what lens models are compared by. NaN where not computed."""
        return float(np.sqrt(np.mean([pose.held_out_rms_px**2 for pose in self.poses])))

    @property
    def spoilers(self) -> tuple[str, ...]:
        """Names of poses that fit the others badly (`SPOILER_SIGMAS`)."""
        fitted = np.array([pose.stereo_rms_px for pose in self.poses])
        held_out = np.array([pose.held_out_rms_px for pose in self.poses])
        errors = fitted if np.isnan(held_out).any() else held_out
        middle = np.median(errors)
        limit = middle + max(SPOILER_SIGMAS * MAD_TO_SIGMA * np.median(np.abs(errors - middle)), 0.5 * middle)
        bad = (errors > limit) & (fitted > SPOILER_SHARE * np.median(fitted))
        return tuple(pose.name for pose, named in zip(self.poses, bad, strict=True) if named)
