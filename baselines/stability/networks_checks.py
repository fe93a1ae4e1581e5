"""Checks of the networks: normalisation layers, gradients, half precisions, images without an object."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fpp_ml_bench.baselines.method import load_method
from fpp_ml_bench.baselines.networks import RECENTRED_FROM, InstanceNorm, build, in_full_precision
from fpp_ml_bench.baselines.phase_route import CalibrationLayer, Reason, Settings, TorchCalibrationLayer
from fpp_ml_bench.baselines.stability.case import Outcome, worst
from fpp_ml_bench.baselines.stability.losses_checks import directional, one_thread, seeded
from fpp_ml_bench.baselines.stability.roundoff import U32, U64, UB16, gamma
from fpp_ml_bench.baselines.training import loss_function
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.optics import paper_rig

SMALL = {
    "unet": {"width": 4}, "transunet": {"width": 16, "map_size": 4, "patch": 2}, "resunet": {"width": 4},
    "hformer": {"width": 8}, "pix2pix": {"width": 4},
}  # fmt: skip
"""Widths of the networks here: small, with the paper's layers."""


def constant_input(value: float, dtype: str) -> Outcome:
    """A constant map under instance normalisation: variance 0, output the bias, gradients finite."""
    kind = getattr(torch, dtype)
    layer = InstanceNorm(3, affine=True).to(kind)
    with torch.no_grad():
        layer.bias.copy_(torch.tensor([0.5, -1.0, 2.0]))
    x = torch.full((1, 3, 56, 56), value, dtype=kind, requires_grad=True)
    out = layer(x)
    (out * torch.randn(out.shape, generator=seeded(3), dtype=kind)).sum().backward()
    if x.grad is None or not bool(torch.isfinite(x.grad).all()):
        return Outcome(math.inf, 0.0, note="a gradient that is not finite")
    unit = U32 if dtype == "float32" else U64
    # The mean of n equal numbers has an error of at most (log2 n + 16) u value, which is divided by sqrt(eps).
    relative = gamma(math.log2(56 * 56) + 16, unit)
    off = relative * abs(value)
    if off**2 > layer.eps * RECENTRED_FROM:
        off = max(relative * off, math.sqrt(layer.eps * RECENTRED_FROM))  # centred twice, or just not
    error = (out - layer.bias.view(1, -1, 1, 1)).abs().max()
    return worst([float(error.detach())], [off / math.sqrt(off**2 + layer.eps) + 4 * unit], condition=abs(value))


def nearly_constant(offset: float) -> Outcome:
    """A pattern of amplitude 1 on a large offset, where one-pass formulas for the variance cancel."""
    pattern = torch.randn((1, 2, 48, 48), generator=seeded(4), dtype=torch.float64)
    x = (pattern + offset).float()
    output = InstanceNorm(2, affine=False)(x).double()
    wide = x.double()
    centred = wide - wide.mean((2, 3), keepdim=True)
    exact = centred / (centred.square().mean((2, 3), keepdim=True) + 1e-5).sqrt()
    relative = gamma(math.log2(48 * 48) + 16, U32)
    off = min(relative * abs(offset), math.sqrt(RECENTRED_FROM) + relative**2 * abs(offset))
    bound = 2 * (off + relative * exact.abs()) + 2 * relative
    return worst((output - exact).numpy(), bound.numpy(), condition=abs(offset))


def instance_norm_gradient() -> Outcome:
    """The closed-form gradient against torch's own layer, both in float64."""
    benchmark_layer, torch_layer = (
        InstanceNorm(3, affine=True).double(),
        torch.nn.InstanceNorm2d(3, affine=True).double(),
    )
    with torch.no_grad():
        for parameter, torch_parameter in zip(benchmark_layer.parameters(), torch_layer.parameters(), strict=True):
            parameter.copy_(torch.randn(3, generator=seeded(5), dtype=torch.float64))
            torch_parameter.copy_(parameter)
    x = torch.randn((2, 3, 12, 10), generator=seeded(6), dtype=torch.float64)
    seed = torch.randn(x.shape, generator=seeded(7), dtype=torch.float64)
    results = []
    for layer in (benchmark_layer, torch_layer):
        inner = x.clone().requires_grad_()
        (layer(inner) * seed).sum().backward()
        results.append([inner.grad, *(parameter.grad for parameter in layer.parameters())])
    errors = [float((a - b).abs().max()) for a, b in zip(*results, strict=True)]
    sizes = [float(seed.abs().sum()) for _ in errors]
    return worst(errors, gamma(12) * torch.tensor(sizes).numpy())


def layer_gradient(direction: str) -> Outcome:
    """d depth / d phase of the calibration layer."""
    rig = paper_rig(16)
    layer = TorchCalibrationLayer(rig, direction, torch.float64)  # type: ignore[arg-type]
    total = torch.from_numpy(CalibrationLayer.of(rig, direction).absolute_phase(1800.0))  # type: ignore[arg-type]
    order = torch.floor(total / (2 * math.pi) + 0.5)
    return directional(lambda phase: layer(phase, order).sum(), total - 2 * math.pi * order, smooth=True)


@one_thread()
def network_gradient(name: str) -> Outcome:
    """The whole network in float64, along a random direction of its input."""
    torch.manual_seed(4)
    network = build(name, **SMALL[name]).double().eval()
    x = torch.rand((1, 1, 64, 64), generator=seeded(9), dtype=torch.float64)
    seed = torch.randn((1, 1, 64, 64), generator=seeded(10), dtype=torch.float64)
    return directional(lambda image: (network(image) * seed).sum(), x, smooth=False)


@one_thread()
def network_single(name: str) -> Outcome:
    """float32 against float64, with a bound from rounding every weight and pixel once in float64."""
    torch.manual_seed(4)
    network = build(name, **SMALL[name]).double().eval()
    x = torch.rand((1, 1, 64, 64), generator=seeded(11), dtype=torch.float64)
    with torch.no_grad():
        exact = network(x)
        spread = torch.zeros_like(exact)
        weights = [parameter.clone() for parameter in network.parameters()]
        for trial in range(3):
            generator = seeded(20 + trial)

            def rounded(values: Tensor, generator: torch.Generator = generator) -> Tensor:
                noise = torch.rand(values.shape, generator=generator, dtype=torch.float64) * 2 - 1
                return values * (1 + U32 * noise)

            for parameter, weight in zip(network.parameters(), weights, strict=True):
                parameter.copy_(rounded(weight))
            spread = torch.maximum(spread, (network(rounded(x)) - exact).abs())
        for parameter, weight in zip(network.parameters(), weights, strict=True):
            parameter.copy_(weight)
        single = network.float()(x.float()).double()
    scale = float(spread.max())
    # A weight takes part in sums of up to 10^3 products: 16 is half of sqrt(10^3), and includes the weights' rounding.
    return worst([float((single - exact).abs().max())], [16 * scale], condition=scale / U32 / float(exact.abs().max()))


@one_thread()
def network_constant(name: str, value: float) -> Outcome:
    """Output and gradients of a constant image: nothing may be NaN or infinite."""
    torch.manual_seed(4)
    network = build(name, **SMALL[name]).train()
    x = torch.full((2, 1, 64, 64), value)
    out = network(x)
    loss = loss_function("hybrid_l1", 0.7)(out, torch.zeros_like(out))
    loss.backward()
    tensors = [out.detach(), *(p.grad for p in network.parameters() if p.grad is not None)]
    return worst([float(sum(int((~torch.isfinite(tensor)).sum()) for tensor in tensors))], [0.0])


@one_thread()
def network_half(name: str, dtype: str) -> Outcome:
    """Inference under autocast with raw depth (a bias of 1,800): the last layer must not round to steps of 8 mm."""
    torch.manual_seed(4)
    network = build(name, **SMALL[name]).eval()
    head = torch.nn.Conv2d(8, 1, 1)
    features = torch.rand((1, 8, 16, 16), generator=seeded(12)).to(getattr(torch, dtype))
    with torch.no_grad():
        head.bias.fill_(1800.0)  # type: ignore[union-attr]
        with torch.autocast("cpu", dtype=getattr(torch, dtype)):
            out = network(torch.rand((1, 1, 64, 64), generator=seeded(13)))
            depth = in_full_precision(head, features)
        exact = torch.nn.functional.conv2d(
            features.double(), head.weight.double(), None if head.bias is None else head.bias.double()
        )
    if out.dtype != torch.float32 or not bool(torch.isfinite(out).all()):
        return Outcome(math.inf, 0.0, note=f"the network gives {out.dtype}, or numbers that are not finite")
    return worst((depth.double() - exact).numpy(), gamma(10, U32) * 1810.0, condition=UB16 / U32)


@one_thread()
def phase_output(name: str, image: str) -> Outcome:
    """Depth of an image without an object: measured pixels must lie in the working range and its slack."""
    rig = paper_rig(480)
    side = rig.camera.width
    grey = {
        "black": lambda: np.zeros((side, side)),
        "white": lambda: np.full((side, side), 255.0),
        "constant": lambda: np.full((side, side), 128.0),
        "noise": lambda: np.random.default_rng(1).uniform(0, 256, (side, side)),
        "checkerboard": lambda: 255.0 * (np.indices((side, side)).sum(axis=0) % 2),
    }[image]()
    try:
        phase_method = load_method(name, rig)
        frames: list[NDArray[np.uint8] | None] = [None] * len(rig.sequence)
        frames[phase_method.frames_used[0]] = grey.astype(np.uint8)
        measurement = phase_method.measure(frames)  # type: ignore[attr-defined]
    except FppBenchError as error:
        return Outcome(None, flagged=1.0, note=str(error))
    near, far = rig.working_range_mm
    slack, depth = Settings().slack_mm * (1 + U32), measurement.depth_mm
    legal = np.isfinite(depth) & ((depth == 0) | ((depth >= near - slack) & (depth <= far + slack)))
    return worst(np.where(legal, 0.0, np.inf), 0.0, measurement.reason != Reason.MEASURED, 1.0)
