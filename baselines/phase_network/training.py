"""The training loop: windows, three losses, checkpoints, and validation in mm on whole images."""

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from fpp_ml_bench.baselines.phase_network.inputs import Geometry
from fpp_ml_bench.baselines.phase_network.network import PhaseNet
from fpp_ml_bench.baselines.phase_network.recipe import Recipe
from fpp_ml_bench.baselines.phase_network.route import Answers, decided_mask, decided_order, network_answers
from fpp_ml_bench.baselines.phase_network.samples import Sample
from fpp_ml_bench.baselines.phase_network.windows import IGNORED, Window, draw
from fpp_ml_bench.baselines.phase_route import TAU
from fpp_ml_bench.baselines.training import optimizer_tensors, read_checkpoint, restore_optimizer, save_checkpoint
from fpp_ml_bench.errors import TrainingError
from fpp_ml_bench.optics import Direction

CHECKPOINT_FILE = "checkpoint.safetensors"
SMALL_RAD = 0.05
"""Error of the phase below which its loss is quadratic."""
IMPOSSIBLE = -1e4
"""Logit of an order that puts its pixel out of the working range: finite, for gradients to stay so."""
LARGEST_GRADIENT = 50.0


@dataclass(frozen=True)
class Batch:
    """`Window`s as tensors with a leading axis B."""

    x: Tensor
    exists: Tensor
    order: Tensor
    correction_rad: Tensor
    fitted: Tensor
    target: Tensor
    mask_valid: Tensor

    @classmethod
    def of(cls, windows: list[Window]) -> "Batch":
        stacked = {
            name: np.stack([getattr(window, name) for window in windows]) for name in Window.__dataclass_fields__
        }
        tensors = {name: torch.from_numpy(values) for name, values in stacked.items()}
        tensors["x"] = tensors["x"].contiguous(memory_format=torch.channels_last)
        return cls(**tensors)


@dataclass(frozen=True)
class TrainedNetwork:
    """The averaged network after ``steps``, and a record of every validation."""

    network: PhaseNet
    history: list[dict[str, Any]]
    steps: int


def losses(network: torch.nn.Module, batch: Batch, bound_rad: float) -> dict[str, Tensor]:
    """``order``: cross-entropy over the candidates; ``mask``: binary cross-entropy; ``phase``: smooth L1 in rad."""
    order, inside, correction = network(batch.x)
    logits = torch.where(batch.exists, order, torch.tensor(IMPOSSIBLE))
    pixels = batch.fitted.sum().clamp(min=1)
    by_order = functional.cross_entropy(logits, batch.order, ignore_index=IGNORED, reduction="sum") / pixels
    by_pixel = functional.binary_cross_entropy_with_logits(inside, batch.target.float(), reduction="none")
    by_mask = (by_pixel * batch.mask_valid).sum() / batch.mask_valid.sum().clamp(min=1)
    target_rad = batch.correction_rad.clamp(-bound_rad, bound_rad)
    by_phase = functional.smooth_l1_loss(correction, target_rad, beta=SMALL_RAD, reduction="none")
    return {"order": by_order, "mask": by_mask, "phase": (by_phase * batch.fitted).sum() / pixels}


def scores(network: PhaseNet, samples: list[Sample], geometries: dict[Direction, Geometry]) -> dict[str, float]:
    """Means of `score` over the samples."""
    rows = []
    for sample in samples:
        geometry, scene = geometries[sample.direction], sample.scene.single()
        rows.append(score(network_answers(network, scene, geometry), sample, geometry))
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


def score(answers: Answers, sample: Sample, geometry: Geometry, threshold: float = 0.0) -> dict[str, float]:
    """Scores of one whole image with ``threshold`` on the mask's logit.

    ``object_mae_mm`` counts a missed pixel with its whole depth; ``right_mae_mm`` is the MAE of the pixels with the
    right order; ``wrong_percent`` and ``missed_percent`` are shares of the object's pixels; ``invented_kpx``:
    background pixels with a depth, in thousands."""
    scene = sample.scene.single()
    layer = geometry.layer.at(scene.crop)
    order, inside = decided_order(answers, scene), decided_mask(answers, scene, threshold)
    base_residual = layer.residual_phase(scene.phase_rad, scene.order)
    true_mm = layer.depth_of_residual_mm(base_residual + sample.missing_rad)
    phase_change = TAU * (order - scene.order) + answers.correction_rad
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


def batches(
    samples: list[Sample], geometries: dict[Direction, Geometry], recipe: Recipe, first: int
) -> Iterator[Batch]:
    """Batch of step ``first``, ``first + 1``, ...: each is a function of seed and step alone, made one step ahead."""

    def make(step: int) -> Batch:
        random = np.random.default_rng([recipe.seed, step])
        return Batch.of([draw(samples, geometries, recipe.window, recipe.vary, random) for _ in range(recipe.batch)])

    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(make, first)
        for step in range(first, recipe.steps):
            batch = coming.result()
            if step + 1 < recipe.steps:
                coming = pool.submit(make, step + 1)
            yield batch


def train(
    recipe: Recipe, samples: list[Sample], validation: list[Sample], geometries: dict[Direction, Geometry], out: Path,
    report: Callable[[list[dict[str, Any]]], None] = lambda history: None,
    advance: Callable[[int], None] = lambda steps: None,
    minutes: float | None = None, start: PhaseNet | None = None,
) -> TrainedNetwork:  # fmt: skip
    """Train to the recipe's end, or to the first validation after ``minutes``, from the checkpoint in ``out`` where
    there is one, else from the weights of ``start`` or none.

    Raises `TrainingError` for a checkpoint of another recipe, and for losses that diverge.
    """
    started = perf_counter()
    torch.manual_seed(recipe.seed)
    network = PhaseNet(recipe.widths, recipe.fine, recipe.squeezed, recipe.order_widths, recipe.bound_rad)
    network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if start is not None:
        if start.options != network.options:
            raise TrainingError(f"weights to start from: expected {network.options}, got {start.options}")
        network.load_state_dict(start.state_dict())
    averaged = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(recipe.averaged), use_buffers=True)
    averaged_network: PhaseNet = averaged.module  # type: ignore[assignment]
    optimizer = torch.optim.AdamW(network.parameters(), lr=recipe.rate, weight_decay=recipe.decay)
    history: list[dict[str, Any]] = []
    first = _restore(out / CHECKPOINT_FILE, recipe, network, averaged, optimizer, history)
    advance(first)
    weights = {"order": recipe.weight_order, "mask": recipe.weight_mask, "phase": recipe.weight_phase}
    sums, interval_started = dict.fromkeys(weights, 0.0), perf_counter()
    network.train()
    for step, batch in enumerate(batches(samples, geometries, recipe, first), start=first):
        for group in optimizer.param_groups:
            group["lr"] = recipe.rate_at(step)
        step_losses = losses(network, batch, recipe.bound_rad)
        total = torch.stack([weights[name] * step_losses[name] for name in weights]).sum()
        if not bool(torch.isfinite(total)):
            raise TrainingError(f"{out}: the loss is {float(total)} at step {step + 1}; lower the rate and start again")
        optimizer.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), LARGEST_GRADIENT)
        optimizer.step()
        averaged.update_parameters(network)
        sums = {name: sums[name] + float(step_losses[name].detach()) for name in sums}
        advance(1)
        steps_done = step + 1
        if steps_done % recipe.validate_every == 0 or steps_done == recipe.steps:
            count = steps_done % recipe.validate_every or recipe.validate_every
            seconds = perf_counter() - interval_started
            record: dict[str, Any] = {"step": steps_done, "rate": recipe.rate_at(step), "seconds": seconds}
            record |= {f"loss_{name}": value / count for name, value in sums.items()}
            record |= scores(averaged_network.eval(), validation, geometries) if validation else {}
            history.append(record)
            report(history)
            _save(out / CHECKPOINT_FILE, recipe, steps_done, network, averaged, optimizer, history)
            sums, interval_started = dict.fromkeys(weights, 0.0), perf_counter()
            if minutes is not None and perf_counter() - started > 60 * minutes:
                return TrainedNetwork(averaged_network.eval(), history, steps_done)
    return TrainedNetwork(averaged_network.eval(), history, recipe.steps)


def _save(
    path: Path, recipe: Recipe, step: int, network: PhaseNet, averaged: AveragedModel, optimizer: torch.optim.Optimizer,
    history: list[dict[str, Any]],
) -> None:  # fmt: skip
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    tensors |= {f"averaged.{name}": value for name, value in averaged.state_dict().items()}
    tensors |= optimizer_tensors(optimizer, "optimizer")
    save_checkpoint(path, tensors, {"step": step, "digest": recipe.digest, "history": history})


def _restore(
    path: Path, recipe: Recipe, network: PhaseNet, averaged: AveragedModel, optimizer: torch.optim.Optimizer,
    history: list[dict[str, Any]],
) -> int:  # fmt: skip
    """Steps done so far."""
    if not path.exists():
        return 0
    tensors, state = read_checkpoint(path)
    if state.get("digest") != recipe.digest:
        raise TrainingError(f"{path}: is of another recipe; give --out a new folder, or the recipe that it was made by")
    for prefix, module in (("network.", network), ("averaged.", averaged)):
        module.load_state_dict(
            {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
        )
    restore_optimizer(optimizer, tensors, "optimizer")
    history.extend(json.loads(json.dumps(state["history"])))
    return int(state["step"])
