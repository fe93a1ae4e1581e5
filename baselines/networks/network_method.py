"""A trained network as a method of the benchmark: of the metric track, or told the sample's depth range (oracle)."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from fpp_ml_bench.baselines.networks.model import Model
from fpp_ml_bench.baselines.training import Loss, ModelConfig
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.protocol import Mode, Units
from fpp_ml_bench.optics import PAPER_SEQUENCE
from fpp_ml_bench.optics import Sequence as FrameSequence

DepthRange = Literal["oracle", "predicted", "mean"]
Setting = str | int | float | bool | None
DEPTH_RANGES: tuple[DepthRange, ...] = get_args(DepthRange)
_TITLES = {"oracle": "oracle range", "predicted": "predicted range", "mean": "mean range", None: ""}


class NetworkMethod:
    """A `Model` that takes one frame of the sequence.

    Under raw and global normalisation a network puts out mm, and ``depth_range`` must be None. Under individual
    normalisation it is ``oracle`` (values go out normalised, and the scoring takes the range of the very sample),
    or ``predicted`` or ``mean`` (the range heads of the weights file make mm). None takes ``predicted`` where the file
    holds heads, else ``oracle``.

    ``frame`` is the index of the frame, by default the first of those that the network was trained on. ``threads``
    are torch's, for the whole process. ``remark`` is added to the title, ``about`` to the settings. A network
    trained with the background removed needs frames that are 0 outside the object (``uses_ground_truth_mask``):
    `fpp_ml_bench.baselines.run.captured_frames` sees to that.
    Raises `PredictionError` for an unknown range or frame.
    """

    packages = ("numpy", "torch", "safetensors")

    def __init__(
        self, model: Model, depth_range: DepthRange | None = None, frame: int | None = None, threads: int = 1,
        sequence: FrameSequence = PAPER_SEQUENCE, remark: str = "", about: Mapping[str, Setting] | None = None,
    ) -> None:  # fmt: skip
        self.model, self.remark, self.about = model, remark, dict(about or {})
        self.depth_range = _checked_range(model, depth_range)
        trained_on = sequence.config(model.config.data_config)
        self.frame = trained_on[0] if frame is None else frame
        if not 0 <= self.frame < len(sequence):
            raise PredictionError(f"frame {frame}: expected 0 to {len(sequence) - 1}, the frames of the sequence")
        if threads < 1:
            raise PredictionError(f"threads {threads}: expected 1 or more")
        self.threads = threads
        self._usual_frame = self.frame == trained_on[0]
        torch.set_num_threads(threads)

    @property
    def name(self) -> str:
        return self.model.config.name

    @property
    def title(self) -> str:
        parts = [self.model.config.title, _TITLES[self.depth_range], "" if self._usual_frame else f"frame {self.frame}"]
        return ", ".join(part for part in parts if part) + (f" ({self.remark})" if self.remark else "")

    @property
    def units(self) -> Units:
        return "normalised" if self.depth_range == "oracle" else "mm"

    @property
    def mode(self) -> Mode:
        """The scoring mode that its row is made with."""
        return "paper-individual" if self.depth_range == "oracle" else "standard"

    target = "depth"
    """What its row is scored against: the decoded depth, which is what it was trained on."""

    @property
    def frames_used(self) -> tuple[int, ...]:
        return (self.frame,)

    @property
    def uses_ground_truth_range(self) -> bool:
        return self.depth_range == "oracle"

    @property
    def uses_ground_truth_mask(self) -> bool:
        return self.model.config.background_removed

    @property
    def device(self) -> str:
        return str(self.model.device)

    @property
    def parameters(self) -> int:
        return self.model.parameters

    @property
    def settings(self) -> Mapping[str, Setting]:
        config = self.model.config
        entries: dict[str, Setting] = {
            "weights_sha256": self.model.sha256,
            "network": config.network,
            "width": config.options.get("width"),
            "normalisation": config.normalisation,
            "loss": _loss(config.recipe.get("loss")),
            "preset": config.recipe.get("preset"),
            "trained_frames": config.data_config,
            "background_removed": config.background_removed,
            "seed": config.recipe.get("seed"),
            "epochs": config.epoch,
            "frame": self.frame,
            "depth_range": self.depth_range,
            "threads": self.threads,
            "device": self.device,
        }
        return {key: value for key, value in entries.items() if value is not None} | self.about

    @property
    def weights_config(self) -> ModelConfig:
        """What the weights file says of the network and its training data."""
        return self.model.config

    @property
    def seeds(self) -> Mapping[str, int]:
        seed = self.model.config.recipe.get("seed")
        return {"training": seed} if isinstance(seed, int) else {}

    def predict(self, frames: Sequence[NDArray[np.uint8] | None]) -> NDArray[np.float32]:
        """Depth float32 (H, W) in `units`; frames other than `frames_used` may be None."""
        return self.predict_batch([frames])[0]

    def predict_batch(self, stacks: Sequence[Sequence[NDArray[np.uint8] | None]]) -> NDArray[np.float32]:
        """`predict` of several samples at once: float32 (B, H, W) in `units`."""
        fringes = [frame for frame in (stack[self.frame] for stack in stacks) if frame is not None]
        if len(fringes) != len(stacks):
            raise PredictionError(
                f"{self.name} needs frame {self.frame}, which was not captured; build with --frames all"
            )
        if self.depth_range == "oracle":
            return self.model.predict_representation(fringes)
        return self.model.predict_batch(fringes, self.depth_range or "predicted")


def _checked_range(model: Model, depth_range: str | None) -> Any:
    """The depth range in force, one of `DEPTH_RANGES` or None."""
    name = model.config.name
    if model.config.normalisation != "individual":
        if depth_range is not None:
            raise PredictionError(
                f"{name} was trained under {model.config.normalisation} normalisation and puts out mm on its own; "
                f"leave out the depth range {depth_range!r}"
            )
        return None
    if depth_range is None:
        return "oracle" if model.heads is None else "predicted"
    if depth_range not in DEPTH_RANGES:
        raise PredictionError(f"unknown depth range {depth_range!r}; there are {', '.join(DEPTH_RANGES)}")
    if depth_range != "oracle" and model.heads is None:
        raise PredictionError(
            f"{name}: this weights file holds no range heads, so its depth range can only be oracle; fit them with "
            "fpp_ml_bench.baselines.networks.range_heads.fit_heads"
        )
    return depth_range


def _loss(loss: Any) -> str | None:
    """The recipe's loss as in the names of runs: ``hybrid_l1_0.7``."""
    return Loss.model_validate(loss).label if isinstance(loss, dict) else loss
