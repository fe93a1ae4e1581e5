"""What a method is, the methods that ``fpp-bench predict`` knows by name, and loading any of them."""

import platform
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench import __version__, baselines
from fpp_ml_bench.baselines import (
    classical_network,
    crossed_network,
    crossed_route,
    networks,
    phase_network,
    phase_route,
    training,
)
from fpp_ml_bench.coding import PhaseShift
from fpp_ml_bench.depth import RangeRule
from fpp_ml_bench.errors import PredictionError, WeightsError
from fpp_ml_bench.evaluation.protocol import Mode, Target, Units
from fpp_ml_bench.optics import Rig

Frames = Sequence[NDArray[np.uint8] | None]
"""A captured sequence by frame number, with None for frames that are not needed."""
Setting = str | int | float | bool | None


class Answer(NamedTuple):
    """``depth`` float32 (H, W) in the method's units, 0 = background or not measured; ``sigma_mm``: its standard
    uncertainty, float32 (H, W), 0 where none is stated, None of a method that states none; ``report``: plain data."""

    depth: NDArray[np.float32]
    sigma_mm: NDArray[np.float32] | None = None
    report: Mapping[str, Any] = MappingProxyType({})


class Method(ABC):
    """A frame stack in, a depth map out.

    name: what it is called on the command line. title: name of the submission, with the settings that matter.
    frames_used: frames that must be captured, ascending. settings: everything needed to run it again.
    uses_ground_truth_range: whether it is given depth_min and depth_max of the sample it predicts.
    range_rule: by which range normalised depth is.
    uses_ground_truth_mask: whether it is given frames that are 0 outside the object.
    mode, target: what its row is scored in and against; for a network the decoded depth, which it was trained on.
    packages: those whose versions matter. parameters: numbers that were learned. weights_config: what its weights file
    says of the network and its training data. batched: whether `predict_batch` takes all samples at once. reports:
    whether `answer` reports.
    """

    name: str
    title: str
    frames_used: tuple[int, ...]
    settings: Mapping[str, Setting]

    uses_ground_truth_range: bool = False
    uses_ground_truth_mask: bool = False
    units: Units = "mm"
    range_rule: RangeRule = "object"
    mode: Mode = "standard"
    target: Target = "depth_exact"
    packages: tuple[str, ...] = ("numpy", "numba")
    seeds: Mapping[str, int] = MappingProxyType({})
    device: str = "cpu"
    parameters: int = 0
    weights_config: "training.ModelConfig | training.NetConfig | None" = None
    batched: bool = False
    reports: bool = False

    @abstractmethod
    def predict(self, frames: Frames) -> NDArray[np.float32]:
        """Depth float32 (H, W) in `units`, 0 = background or not measured; frames not in `frames_used` may be None."""

    def predict_batch(self, stacks: Sequence[Frames]) -> Sequence[NDArray[np.float32]] | NDArray[np.float32]:
        """`predict` of several samples, one after another unless `batched`."""
        return [self.predict(frames) for frames in stacks]

    def answer(self, frames: Frames) -> Answer:
        """`predict`, and what else the method says of the sample."""
        return Answer(self.predict(frames))

    def crop(self, frames: Frames) -> tuple[slice, slice] | None:
        """Rows and columns outside which nothing is computed; None for a method that computes everywhere."""
        return None

    def summary(self, reports: Sequence[Mapping[str, Any]]) -> dict[str, float]:
        """Summary of a split's reports, for the settings of the submission."""
        return {}

    @property
    def learned_from(self) -> dict[str, Any]:
        """What data the method learned from, as `evaluation.submission.LearnedFrom` has it."""
        if (config := self.weights_config) is None:
            return {"data": "none"}
        benchmark = training.trained_on(config)
        title = f"dataset {config.dataset_fingerprint[:8]}" if benchmark is None else benchmark.title
        return {"data": "train-split", "versions": [title]}

    @property
    def software(self) -> dict[str, str]:
        """Versions of this package, Python and the packages that the method computes with."""
        versions = {package: version(package) for package in self.packages}
        return {"fpp_ml_bench": __version__, "python": platform.python_version(), **versions}


METHODS: Mapping[str, Callable[..., Method]] = {
    "classical": lambda rig, **options: baselines.ClassicalMethod(rig, **options),
    "classical-net": lambda rig, **options: classical_network.ClassicalNetMethod(rig, **options),
    "phase": lambda rig, **options: (phase_route.FewestFrames if "error_mm" in options else phase_route.PhaseMethod)(
        rig, **_fringe_options("phase", rig, options)
    ),
    "phase-net": lambda rig, **options: phase_network.PhaseNetMethod(rig, **_fringe_options("phase-net", rig, options)),
    "crossed": lambda rig, **options: crossed_route.CrossedMethod(rig, **options),
    "crossed-net": lambda rig, **options: crossed_network.CrossedNetMethod(rig, **options),
    "constant": lambda rig, **options: baselines.ConstantMethod(rig, **options),
    "nearest": lambda rig, **options: baselines.NearestMethod(rig, **options),
}
"""The methods by name, each made from a rig and its options; with the weights of a network from image to depth it is a
`NetworkMethod`."""


def _fringe_options(name: str, rig: Rig, options: dict[str, Any]) -> dict[str, Any]:
    """``options`` of a method that computes with the fringes of one direction, which is the rig's only one by default.
    Raises `PredictionError` for fringes that it would take for others."""
    ways = rig.fringe_directions
    if len(ways) == 1:
        options = {"direction": ways[0], **options}
    direction = options.get("direction", "horizontal")
    if direction not in ways or not isinstance(code := rig.code(direction), PhaseShift):
        return options  # refused by the method
    shifts = code.fringes[code.finest].shifts_deg
    if code.origin_px != 0 or shifts[0] != 0:
        raise PredictionError(
            f"{name}: needs fringes with a crest on pixel 0 of the projector, and in this rig the first {direction} "
            f"frame is shifted (origin_px {code.origin_px:g}, {shifts[0]:g} degrees); use classical"
        )
    if "error_mm" in options and not code.is_plain:
        raise PredictionError(
            f"{name}: error_mm needs fringes of one period with Gray code in half periods, and this rig has "
            f"{code.title}; say how many frames instead"
        )
    return options


def load_method(name_or_path: str | Path, rig: Rig, **options: Any) -> Method:
    """A method for images of ``rig``: one of `METHODS`, or the trained network of weights that come with the package
    or of a ``.safetensors`` file.

    ``options`` are those of the method's class; a network also takes ``device`` (``cpu``, ``cuda``, ...).
    >>> from fpp_ml_bench.baselines import load_method
    >>> depth_mm = load_method("phase", dataset.rig).predict(frames)    # doctest: +SKIP

    Raises `PredictionError` for an unknown name, and what the method refuses: unusable weights, invalid options.
    """
    try:
        if name_or_path in METHODS:
            return METHODS[str(name_or_path)](rig, **options)
        model = networks.load(known_weights(name_or_path), options.pop("device", None))
        return networks.NetworkMethod(model, sequence=rig.sequence, **options)
    except TypeError as error:
        if "unexpected keyword argument" not in str(error):
            raise
        option = str(error).rsplit(" ", 1)[-1]
        raise PredictionError(f"{name_or_path}: has no option {option}; fpp-bench predict --help lists them") from None


def known_weights(name_or_path: str | Path) -> Path:
    """Path of the weights file that ``name_or_path`` means. `PredictionError` for an unknown name lists the known."""
    try:
        return training.weights_path(name_or_path)
    except WeightsError:
        raise PredictionError(
            f"unknown method {str(name_or_path)!r}; there are {', '.join((*METHODS, *training.shipped_names()))}, and "
            "every .safetensors file of trained weights"
        ) from None
