"""A predictor that looks at nothing: what a method's error is worth is how far it is from this one's."""

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import Frames, Method
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.optics import Rig

TRIVIAL = "constant", "nearest"
"""The methods of this module by name: what a method's error is worth is how far it is from theirs."""
STANDOFF, MIDDLE, TRAINING_MEAN = "standoff", "middle", "training-mean"
TRAINING_MEAN_MM = 1743.75
"""Mean exact depth over the object pixels of the training split of ``fpp-bench-full`` version 1."""


class ConstantMethod(Method):
    """One depth at every pixel: ``at`` the rig's standoff, the middle of its working range, the mean of the benchmark's
    training split, or so many mm. Raises PredictionError for anything else."""

    name = "constant"
    packages = ("numpy",)

    def __init__(self, rig: Rig, at: str | float = STANDOFF) -> None:
        known = {
            STANDOFF: rig.standoff_m * MM_PER_M, MIDDLE: sum(rig.working_range_mm) / 2, TRAINING_MEAN: TRAINING_MEAN_MM,
        }  # fmt: skip
        try:
            self.depth_mm = float(known.get(at, at) if isinstance(at, str) else at)
        except ValueError:
            self.depth_mm = -1.0
        if not 0 < self.depth_mm < 1e6:
            raise PredictionError(f"at {at!r}: expected {', '.join(known)}, or a depth in mm above 0")
        self.shape = rig.camera.height, rig.camera.width
        self.frames_used = rig.sequence.config("single_shot")
        self.title = f"Constant depth, {at} mm" if at not in known else f"Constant depth: {at}"
        self.settings = {"at": at, "depth_mm": self.depth_mm}

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        return np.full(self.shape, self.depth_mm, dtype=np.float32)
