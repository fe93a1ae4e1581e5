"""Validation after an epoch: the recipe's loss of every sample, and the evaluator's scores in mm (`DepthScores`).

Individual normalisation is scored with the sample's range, by the paper's rule, as its rows on the leaderboard are.
"""

import math
from pathlib import Path

import numpy as np
import torch
from accelerate import Accelerator
from accelerate.utils import gather_object
from torch import nn

from fpp_ml_bench.baselines.training.objectives import Objective
from fpp_ml_bench.baselines.training.pairs import spread
from fpp_ml_bench.baselines.training.recipe import Recipe
from fpp_ml_bench.depth import Normalisation
from fpp_ml_bench.errors import TrainingError
from fpp_ml_bench.evaluation.protocol import Mode, Units
from fpp_ml_bench.evaluation.score import DepthScores, scored_pair
from fpp_ml_bench.loaders.training import FringeDepth, FringeDepthDataset

SCORING: dict[Normalisation, tuple[Units, Mode]] = {
    "raw": ("mm", "standard"), "global": ("m", "standard"), "individual": ("normalised", "paper-individual"),
}  # fmt: skip
"""How a network's output is scored: its unit, and the evaluator's mode."""
LOGGED = ("object_mae_mm", "background_mae_mm", "overall_mae_mm")
"""The scores of `DepthScores` that a training log holds."""


def validate(
    network: nn.Module,
    objective: Objective,
    data: FringeDepthDataset,
    recipe: Recipe,
    accelerator: Accelerator,
    out: Path,
) -> dict[str, float | None]:
    """``validation_loss`` and the scores in `LOGGED` of ``network`` (not distributed, not compiled).

    Each process takes its share of the validation pairs, and all get the means over all pairs; a score is None where
    no pair has such a pixel. Raises `TrainingError` when the network answers with NaN or infinity, naming the sample.
    """
    indices = spread(len(data), recipe.validation_pairs)[accelerator.process_index :: accelerator.num_processes]
    units, mode = SCORING[recipe.normalisation]
    network.eval()
    metric = DepthScores()
    if accelerator.device.type == "cuda":  # NCCL adds up tensors on a GPU only
        metric.to(accelerator.device)
    losses: list[float] = []
    for read in data.batches(recipe.batch, indices):
        batch = FringeDepth(*(tensor.to(accelerator.device) for tensor in read))
        with torch.inference_mode(), accelerator.autocast():
            prediction = network(batch.fringe).float()
            losses += objective.validation_losses(prediction, batch).double().cpu().tolist()
        for values, row in zip(prediction[:, 0].cpu().numpy(), read.row.tolist(), strict=True):
            sample = data.samples[row]
            if not np.isfinite(values).all():
                raise TrainingError(f"{out}: the network's answer to {sample} is not finite; it has diverged")
            pair = scored_pair(values, data.source.depth_mm(sample), units, mode, sample)
            metric.update(*(torch.tensor(depth)[None] for depth in pair))
    losses = gather_object(losses)
    means = {key: float(mean) for key, mean in metric.compute().items() if key in LOGGED}
    scores = {key: None if math.isnan(means[key]) else means[key] for key in LOGGED}
    return {"validation_loss": sum(losses) / len(losses) if losses else None, **scores}
