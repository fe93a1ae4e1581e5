"""Training fringe-net: no dataset is needed. Drawn rigs photograph training objects, windows of the
images are learned from, and a moving average of the weights is kept.

``out`` holds ``views/``, the files of the engine and, at the end, the weights instead of the
checkpoint. A stopped training continues at every stage.
"""

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from fpp_ml_bench.baselines.learned.images import FringeImage
from fpp_ml_bench.baselines.learned.recipe import Batch, FringeRecipe, losses, scores
from fpp_ml_bench.baselines.training.engine import (
    CHECKPOINT,
    Panel,
    Record,
    Training,
    alone_in,
    claim_folder,
    reproducible,
)
from fpp_ml_bench.baselines.training.weights import (
    FRINGE_NETWORKS,
    NetConfig,
    TrainingBenchmark,
    open_weights,
    save_weights,
)

VIEWS = "views"
"""Folder of the rendered images."""
LARGEST_GRADIENT = 50.0
"""Norm to which gradients are clipped: only a diverging step exceeds it."""
SCORED_SHARE = 3
"""Every so many validation images are scored while it trains."""
PANELS = {
    "validation, phase error in rad": {
        "crossed_interior_rad": "crossed, interior",
        "crossed_edge_rad": "crossed, edge",
        "line_interior_rad": "one carrier, interior",
        "line_edge_rad": "one carrier, edge",
    },
    "validation, % of object pixels": {
        "missed_percent": "missed",
        "invented_percent": "invented",
    },
}
"""What the curve shows beside the losses: titles, and scores with their labels."""


class FringeTraining(Training):
    """Training in intervals between two validations, on the processor: windows of ``images``,
    validated on ``scored``. ``show``: every new record is printed. Raises `TrainingError` for a
    checkpoint of another recipe."""

    largest_gradient = LARGEST_GRADIENT

    def __init__(
        self,
        recipe: FringeRecipe,
        images: list[FringeImage],
        scored: list[FringeImage],
        out: Path,
        show: bool = False,
    ) -> None:
        super().__init__(out, {"recipe": recipe.digest}, recipe.seed, cpu=True)
        self.recipe, self.images, self.scored, self.show = recipe, images, scored, show
        self.name = self.title = recipe.name
        self.interval_steps, self.total_steps = recipe.validate_every, recipe.steps
        network = recipe.network()
        network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
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
        parts = losses(self.modules["network"], batch)
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
        """The batches up to the next validation, each made one step ahead."""
        first, last = self.steps_done, self._next_validation
        with ThreadPoolExecutor(1) as pool:
            coming = pool.submit(self.recipe.batch_at, self.images, first)
            for step in range(first, last):
                batch = coming.result()
                if step + 1 < last:
                    coming = pool.submit(self.recipe.batch_at, self.images, step + 1)
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
        record |= scores(self.network, self.scored)
        if self.show:
            print("  ".join(f"{key} {value:.4g}" for key, value in record.items()))
        return record

    def progress(self) -> str:
        return (
            f"step {self.steps_done}/{self.recipe.steps}  phase "
            f"{self.history[-1]['loss_phase']:.4g}"
        )

    def panels(self) -> list[Panel]:
        def panel(title: str, labels: dict[str, str], log: bool = False) -> Panel:
            return Panel.of(title, self.history, "step", labels, log)

        shown = {
            f"loss_{name}": name for name in self.recipe.weights if name != "scale"
        }  # a log-likelihood
        beside = [panel(title, labels) for title, labels in PANELS.items()]
        return [panel("training losses", shown, log=True), *beside]


@dataclass(frozen=True)
class Trained:
    """The weights file (None for a training that stopped because its minutes were over), and
    validation scores."""

    weights: Path | None
    steps: int
    validation: dict[str, float]


def train_net(
    recipe: FringeRecipe,
    out: Path,
    *,
    minutes: float | None = None,
    workers: int = 1,
    show: bool = False,
) -> Trained:
    """Train one network from random weights; the same call resumes a training that was stopped.
    ``show``: progress on stderr, and a line for every validation. Raises `TrainingError` for a
    folder of another recipe."""
    started, described = perf_counter(), recipe.to_dict()
    fingerprint = sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()
    with alone_in(out):
        claim_folder(out, {"recipe": described, "dataset_fingerprint": fingerprint})
        weights = out / f"{recipe.name}.safetensors"
        if not weights.exists():
            images, validation = recipe.images(out / VIEWS, workers, show)
            with reproducible(cpu=True):
                ongoing = FringeTraining(recipe, images, validation[::SCORED_SHARE], out, show)
                ongoing.run(started, minutes, show)
                if not ongoing.over:
                    return Trained(None, ongoing.steps_done, {})
                network = ongoing.network
                trained = NetConfig(
                    name=recipe.name,
                    title=recipe.title,
                    options=network.options,
                    dataset_fingerprint=fingerprint,
                    benchmark=TrainingBenchmark("fringe-net views", 1),
                    steps=recipe.steps,
                    recipe=described,
                    validation={**scores(network, validation)},
                )
            save_weights(weights, network, trained, family=FRINGE_NETWORKS)
            (out / CHECKPOINT).unlink(missing_ok=True)
        config = open_weights(weights, FRINGE_NETWORKS).config
        known = {key: float(value or 0) for key, value in config.validation.items()}
        return Trained(weights, config.steps, known)
