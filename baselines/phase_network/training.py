"""Training phase-net, from dataset to weights file: windows of images, three losses, validation in mm on whole images.

``out`` holds the files of the engine and, at the end, phase-net.safetensors instead of the checkpoint.
"""

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from fpp_ml_bench.baselines import training
from fpp_ml_bench.baselines.phase_network.inputs import STEPS, Geometry
from fpp_ml_bench.baselines.phase_network.method import load_net, save_net
from fpp_ml_bench.baselines.phase_network.network import PhaseNet
from fpp_ml_bench.baselines.phase_network.route import Answers, decided_mask, network_answers, with_lead
from fpp_ml_bench.baselines.phase_network.samples import Sample, samples_of, unions_of
from fpp_ml_bench.baselines.phase_network.windows import IGNORED, Variation, Window, draw
from fpp_ml_bench.baselines.phase_route import TAU, Settings
from fpp_ml_bench.baselines.training import Panel, Record
from fpp_ml_bench.errors import RecipeError, TrainingError
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.optics import DIRECTIONS, Direction

WEIGHTS = "phase-net.safetensors"
SMALL_RAD = 0.05  # error of the phase below which its loss is quadratic
IMPOSSIBLE = -1e4  # logit of an order that puts its pixel out of the working range: finite, for gradients to stay so
LARGEST_GRADIENT = 50.0
VALIDATED_SHARE = 5  # every so many-th validation image is scored during training
THRESHOLDS = tuple(float(value) for value in np.arange(-5, 3.01, 0.5))
"""Mask logits that are tried on the validation split."""
LEADS = tuple(float(value) for value in range(8))
"""Leads of the base order (see `network_answers`) that are tried on the validation split."""
_TYPICAL_MM, _TOLERANCE_MM = 1800.0, 0.1
"""Depth error that a missed or invented pixel counts with; errors this close to the least count as equal."""


@dataclass(frozen=True)
class Recipe:
    """``steps`` of ``batch`` windows of ``window`` px; AdamW at ``rate``, after ``warm_up`` steps falling as a cosine.
    ``widths`` to ``bound_rad`` make the network; ``directions``: the fringes it learns from, one frame each;
    ``unions``: images that join several objects, made from each sample (see `unions`); ``weight_*``: of the losses;
    ``averaged``: decay of the weights' moving average, which is what the weights file holds. Raises `RecipeError` for
    values that train nothing."""

    name: str = "phase-net"
    steps: int = 5000
    batch: int = 6
    window: int = 160
    rate: float = 3e-3
    warm_up: int = 100
    decay: float = 1e-4
    averaged: float = 0.995
    seed: int = 42
    widths: tuple[int, ...] = (24, 32, 48, 64)
    fine: int = 14
    squeezed: int = 20
    order_widths: tuple[int, ...] = (32, 48, 64)
    bound_rad: float = math.pi / 2
    directions: tuple[Direction, ...] = DIRECTIONS
    unions: int = 1
    weight_order: float = 2.0
    weight_mask: float = 0.5
    weight_phase: float = 10.0
    validate_every: int = 500
    vary: Variation = field(default_factory=Variation)

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "window", "validate_every"):
            if not getattr(self, name) >= 1:
                raise RecipeError(f"{name} {getattr(self, name)!r}: expected 1 or more")
        if not 0 <= self.unions <= 100:
            raise RecipeError(f"unions {self.unions!r}: expected 0 to 100 for every sample")
        if not self.rate > 0 or not 0 <= self.averaged < 1:
            raise RecipeError(f"expected rate above 0 and averaged 0 to below 1, got {self.rate} and {self.averaged}")
        if not self.directions or any(direction not in DIRECTIONS for direction in self.directions):
            raise RecipeError(f"directions {self.directions}: expected some of {', '.join(DIRECTIONS)}")

    def rate_at(self, step: int) -> float:
        """Learning rate of step 0, 1, ..."""
        if step < self.warm_up:
            return self.rate * (step + 1) / self.warm_up
        progress = (step - self.warm_up) / max(1, self.steps - self.warm_up)
        return self.rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0))))

    def to_dict(self) -> dict[str, Any]:
        return json.loads(json.dumps(asdict(self)))

    @property
    def digest(self) -> str:
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()


Batch = dict[str, Tensor]  # the fields of `Window` with a leading axis B


def batch_of(windows: list[Window]) -> Batch:
    fields = Window.__dataclass_fields__
    batch = {name: torch.from_numpy(np.stack([getattr(window, name) for window in windows])) for name in fields}
    batch["x"] = batch["x"].contiguous(memory_format=torch.channels_last)
    return batch


def losses(network: torch.nn.Module, batch: Batch, bound_rad: float) -> dict[str, Tensor]:
    """``order``: cross-entropy over the candidates; ``mask``: binary cross-entropy; ``phase``: smooth L1 in rad."""
    order, inside, correction = network(batch["x"])
    logits = torch.where(batch["exists"], order, torch.tensor(IMPOSSIBLE))
    pixels = batch["fitted"].sum().clamp(min=1)
    by_order = functional.cross_entropy(logits, batch["order"], ignore_index=IGNORED, reduction="sum") / pixels
    by_pixel = functional.binary_cross_entropy_with_logits(inside, batch["target"].float(), reduction="none")
    by_mask = (by_pixel * batch["mask_valid"]).sum() / batch["mask_valid"].sum().clamp(min=1)
    target_rad = batch["correction_rad"].clamp(-bound_rad, bound_rad)
    by_phase = functional.smooth_l1_loss(correction, target_rad, beta=SMALL_RAD, reduction="none")
    return {"order": by_order, "mask": by_mask, "phase": (by_phase * batch["fitted"]).sum() / pixels}


class WindowObjective:
    """The weighted losses of a `PhaseNet`, and the moving average of its weights, updated after every step."""

    def __init__(self, network: PhaseNet, recipe: Recipe) -> None:
        self.modules: dict[str, nn.Module] = {"network": network}
        self.bound_rad = recipe.bound_rad
        self.weights = {"order": recipe.weight_order, "mask": recipe.weight_mask, "phase": recipe.weight_phase}
        self.averaged = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(recipe.averaged), use_buffers=True)

    def steps(self, batch: Batch) -> Iterator[tuple[str, Tensor, dict[str, Tensor]]]:
        parts = losses(self.modules["network"], batch, self.bound_rad)
        total = torch.stack([self.weights[name] * parts[name] for name in self.weights]).sum()
        yield "network", total, {name: value.detach() for name, value in parts.items()}
        self.averaged.update_parameters(self.modules["network"])


class PhaseNetTraining(training.Training):
    """Training in intervals between two validations, on windows drawn from ``samples``, on the processor. ``start``:
    the network whose weights it starts from (None: random ones). ``print_line`` is given a line for every new record.
    Raises `TrainingError` where ``start`` is another network than the recipe's, and for a checkpoint of another recipe.
    """

    largest_gradient = LARGEST_GRADIENT

    def __init__(
        self, recipe: Recipe, samples: list[Sample], validation: list[Sample], geometries: dict[Direction, Geometry],
        out: Path, start: PhaseNet | None = None, print_line: Callable[[str], None] = lambda line: None,
    ) -> None:  # fmt: skip
        super().__init__(out, {"recipe": recipe.digest}, recipe.seed, cpu=True)
        self.recipe, self.samples, self.validation, self.geometries = recipe, samples, validation, geometries
        self.name = self.title = recipe.name
        self.print_line = print_line
        network = PhaseNet(recipe.widths, recipe.fine, recipe.squeezed, recipe.order_widths, recipe.bound_rad)
        network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        if start is not None:
            if start.options != network.options:
                raise TrainingError(f"weights to start from: expected {network.options}, got {start.options}")
            network.load_state_dict(start.state_dict())
        self.objective = self.windows = WindowObjective(network, recipe)
        self.bare = {"network": network, "averaged": self.windows.averaged}
        optimizer = torch.optim.AdamW(network.parameters(), lr=recipe.rate, weight_decay=recipe.decay)
        self.windows.modules["network"], prepared = self.accelerator.prepare(network, optimizer)
        self.optimizers = {"network": prepared}
        self.resume()

    @property
    def network(self) -> PhaseNet:
        """The averaged network, to be used."""
        averaged: PhaseNet = self.windows.averaged.module.eval()  # type: ignore[assignment]
        return averaged

    @property
    def steps_done(self) -> int:
        return self.history[-1]["step"] if self.history else 0

    @property
    def _next_validation(self) -> int:
        every = self.recipe.validate_every
        return min((self.steps_done // every + 1) * every, self.recipe.steps)

    @property
    def total_steps(self) -> int:
        return self.recipe.steps

    @property
    def over(self) -> bool:
        return self.steps_done >= self.recipe.steps

    def rate(self, number: int) -> float:
        return self.recipe.rate_at(self.steps_done + number)

    def batches(self) -> Iterator[Batch]:
        """The batches up to the next validation: each is a function of seed and step alone, made one step ahead."""
        first, last, recipe = self.steps_done, self._next_validation, self.recipe

        def make(step: int) -> Batch:
            random = np.random.default_rng([recipe.seed, step])
            one = partial(draw, self.samples, self.geometries, recipe.window, recipe.vary, random)
            return batch_of([one() for _ in range(recipe.batch)])

        with ThreadPoolExecutor(1) as pool:
            coming = pool.submit(make, first)
            for step in range(first, last):
                batch = coming.result()
                if step + 1 < last:
                    coming = pool.submit(make, step + 1)
                yield batch

    def diverged(self, name: str, value: float, number: int, label: None) -> str:
        return f"the loss is {value} at step {self.steps_done + number + 1}; lower the rate and start again"

    def validated(self, losses: dict[str, float], began: float) -> Record:
        seconds, steps = perf_counter() - began, self._next_validation
        record: Record = {"step": steps, "rate": self.recipe.rate_at(steps - 1), "seconds": seconds}
        record |= {f"loss_{name}": value for name, value in losses.items()}
        if not self.validation:
            return record
        answers = answers_of(self.network, self.validation, self.geometries)
        return record | mean_scores(answers, self.validation, self.geometries)

    def recorded(self, record: Record) -> None:
        self.print_line("  ".join(f"{key} {value:.4g}" for key, value in record.items()))

    def progress(self) -> str:
        return f"step {self.steps_done}/{self.recipe.steps}  phase {self.history[-1]['loss_phase']:.4g}"

    def panels(self) -> list[Panel]:
        def panel(title: str, labels: dict[str, str], log: bool = False) -> Panel:
            return Panel.of(title, self.history, "step", labels, log)

        return [
            panel("training losses", {f"loss_{name}": name for name in self.windows.weights}, log=True),
            panel("validation MAE, mm", {"object_mae_mm": "object", "right_mae_mm": "right order"}),
            panel("validation, % of object pixels", {"wrong_percent": "wrong order", "missed_percent": "missed"}),
        ]


def answers_of(network: PhaseNet, samples: list[Sample], geometries: dict[Direction, Geometry]) -> Iterator[Answers]:
    """The network's answers for each sample."""
    for sample in samples:
        yield network_answers(network, sample.scene.single(), geometries[sample.direction])


def mean_scores(
    answers: Iterable[Answers], samples: list[Sample], geometries: dict[Direction, Geometry], threshold: float = 0.0
) -> dict[str, float]:
    """Means of `score` over the samples."""
    pairs = zip(answers, samples, strict=True)
    rows = [score(answer, sample, geometries[sample.direction], threshold) for answer, sample in pairs]
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


def score(answers: Answers, sample: Sample, geometry: Geometry, threshold: float = 0.0) -> dict[str, float]:
    """Scores of one whole image with ``threshold`` on the mask's logit. ``object_mae_mm`` counts a missed pixel with
    its whole depth; ``right_mae_mm``: MAE of pixels with the right order; ``wrong_percent`` and ``missed_percent``:
    shares of the object's pixels; ``invented_kpx``: background pixels with a depth, in thousands."""
    scene = sample.scene.single()
    layer = geometry.layer.at(scene.crop)
    steps, inside = np.array(STEPS, np.int32)[answers.logits.argmax(axis=0)], decided_mask(answers, scene, threshold)
    base_residual = layer.residual_phase(scene.phase_rad, scene.order)
    true_mm = layer.depth_of_residual_mm(base_residual + sample.missing_rad)
    phase_change = TAU * steps + answers.correction_rad
    predicted_mm = np.nan_to_num(layer.depth_of_residual_mm(base_residual + phase_change))
    target = sample.target
    phase_error = phase_change - sample.missing_rad
    error = np.where(inside, np.minimum(np.abs(predicted_mm - true_mm), true_mm), true_mm)[target]
    wrong = (np.abs(phase_error) > np.pi)[target]
    detected = inside[target]
    return {
        "object_mae_mm": float(error.mean()),
        "right_mae_mm": float(error[detected & ~wrong].mean()),
        "wrong_percent": 100 * float(wrong.mean()),
        "missed_percent": 100 * float((~detected).mean()),
        "invented_kpx": float((inside & ~target).sum()) / 1000,
    }


def chosen_threshold(answers: list[Answers], samples: list[Sample], pixels: int) -> float:
    """The threshold out of `THRESHOLDS` with the least sum of object and background error: a missed object pixel and an
    invented background pixel are off by the same distance, each divided by the number of pixels of its kind. Among the
    thresholds within 0.1 mm of the least, the lowest: it misses the fewest pixels."""
    costs = np.zeros(len(THRESHOLDS))
    for answer, sample in zip(answers, samples, strict=True):
        scene = sample.scene.single()
        inside = max(int(sample.target.sum()), 1)
        for number, threshold in enumerate(THRESHOLDS):
            is_object = decided_mask(answer, scene, threshold)
            missed, invented = (sample.target & ~is_object).sum(), (is_object & ~sample.target).sum()
            costs[number] += _TYPICAL_MM * (missed / inside + invented / (pixels - inside))
    means = costs / len(samples)
    return THRESHOLDS[int(np.flatnonzero(means < means.min() + _TOLERANCE_MM)[0])]


def chosen_lead(answers: list[Answers], samples: list[Sample], geometries: dict[Direction, Geometry]) -> float:
    """The lead out of `LEADS` with the fewest wrong orders, mean over the samples."""
    means = (mean_scores((with_lead(one, lead) for one in answers), samples, geometries) for lead in LEADS)
    return LEADS[int(np.argmin([mean["wrong_percent"] for mean in means]))]


@dataclass(frozen=True)
class Trained:
    """The weights file, scores on the whole validation split, and the mask threshold that was chosen there.
    ``weights`` is None for a training that stopped because its minutes were over."""

    weights: Path | None
    steps: int
    threshold: float
    validation: dict[str, float]


def train_phase_net(
    recipe: Recipe, dataset: Path, out: Path, *, extra: Path | None = None, start: Path | None = None,
    minutes: float | None = None, show: bool = False, print_line: Callable[[str], None] = lambda line: None,
) -> Trained:  # fmt: skip
    """Train on the dataset's training split, and on that of ``extra``, starting from the weights in ``start`` or from
    random ones; the same call resumes a training that was stopped. ``show``: progress on stderr; ``print_line`` is
    given a line for every validation. Raises `DatasetError` for a dataset without the frames in question,
    `TrainingError` for a folder of another recipe or dataset."""
    started = perf_counter()
    opened = DatasetFolder(dataset)
    extra_data = None if extra is None else DatasetFolder(extra)
    if extra_data is not None and extra_data.rig != opened.rig:
        raise TrainingError(f"{extra}: was made by another rig than {dataset}; build both with the same one")
    start_weights = None if start is None else load_net(start, folded=False)
    described = recipe.to_dict() | ({} if extra_data is None else {"extra_fingerprint": extra_data.fingerprint})
    described |= {} if start_weights is None else {"start_sha256": start_weights.sha256}
    training.claim_folder(out, {"recipe": described, "dataset_fingerprint": opened.fingerprint})
    weights = out / WEIGHTS
    if weights.exists():
        finished = load_net(weights).config
        scores = {key: float(value or 0) for key, value in finished.validation.items()}
        return Trained(weights, finished.steps, finished.threshold, scores)
    geometries = {direction: Geometry.of(opened.rig, Settings(direction=direction)) for direction in recipe.directions}
    folders = [opened] if extra_data is None else [opened, extra_data]
    samples, validation = _samples(recipe, folders, geometries, show)
    with training.reproducible(cpu=True):
        scored = validation[::VALIDATED_SHARE]
        first = None if start_weights is None else start_weights.network
        ongoing = PhaseNetTraining(recipe, samples, scored, geometries, out, first, print_line)
        ongoing.run(started, minutes, show)
        if not ongoing.over:
            return Trained(None, ongoing.steps_done, 0.0, {})
        network = ongoing.network
        answers = list(answers_of(network, validation, geometries))
        threshold = chosen_threshold(answers, validation, opened.size[0] * opened.size[1])
        lead = chosen_lead(answers, validation, geometries)
        means = mean_scores((with_lead(one, lead) for one in answers), validation, geometries, threshold)
    config = training.NetConfig(
        name=recipe.name, title="Fringe order, mask and bounded phase correction", options=network.options,
        threshold=threshold, lead=lead, period_px={direction: g.route.period_px for direction, g in geometries.items()},
        dataset_fingerprint=opened.fingerprint, benchmark=training.training_benchmark(opened.fingerprint),
        steps=recipe.steps, recipe=described, validation=dict(means),
    )  # fmt: skip
    save_net(weights, network, config)
    (out / training.CHECKPOINT).unlink(missing_ok=True)
    return Trained(weights, recipe.steps, threshold, means)


def _samples(
    recipe: Recipe, folders: list[DatasetFolder], geometries: dict[Direction, Geometry], show: bool
) -> tuple[list[Sample], list[Sample]]:
    """Training samples and unions of all ``folders``, and validation samples of the first."""
    train = [(folder, folder.samples("train")) for folder in folders]
    names = folders[0].samples("validation")
    images = (1 + recipe.unions) * sum(len(of_folder) for _, of_folder in train) + len(names)
    samples: list[Sample] = []
    validation: list[Sample] = []
    with training.Display("phase of the samples", images * len(geometries), show) as display:
        for geometry in geometries.values():
            for folder, of_folder in train:
                samples += samples_of(folder, of_folder, geometry, display.advance)
                samples += unions_of(folder, of_folder, geometry, recipe.unions, recipe.seed, display.advance)
            validation += samples_of(folders[0], names, geometry, display.advance)
    return samples, validation
