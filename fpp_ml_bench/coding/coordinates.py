"""What a code measures at each pixel: a projector coordinate, or the reason why there is none."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.gray_code import AMBIGUOUS_FRACTION

MIN_MODULATION = 5.0
"""Grey levels. At a read noise of 1 grey level and only 3 steps the phase noise is then 0.16 rad: a tenth of the pi/2
that the fringe order tolerates, about 7 mm of depth at 1.8 m. Less means shadow, glare or no projector light."""
CLIPPED_STEPS_DIVISOR = 9
"""A pixel may be saturated in N // 9 of its N steps (2 of 18, none below 9). N steps cancel harmonics up to N - 2, so
that a clipped crest then distorts the phase by under 5 mrad; with few steps it would be tens of mrad."""
MAX_DISAGREEMENT_PX = 1.5
"""Projector px between a pixel's measured (u, v) and its epipolar line. Noise at the least modulation and 3 steps
gives a sigma of 0.5 px; a fringe order that is wrong by 1 shifts an 18 px fringe by more than 10 px."""


class Reason(IntEnum):
    """Why a pixel has no depth. Where several reasons apply, the lowest code is stored.

    NO_RAY: the camera's lens model has no inverse at this pixel, or the ray does not meet the measured projector plane
    in front of both devices. NOT_ASKED: the pixel is outside the mask.
    """

    DECODED = 0
    NO_RAY = 1
    LOW_MODULATION = 2
    SATURATED = 3
    INCONSISTENT_ORDER = 4
    OUTSIDE_PATTERN = 5
    DIRECTIONS_DISAGREE = 6
    OUTSIDE_RANGE = 7
    NOT_ASKED = 8


STAGE_REASONS = (Reason.LOW_MODULATION, Reason.SATURATED, Reason.INCONSISTENT_ORDER, Reason.OUTSIDE_PATTERN)
"""Reasons that a code gives, in the order in which they are looked at."""


@dataclass(frozen=True)
class Limits:
    """Conditions that a decoded pixel meets; the defaults are explained beside their constants."""

    min_modulation: float = MIN_MODULATION
    max_clipped_steps: int | None = None
    max_disagreement_px: float = MAX_DISAGREEMENT_PX
    ambiguous_fraction: float = AMBIGUOUS_FRACTION


@dataclass(frozen=True)
class Coordinates:
    """A block's measurement in one direction: coordinate (px), modulation (grey levels) and phase (rad), float64 (n,)
    each, and the reason codes, uint8 (n,)."""

    coordinate_px: NDArray[np.float64]
    modulation: NDArray[np.float64]
    phase: NDArray[np.float64]
    reason: NDArray[np.uint8]

    @classmethod
    def judged(
        cls,
        coordinate_px: NDArray,
        modulation: NDArray,
        phase: NDArray,
        saturated: NDArray,
        inconsistent: NDArray,
        length_px: float,
        limits: Limits,
    ) -> "Coordinates":
        """With the first reason that applies of `STAGE_REASONS`; ``saturated`` and ``inconsistent`` bool (n,)."""
        outside = (coordinate_px < -0.5) | (coordinate_px > length_px - 0.5)
        faults = modulation < limits.min_modulation, saturated, inconsistent, outside
        reason = np.select(faults, [np.uint8(code) for code in STAGE_REASONS], np.uint8(0))
        return cls(coordinate_px, modulation, phase, reason)

    def at(self, indices: NDArray[np.intp]) -> "Coordinates":
        """The coordinates of the pixels at ``indices`` only."""
        return Coordinates(*(values[indices] for values in vars(self).values()))
