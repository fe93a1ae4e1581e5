"""The evaluator's scores as a `torchmetrics.Metric`, for validation during training.

Every sample is scored by `fpp_ml_bench.evaluation.score.evaluator.score_arrays`, on the processor,
and `compute` is the plain mean over samples. The state is a sum and a count for each score. Any
batches, order, device or number of processes therefore give the same numbers, up to the rounding of
adding a few hundred float64 values. A sampler that repeats samples to fill the last batch
(``DistributedSampler`` without ``drop_last``) changes the mean; give each process its own samples
instead.

Included are the metrics whose entry says ``training``; those of edge bands need the depth edges of
every target.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torchmetrics import Metric

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.metrics import METRICS
from fpp_ml_bench.evaluation.score.check import declared_units
from fpp_ml_bench.evaluation.score.evaluator import score_arrays

KEYS = tuple(key for key, metric in METRICS.items() if metric.training)


class DepthScores(Metric):
    """Means over samples of the keys in `KEYS`, in mm and shares, as `fpp-eval` reports them; of
    the two-sided ones with a ``charge_mm`` alone.

    ``update(prediction, target, void=None)`` takes (B, H, W) or (B, 1, H, W) real floats, 0 =
    background, on any device, and bool (B, H, W), true for pixels in no set. They are in mm;
    ``units="m"`` takes metres. Where units are not said, a target below 10 and a prediction that
    looks like metres are refused; say ``units="mm"`` for a network that may predict that early in
    training. Depths of exactly ``nodata`` are read as 0. ``charge_mm``, half of the rig's working
    range, is what a missing or invented pixel costs in the two-sided scores. ``compute()`` gives a
    dict of float64 scalars, NaN where no sample has the pixels for a score. Samples without these
    pixels are left out of the mean and never count as 0.

    The scores have no gradient (``is_differentiable`` is False). Lower is better, except for the
    shares within a tolerance. ``half()`` and ``float()`` leave the state in float64."""

    is_differentiable = False
    higher_is_better = False
    full_state_update = False

    sums: Tensor
    counts: Tensor

    def __init__(
        self,
        units: str | None = None,
        nodata: float | None = None,
        charge_mm: float | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        declared_units(0.0, units)
        self.units, self.nodata, self.charge_mm = units, nodata, charge_mm
        self.keys = tuple(key for key in KEYS if charge_mm is not None or not METRICS[key].charged)
        self.add_state(
            "sums", torch.zeros(len(self.keys), dtype=torch.float64), dist_reduce_fx="sum"
        )
        self.add_state(
            "counts", torch.zeros(len(self.keys), dtype=torch.float64), dist_reduce_fx="sum"
        )

    def update(self, prediction: Tensor, target: Tensor, void: Tensor | None = None) -> None:
        """Add a batch. Raises PredictionError for other shapes or dtypes, for depths that are not
        finite, for negative targets, and for depths that look like another unit."""
        predictions, targets = _maps(prediction, target)
        scored = (
            np.ones(targets.shape, bool) if void is None else ~_checked_void(void, targets.shape)
        )
        for predicted, truth, pixels in zip(predictions, targets, scored, strict=True):
            # What a void pixel holds, as NaN, does not matter.
            shown, true = (np.where(pixels, depths, 0.0) for depths in (predicted, truth))
            sample, _ = score_arrays(
                shown,
                true,
                ~pixels,
                self.units,
                check_prediction_units=self.units is None,
                nodata=self.nodata,
                charge_mm=self.charge_mm,
            )
            for number, key in enumerate(self.keys):
                if (score := METRICS[key].value(sample)) is not None:
                    self.sums[number] += score
                    self.counts[number] += 1

    def compute(self) -> dict[str, Tensor]:
        """Mean over the samples so far, of all processes, of every one of ``keys``."""
        means = self.sums / self.counts  # 0 / 0 is NaN: no sample had the pixels
        return dict(zip(self.keys, means, strict=True))


def _maps(prediction: Tensor, target: Tensor) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Both as float64 (B, H, W)."""
    for name, values in (("prediction", prediction), ("target", target)):
        if not isinstance(values, Tensor):
            raise PredictionError(f"{name}: expected a tensor, got {type(values).__name__}")
    shape, given = tuple(target.shape), tuple(prediction.shape)
    if given != shape:
        raise PredictionError(f"expected a prediction of the target's shape {shape}, got {given}")
    if not (prediction.is_floating_point() and target.is_floating_point()):
        raise PredictionError(
            f"expected real floats, got {prediction.dtype} against {target.dtype}"
        )
    if target.dim() == 4 and shape[1] == 1:
        prediction, target = prediction[:, 0], target[:, 0]
    if target.dim() != 3 or target[:1].numel() == 0:
        raise PredictionError(f"expected (B, H, W) or (B, 1, H, W), got {shape}")
    return prediction.detach().cpu().double().numpy(), target.detach().cpu().double().numpy()


def _checked_void(void: Tensor, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    if not isinstance(void, Tensor) or void.dtype != torch.bool:
        got = getattr(void, "dtype", type(void).__name__)
        raise PredictionError(
            f"void: expected bool, true for pixels in no set, got {got}; of flags: (flags & 3) != 0"
        )
    if void.shape != shape:
        raise PredictionError(f"void: expected {shape} (B, H, W), got {tuple(void.shape)}")
    return void.cpu().numpy()
