"""A trained network as a method of the benchmark: of the metric track, or given the sample's depth
range (oracle)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import Frames, Method, Photographed, Setting
from fpp_ml_bench.baselines.training.recipe import NETWORK_TITLES, PRESETS, SEED, Loss, load_recipe
from fpp_ml_bench.constants import CONFIGS
from fpp_ml_bench.errors import PredictionError, RecipeError, WeightsError
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import PAPER_SEQUENCE, AnySequence
from fpp_ml_bench.options import option

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.networks.model import Model
    from fpp_ml_bench.evaluation.submission.description import Submission

_SHORT_OPTIONS = {
    "input standardised": "standardised",
    "guided by phase": "guided",
}
"""A recipe's title and the short name of each option of a network."""
_SHORT_LOSSES = {
    "rmse": "RMSE",
    "l1": "L1",
    "gan": "GAN",
    "hybrid": "hybrid",
    "masked": "masked",
    "physics": "+ physics",
}


@dataclass(frozen=True)
class NetworkOptions:
    """Options of `NetworkMethod`; the name of the method gives ``weights``, a file, or the
    ``recipe`` that trained them."""

    frame: int | None = option(None, "frame to take (default: the first it was trained on)", "N")
    device: str | None = option(
        None, "cpu, cuda, cuda:1 (default: cuda where there is one)", "NAME"
    )
    threads: int = 1
    weights: Path | None = None
    recipe: str | None = None


def _weights(given: NetworkOptions, size: int) -> Path:
    """The weights file of the options, for images of ``size`` px. Raises `WeightsError` where they
    name none."""
    if given.recipe is not None:
        return weights_of_recipe(given.recipe, size)
    if given.weights is None:
        raise WeightsError("no weights: expected a weights file, or the recipe that trained it")
    return given.weights


class NetworkMethod(Method):
    """A `Model` that takes one frame of the sequence.

    Under raw and global normalisation a network puts out mm. Under individual normalisation values
    go out normalised, and the scoring takes the depth range of the very sample (oracle). ``frame``:
    its index, by default the first of those that the network was trained on. ``threads`` are
    torch's while it predicts. ``remark`` is added to the title, ``about`` to the settings. Raises
    `PredictionError` for a frame or a number of threads that can't be."""

    name = "network"  # a trained one has the name of its weights
    purpose = "trained network from image to depth"
    Options = NetworkOptions
    target = "depth"
    packages = ("numpy", "torch", "safetensors")
    batched = True

    @classmethod
    def for_rig(cls, rig: Rig, **options: object) -> "NetworkMethod":
        """The network of a weights file, for frames in the order of ``rig``."""
        from fpp_ml_bench.baselines.networks.model import load

        given = cls.checked_options(NetworkOptions, options)
        return cls(
            load(_weights(given, rig.camera.width), given.device),
            given.frame,
            given.threads,
            rig.sequence,
        )

    @classmethod
    def for_dataset(cls, dataset: Photographed, **options: object) -> Method:
        """`for_rig`. Raises `WeightsError` for a network that was trained at another image size."""
        given = cls.checked_options(NetworkOptions, options)
        weights = _weights(given, dataset.size[1])
        method = cls.for_rig(dataset.rig, **{**options, "recipe": None, "weights": weights})
        if method.model.config.image_size != dataset.size:
            trained_at, here = (
                f"{height}x{width}"
                for height, width in (method.model.config.image_size, dataset.size)
            )
            raise WeightsError(
                f"{weights}: was trained at {trained_at} px (H x W), {dataset.path} has "
                f"images of {here} "
                "px: the fringe period in px depends on the size, so a network works at one size "
                "only; use weights "
                "trained at that size, or a dataset built at the weights' size"
            )
        return method

    @classmethod
    def short_name(cls, submission: "Submission") -> str | None:
        settings = submission.settings
        network = NETWORK_TITLES[str(settings["network"])]
        if not submission.name.startswith(f"{network}, "):
            return None
        normalisation = {"individual": "", "raw": " raw", "global": " global"}[
            str(settings["normalisation"])
        ]
        trained_frames = str(settings["trained_frames"])
        if trained_frames not in CONFIGS:
            return None
        frames = {"single_shot": "", "all": " all frames"}.get(trained_frames, f" {trained_frames}")
        # The other words of a loss are its weights.
        loss = " ".join(
            _SHORT_LOSSES.get(word) or f"{float(word):g}"
            for word in str(settings["loss"]).split("_")
        )
        seed = "" if settings.get("seed") in (None, SEED) else f" s{settings['seed']}"
        parts = [f"{network}{normalisation} {loss}{frames}{seed}"]
        parts += [word for words, word in _SHORT_OPTIONS.items() if f", {words}" in submission.name]
        parts.append("no background" if settings["background_removed"] else "")
        return ", ".join(filter(None, parts))

    def __init__(
        self,
        model: "Model",
        frame: int | None = None,
        threads: int = 1,
        sequence: AnySequence = PAPER_SEQUENCE,
        remark: str = "",
        about: Mapping[str, Setting] | None = None,
    ) -> None:
        config = self.weights_config = model.config
        self.model, self.threads = model, threads
        self.name, self.device, self.parameters = config.name, str(model.device), model.parameters
        trained_frames = sequence.config(config.data_config)
        if not trained_frames:
            raise PredictionError(
                f"{config.name}: was trained on {config.data_config} fringes, and this rig "
                f"projects "
                f"{' and '.join(sequence.directions)} ones only; use weights that were trained on "
                f"its fringes"
            )
        usual_frame = trained_frames[0]
        self.frame = usual_frame if frame is None else frame
        if not 0 <= self.frame < len(sequence):
            raise PredictionError(
                f"frame {frame}: expected 0 to {len(sequence) - 1}, the frames of the sequence"
            )
        if threads < 1:
            raise PredictionError(f"threads {threads}: expected 1 or more")
        self.frames_used = (self.frame,)
        self.uses_ground_truth_mask = config.background_removed
        given_range = config.normalisation == "individual"
        if given_range:
            self.uses_ground_truth_range, self.units, self.mode = True, "normalised", "paper"
            self.range_rule = config.range_rule
        parts = [config.title, "oracle range" if given_range else ""]
        parts.append("" if self.frame == usual_frame else f"frame {self.frame}")
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
            "depth_range": "oracle" if given_range else None,
            "threads": threads,
            "device": self.device,
        }
        self.settings = {key: value for key, value in entries.items() if value is not None} | dict(
            about or {}
        )

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        """Depth float32 (H, W) in `units`; frames other than `frames_used` may be None."""
        return self.predict_batch([frames])[0]

    def predict_batch(self, stacks: Sequence[Frames]) -> NDArray[np.float32]:
        """`predict` of several samples at once: float32 (B, H, W) in `units`."""
        fringes = [frame for frame in (stack[self.frame] for stack in stacks) if frame is not None]
        if len(fringes) != len(stacks):
            raise PredictionError(
                f"{self.name} needs frame {self.frame}, which was not captured; build with "
                f"--config all"
            )
        from fpp_ml_bench.baselines.networks.base import torch_threads

        with torch_threads(self.threads):
            return self.model.predict_batch(fringes)


def _loss(loss: Any) -> str | None:
    """The recipe's loss as in the names of runs: ``hybrid_l1_0.7``."""
    return Loss.model_validate(loss).label if isinstance(loss, dict) else loss


def weights_of_recipe(recipe: str, size: int) -> Path:
    """The weights that ``fpp-bench reproduce`` left of ``recipe`` below ``runs/``, by the preset of
    images ``size`` px wide. Raises FppBenchError where there are none."""
    from fpp_ml_bench.baselines.reproduce.plan import RUNS, Folders
    from fpp_ml_bench.baselines.reproduce.work import current_weights

    resolved = [load_recipe(recipe, preset) for preset in PRESETS]
    searched = []
    for candidate in resolved:
        below = RUNS / candidate.preset
        weights = current_weights(candidate, Folders(candidate.preset, below, below / "rows"))
        if weights is not None and candidate.size == size:
            return weights
        searched.append(f"{below / candidate.name} ({candidate.size} px)")
    raise RecipeError(
        f"{recipe}: no finished training of it for images of {size} px, looked for "
        f"{' and '.join(searched)}; train it "
        "with fpp-bench reproduce (or fpp-bench train, and give the .safetensors file that it "
        "names)"
    )
