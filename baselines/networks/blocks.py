"""Blocks that more than one network uses; every convolution block keeps H x W unless it says otherwise."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

MEAN_ROUNDINGS = 16
"""Roundings of a mean over a map, in units of the last place of its value."""
RECENTRED_FROM = 1e-6
"""Square of the error of the normalised map from which on it is worth another pass: a thousandth of its spread."""


class _CpuInstanceNorm(torch.autograd.Function):
    """(x - mean) / sqrt(variance + eps) x weight + bias over the last two axes, with its gradient in closed form.

    Torch's kernel copies channels-last maps and reads them more often; this one takes either memory layout as it is.
    The variance is taken of the centred map. Where the rounding of the mean would show in it, on a map that hardly
    varies about a large mean, the map is centred once more: a constant map then gives the bias, whatever its value.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor | None, bias: Tensor | None, eps: float) -> Tensor:
        mean = x.mean((2, 3), keepdim=True)
        centred = x - mean
        spread = (centred * centred).mean((2, 3), keepdim=True).add_(eps)
        if bool((mean.mul_(MEAN_ROUNDINGS * torch.finfo(x.dtype).eps).square_() > RECENTRED_FROM * spread).any()):
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
    """`torch.nn.InstanceNorm2d` (B, C, h, w) -> the same, faster on the CPU in float32 and float64.

    Other devices and types, and networks being compiled or exported, go through torch's own kernel. Like that one, it
    needs more than one pixel. On the CPU it can be differentiated once only.
    """

    def forward(self, x: Tensor) -> Tensor:
        plain = x.is_cpu and x.dtype in (torch.float32, torch.float64)
        if not plain or torch.compiler.is_compiling() or torch.jit.is_tracing():
            return super().forward(x)
        return _CpuInstanceNorm.apply(x, self.weight, self.bias, self.eps)


class DoubleConvolution(nn.Sequential):
    """Twice: 3x3 convolution without bias, affine instance normalisation, ReLU. (B, c_in, h, w) -> (B, c_out, h, w)."""

    def __init__(self, c_in: int, c_out: int) -> None:
        super().__init__(
            nn.Conv2d(c_in, c_out, 3, padding=1, bias=False),
            InstanceNorm(c_out, affine=True),
            nn.ReLU(inplace=True),
            nn.Conv2d(c_out, c_out, 3, padding=1, bias=False),
            InstanceNorm(c_out, affine=True),
            nn.ReLU(inplace=True),
        )


class ResidualBlock(nn.Module):
    """ReLU(convolution-norm-ReLU-convolution-norm + identity); 3x3, batch normalisation, no biases.

    The identity is a 1x1 convolution with batch normalisation where the stride or the channels change.
    (B, c_in, h, w) -> (B, c_out, h / stride, w / stride).
    """

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
            self.identity = nn.Sequential(nn.Conv2d(c_in, c_out, 1, stride, bias=False), nn.BatchNorm2d(c_out))

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(self.residual(x) + self.identity(x), inplace=True)


class Join(nn.Module):
    """A decoder level: double the map by a 2x2 transposed convolution, concatenate the skip, run a block.

    ``block`` takes 2 x ``c_out`` channels: [skip, up] when ``skip_first``, else [up, skip].
    (B, c_in, h, w) and (B, c_out, 2h, 2w) -> (B, c_out, 2h, 2w).
    """

    def __init__(self, c_in: int, c_out: int, block: nn.Module, skip_first: bool = True) -> None:
        super().__init__()
        self.up = nn.ConvTranspose2d(c_in, c_out, 2, 2)
        self.block = block
        self.skip_first = skip_first

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        x = self.up(x)
        return self.block(torch.cat((skip, x) if self.skip_first else (x, skip), dim=1))


class Attention(nn.Module):
    """Global multi-head self-attention over tokens, (B, N, C) -> (B, N, C), by torch's fused kernel."""

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
    """Leave a residual branch out for some samples while training, scaled so that the mean stays (B, ...) -> same."""

    def __init__(self, rate: float) -> None:
        super().__init__()
        self.rate = rate

    def forward(self, x: Tensor) -> Tensor:
        if not self.training or self.rate == 0.0:
            return x
        keep_rate = 1.0 - self.rate
        mask = x.new_empty((x.shape[0],) + (1,) * (x.dim() - 1)).bernoulli_(keep_rate)
        return x * mask.div_(keep_rate)

    def extra_repr(self) -> str:
        return f"rate={self.rate:.3f}"


class TransformerLayer(nn.Module):
    """Pre-norm transformer layer: attention and a GELU MLP, each added to its input, (B, N, C) -> (B, N, C)."""

    def __init__(self, channels: int, heads: int, mlp_ratio: int, drop_path: float = 0.0) -> None:
        super().__init__()
        self.norm_attention = nn.LayerNorm(channels)
        self.attention = Attention(channels, heads)
        self.norm_mlp = nn.LayerNorm(channels)
        self.mlp = nn.Sequential(
            nn.Linear(channels, mlp_ratio * channels), nn.GELU(), nn.Linear(mlp_ratio * channels, channels)
        )
        self.drop_path = DropPath(drop_path)

    def forward(self, tokens: Tensor) -> Tensor:
        tokens = tokens + self.drop_path(self.attention(self.norm_attention(tokens)))
        return tokens + self.drop_path(self.mlp(self.norm_mlp(tokens)))
