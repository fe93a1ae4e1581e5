"""Losses of zero residual, empty mask, half precisions and any magnitude; instance normalisation of
nearly constant input; networks in single and half precision; the training metric."""

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn
from torch.func import functional_call

from fpp_ml_bench.baselines.networks.base import (
    RECENTRED_FROM,
    InstanceNorm,
    in_full_precision,
    torch_threads,
)
from fpp_ml_bench.baselines.networks.model import NETWORKS as NAMES
from fpp_ml_bench.baselines.networks.model import build
from fpp_ml_bench.baselines.stability.cases import U32, Outcome, family, gamma, worst, wrong
from fpp_ml_bench.baselines.stability.scores import exact_scores
from fpp_ml_bench.baselines.training.losses import EPSILON, loss_function
from fpp_ml_bench.evaluation.score.torch_metric import DepthScores

ALPHA = 0.7
"""Share of the object in the hybrid loss: the default of `training.losses`."""
SMALL = {
    "unet": {"width": 4},
    "transunet": {"width": 16, "map_size": 4, "patch": 2},
    "resunet": {"width": 4},
    "hformer": {"width": 8},
    "pix2pix": {"width": 4},
    "pix2pix_unet": {"width": 4, "levels": 3},
}
"""Widths of the networks here: small, with the paper's layers. For images of 64 px one thread is
faster."""
_SHAPE = (2, 1, 24, 32)
_IMAGE = (1, 1, 64, 64)


def random(
    shape: tuple[int, ...],
    seed: int,
    draw: Callable[..., Tensor] = torch.randn,
    dtype: torch.dtype = torch.float64,
) -> Tensor:
    """Seeded random numbers, normal ones or by ``torch.rand`` uniform in [0, 1)."""
    return draw(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def small_network(name: str) -> nn.Module:
    """A network of `SMALL` width with random weights, seeded, without dropout, in float64."""
    torch.manual_seed(4)
    return build(name, **SMALL[name]).double().eval()


def _loss(name: str) -> Callable[[Tensor, Tensor], Tensor]:
    return loss_function(name, ALPHA if name.startswith("hybrid") else None)


def _target() -> Tensor:
    """Depths of 0.5 to 1.5, 0 in the background."""
    target = random(_SHAPE, 1, torch.rand) + 0.5
    target[..., :9, :] = 0
    return target


def _exact_loss(name: str, prediction: Tensor, target: Tensor) -> float:
    """The loss by exactly rounded sums in float64."""
    errors = prediction.double() - target.double()

    def part(values: list[float]) -> float:
        if name.endswith("rmse") and values:
            return math.sqrt(math.fsum(value * value for value in values) / len(values) + EPSILON)
        return math.fsum(map(abs, values)) / max(len(values), 1)

    inside, everywhere = part(errors[target > 0].tolist()), part(errors.flatten().tolist())
    return ALPHA * inside + (1 - ALPHA) * everywhere if name.startswith("hybrid") else everywhere


@family(
    "networks",
    "loss",
    "1",
    against="exactly rounded sums in float64",
    bound="2 (log2 n + 16) u32: pairwise sums in float32 whatever the input; beyond 1e19 the square is "
    "infinite, and training stops",
    expects=lambda scale, **_: "either" if scale > 1e19 else "number",
    name=("rmse", "hybrid_l1", "hybrid_rmse"),
    kind=("float32", "float16", "bfloat16", "zero residual", "empty mask"),
    scale=(1e-6, 2e3, 1e25),
)
def loss(name: str, kind: str, scale: float) -> Outcome:
    """loss of errors of this size and its gradient, which is 0 for a residual of 0"""
    dtype = getattr(torch, kind, torch.float32)
    target = (scale * _target()).to(dtype)
    prediction = (
        target if kind == "zero residual" else target + (0.1 * scale * random(_SHAPE, 2)).to(dtype)
    )
    target = 0 * target if kind == "empty mask" else target
    prediction = prediction.clone().requires_grad_()
    value = _loss(name)(prediction, target)
    if not torch.isfinite(value):
        return worst(0.0, flagged=True)
    (gradient,) = torch.autograd.grad(value, prediction)
    slope = float(gradient.abs().max()) * (kind == "zero residual")  # NaN stays NaN
    # torch sums in vectors and pairs, log2(n) + 16 roundings, doubled by the square
    exact = _exact_loss(name, prediction.detach(), target)
    return worst(
        [value.item() - exact, slope],
        [gamma(2 * (math.log2(target.numel()) + 16), U32) * exact, 0.0],
    )


@family(
    "networks",
    "instance norm",
    "1",
    against="float64 on the same input",
    bound="2 (d / sqrt(d^2 + variance + eps) + g |x| + g), g = (log2 n + 16) u32, d = g |offset|, the "
    "rounding of the mean, or where the map is centred again what is left of it",
    amplitude=(0.0, 1.0),
    offset=(0.0, 1.0, 1e2, 1e4, 1e6, 1e8),
)
def instance_norm(offset: float, amplitude: float) -> Outcome:
    """normalised map of this amplitude on this offset in float32, and whether its gradient is
    finite"""
    x = (
        (amplitude * random((1, 2, 48, 48), 4) + offset).float().requires_grad_()
    )  # one-pass variances cancel here
    layer = InstanceNorm(2, affine=False)
    output = layer(x)
    (gradient,) = torch.autograd.grad(output, x, random(tuple(x.shape), 3).float())
    centred = x.detach().double() - x.detach().double().mean((2, 3), keepdim=True)
    variance = centred.square().mean((2, 3), keepdim=True) + layer.eps
    exact, relative = centred / variance.sqrt(), gamma(math.log2(48 * 48) + 16, U32)
    left = (RECENTRED_FROM * variance).sqrt() + relative**2 * offset
    off = torch.minimum(torch.full_like(left, relative * offset), left)
    bound = 2 * (off / (off**2 + variance).sqrt() + relative * exact.abs() + relative)
    return worst((output.detach() - exact + 0 * gradient).numpy(), bound.numpy(), condition=offset)


@family(
    "networks",
    "network in float32",
    "1",
    against="the same weights in float64",
    bound=(
        "16 x what rounding each weight and pixel once (2^-24) does: condition number x unit "
        "round-off"
    ),
    name=NAMES,
)
@torch_threads(1)
@torch.no_grad()
def network_single(name: str) -> Outcome:
    """output in float32"""
    network, x = small_network(name), random(_IMAGE, 11, torch.rand)
    exact, spread = network(x), 0.0
    for seed in (20, 21, 22):
        draw = partial(
            torch.rand, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
        )
        values = {"": x, **dict(network.named_parameters())}
        inexact = {
            key: value * (1 + U32 * (2 * draw(value.shape) - 1)) for key, value in values.items()
        }
        spread = max(
            spread, float((functional_call(network, inexact, inexact.pop("")) - exact).abs().max())
        )
    single = network.float()(x.float()).double()
    # A weight takes part in sums of up to 10^3 products: 16 is half of sqrt(10^3), and includes the
    # weights' rounding.
    condition = spread / U32 / float(exact.abs().max())
    return worst((single - exact).numpy(), 16 * spread, condition=condition)


@family(
    "networks",
    "network in half precision",
    "mm",
    against="float64 on the same features",
    bound="10 u32 x 1810 mm: the last layer runs in float32; bfloat16 alone would be 4 mm off",
    name=NAMES,
    dtype=("bfloat16", "float16"),
)
@torch_threads(1)
@torch.no_grad()
def network_half(name: str, dtype: str) -> Outcome:
    """depth of the last layer under autocast, 1800 mm"""
    kind, head = getattr(torch, dtype), nn.Conv2d(8, 1, 1)
    features = random((1, 8, 16, 16), 12, torch.rand).to(kind)
    head.bias.fill_(1800.0)  # type: ignore[union-attr]
    with torch.autocast("cpu", dtype=kind):
        out = small_network(name).float()(random(_IMAGE, 13, torch.rand).float())
        depth = in_full_precision(head, features)
    if out.dtype != torch.float32 or not torch.isfinite(out).all():
        return wrong(f"the network gives {out.dtype}, or numbers that are not finite")
    return worst(
        (depth.double() - head.double()(features.double())).numpy(), gamma(10, U32) * 1810.0
    )


@family(
    "networks",
    "training metric",
    "relative",
    against="sums in 50 digits",
    bound="gamma of 460 roundings",
    scale=(
        1.0,
        1e-30,
        1e26,
        1e-160,
        1e-300,
    ),  # of depths up to 5096; above 1e30 mm they are refused
)
def metric_scale(scale: float) -> Outcome:
    """mean RMSE of 50 samples as a torchmetrics metric"""
    metric, target = DepthScores("mm"), torch.full((1, 20, 20), 4096 * scale, dtype=torch.float64)
    predictions = target + scale * (random((50, 20, 20), 14, torch.rand) * 998 + 1)
    for prediction in predictions:
        metric.update(prediction[None], target)
    roots = [exact_scores([((prediction - target).numpy(), 1)])[1] for prediction in predictions]
    error = float(metric.compute()["overall_rmse_mm"]) / (math.fsum(roots) / len(roots)) - 1
    return worst(error, gamma(460))
