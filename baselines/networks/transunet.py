"""TransUNet (paper section 5.6): the UNet with a vision transformer for its bottleneck."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from fpp_ml_bench.baselines.networks.base import initialise_tokens, whole
from fpp_ml_bench.baselines.networks.blocks import TransformerLayer
from fpp_ml_bench.baselines.networks.unet import UShape
from fpp_ml_bench.errors import NetworkError

LAYERS = 8
HEADS = 12
MLP_RATIO = 4


class TokenBottleneck(nn.Module):
    """Patches of a map through a transformer and back, (B, c_in, m, m) -> (B, c_out, m, m).

    Each p x p patch of all ``c_in`` channels becomes one token of ``channels`` numbers, a learned position is added,
    pre-norm layers and a last layer norm follow, and one linear layer turns a token into its p x p x ``c_out`` patch.
    """

    def __init__(self, c_in: int, c_out: int, channels: int, map_size: int, patch: int) -> None:
        super().__init__()
        self.grid = map_size // patch
        self.patch = patch
        self.embed = nn.Conv2d(c_in, channels, patch, patch)
        self.position = nn.Parameter(torch.empty(1, self.grid**2, channels))
        self.layers = nn.Sequential(*(TransformerLayer(channels, HEADS, MLP_RATIO) for _ in range(LAYERS)))
        self.norm = nn.LayerNorm(channels)
        self.unembed = nn.Linear(channels, c_out * patch**2)
        initialise_tokens(self)
        for weight in (self.position, self.embed.weight):
            nn.init.trunc_normal_(weight, std=0.02)
        if self.embed.bias is not None:
            nn.init.zeros_(self.embed.bias)

    def forward(self, x: Tensor) -> Tensor:
        tokens = self.embed(x).flatten(2).transpose(1, 2) + self.position
        patches = self.unembed(self.norm(self.layers(tokens)))
        return functional.pixel_shuffle(
            patches.transpose(1, 2).reshape(-1, patches.shape[2], self.grid, self.grid), self.patch
        )


class TransUNet(UShape):
    """Encoder and decoder of the UNet around 8 transformer layers of 12 heads; 116,162,881 parameters at the defaults.

    width: channels of the first level; tokens have 12 x width numbers. map_size: side of the bottleneck map, 1/16 of
    the image side (60 for 960 px). patch: side of a patch in that map, a divisor of ``map_size``. The learned
    positions tie the network to images of 16 x map_size px a side. Probe layers as the UNet's.
    """

    name = "transunet"

    def __init__(self, *, width: int = 64, patch: int = 6, map_size: int = 60) -> None:
        width = whole(self.name, "width", width)
        patch = whole(self.name, "patch", patch)
        map_size = whole(self.name, "map_size", map_size, least=2)
        if map_size % patch:
            raise NetworkError(f"{self.name}: patch must divide map_size; they were {patch} and {map_size}")
        bottleneck = TokenBottleneck(8 * width, 16 * width, 12 * width, map_size, patch)
        super().__init__(width, bottleneck, patch=patch, map_size=map_size)

    def check_size(self, height: int, width: int) -> None:
        side = self.stride * int(self.options["map_size"])
        if (height, width) != (side, side):
            raise NetworkError(
                f"{self.name} was built for images of {side}x{side} px (map_size {self.options['map_size']}); it was "
                f"given {height}x{width}; build it with map_size = image side / {self.stride} for another size"
            )
