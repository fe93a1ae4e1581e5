"""The base of all networks: input check, the options that rebuild them, the layers for probes; and
the blocks that more than one network uses. Every convolution block keeps H x W unless it says
otherwise."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from fpp_ml_bench.errors import NetworkError

MOST = 1 << 12
"""Of an option that is a whole number, such as a width or the side of a map: beyond all that a
machine can train."""


class FringeNetwork(nn.Module, ABC):
    """A network from one fringe image to one depth map in the training representation.

    ``forward`` takes a floating tensor (B, 1, H, W), fringe in [0, 1], and gives the same shape. H
    and W must be multiples of `stride` and at least twice it, so that a bottleneck has a spread;
    else `NetworkError`.

    name: what `build` calls it. options: JSON scalars with which `build` makes it again, and checks
    them by the type of their defaults and by ``rules``, where a whole number has another least
    value than 1, or must be a multiple.
    """

    name: str
    rules: ClassVar[dict[str, tuple[int, int]]] = {}
    stride: int

    def __init__(self, **options: int | float) -> None:
        super().__init__()
        self.options = options

    @property
    @abstractmethod
    def probe_layers(self) -> dict[str, nn.Module]:
        """Layers by name, in forward order, each giving (B, C, h, w); "bottleneck" is always among
        them."""

    @abstractmethod
    def represent(self, fringe: Tensor) -> Tensor:
        """The network itself, on input that `check_input` has passed."""

    def forward(self, fringe: Tensor) -> Tensor:
        self.check_input(fringe)
        return self.represent(fringe)

    def check_input(self, fringe: Tensor) -> None:
        """Raises `NetworkError` unless ``fringe`` is floating (B, 1, H, W) of a size that the
        network takes."""
        shape, kind = tuple(fringe.shape), fringe.dtype
        if fringe.dim() != 4 or shape[1] != 1:
            raise NetworkError(
                f"{self.name} takes one fringe channel, (B, 1, H, W); it was given {shape}"
            )
        if not fringe.is_floating_point():
            raise NetworkError(
                f"{self.name} takes floating fringe in [0, 1]; it was given {kind}; divide by 255"
            )
        self.check_size(shape[2], shape[3])

    def check_size(self, height: int, width: int) -> None:
        """Raises `NetworkError`, with the nearest sizes that would do, unless the network takes
        ``height x width``."""
        stride, least = self.stride, 2 * self.stride
        if height % stride or width % stride or height < least or width < least:
            nearest = "x".join(_nearest(side, stride, least) for side in (height, width))
            raise NetworkError(
                f"{self.name} takes heights and widths that are multiples of {stride}, at least "
                f"{least} px; it was "
                f"given {height}x{width}; the nearest it takes: {nearest}; crop, pad or build the "
                f"dataset at that size"
            )


def in_full_precision(layer: nn.Module, features: Tensor) -> Tensor:
    """``layer`` of ``features`` outside of autocast, in float32 where that was a half precision:
    bfloat16 has steps of 8 mm at 1.8 m, and the last layer is where mm come out."""
    kind = features.device.type
    if not torch.amp.is_autocast_available(kind) or not torch.is_autocast_enabled(kind):
        return layer(features)
    with torch.autocast(kind, enabled=False):
        return layer(features.float())


def _nearest(side: int, stride: int, least: int) -> str:
    below, above = (
        max(strides * stride, least) for strides in (side // stride, -(-side // stride))
    )
    return str(below) if below == above else f"({below} or {above})"


def checked_option(
    network: str, option: str, value: object, kind: type, rule: tuple[int, int]
) -> int | float:
    """``value`` as a ``kind``: a float in [0, 1), or a whole number, by ``rule`` at least so much
    and a multiple of so much; else `NetworkError`."""
    least, multiple = rule
    words = f"a whole number, {least} to {MOST}" + (
        f" and a multiple of {multiple}" if multiple > 1 else ""
    )
    allowed = isinstance(value, int) and least <= value <= MOST and value % multiple == 0
    if kind is float:
        words, allowed = "a number in [0, 1)", isinstance(value, int | float) and 0 <= value < 1
    if isinstance(value, bool) or not allowed:
        raise NetworkError(f"{network}: {option} must be {words}; it was {value!r}")
    return kind(value)  # type: ignore[no-any-return]


def trains_channels_last(module: nn.Module) -> bool:
    """Whether ``module`` may be trained in channels-last layout on a CPU: not with a 1 x 1
    convolution that has a stride, for whose weights' gradient oneDNN writes past a buffer's end
    (github.com/uxlfoundation/oneDNN/issues/6035).
    """
    convolutions = (layer for layer in module.modules() if isinstance(layer, nn.Conv2d))
    return not any(layer.kernel_size == (1, 1) and layer.stride != (1, 1) for layer in convolutions)


_CONVOLUTIONS = (nn.Conv2d, nn.ConvTranspose2d)


_RULES: dict[str, tuple[tuple[type, ...], Callable[[Tensor], object]]] = {
    "convolutions": (
        _CONVOLUTIONS,
        partial(nn.init.kaiming_normal_, mode="fan_out", nonlinearity="relu"),
    ),
    "tokens": ((nn.Linear,), partial(nn.init.trunc_normal_, std=0.02)),
    "gan": (_CONVOLUTIONS, partial(nn.init.normal_, mean=0.0, std=0.02)),
}


def initialise(module: nn.Module, *rules: str) -> None:
    """Weights by the ``rules`` and zero biases: Kaiming-normal (fan out, ReLU) ``convolutions``,
    transposed ones too; ``tokens``: linear layers, normal of spread 0.02, cut at two units of the
    weight; ``gan``: convolutions, N(0, 0.02).
    """
    for kinds, draw in map(_RULES.__getitem__, rules):
        for layer in module.modules():
            if isinstance(layer, kinds):
                draw(layer.weight)  # type: ignore[arg-type]
                if layer.bias is not None:
                    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]


@contextmanager
def torch_threads(threads: int) -> Iterator[None]:
    """Within: torch computes with so many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def tiny_floats_are_zero() -> Iterator[None]:
    """Within: floats below 1e-38 count as zero on the CPU, which is many times slower with them.
    Fading gradients, RMSprop's averages of them and the weights that they leave fall below: epochs
    were four (UNet) to six times (Hformer) slower, predictions of that UNet twice."""
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


MEAN_ROUNDINGS = 16
"""Roundings of a mean over a map, in units of the last place of its value."""
RECENTRED_FROM = 1e-6
"""Square of the error of the normalised map from which on it is worth another pass: a thousandth of
its spread."""


class _CpuInstanceNorm(torch.autograd.Function):
    """(x - mean) / sqrt(variance + eps) x weight + bias over the last two axes, with its gradient
    in closed form, in either memory layout. A map that hardly varies about a large mean, so that
    the rounding of the mean would show, is centred once more: a constant map gives the bias,
    whatever its value."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, weight: Tensor | None, bias: Tensor | None, eps: float
    ) -> Tensor:
        mean = x.mean((2, 3), keepdim=True)
        centred = x - mean
        spread = (centred * centred).mean((2, 3), keepdim=True).add_(eps)
        if bool(
            (
                mean.mul_(MEAN_ROUNDINGS * torch.finfo(x.dtype).eps).square_()
                > RECENTRED_FROM * spread
            ).any()
        ):
            centred -= centred.mean((2, 3), keepdim=True)
            spread = (centred * centred).mean((2, 3), keepdim=True).add_(eps)
        scale = spread.rsqrt_()
        ctx.save_for_backward(centred, scale, weight)
        if weight is None or bias is None:
            return centred * scale
        return torch.addcmul(bias.view(1, -1, 1, 1), centred, scale * weight.view(1, -1, 1, 1))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        centred, scale, weight = ctx.saved_tensors
        pixels = centred.shape[2] * centred.shape[3]
        along_bias = gradient.sum((2, 3), keepdim=True)
        along_weight = (gradient * centred).sum((2, 3), keepdim=True) * scale
        gain = scale if weight is None else scale * weight.view(1, -1, 1, 1)
        into_x = torch.addcmul(-gain * along_bias / pixels, gradient, gain)
        into_x.addcmul_(centred, -gain * scale * along_weight / pixels)
        if weight is None:
            return into_x, None, None, None
        return into_x, along_weight.sum((0, 2, 3)), along_bias.sum((0, 2, 3)), None


class InstanceNorm(nn.InstanceNorm2d):
    """`torch.nn.InstanceNorm2d` (B, C, h, w) -> the same, faster on the CPU in float32 and float64,
    where it can be differentiated once only. Other devices and types, compiling and exporting go
    through torch's own kernel."""

    def forward(self, x: Tensor) -> Tensor:
        plain = x.is_cpu and x.dtype in (torch.float32, torch.float64)
        if not plain or torch.compiler.is_compiling() or torch.jit.is_tracing():
            return super().forward(x)
        return _CpuInstanceNorm.apply(x, self.weight, self.bias, self.eps)


class DoubleConvolution(nn.Sequential):
    """Twice: 3x3 convolution without bias, affine instance normalisation, ReLU. (B, c_in, h, w) ->
    (B, c_out, h, w)."""

    def __init__(self, c_in: int, c_out: int) -> None:
        layers: list[nn.Module] = []
        for channels in (c_in, c_out):
            layers.append(nn.Conv2d(channels, c_out, 3, padding=1, bias=False))
            layers += [InstanceNorm(c_out, affine=True), nn.ReLU(inplace=True)]
        super().__init__(*layers)


class ResidualBlock(nn.Module):
    """ReLU(convolution-norm-ReLU-convolution-norm + identity); 3x3, batch normalisation, no biases.
    The identity is a 1x1 convolution where stride or channels change. (B, c_in, h, w) -> (B, c_out,
    h / stride, w / stride)."""

    def __init__(self, c_in: int, c_out: int, stride: int = 1) -> None:
        super().__init__()
        self.residual = nn.Sequential(
            nn.Conv2d(c_in, c_out, 3, stride, 1, bias=False),
            nn.BatchNorm2d(c_out),
            nn.ReLU(inplace=True),
            nn.Conv2d(c_out, c_out, 3, padding=1, bias=False),
            nn.BatchNorm2d(c_out),
        )
        self.identity: nn.Module = nn.Identity()
        if stride != 1 or c_in != c_out:
            self.identity = nn.Sequential(
                nn.Conv2d(c_in, c_out, 1, stride, bias=False), nn.BatchNorm2d(c_out)
            )

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(self.residual(x) + self.identity(x), inplace=True)


class Join(nn.Module):
    """A decoder level: double the map by a 2x2 transposed convolution, concatenate the skip ([skip,
    up] when ``skip_first``), run ``block``. (B, c_in, h, w) and (B, c_out, 2h, 2w) -> (B, c_out,
    2h, 2w)."""

    def __init__(self, c_in: int, c_out: int, block: nn.Module, skip_first: bool = True) -> None:
        super().__init__()
        self.up = nn.ConvTranspose2d(c_in, c_out, 2, 2)
        self.block, self.skip_first = block, skip_first

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        x = self.up(x)
        return self.block(torch.cat((skip, x) if self.skip_first else (x, skip), dim=1))


class Attention(nn.Module):
    """Global multi-head self-attention over tokens, (B, N, C) -> (B, N, C), by torch's fused
    kernel."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(channels, 3 * channels)
        self.out = nn.Linear(channels, channels)

    def forward(self, tokens: Tensor) -> Tensor:
        count, channels = tokens.shape[1:]
        qkv = self.qkv(tokens).reshape(-1, count, 3, self.heads, channels // self.heads)
        query, key, value = qkv.permute(2, 0, 3, 1, 4).unbind()
        mixed = functional.scaled_dot_product_attention(query, key, value)
        return self.out(mixed.transpose(1, 2).reshape(-1, count, channels))


class DropPath(nn.Module):
    """Leave a residual branch out for some samples while training, scaled so that the mean stays
    (B, ...) -> same."""

    def __init__(self, rate: float) -> None:
        super().__init__()
        self.rate = rate

    def forward(self, x: Tensor) -> Tensor:
        if not self.training or self.rate == 0.0:
            return x
        keep_rate = 1.0 - self.rate
        return x * x.new_empty((x.shape[0],) + (1,) * (x.dim() - 1)).bernoulli_(keep_rate).div_(
            keep_rate
        )


class TransformerLayer(nn.Module):
    """Pre-norm transformer layer: attention and a GELU MLP, each added to its input, (B, N, C) ->
    (B, N, C)."""

    def __init__(self, channels: int, heads: int, mlp_ratio: int, drop_path: float = 0.0) -> None:
        super().__init__()
        self.norm_attention = nn.LayerNorm(channels)
        self.attention = Attention(channels, heads)
        self.norm_mlp = nn.LayerNorm(channels)
        hidden = mlp_ratio * channels
        self.mlp = nn.Sequential(
            nn.Linear(channels, hidden), nn.GELU(), nn.Linear(hidden, channels)
        )
        self.drop_path = DropPath(drop_path)

    def forward(self, tokens: Tensor) -> Tensor:
        tokens = tokens + self.drop_path(self.attention(self.norm_attention(tokens)))
        return tokens + self.drop_path(self.mlp(self.norm_mlp(tokens)))
