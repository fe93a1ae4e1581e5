"""What a calibration found: lens models, both devices, the pose between them, errors, and how sure
it is of each; its residuals as a picture; and how far a rig's depth is from another's over the
working volume."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import MAD_TO_SIGMA, MM_PER_M
from fpp_ml_bench.decoding.triangulation import depth_from_both, depth_from_coordinate
from fpp_ml_bench.errors import CalibrationError
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import AXES
from fpp_ml_bench.style import DEPTH_COLOURS, figure, figure_png, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MODELS = {
    "none": (),
    "radial-1": (0,),
    "radial-2": (0, 1),
    "radial-3+tangential": (0, 1, 2, 3, 4),
    "rational": (0, 1, 2, 3, 4, 5, 6, 7),
}
"""Free coefficients, by their place in OpenCV's (k1, k2, p1, p2, k3, k4, k5, k6)."""
_FIXED = {
    0: cv2.CALIB_FIX_K1,
    1: cv2.CALIB_FIX_K2,
    2: cv2.CALIB_ZERO_TANGENT_DIST,
    4: cv2.CALIB_FIX_K3,
}
SPOILER_SIGMAS = 3.5
"""Robust standard deviations above the median, and at least half of the median, from which on a
pose's held-out error is high."""
SPOILER_SHARE = 1.2
"""Such a pose is named where its error in the fit is this many times the median, too: one that is
only unlike the others predicts badly, but fits."""
ACROSS = 24
"""Points along each side of the image at which two rigs are compared: enough for a mean of smooth
differences."""
DEPTHS = 9
"""Depths along the range at which they are compared."""


@dataclass(frozen=True)
class Lens:
    """A lens ``model`` of `MODELS`; ``square_pixels``: fx = fy; ``centred``: the principal point is
    the image's centre, ((W - 1) / 2, (H - 1) / 2). Raises `CalibrationError` for an unknown
    model."""

    model: str = "radial-3+tangential"
    square_pixels: bool = False
    centred: bool = False

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise CalibrationError(f"lens: expected one of {', '.join(MODELS)}, got {self.model!r}")

    def __str__(self) -> str:
        return self.model + ", fx = fy" * self.square_pixels + ", centred" * self.centred

    @property
    def coefficients(self) -> int:
        """Number of OpenCV's coefficients: 5, or 8 of the rational model."""
        return 8 if self.model == "rational" else 5

    @property
    def flags(self) -> int:
        """For cv2.calibrateCamera."""
        fixed = sum(flag for place, flag in _FIXED.items() if place not in MODELS[self.model])
        rational = cv2.CALIB_RATIONAL_MODEL * (self.coefficients == 8)
        square = cv2.CALIB_FIX_ASPECT_RATIO * self.square_pixels
        return fixed + rational + square + cv2.CALIB_FIX_PRINCIPAL_POINT * self.centred

    @property
    def free(self) -> NDArray[np.float64]:
        """Matrix (4 + coefficients, f) from the free parameters to (fx, fy, cx, cy,
        coefficients)."""
        unit = np.eye(4 + self.coefficients)
        focal = [unit[0] + unit[1]] if self.square_pixels else [unit[0], unit[1]]
        centre = [] if self.centred else [unit[2], unit[3]]
        return np.stack([*focal, *centre, *(unit[4 + i] for i in MODELS[self.model])], axis=1)


class Device(NamedTuple):
    """Camera or projector: its lens model, and the standard uncertainties ``sigma`` of fx, fy, cx,
    cy in px and of the distortion coefficients; 0 = not estimated."""

    lens: Lens
    pinhole: Pinhole
    sigma: tuple[float, ...]


class Errors(NamedTuple):
    """OpenCV's reprojection errors in px, the root of the mean squared distance over all points: of
    camera, projector and both."""

    camera: float
    projector: float
    both: float


def errors_px(camera: NDArray[np.float64], projector: NDArray[np.float64]) -> Errors:
    """The errors of residuals (n, 2) in px; NaN are left out."""
    parts = camera, projector, np.concatenate([camera, projector])
    return Errors(*(float(np.sqrt(np.nanmean((residuals**2).sum(axis=1)))) for residuals in parts))


@dataclass(frozen=True)
class FittedPose:
    """A pose of the board: rotation vector (rad) and translation (mm) to the camera's frame. Of
    camera and projector the measured coordinates and the residuals, projected less measured, (n, 2)
    px each, NaN where not measured. ``held_out_rms_px``: the RMS over both devices when the rig
    comes from the other poses and only the board's pose from this one; NaN where that was not
    computed."""

    name: str
    rotation_vector: tuple[float, ...]
    translation_mm: tuple[float, ...]
    held_out_rms_px: float
    measured_px: Sequence[NDArray[np.float64]] = field(repr=False, compare=False)
    residuals_px: Sequence[NDArray[np.float64]] = field(repr=False, compare=False)

    @property
    def rms_px(self) -> Errors:
        return errors_px(*self.residuals_px)


@dataclass(frozen=True)
class Calibration:
    """A calibrated rig. A point goes from the camera's frame to the projector's by ``X_p = rotation
    X_c + translation_mm``; ``rotation_sigma_rad`` is the uncertainty of a small turn about the axes
    of OpenCV's rotation vector. ``scale`` says what the lengths were taken from. ``alone_rms_px``:
    the RMS of cv2.calibrateCamera for camera and projector each on its own with a perfect board.
    ``noise_px``: standard deviations of camera and projector coordinates that the residuals show,
    with whose inverse squares they were weighted. ``bic``: Bayesian information criterion.
    ``board_mm``: the board's points (n, 3), estimated or given. ``doubts``: what is improbable, in
    sentences that begin with ``warning:``, or ``note:`` where it may well be right. Uncertainties
    take the residuals for independent: errors that all poses share, such as those of a board that
    is taken for perfect, make them too small."""

    camera: Device
    projector: Device
    rotation: tuple[tuple[float, float, float], ...]
    translation_mm: tuple[float, float, float]
    rotation_sigma_rad: tuple[float, ...]
    translation_sigma_mm: tuple[float, ...]
    scale: str
    alone_rms_px: tuple[float, float]
    noise_px: tuple[float, float]
    bic: float
    board_mm: NDArray[np.float64] = field(repr=False, compare=False)
    poses: tuple[FittedPose, ...] = field(repr=False)
    doubts: tuple[str, ...] = ()

    @property
    def rms_px(self) -> Errors:
        """The errors of the joint fit, over the points of all poses."""
        camera, projector = zip(*(pose.residuals_px for pose in self.poses), strict=True)
        return errors_px(np.concatenate(camera), np.concatenate(projector))

    @property
    def baseline_mm(self) -> float:
        return float(np.linalg.norm(self.translation_mm))

    @property
    def translation_m(self) -> tuple[float, float, float]:
        x, y, z = (length / MM_PER_M for length in self.translation_mm)
        return x, y, z

    @property
    def held_out_rms_px(self) -> float:
        """Root mean square of the poses' held-out errors: what lens models are compared by. NaN
        where not computed."""
        return float(np.sqrt(np.mean([pose.held_out_rms_px**2 for pose in self.poses])))

    @property
    def spoilers(self) -> tuple[str, ...]:
        """Names of poses that fit the others badly (`SPOILER_SIGMAS`)."""
        fitted = np.array([pose.rms_px.both for pose in self.poses])
        held_out = np.array([pose.held_out_rms_px for pose in self.poses])
        errors = fitted if np.isnan(held_out).any() else held_out
        middle = np.median(errors)
        limit = middle + max(
            SPOILER_SIGMAS * MAD_TO_SIGMA * np.median(np.abs(errors - middle)), 0.5 * middle
        )
        bad = (errors > limit) & (fitted > SPOILER_SHARE * np.median(fitted))
        return tuple(pose.name for pose, named in zip(self.poses, bad, strict=True) if named)


@styled
def draw_residuals(calibration: Calibration) -> bytes:
    """PNG of a calibration: for camera and projector the residuals by pose and the points in the
    image, and the RMS of each pose."""
    from matplotlib import colormaps

    poses = calibration.poses
    colours = colormaps[DEPTH_COLOURS](np.linspace(0.05, 0.95, len(poses)))
    drawn = figure(13, 8)
    plots = drawn.subplots(2, 3)
    for row, (name, device) in enumerate(
        (("camera", calibration.camera.pinhole), ("projector", calibration.projector.pinhole))
    ):
        scatter, cover = plots[row, 0], plots[row, 1]
        for pose, colour in zip(poses, colours, strict=True):
            errors = pose.residuals_px[row].T
            scatter.plot(*errors, ".", ms=3, color=colour, label=pose.name)
            cover.quiver(*pose.measured_px[row].T, *errors, color=colour, angles="xy", width=0.003)
        scatter.set(
            title=f"{name}: residuals, RMS {calibration.rms_px[row]:.3f} px",
            xlabel="x, px",
            ylabel="y, px",
            aspect="equal",
        )
        scatter.axhline(0, color="0.6", lw=0.6)
        scatter.axvline(0, color="0.6", lw=0.6)
        cover.set(
            title=f"{name}: points and residuals (enlarged)",
            xlabel="column, px",
            ylabel="row, px",
            aspect="equal",
            xlim=(-0.5, device.width - 0.5),
            ylim=(device.height - 0.5, -0.5),
        )
    _bars(plots[0, 2], calibration)
    plots[1, 2].axis("off")
    handles, labels = plots[0, 0].get_legend_handles_labels()
    plots[1, 2].legend(handles, labels, loc="upper left", ncols=1 + len(poses) // 20, markerscale=3)
    return figure_png(drawn, reduced=True)


def _bars(axes: "Axes", calibration: Calibration) -> None:
    """RMS of each pose in camera and projector, and held out; poses that spoil the fit are
    marked."""
    poses, place = calibration.poses, np.arange(len(calibration.poses))
    series = {
        "camera": [pose.rms_px.camera for pose in poses],
        "projector": [pose.rms_px.projector for pose in poses],
        "both, held out": [pose.held_out_rms_px for pose in poses],
    }
    for number, (label, values) in enumerate(series.items()):
        if np.isfinite(values).all():
            axes.bar(place + 0.27 * (number - 1), values, 0.27, label=label)
    marks = [pose.name + (" (!)" if pose.name in calibration.spoilers else "") for pose in poses]
    axes.set_xticks(place, marks, rotation=90 if len(poses) > 6 else 20, fontsize=7)
    axes.set(title="RMS by pose, (!) fits the others badly", ylabel="px")
    axes.legend()


class VolumeError(NamedTuple):
    """Depth by one rig minus depth by the true one: ``rms_mm``, ``worst_mm``, and ``scale``, the
    factor between the two by least squares (0.95 where a board's spacing was given 5% too
    small)."""

    rms_mm: float
    worst_mm: float
    scale: float


def volume_error_mm(rig: Rig, true_rig: Rig) -> VolumeError:
    """Depth error of ``rig`` where ``true_rig`` captures: a grid of points of the true working
    range, seen from the centres of as many parts of the image, goes to image and projector px by
    the true rig and back to depth by the other. Both are depths along the camera's axis, each of
    its own. Points beside the pattern don't count.

    Raises `CalibrationError` for images or patterns of different sizes, and where no point is left
    or one has no depth by ``rig``."""
    for device in ("camera", "projector"):
        sizes = [
            (part.width, part.height) for part in (getattr(rig, device), getattr(true_rig, device))
        ]
        if sizes[0] != sizes[1]:
            (w, h), (true_w, true_h) = sizes
            raise CalibrationError(
                f"{device}: expected {true_w} x {true_h} px as in the true rig, got {w} x {h} px"
            )
    camera, projector = true_rig.camera, true_rig.projector
    sides = (
        (np.arange(ACROSS) + 0.5) * (length / ACROSS) - 0.5
        for length in (camera.width, camera.height)
    )
    column, row = (axis.ravel() for axis in np.meshgrid(*sides))
    x, y = camera.normalised(column, row)
    near_m, far_m = (limit / MM_PER_M for limit in true_rig.working_range_mm)
    depth_m = np.linspace(near_m, far_m, DEPTHS)[:, None]
    u, v = true_rig.project(
        np.stack([x * depth_m, y * depth_m, np.broadcast_to(depth_m, (DEPTHS, x.size))], axis=-1)
    )
    shown = (u >= -0.5) & (u <= projector.width - 0.5) & (v >= -0.5) & (v <= projector.height - 0.5)
    if not shown.any():
        raise CalibrationError(
            "no point of the true rig's working range is on both image and pattern; check that rig"
        )
    rays = rig.camera.normalised(column, row)
    if len(rig.directions) == 2:
        weights = (
            1.0 / true_rig.code(direction).sigma_px(1.0, 1.0) ** 2 for direction in AXES
        )  # as the decoder's
        found_mm = depth_from_both(rays, u, v, rig, *weights).depth_mm
    else:
        (direction,) = rig.directions
        found_mm = depth_from_coordinate(rays, u if direction == "vertical" else v, rig, direction)
    true_mm = np.broadcast_to(depth_m * MM_PER_M, u.shape)[shown]
    found_mm = found_mm[shown]
    lost = int(np.isnan(found_mm).sum())
    if lost:
        raise CalibrationError(
            f"{lost} of {len(found_mm)} points of the true rig's working range have no depth by "
            f"the other rig, so the "
            "two have nothing in common; check rotation, translation and the sign of the axes"
        )
    error = found_mm - true_mm
    scale = float((found_mm * true_mm).sum() / (true_mm * true_mm).sum())
    return VolumeError(float(np.sqrt((error * error).mean())), float(np.abs(error).max()), scale)
