"""A rig's depth over its working volume: how far it is from another rig's, and how sure a calibration
leaves it.

A calibration's covariance is carried to depth through a grid of points of the working range, by
derivatives of what the rig finds there, as mrcal carries a camera's to its projection. All points
share the error, so that no averaging of pixels makes it smaller.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding.triangulation import (
    coordinate_slope_px_per_mm,
    depth_from_both,
    depth_from_coordinate,
)
from fpp_ml_bench.errors import CalibrationError
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import AXES

ACROSS = 24
"""Points along each side of the image at which two rigs are compared: enough for a mean of smooth
differences."""
DEPTHS = 9
"""Depths along the range at which they are compared."""
STEP = 0.1
"""Of the derivatives, in standard deviations: small for the lens, and far above rounding."""
LENS_VALUES = 4
"""Of a lens before its coefficients: fx, fy, cx, cy."""


@dataclass(frozen=True)
class Places:
    """Points before ``rig``: ``column`` and ``row`` (n,) px of the camera, ``depth_mm`` (d, n),
    where the rig shows them in its pattern, ``u`` and ``v`` (d, n) px, and which of them lie on it,
    ``shown`` (d, n)."""

    rig: Rig
    column: NDArray[np.float64]
    row: NDArray[np.float64]
    depth_mm: NDArray[np.float64]
    u: NDArray[np.float64]
    v: NDArray[np.float64]
    shown: NDArray[np.bool_]

    @classmethod
    def at(cls, rig: Rig, column: NDArray, row: NDArray, depth_mm: NDArray) -> "Places":
        """The points seen at ``column`` and ``row`` (n,) px, at depths (d, n) or (d, 1). Raises
        `CalibrationError` where none of them is on the pattern."""
        depth_m = np.broadcast_to(depth_mm, (len(depth_mm), len(column))) / MM_PER_M
        u, v = rig.seen(rig.camera.normalised(column, row), depth_m)
        shown = rig.projector.holds(u, v)
        if not shown.any():
            raise CalibrationError(
                "no point of the true rig's working range is on both image and pattern; check that "
                "rig"
            )
        return cls(rig, column, row, depth_m * MM_PER_M, u, v, shown)

    @classmethod
    def over(cls, rig: Rig) -> "Places":
        """`DEPTHS` times `ACROSS`^2 points over the working range, seen from the centres of as many
        parts of the image. Raises `CalibrationError` as `at`."""
        sides = (
            (np.arange(ACROSS) + 0.5) * (length / ACROSS) - 0.5
            for length in (rig.camera.width, rig.camera.height)
        )
        column, row = (axis.ravel() for axis in np.meshgrid(*sides))
        return cls.at(rig, column, row, np.linspace(*rig.working_range_mm, DEPTHS)[:, None])

    def found_mm(self, rig: Rig) -> NDArray[np.float64]:
        """Depth of the points (d, n) by another ``rig``, NaN where it has none; both depths are
        along the camera's axis, each of its own."""
        rays = rig.camera.normalised(self.column, self.row)
        if len(rig.directions) == 2:
            weights = (
                1.0 / self.rig.code(direction).sigma_px(1.0, 1.0) ** 2 for direction in AXES
            )  # as the decoder's
            return depth_from_both(rays, self.u, self.v, rig, *weights).depth_mm
        (direction,) = rig.directions
        coordinate = self.u if direction == "vertical" else self.v
        return depth_from_coordinate(rays, coordinate, rig, direction)


class VolumeError(NamedTuple):
    """Depth by one rig minus depth by the true one: ``rms_mm``, ``worst_mm``, and ``scale``, the
    factor between the two by least squares (0.95 where a board's spacing was given 5% too
    small)."""

    rms_mm: float
    worst_mm: float
    scale: float


def volume_error_mm(rig: Rig, true_rig: Rig) -> VolumeError:
    """Depth error of ``rig`` where ``true_rig`` captures: points of its working range go to image and
    projector px by the true rig and back to depth by the other. Points beside the pattern don't
    count.

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
    places = Places.over(true_rig)
    true_mm, found_mm = places.depth_mm[places.shown], places.found_mm(rig)[places.shown]
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


def moved(rig: Rig, change: NDArray[np.float64]) -> Rig:
    """The rig with ``change`` (k,) added to its parameters, in the order of `Calibration.root`."""
    devices, start = [], 0
    for device in (rig.camera, rig.projector):
        terms = np.array(device.distortion)
        end = start + LENS_VALUES + len(terms)
        lens, bent = change[start : start + LENS_VALUES], change[start + LENS_VALUES : end]
        values = np.array([device.fx, device.fy, device.cx, device.cy]) + lens
        fx, fy, cx, cy = values.tolist()
        bend = tuple((terms + bent).tolist())
        devices.append(Pinhole(device.width, device.height, fx, fy, cx, cy, bend))
        start = end
    turn = cv2.Rodrigues(cv2.Rodrigues(rig.R)[0].ravel() + change[start : start + 3])[0]
    x, y, z = rig.t + change[start + 3 :] / MM_PER_M
    rotation = tuple(tuple(row) for row in turn.tolist())
    camera, projector = devices
    return replace(
        rig, camera=camera, projector=projector, rotation=rotation, translation_m=(x, y, z)
    )


class Spread(NamedTuple):
    """How sure a calibration leaves the depth of `Places`: ``mm`` (d, n), its standard uncertainty,
    NaN beside the pattern, infinite where nothing is known (far from all boards); and ``px``
    (d, n), the same as an error of a projector coordinate, which differs less over the volume."""

    mm: NDArray[np.float64]
    px: NDArray[np.float64]

    @property
    def median_px(self) -> float:
        return float(np.nanmedian(self.px))

    def maps(self, places: Places) -> dict[float, NDArray[np.float64]]:
        """Of `Places.over`, by depth in mm at the near end of the range, its middle and its far
        end: ``mm`` over the image, (`ACROSS`, `ACROSS`)."""
        return {
            float(places.depth_mm[at, 0]): self.mm[at].reshape(ACROSS, ACROSS)
            for at in (0, DEPTHS // 2, DEPTHS - 1)
        }


def depth_spread(places: Places, root: NDArray[np.float64]) -> Spread:
    """What the covariance of the calibration of the places' rig, by its ``root``
    (`Calibration.root`), leaves of the depth. By central differences along the axes of the
    covariance: parameters alone may be so unsure that no lens has them."""
    rig = places.rig
    axes, lengths, _ = np.linalg.svd(root, full_matrices=False)
    variance = np.zeros(places.u.shape)
    for change in STEP * (axes * lengths).T:
        ahead, behind = (places.found_mm(moved(rig, sign * change)) for sign in (1, -1))
        variance += ((ahead - behind) / (2 * STEP)) ** 2
    known = np.where(np.isnan(variance), np.inf, np.sqrt(variance))
    sigma_mm = np.where(places.shown, known, np.nan)
    rays = rig.camera.normalised(places.column, places.row)
    px_per_mm = np.sqrt(
        sum(
            coordinate_slope_px_per_mm(rig, places.depth_mm, direction, rays) ** 2
            for direction in rig.directions
        )
    )
    return Spread(sigma_mm, sigma_mm * px_per_mm)
