"""Training classical-net: the decoded scene of each view with the exact depth, windows of them, and
what is chosen on validation views."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.learned.network import DepthFilter, mask_loss, mean_over, scale_loss
from fpp_ml_bench.baselines.learned.routes import (
    DEPTH_CHANNELS,
    DepthScene,
    Filtered,
    decided,
    depth_channels,
    filtered,
)
from fpp_ml_bench.baselines.learned.scenes import View
from fpp_ml_bench.baselines.learned.training import Batch, StepRecipe, ViewTask
from fpp_ml_bench.baselines.learned.windows import Sample, Window, mean_scores, view_scores
from fpp_ml_bench.baselines.training.weights import FILTER_NETWORKS, Family
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import Direction

SMALL_UNITS = 0.1  # error below which its loss is quadratic, in the scene's median sigma
LARGEST_UNITS = 30.0  # at which an error is clipped: a wrong order can't be averaged away
THRESHOLDS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1e3)
"""Logits from which on a pixel without a depth is filled, tried on the validation views; the last
fills none."""
ORIENTATIONS = 8
STRIDES, STRIDE_SHARES = (1, 2, 4), (0.6, 0.25, 0.15)
"""Every so many-th pixel of a view makes a window, and how often: a coarser camera sees steeper,
more bent surfaces."""


def depth_sample(view: View, method: ClassicalMethod) -> Sample | None:
    """The sample of a view, decoded by ``method``; None where nothing was decoded. What is missing:
    exact depth less the scene's ``middle_mm``. Pixels without a depth are of interest too."""
    frames: list[NDArray[np.uint8] | None] = [None] * len(method.rig.sequence)
    for index, frame in zip(method.frames_used, view.frames, strict=True):
        frames[index] = frame
    answer, modulation = method.measure(frames)
    scene = (
        None
        if answer.sigma_mm is None
        else DepthScene.of(answer.depth, answer.sigma_mm, modulation)
    )
    if scene is None:
        return None
    part = view.part(scene.crop)
    exact = np.where(part.target, part.depth_mm - np.float32(scene.middle_mm), 0).astype(np.float32)
    return Sample.of(part, scene, exact, part.target & ~scene.found)


@dataclass(frozen=True)
class FilterRecipe(StepRecipe):
    """``phase_steps`` of one ``direction``, with Gray code; ``widths`` of the network;
    ``near_edge``: share of windows beside depth edges and missing pixels; ``weight_*``: of the
    losses."""

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

    title: ClassVar[str] = "Weights of neighbouring depths, and which missing pixels are object"
    family: ClassVar[Family] = FILTER_NETWORKS
    main_loss: ClassVar[str] = "depth"
    scores: ClassVar[dict[str, dict[str, str]]] = {
        "validation MAE, mm": {"object_mae_mm": "filtered", "input_mae_mm": "decoded"},
        "validation, % of object pixels": {
            "missed_percent": "missed",
            "input_missed_percent": "missed before",
        },
    }

    def network(self) -> DepthFilter:
        return DepthFilter(len(DEPTH_CHANNELS), self.widths)

    def losses(self, network: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """``depth``: smooth L1 in the scene's median sigma; ``mask``: binary cross-entropy of
        pixels without a depth; ``scale``: negative log-likelihood of the depth's error under a
        Laplace distribution."""
        depth, inside, scale, near = network(
            batch["x"], batch["depth_mm"], batch["sigma_mm"], batch["found"]
        )
        unit = batch["unit_mm"][:, None, None]
        counted = batch["target"] & near
        error = ((depth - batch["exact_mm"]) / unit).clamp(-LARGEST_UNITS, LARGEST_UNITS)
        by_pixel = functional.smooth_l1_loss(
            error, torch.zeros_like(error), beta=SMALL_UNITS, reduction="none"
        )
        return {
            "depth": mean_over(by_pixel, counted),
            "mask": mask_loss(inside, batch["target"], near & ~batch["found"] & batch["valid"]),
            "scale": scale_loss(error.detach().abs(), scale, counted),
        }

    def task(self, rig: Rig) -> "FilterTask":
        return FilterTask(self, rig)


class FilterTask(ViewTask):
    """What classical-net learns: the frames of a decoded depth."""

    def __init__(self, recipe: FilterRecipe, rig: Rig) -> None:
        self.recipe, self.method = (
            recipe,
            ClassicalMethod(rig, direction=recipe.direction, steps=recipe.phase_steps),
        )
        self.frames = self.method.frames_used

    def samples(self, views: Iterable[View]) -> list[Sample]:
        return [sample for view in views if (sample := depth_sample(view, self.method)) is not None]

    def draw(self, samples: list[Sample], random: np.random.Generator) -> Window:
        """A random window of one of ``samples``, of one of `STRIDES`, in one of 8 orientations: the
        maps of its scene that the network takes; ``exact_mm``, ``target``, and ``valid``: neither
        void nor padding; ``unit_mm``: median sigma of the scene, the unit of the errors."""
        size, sample = self.recipe.window, samples[random.integers(len(samples))]
        orientation, every = (
            int(random.integers(ORIENTATIONS)),
            int(random.choice(STRIDES, p=STRIDE_SHARES)),
        )
        rows, columns = sample.place(size * every, self.recipe.near_edge, random)

        def cut(name: str, maps: NDArray) -> NDArray:
            part = np.rot90(maps[rows, columns][::every, ::every], orientation % 4)
            part = part[:, ::-1] if orientation >= 4 else part
            return np.pad(part, [(0, size - length) for length in part.shape])

        scene = sample.scene.with_maps(cut)
        truth = {"exact_mm": sample.missing, "target": sample.target, "valid": ~sample.void}
        return {
            "x": depth_channels(scene),
            **{name: getattr(scene, name) for name in ("depth_mm", "sigma_mm", "found")},
            **{name: cut(name, maps) for name, maps in truth.items()},
            "unit_mm": np.asarray(scene.unit_mm, dtype=np.float32),
        }

    def scores(self, network: DepthFilter, samples: list[Sample]) -> dict[str, float]:
        return mean_scores(
            filter_scores(filtered(network, sample.scene), sample, 0.0) for sample in samples
        )

    def chosen(
        self, network: DepthFilter, samples: list[Sample], validation: list[Sample], out: Path
    ) -> dict[str, Any]:
        folded = network.folded()
        answers = [filtered(folded, sample.scene) for sample in validation]
        threshold = chosen_threshold(answers, validation)
        pairs = zip(answers, validation, strict=True)
        means = mean_scores(filter_scores(answer, sample, threshold) for answer, sample in pairs)
        return {"threshold": threshold, "period_px": {}, "validation": means}


def filter_scores(answer: Filtered, sample: Sample, threshold: float) -> dict[str, float | None]:
    """`view_scores` of a view, filtered and, as ``input_*``, as decoded; ``invented_kpx`` counts
    what the filter added. ``within_percent``: share of errors within the stated standard
    uncertainty."""
    scene, target = sample.scene, sample.target
    if not target.any():
        return {}
    inside, middle = decided(answer, scene, threshold), np.float32(scene.middle_mm)
    exact = sample.missing + middle
    after = view_scores(sample, inside, answer.depth_mm + middle, exact)
    before = view_scores(sample, scene.found, scene.depth_mm + middle, exact)
    within = (np.abs(answer.depth_mm - sample.missing) < answer.sigma_mm)[target & inside]
    return {
        **after,
        "input_mae_mm": before["object_mae_mm"],
        "input_missed_percent": before["missed_percent"],
        "invented_kpx": after["invented_kpx"] - before["invented_kpx"],
        "within_percent": 100 * float(within.mean()) if within.size else None,
    }


def chosen_threshold(answers: Sequence[Filtered], samples: Sequence[Sample]) -> float:
    """The lowest of `THRESHOLDS` at which no validation view loses: what filling saves on the
    object is at least what it adds on the background, each pixel counted with its whole depth."""
    for threshold in THRESHOLDS:
        if all(
            _gain_px(answer, sample, threshold) >= 0
            for answer, sample in zip(answers, samples, strict=True)
        ):
            return threshold
    return THRESHOLDS[-1]


def _gain_px(answer: Filtered, sample: Sample, threshold: float) -> int:
    new = decided(answer, sample.scene, threshold) & ~sample.scene.found
    return int((new & sample.target).sum()) - int((new & ~sample.target & ~sample.void).sum())
