"""Training classical-net: views in drawn lights are rendered, decoded and cut into windows; no dataset is needed.

``out`` holds ``views/``, the files of the engine and, at the end, classical-net.safetensors instead of the checkpoint.
A stopped training continues at every stage.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from fpp_ml_bench.baselines import training
from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.classical_network.network import DepthFilter
from fpp_ml_bench.baselines.classical_network.route import Filtered, decided, filtered
from fpp_ml_bench.baselines.classical_network.samples import Sample, draw, sample_of
from fpp_ml_bench.baselines.classical_network.scene import CHANNELS
from fpp_ml_bench.baselines.phase_network import (
    Batch,
    StepRecipe,
    Trained,
    WindowTraining,
    mean_scores,
    read_net,
    save_net,
)
from fpp_ml_bench.optics import Direction, Rig, paper_rig

VIEWS, WEIGHTS = "views", "classical-net.safetensors"
SMALL_UNITS = 0.1  # error below which its loss is quadratic, in the scene's median sigma
LARGEST_UNITS = 30.0  # at which an error is clipped: a wrong order can't be averaged away
THRESHOLDS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1e3)
"""Logits from which on a pixel without a depth is filled, tried on the validation views; the last fills none."""
VALIDATED_SHARE = 3  # every so many-th validation view is scored during training


@dataclass(frozen=True)
class FilterRecipe(StepRecipe):
    """``phase_steps`` of one ``direction``, with Gray code; ``widths`` of the network; ``near_edge``: share of windows
    beside depth edges and missing pixels; ``weight_*``: of the losses."""

    name: str = "classical-net"
    steps: int = 2000
    window: int = 128
    lights: int = 16
    unions: int = 0
    phase_steps: int = 3
    direction: Direction = "vertical"
    widths: tuple[int, ...] = (16, 24, 32)
    near_edge: float = 0.5
    weight_depth: float = 1.0
    weight_mask: float = 0.5
    weight_scale: float = 0.1

    main_loss: ClassVar[str] = "depth"
    scores: ClassVar[dict[str, dict[str, str]]] = {
        "validation MAE, mm": {"object_mae_mm": "filtered", "input_mae_mm": "decoded"},
        "validation, % of object pixels": {"missed_percent": "missed", "input_missed_percent": "missed before"},
    }

    @property
    def weights(self) -> dict[str, float]:
        return {"depth": self.weight_depth, "mask": self.weight_mask, "scale": self.weight_scale}

    def network(self) -> DepthFilter:
        return DepthFilter(len(CHANNELS), self.widths)

    def losses(self, network: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """``depth``: smooth L1 in the scene's median sigma; ``mask``: binary cross-entropy of pixels without a depth;
        ``scale``: negative log-likelihood of the depth's error under a Laplace distribution."""
        depth, inside, scale, near = network(batch["x"], batch["depth_mm"], batch["sigma_mm"], batch["found"])
        unit = batch["unit_mm"][:, None, None]
        counted = batch["target"] & near
        pixels = counted.sum().clamp(min=1)
        error = ((depth - batch["exact_mm"]) / unit).clamp(-LARGEST_UNITS, LARGEST_UNITS)
        by_pixel = functional.smooth_l1_loss(error, torch.zeros_like(error), beta=SMALL_UNITS, reduction="none")
        left = error.detach().abs()
        open_px = near & ~batch["found"] & batch["valid"]
        by_mask = functional.binary_cross_entropy_with_logits(inside, batch["target"].float(), reduction="none")
        return {
            "depth": (by_pixel * counted).sum() / pixels,
            "mask": (by_mask * open_px).sum() / open_px.sum().clamp(min=1),
            "scale": ((left * torch.exp(-scale) + scale) * counted).sum() / pixels,
        }


def train_classical_net(
    recipe: FilterRecipe,
    out: Path,
    *,
    rig: Rig | None = None,
    minutes: float | None = None,
    workers: int = 1,
    show: bool = False,
    print_line: Callable[[str], None] = lambda line: None,
) -> Trained:
    """Train for ``rig`` (default: the paper's); the same call resumes a training that was stopped. ``show``: progress
    on stderr. Raises `TrainingError` for a folder of another recipe or rig."""
    started, rig = perf_counter(), rig or paper_rig()
    method = ClassicalMethod(rig, direction=recipe.direction, steps=recipe.phase_steps)
    groups = training.groups_of(recipe.lights, recipe.views_a_light, recipe.seed)
    described = recipe.to_dict() | {"rig": rig.to_dict()}
    fingerprint = training.fingerprint_of(described, groups)
    with training.alone_in(out):
        training.claim_folder(out, {"recipe": described, "dataset_fingerprint": fingerprint})
        weights = out / WEIGHTS
        if weights.exists():
            return Trained.before(weights, read_net(weights, DepthFilter, training.FILTER_NETWORKS)[0])

        def measured(views: Iterable[training.View]) -> list[Sample]:
            return [sample for view in views if (sample := sample_of(view, method)) is not None]

        samples, validation = training.measured_views(
            groups, rig, method.frames_used, out / VIEWS, measured, recipe.unions, recipe.seed, workers, show
        )

        def validated(network: DepthFilter) -> dict[str, float]:
            scored = validation[::VALIDATED_SHARE]
            return mean_scores(score(filtered(network, one.scene), one, 0.0) for one in scored)

        with training.reproducible(cpu=True):
            one_window = partial(draw, samples, recipe.window, recipe.near_edge)
            ongoing = WindowTraining(recipe, one_window, validated, out, print_line=print_line)
            ongoing.run(started, minutes, show)
            if not ongoing.over:
                return Trained(None, ongoing.steps_done, 0.0, {})
            network = ongoing.network
            answers = [filtered(network.folded(), sample.scene) for sample in validation]
        threshold = chosen_threshold(answers, validation)
        means = mean_scores(score(one, sample, threshold) for one, sample in zip(answers, validation, strict=True))
        config = training.NetConfig(
            name=recipe.name,
            title="Weights of neighbouring depths, and which missing pixels are object",
            options=network.options,
            threshold=threshold,
            period_px={},
            dataset_fingerprint=fingerprint,
            benchmark=training.TrainingBenchmark("classical-net views", 1),
            steps=recipe.steps,
            recipe=described,
            validation=dict(means),
        )
        save_net(weights, network, config, training.FILTER_NETWORKS)
        (out / training.CHECKPOINT).unlink(missing_ok=True)
        return Trained(weights, recipe.steps, threshold, means)


def score(answer: Filtered, sample: Sample, threshold: float) -> dict[str, float | None]:
    """Of a view: MAE of object pixels in mm, filtered and as decoded, where a missed one counts with its whole depth;
    the shares that are missed; background pixels that were given a depth, in thousands; and the share of errors within
    the stated standard uncertainty."""
    scene, target = sample.scene, sample.target
    if not target.any():
        return {}
    inside = decided(answer, scene, threshold)
    whole = sample.exact_mm + np.float32(scene.middle_mm)
    error = np.where(inside, np.abs(answer.depth_mm - sample.exact_mm), whole)[target]
    before = np.where(scene.found, np.abs(scene.depth_mm - sample.exact_mm), whole)[target]
    within = np.abs(answer.depth_mm - sample.exact_mm) < answer.sigma_mm
    return {
        "object_mae_mm": float(error.mean(dtype=np.float64)),
        "input_mae_mm": float(before.mean(dtype=np.float64)),
        "missed_percent": 100 * float((~inside)[target].mean()),
        "input_missed_percent": 100 * float((~scene.found)[target].mean()),
        "invented_kpx": float((inside & ~scene.found & ~target & ~sample.void).sum()) / 1000,
        "within_percent": 100 * float(within[target & inside].mean()) if (target & inside).any() else None,
    }


def chosen_threshold(answers: Sequence[Filtered], samples: Sequence[Sample]) -> float:
    """The lowest of `THRESHOLDS` at which no validation view loses: what filling saves on the object is at least what
    it adds on the background, each pixel counted with its whole depth."""
    for threshold in THRESHOLDS:
        if all(_gain_px(answer, sample, threshold) >= 0 for answer, sample in zip(answers, samples, strict=True)):
            return threshold
    return THRESHOLDS[-1]


def _gain_px(answer: Filtered, sample: Sample, threshold: float) -> int:
    new = decided(answer, sample.scene, threshold) & ~sample.scene.found
    return int((new & sample.target).sum()) - int((new & ~sample.target & ~sample.void).sum())
