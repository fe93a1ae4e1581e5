"""The evaluator's scores as a `torchmetrics.Metric`, for validation during training.

The rules and the float64 arithmetic are those of `fpp_ml_bench.evaluation.score`: every sample is scored separately,
and `compute` is the plain mean over samples. The state is a sum and a count for each score. Any batches, order, device
or number of processes therefore give the same numbers, up to the rounding of adding a few hundred float64 values. A
sampler that repeats samples to fill the last batch (``DistributedSampler`` without ``drop_last``) changes the mean;
give each process its own samples instead.

Not included: the scores of edge bands, which need the depth edges of every target.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.protocol import DISTRIBUTION, HEADLINE, WITHIN, WITHIN_MM
from fpp_ml_bench.evaluation.score.sample_scores import NOT_FINITE

KEYS = (*HEADLINE, "object_valid_mae_mm", "object_missing_share", *DISTRIBUTION)
SQUARES_VANISH = 1e-140
"""Errors below this have squares below the smallest normal float64."""


class DepthScores(Metric):
    """Means over samples of the keys in `KEYS`, in mm and shares, as `fpp-eval` reports them.

    ``update(prediction_mm, target_mm, void=None)`` takes (B, H, W) or (B, 1, H, W) real floats in mm, 0 = background,
    on any device, and bool (B, H, W), true for pixels in no set. ``compute()`` gives a dict of float64 scalars, NaN
    where no sample has the pixels for a score. Samples without these pixels are left out of the mean and never count as
    0.

    The scores have no gradient (``is_differentiable`` is False). Lower is better, except for the shares within a
    tolerance. ``half()`` and ``float()`` leave the state in float64."""

    is_differentiable = False
    higher_is_better = False
    full_state_update = False

    sums: Tensor
    counts: Tensor

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.add_state("sums", torch.zeros(len(KEYS), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("counts", torch.zeros(len(KEYS), dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, prediction_mm: Tensor, target_mm: Tensor, void: Tensor | None = None) -> None:
        """Add a batch. Raises PredictionError for other shapes or dtypes, and for errors that are not finite."""
        prediction, target = _maps(prediction_mm, target_mm)
        scored = torch.ones(target.shape, dtype=torch.bool) if void is None else ~void
        if scored.shape != target.shape:
            raise PredictionError(f"void: expected {tuple(target.shape)} (B, H, W), got {tuple(scored.shape)}")
        for predicted, truth, pixels in zip(prediction, target, scored.to(target.device), strict=True):
            scores = _sample_scores(predicted[pixels], truth[pixels])
            values = [predicted.new_zeros(()) if (score := scores[key]) is None else score for key in KEYS]
            self.sums += torch.stack(values).to(self.sums.device)
            self.counts += torch.tensor([scores[key] is not None for key in KEYS], device=self.counts.device)

    def compute(self) -> dict[str, Tensor]:
        """Mean over the samples so far, of all processes, of every key."""
        means = self.sums / self.counts  # 0 / 0 is NaN: no sample had the pixels
        return dict(zip(KEYS, means, strict=True))


def _maps(prediction_mm: Tensor, target_mm: Tensor) -> tuple[Tensor, Tensor]:
    shape, given = tuple(target_mm.shape), tuple(prediction_mm.shape)
    if given != shape:
        raise PredictionError(f"expected a prediction of the target's shape {shape}, got {given}")
    if not (prediction_mm.is_floating_point() and target_mm.is_floating_point()):
        raise PredictionError(f"expected real floats, got {prediction_mm.dtype} against {target_mm.dtype}")
    if target_mm.dim() == 4 and shape[1] == 1:
        prediction_mm, target_mm = prediction_mm[:, 0], target_mm[:, 0]
    if target_mm.dim() != 3 or target_mm[:1].numel() == 0:
        raise PredictionError(f"expected (B, H, W) or (B, 1, H, W), got {shape}")
    prediction, target = prediction_mm.detach(), target_mm.detach()
    if prediction.device.type == "mps":  # Apple's GPUs have no float64
        prediction, target = prediction.cpu(), target.cpu()
    return prediction.to(torch.float64), target.to(prediction.device, torch.float64)


def _sample_scores(prediction: Tensor, target: Tensor) -> Mapping[str, Tensor | None]:
    """Scores of one sample, float64 (n,) in mm each: the keys of `KEYS`, None for an empty pixel set."""
    error = prediction - target
    if not error.numel():
        return dict.fromkeys(KEYS)
    if not bool(torch.isfinite(error.square().sum())):
        raise PredictionError(NOT_FINITE)
    inside = target > 0
    scores: dict[str, Tensor | None] = dict.fromkeys(KEYS)
    for name, part in (("overall", error.flatten()), ("object", error[inside]), ("background", error[~inside])):
        if part.numel():
            scores[f"{name}_mae_mm"] = part.abs().mean()
            scores[f"{name}_rmse_mm"] = _root_mean_square(part)
    if not bool(inside.any()):
        return scores
    errors, measured = error[inside], prediction[inside] > 0
    valid = errors[measured]
    ascending = errors.abs().sort().values
    offset = _quantile(errors.sort().values, 0.5)
    scores["object_missing_share"] = 1.0 - measured.to(torch.float64).mean()
    if valid.numel():
        scores["object_valid_mae_mm"], scores["object_valid_bias_mm"] = valid.abs().mean(), valid.mean()
    scores["object_median_mm"], scores["object_p95_mm"] = _quantile(ascending, 0.5), _quantile(ascending, 0.95)
    scores["object_max_mm"] = ascending[-1]
    for key, limit in zip(WITHIN, WITHIN_MM, strict=True):
        scores[key] = (ascending <= limit).to(torch.float64).mean()
    scores["object_bias_mm"] = errors.mean()
    scores["object_shift_free_mae_mm"] = (errors - offset).abs().mean()
    return scores


def _root_mean_square(errors: Tensor) -> Tensor:
    """Root mean square; errors whose squares would underflow are divided by the largest first."""
    largest = errors.abs().max()
    scale = torch.where((largest > 0) & (largest < SQUARES_VANISH), largest, torch.ones_like(largest))
    return (errors / scale).square().mean().sqrt() * scale


def _quantile(ascending: Tensor, level: float) -> Tensor:
    """Linear interpolation between order statistics, as in `sample_scores`."""
    position = level * (ascending.numel() - 1)
    low = int(position)
    below, above = ascending[low], ascending[min(low + 1, ascending.numel() - 1)]
    return below + (above - below) * (position - low)
