"""Validation after an epoch: the recipe's loss of every sample, and the evaluator's own scores in mm.

Individual normalisation is scored with the sample's range, by the paper's rule, as its rows on the leaderboard are.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator
from torch import nn

from fpp_ml_bench.baselines.training.objectives import Objective
from fpp_ml_bench.baselines.training.pairs import spread
from fpp_ml_bench.baselines.training.recipe import Recipe
from fpp_ml_bench.errors import TrainingError
from fpp_ml_bench.evaluation.protocol import Mode, Units
from fpp_ml_bench.evaluation.scores import score_sample
from fpp_ml_bench.evaluation.units import scored_pair
from fpp_ml_bench.loaders.training import FringeDepth, FringeDepthDataset
from fpp_ml_bench.normalisation import Normalisation

SCORING: dict[Normalisation, tuple[Units, Mode]] = {
    "raw": ("mm", "standard"), "global": ("m", "standard"), "individual": ("normalised", "paper-individual"),
}  # fmt: skip
"""How a network's output is scored: its unit, and the evaluator's mode."""
_KEYS = ("validation_loss", "object_mae_mm", "background_mae_mm", "overall_mae_mm")
Row = tuple[float | None, ...]


@dataclass(frozen=True)
class Validated:
    """One row of `_KEYS` for each pair of this process; None where the sample has no such pixel."""

    rows: list[Row]

    @staticmethod
    def mean(rows: list[Row]) -> dict[str, float | None]:
        """Plain mean of each score over all pairs that have it."""
        found: dict[str, float | None] = {}
        for place, key in enumerate(_KEYS):
            values = [row[place] for row in rows if row[place] is not None]
            found[key] = sum(values) / len(values) if values else None  # type: ignore[arg-type]
        return found


def validate(
    network: nn.Module,
    objective: Objective,
    data: FringeDepthDataset,
    recipe: Recipe,
    accelerator: Accelerator,
    out: Path,
) -> Validated:  # fmt: skip
    """Loss and scores of ``network`` (not distributed, not compiled) on this process's share of the validation
    pairs, each pair for itself.

    Raises `TrainingError` when the network answers with NaN or infinity, naming the sample.
    """
    indices = spread(len(data), recipe.validation_pairs)[accelerator.process_index :: accelerator.num_processes]
    units, mode = SCORING[recipe.normalisation]
    network.eval()
    rows: list[Row] = []
    with torch.inference_mode(), accelerator.autocast():
        for read in data.batches(recipe.batch, indices):
            batch = FringeDepth(*(tensor.to(accelerator.device) for tensor in read))
            prediction = network(batch.fringe).float()
            losses = objective.validation_losses(prediction, batch).double().cpu().tolist()
            values = prediction[:, 0].cpu().numpy()
            for loss, value, row in zip(losses, values, read.row.tolist(), strict=True):
                sample = data.samples[row]
                if not np.isfinite(value).all():
                    raise TrainingError(f"{out}: the network's answer to {sample} is not finite; it has diverged")
                scores = score_sample(*scored_pair(value, data.source.depth_mm(sample), units, mode, sample))
                rows.append((loss, *_plain(scores.object.mae_mm, scores.background.mae_mm, scores.overall.mae_mm)))
    return Validated(rows)


def _plain(*values: Any) -> tuple[float | None, ...]:
    return tuple(None if value is None else float(value) for value in values)
