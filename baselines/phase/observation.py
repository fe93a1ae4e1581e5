"""Data of the phase route: its settings, what it has measured before the fringe orders are chosen, and its result."""

from dataclasses import dataclass
from enum import IntEnum
from time import perf_counter
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import CalibrationLayer, Candidates, Image, Mask
from fpp_ml_bench.baselines.phase.local_fit import FringeFit
from fpp_ml_bench.baselines.phase.object_mask import Background, Crop
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import DIRECTIONS, Direction

Prior = Literal["none", "standoff"]
PIXELWISE = 3  # frames from which on every pixel has a phase of its own
_POSITIVE = "first_window", "second_window", "pair_window", "slope_window", "jump_rad", "shading_spread"


@dataclass(frozen=True)
class Settings:
    """``direction`` of the fringes and how many ``frames`` of them, 1 to all that are projected; what the choice of
    the order may use: ``shading`` and ``prior`` ("standoff": objects are near the rig's standoff, true of fixed
    placement); ``min_confidence``: pixels below it are 0 (0: dense, every object pixel gets a depth). The defaults
    were chosen on train and validation objects.

    Windows, in fringe periods: of the first fit, of the second, of the last one to two frames, and of the slopes. Costs
    (no unit): ``shading_cost`` a pixel for each ``shading_spread`` of log brightness, up to ``shading_limit`` of them;
    ``prior_cost`` a pixel for each 100 mm; ``jump_rad``: a jump of phase between neighbours from which on it costs no
    more. ``slack_mm`` widens the range in which orders are chosen, for noise at its ends: a depth
    beyond them is left out, and no other order is taken to be within. ``white_grey`` and ``ambient_grey``, if given,
    calibrate brightness (see `EmptyScene`); without them it is taken from the lit background, and where the image
    shows none, range and continuity settle the order, or it is ambiguous and has no depth (see `continuity`).
    """

    direction: Direction = "horizontal"
    frames: int = 1
    shading: bool = True
    prior: Prior = "none"
    min_confidence: float = 0.0
    first_window: float = 0.35
    second_window: float = 0.27
    pair_window: float = 0.06
    slope_window: float = 0.13
    shading_cost: float = 0.003
    shading_spread: float = 0.1
    shading_limit: float = 3.0
    prior_cost: float = 0.002
    jump_rad: float = 2.5
    slack_mm: float = 15.0
    white_grey: float | None = None
    ambient_grey: float | None = None

    def __post_init__(self) -> None:
        if self.direction not in DIRECTIONS:
            raise PredictionError(f"direction {self.direction!r}: one fringe is {' or '.join(DIRECTIONS)}, not both")
        if self.prior not in get_args(Prior):
            raise PredictionError(f"prior {self.prior!r}: expected {' or '.join(get_args(Prior))}")
        if not 0 <= self.min_confidence < 1:
            raise PredictionError(f"min_confidence {self.min_confidence!r}: expected 0 (dense) to below 1")
        for name in (*_POSITIVE, *(["white_grey"] if self.white_grey is not None else [])):
            if not 0 < getattr(self, name) < np.inf:
                raise PredictionError(f"{name} {getattr(self, name)!r}: expected more than 0")
        if self.ambient_grey is not None and not 0 <= self.ambient_grey <= GREY_LEVELS:
            raise PredictionError(f"ambient_grey {self.ambient_grey!r}: expected 0 to {GREY_LEVELS} grey levels")


class Watch:
    """Seconds of each stage since the last."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._since = perf_counter()

    def done(self, stage: str) -> None:
        now = perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._since
        self._since = now


@dataclass(frozen=True)
class Capture:
    """Captured fringes around the object: maps (h, w) of the part ``crop`` of images of ``shape`` (H, W). ``greys``:
    float32 grey levels of each frame, whose fringe is shifted by ``shifts_rad``; ``background`` and ``layer``: fit of
    the empty scene and calibration layer, both of the crop; ``period_px``: of the fringe in the image. An image without
    an object has a crop of one pixel."""

    rig: Rig
    period_px: float
    shape: tuple[int, ...]
    crop: Crop
    greys: tuple[Image, ...]
    shifts_rad: tuple[float, ...]
    background: Background
    layer: CalibrationLayer
    watch: Watch

    @property
    def pixelwise(self) -> bool:
        """Whether there are frames enough for every pixel to have a phase of its own."""
        return len(self.greys) >= PIXELWISE


@dataclass(frozen=True)
class Observation(Capture):
    """Everything measured in a capture before the orders are chosen, maps (h, w). ``inside``: object; ``fit``: phase,
    not wrapped, and brightness; ``phase_rad`` float32, the fit's phase in [-pi, pi]; ``slopes``: change of the residual
    phase in rad a px along x and y; ``uncertainty_rad`` float32: of the phase, without the order; ``clipped_share``
    float32: of the window's weight, what is saturated; ``candidates``: the orders that the working range allows."""

    inside: Mask
    fit: FringeFit
    phase_rad: Image
    slopes: tuple[Image, Image]
    uncertainty_rad: Image
    clipped_share: Image
    candidates: Candidates


class Reason(IntEnum):
    """Why a pixel should not be trusted; of several reasons the lowest. BACKGROUND: the empty scene explains it.
    LOW_MODULATION: too dark for a fringe, in shadow or turned away. SATURATED: clipped grey levels in the window.
    OUT_OF_RANGE: its depth is not in the working range, and is left out. THIN: the object is thinner than half a period
    there. TOO_STEEP: the fringe is compressed or stretched beyond what a window resolves. AMBIGUOUS: the candidate
    orders can't be told apart. UNSURE: the expected error alone is too large."""

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
    """Maps (H, W) of one image; NaN or 0 where there is no object. ``wrapped_phase_rad`` float32 in [-pi, pi];
    ``modulation_grey`` float32 grey levels; ``order`` int32; ``candidates``: the orders that the working range allows;
    ``confidence`` float32, 0 to 1, computed from ``expected_error_mm`` float32; ``order_doubt_mm``: the part of that
    error that comes from the order; ``depth_mm`` float32, 0 = background or masked; ``reason`` uint8, a `Reason`, given
    whether the pixel was masked or not; ``counts``: pixels per reason; ``background_share``: of the image's tiles that
    calibrated its brightness; ``seconds`` per stage."""

    wrapped_phase_rad: Image
    modulation_grey: Image
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

    @property
    def sigma_mm(self) -> Image:
        """Standard uncertainty of the depth, float32 (H, W), 0 where there is none: that of a normal error whose
        expected size is ``expected_error_mm``."""
        return np.where(self.depth_mm > 0, self.expected_error_mm * np.float32(np.sqrt(np.pi / 2)), np.float32(0))
