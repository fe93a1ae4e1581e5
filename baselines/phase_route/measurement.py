"""The phase route's result for an image: depth, confidence, and reasons for a low confidence."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route.calibration_layer import Candidates

Image = NDArray[np.float32]


class Reason(IntEnum):
    """Why a pixel should not be trusted; of several reasons the lowest.

    BACKGROUND: the empty scene explains it. LOW_MODULATION: too dark for a fringe, in shadow or turned away.
    SATURATED: clipped grey levels in the window. OUT_OF_RANGE: no order puts it in the working range. THIN: the object
    is thinner than half a period there. TOO_STEEP: the fringe is compressed or stretched beyond what a window resolves.
    AMBIGUOUS: the candidate orders can't be told apart. UNSURE: the expected error alone is too large.
    """

    MEASURED = 0
    BACKGROUND = 1
    LOW_MODULATION = 2
    SATURATED = 3
    OUT_OF_RANGE = 4
    THIN = 5
    TOO_STEEP = 6
    AMBIGUOUS = 7
    UNSURE = 8


@dataclass(frozen=True)
class Measurement:
    """Maps (H, W) of one image; NaN or 0 where there is no object.

    ``wrapped_phase`` float32 rad in [-pi, pi]; ``modulation`` float32 grey levels; ``order`` int32; ``candidates``: the
    orders that the working range allows; ``confidence`` float32, 0 to 1, computed from ``expected_error_mm`` float32;
    ``order_doubt_mm``: the part of that error that comes from the order; ``depth_mm`` float32, 0 = background or
    masked; ``reason`` uint8, a `Reason`, given whether the pixel was masked or not; ``counts``: pixels per reason;
    ``background_share``: of the image's tiles that calibrated its brightness; ``seconds`` per stage.
    """

    wrapped_phase: Image
    modulation: Image
    order: NDArray[np.int32]
    candidates: Candidates
    confidence: Image
    expected_error_mm: Image
    order_doubt_mm: Image
    depth_mm: Image
    reason: NDArray[np.uint8]
    counts: dict[str, int]
    background_share: float
    seconds: dict[str, float]
