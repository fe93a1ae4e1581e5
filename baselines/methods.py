"""The methods that ``fpp-bench predict`` knows, by name, and what each of them must offer."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.rig import Rig


class Method(Protocol):
    """One frame stack in, one depth map out."""

    @property
    def name(self) -> str:
        """What the method is called on the command line."""

    @property
    def title(self) -> str:
        """Name of the submission, with the settings that matter."""

    @property
    def frames_used(self) -> tuple[int, ...]:
        """Frames that must be captured, ascending."""

    @property
    def uses_ground_truth_range(self) -> bool:
        """Whether the method is given depth_min and depth_max of the sample it predicts."""

    @property
    def settings(self) -> Mapping[str, str | int | float | bool | None]:
        """Everything needed to run it again."""

    def predict(self, frames: Sequence[NDArray[np.uint8] | None]) -> NDArray[np.float32]:
        """Depth float32 (H, W) in mm, 0 = background or not measured; frames not in `frames_used` are None."""


METHODS = ("classical",)


def method(name: str, rig: Rig, **options: Any) -> Method:
    """Method ``name`` for a rig; raises `FppBenchError` for an unknown one."""
    if name == "classical":
        from fpp_ml_bench.baselines.classical import ClassicalMethod

        return ClassicalMethod(rig, **options)
    raise FppBenchError(f"unknown method {name!r}; there are {', '.join(METHODS)}")
