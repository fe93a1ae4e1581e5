"""Local least squares of a fringe under a Gaussian window, which never reaches across the object mask.

First fit: ``I = a + b x + c y + C cos(theta) + S sin(theta)`` around each pixel, with theta a carrier (a plane at the
standoff) whose phase the solution corrects by ``atan2(-S, C)``. Second fit: ``I - ambient = g (1 + cos(theta + d))``
with g a plane. A projected fringe goes down to black, so its mean and its modulation are the same number g; with that
constraint a slope of brightness is not taken for phase.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import Image, Mask, wrapped

WINDOW_SIGMAS = 3.0
RIDGE = 1e-6  # of the window's weight, added to the diagonal: fits of a few pixels stay finite
LARGEST_STEP_RAD = 0.7  # largest correction of the second fit: beyond it the linear model does not hold
WHOLE_WINDOW = 0.9  # share of a window that lies on the object, of the pixels on which contrast is measured
LEAST_CONTRAST = 0.3
STEEPEST_RAD_PER_PX = 0.5
"""Largest change of the residual phase a px that counts as slope; the carrier itself changes by 0.28."""


PLANE = ((0, 0), (1, 0), (0, 1))
"""Powers of x and y of the terms of a brightness that changes evenly across a window."""
CURVED = (*PLANE, (2, 0), (1, 1), (0, 2))


class Window:
    """A Gaussian of ``sigma_px`` and its moments up to the fourth, for `cv2.sepFilter2D`."""

    def __init__(self, sigma_px: float) -> None:
        half = int(np.ceil(WINDOW_SIGMAS * sigma_px))
        t = np.arange(-half, half + 1) / sigma_px
        weight = np.exp(-0.5 * t * t)
        weight /= weight.sum()
        self.sigma_px = sigma_px
        self._kernels = [(weight * t**power).astype(np.float64) for power in range(2 * max(map(max, CURVED)) + 1)]

    def moment(self, image: Image, along_x: int = 0, along_y: int = 0) -> Image:
        """Sum of ``image`` (H, W) under the window times x^along_x y^along_y, in window sigmas; 0 beyond the image. In
        the image's precision, single or double."""
        kernels = self._kernels
        return cv2.sepFilter2D(image, -1, kernels[along_x], kernels[along_y], borderType=cv2.BORDER_CONSTANT)  # type: ignore[return-value]


@dataclass(frozen=True)
class FringeFit:
    """``phase_rad`` float32 (H, W), not wrapped: carrier plus correction; ``brightness`` g, grey levels (a white
    pattern's is twice as much); ``weight``: share of the window that lies on the object; ``contrast`` of the fringes,
    modulation over mean."""

    phase_rad: Image
    brightness: Image
    weight: Image
    contrast: float = 1.0

    @property
    def light(self) -> Image:
        """Grey levels (H, W) of the fitted fringe, without the ambient light, in the first frame."""
        fringe = np.cos(self.phase_rad) if self.contrast == 1 else np.float32(self.contrast) * np.cos(self.phase_rad)
        return np.maximum(self.brightness, 0) * (1 + fringe)


def solve_symmetric(rows: list[list[Image]], right: list[Image]) -> list[Image]:
    """Solve one small symmetric system a pixel by elimination without pivoting; ``rows``: from the diagonal on. Both
    arguments are overwritten. The windows' normal matrices are positive; `RIDGE` keeps them so in float32."""
    size = len(right)
    ridge = RIDGE * rows[0][0] + np.float32(1e-9)
    for row in rows:
        row[0] = row[0] + ridge
    for i in range(size):
        for j in range(i + 1, size):
            factor = rows[i][j - i] / rows[i][0]
            for k in range(j, size):
                rows[j][k - j] = rows[j][k - j] - factor * rows[i][k - i]
            right[j] = right[j] - factor * right[i]
    for i in reversed(range(size)):
        for j in range(i + 1, size):
            right[i] = right[i] - rows[i][j - i] * right[j]
        right[i] = right[i] / rows[i][0]
    return right


def carrier_fit(grey: Image, inside: Mask, carrier_rad: NDArray, window: Window) -> tuple[Image, Image]:
    """Phase in rad and modulation in grey levels, float32 (H, W), from the five-term fit of ``grey`` around each pixel;
    use them inside only."""
    weight = inside.astype(np.float32)
    light = grey * weight
    cosine, sine = np.cos(carrier_rad).astype(np.float32), np.sin(carrier_rad).astype(np.float32)
    by_cosine, by_sine = weight * cosine, weight * sine
    m = window.moment
    w00, cc = m(weight), m(by_cosine * cosine)
    rows = [
        [w00, m(weight, 1, 0), m(weight, 0, 1), m(by_cosine), m(by_sine)],
        [m(weight, 2, 0), m(weight, 1, 1), m(by_cosine, 1, 0), m(by_sine, 1, 0)],
        [m(weight, 0, 2), m(by_cosine, 0, 1), m(by_sine, 0, 1)],
        [cc, m(by_cosine * sine)],
        [w00 - cc],
    ]
    answer = solve_symmetric(rows, [m(light), m(light, 1, 0), m(light, 0, 1), m(light * cosine), m(light * sine)])
    phase: Image = (carrier_rad + np.arctan2(-answer[4], answer[3])).astype(np.float32)
    return phase, np.hypot(answer[3], answer[4])


def fringe_fit(
    greys: Sequence[Image],
    inside: Mask,
    carrier_rad: Image,
    ambient: float,
    window: Window,
    shifts_rad: Sequence[float],
    contrast: float = 1.0,
    terms: Sequence[tuple[int, int]] = PLANE,
) -> FringeFit:
    """Fit of g (1 + c cos(carrier + shift + d)), g of the ``terms`` and c the ``contrast``, around each pixel of
    ``greys``, float32 (H, W) each: one image, or several whose fringes are shifted by ``shifts_rad``."""
    # The moments of more terms than a plane's are too much alike for the elimination in single precision.
    real: type = np.float32 if len(terms) <= len(PLANE) else np.float64
    weight: NDArray = inside.astype(real)
    rr: NDArray
    rr = rs = ss = lr = ls = np.zeros_like(weight)
    for grey, shift in zip(greys, shifts_rad, strict=True):
        angle = carrier_rad.astype(real) + real(shift)
        light = (grey - real(ambient)) * weight
        raised, sine = 1 + real(contrast) * np.cos(angle), real(contrast) * np.sin(angle)
        rr, rs, ss = rr + weight * raised * raised, rs + weight * raised * sine, ss + weight * sine * sine
        lr, ls = lr + light * raised, ls + light * sine
    m = window.moment
    rows = [[m(rr, a + c, b + d) for c, d in terms[i:]] + [m(rs, a, b)] for i, (a, b) in enumerate(terms)] + [[m(ss)]]
    g, *_, s = solve_symmetric(rows, [m(lr, a, b) for a, b in terms] + [m(ls)])
    step = np.clip(-s / np.maximum(g, 1.0), -LARGEST_STEP_RAD, LARGEST_STEP_RAD)
    phase, share = (carrier_rad + step).astype(np.float32), m(weight).astype(np.float32)
    return FringeFit(phase, g.astype(np.float32), share, contrast)


def measured_contrast(light: Image, inside: Mask, fit: FringeFit) -> float:
    """Modulation over mean of the fringes of ``light`` (grey levels less the ambient light), over the pixels whose
    window lies on the object: the contrast with which the phase and brightness of ``fit`` explain them best."""
    fringe, whole = np.cos(fit.phase_rad), inside & (fit.weight > WHOLE_WINDOW)
    varies = np.clip(light / np.maximum(fit.brightness, 1.0) - 1, -1, 1)
    power = float((fringe**2).sum(where=whole, dtype=np.float64))
    if power == 0:
        return fit.contrast
    return float(np.clip((fringe * varies).sum(where=whole, dtype=np.float64) / power, LEAST_CONTRAST, 1.0))


def phase_slopes(residual_rad: Image, inside: Mask, smooth_px: float) -> tuple[Image, Image]:
    """Change of the residual phase a px along x and y, float32 (H, W), averaged under a Gaussian inside the mask."""
    size = 2 * int(np.ceil(2.5 * smooth_px)) + 1
    weight = cv2.erode(inside.astype(np.float32), np.ones((3, 3), np.uint8))
    total = np.maximum(cv2.GaussianBlur(weight, (size, size), smooth_px, borderType=cv2.BORDER_CONSTANT), 1e-3)
    slopes: list[Image] = []
    for axis in (1, 0):
        change: NDArray = wrapped(np.roll(residual_rad, -1, axis) - np.roll(residual_rad, 1, axis)) / 2
        change = np.clip(change, -STEEPEST_RAD_PER_PX, STEEPEST_RAD_PER_PX).astype(np.float32) * weight
        smooth = cv2.GaussianBlur(change, (size, size), smooth_px, borderType=cv2.BORDER_CONSTANT)
        slopes.append((smooth / total).astype(np.float32))
    return slopes[0], slopes[1]
