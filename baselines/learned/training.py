"""What the trainings of phase-net, crossed-net and classical-net have in common: windows of
rendered views; no dataset is needed. Views in drawn lights are rendered, measured, and cut into
windows; a moving average of the weights is kept; mask and order are chosen on validation views.

``out`` holds ``views/``, the files of the engine and, at the end, the weights instead of the
checkpoint. A stopped training continues at every stage.
"""

import hashlib
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from fpp_ml_bench.baselines.learned.inputs import PHASE_CHANNELS
from fpp_ml_bench.baselines.learned.network import (
    PhaseNet,
    load_net,
    mask_loss,
    mean_over,
    scale_loss,
)
from fpp_ml_bench.baselines.learned.odds import Answers, decided_mask
from fpp_ml_bench.baselines.learned.scenes import (
    HELD_OUT,
    Group,
    View,
    fingerprint_of,
    groups_of,
    read_views,
    render_views,
    with_unions,
)
from fpp_ml_bench.baselines.learned.windows import (
    IGNORED,
    Sample,
    Window,
    chosen_threshold,
    mean_scores,
    view_scores,
)
from fpp_ml_bench.baselines.phase.geometry import Image, Mask
from fpp_ml_bench.baselines.training.engine import (
    CHECKPOINT,
    Display,
    Panel,
    Record,
    Training,
    alone_in,
    claim_folder,
    reproducible,
)
from fpp_ml_bench.baselines.training.weights import (
    PHASE_NETWORKS,
    Family,
    NetConfig,
    TrainingBenchmark,
    open_weights,
    save_weights,
)
from fpp_ml_bench.errors import RecipeError, TrainingError
from fpp_ml_bench.optics.named_rigs import NAMED_RIGS
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import Direction

VIEWS = "views"
SMALL_RAD = 0.05  # error of the phase below which its loss is quadratic
IMPOSSIBLE = -1e4
"""Logit of an order that puts its pixel out of the working range: finite, for gradients to stay
so."""
LARGEST_GRADIENT = 50.0
MOST = {"views_a_light": 40, "unions": 100}  # of a recipe

SampleT = TypeVar("SampleT")
Batch = dict[str, Tensor]  # the fields of a window with a leading axis B


def batch_of(windows: Sequence[Window]) -> Batch:
    batch = {
        name: torch.from_numpy(np.stack([window[name] for window in windows]))
        for name in windows[0]
    }
    batch["x"] = batch["x"].contiguous(memory_format=torch.channels_last)
    return batch


@dataclass(frozen=True)
class StepRecipe(ABC):
    """``steps`` of ``batch`` windows of ``window`` px; AdamW at ``rate``, after ``warm_up`` steps
    falling as a cosine; ``averaged``: decay of the moving average of the weights, which is what the
    weights file holds; ``lights`` that are drawn, ``views_a_light`` of training objects in each,
    ``unions`` for every view, ``textured_every``-th of the lights with albedo maps and gloss, and
    ``validation_lights`` for validation objects (see `groups_of`). A subclass says which network
    learns what. Raises `RecipeError` for values that train nothing."""

    name: str = ""
    steps: int = 5000
    batch: int = 6
    window: int = 160
    rate: float = 3e-3
    warm_up: int = 100
    decay: float = 1e-4
    averaged: float = 0.995
    seed: int = 42
    validate_every: int = 500
    lights: int = 30
    views_a_light: int = 8
    unions: int = 1
    textured_every: int = 1
    validation_lights: int = 0

    title: ClassVar[str]
    """Of the weights."""
    family: ClassVar[Family] = PHASE_NETWORKS
    main_loss: ClassVar[str]
    """Which is shown while it trains."""
    scores: ClassVar[dict[str, dict[str, str]]]
    """What its curve shows beside the losses: titles, and scores with their labels."""
    rig: ClassVar[str] = "paper"
    """Which of `NAMED_RIGS` it trains for by default."""

    def __post_init__(self) -> None:
        ones = "steps", "batch", "window", "validate_every", "views_a_light", "textured_every"
        for name in (*ones, "lights", "unions", "validation_lights"):
            least, most, value = int(name in ones), MOST.get(name, math.inf), getattr(self, name)
            if not least <= value <= most:
                raise RecipeError(f"{name} {value!r}: expected {least} to {most}")
        if not self.rate > 0 or not 0 <= self.averaged < 1:
            raise RecipeError(
                f"expected rate above 0 and averaged 0 to below 1, got {self.rate} and "
                f"{self.averaged}"
            )

    @property
    def weights_name(self) -> str:
        """Of the file, and of the weights that come with the package."""
        return self.name

    @property
    def weights(self) -> dict[str, float]:
        """Of the losses, by name: the fields ``weight_*``."""
        return {
            name.removeprefix("weight_"): value
            for name, value in vars(self).items()
            if name.startswith("weight_")
        }

    @abstractmethod
    def network(self) -> nn.Module:
        """The network, untrained."""

    @abstractmethod
    def losses(self, network: nn.Module, batch: "Batch") -> dict[str, Tensor]:
        """Of ``network`` on a batch, by the names of `weights`."""

    @abstractmethod
    def task(self, rig: Rig) -> "Task[Any]":
        """What the network learns from views of ``rig``."""

    def rate_at(self, step: int) -> float:
        """Learning rate of step 0, 1, ..."""
        if step < self.warm_up:
            return self.rate * (step + 1) / self.warm_up
        progress = (step - self.warm_up) / max(1, self.steps - self.warm_up)
        return self.rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0))))

    def to_dict(self) -> dict[str, Any]:
        """All settings, and what the drawn lights leave alone."""
        return json.loads(json.dumps(asdict(self) | {"held_out": HELD_OUT}))

    @property
    def digest(self) -> str:
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class WindowRecipe(StepRecipe):
    """Of a `PhaseNet`: ``widths`` to ``bound_rad`` make the network; ``weight_*``: of the losses,
    ``weight_scale`` that of the stated uncertainty."""

    name: str = "phase-net"
    widths: tuple[int, ...] = (24, 32, 48, 64)
    fine: int = 14
    squeezed: int = 20
    order_widths: tuple[int, ...] = (32, 48, 64)
    bound_rad: float = math.pi / 2
    weight_order: float = 2.0
    weight_mask: float = 0.5
    weight_phase: float = 10.0
    weight_scale: float = 0.1

    inputs: ClassVar[tuple[str, ...]] = PHASE_CHANNELS
    main_loss: ClassVar[str] = "phase"
    scores: ClassVar[dict[str, dict[str, str]]] = {
        "validation MAE, mm": {"object_mae_mm": "object", "right_mae_mm": "right order"},
        "validation, % of object pixels": {
            "wrong_percent": "wrong order",
            "missed_percent": "missed",
        },
    }

    def network(self) -> PhaseNet:
        return PhaseNet(
            self.widths,
            self.fine,
            self.squeezed,
            self.order_widths,
            self.bound_rad,
            len(self.inputs),
        )

    def losses(self, network: nn.Module, batch: "Batch") -> dict[str, Tensor]:
        """``order``: cross-entropy over the candidates; ``mask``: binary cross-entropy; ``phase``:
        smooth L1 in rad; ``scale``: negative log-likelihood of its phase error under a Laplace
        distribution."""
        order, inside, correction, scale = network(batch["x"])
        logits = torch.where(batch["exists"], order, torch.tensor(IMPOSSIBLE))
        fitted = batch["fitted"]
        by_order = functional.cross_entropy(
            logits, batch["order"], ignore_index=IGNORED, reduction="sum"
        )
        target_rad = batch["correction_rad"].clamp(-self.bound_rad, self.bound_rad)
        by_phase = functional.smooth_l1_loss(
            correction, target_rad, beta=SMALL_RAD, reduction="none"
        )
        error = (correction.detach() - batch["correction_rad"]).abs()
        return {
            "order": by_order / fitted.sum().clamp(min=1),
            "mask": mask_loss(inside, batch["target"], batch["mask_valid"]),
            "phase": mean_over(by_phase, fitted),
            "scale": scale_loss(error, scale, fitted),
        }


class WindowTraining(Training):
    """Training in intervals between two validations, on the processor. Windows are those of
    ``task``, drawn from ``samples``; it is validated on ``scored``. ``start``: the network whose
    weights it starts from (None: random ones). ``show``: every new record is printed. Raises
    `TrainingError` where ``start`` is another network than the recipe's, and for a checkpoint of
    another recipe."""

    largest_gradient = LARGEST_GRADIENT

    def __init__(
        self,
        task: "Task[Any]",
        samples: list[Any],
        scored: list[Any],
        out: Path,
        start: PhaseNet | None = None,
        show: bool = False,
    ) -> None:
        recipe: StepRecipe = task.recipe
        super().__init__(out, {"recipe": recipe.digest}, recipe.seed, cpu=True)
        self.recipe, self.task, self.samples, self.scored, self.show = (
            recipe,
            task,
            samples,
            scored,
            show,
        )
        self.name = self.title = recipe.name
        self.interval_steps, self.total_steps = recipe.validate_every, recipe.steps
        network = recipe.network()
        network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        if start is not None:
            if start.options != network.options:
                raise TrainingError(
                    f"weights to start from: expected {network.options}, got {start.options}"
                )
            network.load_state_dict(start.state_dict())
        self.averaged = AveragedModel(
            network, multi_avg_fn=get_ema_multi_avg_fn(recipe.averaged), use_buffers=True
        )
        self.bare = {"network": network, "averaged": self.averaged}
        optimizer = torch.optim.AdamW(
            network.parameters(), lr=recipe.rate, weight_decay=recipe.decay
        )
        prepared, prepared_optimizer = self.accelerator.prepare(network, optimizer)
        self.modules, self.optimizers, self.objective = (
            {"network": prepared},
            {"network": prepared_optimizer},
            self,
        )
        self.resume()

    def steps(self, batch: Batch) -> Iterator[tuple[str, Tensor, dict[str, Tensor]]]:
        """As of `training.Objective`: the weighted losses; the average is updated after every
        step."""
        parts = self.recipe.losses(self.modules["network"], batch)
        total = torch.stack(
            [weight * parts[name] for name, weight in self.recipe.weights.items()]
        ).sum()
        yield "network", total, {name: value.detach() for name, value in parts.items()}
        self.averaged.update_parameters(self.modules["network"])

    @property
    def network(self) -> Any:
        """The averaged network, to be used."""
        return self.averaged.module.eval()

    @property
    def _next_validation(self) -> int:
        return min(self.steps_done + self.interval_steps, self.total_steps)

    def rate(self, number: int) -> float:
        return self.recipe.rate_at(self.steps_done + number)

    def batches(self) -> Iterator[Batch]:
        """The batches up to the next validation: each is a function of seed and step alone, made
        one step ahead."""
        first, last, recipe = self.steps_done, self._next_validation, self.recipe

        def make(step: int) -> Batch:
            random = np.random.default_rng([recipe.seed, step])
            return batch_of([self.task.draw(self.samples, random) for _ in range(recipe.batch)])

        with ThreadPoolExecutor(1) as pool:
            coming = pool.submit(make, first)
            for step in range(first, last):
                batch = coming.result()
                if step + 1 < last:
                    coming = pool.submit(make, step + 1)
                yield batch

    def diverged(self, name: str, value: float, number: int) -> str:
        return (
            f"the loss is {value} at step {self.steps_done + number + 1}; lower the rate and start "
            f"again"
        )

    def validated(self, losses: dict[str, float], began: float) -> Record:
        seconds, steps = perf_counter() - began, self._next_validation
        record: Record = {"step": steps, "rate": self.recipe.rate_at(steps - 1), "seconds": seconds}
        record |= {f"loss_{name}": value for name, value in losses.items()}
        record |= self.task.scores(self.network, self.scored)
        if self.show:
            print("  ".join(f"{key} {value:.4g}" for key, value in record.items()))
        return record

    def progress(self) -> str:
        shown = self.recipe.main_loss
        return (
            f"step {self.steps_done}/{self.recipe.steps}  {shown} "
            f"{self.history[-1][f'loss_{shown}']:.4g}"
        )

    def panels(self) -> list[Panel]:
        def panel(title: str, labels: dict[str, str], log: bool = False) -> Panel:
            return Panel.of(title, self.history, "step", labels, log)

        shown = {
            f"loss_{name}": name for name in self.recipe.weights if name != "scale"
        }  # a log-likelihood
        scores = [panel(title, labels) for title, labels in self.recipe.scores.items()]
        return [panel("training losses", shown, log=True), *scores]


class Task(ABC, Generic[SampleT]):
    """What a network learns from rendered views: samples of the views, windows of the samples, and
    what is chosen on validation samples, of which every ``scored_share``-th is scored during
    training."""

    recipe: Any
    scored_share: ClassVar[int] = 3

    @abstractmethod
    def measured(
        self, groups: list[Group], rig: Rig, folder: Path, workers: int, show: bool
    ) -> tuple[list[SampleT], list[SampleT]]:
        """Training and validation samples of views, which are rendered where ``folder`` does not
        hold them yet: of ``groups`` by ``rig``."""

    @abstractmethod
    def draw(self, samples: list[SampleT], random: np.random.Generator) -> Window:
        """A random window of one of ``samples``, varied."""

    @abstractmethod
    def scores(self, network: Any, samples: list[SampleT]) -> dict[str, float]:
        """Mean scores of a network."""

    @abstractmethod
    def chosen(
        self, network: Any, samples: list[SampleT], validation: list[SampleT], out: Path
    ) -> dict[str, Any]:
        """The fields of `training.NetConfig` that are chosen on the validation samples for the
        trained network, and its scores there; pictures of that go to ``out``."""


class ViewTask(Task[Sample]):
    """That of one rig. ``frames``: those it takes, and behind them what the steps of the directions
    ``decoded`` tell."""

    frames: tuple[int, ...]
    decoded: tuple[Direction, ...] = ()

    def measured(
        self, groups: list[Group], rig: Rig, folder: Path, workers: int, show: bool
    ) -> tuple[list[Sample], list[Sample]]:
        render_views(groups, rig, self.frames, folder, workers, show, self.decoded)
        count = sum(len(group.views) for group in groups)
        with Display("measuring views", count, show) as display:

            def of_split(split: str, unions: int) -> list[Sample]:
                views, done = read_views(folder, groups, split), int(display.tasks[0].completed)
                followed = display.track(views, completed=done, task_id=display.bar)
                return self.samples(with_unions(followed, unions, self.recipe.seed))

            return of_split("train", self.recipe.unions), of_split("validation", 0)

    @abstractmethod
    def samples(self, views: Iterable[View]) -> list[Sample]:
        """The samples of views; a view that can't be used has none."""


class CandidateTask(ViewTask):
    """That of a `PhaseNet`. ``thresholds`` of the mask's logit and ``leads`` of the base order are
    tried on the validation samples, thresholds also on every ``chosen_share``-th training sample;
    sums of errors ``tolerance_mm`` from the least count as equal, and for fewer missed pixels the
    background error may grow by ``growth``. An order is wrong where the phase is more than
    ``wrong_rad`` off."""

    thresholds: ClassVar[tuple[float, ...]]
    leads: ClassVar[tuple[float, ...]]
    tolerance_mm: ClassVar[float] = 0.0
    growth: ClassVar[float] = 1.0
    chosen_share: ClassVar[int | None] = None
    wrong_rad: ClassVar[float]

    def __init__(self, recipe: "WindowRecipe", rig: Rig) -> None:
        self.recipe, self.image_px = recipe, rig.camera.width * rig.camera.height

    @abstractmethod
    def varied(
        self, sample: Sample, scene: Any, missing: Image, random: np.random.Generator, *truth: Mask
    ) -> Window:
        """The training example of a window's ``scene``, varied; ``missing`` and ``truth``, target
        and void, of the sample there."""

    @abstractmethod
    def answers(self, network: PhaseNet, sample: Sample) -> Answers:
        """The network's answers for a sample."""

    @abstractmethod
    def changes_rad(self, answers: Answers, sample: Sample) -> Image:
        """By how much the answers change the phase of a sample's scene: each pixel's likeliest
        order is taken."""

    @abstractmethod
    def depth_mm(self, sample: Sample, change_rad: Image) -> NDArray:
        """Depth with the phase of a sample's scene changed."""

    def draw(self, samples: list[Sample], random: np.random.Generator) -> Window:
        sample = samples[random.integers(len(samples))]
        size = self.recipe.window
        where = sample.place(size, self.recipe.vary.near_edge, random)
        scene, missing = (
            sample.scene.window(*where).single(),
            sample.missing[where].astype(np.float32),
        )
        return self.varied(sample, scene, missing, random, sample.target[where], sample.void[where])

    def score(self, answers: Answers, sample: Sample, inside: Mask) -> dict[str, float | None]:
        """`view_scores` of a sample whose pixels ``inside`` are object. ``right_mae_mm``: MAE of
        detected pixels with the right order; ``wrong_percent`` of the object's pixels;
        ``within_percent``: errors of the phase within the stated standard uncertainty, 68 of a
        normal distribution. Where no order is right, it and ``right_mae_mm`` are None."""
        target, change = sample.target, self.changes_rad(answers, sample)
        found, true = (self.depth_mm(sample, rad) for rad in (change, sample.missing))
        apart = np.abs(change - sample.missing)
        wrong = apart > self.wrong_rad
        right = target & inside & ~wrong
        error = np.minimum(np.abs(np.nan_to_num(found) - true), true)[right]
        return view_scores(sample, inside, found, true) | {
            "right_mae_mm": float(error.mean(dtype=np.float64)) if right.any() else None,
            "wrong_percent": 100 * float(wrong[target].mean()),
            "within_percent": 100 * float((apart < answers.sigma_rad)[right].mean())
            if right.any()
            else None,
        }

    def scores_of(
        self, answers: Iterable[Answers], samples: list[Sample], threshold: float = 0.0
    ) -> dict[str, float]:
        """Means of each `score` over the samples that have it."""
        return mean_scores(
            self.score(one, sample, decided_mask(one, sample.scene.single(), threshold))
            for one, sample in zip(answers, samples, strict=True)
        )

    def scores(self, network: PhaseNet, samples: list[Sample]) -> dict[str, float]:
        return self.scores_of((self.answers(network, sample) for sample in samples), samples)

    def chosen(
        self, network: PhaseNet, samples: list[Sample], validation: list[Sample], out: Path
    ) -> dict[str, Any]:
        """Threshold, and the lead by which the fewest orders are wrong."""
        answers = [self.answers(network, sample) for sample in validation]
        further = samples[:: self.chosen_share] if self.chosen_share else []
        masked = answers + [self.answers(network, sample) for sample in further]
        masks = [
            (sample, partial(decided_mask, one, sample.scene.single()))
            for one, sample in zip(masked, validation + further, strict=True)
        ]
        threshold = chosen_threshold(
            masks, self.thresholds, self.image_px, self.tolerance_mm, self.growth
        )
        with_leads = ([one.with_lead(lead) for one in answers] for lead in self.leads)
        wrong = [self.scores_of(shifted, validation)["wrong_percent"] for shifted in with_leads]
        lead = self.leads[int(np.argmin(wrong))]
        shifted = [one.with_lead(lead) for one in answers]
        validated = self.scores_of(shifted, validation, threshold)
        fields = {"threshold": threshold, "lead": lead, "validation": validated}
        self.calibrated(fields, shifted, validation, out)
        return fields

    @abstractmethod
    def calibrated(
        self, fields: dict[str, Any], answers: list[Answers], validation: list[Sample], out: Path
    ) -> None:
        """Add the other ``fields``, from the ``answers`` with the lead that was chosen."""


@dataclass(frozen=True)
class Trained:
    """The weights file (None for a training that stopped because its minutes were over), validation
    scores, and the mask threshold that was chosen there."""

    weights: Path | None
    steps: int
    threshold: float
    validation: dict[str, float]


def train_net(
    recipe: StepRecipe,
    out: Path,
    *,
    rig: Rig | None = None,
    start: Path | None = None,
    minutes: float | None = None,
    workers: int = 1,
    show: bool = False,
) -> Trained:
    """Train for ``rig`` (default: that of the recipe), starting from the weights in ``start`` or
    from random ones; the same call resumes a training that was stopped. ``show``: progress on
    stderr, and a line for every validation. Raises `TrainingError` for a folder of another recipe
    or rig."""
    started, rig = perf_counter(), rig or NAMED_RIGS[recipe.rig]()
    groups = groups_of(
        recipe.lights,
        recipe.views_a_light,
        recipe.seed,
        recipe.textured_every,
        recipe.validation_lights,
    )
    first = None if start is None else load_net(start, folded=False)
    described = recipe.to_dict() | {"rig": rig.to_dict()}
    described |= {} if first is None else {"start_sha256": first.sha256}
    fingerprint = fingerprint_of(described, groups)
    with alone_in(out):
        claim_folder(out, {"recipe": described, "dataset_fingerprint": fingerprint})
        weights = out / f"{recipe.weights_name}.safetensors"
        if not weights.exists():
            task = recipe.task(rig)
            samples, validation = task.measured(groups, rig, out / VIEWS, workers, show)
            with reproducible(cpu=True):
                start_network = None if first is None else first.network
                scored = validation[:: task.scored_share]
                ongoing = WindowTraining(task, samples, scored, out, start_network, show)
                ongoing.run(started, minutes, show)
                if not ongoing.over:
                    return Trained(None, ongoing.steps_done, 0.0, {})
                network = ongoing.network
                fields = task.chosen(network, samples, validation, out)
            trained = NetConfig(
                name=recipe.weights_name,
                title=recipe.title,
                options=network.options,
                dataset_fingerprint=fingerprint,
                benchmark=TrainingBenchmark(f"{recipe.name} views", 1),
                steps=recipe.steps,
                recipe=described,
                **fields,
            )
            save_weights(weights, network, trained, family=recipe.family)
            (out / CHECKPOINT).unlink(missing_ok=True)
        config = open_weights(weights, recipe.family).config
        scores = {key: float(value or 0) for key, value in config.validation.items()}
        return Trained(weights, config.steps, config.threshold, scores)
