"""Metric depth from an individually normalised network, without being told the sample's depth range.

Such a network puts out v in [0, 1], and mm are v (D_max - D_min) + D_min. The benchmark's *metric twin* of its row
replaces the range of the test sample, which only the ground truth knows, by either

- ``mean``: D_min and D_max averaged over the training split;
- ``predicted``: a ridge regression from the mean and spread of each bottleneck channel to (D_min, D_max - D_min).

Both also need an object mask, because v = 0 means both background and D_min: a logistic regression on the features
of the last decoder layer (a 1x1 convolution). Depth is v span + D_min, held within the training set's range and a
quarter of its width to either side, where the mask says object, and 0 elsewhere. The network itself stays as it is.
Own definition; `fpp_ml_bench.baselines.networks.range_heads.fit_heads` fits it.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Literal, get_args

import torch
from torch import Tensor
from torch.nn import functional

from fpp_ml_bench.baselines.networks.inference import Probe
from fpp_ml_bench.errors import WeightsError

Twin = Literal["mean", "predicted"]
TWINS: tuple[Twin, ...] = get_args(Twin)


@dataclass(frozen=True)
class HeadReport:
    """How the heads do on the validation split.

    Range errors are means over its pairs of (|error of D_min| + |error of D_max|) / 2 in mm; ``mask_iou`` is the
    intersection of predicted and true object over their union, all pixels pooled, at the threshold of ``predicted``.
    The ridge's strength and the thresholds were chosen on these same pairs, so the test split does a little worse.
    """

    mean_range_error_mm: float
    predicted_range_error_mm: float
    mask_iou: float
    mean_overall_mae_mm: float
    predicted_overall_mae_mm: float
    ridge_strength: float

    def to_tensor(self) -> Tensor:
        return torch.tensor(list(asdict(self).values()), dtype=torch.float64)


@dataclass(frozen=True)
class RangeHeads:
    """The fitted heads. Ranges and limits in mm, float64; ``F`` pooled and ``C`` per-pixel features.

    mean_range_mm (2,): D_min, D_max. range_weight (F, 2), range_bias (2,): to (D_min, span). mask_weight (C,),
    mask_bias (): the logit of being object. mask_threshold (2,): least logit of an object pixel, for each of `TWINS`.
    limits_mm (2,): what depth is held within. report (6,): a `HeadReport`.
    """

    mean_range_mm: Tensor
    range_weight: Tensor
    range_bias: Tensor
    mask_weight: Tensor
    mask_bias: Tensor
    mask_threshold: Tensor
    limits_mm: Tensor
    report: Tensor

    def to_tensors(self) -> dict[str, Tensor]:
        """As stored in a weights file."""
        return dict(vars(self))

    @property
    def validation(self) -> HeadReport:
        return HeadReport(*self.report.tolist())

    def depth_range_mm(self, probe: Probe, twin: Twin) -> Tensor:
        """D_min and span of the probed batch, float64 (B, 2); a span is never below 0."""
        pooled = probe.pooled()
        if twin == "mean":
            low, high = self.mean_range_mm.tolist()
            return torch.tensor([[low, high - low]], dtype=torch.float64).expand(len(pooled), 2)
        predicted = pooled @ self.range_weight + self.range_bias
        return torch.stack([predicted[:, 0], predicted[:, 1].clamp(min=0)], dim=1)

    def logits(self, probe: Probe, size: tuple[int, int]) -> Tensor:
        """Logit of being object of each pixel of the probed batch, float32 (B, 1, H, W)."""
        features = probe.pixels(size).float()
        weight, bias = (part.to(features.device, torch.float32) for part in (self.mask_weight, self.mask_bias))
        return functional.conv2d(features, weight[None, :, None, None], bias[None])

    def unmasked_mm(self, values: Tensor, depth_range_mm: Tensor) -> Tensor:
        """v span + D_min, held within the limits: ``values`` (B, 1, H, W), ``depth_range_mm`` (B, 2) -> float32 mm."""
        least, most = self.limits_mm.tolist()
        low, span = depth_range_mm.to(values.device, torch.float32).T[:, :, None, None, None]
        return (values * span + low).clamp(least, most)

    def depth_mm(self, values: Tensor, probe: Probe, twin: Twin) -> Tensor:
        """Depth of the probed batch, float32 (B, 1, H, W) in mm, 0 = background."""
        depth = self.unmasked_mm(values.float(), self.depth_range_mm(probe, twin))
        threshold = float(self.mask_threshold[TWINS.index(twin)])
        is_object = self.logits(probe, (values.shape[2], values.shape[3])) >= threshold
        return torch.where(is_object, depth, 0.0)


def heads_from_tensors(tensors: Mapping[str, Tensor], name: str) -> RangeHeads | None:
    """The heads stored with the weights ``name``; None without any. `WeightsError` for what can't be heads."""
    if not tensors:
        return None
    fields = RangeHeads.__dataclass_fields__
    differing = [*sorted(set(fields) - set(tensors)), *sorted(set(tensors) - set(fields))]
    if differing:
        raise WeightsError(
            f"{name}: expected the range heads {', '.join(fields)}, differs in {differing[0]}; fit them again"
        )
    features = tensors["range_weight"].shape[0] if tensors["range_weight"].dim() == 2 else 0
    channels = tensors["mask_weight"].numel()
    shapes = {
        "mean_range_mm": (2,), "range_weight": (features, 2), "range_bias": (2,), "mask_weight": (channels,),
        "mask_bias": (), "mask_threshold": (2,), "limits_mm": (2,), "report": (len(HeadReport.__dataclass_fields__),),
    }  # fmt: skip
    for key, shape in shapes.items():
        if tuple(tensors[key].shape) != shape or tensors[key].dtype != torch.float64:
            actual = f"{tensors[key].dtype} {tuple(tensors[key].shape)}"
            raise WeightsError(f"{name}: range head {key}: expected float64 {shape}, got {actual}; fit the heads again")
    return RangeHeads(**tensors)
