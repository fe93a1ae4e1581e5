"""Standard uncertainty of decoded depth, from the noise of the frames."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding import MIN_MODULATION, PhaseShift, phase_weights, weighted_sums
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.decoding.decode import Decoded
from fpp_ml_bench.decoding.triangulation import coordinate_slope_px_per_mm
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics import Rig

ASSUMED_NOISE_GREY = 1.0
"""Where the frames don't tell: three steps fit any three grey levels."""
_LEAST_STEPS, _SAMPLED_PX, _LEAST_PX = 4, 50_000, 100
_MEDIAN_OF_SQUARE = (0.4549, 0.6931, 0.7887, 0.8392, 0.8703, 0.8914)
"""Median of chi^2 / n for 1 to 6 degrees of freedom; (1 - 2 / (9 n))^3 for more."""


def depth_sigma_mm(decoded: Decoded, rig: Rig, noise_grey: float) -> NDArray[np.float32]:
    """Standard uncertainty of every decoded pixel in mm, float32 (H, W), 0 = none, from noise of ``noise_grey`` grey
    levels a frame. Of ``decoded`` with details. It is that of the noise alone: gamma, blur, further bounces and the
    calibration add to it. Raises `DecodeError` for a decoding without details, or noise that is none."""
    if not decoded.details:
        raise DecodeError("details: missing; decode with details=True")
    if not (np.isfinite(noise_grey) and noise_grey > 0):
        raise DecodeError(f"noise_grey: expected grey levels above 0, got {noise_grey!r}")
    found = decoded.depth_mm > 0
    rays = tuple(axis[found] for axis in rig.camera.rays())
    precision = np.zeros(int(found.sum()))
    for direction, measured in decoded.details.items():
        sigma_px = rig.code(direction).sigma_px(measured.modulation[found], noise_grey)
        slope = coordinate_slope_px_per_mm(rig, decoded.depth_mm[found], direction, (rays[0], rays[1]))
        precision += (slope / sigma_px) ** 2
    sigma_mm = np.zeros(decoded.depth_mm.shape, dtype=np.float32)
    with np.errstate(divide="ignore"):
        sigma_mm[found] = np.where(precision > 0, 1 / np.sqrt(precision), np.finfo(np.float32).max)
    return sigma_mm


def noise_of_frames(frames: Sequence[NDArray], rig: Rig) -> float | None:
    """Noise of the frames in grey levels, from what their sinusoids can't explain: the median over lit pixels; None
    where every period has three steps, which explain anything, or too few pixels are lit."""
    estimates = []
    for direction in rig.directions:
        code = rig.code(direction)
        for number, fringe in enumerate(code.fringes if isinstance(code, PhaseShift) else ()):
            steps = len(fringe.shifts_deg)
            if steps < _LEAST_STEPS:
                continue
            indices = [frame.index for frame in rig.sequence if frame.direction == direction
                       and frame.kind == "sinusoid" and frame.fringe == number]  # fmt: skip
            flat = [np.asarray(frames[index]).reshape(-1) for index in indices]
            levels = np.stack([frame[:: max(frame.size // _SAMPLED_PX, 1)] for frame in flat]).astype(np.float64)
            weights = phase_weights(2 * np.pi * fringe.turns)
            mean, cosine, sine = weighted_sums(levels, weights)
            lit = (cosine**2 + sine**2 >= MIN_MODULATION**2) & ((levels > 0) & (levels < GREY_LEVELS)).all(axis=0)
            if lit.sum() < _LEAST_PX:
                continue
            angles = 2 * np.pi * fringe.turns[:, None]
            residual = levels - (mean + cosine * np.cos(angles) + sine * np.sin(angles))
            square = (residual[:, lit] ** 2).sum(axis=0) / (steps - 3)
            freedom = steps - 3
            known = freedom <= len(_MEDIAN_OF_SQUARE)
            median = _MEDIAN_OF_SQUARE[freedom - 1] if known else (1 - 2 / (9 * freedom)) ** 3
            estimates.append(float(np.sqrt(np.median(square) / median)))
    return float(np.median(estimates)) if estimates else None
