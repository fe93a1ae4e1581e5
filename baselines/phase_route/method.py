"""The phase route as a method of ``fpp-bench predict``: one captured fringe or a few, metric depth, nothing learned."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route.observation import Measurement, Settings
from fpp_ml_bench.baselines.phase_route.route import PhaseRoute
from fpp_ml_bench.errors import DecodeError, PredictionError
from fpp_ml_bench.optics import Rig


class PhaseMethod:
    """Depth from one or more sinusoids of one direction; options are those of `Settings`.

    Raises `PredictionError` for an unknown option or an invalid value.
    """

    name = "phase"
    uses_ground_truth_range = False
    units = "mm"

    def __init__(self, rig: Rig, **options: Any) -> None:
        try:
            settings = Settings(**options)
        except TypeError as error:
            raise PredictionError(f"phase: {error}; there are {', '.join(Settings.__dataclass_fields__)}") from None
        self.rig, self.options, self.route = rig, settings, PhaseRoute(rig, settings)

    @property
    def frames_used(self) -> tuple[int, ...]:
        """The frames that must be captured."""
        sinusoids = self.rig.sequence.sinusoids(self.options.direction)
        return tuple(sinusoids[step] for step in self.route.steps)

    @property
    def title(self) -> str:
        cues = ["range"] + ["shading"] * self.options.shading + ["standoff"] * (self.options.prior == "standoff")
        frames = len(self.frames_used)
        count = f"one {self.options.direction} fringe" if frames == 1 else f"{frames} {self.options.direction} fringes"
        return f"Phase route, {count}, order by {' + '.join(cues)}, nothing learned"

    @property
    def settings(self) -> dict[str, Any]:
        return asdict(self.options)

    def measure(self, frames: Sequence[NDArray[np.uint8] | None]) -> Measurement:
        """All maps of a captured sequence; frames that are not in `frames_used` may be None."""
        images = []
        for index in self.frames_used:
            image = frames[index] if index < len(frames) else None
            if image is None:
                needed = "that fringe" if len(self.frames_used) == 1 else f"frames {self.frames_used}"
                raise DecodeError(f"frame {index} is missing: the phase route needs {needed}")
            images.append(image)
        return self.route.measure(images)

    def predict(self, frames: Sequence[NDArray[np.uint8] | None]) -> NDArray[np.float32]:
        """Depth float32 (H, W) in mm, 0 = background, or masked where ``min_confidence`` is above 0."""
        return self.measure(frames).depth_mm
