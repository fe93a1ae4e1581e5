"""Depth from projector coordinates: closed form from a single coordinate, least squares from both, for any rig.

A camera pixel's ray is ``Z (x, y, 1)``; with ``a = R (x, y, 1)`` it runs through ``Z a + t`` in the projector's frame
and projects to ``(Z a_0 + t_0) / (Z a_2 + t_2)``. A single ideal projector coordinate x_p therefore gives

    Z = (x_p t_2 - t_0) / (a_0 - x_p a_2)            (and likewise y_p with a_1, t_1),

which for the paper's rig is ``Z = f_p b / (u_p - c_u - f_p x)``. Depth is the camera's z, not the length of the ray.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics import AXES, DIRECTIONS, Direction, Maps, Rig, distort

GAUSS_NEWTON_STEPS = 3
"""The algebraic start is exact for a projector beside the camera (t_2 = 0), close otherwise, and each step squares its
error; after three steps it is below float64's resolution."""
FIXED_POINT_STEPS = 50
FIXED_POINT_TOLERANCE = 1e-13
"""Largest last change, in normalised units, of a projector coordinate after its distortion was removed by iteration."""
LEAST_PARALLAX = 2.0**-49
"""Least ``|a_0 - x_p a_2|``, relative to the magnitudes of its terms and of the coordinate, of which its round-off is
up to 8 x 2^-53. Below it ray and plane count as parallel: up to half of the depth would be round-off."""


class DepthFromBoth(NamedTuple):
    """``depth_mm`` float64, NaN = no depth; ``disagreement_px``: distance from the epipolar line in projector px."""

    depth_mm: NDArray[np.float64]
    disagreement_px: NDArray[np.float64]


def rotated_ray(rays: Maps, rig: Rig, axis: int) -> NDArray[np.float64]:
    """Component ``axis`` of R (x, y, 1)."""
    x, y = rays
    return rig.R[axis, 0] * x + rig.R[axis, 1] * y + rig.R[axis, 2]


def _depth_in_front(depth_m: NDArray, forward: NDArray, rig: Rig) -> NDArray[np.float64]:
    """Depth in mm where ``depth_m`` is finite and in front of both devices, else NaN."""
    good = (depth_m > 0) & (depth_m < np.inf) & (forward * depth_m + rig.t[2] > 0)
    return np.where(good, depth_m * MM_PER_M, np.nan)


def _ideal_coordinate(rays: Maps, coordinate: NDArray, rig: Rig, axis: int) -> NDArray[np.float64]:
    """Ideal normalised projector coordinate from a distorted coordinate, when the second coordinate is unknown. The ray
    supplies the second coordinate: each step takes the depth from the present estimate, projects the point and
    subtracts its distortion from the measured coordinate. Coordinates that do not settle are NaN."""
    device = rig.projector
    measured = (coordinate - device.centre[axis]) / device.focal[axis]
    rotated = [rotated_ray(rays, rig, i) for i in range(3)]
    ideal, change = measured, np.full(np.shape(measured), np.inf)
    for _ in range(FIXED_POINT_STEPS):
        depth = (ideal * rig.t[2] - rig.t[axis]) / (rotated[axis] - ideal * rotated[2])
        forward = depth * rotated[2] + rig.t[2]
        point = [(depth * rotated[i] + rig.t[i]) / forward for i in range(2)]
        improved = measured - (distort(point[0], point[1], device.distortion)[axis] - point[axis])
        change, ideal = np.abs(improved - ideal), improved
        if not np.any(change > FIXED_POINT_TOLERANCE):
            break
    return np.where(change <= FIXED_POINT_TOLERANCE, ideal, np.nan)


def depth_from_coordinate(rays: Maps, coordinate_px: ArrayLike, rig: Rig, direction: Direction) -> NDArray[np.float64]:
    """Depth in mm from one projector coordinate per pixel, float64; NaN where there is no depth (NaN input, ray
    parallel to the projector plane, intersection behind a device, or a distortion that can't be inverted). ``rays``:
    normalised (x, y) of the camera pixels, as `Pinhole.rays` gives them; ``coordinate_px``: u_p for ``direction``
    "vertical", v_p for "horizontal", in px, same shape."""
    if direction not in DIRECTIONS:
        raise DecodeError(f"direction: expected horizontal or vertical, got {direction!r}")
    axis, device = AXES.index(direction), rig.projector
    centre, focal = device.centre[axis], device.focal[axis]
    coordinate = np.asarray(coordinate_px, dtype=np.float64)
    with np.errstate(all="ignore"):
        undistorted = not device.is_distorted
        ideal = (coordinate - centre) / focal if undistorted else _ideal_coordinate(rays, coordinate, rig, axis)
        forward = rotated_ray(rays, rig, 2)
        along, across = rotated_ray(rays, rig, axis), ideal * forward
        depth = (ideal * rig.t[2] - rig.t[axis]) / (along - across)
        size = np.abs(along) + (np.abs(coordinate) + abs(centre)) / focal * np.abs(forward)
        parallel = np.abs(along - across) <= LEAST_PARALLAX * size
        return np.where(parallel, np.nan, _depth_in_front(depth, forward, rig))


def depth_from_both(
    rays: Maps, u_px: ArrayLike, v_px: ArrayLike, rig: Rig, weight_u: ArrayLike = 1.0, weight_v: ArrayLike = 1.0
) -> DepthFromBoth:
    """Depth in mm from both projector coordinates by weighted least squares in projector px, float64; NaN = no depth.

    ``weight_u`` and ``weight_v``: 1 / sigma^2 of the coordinates, up to a common factor; for sinusoids (B / P)^2.
    Solved for the inverse depth w, in which ``u - u_p(w)`` is a ratio of linear functions: algebraic start, then
    `GAUSS_NEWTON_STEPS`. ``disagreement_px`` is the measured point's distance from the epipolar line, for any weights,
    in undistorted px."""
    device = rig.projector
    u, v = np.asarray(u_px, dtype=np.float64), np.asarray(v_px, dtype=np.float64)
    tx, ty, tz = rig.t
    with np.errstate(all="ignore"):
        px, py = device.normalised(u, v)
        weight_u, weight_v = np.asarray(weight_u, dtype=np.float64), np.asarray(weight_v, dtype=np.float64)
        forward = rotated_ray(rays, rig, 2)
        # f (c - d w) / (forward + t_2 w) is the residual in px; c and d, with f in them, are fixed by the measurement.
        cu, du = device.fx * (rotated_ray(rays, rig, 0) - px * forward), device.fx * (px * tz - tx)
        cv, dv = device.fy * (rotated_ray(rays, rig, 1) - py * forward), device.fy * (py * tz - ty)

        def residuals_and_slopes(w: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
            q = forward + tz * w
            ru, rv = (cu - du * w) / q, (cv - dv * w) / q
            return ru, rv, (du + ru * tz) / q, (dv + rv * tz) / q

        w = (weight_u * cu * du + weight_v * cv * dv) / (weight_u * du * du + weight_v * dv * dv)
        if tz != 0.0:
            for _ in range(GAUSS_NEWTON_STEPS):
                ru, rv, gu, gv = residuals_and_slopes(w)
                w = w + (weight_u * ru * gu + weight_v * rv * gv) / (weight_u * gu * gu + weight_v * gv * gv)
        ru, rv, gu, gv = residuals_and_slopes(w)
        disagreement = np.abs(ru * gv - rv * gu) / np.sqrt(gu * gu + gv * gv)
        return DepthFromBoth(_depth_in_front(1.0 / w, forward, rig), disagreement)


def depth_noise_mm(
    rig: Rig,
    depth_mm: ArrayLike,
    direction: Direction | str,
    steps: int,
    modulation: ArrayLike,
    noise: ArrayLike = 1.0,
    rays: Maps | None = None,
) -> NDArray[np.float64]:
    """Standard deviation of the depth in mm that intensity noise causes, float64.

    ``modulation`` B and ``noise`` sigma in grey levels, ``rays`` the pixels' normalised (x, y), by default the optical
    axis. sigma_phi = sqrt(2 / N) sigma / B, sigma_u = P sigma_phi / (2 pi), sigma_Z = sigma_u / ``|du/dZ|``; for the
    paper's rig sigma_Z is sigma_u Z^2 / (f_p b). For ``direction`` "both" the two directions' precisions add. Projector
    distortion is ignored; it changes the slope by a few percent."""
    if direction != "both" and direction not in DIRECTIONS:
        raise DecodeError(f"direction: expected horizontal, vertical or both, got {direction!r}")
    if steps < 3:
        raise DecodeError(f"steps: expected at least 3, got {steps}")
    z = np.asarray(depth_mm, dtype=np.float64) / MM_PER_M
    normalised: Maps = rays if rays is not None else (np.zeros(()), np.zeros(()))
    forward = rotated_ray(normalised, rig, 2)
    precision: NDArray[np.float64] | float = 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma_phase = np.sqrt(2.0 / steps) * np.asarray(noise) / np.asarray(modulation)
        for name in DIRECTIONS if direction == "both" else (direction,):
            slope = _slope_px_per_m(rig, name, normalised, forward, z)
            sigma_px = rig.pitch(name) * sigma_phase / (2 * np.pi)  # type: ignore[arg-type]
            precision = precision + (slope / sigma_px) ** 2
        return MM_PER_M / np.sqrt(precision)


def coordinate_slope_px_per_mm(rig: Rig, depth_mm: ArrayLike, direction: Direction, rays: Maps) -> NDArray[np.float64]:
    """Projector px by which the coordinate of ``direction`` changes for a mm of depth, at normalised ``rays`` (x, y);
    float64. The projector's distortion is ignored, as in `depth_noise_mm`."""
    with np.errstate(divide="ignore", invalid="ignore"):
        z_m = np.asarray(depth_mm, dtype=np.float64) / MM_PER_M
        return _slope_px_per_m(rig, direction, rays, rotated_ray(rays, rig, 2), z_m) / MM_PER_M


def _slope_px_per_m(
    rig: Rig, direction: Direction, rays: Maps, forward: NDArray, z_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    axis = AXES.index(direction)
    slope = rig.projector.focal[axis] * (rotated_ray(rays, rig, axis) * rig.t[2] - rig.t[axis] * forward)
    quotient: NDArray[np.float64] = slope / (forward * z_m + rig.t[2]) ** 2
    return quotient
