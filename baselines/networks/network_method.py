"""A trained network as a method of the benchmark: of the metric track, or told the sample's depth range (oracle)."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import Frames, Method, Setting
from fpp_ml_bench.baselines.networks.base import torch_threads
from fpp_ml_bench.baselines.networks.model import Model
from fpp_ml_bench.baselines.training import Loss
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.optics import PAPER_SEQUENCE, AnySequence

DepthRange = Literal["oracle", "predicted", "mean"]
DEPTH_RANGES: tuple[DepthRange, ...] = get_args(DepthRange)


class NetworkMethod(Method):
    """A `Model` that takes one frame of the sequence.

    Under raw and global normalisation a network puts out mm, and ``depth_range`` must be None. Under individual
    normalisation it is ``oracle`` (values go out normalised, and the scoring takes the range of the very sample), or
    ``predicted`` or ``mean`` (the range heads of the weights file make mm). None takes ``predicted`` where the file
    holds heads, else ``oracle``. ``frame``: its index, by default the first of those that the network was trained on.
    ``threads`` are torch's while it predicts. ``remark`` is added to the title, ``about`` to the settings. Raises
    `PredictionError` for an unknown range or frame."""

    target = "depth"
    packages = ("numpy", "torch", "safetensors")
    batched = True

    def __init__(
        self,
        model: Model,
        depth_range: DepthRange | None = None,
        frame: int | None = None,
        threads: int = 1,
        sequence: AnySequence = PAPER_SEQUENCE,
        remark: str = "",
        about: Mapping[str, Setting] | None = None,
    ) -> None:
        config = self.weights_config = model.config
        self.model, self.threads = model, threads
        self.name, self.device, self.parameters = config.name, str(model.device), model.parameters
        self.depth_range = _checked_range(model, depth_range)
        trained_frames = sequence.config(config.data_config)
        if not trained_frames:
            raise PredictionError(
                f"{config.name}: was trained on {config.data_config} fringes, and this rig projects "
                f"{' and '.join(sequence.directions)} ones only; use weights that were trained on its fringes"
            )
        usual_frame = trained_frames[0]
        self.frame = usual_frame if frame is None else frame
        if not 0 <= self.frame < len(sequence):
            raise PredictionError(f"frame {frame}: expected 0 to {len(sequence) - 1}, the frames of the sequence")
        if threads < 1:
            raise PredictionError(f"threads {threads}: expected 1 or more")
        self.frames_used = (self.frame,)
        self.uses_ground_truth_mask = config.background_removed
        if self.depth_range == "oracle":
            self.uses_ground_truth_range, self.units, self.mode = True, "normalised", "paper"
            self.range_rule = config.range_rule
        of_range = "" if self.depth_range is None else f"{self.depth_range} range"
        parts = [config.title, of_range, "" if self.frame == usual_frame else f"frame {self.frame}"]
        self.title = ", ".join(part for part in parts if part) + (f" ({remark})" if remark else "")
        seed = config.recipe.get("seed")
        if isinstance(seed, int):
            self.seeds = {"training": seed}
        entries: dict[str, Setting] = {
            "weights_sha256": model.sha256,
            "network": config.network,
            "width": config.options.get("width"),
            "normalisation": config.normalisation,
            "loss": _loss(config.recipe.get("loss")),
            "preset": config.recipe.get("preset"),
            "trained_frames": config.data_config,
            "background_removed": config.background_removed,
            "seed": seed,
            "epochs": config.epoch,
            "frame": self.frame,
            "depth_range": self.depth_range,
            "threads": threads,
            "device": self.device,
        }
        self.settings = {key: value for key, value in entries.items() if value is not None} | dict(about or {})

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        """Depth float32 (H, W) in `units`; frames other than `frames_used` may be None."""
        return self.predict_batch([frames])[0]

    def predict_batch(self, stacks: Sequence[Frames]) -> NDArray[np.float32]:
        """`predict` of several samples at once: float32 (B, H, W) in `units`."""
        fringes = [frame for frame in (stack[self.frame] for stack in stacks) if frame is not None]
        if len(fringes) != len(stacks):
            raise PredictionError(
                f"{self.name} needs frame {self.frame}, which was not captured; build with --frames all"
            )
        with torch_threads(self.threads):
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
