"""Training a network on windows of images: four losses, a moving average of the weights, resumable."""

import hashlib
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from fpp_ml_bench.baselines import training
from fpp_ml_bench.baselines.phase_network.inputs import CHANNELS
from fpp_ml_bench.baselines.phase_network.network import PhaseNet
from fpp_ml_bench.baselines.phase_network.windows import IGNORED
from fpp_ml_bench.baselines.training import Panel, Record
from fpp_ml_bench.errors import RecipeError, TrainingError

SMALL_RAD = 0.05  # error of the phase below which its loss is quadratic
IMPOSSIBLE = -1e4  # logit of an order that puts its pixel out of the working range: finite, for gradients to stay so
LARGEST_GRADIENT = 50.0


@dataclass(frozen=True)
class StepRecipe(ABC):
    """``steps`` of ``batch`` windows of ``window`` px; AdamW at ``rate``, after ``warm_up`` steps falling as a cosine;
    ``averaged``: decay of the moving average of the weights, which is what the weights file holds; ``lights`` that are
    drawn, ``views_a_light`` of training objects in each, and ``unions`` for every view (see `training.groups_of`). A
    subclass says which network learns what. Raises `RecipeError` for values that train nothing."""

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

    main_loss: ClassVar[str]
    """Which is shown while it trains."""
    scores: ClassVar[dict[str, dict[str, str]]]
    """What its curve shows beside the losses: titles, and scores with their labels."""

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "window", "validate_every"):
            if not getattr(self, name) >= 1:
                raise RecipeError(f"{name} {getattr(self, name)!r}: expected 1 or more")
        if not self.rate > 0 or not 0 <= self.averaged < 1:
            raise RecipeError(f"expected rate above 0 and averaged 0 to below 1, got {self.rate} and {self.averaged}")
        if not (self.lights >= 0 and 1 <= self.views_a_light <= 40 and 0 <= self.unions <= 100):
            raise RecipeError(
                f"lights {self.lights!r}, views_a_light {self.views_a_light!r}, unions {self.unions!r}: expected 0 and "
                "more, 1 to 40, 0 to 100"
            )

    @property
    @abstractmethod
    def weights(self) -> dict[str, float]:
        """Of the losses, by name."""

    @abstractmethod
    def network(self) -> nn.Module:
        """The network, untrained."""

    @abstractmethod
    def losses(self, network: nn.Module, batch: "Batch") -> dict[str, Tensor]:
        """Of ``network`` on a batch, by the names of `weights`."""

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


@dataclass(frozen=True)
class WindowRecipe(StepRecipe):
    """Of a `PhaseNet`: ``widths`` to ``bound_rad`` make the network; ``weight_*``: of the losses, ``weight_scale`` that
    of the stated uncertainty."""

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

    main_loss: ClassVar[str] = "phase"
    scores: ClassVar[dict[str, dict[str, str]]] = {
        "validation MAE, mm": {"object_mae_mm": "object", "right_mae_mm": "right order"},
        "validation, % of object pixels": {"wrong_percent": "wrong order", "missed_percent": "missed"},
    }

    @property
    def weights(self) -> dict[str, float]:
        weights = {"order": self.weight_order, "mask": self.weight_mask, "phase": self.weight_phase}
        return weights | {"scale": self.weight_scale}

    @property
    def channels(self) -> int:
        """Input maps of the network."""
        return len(CHANNELS)

    def network(self) -> PhaseNet:
        return PhaseNet(
            self.widths, self.fine, self.squeezed, self.order_widths, self.bound_rad, self.channels, uncertain=True
        )

    def losses(self, network: nn.Module, batch: "Batch") -> dict[str, Tensor]:
        return losses(network, batch, self.bound_rad)


Batch = dict[str, Tensor]  # the fields of a window with a leading axis B


def batch_of(windows: Sequence[Any]) -> Batch:
    fields = windows[0].__dataclass_fields__
    batch = {name: torch.from_numpy(np.stack([getattr(window, name) for window in windows])) for name in fields}
    batch["x"] = batch["x"].contiguous(memory_format=torch.channels_last)
    return batch


def losses(network: torch.nn.Module, batch: Batch, bound_rad: float) -> dict[str, Tensor]:
    """``order``: cross-entropy over the candidates; ``mask``: binary cross-entropy; ``phase``: smooth L1 in rad;
    ``scale``: negative log-likelihood of its phase error under a Laplace distribution."""
    order, inside, correction, scale = network(batch["x"])
    logits = torch.where(batch["exists"], order, torch.tensor(IMPOSSIBLE))
    pixels = batch["fitted"].sum().clamp(min=1)
    by_order = functional.cross_entropy(logits, batch["order"], ignore_index=IGNORED, reduction="sum") / pixels
    by_pixel = functional.binary_cross_entropy_with_logits(inside, batch["target"].float(), reduction="none")
    by_mask = (by_pixel * batch["mask_valid"]).sum() / batch["mask_valid"].sum().clamp(min=1)
    target_rad = batch["correction_rad"].clamp(-bound_rad, bound_rad)
    by_phase = functional.smooth_l1_loss(correction, target_rad, beta=SMALL_RAD, reduction="none")
    error = (correction.detach() - batch["correction_rad"]).abs()
    by_scale = ((error * torch.exp(-scale) + scale) * batch["fitted"]).sum() / pixels
    phase = (by_phase * batch["fitted"]).sum() / pixels
    return {"order": by_order, "mask": by_mask, "phase": phase, "scale": by_scale}


class WindowObjective:
    """The weighted losses of a recipe's network, and the moving average of its weights, updated after every step."""

    def __init__(self, network: nn.Module, recipe: StepRecipe) -> None:
        self.modules: dict[str, nn.Module] = {"network": network}
        self.recipe, self.weights = recipe, recipe.weights
        self.averaged = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(recipe.averaged), use_buffers=True)

    def steps(self, batch: Batch) -> Iterator[tuple[str, Tensor, dict[str, Tensor]]]:
        parts = self.recipe.losses(self.modules["network"], batch)
        total = torch.stack([self.weights[name] * parts[name] for name in self.weights]).sum()
        yield "network", total, {name: value.detach() for name, value in parts.items()}
        self.averaged.update_parameters(self.modules["network"])


class WindowTraining(training.Training):
    """Training in intervals between two validations, on the processor. ``draw`` gives a random window, a dataclass of
    arrays with the network's input ``x``; ``validate``: scores of a network, those of ``recipe.scores`` among them, or
    nothing. ``start``: the network whose weights it starts from (None: random ones). ``print_line`` is given a line for
    every new record. Raises `TrainingError` where ``start`` is another network than the recipe's, and for a checkpoint
    of another recipe."""

    largest_gradient = LARGEST_GRADIENT

    def __init__(
        self,
        recipe: StepRecipe,
        draw: Callable[[np.random.Generator], Any],
        validate: Callable[[Any], dict[str, float]],
        out: Path,
        start: PhaseNet | None = None,
        print_line: Callable[[str], None] = lambda line: None,
    ) -> None:
        super().__init__(out, {"recipe": recipe.digest}, recipe.seed, cpu=True)
        self.recipe, self.draw, self.validate, self.print_line = recipe, draw, validate, print_line
        self.name = self.title = recipe.name
        network = recipe.network()
        network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        if start is not None:
            start = start.stating_scale()
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
    def network(self) -> Any:
        """The averaged network, to be used."""
        return self.windows.averaged.module.eval()

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
            return batch_of([self.draw(random) for _ in range(recipe.batch)])

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
        return record | self.validate(self.network)

    def recorded(self, record: Record) -> None:
        self.print_line("  ".join(f"{key} {value:.4g}" for key, value in record.items()))

    def progress(self) -> str:
        shown = self.recipe.main_loss
        return f"step {self.steps_done}/{self.recipe.steps}  {shown} {self.history[-1][f'loss_{shown}']:.4g}"

    def panels(self) -> list[Panel]:
        def panel(title: str, labels: dict[str, str], log: bool = False) -> Panel:
            return Panel.of(title, self.history, "step", labels, log)

        shown = {f"loss_{name}": name for name in self.recipe.weights if name != "scale"}  # a log-likelihood
        scores = [panel(title, labels) for title, labels in self.recipe.scores.items()]
        return [panel("training losses", shown, log=True), *scores]
