"""The response of projector and camera together, from board captures: by how much light follows the pattern's level.

At a pixel of the board the frames show ``a + b g(p_n)`` of the pattern's levels p_n there, with the response
``g(p) = (p / 255)^gamma`` that all pixels share. The levels come from the projector coordinate, which is averaged over
more than a period: the errors that a response itself causes are periodic, and cancel.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.optimize import minimize_scalar

from fpp_ml_bench.calibration.projector_points import Pose
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.optics.patterns import pattern_profiles
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import AXES

GAMMAS = (0.3, 4.0)
LEAST_LEVELS = 4
"""Frames of a pixel: two of its own unknowns, and the response."""
LEAST_PIXELS = 200
MOST_PIXELS = 4000
PERIODS = 1.5
"""Width of the average in periods of the finest fringes."""
BRIGHT_SHARE = 0.5
"""Only pixels at least so bright, of the brightest on the board: the board's print has edges where it is dark."""


class Response(NamedTuple):
    """``gamma`` of projector and camera together, and its standard ``sigma``; ``misfit_grey``: what is left, RMS grey
    levels; ``white_grey``: the grey level of a white pattern at the board's brightest, of 255."""

    gamma: float
    sigma: float
    misfit_grey: float
    white_grey: float


class Levels(NamedTuple):
    """Pattern ``levels`` from 0 to 1 and captured ``grey`` levels of n pixels in F frames, float64 (F, n) each."""

    levels: NDArray[np.float64]
    grey: NDArray[np.float64]


def levels_of(frames: Sequence[NDArray], maps: Sequence[NDArray[np.float64]], pose: Pose, rig: Rig) -> Levels | None:
    """Sinusoid levels and grey levels at bright pixels of a pose's board; ``maps``: columns and rows of the projector,
    (H, W) px, NaN where not decoded. None where too few pixels are left, or a direction has no sinusoids."""
    if len(rig.fringe_directions) < len(AXES):
        return None
    x, y = pose.corners_px[np.isfinite(pose.corners_px).all(axis=1)].T
    rows = slice(max(int(y.min()), 0), int(y.max()) + 1)
    columns = slice(max(int(x.min()), 0), int(x.max()) + 1)
    smooth = []
    for coordinate, direction in zip(maps, AXES, strict=True):
        part = coordinate[rows, columns]
        slopes = [np.abs(np.diff(part, axis=axis)) for axis in (0, 1)]
        step = max(float(np.nanmedian(slope)) if np.isfinite(slope).any() else 0.0 for slope in slopes)
        width = max(3, int(np.ceil(PERIODS * rig.pitch(direction) / max(step, 1e-3))) | 1)
        if width > min(part.shape) / 2:
            return None
        known = np.isfinite(part)
        share = uniform_filter(known.astype(np.float64), width, mode="constant")
        mean = uniform_filter(np.where(known, part, 0.0), width, mode="constant") / np.where(share > 0, share, 1)
        smooth.append(np.where(share > 1 - 1e-9, mean, np.nan))
    used = [index for index, frame in enumerate(rig.sequence) if frame.kind == "sinusoid"]
    grey = np.stack([np.asarray(frames[index])[rows, columns] for index in used]).astype(np.float64)
    top = grey.max(axis=0)
    bright = np.isfinite(smooth[0]) & np.isfinite(smooth[1]) & (top < GREY_LEVELS)
    bright &= top > BRIGHT_SHARE * np.quantile(top[bright], 0.98) if bright.any() else False
    picked = np.flatnonzero(bright)
    if len(used) < LEAST_LEVELS or len(picked) < LEAST_PIXELS:
        return None
    picked = picked[:: max(len(picked) // MOST_PIXELS, 1)]
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
        return sum(_residuals(pose, gamma)[0] for pose in measured)

    found = minimize_scalar(misfit, bounds=GAMMAS, method="bounded", options={"xatol": 1e-5})
    gamma, least = float(found.x), float(found.fun)
    count = sum(pose.grey.size - 2 * pose.grey.shape[1] for pose in measured)
    step = 1e-2
    curvature = (misfit(gamma + step) - 2 * least + misfit(gamma - step)) / step**2
    sigma = float(np.sqrt(2 * least / count / curvature)) if curvature > 0 else float("inf")
    white = max(float(np.quantile(_residuals(pose, gamma)[1], 0.98)) for pose in measured)
    return Response(gamma, sigma, float(np.sqrt(least / count)), white)


def _residuals(pose: Levels, gamma: float) -> tuple[float, NDArray[np.float64]]:
    """Sum of squares with each pixel's own a and b, and every pixel's grey level of a white pattern, a + b."""
    light = pose.levels**gamma
    mean_light, mean_grey = light.mean(axis=0), pose.grey.mean(axis=0)
    light, grey = light - mean_light, pose.grey - mean_grey
    power = (light * light).sum(axis=0)
    slope = (light * grey).sum(axis=0) / np.where(power > 0, power, 1.0)
    residual = grey - slope * light
    return float((residual * residual).sum()), mean_grey + slope * (1 - mean_light)
