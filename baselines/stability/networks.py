"""Losses of zero residual, empty mask and any magnitude; networks on constant input and in half precisions; gradients;
the phase methods on images without an object; the training metric."""

import copy
import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from fpp_ml_bench.baselines.networks.base import RECENTRED_FROM, InstanceNorm, in_full_precision, torch_threads
from fpp_ml_bench.baselines.networks.model import NETWORKS as NAMES
from fpp_ml_bench.baselines.networks.model import build
from fpp_ml_bench.baselines.phase_route.calibration_layer import CalibrationLayer
from fpp_ml_bench.baselines.phase_route.observation import Reason
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.baselines.stability.cases import U32, U64, UB16, Group, Outcome, gamma, worst, wrong
from fpp_ml_bench.baselines.training.losses import EPSILON, loss_function, sample_losses
from fpp_ml_bench.baselines.training.tables import LOSSES
from fpp_ml_bench.errors import FppBenchError, PredictionError
from fpp_ml_bench.evaluation.score.torch_metric import DepthScores
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.sequence import DIRECTIONS, Direction

NETWORKS = Group(
    "networks",
    "Richardson's extrapolated differences",
    "difference of two extrapolations (the next order) + 64 u |f| sqrt(n) / h of rounding",
)
ALPHA = 0.7
SMALL = {
    "unet": {"width": 4},
    "transunet": {"width": 16, "map_size": 4, "patch": 2},
    "resunet": {"width": 4},
    "hformer": {"width": 8},
    "pix2pix": {"width": 4},
    "pix2pix_unet": {"width": 4, "levels": 3},
}
"""Widths of the networks here: small, with the paper's layers. For images of 64 px one thread is faster."""
_SHAPE = (2, 1, 24, 32)


def _seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random(
    shape: tuple[int, ...], seed: int, draw: Callable[..., Tensor] = torch.randn, dtype: torch.dtype = torch.float64
) -> Tensor:
    """Seeded random numbers, normal ones or by ``torch.rand`` uniform in [0, 1)."""
    return draw(shape, generator=_seeded(seed), dtype=dtype)


def small_network(name: str) -> nn.Module:
    """A network of `SMALL` width with random weights, seeded."""
    torch.manual_seed(4)
    return build(name, **SMALL[name])


def _loss(name: str) -> Callable[[Tensor, Tensor], Tensor]:
    return loss_function(name, ALPHA if name.startswith("hybrid") else None)


def _scene(scale: float, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    """A prediction and its target, 0 in the background."""
    target = random(_SHAPE, 1, torch.rand) + 0.5
    target[..., :9, :] = 0
    prediction = target + 0.1 * random(_SHAPE, 2)
    return (scale * prediction).to(dtype), (scale * target).to(dtype)


def _exact_loss(name: str, prediction: Tensor, target: Tensor) -> float:
    """The loss by exactly rounded sums in float64."""
    errors = (prediction.double() - target.double()).flatten().tolist()
    inside = [error for error, depth in zip(errors, target.flatten().tolist(), strict=True) if depth > 0]

    def part(values: list[float]) -> float:
        if name.endswith("rmse") and values:
            return math.sqrt(math.fsum(value * value for value in values) / len(values) + EPSILON)
        return math.fsum(map(abs, values)) / max(len(values), 1)

    if name.startswith("hybrid"):
        return ALPHA * part(inside) + (1 - ALPHA) * part(errors)
    return part(inside if name.startswith("masked") else errors)


def _loss_and_gradient(name: str, prediction: Tensor, target: Tensor) -> tuple[float, Tensor]:
    prediction = prediction.clone().requires_grad_()
    loss = _loss(name)(prediction, target)
    (gradient,) = torch.autograd.grad(loss, prediction)
    return float(loss.detach()), gradient


def _finite(*tensors: Tensor) -> bool:
    return all(torch.isfinite(tensor).all() for tensor in tensors)


@NETWORKS.family("zero residual", "1", name=LOSSES)
def zero_residual(name: str) -> Outcome:
    """loss and gradient of a perfect prediction; against 1e-4 for RMSE, else 0; gradient exactly 0; bound: 4 u32: one
    root of e = 1e-8"""
    _, target = _scene(1.0)
    loss, gradient = _loss_and_gradient(name, target, target)
    if not _finite(gradient):
        return wrong("a gradient that is not finite")
    exact = math.sqrt(EPSILON) if name.endswith("rmse") else 0.0
    return worst([loss - exact, float(gradient.abs().max())], [4 * U32 * exact, 0.0])


@NETWORKS.family("empty mask", "1", name=LOSSES)
def empty_mask(name: str) -> Outcome:
    """loss and gradient without object pixels; against exactly rounded sums; 0 where masked; bound: 32 u32: torch's
    pairwise sums"""
    prediction, target = _scene(1.0)[0], torch.zeros(_SHAPE)
    loss, gradient = _loss_and_gradient(name, prediction, target)
    per_sample = sample_losses(name, ALPHA if name.startswith("hybrid") else None, prediction, target)
    if not _finite(gradient, per_sample):
        return wrong("a loss or gradient that is not finite")
    exact = _exact_loss(name, prediction, target)
    return worst(loss - exact, gamma(32, U32) * exact)


@NETWORKS.family(
    "loss magnitude",
    "1",
    expects=lambda name, scale: "either" if scale > 1e19 else "number",
    name=("rmse", "hybrid_l1"),
    scale=(1e-30, 1e-6, 1.0, 2e3, 1e15, 1e25),
)
def loss_size(name: str, scale: float, dtype: str = "float32") -> Outcome:
    """float32 loss of errors of this size; against exactly rounded sums in float64; bound: 2 (log2 n + 16) u32:
    pairwise sums; beyond 1e19 the square is infinite, and training stops"""
    prediction, target = _scene(scale, getattr(torch, dtype))
    value = float(_loss(name)(prediction, target))
    if not math.isfinite(value):
        finite = _finite(prediction)
        note = "an infinite loss, on which training stops" if finite else "infinite input gives an infinite loss"
        return Outcome(None, flagged=1.0, note=note)
    # torch sums in vectors and pairs, log2(n) + 16 roundings, doubled by the square
    exact = _exact_loss(name, prediction, target)
    return worst(value - exact, gamma(2 * (math.log2(prediction.numel()) + 16), U32) * exact)


NETWORKS.family(
    "half-precision loss",
    "1",
    about="loss of half-precision tensors in mm; against exactly rounded sums of the same "
    "input; bound: 2 (log2 n + 16) u32: computed in float32; infinite input gives an infinite loss",
    expects=lambda name, dtype, scale: "either" if dtype == "float16" and scale > 3e4 else "number",
    name=("rmse", "hybrid_l1"),
    dtype=("float16", "bfloat16"),
    scale=(1.0, 2e3, 3e4, 1e5),
)(loss_size)


@NETWORKS.family(
    "constant input, instance norm", "1", dtype=("float32", "float64"), value=(0.0, 0.1, 1.0, 255.0, 1e4, 1e8, 1e-30)
)
def constant_input(value: float, dtype: str) -> Outcome:
    """output and gradient of a map without variance; against the bias; bound: d / sqrt(d^2 + eps), d = (log2 n + 16) u
    |value|, or that factor twice: the mean, centred again"""
    kind = getattr(torch, dtype)
    layer = InstanceNorm(3, affine=True).to(kind)
    with torch.no_grad():
        layer.bias.copy_(torch.tensor([0.5, -1.0, 2.0]))
    x = torch.full((1, 3, 56, 56), value, dtype=kind, requires_grad=True)
    out = layer(x)
    (gradient,) = torch.autograd.grad((out * random(tuple(out.shape), 3, dtype=kind)).sum(), x)
    if not _finite(gradient):
        return wrong("a gradient that is not finite")
    unit = U32 if dtype == "float32" else U64
    # The mean of n equal numbers has an error of at most (log2 n + 16) u value, which is divided by sqrt(eps).
    relative = gamma(math.log2(56 * 56) + 16, unit)
    off = relative * abs(value)
    if off**2 > layer.eps * RECENTRED_FROM:
        off = max(relative * off, math.sqrt(layer.eps * RECENTRED_FROM))  # centred twice, or just not
    error = float((out - layer.bias.view(1, -1, 1, 1)).abs().max().detach())
    return worst(error, off / math.sqrt(off**2 + layer.eps) + 4 * unit, condition=abs(value))


@NETWORKS.family("nearly constant input, instance norm", "1", offset=(0.0, 1.0, 1e2, 1e4, 1e6))
def nearly_constant(offset: float) -> Outcome:
    """normalised map of amplitude 1 on this offset, float32; against float64 on the same input; bound: 2 (min(g
    |offset|, 1e-3 + g^2 |offset|) + g |x| + g), g = (log2 n + 16) u32"""
    x = (random((1, 2, 48, 48), 4) + offset).float()  # where one-pass formulas for the variance cancel
    output = InstanceNorm(2, affine=False)(x).double()
    centred = x.double() - x.double().mean((2, 3), keepdim=True)
    exact = centred / (centred.square().mean((2, 3), keepdim=True) + 1e-5).sqrt()
    relative = gamma(math.log2(48 * 48) + 16, U32)
    off = min(relative * abs(offset), math.sqrt(RECENTRED_FROM) + relative**2 * abs(offset))
    bound = 2 * (off + relative * exact.abs()) + 2 * relative
    return worst((output - exact).numpy(), bound.numpy(), condition=abs(offset))


@NETWORKS.family("instance norm gradient", "1")
def instance_norm_gradient() -> Outcome:
    """closed-form gradient in float64; against torch's own instance norm in float64; bound: 12 u sum |seed|"""
    x, seed = random((2, 3, 12, 10), 6).requires_grad_(), random((2, 3, 12, 10), 7)
    gradients = []
    for layer in InstanceNorm(3, affine=True).double(), nn.InstanceNorm2d(3, affine=True).double():
        layer.load_state_dict({name: random((3,), 5) for name in ("weight", "bias")})
        gradients.append(torch.autograd.grad((layer(x) * seed).sum(), [x, *layer.parameters()]))
    errors = [float((a - b).abs().max()) for a, b in zip(*gradients, strict=True)]
    return worst(errors, gamma(12) * np.float32(seed.abs().sum()))


def directional(function: Callable[[Tensor], Tensor], x: Tensor, step: float = 1e-3) -> Outcome:
    """Autograd's derivative along a random direction against Richardson's extrapolated difference quotient."""
    seed = random(tuple(x.shape), 8, dtype=x.dtype)
    seed = seed / seed.norm()
    inner = x.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(inner), inner)
    slope = float((gradient * seed).sum())
    with torch.no_grad():
        steps = step, 2 * step, 4 * step
        one, two, four = (float(function(x + h * seed) - function(x - h * seed)) / (2 * h) for h in steps)
        value = abs(float(function(x)))
    first, second = (4 * one - two) / 3, (4 * two - four) / 3
    rounding = 64 * U64 * max(value, 1e-300) * math.sqrt(x.numel()) / step
    return worst(slope - first, abs(first - second) + abs(one - two) * 1e-3 + rounding)


@NETWORKS.family("loss gradient", "1", name=LOSSES)
def loss_gradient(name: str) -> Outcome:
    """directional derivative in float64"""
    prediction, target = _scene(1.0, torch.float64)
    prediction = target + torch.sign(prediction - target) * (0.05 + (prediction - target).abs())  # away from |.|'s kink
    return directional(lambda x: _loss(name)(x, target), prediction)


@NETWORKS.family("calibration layer gradient", "mm/rad", direction=DIRECTIONS)
def layer_gradient(direction: Direction) -> Outcome:
    """directional derivative of depth by phase"""
    exact = CalibrationLayer.of(paper_rig(16), direction)
    layer, total = exact.tensors(torch.float64), torch.from_numpy(exact.absolute_phase(1800.0))
    order = torch.floor(total / (2 * math.pi) + 0.5)
    return directional(lambda phase: layer.depth_mm(phase, order).sum(), total - 2 * math.pi * order)


@NETWORKS.family("network gradient", "1", name=NAMES)
@torch_threads(1)
def network_gradient(name: str) -> Outcome:
    """directional derivative of the whole network, float64"""
    network, seed = small_network(name).double().eval(), random((1, 1, 64, 64), 10)
    return directional(lambda image: (network(image) * seed).sum(), random((1, 1, 64, 64), 9, torch.rand), step=1e-7)


@NETWORKS.family("network in float32", "1", name=NAMES)
@torch_threads(1)
def network_single(name: str) -> Outcome:
    """output in float32; against the same weights in float64; bound: 16 x what rounding each weight and pixel once
    (2^-24) does: condition number x unit round-off"""
    network, x = small_network(name).double().eval(), random((1, 1, 64, 64), 11, torch.rand)
    weights = [*copy.deepcopy(network).parameters()]

    def output(values: Sequence[Tensor], image: Tensor) -> Tensor:
        for parameter, value in zip(network.parameters(), values, strict=True):
            parameter.copy_(value)
        return network(image)

    with torch.no_grad():
        exact, spread = network(x), torch.zeros(1, dtype=torch.float64)
        for generator in map(_seeded, (20, 21, 22)):
            draw = partial(torch.rand, generator=generator, dtype=torch.float64)
            *inexact, image = (values * (1 + U32 * (draw(values.shape) * 2 - 1)) for values in (*weights, x))
            spread = torch.maximum(spread, (output(inexact, image) - exact).abs())
        output(weights, x)
        single = network.float()(x.float()).double()
    scale = float(spread.max())
    # A weight takes part in sums of up to 10^3 products: 16 is half of sqrt(10^3), and includes the weights' rounding.
    return worst(float((single - exact).abs().max()), 16 * scale, condition=scale / U32 / float(exact.abs().max()))


@NETWORKS.family("network on a constant image", "count", name=NAMES, value=(0.0, 0.5, 1.0))
@torch_threads(1)
def network_constant(name: str, value: float) -> Outcome:
    """numbers that are not finite in output and gradients, training mode; against none; bound: exact"""
    network = small_network(name).train()
    out = network(torch.full((2, 1, 64, 64), value))
    _loss("hybrid_l1")(out, torch.zeros_like(out)).backward()
    tensors = [out.detach(), *(p.grad for p in network.parameters() if p.grad is not None)]
    return worst(sum(int((~torch.isfinite(tensor)).sum()) for tensor in tensors))


@NETWORKS.family("network in half precision", "mm", name=NAMES, dtype=("bfloat16", "float16"))
@torch_threads(1)
def network_half(name: str, dtype: str) -> Outcome:
    """depth of the last layer under autocast, 1800 mm; against float64 on the same features; bound: 10 u32 x 1810 mm:
    the last layer runs in float32; bfloat16 alone would be 4 mm off"""
    network = small_network(name).eval()
    head = nn.Conv2d(8, 1, 1)
    features = random((1, 8, 16, 16), 12, torch.rand, torch.float32).to(getattr(torch, dtype))
    with torch.no_grad():
        head.bias.fill_(1800.0)  # type: ignore[union-attr]
        with torch.autocast("cpu", dtype=getattr(torch, dtype)):
            out = network(random((1, 1, 64, 64), 13, torch.rand, torch.float32))
            depth = in_full_precision(head, features)
        exact = head.double()(features.double())
    if out.dtype != torch.float32 or not _finite(out):
        return wrong(f"the network gives {out.dtype}, or numbers that are not finite")
    return worst((depth.double() - exact).numpy(), gamma(10, U32) * 1810.0, condition=UB16 / U32)


@NETWORKS.family(
    "phase route",
    "mm",
    expects="either",
    refuses=FppBenchError,
    name=("phase", "phase-net"),
    image=("black", "white", "constant", "noise", "checkerboard"),
)
@torch_threads(1)
def phase_output(name: str, image: str) -> Outcome:
    """depth of an image without an object; against a depth in the working range, or none; bound: exact"""
    rig = paper_rig(480)
    shape = (rig.camera.width, rig.camera.width)
    levels = {
        "black": 0,
        "white": 255,
        "constant": 128,
        "noise": np.random.default_rng(1).uniform(0, 256, shape),
        "checkerboard": 255 * (np.indices(shape).sum(axis=0) % 2),
    }[image]
    phase_method = load_method(name, rig)
    frames: list[NDArray[np.uint8] | None] = [None] * len(rig.sequence)
    frames[phase_method.frames_used[0]] = np.broadcast_to(np.asarray(levels), shape).astype(np.uint8)
    measurement = phase_method.measure(frames)  # type: ignore[attr-defined]
    depth = measurement.depth_mm
    legal = (depth == 0) | rig.in_range(depth)
    return worst(np.where(legal, 0.0, np.inf), 0.0, measurement.reason != Reason.MEASURED)


@NETWORKS.family("training metric", "relative", refuses=PredictionError, scale=(1.0, 1e-30, 1e30, 1e-160, 1e-300))
def metric_scale(scale: float) -> Outcome:
    """mean RMSE of 50 samples as a torchmetrics metric; against exactly rounded sums; bound: gamma of 460 roundings"""
    metric, target = DepthScores("mm"), torch.zeros((1, 20, 20), dtype=torch.float64)
    target[:, 5:15, 5:15] = 4096 * scale
    errors = scale * torch.randint(1, 999, (50, 20, 20), generator=_seeded(14)).double()
    for error in errors:
        metric.update(target + error[None], target)
    scaled = (((target + errors) - target) / scale).flatten(1)
    roots = [scale * math.sqrt(math.fsum(value**2 for value in row) / len(row)) for row in scaled.tolist()]
    exact_mm = math.fsum(roots) / len(roots)
    error = float(metric.compute()["overall_rmse_mm"]) / exact_mm - 1
    return worst(error, gamma(460) + 2 * 2.0**-1074 / max(exact_mm, 2.0**-1074))


@NETWORKS.family(
    "training metric, not a number", "mm", expects="refusal", refuses=PredictionError, value=(math.nan, math.inf, 1e200)
)
def metric_refuses(value: float) -> None:
    """a score of a prediction with a pixel of this value; against there is none; bound: must be refused"""
    prediction = torch.tensor([[[1800.0, value]]], dtype=torch.float64)
    DepthScores().update(prediction, torch.full_like(prediction, 1800.0))
