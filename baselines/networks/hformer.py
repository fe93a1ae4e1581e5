"""Hformer (Zhu et al. 2022, as the benchmark's conference version ran it): a convolutional backbone
of four branches without exchange between them, then a U of global transformers over the branches'
pixels. All sizes are those of the authors' published code (AnushLak/fpp-ml-bench)."""

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from fpp_ml_bench.baselines.networks import base
from fpp_ml_bench.baselines.networks.base import (
    FringeNetwork,
    ResidualBlock,
    TransformerLayer,
    in_full_precision,
)

HEADS = (1, 1, 2, 4)
ENCODER_DEPTHS = (1, 1, 2, 2)
DECODER_DEPTHS = (2, 1, 1)
STAGE_BLOCKS = (4, 4, 3)
STEM_BLOCKS = 4
MLP_RATIO = 2


def _last(x: Tensor) -> Tensor:
    """(B, C, h, w) -> (B, h, w, C), a view."""
    return x.permute(0, 2, 3, 1)


def _first(x: Tensor) -> Tensor:
    """(B, h, w, C) -> (B, C, h, w), a view."""
    return x.permute(0, 3, 1, 2)


def _convolution(c_in: int, c_out: int, stride: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(c_in, c_out, 3, stride, 1, bias=False),
        nn.BatchNorm2d(c_out),
        nn.ReLU(inplace=True),
    )


class Backbone(nn.Module):
    """(B, 1, H, W) -> four branches (B, c_i, h_i, w_i) at 1/4, 1/8, 1/16 and 1/32 of the image: a
    stem, then three stages. Each opens the next branch by a stride-2 convolution of the last one,
    and passes every branch by itself through a convolution and residual blocks."""

    def __init__(self, stem: int, branches: Sequence[int]) -> None:
        super().__init__()
        first = branches[0]
        self.stem = nn.Sequential(
            _convolution(1, stem, 2),
            _convolution(stem, stem, 2),
            ResidualBlock(stem, first),
            *(ResidualBlock(first, first) for _ in range(STEM_BLOCKS - 1)),
        )
        self.stages = nn.ModuleList()
        for stage, blocks in enumerate(STAGE_BLOCKS, 1):
            lanes = nn.ModuleList()
            for lane, channels in enumerate(branches[: stage + 1]):
                opens = lane == stage
                entry = _convolution(
                    branches[lane - 1] if opens else channels, channels, 2 if opens else 1
                )
                lanes.append(
                    nn.Sequential(
                        entry, *(ResidualBlock(channels, channels) for _ in range(blocks))
                    )
                )
            self.stages.append(lanes)

    def forward(self, fringe: Tensor) -> list[Tensor]:
        maps = [self.stem(fringe)]
        for lanes in self.stages:
            maps.append(maps[-1])  # the source of the branch that opens
            maps = [lane(x) for lane, x in zip(lanes, maps, strict=True)]  # type: ignore[call-overload]
        return maps


class Embed(nn.Module):
    """1x1 embedding of a branch and layer norm, (B, c_in, h, w) -> (B, c_out, h, w)."""

    def __init__(self, c_in: int, c_out: int) -> None:
        super().__init__()
        self.project = nn.Conv2d(c_in, c_out, 1)
        self.norm = nn.LayerNorm(c_out)

    def forward(self, x: Tensor) -> Tensor:
        return _first(self.norm(_last(self.project(x))))


class Level(nn.Module):
    """Transformer layers over all pixels of a map, and a layer norm if asked, (B, C, h, w) -> the
    same."""

    def __init__(self, channels: int, heads: int, drop_paths: Sequence[float], norm: bool) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            *(TransformerLayer(channels, heads, MLP_RATIO, drop) for drop in drop_paths)
        )
        self.norm = nn.LayerNorm(channels) if norm else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        tokens = self.norm(self.layers(_last(x).flatten(1, 2)))
        channels, height, width = x.shape[1:]
        return _first(tokens.reshape(-1, height, width, channels))


class MergePatches(nn.Module):
    """2x2 pixels into one, and the branch joined: (B, C, 2h, 2w) and (B, 2C, h, w) -> (B, 2C, h,
    w)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(4 * channels)
        self.reduce = nn.Linear(4 * channels, 2 * channels, bias=False)
        self.join = nn.Linear(4 * channels, 2 * channels)

    def forward(self, x: Tensor, branch: Tensor) -> Tensor:
        channels, height, width = x.shape[1:]
        quads = _last(x).reshape(-1, height // 2, 2, width // 2, 2, channels)
        patches = quads.transpose(2, 3).flatten(3)
        return _first(
            self.join(torch.cat((self.reduce(self.norm(patches)), _last(branch)), dim=-1))
        )


class ExpandPatches(nn.Module):
    """One pixel into 2x2, the encoder's map joined, layers: (B, 2C, h, w) and (B, C, 2h, 2w) -> (B,
    C, 2h, 2w)."""

    def __init__(self, channels: int, heads: int, drop_paths: Sequence[float]) -> None:
        super().__init__()
        self.expand = nn.Linear(2 * channels, 4 * channels, bias=False)
        self.norm = nn.LayerNorm(channels)
        self.join = nn.Linear(2 * channels, channels)
        self.level = Level(channels, heads, drop_paths, norm=False)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        channels, height, width = skip.shape[1:]
        quads = self.expand(_last(x)).reshape(-1, height // 2, width // 2, 2, 2, channels)
        pixels = quads.transpose(2, 3).reshape(-1, height, width, channels)
        return self.level(_first(self.join(torch.cat((self.norm(pixels), _last(skip)), dim=-1))))


class Hformer(FringeNetwork):
    """Token widths width x (1, 2, 4, 8) at 1/4 to 1/32 of the image; 4,655,993 parameters at width
    32.

    width: channels of the first token level, a multiple of 4. The stem has 2 x width channels, the
    branches 9/16 x width (rounded) x (1, 2, 4, 8). drop_path: rate of the deepest layer's DropPath,
    rising from 0 at the first layer of the encoder; a decoder level has its encoder level's rates.
    Attention is global, so time grows with the fourth power of the image side. There are no
    position embeddings: zero padding in the backbone tells pixels apart.
    """

    name = "hformer"
    rules: ClassVar = {"width": (4, 4)}
    stride = 32

    def __init__(self, *, width: int = 32, drop_path: float = 0.4) -> None:
        super().__init__(width=width, drop_path=drop_path)
        first = (9 * width + 8) // 16
        branches = [first * 2**level for level in range(4)]
        tokens = [width * 2**level for level in range(4)]
        last = sum(ENCODER_DEPTHS) - 1
        drops = iter([drop_path * layer / last for layer in range(last + 1)])
        level_drops = [[next(drops) for _ in range(depth)] for depth in ENCODER_DEPTHS]
        self.backbone = Backbone(2 * width, branches)
        self.embeds = nn.ModuleList(
            Embed(c_in, c_out) for c_in, c_out in zip(branches, tokens, strict=True)
        )
        levels = zip(tokens, HEADS, level_drops, strict=True)
        self.encoder = nn.ModuleList(
            Level(c, heads, rates, norm=True) for c, heads, rates in levels
        )
        self.merges = nn.ModuleList(MergePatches(c) for c in tokens[:3])
        self.decoder = nn.ModuleList(
            ExpandPatches(tokens[level], HEADS[level], level_drops[level][:depth])
            for level, depth in zip((2, 1, 0), DECODER_DEPTHS, strict=True)
        )
        self.up1 = nn.Sequential(nn.ConvTranspose2d(width, width // 2, 2, 2), nn.ReLU(inplace=True))
        self.up2 = nn.Sequential(
            nn.ConvTranspose2d(width // 2, width // 4, 2, 2), nn.ReLU(inplace=True)
        )
        self.head = nn.Conv2d(width // 4, 1, 1)
        base.initialise(self, "convolutions", "tokens")

    @property
    def probe_layers(self) -> dict[str, nn.Module]:
        layers = {f"enc{level}": block for level, block in enumerate(self.encoder, 1)}
        layers["bottleneck"] = layers.pop("enc4")
        layers |= {f"dec{3 - step}": block for step, block in enumerate(self.decoder)}
        return layers | {"up1": self.up1, "up2": self.up2}

    def represent(self, fringe: Tensor) -> Tensor:
        branches = [embed(x) for embed, x in zip(self.embeds, self.backbone(fringe), strict=True)]
        x = self.encoder[0](branches[0])
        skips = [x]
        for merge, level, branch in zip(self.merges, self.encoder[1:], branches[1:], strict=True):  # type: ignore[arg-type]
            x = level(merge(x, branch))
            skips.append(x)
        skips.pop()
        for expand in self.decoder:
            x = expand(x, skips.pop())
        return in_full_precision(self.head, self.up2(self.up1(x)))
