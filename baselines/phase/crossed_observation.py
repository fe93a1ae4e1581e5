"""Data of the crossed route: its settings, what it has measured, and its result."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import Image, Mask
from fpp_ml_bench.baselines.phase.carriers import Carriers
from fpp_ml_bench.baselines.phase.crossed_orders import Candidates
from fpp_ml_bench.baselines.phase.object_mask import Background, Crop
from fpp_ml_bench.baselines.phase.observation import Watch
from fpp_ml_bench.baselines.phase.refinement import Fit
from fpp_ml_bench.errors import PredictionError


@dataclass(frozen=True)
class Settings:
    """``min_confidence``: pixels below it are 0 (0: dense); ``slack_mm`` widens the range in which orders are chosen,
    as that of `phase.Settings`. Raises `PredictionError`."""

    min_confidence: float = 0.0
    slack_mm: float = 15.0

    def __post_init__(self) -> None:
        if not 0 <= self.min_confidence < 1:
            raise PredictionError(f"min_confidence {self.min_confidence!r}: expected 0 (dense) to below 1")


class CrossedReason(IntEnum):
    """Why a pixel should not be trusted; of several reasons the lowest. BACKGROUND: the empty scene explains it.
    LOW_MODULATION: too dark for fringes, in shadow or turned away. SATURATED: clipped grey levels in the window.
    OUT_OF_RANGE: its depth is not in the working range, and is left out.
    ONE_DIRECTION: one carrier is not to be seen, so that nothing decides the order. TEXTURE: what the window shows is
    no crossed fringe: stripes near a carrier's period, or a depth edge. AMBIGUOUS: a rival order is as likely. UNSURE:
    the expected error alone is too large."""

    MEASURED = 0
    BACKGROUND = 1
    LOW_MODULATION = 2
    SATURATED = 3
    OUT_OF_RANGE = 4
    ONE_DIRECTION = 5
    TEXTURE = 6
    AMBIGUOUS = 7
    UNSURE = 8


@dataclass(frozen=True)
class CrossedObservation:
    """A frame measured around its object, maps (h, w) of the part ``carriers.crop`` of an image of ``shape`` (H, W):
    ``grey`` float32; ``inside``: object; ``fit``; ``phase_rad`` and ``modulation`` float32 (2, h, w): wrapped phases
    and grey levels of the first windows; ``contrast``: modulation over mean of each carrier, in this image; ``margin``:
    energy of the rival order minus that of the chosen one; ``evidence``: the same difference for the cost of the phase
    misfit alone (a misfit of s standard deviations costs s^2 / 2); ``rival``: nearness of the rival; ``candidates`` (3,
    h, w): a turn further, the chosen order, and a turn nearer; ``clipped_share``: of the window, saturated."""

    carriers: Carriers
    shape: tuple[int, ...]
    grey: Image
    background: Background
    inside: Mask
    fit: Fit
    phase_rad: Image
    modulation: Image
    contrast: tuple[float, float]
    margin: Image
    evidence: Image
    rival: Image
    candidates: Candidates
    clipped_share: Image
    watch: Watch

    @property
    def crop(self) -> Crop:
        return self.carriers.crop


@dataclass(frozen=True)
class CrossedMeasurement:
    """Maps (H, W) of one image; 0 where there is no object. ``depth_mm`` float32, 0 = background or masked;
    ``sigma_mm`` float32: standard uncertainty; ``confidence`` float32, 0 to 1; ``wrong_chance`` float32: probability
    that the order is wrong; ``brightness_grey`` float32; ``reason`` uint8, a `CrossedReason`; ``counts``: pixels per
    reason; ``background_share``: of the image that shows the plane; ``seconds`` per stage."""

    depth_mm: Image
    sigma_mm: Image
    confidence: Image
    wrong_chance: Image
    brightness_grey: Image
    reason: NDArray[np.uint8]
    counts: dict[str, int]
    background_share: float
    seconds: dict[str, float]
