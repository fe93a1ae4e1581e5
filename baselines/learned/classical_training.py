"""Training classical-net: the decoded scene of each view with the exact depth, windows of them, and what is chosen on
validation views."""

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
from fpp_ml_bench.baselines.learned.classical_network import DepthFilter
from fpp_ml_bench.baselines.learned.classical_route import Filtered, decided, filtered
from fpp_ml_bench.baselines.learned.classical_scene import CHANNELS, DepthScene, channels
from fpp_ml_bench.baselines.learned.window_training import (
    Batch,
    StepRecipe,
    Task,
    mask_loss,
    mean_over,
    scale_loss,
)
from fpp_ml_bench.baselines.learned.windows import Sample, edge_points, mean_scores, place_of
from fpp_ml_bench.baselines.phase.calibration_layer import Image, Mask
from fpp_ml_bench.baselines.training.views import View
from fpp_ml_bench.baselines.training.weights import FILTER_NETWORKS, Family
from fpp_ml_bench.depth import depth_edges
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import Direction

SMALL_UNITS = 0.1  # error below which its loss is quadratic, in the scene's median sigma
LARGEST_UNITS = 30.0  # at which an error is clipped: a wrong order can't be averaged away
THRESHOLDS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1e3)
"""Logits from which on a pixel without a depth is filled, tried on the validation views; the last fills none."""
ORIENTATIONS = 8
STRIDES, STRIDE_SHARES = (1, 2, 4), (0.6, 0.25, 0.15)
"""Every so many-th pixel of a view makes a window, and how often: a coarser camera sees steeper, more bent surfaces."""


@dataclass(frozen=True)
class DepthSample(Sample):
    """``exact_mm`` (h, w): exact depth less the scene's ``middle_mm``; pixels without a depth are of interest too."""

    exact_mm: Image


@dataclass(frozen=True)
class Window:
    """One training example, maps (n, n) of a `DepthSample`; ``x`` (C, n, n); ``valid``: neither void nor padding;
    ``unit_mm``: median sigma of the scene, the unit of the errors."""

    x: Image
    depth_mm: Image
    sigma_mm: Image
    found: Mask
    exact_mm: Image
    target: Mask
    valid: Mask
    unit_mm: NDArray[np.float32]


def sample_of(view: View, method: ClassicalMethod) -> DepthSample | None:
    """The sample of a view, decoded by ``method``; None where nothing was decoded."""
    frames: list[NDArray[np.uint8] | None] = [None] * len(method.rig.sequence)
    for index, frame in zip(method.frames_used, view.frames, strict=True):
        frames[index] = frame
    answer, modulation = method.measure(frames)
    scene = None if answer.sigma_mm is None else DepthScene.of(answer.depth, answer.sigma_mm, modulation)
    if scene is None:
        return None
    depth_mm, void = view.depth_mm[scene.crop], view.void[scene.crop]
    target = (depth_mm > 0) & ~void
    exact = np.where(target, depth_mm - np.float32(scene.middle_mm), 0).astype(np.float32)
    edges = edge_points(depth_edges(depth_mm) | (target & ~scene.found))
    return DepthSample(view.name, scene, target, void, edges, exact)


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

    title: ClassVar[str] = "Weights of neighbouring depths, and which missing pixels are object"
    family: ClassVar[Family] = FILTER_NETWORKS
    makes: ClassVar[type[nn.Module]] = DepthFilter
    main_loss: ClassVar[str] = "depth"
    scores: ClassVar[dict[str, dict[str, str]]] = {
        "validation MAE, mm": {"object_mae_mm": "filtered", "input_mae_mm": "decoded"},
        "validation, % of object pixels": {"missed_percent": "missed", "input_missed_percent": "missed before"},
    }

    def network(self) -> DepthFilter:
        return DepthFilter(len(CHANNELS), self.widths)

    def losses(self, network: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """``depth``: smooth L1 in the scene's median sigma; ``mask``: binary cross-entropy of pixels without a depth;
        ``scale``: negative log-likelihood of the depth's error under a Laplace distribution."""
        depth, inside, scale, near = network(batch["x"], batch["depth_mm"], batch["sigma_mm"], batch["found"])
        unit = batch["unit_mm"][:, None, None]
        counted = batch["target"] & near
        error = ((depth - batch["exact_mm"]) / unit).clamp(-LARGEST_UNITS, LARGEST_UNITS)
        by_pixel = functional.smooth_l1_loss(error, torch.zeros_like(error), beta=SMALL_UNITS, reduction="none")
        return {
            "depth": mean_over(by_pixel, counted),
            "mask": mask_loss(inside, batch["target"], near & ~batch["found"] & batch["valid"]),
            "scale": scale_loss(error.detach().abs(), scale, counted),
        }

    def task(self, rig: Rig) -> "FilterTask":
        return FilterTask(self, rig)


class FilterTask(Task):
    """What classical-net learns: the frames of a decoded depth."""

    def __init__(self, recipe: FilterRecipe, rig: Rig) -> None:
        self.recipe, self.method = recipe, ClassicalMethod(rig, direction=recipe.direction, steps=recipe.phase_steps)
        self.frames = self.method.frames_used

    def samples(self, views: Iterable[View]) -> list[DepthSample]:
        return [sample for view in views if (sample := sample_of(view, self.method)) is not None]

    def draw(self, samples: list[DepthSample], random: np.random.Generator) -> Window:
        """A random window of one of ``samples``, of one of `STRIDES`, in one of 8 orientations."""
        size, near_edge = self.recipe.window, self.recipe.near_edge
        sample = samples[random.integers(len(samples))]
        orientation, every = int(random.integers(ORIENTATIONS)), int(random.choice(STRIDES, p=STRIDE_SHARES))
        rows, columns = place_of(sample.edges, sample.target.shape, size * every, random.random() < near_edge, random)

        def cut(maps: NDArray) -> NDArray:
            part = np.rot90(maps[rows, columns][::every, ::every], orientation % 4)
            part = part[:, ::-1] if orientation >= 4 else part
            return np.pad(part, [(0, size - length) for length in part.shape])

        scene = sample.scene.with_maps(cut)
        return Window(
            channels(scene),
            scene.depth_mm,
            scene.sigma_mm,
            scene.found,
            cut(sample.exact_mm),
            cut(sample.target),
            cut(~sample.void),
            np.asarray(scene.unit_mm, dtype=np.float32),
        )

    def scores(self, network: DepthFilter, samples: list[DepthSample]) -> dict[str, float]:
        return mean_scores(score(filtered(network, sample.scene), sample, 0.0) for sample in samples)

    def answered(
        self, network: DepthFilter, samples: list[DepthSample], validation: list[DepthSample]
    ) -> list[Filtered]:
        return [filtered(network.folded(), sample.scene) for sample in validation]

    def chosen(self, answered: list[Filtered], validation: list[DepthSample], out: Path) -> dict[str, Any]:
        threshold = chosen_threshold(answered, validation)
        pairs = zip(answered, validation, strict=True)
        means = mean_scores(score(answer, sample, threshold) for answer, sample in pairs)
        return {"threshold": threshold, "period_px": {}, "validation": means}


def score(answer: Filtered, sample: DepthSample, threshold: float) -> dict[str, float | None]:
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


def chosen_threshold(answers: Sequence[Filtered], samples: Sequence[DepthSample]) -> float:
    """The lowest of `THRESHOLDS` at which no validation view loses: what filling saves on the object is at least what
    it adds on the background, each pixel counted with its whole depth."""
    for threshold in THRESHOLDS:
        if all(_gain_px(answer, sample, threshold) >= 0 for answer, sample in zip(answers, samples, strict=True)):
            return threshold
    return THRESHOLDS[-1]


def _gain_px(answer: Filtered, sample: DepthSample, threshold: float) -> int:
    new = decided(answer, sample.scene, threshold) & ~sample.scene.found
    return int((new & sample.target).sum()) - int((new & ~sample.target & ~sample.void).sum())
