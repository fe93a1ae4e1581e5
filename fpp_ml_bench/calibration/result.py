"""What a calibration found: lens models, both devices, the pose between them, errors, and how sure
it is of each; its residuals as a picture."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import MAD_TO_SIGMA, MM_PER_M
from fpp_ml_bench.errors import CalibrationError
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.style import DEPTH_COLOURS, SIGMA_COLOURS, figure, figure_png, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fpp_ml_bench.optics.rig import Rig

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
    X_c + translation_mm``. ``scale`` says what the lengths were taken from. ``alone_rms_px``:
    the RMS of cv2.calibrateCamera for camera and projector each on its own with a perfect board.
    ``noise_px``: standard deviations of camera and projector coordinates that the residuals show,
    with whose inverse squares they were weighted. ``bic``: Bayesian information criterion.
    ``root`` (k, f): the covariance of the k parameters, fx, fy, cx, cy and coefficients of camera and
    projector, rotation vector and translation in mm, is its product with its transpose.
    ``board_mm``: the board's points (n, 3), estimated or given. ``doubts``: what is improbable, in
    sentences that begin with ``warning:``, or ``note:`` where it may well be right. Uncertainties
    take the residuals for independent: errors that all poses share, such as those of a board that
    is taken for perfect, make them too small."""

    camera: Device
    projector: Device
    rotation: tuple[tuple[float, float, float], ...]
    translation_mm: tuple[float, float, float]
    translation_sigma_mm: tuple[float, ...]
    scale: str
    alone_rms_px: tuple[float, float]
    noise_px: tuple[float, float]
    bic: float
    root: NDArray[np.float64] = field(repr=False, compare=False)
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

    def applied_to(self, rig: "Rig") -> "Rig":
        """``rig`` with the devices that were found, and the pose between them."""
        return replace(
            rig,
            camera=self.camera.pinhole,
            projector=self.projector.pinhole,
            rotation=self.rotation,
            translation_m=self.translation_m,
        )

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
def draw_residuals(
    calibration: Calibration, sigma_mm: Mapping[float, NDArray[np.float64]] | None = None
) -> bytes:
    """PNG of a calibration: for camera and projector the residuals by pose and the points in the
    image, and the RMS of each pose; and by three depths in mm what it leaves of the depth over the
    image, ``sigma_mm`` (n, m), NaN beside the pattern."""
    from matplotlib import colormaps

    poses, maps = calibration.poses, sigma_mm or {}
    colours = colormaps[DEPTH_COLOURS](np.linspace(0.05, 0.95, len(poses)))
    drawn = figure(13, 12 if maps else 8)
    plots = drawn.subplots(3 if maps else 2, 3)
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
    most = max((np.nanquantile(sigma, 0.95, method="lower") for sigma in maps.values()), default=0)
    camera = calibration.camera.pinhole
    for axes, (depth_mm, sigma) in zip(plots[2] if maps else (), maps.items(), strict=True):
        image = axes.imshow(
            sigma,
            SIGMA_COLOURS,
            extent=(-0.5, camera.width - 0.5, camera.height - 0.5, -0.5),
            vmin=0,
            vmax=most,
        )
        drawn.colorbar(image, ax=axes, label="mm", extend="max")
        axes.set(title=f"depth at {depth_mm:.0f} mm: standard uncertainty", xlabel="column, px")
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
