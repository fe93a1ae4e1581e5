"""What the phase route measures in an image before it chooses the fringe orders."""

from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route.calibration_layer import CalibrationLayer, Candidates
from fpp_ml_bench.baselines.phase_route.empty_scene import Background
from fpp_ml_bench.baselines.phase_route.local_fit import FringeFit
from fpp_ml_bench.baselines.phase_route.orders import Question

Image = NDArray[np.float32]
Crop = tuple[slice, slice]


class Stopwatch:
    """Seconds of each stage since the last."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._since = perf_counter()

    def done(self, stage: str) -> None:
        now = perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._since
        self._since = now


@dataclass(frozen=True)
class Observation:
    """Everything measured around the object; maps (h, w) of the part ``crop`` of an image of ``shape`` (H, W).

    ``frames``: how many were captured; ``grey`` float32 grey levels of the first; ``inside``: object; ``layer``:
    calibration layer of the crop; ``fit``: phase, not wrapped, and brightness; ``phase_rad`` float32, the fit's phase
    in [-pi, pi]; ``residual_rad``: that phase minus the phase at infinity, wrapped; ``slopes``: its
    change a px along x and y; ``uncertainty_rad`` float32: of the phase, order aside; ``clipped`` float32: share of
    the window's weight that is saturated; ``candidates``: the orders that the working range allows; ``question``: the
    same on a grid, for a `Chooser`. An image without an object has a crop of one pixel that is not ``inside``.
    """

    shape: tuple[int, int]
    crop: Crop
    frames: int
    background: Background
    grey: Image
    inside: NDArray[np.bool_]
    layer: CalibrationLayer
    fit: FringeFit
    phase_rad: Image
    residual_rad: Image
    slopes: tuple[Image, Image]
    uncertainty_rad: Image
    clipped: Image
    candidates: Candidates
    question: Question
    watch: Stopwatch

    @property
    def empty(self) -> bool:
        """Whether there is no object."""
        return not self.inside.any()
