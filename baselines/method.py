"""The methods that ``fpp-bench predict`` knows, by name, and what each of them must offer."""

import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench import __version__
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.optics import Rig


class Method(Protocol):
    """A frame stack in, a depth map out.

    A method may also have: ``units`` of what it predicts (default ``mm``), ``uses_ground_truth_mask`` (it is given
    frames that are 0 outside the object; default no), ``seeds``, ``packages`` whose versions matter (default numpy and
    numba), ``predict_reported`` and ``summary`` (a report of every sample, see `fpp_ml_bench.baselines.run`),
    ``predict_batch``, ``device`` and ``parameters`` (see `fpp_ml_bench.baselines.timing`), ``weights_config`` (see
    `fpp_ml_bench.baselines.training.provenance_of_data`), and ``mode`` and ``target``, how its row is scored.
    """

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


METHODS = ("classical", "phase", "phase-net")
"""The methods by name; with the weights of a network from image to depth it is a `NetworkMethod`."""


def method(name: str, rig: Rig, **options: Any) -> Method:
    """Method ``name`` for a rig; raises `FppBenchError` for an unknown one."""
    if name == "classical":
        from fpp_ml_bench.baselines.classical import ClassicalMethod

        return ClassicalMethod(rig, **options)
    if name == "phase" and "error_mm" in options:
        from fpp_ml_bench.baselines.phase_route import FewestFrames

        fewest_frames: Method = FewestFrames(rig, **options)
        return fewest_frames
    if name == "phase":
        from fpp_ml_bench.baselines.phase_route import PhaseMethod

        phase_route: Method = PhaseMethod(rig, **options)
        return phase_route
    if name == "phase-net":
        from fpp_ml_bench.baselines.phase_network import PhaseNetMethod

        phase_net: Method = PhaseNetMethod(rig, **options)
        return phase_net
    raise FppBenchError(f"unknown method {name!r}; there are {', '.join(METHODS)}")


def software_of(method: Method) -> dict[str, str]:
    """Versions of this package, Python and the packages that ``method`` computes with."""
    packages: tuple[str, ...] = getattr(method, "packages", ("numpy", "numba"))
    versions = {package: version(package) for package in packages}
    return {"fpp_ml_bench": __version__, "python": platform.python_version(), **versions}
