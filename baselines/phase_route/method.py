"""The phase route as a method of ``fpp-bench predict``: one captured fringe or a few, metric depth, nothing learned."""

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import Frames, Method
from fpp_ml_bench.baselines.phase_route.observation import Measurement, Settings
from fpp_ml_bench.baselines.phase_route.route import PhaseRoute
from fpp_ml_bench.errors import DecodeError, PredictionError
from fpp_ml_bench.optics import Rig


class PhaseMethod(Method):
    """Depth from one or more sinusoids of one direction; options are those of `Settings`.

    Raises `PredictionError` for an unknown option or an invalid value.
    """

    name = "phase"
    crops = True

    def __init__(self, rig: Rig, **options: Any) -> None:
        try:
            settings = Settings(**options)
        except TypeError as error:
            raise PredictionError(f"phase: {error}; there are {', '.join(Settings.__dataclass_fields__)}") from None
        self.rig, self.options, self.route = rig, settings, PhaseRoute(rig, settings)
        sinusoids = rig.sequence.sinusoids(settings.direction)
        self.frames_used = tuple(sinusoids[step] for step in self.route.steps)
        frames = len(self.frames_used)
        count = f"one {settings.direction} fringe" if frames == 1 else f"{frames} {settings.direction} fringes"
        cues = ["range"] + ["shading"] * settings.shading + ["standoff"] * (settings.prior == "standoff")
        self.title = f"Phase route, {count}, order by {' + '.join(cues)}, nothing learned"
        self.settings = asdict(settings)

    def measure(self, frames: Frames) -> Measurement:
        """All maps of a captured sequence; frames that are not in `frames_used` may be None."""
        return self.route.measure(self._images(frames))

    def crop(self, frames: Frames) -> tuple[slice, slice]:
        images = self._images(frames)
        return self.route.observe(images if len(images) > 1 else images[0]).crop

    def _images(self, frames: Frames) -> list[NDArray[np.uint8]]:
        images = []
        for index in self.frames_used:
            image = frames[index] if index < len(frames) else None
            if image is None:
                needed = "that fringe" if len(self.frames_used) == 1 else f"frames {self.frames_used}"
                raise DecodeError(f"frame {index} is missing: the phase route needs {needed}")
            images.append(image)
        return images

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        """Depth float32 (H, W) in mm, 0 = background, or masked where ``min_confidence`` is above 0."""
        return self.measure(frames).depth_mm
