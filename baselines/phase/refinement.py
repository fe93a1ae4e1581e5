"""The depth of every pixel: one unknown, the nearness, fitted to the frame itself under a Gaussian window.

The frame is ``I - ambient = g (1 + c_1 cos phase_1(q) + c_2 cos phase_2(q))``. Starting from the nearness of the grid,
g (a quadratic) and one change of q are solved for around each pixel. Depth jumps inside a window are in the start
already. A second round, or less weight for pixels that the first does not explain, makes it worse.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import Image, Mask
from fpp_ml_bench.baselines.phase.carriers import Carriers
from fpp_ml_bench.baselines.phase.local_fit import CURVED, Window, solve_symmetric

WINDOW_PERIODS = 0.27
LARGEST_STEP_RAD = 0.7  # largest change of the joint phase: beyond it the linear model does not hold
LEAST_GREY = 0.5  # least brightness that a change is divided by
SYSTEMATIC_SHARE, RIM_SHARE = 0.06, 0.6
"""Of the power of a misfit that is no noise, what acts as an error of the phase: everywhere, and more by the share of
the window that lies beyond the object. So that 68% intervals hold 68% of the pixels of validation views."""


@dataclass(frozen=True)
class Fit:
    """``nearness`` float32 (h, w); ``brightness`` g, grey levels (a white pattern's is twice as much); ``misfit_grey``:
    frame minus fit; ``slope``: change of the fringes over their brightness by the joint phase; ``weight``: share of the
    window that lies on the object; ``uncertainty_rad``: standard uncertainty of the joint phase from noise and misfit,
    apart from the order."""

    nearness: NDArray[np.float32]
    brightness: Image
    misfit_grey: Image
    slope: Image
    weight: Image
    uncertainty_rad: Image


def fringes(carriers: Carriers, nearness: NDArray, contrast: tuple[float, float]) -> tuple[Image, Image]:
    """Light over brightness (h, w) of crossed fringes of some ``contrast`` at ``nearness``, and its change by the joint
    phase."""
    raised, slope = np.ones(nearness.shape, np.float32), np.zeros(nearness.shape, np.float32)
    shares = carriers.gain / carriers.joint_gain
    for phase, share, modulation in zip(carriers.phases(nearness), shares, contrast, strict=True):
        raised += np.float32(modulation) * np.cos(phase)
        slope -= np.float32(modulation) * np.sin(phase) * share
    return raised, slope


def refined(
    carriers: Carriers, light: Image, inside: Mask, nearness: NDArray, contrast: tuple[float, float], noise_grey: float
) -> Fit:
    """The fit to ``light`` (h, w), grey levels less ambient light, on the pixels ``inside``, from a first
    ``nearness``."""
    window = Window(WINDOW_PERIODS * carriers.period_px)
    terms = CURVED

    def m(values: NDArray, along_x: int = 0, along_y: int = 0) -> NDArray:
        return window.moment(values, along_x, along_y)

    raised, slope = fringes(carriers, nearness, contrast)
    # The moments of a quadratic's terms are too much alike for the elimination in single precision.
    weight = inside.astype(np.float64)
    by_raised, by_slope = weight * raised, weight * slope
    rr, rs, ss = by_raised * raised, by_raised * slope, by_slope * slope
    right = [m(light * by_raised, a, b) for a, b in terms] + [m(light * by_slope)]
    rows = [[m(rr, a + c, b + d) for c, d in terms[i:]] + [m(rs, a, b)] for i, (a, b) in enumerate(terms)] + [[m(ss)]]
    share = np.maximum(m(weight), 1e-6)
    curvature = np.maximum(rows[-1][0] / share, 1e-3)
    brightness, *_, change = solve_symmetric(rows, right)
    bright = np.maximum(brightness, LEAST_GREY)
    nearness = nearness + np.clip(change / bright, -LARGEST_STEP_RAD, LARGEST_STEP_RAD) / carriers.joint_gain
    raised, slope = fringes(carriers, nearness, contrast)
    misfit = light - np.maximum(brightness, 0) * raised
    power = m(misfit * misfit * weight) / share
    averaged = noise_grey**2 / (2 * np.pi * window.sigma_px**2 * np.maximum(share, 0.05))
    acting = SYSTEMATIC_SHARE + RIM_SHARE * (1 - np.minimum(share, 1))
    systematic = np.maximum(power - noise_grey**2, 0) * acting
    uncertainty = np.sqrt((averaged + systematic) / curvature) / bright
    maps = (nearness, brightness, misfit, slope, share, uncertainty)
    return Fit(*(np.asarray(values, np.float32) for values in maps))
