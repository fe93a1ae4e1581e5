"""The expected error of each pixel in mm, and the reasons not to trust a pixel.

The expected error has three parts. Phase: noise and misfit of the local fit (rms misfit divided by brightness is a
phase error, and the slope of the calibration layer turns it into mm). Rim: there the fit extrapolates instead of
averaging. Order: its margin gives the probability of a wrong order, whose error in mm is known.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import TAU, Image, Mask
from fpp_ml_bench.baselines.phase.local_fit import FringeFit, Window
from fpp_ml_bench.baselines.phase.object_mask import disk
from fpp_ml_bench.baselines.phase.observation import Capture, Observation, Reason, Settings
from fpp_ml_bench.coding.code import MIN_MODULATION
from fpp_ml_bench.coding.phase_shift import phase_weights
from fpp_ml_bench.constants import GREY_LEVELS, MM_PER_M

LEAST_MARGIN = 0.1
"""Least margin of an order that is not ambiguous; 1 is the margin of brightness that rules the rival order out."""
MARGIN_SCALE = 0.04  # margin by which the odds of two orders grow e-fold
MISFIT_SHARE, UNKNOWN_MISFIT_SHARE = 0.3, 0.75
"""Phase error of a local fit as a share of its relative misfit: on the benchmark's objects, and where no known
background shows, so that light and surface may be any (a real skull, `docs/results/phase_route.md`)."""
SATURATED_SHARE = 0.02
SLOWEST, FASTEST = 0.35, 2.2
"""Fringe frequency in the image, as a multiple of that of a plane square to the axis, that a window resolves."""
THIN_PERIODS = 0.5


def fit_uncertainty_rad(
    capture: Capture, fit: FringeFit, inside: Mask, slopes: tuple[Image, Image], window: Window
) -> Image:
    """Expected error of the phase of a local fit to the first frame, in rad, float32 (h, w), apart from the order."""
    background = capture.background
    bright = np.maximum(fit.brightness, 0.5)
    fringe = np.cos(fit.phase_rad) if fit.contrast == 1 else np.float32(fit.contrast) * np.cos(fit.phase_rad)
    misfit = (capture.greys[0] - background.ambient_grey - bright * (1 + fringe)) * inside
    power = window.moment((misfit * misfit).astype(np.float32)) / np.maximum(fit.weight, 1e-3)
    # A window of sigma s averages 4 pi s^2 pixels of white noise; what is not noise does not average.
    averaged = background.noise_grey**2 / (2 * np.pi * window.sigma_px**2 * np.maximum(fit.weight, 0.05))
    systematic = np.maximum(power - background.noise_grey**2, 0)
    sigma_phase = np.sqrt(averaged + systematic) / bright
    steep = np.hypot(*slopes)
    rim = np.clip(1 - fit.weight, 0, 1)
    share = MISFIT_SHARE if background.shown else UNKNOWN_MISFIT_SHARE
    return sigma_phase * (share + rim) + steep * rim  # type: ignore[return-value]  # float32 all through


def pixel_uncertainty_rad(capture: Capture, fit: FringeFit, mean_grey: Image) -> Image:
    """Expected absolute error of the phase of each pixel, float32 (h, w): noise through the weights of the steps, and
    the difference of mean and modulation beyond it (a pixel that covers two surfaces, or is clipped). Of modulation a
    pixel that averages the fringe over its area loses a share that is known, without an error of the phase."""
    background = capture.background
    _, cosine, sine = phase_weights(capture.shifts_rad)
    bright = np.maximum(fit.brightness, 0.5)
    # Of phi = -atan2(S, C): d phi = -(C dS - S dC) / B^2 = -(cos phi dS + sin phi dC) / B.
    c, s = np.cos(fit.phase_rad), np.sin(fit.phase_rad)
    variance = c * c * (sine @ sine) + s * s * (cosine @ cosine) + 2 * c * s * (sine @ cosine)
    noise = background.noise_grey * np.sqrt(variance * 2 / np.pi)
    mean = mean_grey - background.ambient_grey
    before_pixel = fit.brightness / np.float32(np.sinc(1 / capture.period_px))
    disagreement = np.maximum(mean - before_pixel, fit.brightness - mean)
    allowed = 3 * background.noise_grey * np.sqrt(3 / len(capture.shifts_rad))
    return ((noise + np.maximum(disagreement - allowed, 0) / 2) / bright).astype(np.float32)


def clipped_share(capture: Capture, fit: FringeFit, inside: Mask, window: Window) -> Image:
    """Share of the window's weight on the object that is saturated in any of the frames, float32 (h, w)."""
    clipped = np.any([grey >= GREY_LEVELS for grey in capture.greys], axis=0) & inside
    return (window.moment(clipped.astype(np.float32)) / np.maximum(fit.weight, 1e-3)).astype(np.float32)


def expected_error_mm(observation: Observation, margin: Image, depth_mm: NDArray) -> tuple[Image, Image]:
    """Expected absolute error of ``depth_mm`` (h, w) in mm, float32, and the order's part of it; 0 outside the mask."""
    layer = observation.layer
    z = np.maximum(depth_mm, observation.rig.working_range_mm[0]) / MM_PER_M
    ahead = layer.forward * z + layer.back_m
    mm_per_rad = np.abs(ahead**2 / (layer.gain * layer.forward)) * MM_PER_M
    wrong_chance = 1 / (1 + np.exp(np.clip(margin / MARGIN_SCALE, 0, 50)))
    error_mm = mm_per_rad * (observation.uncertainty_rad + TAU * wrong_chance)
    doubt_mm = mm_per_rad * TAU * wrong_chance
    outside = ~observation.inside
    error_mm[outside] = doubt_mm[outside] = 0
    return error_mm.astype(np.float32), doubt_mm.astype(np.float32)


def reasons(
    observation: Observation, margin: Image, confidence: Image, depth_mm: NDArray, settings: Settings
) -> NDArray[np.uint8]:
    """A `Reason` for every pixel (h, w), masked or not: `Reason.MEASURED` for a pixel that can be trusted.
    ``depth_mm`` is 0 where it is not in the working range."""
    slopes, period_px = observation.slopes, observation.period_px
    axis = 0 if settings.direction == "vertical" else 1
    # The carrier of a plane square to the axis advances by one period every period_px; slopes come on top.
    along = np.abs(TAU / period_px + slopes[axis]) * period_px / TAU
    across = np.abs(slopes[1 - axis]) * period_px / TAU
    frequency = np.hypot(along, across)
    widest = disk(THIN_PERIODS / 2 * period_px)
    thick = cv2.morphologyEx(observation.inside.astype(np.uint8), cv2.MORPH_OPEN, widest) > 0
    by_reason = {
        Reason.BACKGROUND: ~observation.inside,
        Reason.LOW_MODULATION: observation.fit.brightness < MIN_MODULATION,
        Reason.SATURATED: observation.clipped_share > SATURATED_SHARE,
        Reason.OUT_OF_RANGE: depth_mm == 0,
        Reason.THIN: ~thick,
        Reason.TOO_STEEP: (frequency < SLOWEST) | (frequency > FASTEST),
        Reason.AMBIGUOUS: margin < LEAST_MARGIN,
        Reason.UNSURE: confidence < settings.min_confidence,
    }
    return np.select(list(by_reason.values()), [np.uint8(reason) for reason in by_reason], np.uint8(Reason.MEASURED))
