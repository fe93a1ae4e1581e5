"""Training a network from a fringe image to depth by a recipe (paper Section 5.3), from dataset to
weights file.

The weights kept are those of the lowest validation loss, the mean over samples of each one's own;
the scores beside it are the evaluator's, under individual normalisation with the sample's range, as
on the leaderboard. Beside the engine's files a folder holds ``weights.safetensors`` and, at the
end, ``done.json``.

The order of an epoch depends on the seed and its number alone, so that a resumed training gives the
same result as one that never stopped.
"""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from accelerate import PartialState
from accelerate.utils import gather_object, set_seed
from torch import Tensor, nn
from torch.optim import RMSprop

from fpp_ml_bench.baselines.networks.base import trains_channels_last
from fpp_ml_bench.baselines.networks.model import build as build_network
from fpp_ml_bench.baselines.networks.model import discriminator
from fpp_ml_bench.baselines.networks.unet import re_projection_loss
from fpp_ml_bench.baselines.phase.geometry import CalibrationLayer
from fpp_ml_bench.baselines.training.engine import (
    CURVE_FILE,
    DIVERGED,
    LOG_FILE,
    Panel,
    Record,
    Training,
    alone_in,
    claim_folder,
    reproducible,
)
from fpp_ml_bench.baselines.training.losses import Adversarial, AdversarialSettings, Regression
from fpp_ml_bench.baselines.training.recipe import GAN, Linear, Plateau, Recipe
from fpp_ml_bench.baselines.training.weights import ModelConfig, save_weights, training_benchmark
from fpp_ml_bench.constants import GOLDEN, MM_PER_M, SPLITS, split_sample_name
from fpp_ml_bench.depth import Normalisation
from fpp_ml_bench.errors import TrainingError
from fpp_ml_bench.evaluation.protocol import Mode, Units
from fpp_ml_bench.evaluation.score.check import scored_pair
from fpp_ml_bench.evaluation.score.torch_metric import DepthScores
from fpp_ml_bench.files import read_json, write_atomically
from fpp_ml_bench.loaders.storage.store import ALL_SPLITS, DatasetFolder
from fpp_ml_bench.loaders.training import FringeDepth, FringeDepthDataset

WEIGHTS, DONE = "weights.safetensors", "done.json"
SCORING: dict[Normalisation, tuple[Units, Mode]] = {
    "raw": ("mm", "standard"),
    "global": ("m", "standard"),
    "individual": ("normalised", "paper"),
}
"""How a network's output is scored: its unit, and the evaluator's mode."""
LOGGED = ("object_mae_mm", "background_mae_mm", "overall_mae_mm")
LEAST_GAIN = 1e-4
"""Share by which a loss must be below the best one to count as lower."""
_RELATIVE = 1e-9
"""1e-4 x 0.1 x 0.1 is 1.0000000000000002e-06: a rate this near to its minimum has reached it."""


@dataclass(frozen=True)
class TrainingRun:
    """Epochs of the training in the folder ``out``, and its files; ``finished`` is False when its
    minutes ran out: call `train` again to resume."""

    out: Path
    epochs: int
    best_epoch: int
    seconds: float
    finished: bool = True

    @property
    def weights(self) -> Path:
        return self.out / WEIGHTS

    @property
    def log(self) -> Path:
        return self.out / LOG_FILE

    @property
    def curve(self) -> Path:
        return self.out / CURVE_FILE


def train(
    recipe: Recipe,
    dataset: str | Path,
    out: str | Path,
    *,
    minutes: float | None = None,
    show: bool = True,
) -> TrainingRun:
    """Train ``recipe`` on a dataset folder into ``out``, from the checkpoint there; returns at once
    if it is finished. ``minutes``: stop, with everything saved, before an epoch that would outlast
    them; one is always trained. ``show``: progress on stderr. Raises `TrainingError` for a folder
    of another recipe or dataset, a damaged checkpoint, a dataset of another image size, a loss that
    is not finite or has diverged (the batch's samples are named)."""
    out, started = Path(out), perf_counter()
    data, validation = open_data(recipe, Path(dataset))
    state = PartialState()
    with alone_in(out) if state.is_main_process else nullcontext():
        with state.local_main_process_first():
            claim_folder(out, {"recipe": recipe.to_dict(), "fingerprint": data.source.fingerprint})
        if (finished := finished_run(out)) is not None:
            return finished
        with reproducible(recipe.precision):
            training = DepthTraining(recipe, data, validation, out)
            seconds = training.run(started, minutes, show)
            best = training.best["epoch"] if training.history else 0
            run = TrainingRun(out, training.epoch, best, seconds, training.over)
            if run.finished and training.accelerator.is_main_process:
                summary = {"epochs": run.epochs, "best_epoch": best, "seconds": seconds}
                write_atomically(out / DONE, json.dumps(summary).encode())
            training.accelerator.wait_for_everyone()
            return run


def finished_run(out: Path) -> TrainingRun | None:
    """The finished training in the folder ``out``; None where there is none. `TrainingError` for a
    damaged one."""
    path = out / DONE
    if not path.exists() or not (out / WEIGHTS).exists():
        return None
    cure = "is damaged; delete it, and the training resumes from its checkpoint"
    summary = read_json(path, TrainingError, f"it {cure}")
    try:
        return TrainingRun(out, **summary)
    except TypeError:
        raise TrainingError(f"{path}: {cure}") from None


def epoch_order(pairs: int, drawn: int | None, seed: int, epoch: int) -> list[int]:
    """Indices of epoch ``epoch`` (from 0): all ``pairs`` in a new order, or the next ``drawn`` of
    one shuffled round of all pairs after the other: every pair comes once before any comes
    twice."""
    drawn = min(drawn or pairs, pairs)
    first = epoch * drawn
    turns = range(first // pairs, (first + drawn - 1) // pairs + 1)
    rounds = np.concatenate(
        [np.random.default_rng([seed, turn]).permutation(pairs) for turn in turns]
    )
    return rounds[first % pairs :][:drawn].tolist()


def spread(pairs: int, drawn: int | None) -> list[int]:
    """``drawn`` indices (all, if None) evenly over ``pairs``, always the same: each in its own
    stretch of the pairs, at a place that walks through it by the golden ratio, so that views and
    the frames within them come evenly."""
    if drawn is None or drawn >= pairs:
        return list(range(pairs))
    return [int((place + place * GOLDEN % 1) * pairs / drawn) for place in range(drawn)]


def open_data(recipe: Recipe, dataset: Path) -> tuple[FringeDepthDataset, FringeDepthDataset]:
    """Training and validation pairs. TrainingError for another image size than the recipe's, or an
    empty split."""
    datasets = []
    parts = {} if recipe.fold is None else fold_samples(DatasetFolder(dataset), recipe.fold)
    for split in ("train", "validation"):
        data = FringeDepthDataset(
            dataset,
            split,
            recipe.frames,
            recipe.normalisation,
            recipe.background_removed,
            samples=parts.get(split),
        )
        if data.source.size != (recipe.size, recipe.size):
            height, width = data.source.size
            raise TrainingError(
                f"{dataset}: holds images of {width} x {height} px, recipe {recipe.name} with "
                f"preset {recipe.preset} "
                f"expects {recipe.size} x {recipe.size}; build the size it needs: fpp-bench build "
                f"--out DIR "
                f"--preset full --size {recipe.size}"
            )
        if not len(data):
            raise TrainingError(
                f"{dataset}: split {split} holds no sample; training needs train and validation"
            )
        datasets.append(data)
    return datasets[0], datasets[1]


def fold_samples(data: DatasetFolder, fold: tuple[int, int]) -> dict[str, list[str]]:
    """The samples of each split for part k of n of a cross-validation over all objects of ``data``,
    whatever their split: part k is ``test``, every second object of the next part ``validation``,
    all others ``train``. The objects are dealt in the order of their names' hashes, which is as
    good as shuffled and the same everywhere."""
    part, parts = fold
    owners = {sample: split_sample_name(sample)[0] for sample in data.samples(ALL_SPLITS)}
    objects = sorted(set(owners.values()), key=lambda name: sha256(name.encode()).digest())
    test, validation = objects[part::parts], objects[(part + 1) % parts :: parts][::2]
    splits = {
        name: "test" if name in test else "validation" if name in validation else "train"
        for name in objects
    }
    return {
        split: [sample for sample in owners if splits[owners[sample]] == split] for split in SPLITS
    }


def rate_after(rule: Plateau | Linear, rate: float, losses: Sequence[float]) -> float:
    """Learning rate of the epoch after those with these validation ``losses``, from the first
    ``rate``; a plateau as torch's ``ReduceLROnPlateau`` counts it."""
    if isinstance(rule, Linear):
        return rate * min(1.0, max(0, rule.constant + rule.decay - len(losses)) / rule.decay)
    best, bad = math.inf, 0
    for loss in losses:
        if loss < best * (1 - LEAST_GAIN):
            best, bad = loss, 0
        elif bad < rule.patience:
            bad += 1
        else:
            rate, bad = max(rate * rule.factor, rule.minimum), 0
    return rate


def at_minimum(rule: Plateau | Linear, rate: float) -> bool:
    """Whether a training ends at ``rate``: that of a plateau is at its minimum, or a linear one at
    0."""
    return rate <= getattr(rule, "minimum", 0.0) * (1 + _RELATIVE)


class DepthTraining(Training):
    """`Training` of a recipe in epochs, on pairs of a fringe image and depth; every epoch is
    validated. ``epochs``: at most; a plateau may end it sooner."""

    objective: Regression | Adversarial

    def __init__(
        self, recipe: Recipe, data: FringeDepthDataset, validation: FringeDepthDataset, out: Path
    ) -> None:
        identity = {"recipe": recipe.digest, "fingerprint": data.source.fingerprint}
        if recipe.normalisation == "individual":
            identity["range_rule"] = data.range_rule
        super().__init__(out, identity, recipe.seed, recipe.precision)
        self.recipe, self.data, self.validation = recipe, data, validation
        self.name, self.title = recipe.name, recipe.title
        self.epochs = recipe.epochs
        self.interval_steps = len(self._indices())
        self.total_steps = self.epochs * self.interval_steps
        network = build_network(recipe.network, width=recipe.width, **recipe.options)
        if recipe.loss.name == GAN:
            settings = AdversarialSettings.of(recipe.loss.alpha)
            self.objective = Adversarial(network, discriminator(width=recipe.width), settings)
        else:
            self.objective = Regression(
                network, recipe.loss.name, recipe.loss.alpha, self._physics(data)
            )
        self.bare = dict(self.objective.modules)
        modules: dict[str, Any] = dict(self.bare)
        on_gpu = self.accelerator.device.type == "cuda"
        for module in self.bare.values():
            if on_gpu or trains_channels_last(module):
                module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        if on_gpu and recipe.compile:
            modules = {name: torch.compile(module) for name, module in modules.items()}
        rule = recipe.optimizer
        self.optimizers = {
            name: RMSprop(
                module.parameters(),
                rule.learning_rate,
                alpha=rule.alpha,
                weight_decay=rule.weight_decay,
            )
            for name, module in modules.items()
        }
        for name, module in modules.items():
            prepared = self.accelerator.prepare(module, self.optimizers[name])
            self.objective.modules[name], self.optimizers[name] = prepared
        self.resume()

    def _physics(self, data: FringeDepthDataset) -> Callable[[Tensor, Tensor], Tensor] | None:
        """The re-projection term of the recipe's loss for a dataset's rig, None where the recipe
        has none."""
        weight = self.recipe.loss.physics
        if weight is None:
            return None
        rig = data.source.rig
        layer = CalibrationLayer.of(rig, "horizontal").tensors(device=self.accelerator.device)
        unit_mm, nearest_mm = (
            MM_PER_M if self.recipe.normalisation == "global" else 1.0,
            rig.working_range_mm[0] / 2,
        )

        def term(prediction: Tensor, target: Tensor) -> Tensor:
            return weight * re_projection_loss(
                layer, prediction * unit_mm, target * unit_mm, nearest_mm
            )

        return term

    @property
    def epoch(self) -> int:
        return len(self.history)

    @property
    def best(self) -> Record:
        return min(self.history, key=lambda record: record["validation_loss"])

    @property
    def learning_rate(self) -> float:
        losses = [record["validation_loss"] for record in self.history]
        return rate_after(self.recipe.schedule, self.recipe.optimizer.learning_rate, losses)

    @property
    def over(self) -> bool:
        return super().over or (
            self.epoch > 0 and at_minimum(self.recipe.schedule, self.learning_rate)
        )

    def _indices(self) -> list[list[int]]:
        """The pairs of each batch of this process in the coming epoch; all processes have as many
        batches."""
        size, processes = self.recipe.batch, self.accelerator.num_processes
        order = epoch_order(
            len(self.data), self.recipe.pairs_per_epoch, self.recipe.seed, self.epoch
        )
        if processes > 1:
            order = np.resize(
                order, -(-len(order) // (size * processes)) * size * processes
            ).tolist()
        batches = [order[start : start + size] for start in range(0, len(order), size)]
        return batches[self.accelerator.process_index :: processes]

    def batches(self) -> Iterator[FringeDepth]:
        # What is drawn within an epoch (DropPath) depends on the epoch alone: a resumed training
        # draws the same.
        set_seed(
            (self.recipe.seed + 1_000_003 * (self.epoch + 1) + self.accelerator.process_index)
            % 2**32
        )
        torch.empty(
            (), dtype=torch.int64
        ).random_()  # as a DataLoader draws: published weights come out again
        for indices in self._indices():
            yield self._on_device(self.data.read(indices))

    def _on_device(self, read: FringeDepth) -> FringeDepth:
        device = self.accelerator.device
        if device.type == "cuda":
            read = FringeDepth(*(tensor.pin_memory() for tensor in read))
        return FringeDepth(*(tensor.to(device, non_blocking=True) for tensor in read))

    def rate(self, number: int) -> float:
        return self.learning_rate

    def diverged(self, name: str, value: float, number: int) -> str:
        fault = f"is {DIVERGED:g} times the first one" if math.isfinite(value) else "is not finite"
        samples = sorted(
            {self.data.samples[self.data.pair(index)[0]] for index in self._indices()[number]}
        )
        return (
            f"training diverged: {name} {fault} ({value:.4g}) in epoch {self.epoch + 1}, batch "
            f"{number + 1}, samples "
            f"{', '.join(samples)}. The last good state is kept ({self.epoch} epochs); lower the "
            f"learning rate, or "
            "look at those samples (fpp-bench show)"
        )

    def validated(self, losses: dict[str, float], began: float) -> Record:
        scores = self._validate()
        loss = scores["validation_loss"]
        if loss is None or not math.isfinite(loss) or loss > self.limit:
            raise TrainingError(
                f"{self.out}: training diverged: the validation loss after epoch {self.epoch + 1} "
                f"is {loss}. The last "
                f"good state is kept ({self.epoch} epochs); lower the learning rate"
            )
        training_loss = losses.pop("loss")
        record = {
            "epoch": self.epoch + 1,
            "learning_rate": self.learning_rate,
            "training_loss": training_loss,
            **scores,
            **losses,
            "seconds": round(perf_counter() - began, 3),
        }
        if (
            all(loss < before["validation_loss"] for before in self.history)
            and self.accelerator.is_main_process
        ):
            network, data = self.bare["network"], self.data
            config = model_config(self.recipe, network, data.source, self.epoch + 1, scores)
            save_weights(self.out / WEIGHTS, network, replace(config, range_rule=data.range_rule))
        return record

    def _validate(self) -> dict[str, float | None]:
        """``validation_loss`` and the scores in `LOGGED` of the network (not distributed, not
        compiled): means over the pairs of all processes, None where no pair has such a pixel."""
        network, accelerator = self.bare["network"], self.accelerator
        pairs = spread(len(self.validation), self.recipe.validation_pairs)
        indices = pairs[accelerator.process_index :: accelerator.num_processes]
        units, mode = SCORING[self.recipe.normalisation]
        network.eval()
        metric = DepthScores("mm")
        if accelerator.device.type == "cuda":  # NCCL adds up tensors on a GPU only
            metric.to(accelerator.device)
        losses: list[float] = []
        for read in self.validation.batches(self.recipe.batch, indices):
            batch = self._on_device(read)
            with torch.inference_mode(), accelerator.autocast():
                prediction = network(batch.fringe).float()
                losses += (
                    self.objective.validation_losses(prediction, batch).double().cpu().tolist()
                )
            for values, row in zip(prediction[:, 0].cpu().numpy(), read.row.tolist(), strict=True):
                sample = self.validation.samples[row]
                if not np.isfinite(values).all():
                    raise TrainingError(
                        f"{self.out}: the network's answer to {sample} is not finite; it has "
                        f"diverged"
                    )
                source = self.validation.source
                left_out = source.left_out(sample, self.validation.range_rule)
                pair = scored_pair(values, source.depth_mm(sample), units, mode, sample, left_out)
                maps = (*pair, source.void(sample)) if mode == "standard" else pair
                metric.update(*(torch.tensor(pixels)[None] for pixels in maps))
        losses = gather_object(losses)
        means = {key: float(mean) for key, mean in metric.compute().items() if key in LOGGED}
        scores = {key: None if math.isnan(means[key]) else means[key] for key in LOGGED}
        return {"validation_loss": sum(losses) / len(losses) if losses else None, **scores}

    def progress(self) -> str:
        record = self.history[-1]
        score, losses = (
            record["object_mae_mm"],
            (record["training_loss"], record["validation_loss"]),
        )
        shown, rate = "-" if score is None else f"{score:.1f} mm", record["learning_rate"]
        epoch = f"epoch {record['epoch']}/{self.epochs}"
        return f"{epoch}  loss {losses[0]:.4g} / {losses[1]:.4g}  object {shown}  rate {rate:.1e}"

    def panels(self) -> list[Panel]:
        labels, kept = (
            {"training_loss": "training", "validation_loss": "validation"},
            self.best["epoch"],
        )
        losses = Panel.of("loss", self.history, "epoch", labels, log=True)
        losses.lines[f"kept: epoch {kept}"] = ([kept], [self.best["validation_loss"]])
        object_mae = Panel.of(
            "validation object MAE, mm", self.history, "epoch", {"object_mae_mm": "_"}
        )
        return [
            losses,
            object_mae,
            Panel.of("learning rate", self.history, "epoch", {"learning_rate": "_"}, log=True),
        ]


def model_config(
    recipe: Recipe, network: nn.Module, data: DatasetFolder, epoch: int, scores: Record
) -> ModelConfig:
    """Configuration for the weights file of a network trained on ``data``."""
    return ModelConfig(
        name=recipe.name,
        title=recipe.title,
        network=recipe.network,
        options=dict(network.options),  # type: ignore[arg-type, call-overload]
        normalisation=recipe.normalisation,
        image_size=(recipe.size, recipe.size),
        dataset_fingerprint=data.fingerprint,
        benchmark=training_benchmark(data.content),
        data_config=recipe.frames,
        background_removed=recipe.background_removed,
        recipe=recipe.to_dict(),
        epoch=epoch,
        validation=scores,
    )
