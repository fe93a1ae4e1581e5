"""Generators and discriminator of conditional GANs (paper section 5.6).

The paper's text names a U-Net generator (Isola et al. 2017) and a PatchGAN discriminator, "adapted
from NVIDIA Pix2Pix-HD"; the authors' published code has pix2pixHD itself (Wang et al. 2018), whose
global generator has residual blocks and no skips. Both are here. The paper gives no sizes: those of
pix2pixHD are of the authors' code, those of the U-Net generator of Isola et al., with as many
levels as divide the image.
"""

from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from fpp_ml_bench.baselines.networks import base
from fpp_ml_bench.baselines.networks.base import FringeNetwork, InstanceNorm, in_full_precision

DOWNSAMPLINGS = 4
RESIDUAL_BLOCKS = 9
LEAK = 0.2


def _convolution(
    c_in: int, c_out: int, kernel: int, stride: int = 1, reflect: bool = False
) -> nn.Conv2d:
    # biases as published, though an instance normalisation after them takes them out again
    return nn.Conv2d(
        c_in, c_out, kernel, stride, kernel // 2, padding_mode="reflect" if reflect else "zeros"
    )


class GeneratorBlock(nn.Module):
    """x + norm-convolved x: two reflected 3x3 convolutions with instance normalisation, (B, c, h,
    w) -> same."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.residual = nn.Sequential(
            _convolution(channels, channels, 3, reflect=True),
            InstanceNorm(channels),
            nn.ReLU(inplace=True),
            _convolution(channels, channels, 3, reflect=True),
            InstanceNorm(channels),
        )

    def forward(self, x: Tensor) -> Tensor:
        return x + self.residual(x)


class Generator(nn.Sequential):
    """The bare generator, (B, 1, H, W) in [-1, 1] -> the same; 182,430,721 parameters at width
    64."""

    def __init__(self, width: int) -> None:
        widths = [width * 2**level for level in range(DOWNSAMPLINGS + 1)]

        def normed(layer: nn.Module, channels: int) -> nn.Sequential:
            return nn.Sequential(layer, InstanceNorm(channels), nn.ReLU(inplace=True))

        super().__init__()
        self.stem = normed(_convolution(1, width, 7, reflect=True), width)
        self.down = nn.Sequential(
            *(normed(_convolution(c // 2, c, 3, stride=2), c) for c in widths[1:])
        )
        self.bottleneck = nn.Sequential(
            *(GeneratorBlock(widths[-1]) for _ in range(RESIDUAL_BLOCKS))
        )
        self.up = nn.Sequential(
            *(normed(nn.ConvTranspose2d(2 * c, c, 3, 2, 1, 1), c) for c in reversed(widths[:-1]))
        )
        self.head = nn.Sequential(_convolution(width, 1, 7, reflect=True), nn.Tanh())

    def forward(self, x: Tensor) -> Tensor:
        for name, layer in self.named_children():
            x = in_full_precision(layer, x) if name == "head" else layer(x)
        return x


class UnitNetwork(FringeNetwork):
    """A ``generator`` in [-1, 1] as a network in [0, 1] on both sides, which its output can't
    leave: it suits representations in that range. Convolutions start from N(0, 0.02)."""

    generator: Any

    def __init__(self, generator: nn.Module, **options: int) -> None:
        super().__init__(**options)
        self.generator = generator
        base.initialise(self, "gan")

    def represent(self, fringe: Tensor) -> Tensor:
        return (self.generator(2.0 * fringe - 1.0) + 1.0) / 2.0


class Pix2Pix(UnitNetwork):
    """pix2pixHD's generator. width: channels of the first layer. Probe layers: stem, down1..down4,
    bottleneck (nine blocks at 16 x width channels, 1/16 of the image), up4..up1 (up1 at full
    resolution, ``width`` channels)."""

    name = "pix2pix"
    stride = 2**DOWNSAMPLINGS

    def __init__(self, *, width: int = 64) -> None:
        super().__init__(Generator(width), width=width)

    @property
    def probe_layers(self) -> dict[str, nn.Module]:
        layers: dict[str, nn.Module] = {"stem": self.generator.stem}
        layers |= {f"down{level}": layer for level, layer in enumerate(self.generator.down, 1)}
        layers["bottleneck"] = self.generator.bottleneck
        return layers | {
            f"up{DOWNSAMPLINGS - step}": layer for step, layer in enumerate(self.generator.up)
        }


class UNetGenerator(nn.Module):
    """The bare U-Net generator, (B, 1, H, W) in [-1, 1] -> the same. A level halves the image by a
    4x4 convolution, and a transposed one brings it back beside the encoder's features of that size.
    Channels: width x (1, 2, 4, 8, 8, ...). As pix2pixHD it ends in a 7x7 convolution at full
    resolution, and has no dropout: a measurement is no draw."""

    def __init__(self, width: int, levels: int) -> None:
        super().__init__()
        widths = [width * min(2**level, 8) for level in range(levels)]
        self.down = nn.ModuleList()
        for level, channels in enumerate(widths):
            layers: list[nn.Module] = [
                nn.Conv2d(widths[level - 1] if level else 1, channels, 4, 2, 1)
            ]
            layers += [InstanceNorm(channels)] if 0 < level < levels - 1 else []
            self.down.append(nn.Sequential(*layers, nn.LeakyReLU(LEAK)))
        self.up = nn.ModuleList()
        for level in reversed(range(levels)):
            given = widths[level] if level == levels - 1 else 2 * widths[level]
            channels = widths[level - 1] if level else width
            convolution = nn.ConvTranspose2d(given, channels, 4, 2, 1)
            self.up.append(
                nn.Sequential(convolution, InstanceNorm(channels), nn.ReLU(inplace=True))
            )
        self.head = nn.Sequential(_convolution(width, 1, 7, reflect=True), nn.Tanh())

    def forward(self, x: Tensor) -> Tensor:
        features = []
        for layer in self.down:
            x = layer(x)
            features.append(x)
        x = self.up[0](features.pop())
        for layer in self.up[1:]:
            x = layer(torch.cat([features.pop(), x], dim=1))
        return in_full_precision(self.head, x)


class Pix2PixUNet(UnitNetwork):
    """The U-Net generator; 29,367,809 parameters at width 64 and 6 levels. width: channels of the
    first level. levels: halvings of the image. Probe layers: down1..downN (down1 at half the
    resolution), of which the last is bottleneck, upN..up1 (up1 at full resolution, ``width``
    channels)."""

    name = "pix2pix_unet"
    rules: ClassVar = {"levels": (2, 1)}

    def __init__(self, *, width: int = 64, levels: int = 6) -> None:
        super().__init__(UNetGenerator(width, levels), width=width, levels=levels)
        self.stride = 2**levels

    @property
    def probe_layers(self) -> dict[str, nn.Module]:
        *down, bottleneck = self.generator.down
        layers = {f"down{level}": layer for level, layer in enumerate(down, 1)} | {
            "bottleneck": bottleneck
        }
        return layers | {
            f"up{len(down) + 1 - step}": layer for step, layer in enumerate(self.generator.up)
        }


class Discriminator(nn.Module):
    """Judges fringe and depth together at full and at half resolution; 5,527,426 parameters at
    width 64. ``forward`` takes floating (B, 2, H, W): fringe and depth, each mapped to [-1, 1]. It
    gives, for each scale (full resolution first, no shared weights), the feature maps after its
    ``layers + 2`` convolutions; the last is the judgement, (B, 1, h, w), unbounded. Convolutions
    start from N(0, 0.02). width: channels of the first layer."""

    rules: ClassVar[dict] = {}

    def __init__(self, *, width: int = 64, layers: int = 3, scales: int = 2) -> None:
        super().__init__()
        self.scales = nn.ModuleList(_patch_discriminator(width, layers) for _ in range(scales))
        base.initialise(self, "gan")

    def forward(self, pair: Tensor) -> list[list[Tensor]]:
        features = []
        for step, patch_discriminator in enumerate(self.scales):
            if step:
                pair = functional.avg_pool2d(pair, 3, stride=2, padding=1, count_include_pad=False)
            x, maps = pair, []
            for stage in patch_discriminator:  # type: ignore[attr-defined]
                x = stage(x)
                maps.append(x)
            features.append(maps)
        return features


def _patch_discriminator(width: int, layers: int) -> nn.ModuleList:
    """One scale: 4x4 convolutions, ``layers`` of stride 2, one of stride 1, then the judgement."""
    widths = [min(width * 2**level, 8 * width) for level in range(layers + 1)]
    stages = [nn.Sequential(nn.Conv2d(2, width, 4, 2, 2), nn.LeakyReLU(LEAK, inplace=True))]
    for level in range(1, layers + 1):
        convolution = nn.Conv2d(widths[level - 1], widths[level], 4, 2 if level < layers else 1, 2)
        stages.append(
            nn.Sequential(
                convolution, InstanceNorm(widths[level]), nn.LeakyReLU(LEAK, inplace=True)
            )
        )
    stages.append(nn.Sequential(nn.Conv2d(widths[-1], 1, 4, 1, 2)))
    return nn.ModuleList(stages)
