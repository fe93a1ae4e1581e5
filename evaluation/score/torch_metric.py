"""The evaluator's scores as a `torchmetrics.Metric`, for validation during training.

The rules and the float64 arithmetic are those of `fpp_ml_bench.evaluation.score`: every sample is scored separately,
and `compute` is the plain mean over samples. The state is a sum and a count for each score. Any batches, order, device
or number of processes therefore give the same numbers, up to the rounding of adding a few hundred float64 values. A
sampler that repeats samples to fill the last batch (``DistributedSampler`` without ``drop_last``) changes the mean;
give each process its own samples instead.

Included are the metrics whose entry says ``training``; those of edge bands need the depth edges of every target.
"""

from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.metrics import METRICS
from fpp_ml_bench.evaluation.protocol import WITHIN_MM
from fpp_ml_bench.evaluation.score.check import MM_PER_UNIT, declared_units, not_in_mm
from fpp_ml_bench.evaluation.score.sample_scores import EMPTY, NOT_FINITE, ErrorStats, Spread

KEYS = tuple(key for key, metric in METRICS.items() if metric.training)
SQUARES_VANISH = 1e-140
"""Errors below this have squares below the smallest normal float64."""


class DepthScores(Metric):
    """Means over samples of the keys in `KEYS`, in mm and shares, as `fpp-eval` reports them.

    ``update(prediction, target, void=None)`` takes (B, H, W) or (B, 1, H, W) real floats, 0 = background, on any
    device, and bool (B, H, W), true for pixels in no set. They are in mm; ``units="m"`` takes metres. Where units are
    not said, a target below 10 and a prediction that looks like metres are refused; say ``units="mm"`` for a network
    that may predict that early in training. ``compute()`` gives a dict of float64 scalars, NaN where no sample has the
    pixels for a score. Samples without these pixels are left out of the mean and never count as 0.

    The scores have no gradient (``is_differentiable`` is False). Lower is better, except for the shares within a
    tolerance. ``half()`` and ``float()`` leave the state in float64."""

    is_differentiable = False
    higher_is_better = False
    full_state_update = False

    sums: Tensor
    counts: Tensor

    def __init__(self, units: str | None = None, **options: Any) -> None:
        super().__init__(**options)
        declared_units(0.0, units)
        self.units = units
        self.add_state("sums", torch.zeros(len(KEYS), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("counts", torch.zeros(len(KEYS), dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, prediction: Tensor, target: Tensor, void: Tensor | None = None) -> None:
        """Add a batch. Raises PredictionError for other shapes or dtypes, for errors that are not finite, for negative
        targets, and for depths that look like another unit."""
        prediction, target = _maps(prediction, target)
        scored = torch.ones(target.shape, dtype=torch.bool) if void is None else ~_checked_void(void, target.shape)
        for predicted, truth, pixels in zip(prediction, target, scored.to(target.device), strict=True):
            counted = predicted[pixels], truth[pixels]  # what a void pixel holds, as NaN, does not matter
            mm_per_unit = _mm_per_unit(*counted, self.units)
            sample = _sample(*(depths * mm_per_unit for depths in counted))
            scores = [METRICS[key].value(sample) for key in KEYS]
            values = [predicted.new_zeros(()) if score is None else score for score in scores]
            self.sums += torch.stack(values).to(self.sums.device)
            self.counts += torch.tensor([score is not None for score in scores], device=self.counts.device)

    def compute(self) -> dict[str, Tensor]:
        """Mean over the samples so far, of all processes, of every key."""
        means = self.sums / self.counts  # 0 / 0 is NaN: no sample had the pixels
        return dict(zip(KEYS, means, strict=True))


def _maps(prediction: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Both as float64 (B, H, W)."""
    for name, values in (("prediction", prediction), ("target", target)):
        if not isinstance(values, Tensor):
            raise PredictionError(f"{name}: expected a tensor, got {type(values).__name__}")
    shape, given = tuple(target.shape), tuple(prediction.shape)
    if given != shape:
        raise PredictionError(f"expected a prediction of the target's shape {shape}, got {given}")
    if not (prediction.is_floating_point() and target.is_floating_point()):
        raise PredictionError(f"expected real floats, got {prediction.dtype} against {target.dtype}")
    if target.dim() == 4 and shape[1] == 1:
        prediction, target = prediction[:, 0], target[:, 0]
    if target.dim() != 3 or target[:1].numel() == 0:
        raise PredictionError(f"expected (B, H, W) or (B, 1, H, W), got {shape}")
    prediction, target = prediction.detach(), target.detach()
    if prediction.device.type == "mps":  # Apple's GPUs have no float64
        prediction, target = prediction.cpu(), target.cpu()
    return prediction.to(torch.float64), target.to(prediction.device, torch.float64)


def _checked_void(void: Tensor, shape: torch.Size) -> Tensor:
    if not isinstance(void, Tensor) or void.dtype != torch.bool:
        got = getattr(void, "dtype", type(void).__name__)
        raise PredictionError(f"void: expected bool, true for pixels in no set, got {got}; of flags: (flags & 3) != 0")
    if void.shape != shape:
        raise PredictionError(f"void: expected {tuple(shape)} (B, H, W), got {tuple(void.shape)}")
    return void


def _mm_per_unit(prediction: Tensor, target: Tensor, units: str | None) -> float:
    """What one unit of a sample's depths (n,) is in mm; raises PredictionError for a target that is no depth, and where
    ``units`` can't be true."""
    if not bool(torch.isfinite(target).all() and (target >= 0).all()):
        raise PredictionError("target: expected finite depths of 0 and more")
    largest, target_max = (float(depths.max()) if depths.numel() else 0.0 for depths in (prediction, target))
    scale = MM_PER_UNIT[declared_units(target_max, units)]
    if units is None and not_in_mm(largest, target_max):
        raise PredictionError(
            f"the prediction looks like another unit than the target: its largest value is {largest:.4g}, the target's "
            f"{target_max:.4g}; give both in the same"
        )
    return scale


def _sample(prediction: Tensor, target: Tensor) -> SimpleNamespace:
    """The parts of a `fpp_ml_bench.evaluation.score.SampleScores` that the metrics of the training read, as tensors, of
    one sample, float64 (n,) in mm."""
    error = prediction - target
    if error.numel() and not bool(torch.isfinite(error.square().sum())):
        raise PredictionError(NOT_FINITE)
    inside = target > 0
    errors, measured = error[inside], prediction[inside] > 0
    valid = errors[measured]
    sets = {"overall": error, "object": errors, "background": error[~inside], "valid": valid}
    sample = SimpleNamespace(**{name: _stats(pixels) for name, pixels in sets.items()}, spread=Spread(), range_mm=0.0)
    if not errors.numel():
        return sample
    ascending = errors.abs().sort().values
    offset = _quantile(errors.sort().values, 0.5)
    sample.range_mm = target[inside].max() - target[inside].min()
    sample.spread = Spread(
        _quantile(ascending, 0.5),
        _quantile(ascending, 0.95),
        ascending[-1],
        tuple((ascending <= limit).to(torch.float64).mean() for limit in WITHIN_MM),
        errors.mean(),
        valid.mean() if valid.numel() else None,
        (errors - offset).abs().mean(),
    )
    return sample


def _stats(errors: Tensor) -> ErrorStats | SimpleNamespace:
    """`ErrorStats`, of tensors where there are errors."""
    if not errors.numel():
        return EMPTY
    pixels = errors.new_tensor(errors.numel())
    return SimpleNamespace(pixels=pixels, mae_mm=errors.abs().mean(), rmse_mm=_root_mean_square(errors))


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
