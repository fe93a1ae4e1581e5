"""Standard uncertainty of decoded depth, from the noise of the frames."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

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
_SAMPLED_PX, _LEAST_PX = 50_000, 100
_BRIGHTNESSES = 12  # groups of as many pixels each
_LEAST_VARIANCE = 1 / 12  # of rounding to whole grey levels
_HIGHEST_HARMONIC, _LEAST_HARMONIC = 4, 0.01
_MEDIAN_OF_SQUARE = (0.4549, 0.6931, 0.7887, 0.8392, 0.8703, 0.8914)
"""Median of chi^2 / n for 1 to 6 degrees of freedom; (1 - 2 / (9 n))^3 for more."""


SYSTEMATIC_RAD = 0.005
"""Error of a phase that is no noise: light of further bounces, mostly. With it 68% intervals hold 68% of the pixels of
the validation objects in the light ``paper`` (`fpp-bench predict classical DATASET --split validation` and `fpp-eval`
with ``--split validation --target depth_exact``); larger errors are more frequent than in a normal distribution."""


def depth_sigma_mm(
    decoded: Decoded,
    rig: Rig,
    noise_grey: NDArray | float,
    steps: int | None = None,
    systematic_rad: float | Mapping[str, float] = 0.0,
) -> NDArray[np.float32]:
    """Standard uncertainty of every decoded pixel in mm, float32 (H, W), 0 = none, from noise of ``noise_grey`` grey
    levels a frame, one number or (H, W). Of ``decoded`` with details, and with so many ``steps`` of each direction
    (default: all). It is that of the noise, and of an error ``systematic_rad`` of every phase, one for all or by
    direction: gamma, blur, further bounces. The calibration adds to it. Raises `DecodeError` for a decoding without
    details, or noise that is none."""
    if not decoded.details:
        raise DecodeError("details: missing; decode with details=True")
    noise = np.asarray(noise_grey, dtype=np.float64)
    if not (np.isfinite(noise) & (noise > 0)).all():
        raise DecodeError(f"noise_grey: expected grey levels above 0, got {noise.min():g}")
    found = decoded.depth_mm > 0
    rays = tuple(axis[found] for axis in rig.camera.rays())
    of_found = noise[found] if noise.ndim else noise
    precision = np.zeros(int(found.sum()))
    for direction, measured in decoded.details.items():
        code, modulation = rig.code(direction), measured.modulation[found]
        fewer, systematic_px = 1.0, 0.0
        if isinstance(code, PhaseShift):
            fewer = 1.0 if steps is None else steps / len(code.fringes[0].shifts_deg)
            rad = systematic_rad if isinstance(systematic_rad, float) else systematic_rad.get(direction, 0.0)
            systematic_px = code.pitch_px * rad / (2 * np.pi)
        sigma_px = np.hypot(code.sigma_px(modulation, of_found / np.sqrt(fewer)), systematic_px)
        slope = coordinate_slope_px_per_mm(rig, decoded.depth_mm[found], direction, (rays[0], rays[1]))
        precision += (slope / sigma_px) ** 2
    sigma_mm = np.zeros(decoded.depth_mm.shape, dtype=np.float32)
    with np.errstate(divide="ignore"):
        sigma_mm[found] = np.where(precision > 0, 1 / np.sqrt(precision), np.finfo(np.float32).max)
    return sigma_mm


def noise_of_frames(frames: Sequence[NDArray | None], rig: Rig) -> float | None:
    """Noise of the frames in grey levels, from what their sinusoids can't explain: the median over lit pixels; None
    where every period has three steps, which explain anything, or too few pixels are lit. A frame may be None."""
    estimates = [_variance(squares, freedom) for _, squares, freedom in _unexplained(frames, rig, straight=True)]
    return float(np.median(np.sqrt(estimates))) if estimates else None


def noise_by_light(frames: Sequence[NDArray | None], rig: Rig) -> tuple[float, float] | None:
    """Variance of the noise in squared grey levels without light, and what a grey level of light adds to it: photons
    come by chance. From the same pixels as `noise_of_frames`, by their brightness; None as there."""
    means, variances = [], []
    for mean, squares, freedom in _unexplained(frames, rig):
        limits = np.quantile(mean, np.linspace(0, 1, _BRIGHTNESSES + 1))
        for low, high in pairwise(limits):
            here = (mean >= low) & (mean <= high)
            means.append(float(mean[here].mean()))
            variances.append(_variance(squares[here], freedom))
    if not means:
        return None
    (per_grey, dark) = np.polynomial.Polynomial.fit(means, variances, 1).convert().coef[::-1]
    return (float(np.median(variances)), 0.0) if per_grey <= 0 else (max(float(dark), _LEAST_VARIANCE), float(per_grey))


def _variance(squares: NDArray[np.float64], freedom: int) -> float:
    """Variance of normal errors from the median of what they leave, squared and over ``freedom``."""
    known = freedom <= len(_MEDIAN_OF_SQUARE)
    return float(np.median(squares)) / (_MEDIAN_OF_SQUARE[freedom - 1] if known else (1 - 2 / (9 * freedom)) ** 3)


def _unexplained(
    frames: Sequence[NDArray | None], rig: Rig, straight: bool = False
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64], int]]:
    """Of every period with four and more steps, at some of the lit pixels: mean grey level, squared residual over its
    degrees of freedom, and these. ``straight``: without what a response that is not straight adds (`_harmonics`)."""
    for direction in rig.directions:
        code = rig.code(direction)
        for number, fringe in enumerate(code.fringes if isinstance(code, PhaseShift) else ()):
            indices = rig.sequence.period(direction, number)
            captured = [step for step, index in enumerate(indices) if frames[index] is not None]
            freedom = len(captured) - 3
            if freedom < 1:
                continue
            flat = [np.asarray(frames[indices[step]]).reshape(-1) for step in captured]
            levels = np.stack([frame[:: max(frame.size // _SAMPLED_PX, 1)] for frame in flat]).astype(np.float64)
            angles = 2 * np.pi * fringe.turns[captured]
            mean, cosine, sine = weighted_sums(levels, phase_weights(angles))
            lit = (cosine**2 + sine**2 >= MIN_MODULATION**2) & ((levels > 0) & (levels < GREY_LEVELS)).all(axis=0)
            if lit.sum() < _LEAST_PX:
                continue
            residual = levels - (mean + cosine * np.cos(angles)[:, None] + sine * np.sin(angles)[:, None])
            if straight:
                residual[:, lit] -= _harmonics(residual[:, lit], cosine[lit], sine[lit], angles)
            yield mean[lit], (residual[:, lit] ** 2).sum(axis=0) / freedom, freedom


def _harmonics(residual: NDArray, cosine: NDArray, sine: NDArray, angles: NDArray) -> NDArray[np.float64]:
    """The part of residuals (N, n) that higher harmonics make, which all pixels share as a share of their modulation
    (gamma), and that is no noise; 0 where the share is below `_LEAST_HARMONIC`, as in straight light."""
    phase, modulation, part = np.arctan2(-sine, cosine), np.hypot(cosine, sine), np.zeros_like(residual)
    for harmonic in range(2, min(len(angles) // 2, _HIGHEST_HARMONIC) + 1):
        turned = harmonic * (phase + angles[:, None])
        shares = []
        for wave in (modulation * np.cos(turned), modulation * np.sin(turned)):
            power = float((wave * wave).sum())
            shares.append((float((residual * wave).sum()) / power if power > 0 else 0.0, wave))
        if np.hypot(shares[0][0], shares[1][0]) > _LEAST_HARMONIC:
            part += sum(share * wave for share, wave in shares)
    return part
