"""The background plane in a crossed frame: the pixels where both phases are the plane's, and their grey levels.

The plane's phases are known from the rig, the light is not: the lamp's brightness, the contrast of the fringes, and the
response of projector and camera are fitted to the pixels that show the plane. So no absolute grey level is needed.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import Image, Mask, wrapped
from fpp_ml_bench.baselines.phase.carriers import Carriers
from fpp_ml_bench.baselines.phase.demodulation import Demodulated
from fpp_ml_bench.baselines.phase.object_mask import (
    DEFAULT_NOISE_GREY,
    FLOOR_NOISE_GREY,
    Background,
    image_noise_grey,
    plane_irradiance,
)
from fpp_ml_bench.constants import MAD_TO_SIGMA, MM_PER_M

SAME_RAD = 0.4  # distance of a phase pair from the plane's within which a pixel may show it
MARGIN_PERIODS = 0.4  # eroded from those pixels: a window beside an object covers it too
SAMPLE_STEP_PX = 5
LEAST_SHARE = 0.02  # of the image that must show the plane
SAMPLES = 4000  # points to which the plane is fitted, about
ROUNDS = 4
OUTLIER_SIGMAS = 4.0
DARK_PERCENTILE = 1.0  # of the grey levels, smoothed, that is taken for ambient light
CURVE_POWERS = (1, 2, 3)
"""Powers of the fitted light whose sum is the plane's grey level: a gamma of projector or camera bends it."""


class EmptySceneFit:
    """The plane of a rig in the light of a carrier pair; computed once, then fitted to every image."""

    def __init__(self, carriers: Carriers, stride: int) -> None:
        rig = carriers.rig
        self.known = rig.background_m is not None
        shape = rig.camera.height, rig.camera.width
        self._coarse = slice(None, None, stride), slice(None, None, stride)
        self._stride = stride
        if rig.background_m is None:
            return
        phases = carriers.phases(carriers.nearness(rig.background_m * MM_PER_M))
        self._phases = wrapped(phases[:, *self._coarse])
        x, y = (axis.astype(np.float32) for axis in rig.camera.rays())
        fall_off = plane_irradiance(rig, rig.background_m).astype(np.float32)
        fall_off /= np.float32(np.median(fall_off))
        lamp = [fall_off * term for term in (np.ones_like(x), x, y, x * x, x * y, y * y)]
        first, second = (np.float32(w) * np.cos(phase) for w, phase in zip(carriers.weights, phases, strict=True))
        self._terms = [
            term.astype(np.float32)
            for term in (
                *(part * (1 + first + second) for part in lamp),
                fall_off * first,
                fall_off * second,
                np.ones(shape),
            )
        ]
        self._margin = 2 * max(1, round(MARGIN_PERIODS * carriers.period_px / stride)) + 1

    def __call__(self, grey: Image, seen: Demodulated) -> Background:
        """Fit the plane to an image float32 (H, W), demodulated as ``seen``: its ``residual`` float32 (H, W), ambient
        light and noise, and the ``share`` of the image that shows it, 0 where it is not to be seen. The brightness of a
        crossed frame tells no distance: `Background.strength` is NaN."""
        smooth = cv2.blur(grey, (3, 3))[::SAMPLE_STEP_PX, ::SAMPLE_STEP_PX]
        dark = float(np.percentile(smooth, DARK_PERCENTILE))
        noise = max(image_noise_grey(grey), FLOOR_NOISE_GREY)
        plane_points = self._plane(seen, noise) if self.known else np.zeros(seen.mean_grey.shape, bool)
        share = float(plane_points.mean())
        if share < LEAST_SHARE:
            return Background(dark, np.nan, max(noise, DEFAULT_NOISE_GREY), np.zeros_like(grey), 0.0, ())
        places = np.argwhere(plane_points)
        row, column = self._stride * places[:: max(1, len(places) // SAMPLES)].T
        samples = grey[row, column].astype(np.float64)
        terms = np.stack([term[row, column] for term in self._terms], axis=1).astype(np.float64)
        light, weights = _robust(terms, samples)
        curve = np.stack([light**power for power in CURVE_POWERS] + [np.ones_like(light)], axis=1)
        scale = np.abs(curve).max(axis=0)
        fitted, bend = _robust(curve / scale, samples)
        noise = max(MAD_TO_SIGMA * float(np.median(np.abs(samples - fitted))), FLOOR_NOISE_GREY)
        # Horner's rule on whole images, in single precision: 1e-5 of a grey level is enough here.
        first = sum((np.float32(w) * term for w, term in zip(weights, self._terms, strict=True)), np.float32(0))
        bend = (bend / scale).astype(np.float32)
        plane = ((bend[2] * first + bend[1]) * first + bend[0]) * first + bend[3]
        return Background(dark, np.nan, noise, grey - plane, share, ())

    def _plane(self, seen: Demodulated, noise_grey: float) -> Mask:
        """Grid points (h', w') whose windows show the plane alone."""
        distance = np.hypot(*wrapped(seen.phase_rad - self._phases))
        visible = seen.modulation.min(axis=0) > noise_grey / 4
        same = ((distance < SAME_RAD) & visible).astype(np.uint8)
        return cv2.erode(same, np.ones((self._margin, self._margin), np.uint8), borderValue=1) > 0  # type: ignore[call-overload,no-any-return]


def _robust(terms: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
    """Least squares without outliers: the fitted values and the solution."""
    keep = np.ones(len(values), bool)
    fitted: NDArray = values
    solution: NDArray = values
    for _ in range(ROUNDS):
        solution = np.linalg.lstsq(terms[keep], values[keep], rcond=None)[0]
        fitted = terms @ solution
        misfit = np.abs(values - fitted)
        keep = misfit < OUTLIER_SIGMAS * max(MAD_TO_SIGMA * float(np.median(misfit[keep])), FLOOR_NOISE_GREY)
    return fitted, solution
