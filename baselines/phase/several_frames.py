"""Which frames to capture, and phase and object mask from two or more of one direction.

With three or more frames, the phase is the N-step least squares of `fpp_ml_bench.decoding`, pixel by pixel, so that two
surfaces are never mixed at a depth edge. Object pixels are those whose frames the empty scene does not explain. Two
frames have one equation too few, but a projected fringe goes down to black: its mean is its modulation plus ambient
light. With that constraint a window of a few px (`Settings.pair_window`) is enough.
"""

from collections.abc import Iterable, Iterator, Sequence

import cv2
import numpy as np

from fpp_ml_bench.baselines.phase.calibration_layer import Image, Mask
from fpp_ml_bench.baselines.phase.local_fit import FringeFit, Window
from fpp_ml_bench.baselines.phase.object_mask import (
    DARKEST_GREY,
    Background,
    EmptyScene,
    closed,
    without_small,
)
from fpp_ml_bench.baselines.phase.observation import PIXELWISE, Capture
from fpp_ml_bench.coding.code import MIN_MODULATION
from fpp_ml_bench.coding.phase_shift import choose_steps, phase_weights, wrapped_phase
from fpp_ml_bench.errors import PredictionError

PAIR_DEGREES = 120.0
"""Phase shift between two frames: that of the first two of three, so that a third frame completes them."""
PLANE_CHANCE_SIGMAS = 4.0
"""How far, in sigmas of its own spread, the squared misfit of N frames must exceed N not to be the empty plane."""
PLANE_TOLERANCE_GREY = 0.3  # error of the fitted empty scene, grey levels, beside noise
SQUARE_PX = 5  # side of the square over which faint differences are averaged
CLOSING_PERIODS = 0.2
ALIKE = 0.2
"""Largest relative difference from the brightness around of an object pixel that the empty scene explains as well."""
SPECK_PX = 6  # smallest group of pixels that counts as object, and largest hole in it that is closed
DARK_SIGMAS = 4.0


def steps_of(steps: int, frames: int) -> tuple[int, ...]:
    """Which of ``steps`` phase shifts ``frames`` of them are: 0 alone, 0 and a third, or `choose_steps`. Raises
    `PredictionError` for a number of frames that can't be had."""
    if isinstance(frames, bool) or not isinstance(frames, int | np.integer) or not 1 <= frames <= steps:
        raise PredictionError(
            f"frames {frames!r}: expected a whole number from 1 to the {steps} sinusoids of a direction that were "
            "projected"
        )
    if frames < PIXELWISE:
        return (0, round(steps * PAIR_DEGREES / 360))[:frames]
    return choose_steps(steps, frames)


def pixel_fits(capture: Capture, scene: EmptyScene, mask: Mask | None, window: Window) -> tuple[Mask, FringeFit, Image]:
    """Object mask (or ``mask``), phase and modulation of every pixel by N-step least squares, and its mean grey level.
    The fit's weight is the share of ``window`` on the object, which the use of its slopes needs."""
    fitted = wrapped_phase(capture.greys, capture.shifts_rad, np.float32)
    phase, modulation, mean = (np.asarray(values, np.float32) for values in fitted)
    capture.watch.done("phase")
    inside = mask
    if inside is None:
        different = differs(plane_misfits(capture, scene), capture.background.noise_grey)
        inside = lit_object(different, modulation, capture.background, capture.shifts_rad, capture.period_px)
    capture.watch.done("mask")
    return inside, FringeFit(phase, modulation, window.moment(inside.astype(np.float32))), mean


def plane_misfits(capture: Capture, scene: EmptyScene) -> Iterator[Image]:
    """Each frame (h, w) less what the empty scene gives there, grey levels."""
    for grey, shift in zip(capture.greys, capture.shifts_rad, strict=True):
        yield grey - scene.predicted(capture.background, shift, capture.crop)


def differs(plane_misfits: Iterable[Image], noise_grey: float) -> Mask:
    """Pixels (h, w) whose grey levels the empty scene does not explain, by ``plane_misfits`` (h, w) of each frame.
    Tested for every pixel, and for means over a small square, which separate the plane from an object that happens to
    be as bright; pixels that only the square's reach beyond the silhouette adds are removed."""
    misfits, noise = list(plane_misfits), noise_grey**2
    alone = sum((misfit * misfit for misfit in misfits), np.float32(0))
    around = np.asarray(sum((cv2.blur(misfit, (SQUARE_PX, SQUARE_PX)) ** 2 for misfit in misfits), np.float32(0)))
    square_differs = (around > _limit(noise / SQUARE_PX**2, len(misfits))).astype(np.uint8)
    without_rim = cv2.erode(square_differs, np.ones((SQUARE_PX, SQUARE_PX), np.uint8)) > 0
    return (alone > _limit(noise, len(misfits))) | without_rim


def _limit(variance: float, count: int) -> float:
    """Squared misfit of ``count`` frames that the empty scene, with noise of that variance, hardly ever exceeds."""
    chance = count + PLANE_CHANCE_SIGMAS * np.sqrt(2 * count) + PLANE_CHANCE_SIGMAS
    return float((variance + PLANE_TOLERANCE_GREY**2) * chance)


def first_mask(different: Mask, period_px: float) -> Mask:
    """Object pixels (h, w) before brightness is known: small stripes and holes closed, specks removed."""
    return closed(different, CLOSING_PERIODS * period_px, SPECK_PX)


def lit_object(
    different: Mask, modulation: Image, background: Background, shifts_rad: Sequence[float], period_px: float
) -> Mask:
    """Object pixels (h, w): those that are ``different`` (`differs`) and modulated by more than noise. Pixels that only
    closing has added must be as bright as the object around them, otherwise they are the plane beside a corner."""
    _, cosine, sine = phase_weights(shifts_rad)
    sigma = background.noise_grey * np.sqrt(max(cosine @ cosine, sine @ sine))
    least_grey = min(max(DARKEST_GREY, DARK_SIGMAS * float(sigma)), MIN_MODULATION)
    if not background.shown:  # nothing else tells the object
        least_grey = MIN_MODULATION
    region = first_mask(different, period_px)
    certain = region & different & (modulation > least_grey)
    side = 2 * round(CLOSING_PERIODS * period_px) + 1
    weight = cv2.blur(certain.astype(np.float32), (side, side))
    around = cv2.blur(modulation * certain, (side, side)) / np.maximum(weight, 1e-6)
    alike = np.abs(modulation - around) < ALIKE * around
    return without_small(certain | (region & ~different & alike), SPECK_PX)
