"""The training loop of all recipes, on one processor or many, on the devices that `accelerate` finds.

    accelerate launch ...   several GPUs or machines; a batch of the recipe is then that of one process

A training folder holds, after every epoch, all that is needed to resume: ``checkpoint.safetensors`` (everything),
``weights.safetensors`` (the epoch of the lowest validation loss), ``log.jsonl``, ``recipe.json``; at the end also
``curve.png`` and ``done.json``. On one processor type and number of threads, the same recipe and data give the same
bits on the CPU, stopped and resumed or not.

The recipe is the paper's (Section 5.3): the rate falls on a plateau of the validation loss, training ends when it has
reached its minimum, and the weights kept are those of the lowest validation loss. A validation loss is the mean over
samples of each sample's own loss, and the scores beside it are the evaluator's (`training.validation`).
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from accelerate import Accelerator, PartialState
from accelerate.utils import broadcast_object_list, gather_object, set_seed
from torch import Tensor
from torch.optim import RMSprop
from torch.utils.data import DataLoader

from fpp_ml_bench.baselines.training import environment, history
from fpp_ml_bench.baselines.training.checkpoint import (
    optimizer_tensors,
    read_checkpoint,
    restore_optimizer,
    save_checkpoint,
)
from fpp_ml_bench.baselines.training.display import Display
from fpp_ml_bench.baselines.training.objectives import Objective
from fpp_ml_bench.baselines.training.pairs import EpochSampler, training_loader
from fpp_ml_bench.baselines.training.recipe import Recipe
from fpp_ml_bench.baselines.training.schedules import Schedule
from fpp_ml_bench.baselines.training.setup import model_config, objective_of, open_data
from fpp_ml_bench.baselines.training.validation import validate
from fpp_ml_bench.baselines.training.weights import save_weights
from fpp_ml_bench.errors import TrainingError
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.loaders.training import FringeDepth, FringeDepthDataset

CHECKPOINT, WEIGHTS, RECIPE, DONE = "checkpoint.safetensors", "weights.safetensors", "recipe.json", "done.json"
CHECK_EVERY = 16
"""Steps between two checks of the losses: reading a loss makes a GPU wait."""
DIVERGED = 1e6
"""Multiple of the first loss from which on a training counts as diverged."""


@dataclass(frozen=True)
class TrainingRun:
    """Files and epochs of a training; ``finished`` is False when its minutes ran out: call `train` again to resume."""

    weights: Path
    epochs: int
    best_epoch: int
    seconds: float
    finished: bool
    log: Path
    curve: Path


def train(
    recipe: Recipe, dataset: str | Path, out: str | Path, *, minutes: float | None = None, show: bool = True
) -> TrainingRun:
    """Train ``recipe`` on a dataset folder into ``out``, from the checkpoint there; returns at once if it is finished.

    ``minutes``: stop, with everything saved, before an epoch that would outlast them; one epoch is always
    trained. ``show``: progress on stderr.

    Raises `TrainingError` for a folder of another recipe or dataset, a damaged checkpoint, a dataset of another image
    size, a loss that is not finite or has diverged (the batch's samples are named); what else recipe, dataset or
    network refuse comes as their own error.
    """
    out = Path(out)
    started = perf_counter()
    training, validation = open_data(recipe, Path(dataset))
    _claim(out, recipe, training)
    finished = _finished(out)
    if finished is not None:
        return finished
    with environment.reproducible(recipe):
        return _Training(recipe, training, validation, out).run(started, minutes, show)


class _Training:
    """The state of one training and its loop."""

    def __init__(self, recipe: Recipe, training: FringeDepthDataset, validation: FringeDepthDataset, out: Path) -> None:
        self.recipe, self.out, self.training, self.validation = recipe, out, training, validation
        precision = "no" if recipe.precision == "fp32" else recipe.precision
        self.accelerator = Accelerator(mixed_precision=precision, gradient_accumulation_steps=1)
        on_gpu = self.accelerator.device.type == "cuda"
        set_seed(recipe.seed)
        self.objective: Objective = objective_of(recipe)
        # The networks themselves, whatever compiles or distributes them: they are validated, saved and restored.
        self.bare = dict(self.objective.modules)
        if on_gpu:
            for module in self.objective.modules.values():
                module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        if on_gpu and recipe.compile:
            self.objective.modules = {name: torch.compile(m) for name, m in self.objective.modules.items()}  # type: ignore[misc]
        rule = recipe.optimizer
        self.optimizers = {
            name: RMSprop(module.parameters(), rule.learning_rate, alpha=rule.alpha, weight_decay=rule.weight_decay)
            for name, module in self.objective.modules.items()
        }
        self.schedule = Schedule(recipe.schedule, rule.learning_rate)
        self.sampler = EpochSampler(len(training), recipe.pairs_per_epoch, recipe.seed)
        loader = training_loader(training, self.sampler, recipe.batch, pin=on_gpu)
        self.loader: DataLoader = self.accelerator.prepare(loader)
        for name in self.objective.modules:
            self.objective.modules[name], self.optimizers[name] = self.accelerator.prepare(
                self.objective.modules[name], self.optimizers[name]
            )
        self.history: list[history.Record] = []
        self.first_loss: float | None = None
        self.before = 0.0  # seconds of earlier calls
        if (out / CHECKPOINT).exists():
            self._resume()
        if len(set(gather_object([self.epoch]))) > 1:
            raise TrainingError(f"{out}: processes found different checkpoints; give a folder that all machines share")

    @property
    def epoch(self) -> int:
        """Epochs done."""
        return len(self.history)

    @property
    def best(self) -> history.Record:
        return min(self.history, key=lambda record: record["validation_loss"])

    @property
    def over(self) -> bool:
        return self.epoch >= self.recipe.max_epochs or (self.epoch > 0 and self.schedule.finished)

    def run(self, started: float, minutes: float | None, show: bool) -> TrainingRun:
        with Display(self.recipe, len(self.loader), show and self.accelerator.is_main_process) as display:
            for record in self.history:
                display.epoch_done(record)
            last_epoch_s = 0.0
            while not self.over and self._agreed(last_epoch_s == 0 or _fits(started, last_epoch_s, minutes)):
                epoch_started = perf_counter()
                losses = self._train_epoch(display)
                self._finish_epoch(losses, epoch_started)
                display.epoch_done(self.history[-1])
                last_epoch_s = perf_counter() - epoch_started
        seconds = round(self.before + perf_counter() - started, 1)
        if self.accelerator.is_main_process:
            history.write_log(self.out, self.history)
            history.draw_curve(self.out, self.history, self.recipe.title)
            if self.over:
                summary = {"epochs": self.epoch, "best_epoch": self.best["epoch"], "seconds": seconds}
                write_atomically(self.out / DONE, json.dumps(summary).encode())
        self.accelerator.wait_for_everyone()
        best = self.best["epoch"] if self.history else 0
        return _run(self.out, self.epoch, best, seconds, self.over)

    def _agreed(self, next_epoch: bool) -> bool:
        """Whether the first process trains a next epoch: clocks differ, and all processes must train the same ones."""
        return bool(broadcast_object_list([next_epoch])[0])

    def _train_epoch(self, display: Display) -> dict[str, float]:
        """One pass; the mean over batches of everything the objective logs."""
        recipe = self.recipe
        # What is drawn within an epoch (DropPath) depends on the epoch alone: a resumed training draws the same.
        set_seed((recipe.seed + 1_000_003 * (self.epoch + 1) + self.accelerator.process_index) % 2**32)
        self.sampler.epoch = self.epoch
        for module in self.objective.modules.values():
            module.train()
        for optimizer in self.optimizers.values():
            for group in optimizer.param_groups:
                group["lr"] = self.schedule.rate
        unchecked: list[tuple[int, Tensor, dict[str, Tensor]]] = []
        sums: dict[str, float] = {}
        batches = 0
        for batch in self.loader:
            unchecked.append((batches, batch.row, self._step(batch)))
            batches += 1
            if len(unchecked) == CHECK_EVERY:
                self._check_losses(unchecked, sums)
            display.step()
        self._check_losses(unchecked, sums)
        return {name: value / batches for name, value in sums.items()}

    def _step(self, batch: FringeDepth) -> dict[str, Tensor]:
        logged: dict[str, Tensor] = {}
        with self.accelerator.autocast():
            steps = self.objective.steps(batch)
            for name, loss, values in steps:
                optimizer = self.optimizers[name]
                optimizer.zero_grad(set_to_none=True)
                self.accelerator.backward(loss)
                optimizer.step()
                logged |= values
        return logged

    def _check_losses(self, unchecked: list[tuple[int, Tensor, dict[str, Tensor]]], sums: dict[str, float]) -> None:
        """Add the losses of the last steps to ``sums``; raise for a loss that is not finite or has diverged."""
        for number, rows, logged in unchecked:
            for name, value in logged.items():
                loss_value = float(value)
                if name == "loss" and self.first_loss is None and math.isfinite(loss_value):
                    self.first_loss = max(loss_value, 1e-6)
                limit = DIVERGED * (self.first_loss or math.inf)
                if not math.isfinite(loss_value) or (name == "loss" and loss_value > limit):
                    fault = "is not finite" if not math.isfinite(loss_value) else f"is {DIVERGED:g} times the first one"
                    samples = sorted({self.training.samples[row] for row in rows.tolist()})
                    raise TrainingError(
                        f"{self.out}: training diverged: {name} {fault} ({loss_value:.4g}) in epoch {self.epoch + 1}, "
                        f"batch {number + 1}, samples {', '.join(samples)}. The last good state is kept "
                        f"({self.epoch} epochs); lower the learning rate, or look at those samples (fpp-bench show)"
                    )
                sums[name] = sums.get(name, 0.0) + loss_value
        unchecked.clear()

    def _finish_epoch(self, losses: dict[str, float], epoch_started: float) -> None:
        """Validate, set the rate of the next epoch, keep the best weights, save everything."""
        network = self.bare["network"]
        scores = validate(network, self.objective, self.validation, self.recipe, self.accelerator, self.out)
        self._check_validation(scores["validation_loss"])
        rate = self.schedule.rate
        loss = losses.pop("loss")
        record = {
            "epoch": self.epoch + 1, "learning_rate": rate, "training_loss": loss, **scores, **losses,
            "seconds": round(perf_counter() - epoch_started, 3),
        }  # fmt: skip
        improved = not self.history or record["validation_loss"] < self.best["validation_loss"]
        self.history.append(record)
        self.schedule.step(record["validation_loss"])
        if self.accelerator.is_main_process:
            if improved:
                self._keep_weights(record)
            self._save()
            history.write_log(self.out, self.history)
        self.accelerator.wait_for_everyone()

    def _check_validation(self, loss: float | None) -> None:
        limit = DIVERGED * (self.first_loss or math.inf)
        if loss is None or not math.isfinite(loss) or loss > limit:
            raise TrainingError(
                f"{self.out}: training diverged: the validation loss after epoch {self.epoch + 1} is {loss}. The last "
                f"good state is kept ({self.epoch} epochs); lower the learning rate"
            )

    def _keep_weights(self, record: history.Record) -> None:
        network = self.bare["network"]
        scores = {key: value for key, value in record.items() if key.endswith("_mm") or key == "validation_loss"}
        config = model_config(self.recipe, network, self.training.source.fingerprint, record["epoch"], scores)
        save_weights(self.out / WEIGHTS, network, config)

    def _save(self) -> None:
        tensors: dict[str, Tensor] = {}
        for name, bare in self.bare.items():
            tensors |= {f"module.{name}.{key}": value for key, value in bare.state_dict().items()}
            tensors |= optimizer_tensors(self.optimizers[name], f"optimizer.{name}")
        seconds = self.before + sum(record["seconds"] for record in self.history[self.resumed_at :])
        state: dict[str, Any] = {
            "recipe": self.recipe.digest, "fingerprint": self.training.source.fingerprint, "history": self.history,
            "schedule": self.schedule.state(), "first_loss": self.first_loss, "seconds": seconds,
        }  # fmt: skip
        save_checkpoint(self.out / CHECKPOINT, tensors, state)

    resumed_at = 0

    def _resume(self) -> None:
        tensors, state = read_checkpoint(self.out / CHECKPOINT)
        if (state["recipe"], state["fingerprint"]) != (self.recipe.digest, self.training.source.fingerprint):
            raise TrainingError(f"{self.out / CHECKPOINT}: belongs to another recipe or dataset; give a new folder")
        for name, bare in self.bare.items():
            prefix = f"module.{name}."
            bare.load_state_dict({k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)})
            restore_optimizer(self.optimizers[name], tensors, f"optimizer.{name}")
        self.schedule.restore(state["schedule"])
        self.history, self.first_loss, self.before = state["history"], state["first_loss"], state["seconds"]
        self.resumed_at = len(self.history)


def _fits(started: float, last_epoch_s: float, minutes: float | None) -> bool:
    """Whether another epoch like the last one ends in time."""
    return minutes is None or perf_counter() - started + last_epoch_s < 60 * minutes


def _claim(out: Path, recipe: Recipe, data: FringeDepthDataset) -> None:
    """Make ``out`` this recipe's folder, or see that it is. One process of a machine first, then the others."""
    with PartialState().local_main_process_first():
        _claim_or_check(out, recipe, data)


def _claim_or_check(out: Path, recipe: Recipe, data: FringeDepthDataset) -> None:
    path = out / RECIPE
    own_recipe = recipe.to_dict()
    content = {"recipe": own_recipe, "fingerprint": data.source.fingerprint}
    try:
        out.mkdir(parents=True, exist_ok=True)
        existing = json.loads(path.read_text(encoding="utf-8")) if path.exists() else None
    except (OSError, ValueError) as error:
        raise TrainingError(f"{out}: expected a training folder, or a new one ({error})") from None
    if existing is None:
        # A process that was killed while it wrote the recipe leaves a hidden temporary file.
        if any(not path.name.startswith(f".{RECIPE}.") for path in out.iterdir()):
            raise TrainingError(f"{out}: holds files but no {RECIPE}; give a new or empty folder")
        write_atomically(path, (json.dumps(content, indent=1) + "\n").encode("utf-8"))
    elif existing != content:
        existing_recipe = existing.get("recipe", {}) if isinstance(existing, dict) else {}
        differs = [key for key, value in own_recipe.items() if existing_recipe.get(key) != value] or ["dataset"]
        raise TrainingError(
            f"{path}: was made for another training, which differs in {', '.join(differs)}; give another folder, or "
            f"remove {out} to train again from the start"
        )


def _finished(out: Path) -> TrainingRun | None:
    path = out / DONE
    if not path.exists() or not (out / WEIGHTS).exists():
        return None
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
        return _run(out, summary["epochs"], summary["best_epoch"], summary["seconds"], True)
    except (OSError, ValueError, KeyError, TypeError):
        raise TrainingError(f"{path}: is damaged; delete it, and the training resumes from its checkpoint") from None


def _run(out: Path, epochs: int, best: int, seconds: float, finished: bool) -> TrainingRun:
    return TrainingRun(out / WEIGHTS, epochs, best, seconds, finished, out / history.LOG_FILE, out / history.CURVE_FILE)
