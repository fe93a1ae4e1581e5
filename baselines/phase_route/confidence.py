"""The expected error of each pixel in mm, and the reasons not to trust a pixel.

The expected error adds three parts. Noise and misfit of the local fit: the window's rms misfit over brightness is a
phase error, and the calibration layer's slope turns it into depth. The rim: where half the window lies off the object,
the fit extrapolates instead of averaging. The order: its margin gives the probability of being a period off, whose
error in mm is known. The confidence, 1 / (1 + error / 5 mm), lies between 0 and 1.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route.calibration_layer import TAU
from fpp_ml_bench.baselines.phase_route.empty_scene import Background
from fpp_ml_bench.baselines.phase_route.local_fit import FringeFit, Window
from fpp_ml_bench.baselines.phase_route.measurement import Reason
from fpp_ml_bench.baselines.phase_route.object_mask import disk
from fpp_ml_bench.baselines.phase_route.observation import Observation
from fpp_ml_bench.baselines.phase_route.settings import Settings
from fpp_ml_bench.constants import GREY_LEVELS, MM_PER_M
from fpp_ml_bench.decoding import MIN_MODULATION
from fpp_ml_bench.optics import Rig

Image = NDArray[np.float32]

HALF_CONFIDENCE_MM = 5.0
LEAST_MARGIN = 0.1
"""Least margin of an order that is not ambiguous; 1 is the margin of brightness that rules the rival order out."""
MARGIN_SCALE = 0.04
"""Margin by which the odds of two orders grow e-fold."""
SATURATED_SHARE = 0.02
SLOWEST, FASTEST = 0.35, 2.2
"""Fringe frequency in the image, as a multiple of that of a plane square to the axis, that a window resolves."""
THIN_PERIODS = 0.5


def phase_uncertainty_rad(
    grey: Image, fit: FringeFit, inside: NDArray[np.bool_], slopes: tuple[Image, Image], background: Background,
    window: Window,
) -> Image:  # fmt: skip
    """Expected error of the phase of a local fit to ``grey`` (h, w), in rad, float32; order aside."""
    bright = np.maximum(fit.brightness, 0.5)
    misfit = (grey - background.ambient_grey - bright * (1 + np.cos(fit.phase_rad))) * inside
    power = window.moment((misfit * misfit).astype(np.float32)) / np.maximum(fit.weight, 1e-3)
    # A window of sigma s averages 4 pi s^2 pixels of white noise; what is not noise does not average.
    averaged = background.noise_grey**2 / (2 * np.pi * window.sigma_px**2 * np.maximum(fit.weight, 0.05))
    systematic = np.maximum(power - background.noise_grey**2, 0)
    sigma_phase = np.sqrt(averaged + systematic) / bright
    steep = np.hypot(slopes[0], slopes[1])
    rim = np.clip(1 - fit.weight, 0, 1)
    expected: Image = sigma_phase * (0.3 + rim) + steep * rim  # type: ignore[assignment]  # float32 all through
    return expected


def clipped_share(greys: Sequence[Image], fit: FringeFit, inside: NDArray[np.bool_], window: Window) -> Image:
    """Share of the window's weight on the object that is saturated in any of the frames, float32 (h, w)."""
    anywhere = np.any([grey >= GREY_LEVELS for grey in greys], axis=0)
    clipped = window.moment((anywhere & inside).astype(np.float32))
    share: Image = (clipped / np.maximum(fit.weight, 1e-3)).astype(np.float32)
    return share


def expected_error_mm(observation: Observation, margin: Image, depth_mm: NDArray) -> tuple[Image, Image]:
    """Expected absolute error of ``depth_mm`` (h, w) in mm, float32, and its part that comes from the order; 0 outside
    the mask."""
    layer = observation.layer
    z = np.maximum(depth_mm, 1.0) / MM_PER_M
    ahead = layer.forward * z + layer.back_m
    mm_per_rad = np.abs(ahead**2 / (layer.gain * layer.forward)) * MM_PER_M
    wrong_chance = 1 / (1 + np.exp(np.clip(margin / MARGIN_SCALE, 0, 50)))
    error_mm = np.where(observation.inside, mm_per_rad * (observation.uncertainty_rad + TAU * wrong_chance), 0).astype(
        np.float32
    )
    return error_mm, np.where(observation.inside, mm_per_rad * TAU * wrong_chance, 0).astype(np.float32)


def confidence_of(error_mm: Image) -> Image:
    """1 / (1 + error / 5 mm), float32."""
    return (1 / (1 + error_mm / HALF_CONFIDENCE_MM)).astype(np.float32)


def reasons(
    observation: Observation,
    margin: Image,
    confidence: Image,
    depth_mm: NDArray,
    rig: Rig,
    settings: Settings,
    period_px: float,
) -> NDArray[np.uint8]:
    """A `Reason` for every pixel (h, w), masked or not: `Reason.MEASURED` for a pixel that can be trusted.

    A depth outside the working range is a reason also where another order would give a depth inside: a chooser that
    corrects the phase can leave the range that its orders were chosen for.
    """
    near, far = rig.working_range_mm
    outside = (depth_mm < near - settings.slack_mm) | (depth_mm > far + settings.slack_mm)
    slopes = observation.slopes
    axis = 0 if settings.direction == "vertical" else 1
    # The carrier of a plane square to the axis advances by one period every period_px; slopes come on top.
    along = np.abs(TAU / period_px + slopes[axis]) * period_px / TAU
    across = np.abs(slopes[1 - axis]) * period_px / TAU
    frequency = np.hypot(along, across)
    thick = (
        cv2.morphologyEx(observation.inside.astype(np.uint8), cv2.MORPH_OPEN, disk(THIN_PERIODS / 2 * period_px)) > 0
    )
    reason_map = np.full(observation.inside.shape, Reason.MEASURED, np.uint8)
    checks = (
        (confidence < settings.min_confidence, Reason.UNSURE),
        (margin < LEAST_MARGIN, Reason.AMBIGUOUS),
        ((frequency < SLOWEST) | (frequency > FASTEST), Reason.TOO_STEEP),
        (~thick, Reason.THIN),
        ((observation.candidates.count == 0) | outside, Reason.OUT_OF_RANGE),
        (observation.clipped > SATURATED_SHARE, Reason.SATURATED),
        (observation.fit.brightness < MIN_MODULATION, Reason.LOW_MODULATION),
        (~observation.inside, Reason.BACKGROUND),
    )
    for pixels, reason in checks:
        reason_map[pixels] = reason
    return reason_map
