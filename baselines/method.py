"""What a method is: a class that says its name, options, assumptions and training itself. No other
file knows a method by its name; `registry` finds the classes.

A whole method, in a file ``mine.py`` of its own, for ``fpp-bench predict mine.py:Mine data/mini``:

    import numpy as np
    from fpp_ml_bench import Method

    class Mine(Method):
        name, title, frames_used = "mine", "Everything lit is 1.5 m away", (0,)

        def predict(self, frames):
            return np.where(frames[0] > 60, np.float32(1500), np.float32(0))
"""

import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench import __version__
from fpp_ml_bench.depth import RangeRule
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.protocol import Mode, Target, Units
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import AnySequence
from fpp_ml_bench.options import did_you_mean

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from fpp_ml_bench.baselines.training.weights import ModelConfig, NetConfig, TrainingBenchmark
    from fpp_ml_bench.evaluation.submission.description import Submission
    from fpp_ml_bench.loaders.storage.benchmark import Benchmark
    from fpp_ml_bench.loaders.storage.manifest import Manifest

Frames = Sequence[NDArray[np.uint8] | None]
"""A captured sequence by frame number, with None for frames that are not needed."""
FRAMEWORKS = (
    "cv2",
    "jax",
    "onnxruntime",
    "scipy",
    "skimage",
    "sklearn",
    "tensorflow",
    "torch",
    "torchvision",
)
"""Modules whose versions are stated of a method of a file where they are loaded: nobody has to say
so."""
Setting = str | int | float | bool | None
OptionsT = TypeVar("OptionsT", bound="DataclassInstance")


class Photographed(Protocol):
    """What a method can be made for: a dataset, or scenes of a rig that are rendered and not
    stored."""

    @property
    def path(self) -> Path: ...
    @property
    def rig(self) -> Rig: ...
    @property
    def size(self) -> tuple[int, int]: ...
    @property
    def sequence(self) -> AnySequence: ...
    @property
    def manifest(self) -> "Manifest": ...


class Answer(NamedTuple):
    """``depth`` float32 (H, W) in the method's units, 0 = background or not measured; ``sigma_mm``:
    its standard uncertainty, float32 (H, W), 0 where none is stated, None of a method that states
    none; ``report``: plain data."""

    depth: NDArray[np.float32]
    sigma_mm: NDArray[np.float32] | None = None
    report: Mapping[str, Any] = MappingProxyType({})


class Assumption(NamedTuple):
    """What a method assumes of every scene: in a few ``words`` for a table, and as a
    ``sentence``."""

    words: str
    sentence: str


@dataclass(frozen=True)
class NoOptions:
    """Options of a method that has none."""


class Method:
    """A frame stack in, a depth map out. A subclass needs ``name``, ``title``, ``frames_used``, and
    `predict` or `answer`. `answer` is what is scored, timed and measured; where a class does not
    define it, it calls `predict`.

    name: what it is called on the command line and in submissions. purpose: what it does, one line
    of ``--help``.
    Options: a frozen dataclass, whose fields made with `fpp_ml_bench.options.option` are options of
    every command that takes a method. Training: the same for ``fpp-bench train``, None where there
    is nothing to train. trivial: whether it ignores the image (a constant) or only looks up the
    nearest training image: a reference for other errors.
    title: name of the submission, with the settings that matter.
    frames_used: frames that must be captured, ascending. settings: everything needed to run it
    again.
    uses_ground_truth_range: whether it is given depth_min and depth_max of the sample it predicts.
    range_rule: by which range normalised depth is.
    uses_ground_truth_mask: whether it is given frames that are 0 outside the object.
    mode, target: what its row is scored in and against; for a network the decoded depth, which it
    was trained on.
    packages: those whose versions matter, for a class outside this package beside `FRAMEWORKS`.
    parameters: numbers that were learned. weights_config: what its weights file says of the network
    and its training data. learned_from: what data it learned from, as
    `evaluation.submission.LearnedFrom` has it; a class outside this package says so itself, like
    ``learned_from = {"data": "other", "versions": ["my scans"]}``, and without that it is unknown.
    code: hashes of the files of a class outside this package. batched: whether `predict_batch`
    takes all samples at once. reports: whether `answer` reports. caution: a sentence that a user
    should read before it runs.
    """

    name: str
    purpose: ClassVar[str] = ""
    Options: "ClassVar[type[DataclassInstance]]" = NoOptions
    Training: ClassVar[type | None] = None
    trivial: ClassVar[bool] = False

    options: "DataclassInstance"
    title: str
    frames_used: tuple[int, ...]
    settings: Mapping[str, Setting] = MappingProxyType({})

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
    weights_config: "ModelConfig | NetConfig | None" = None
    code: Mapping[str, str] = MappingProxyType({})
    batched: bool = False
    reports: bool = False
    caution: str = ""

    def __init__(self, rig: Rig, **options: object) -> None:
        """For images of ``rig``; ``options`` are the fields of `Options`, and become the settings
        of its submission. `PredictionError` for an option that it does not have."""
        self.rig, self.options = rig, self.checked_options(self.Options, options)
        # A submission states a path as text.
        given = {
            key: str(value) if isinstance(value, Path) else value
            for key, value in asdict(self.options).items()
        }
        self.settings = {**self.settings, **given}

    @classmethod
    def checked_options(cls, make: "type[OptionsT]", given: Mapping[str, object]) -> "OptionsT":
        """The dataclass ``make``, `Options` as a rule, with the values ``given``, by name.
        `PredictionError` for a name that it does not have."""
        known = [entry.name for entry in fields(make)]
        for name in given:
            if name not in known:
                hint = did_you_mean(name, known) if known else "it has none"
                raise PredictionError(f"{cls.name}: has no option {name}; {hint}")
        return make(**given)

    @classmethod
    def for_rig(cls, rig: Rig, **options: object) -> "Method":
        """The method for images of ``rig``. A class that makes another one for some options
        overrides this."""
        return cls(rig, **options)

    @classmethod
    def for_dataset(cls, dataset: "Photographed", **options: object) -> "Method":
        """The method for a dataset. A class that needs more of it than the rig (its training split,
        the light it was built with) overrides this."""
        return cls.for_rig(dataset.rig, **options)

    @classmethod
    def train(cls, training: Any, out: Path, minutes: float | None = None) -> bool:
        """Learn by ``training``, an instance of `Training`, into the folder ``out``; within
        ``minutes``, everything saved, and continued by the next call. Prints what came of it.
        Whether the training has finished."""
        raise PredictionError(f"{cls.name}: there is nothing to train")

    @classmethod
    def variants(cls, rig: Rig) -> Sequence[Mapping[str, Setting]]:
        """The options with which ``fpp-bench tradeoff`` measures it on ``rig``; none for a rig that
        it can't be for."""
        return [{}]

    @classmethod
    def scenes_rig(cls, settings: Mapping[str, Setting]) -> str:
        """Which of `NAMED_RIGS` photographs the scenes that are rendered for it, as of ``fpp-bench
        robustness``, with these ``settings`` (an option that is not given may be missing)."""
        return "paper"

    @classmethod
    def short_name(cls, submission: "Submission") -> str | None:
        """A short name for tables, made of the settings of a submission of this method; None for
        one that it did not write. May raise KeyError, TypeError or ValueError for such settings."""
        return None

    @classmethod
    def assumption(cls, settings: Mapping[str, Setting]) -> Assumption | None:
        """What it assumes of every scene with these settings; None where it assumes nothing."""
        return None

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        """Depth float32 (H, W) in `units`, 0 = background or not measured; frames not in
        `frames_used` may be None."""
        return self.answer(frames).depth

    def predict_batch(
        self, stacks: Sequence[Frames]
    ) -> Sequence[NDArray[np.float32]] | NDArray[np.float32]:
        """The depth of several samples, one after another unless `batched`."""
        return [self.answer(frames).depth for frames in stacks]

    def answer(self, frames: Frames) -> Answer:
        """The depth, and what else the method says of the sample."""
        return Answer(self.predict(frames))

    def crop(self, frames: Frames) -> tuple[slice, slice] | None:
        """Rows and columns outside which nothing is computed; None for a method that computes
        everywhere."""
        return None

    def summary(self, reports: Sequence[Mapping[str, Any]]) -> dict[str, float]:
        """Summary of a split's reports, for the settings of the submission."""
        return {}

    @cached_property  # which a class or an instance can set
    def learned_from(self) -> dict[str, Any] | None:
        """What data the method learned from; None where that is unknown."""
        if (config := self.weights_config) is not None:
            return training_split_of(config.benchmark, config.dataset_fingerprint)
        return {"data": "none"} if is_built_in(type(self)) else None

    @property
    def settings_of_depth(self) -> dict[str, Setting]:
        """The settings without those of the machine, which change its time and not its depth."""
        return {
            key: value for key, value in self.settings.items() if key not in ("threads", "device")
        }

    @property
    def weights_sha256(self) -> str | None:
        """Hash of the weights file, of a method that has one."""
        sha256 = self.settings.get("weights_sha256")
        return sha256 if isinstance(sha256, str) else None

    @property
    def software(self) -> dict[str, str]:
        """Versions of this package, Python and the packages that the method computes with."""
        versions = {package: version(package) for package in self.packages}
        if not is_built_in(type(self)):
            versions |= {
                name: str(getattr(sys.modules[name], "__version__", "unknown"))
                for name in FRAMEWORKS
                if name in sys.modules
            }
        return {"fpp_ml_bench": __version__, "python": platform.python_version(), **versions}


def checked(answer: Answer, size: tuple[int, int], where: object) -> Answer:
    """``answer`` if its maps are finite float32 of ``size`` (H, W), no sigma below 0, as
    `Method.answer` must give them; else `PredictionError`, which begins with ``where``."""
    if not isinstance(answer, Answer):
        raise PredictionError(
            f"{where}: answer gave {type(answer).__name__}, expected Answer(depth)"
        )
    for values in (answer.depth, *([] if answer.sigma_mm is None else [answer.sigma_mm])):
        actual = f"{getattr(values, 'dtype', type(values).__name__)} {np.shape(values)}"
        if actual != (expected := f"float32 {size}"):
            raise PredictionError(f"{where}: the method gave {actual}, expected {expected}")
        if not np.isfinite(values).all():
            raise PredictionError(
                f"{where}: the method gave values that are not finite: a fault of the method"
            )
    if answer.sigma_mm is not None and (answer.sigma_mm < 0).any():
        raise PredictionError(f"{where}: the method gave a sigma below 0: a fault of the method")
    return answer


def training_split_of(
    benchmark: "Benchmark | TrainingBenchmark | None", fingerprint: str
) -> dict[str, Any]:
    """`Method.learned_from` of a method that learned from the training split of a dataset, a
    ``benchmark`` or not."""
    title = f"dataset {fingerprint[:8]}" if benchmark is None else benchmark.title
    return {"data": "train-split", "versions": [title]}


def is_built_in(part: Callable[..., Any]) -> bool:
    """Whether a class of methods, or a function of one, comes with this package."""
    return part.__module__.startswith(f"{__package__}.")
