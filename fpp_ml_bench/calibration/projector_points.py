"""What the captures of a board tell: projector coordinates of its points, fitted to what the camera
sees of the projector round each of them, and the response of projector and camera together.

Near a point of a flat board, camera and projector see each other through a homography (Moreno and
Taubin, Simple, accurate, and robust projector-camera calibration, 3DIMPVT 2012). It is fitted to
the decoded pixels of a window; dark squares that were not decoded are left out, wrong orders and
edges get no weight.

The response is by how much light follows the pattern's level: at a pixel of the board the frames
show ``a + b g(p_n)`` of the pattern's levels p_n there, with the response ``g(p) = (p /
255)^gamma`` that all pixels share. The levels come from the projector coordinate, which is averaged
over more than a period: the errors that a response itself causes are periodic, and cancel.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.optimize import minimize_scalar

from fpp_ml_bench.calibration.boards import Board, nearest_px
from fpp_ml_bench.constants import GREY_LEVELS, MAD_TO_SIGMA
from fpp_ml_bench.errors import CalibrationError
from fpp_ml_bench.optics.patterns import pattern_profiles
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import AXES

WINDOW_SHARE = 0.5
"""Radius of the window, in distances to the nearest neighbour."""
LEAST_RADIUS_PX = 4.0
"""Least radius of the window in px: a disc of 4 px has 49 pixels, twice `FEWEST_PIXELS`."""
LARGEST_RADIUS_PX = 24.0
"""Largest radius of the window in px: a larger one sees more of the lens's distortion, which a
homography does not describe."""
FEWEST_PIXELS = 24
"""Decoded pixels that a point needs: a homography has eight unknowns, and each pixel gives two
equations with noise."""
LEAST_SPREAD = 0.15
"""Smallest standard deviation of the pixels' positions along any direction, in window radii: 0.5
for a full disc."""
LARGEST_OFFSET = 0.4
"""Of the pixels' centroid from the point, in window radii: beyond, they lie on one side of it."""
TUKEY = 6.0
"""Residuals beyond this many robust sigmas get no weight."""

GAMMAS = (0.3, 4.0)
"""Least and largest gamma of a projector that is looked for; a projector's is mostly between 1 and
2.5."""
LEAST_LEVELS = 4
"""Frames of a pixel: two of its own unknowns, and the response."""
LEAST_RESPONSE_PIXELS = 200
"""Fewest bright pixels from which the response is measured; with fewer it is not."""
MOST_RESPONSE_PIXELS = 4000
"""Pixels of a pose, about, from which it is measured: enough for a smooth curve, and quick."""
AVERAGED_PERIODS = 1.5
"""Width of the average in periods of the finest fringes."""
BRIGHT_SHARE = 0.5
"""Only pixels at least so bright, of the brightest on the board: the board's print has edges where
it is dark."""


class ProjectorPoints(NamedTuple):
    """Projector coordinates ``points_px`` (n, 2), their standard uncertainty ``sigma_px`` (n, 2),
    the change of the coordinates with the image position ``jacobian`` (n, 2, 2), float64, NaN where
    there are none; ``reasons``: why not, by the point's number."""

    points_px: NDArray[np.float64]
    sigma_px: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    reasons: dict[int, str]


class Pose(NamedTuple):
    """A board pose as measured: image size (width, height), board points in the image and in the
    projector, px."""

    name: str
    size: tuple[int, int]
    corners_px: NDArray[np.float64]
    projector: ProjectorPoints


def measure_pose(
    name: str,
    image: NDArray[np.uint8],
    u_px: NDArray[np.float64],
    v_px: NDArray[np.float64],
    board: Board,
) -> Pose:
    """Find the ``board`` in the 8-bit ``image`` (H, W) of a pose, and the projector's columns and
    rows at its points from the decoded maps ``u_px`` and ``v_px`` (H, W), NaN where not decoded.
    Raises `CalibrationError` naming the pose where the board is not found, or image and maps differ
    in size."""
    for title, coordinates in (("columns", u_px), ("rows", v_px)):
        if coordinates.shape != image.shape:
            (h, w), got = image.shape[:2], " x ".join(map(str, coordinates.shape[::-1]))
            raise CalibrationError(
                f"pose {name}: the image is {w} x {h} px, but the map of projector {title} {got} px"
            )
    corners = board.find(image, f"pose {name}")
    return Pose(
        name, (image.shape[1], image.shape[0]), corners, projector_points(corners, u_px, v_px)
    )


def projector_points(
    corners_px: NDArray[np.float64], u_px: NDArray[np.float64], v_px: NDArray[np.float64]
) -> ProjectorPoints:
    """Projector coordinates at image points (n, 2) from the maps of projector columns and rows (H,
    W) px, float64, NaN where not decoded. The uncertainty is that of the fit, with the errors that
    neighbouring pixels share (fringe harmonics, edges); errors of a whole window are not in it."""
    n = len(corners_px)
    points, sigma, jacobian = (
        np.full((n, 2), np.nan),
        np.full((n, 2), np.nan),
        np.full((n, 2, 2), np.nan),
    )
    reasons: dict[int, str] = {}
    radii = np.clip(WINDOW_SHARE * nearest_px(corners_px), LEAST_RADIUS_PX, LARGEST_RADIUS_PX)
    for i, (corner, radius) in enumerate(zip(corners_px, radii, strict=True)):
        if np.isnan(corner).any():
            reasons[i] = "not seen by the camera"
            continue
        position, coordinates, count = _window(corner, radius, u_px, v_px)
        if reason := _too_few(position, count):
            reasons[i] = reason
            continue
        points[i], sigma[i], jacobian[i] = _fit(position, coordinates)
        jacobian[i] /= radius
    return ProjectorPoints(points, sigma, jacobian, reasons)


def _window(
    corner: NDArray, radius: float, u_px: NDArray, v_px: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Positions (k, 2), in radii from the corner, and coordinates (k, 2) of the decoded pixels of a
    disc, and the number of all its pixels."""
    reach = int(np.ceil(radius))
    x0, y0 = np.rint(corner).astype(int)
    rows, columns = (
        slice(max(y0 - reach, 0), y0 + reach + 1),
        slice(max(x0 - reach, 0), x0 + reach + 1),
    )
    u, v = u_px[rows, columns], v_px[rows, columns]
    y, x = np.mgrid[
        rows.start : rows.start + u.shape[0], columns.start : columns.start + u.shape[1]
    ]
    position = (np.stack([x, y], axis=-1) - corner) / radius
    disc = (position**2).sum(-1) <= 1
    decoded = disc & np.isfinite(u) & np.isfinite(v)
    return position[decoded], np.stack([u[decoded], v[decoded]], axis=-1), int(disc.sum())


def _too_few(position: NDArray[np.float64], count: int) -> str | None:
    """Why the pixels at ``position`` don't determine a homography at the origin, or None."""
    if len(position) < FEWEST_PIXELS:
        return f"only {len(position)} of {count} pixels were decoded"
    if np.hypot(*position.mean(0)) > LARGEST_OFFSET:
        return f"the {len(position)} decoded pixels of {count} lie on one side"
    if np.linalg.eigvalsh(np.cov(position.T))[0] < LEAST_SPREAD**2:
        return f"the {len(position)} decoded pixels of {count} lie along a line"
    return None


def _fit(
    position: NDArray[np.float64], coordinates: NDArray[np.float64]
) -> tuple[NDArray, NDArray, NDArray]:
    """Coordinates, uncertainty and Jacobian at the origin of the homography from ``position`` to
    ``coordinates`` (k, 2): first the sum of distances is made smallest, which wrong orders don't
    move, then Tukey's weights."""
    x, y = position.T
    shift = np.median(coordinates, axis=0)
    u, v = (coordinates - shift).T
    plane = np.stack([x, y, np.ones_like(x)], axis=-1)
    zero = np.zeros_like(plane)
    design = np.concatenate(
        [
            np.hstack([plane, zero, -position * u[:, None]]),
            np.hstack([zero, plane, -position * v[:, None]]),
        ]
    )
    target, weight, scale = np.concatenate([u, v]), np.ones(len(x)), np.ones(len(x))
    for step in range(20):
        factor = np.tile(weight / scale**2, 2)
        normal = (design.T * factor) @ design
        solution = np.linalg.lstsq(normal, design.T @ (factor * target), rcond=1e-14)[0]
        denominator = 1 + position @ solution[6:]
        residual = (target - design @ solution).reshape(2, -1) / denominator
        distance = np.hypot(*residual)
        sigma = max(MAD_TO_SIGMA * float(np.median(distance)), 1e-12)
        if step < 8:
            new_weight = 1 / np.maximum(distance / sigma, 0.1)
        else:
            new_weight = np.where(
                distance < TUKEY * sigma, (1 - (distance / (TUKEY * sigma)) ** 2) ** 2, 0.0
            )
        done = step > 9 and np.abs(new_weight - weight).max() < 1e-2
        if done:
            break
        weight, scale = new_weight, np.where(denominator > 0.1, denominator, 0.1)
    # The own noise of the pixels, and what blocks of them have in common: the larger one.
    block = np.clip((position * 2 + 2).astype(int), 0, 3) @ [4, 1]
    scores = np.zeros((16, 8))
    np.add.at(
        scores, np.tile(block, 2), design * (np.tile(weight / scale, 2) * residual.ravel())[:, None]
    )
    occupied = len(np.unique(block[weight > 0]))
    bread = np.linalg.pinv(normal, rcond=1e-14, hermitian=True)
    shared = np.diag(bread @ (scores.T @ scores) @ bread) * occupied / max(occupied - 4, 1)
    own = np.diag(bread) * (weight * distance**2).sum() / max(2 * weight.sum() - 8, 1)
    variance = np.maximum(shared, own)
    jacobian = solution[:6].reshape(2, 3)[:, :2] - np.outer(solution[[2, 5]], solution[6:])
    return solution[[2, 5]] + shift, np.sqrt(variance[[2, 5]]), jacobian


class Response(NamedTuple):
    """``gamma`` of projector and camera together, and its standard ``sigma``; ``misfit_grey``: what
    is left, RMS grey levels; ``white_grey``: the grey level of a white pattern at the board's
    brightest, of 255."""

    gamma: float
    sigma: float
    misfit_grey: float
    white_grey: float


class Levels(NamedTuple):
    """Pattern ``levels`` from 0 to 1 and captured ``grey`` levels of n pixels in F frames, float64
    (F, n) each."""

    levels: NDArray[np.float64]
    grey: NDArray[np.float64]


def levels_of(
    frames: Sequence[NDArray], maps: Sequence[NDArray[np.float64]], pose: Pose, rig: Rig
) -> Levels | None:
    """Sinusoid levels and grey levels at bright pixels of a pose's board; ``maps``: columns and
    rows of the projector, (H, W) px, NaN where not decoded. None where too few pixels are left, or
    a direction has no sinusoids."""
    if len(rig.fringe_directions) < len(AXES):
        return None
    x, y = pose.corners_px[np.isfinite(pose.corners_px).all(axis=1)].T
    rows = slice(max(int(y.min()), 0), int(y.max()) + 1)
    columns = slice(max(int(x.min()), 0), int(x.max()) + 1)
    smooth = []
    for coordinate, direction in zip(maps, AXES, strict=True):
        part = coordinate[rows, columns]
        slopes = [np.abs(np.diff(part, axis=axis)) for axis in (0, 1)]
        step = max(
            float(np.nanmedian(slope)) if np.isfinite(slope).any() else 0.0 for slope in slopes
        )
        width = max(3, int(np.ceil(AVERAGED_PERIODS * rig.pitch(direction) / max(step, 1e-3))) | 1)
        if width > min(part.shape) / 2:
            return None
        known = np.isfinite(part)
        share = uniform_filter(known.astype(np.float64), width, mode="constant")
        mean = uniform_filter(np.where(known, part, 0.0), width, mode="constant") / np.where(
            share > 0, share, 1
        )
        smooth.append(np.where(share > 1 - 1e-9, mean, np.nan))
    used = [index for index, frame in enumerate(rig.sequence) if frame.kind == "sinusoid"]
    grey = np.stack([np.asarray(frames[index])[rows, columns] for index in used]).astype(np.float64)
    top = grey.max(axis=0)
    bright = np.isfinite(smooth[0]) & np.isfinite(smooth[1]) & (top < GREY_LEVELS)
    bright &= top > BRIGHT_SHARE * np.quantile(top[bright], 0.98) if bright.any() else False
    picked = np.flatnonzero(bright)
    if len(used) < LEAST_LEVELS or len(picked) < LEAST_RESPONSE_PIXELS:
        return None
    picked = picked[:: max(len(picked) // MOST_RESPONSE_PIXELS, 1)]
    levels = []
    for index, profile in zip(used, pattern_profiles(rig, used), strict=True):
        frame = rig.sequence.frames[index]
        at = smooth[0 if frame.direction == "vertical" else 1].ravel()[picked]
        levels.append(np.interp(at, np.arange(profile.size), profile) / GREY_LEVELS)
    return Levels(np.array(levels), grey.reshape(len(used), -1)[:, picked])


def fit_response(measured: Sequence[Levels]) -> Response | None:
    """The response that fits all poses best; None without any."""
    if not measured:
        return None

    def misfit(gamma: float) -> float:
        return sum(_response_residuals(pose, gamma)[0] for pose in measured)

    minimum = minimize_scalar(misfit, bounds=GAMMAS, method="bounded", options={"xatol": 1e-5})
    gamma, least = float(minimum.x), float(minimum.fun)
    count = sum(pose.grey.size - 2 * pose.grey.shape[1] for pose in measured)
    step = 1e-2
    curvature = (misfit(gamma + step) - 2 * least + misfit(gamma - step)) / step**2
    sigma = float(np.sqrt(2 * least / count / curvature)) if curvature > 0 else float("inf")
    white = max(float(np.quantile(_response_residuals(pose, gamma)[1], 0.98)) for pose in measured)
    return Response(gamma, sigma, float(np.sqrt(least / count)), white)


def _response_residuals(pose: Levels, gamma: float) -> tuple[float, NDArray[np.float64]]:
    """Sum of squares with each pixel's own a and b, and every pixel's grey level of a white
    pattern, a + b."""
    light = pose.levels**gamma
    mean_light, mean_grey = light.mean(axis=0), pose.grey.mean(axis=0)
    light, grey = light - mean_light, pose.grey - mean_grey
    power = (light * light).sum(axis=0)
    slope = (light * grey).sum(axis=0) / np.where(power > 0, power, 1.0)
    residual = grey - slope * light
    return float((residual * residual).sum()), mean_grey + slope * (1 - mean_light)
