"""Phase and object mask from two or more frames of one direction, with no or little averaging over pixels.

From three frames on the phase is the N-step least squares of `fpp_ml_bench.decoding`, pixel by pixel and without any
window, so nothing mixes two surfaces at a depth edge. Two frames leave one unknown too many, but a projected fringe
goes down to black: its mean is its modulation plus the calibrated ambient light, and with that constraint two grey
levels give brightness and phase. The sign stays open: the local fit over a window decides it. The result is poor where
both grey levels are dark; a window of a few px bridges such pixels (`Settings.pair_window`).

The object mask is then decided for every pixel alone: object pixels are those whose frames the empty scene does not
explain.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route.empty_scene import Background, EmptyScene
from fpp_ml_bench.baselines.phase_route.local_fit import FringeFit, Window, fringe_fit
from fpp_ml_bench.baselines.phase_route.object_mask import DARKEST_GREY, disk, without_small
from fpp_ml_bench.baselines.phase_route.observation import Crop, Stopwatch
from fpp_ml_bench.decoding import MIN_MODULATION, choose_steps, phase_weights, wrapped_phase
from fpp_ml_bench.errors import PredictionError

Image = NDArray[np.float32]

PIXELWISE = 3
"""Frames from which on every pixel has a phase of its own."""
PAIR_DEGREES = 120.0
"""Phase shift between two frames: that of the first two of three, so that a third frame completes them."""
PLANE_CHANCE_SIGMAS = 4.0
"""How far, in sigmas of its own spread, the squared misfit of N frames must exceed N not to be the empty plane."""
PLANE_TOLERANCE_GREY = 0.3
"""Error of the fitted empty scene, grey levels, beside noise."""
SQUARE_PX = 5
"""Side of the square over which faint differences are averaged."""
CLOSING_PERIODS = 0.2
ALIKE = 0.2
"""Largest relative difference from the brightness around of an object pixel that the empty scene explains as well."""
SPECK_PX = 6
"""Smallest group of pixels that counts as object, and largest hole in it that is closed."""
DARK_SIGMAS = 4.0


def steps_of(steps: int, frames: int) -> tuple[int, ...]:
    """Which of ``steps`` phase shifts ``frames`` of them are: 0 alone, 0 and a third, or `choose_steps`.

    Raises `PredictionError` for a number of frames that can't be had.
    """
    if isinstance(frames, bool) or not isinstance(frames, int | np.integer) or not 1 <= frames <= steps:
        raise PredictionError(
            f"frames {frames!r}: expected a whole number from 1 to the {steps} sinusoids of a direction that were "
            "projected"
        )
    if frames < PIXELWISE:
        return (0, round(steps * PAIR_DEGREES / 360))[:frames]
    return choose_steps(steps, frames)


def differs(
    greys: Sequence[Image], shifts_rad: Sequence[float], scene: EmptyScene, background: Background, crop: Crop
) -> NDArray[np.bool_]:
    """Pixels (h, w) whose ``greys``, float32 (h, w) each, the empty scene does not explain.

    Tested for every pixel, and for means over a small square, which separate the plane from an object that happens to
    be as bright; pixels that only the square's reach beyond the silhouette adds are removed.
    """
    alone, around = np.zeros(greys[0].shape, np.float32), np.zeros(greys[0].shape, np.float32)
    for grey, shift in zip(greys, shifts_rad, strict=True):
        misfit = grey - scene.predicted(background, shift, crop)
        alone += misfit * misfit
        around += cv2.blur(misfit, (SQUARE_PX, SQUARE_PX)) ** 2
    noise = background.noise_grey**2
    square_differs = (around > _limit(noise / SQUARE_PX**2, len(greys))).astype(np.uint8)
    without_rim = cv2.erode(square_differs, np.ones((SQUARE_PX, SQUARE_PX), np.uint8)) > 0
    return (alone > _limit(noise, len(greys))) | without_rim


def _limit(variance: float, count: int) -> float:
    """Squared misfit of ``count`` frames that the empty scene, with noise of that variance, hardly ever exceeds."""
    chance = count + PLANE_CHANCE_SIGMAS * np.sqrt(2 * count) + PLANE_CHANCE_SIGMAS
    return float((variance + PLANE_TOLERANCE_GREY**2) * chance)


def first_mask(different: NDArray[np.bool_], period_px: float) -> NDArray[np.bool_]:
    """Object pixels (h, w) before brightness is known: small stripes and holes closed, specks removed."""
    radius = disk(CLOSING_PERIODS * period_px)
    region = cv2.morphologyEx(different.astype(np.uint8), cv2.MORPH_CLOSE, radius) > 0
    mask = without_small(region, SPECK_PX)
    return mask | ~without_small(~mask, SPECK_PX)


def pair_fit(
    greys: Sequence[Image], shifts_rad: Sequence[float], inside: NDArray[np.bool_], carrier_rad: Image, ambient: float,
    windows: Sequence[Window],
) -> FringeFit:  # fmt: skip
    """Fits of g (1 + cos(phase + shift)) to all ``greys`` at once; each window starts from the phase of the last."""
    for window in windows:
        fit = fringe_fit(greys, inside, carrier_rad, ambient, window, shifts_rad)
        carrier_rad = fit.phase_rad
    return fit


def measure_pixels(
    greys: Sequence[Image], shifts_rad: Sequence[float], mask: NDArray[np.bool_] | None, scene: EmptyScene,
    background: Background, crop: Crop, window: Window, period_px: float, watch: Stopwatch,
) -> tuple[NDArray[np.bool_], FringeFit, Image]:  # fmt: skip
    """Object mask (or ``mask``), phase and modulation by N-step least squares, and mean grey level of every pixel.

    The fit's weight is the share of ``window`` on the object, which the use of its slopes needs.
    """
    fitted = wrapped_phase(greys, shifts_rad, np.float32)
    flat = np.zeros_like(greys[0])
    phase, modulation, mean = (np.asarray(values, np.float32) for values in fitted)
    watch.done("phase")
    inside = mask
    if inside is None:
        different = differs(greys, shifts_rad, scene, background, crop)
        inside = lit_object(different, modulation, shifts_rad, background, period_px)
    watch.done("mask")
    return inside, FringeFit(phase, modulation, flat, flat, window.moment(inside.astype(np.float32))), mean


def pixel_uncertainty_rad(
    fit: FringeFit, mean_grey: Image, shifts_rad: Sequence[float], background: Background
) -> Image:
    """Expected absolute error of the phase of each pixel, float32 (h, w): noise through the weights of the steps, and
    the difference of mean and modulation beyond it (a pixel that covers two surfaces, or is clipped)."""
    _, cosine, sine = phase_weights(shifts_rad)
    bright = np.maximum(fit.brightness, 0.5)
    # Of phi = -atan2(S, C): d phi = -(C dS - S dC) / B^2 = -(cos phi dS + sin phi dC) / B.
    c, s = np.cos(fit.phase_rad), np.sin(fit.phase_rad)
    variance = c * c * (sine @ sine) + s * s * (cosine @ cosine) + 2 * c * s * (sine @ cosine)
    noise = background.noise_grey * np.sqrt(variance * 2 / np.pi)
    disagreement = np.abs(mean_grey - background.ambient_grey - fit.brightness)
    allowed = 3 * background.noise_grey * np.sqrt(3 / len(shifts_rad))
    return ((noise + np.maximum(disagreement - allowed, 0) / 2) / bright).astype(np.float32)


def lit_object(
    different: NDArray[np.bool_], modulation: Image, shifts_rad: Sequence[float], background: Background,
    period_px: float,
) -> NDArray[np.bool_]:  # fmt: skip
    """Object pixels (h, w): those that differ and are modulated by more than noise. Pixels that only closing has added
    must be as bright as the object around them, otherwise they are the plane beside a corner."""
    _, cosine, sine = phase_weights(shifts_rad)
    sigma = background.noise_grey * np.sqrt(max(cosine @ cosine, sine @ sine))
    least_grey = min(max(DARKEST_GREY, DARK_SIGMAS * float(sigma)), MIN_MODULATION)
    closed = first_mask(different, period_px)
    certain = closed & different & (modulation > least_grey)
    side = 2 * round(CLOSING_PERIODS * period_px) + 1
    weight = cv2.blur(certain.astype(np.float32), (side, side))
    around = cv2.blur(modulation * certain, (side, side)) / np.maximum(weight, 1e-6)
    alike = np.abs(modulation - around) < ALIKE * around
    return without_small(certain | (closed & ~different & alike), SPECK_PX)
