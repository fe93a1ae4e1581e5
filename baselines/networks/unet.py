"""The U-shaped networks: UNet, the paper's baseline (section 5.3.1), with four levels down, four up
and instance normalisation; TransUNet (section 5.6), the UNet with a vision transformer for its
bottleneck; and ResUNet (section 5.6), of residual blocks on four levels, with batch normalisation.

The paper gives TransUNet's sizes and the UNet's levels and number of parameters. The UNet's widths,
norm and first weights, and ResUNet's widths, blocks and norm are those of the authors' published
code (AnushLak/fpp-ml-bench).

A guided UNet sees the phase as further input (the paper's further directions): what a fringe
measures, pixel by pixel. The fringe is demodulated by the carrier of a surface at the rig's
standoff and a Gaussian window of half a period. That gives the phase within a period, how strong
the fringe is, and the depths of the orders around it, which the calibration layer computes: the
network has to choose one, not to find it."""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from fpp_ml_bench.baselines.networks import base
from fpp_ml_bench.baselines.networks.base import (
    DoubleConvolution,
    FringeNetwork,
    Join,
    ResidualBlock,
)
from fpp_ml_bench.baselines.phase.geometry import TAU, CalibrationLayer
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import NetworkError
from fpp_ml_bench.optics.named_rigs import paper_rig


class Levels(FringeNetwork):
    """An encoder, a bottleneck and a decoder that joins what each level of the encoder gave;
    ``pooled``: every level is halved on its way down, else the blocks do so themselves, and the
    last level is no skip."""

    pooled = True
    encoder: nn.ModuleList
    decoder: nn.ModuleList
    bottleneck: nn.Module
    head: nn.Module

    @property
    def probe_layers(self) -> dict[str, nn.Module]:
        layers = {f"enc{level}": block for level, block in enumerate(self.encoder, 1)}
        layers["bottleneck"] = self.bottleneck
        return layers | {
            f"dec{len(self.decoder) - step}": block for step, block in enumerate(self.decoder)
        }

    def represent(self, fringe: Tensor) -> Tensor:
        x, skips = fringe, []
        for block in self.encoder:
            x = block(x)
            skips.append(x)
            x = functional.max_pool2d(x, 2) if self.pooled else x
        x = self.bottleneck(x if self.pooled else skips.pop())
        for block in self.decoder:
            x = block(x, skips.pop())
        return base.in_full_precision(self.head, x)


class UShape(Levels):
    """The UNet's encoder and decoder, Kaiming-normal (fan out), around any ``bottleneck``: (B, 8
    width, h, w) -> (B, 16 width, h, w), left as it comes."""

    stride = 16

    def __init__(
        self, width: int, bottleneck: nn.Module, channels: int = 1, **options: int | float
    ) -> None:
        super().__init__(width=width, **options)
        widths = [width * 2**level for level in range(4)]
        self.encoder = nn.ModuleList(
            DoubleConvolution(c_in, c_out) for c_in, c_out in pairwise([channels, *widths])
        )
        self.decoder = nn.ModuleList(
            Join(2 * c, c, DoubleConvolution(2 * c, c)) for c in reversed(widths)
        )
        self.head = nn.Conv2d(width, 1, 1)
        base.initialise(self, "convolutions")
        self.bottleneck = bottleneck


ORDERS = (-1, 0, 1)  # around the standoff's; the paper's range spans 1.9 periods
WINDOW_PERIODS = 0.5  # sigma
WEAKEST = 1e-3  # modulation of a fringe in [0, 1] that has no phase
GUIDED_CHANNELS = 4 + len(ORDERS)


@dataclass(frozen=True)
class _Constants:
    """``layer``, ``carrier_rad`` (H, W), ``standoff_rad`` (H, W), ``kernel`` (n,) and the working
    ``range_mm``."""

    layer: CalibrationLayer
    carrier_rad: Tensor
    standoff_rad: Tensor
    kernel: Tensor
    range_mm: tuple[float, float]


@lru_cache(maxsize=4)
def _constants(size: int, device: torch.device) -> _Constants:
    rig = paper_rig(size)
    layer = CalibrationLayer.of(rig, "horizontal").tensors(device=device)
    standoff = layer.residual_of_depth(rig.standoff_m * MM_PER_M)
    sigma = WINDOW_PERIODS * rig.image_px_per_period("horizontal")
    half = int(3 * sigma) + 1
    kernel = torch.exp(-0.5 * (torch.arange(-half, half + 1, device=device) / sigma) ** 2)
    return _Constants(
        layer, layer.infinity_rad + standoff, standoff, kernel / kernel.sum(), rig.working_range_mm
    )


class PhaseGuide(nn.Module):
    """A fringe (B, 1, S, S) in [0, 1], frame 0 of the paper's rig at any size, to (B,
    `GUIDED_CHANNELS`, S, S): the fringe, cosine and sine of its phase less the standoff's, its
    modulation, and the depths of `ORDERS`, from 0 at the near to 1 at the far end of the working
    range. Nothing is learned. Raises `NetworkError` for an image that is not square."""

    def forward(self, fringe: Tensor) -> Tensor:
        height, width = fringe.shape[-2:]
        if height != width:
            raise NetworkError(
                f"guided by phase: expected a square image of the paper's rig, got {height} x "
                f"{width}"
            )
        with torch.no_grad(), torch.autocast(fringe.device.type, enabled=False):
            known, grey = _constants(width, fringe.device), fringe.float()
            parts = [grey * torch.cos(known.carrier_rad), -grey * torch.sin(known.carrier_rad)]
            real, imaginary = (_blurred(part, known.kernel) for part in parts)
            strength = torch.hypot(real, imaginary)
            cosine, sine = (part / strength.clamp_min(WEAKEST) for part in (real, imaginary))
            phase, (near_mm, far_mm) = torch.atan2(imaginary, real), known.range_mm
            depths = [
                known.layer.depth_of_residual_mm(known.standoff_rad + phase + TAU * order)
                for order in ORDERS
            ]
            candidates = [((depth - near_mm) / (far_mm - near_mm)).clamp(0, 1) for depth in depths]
            maps = torch.cat([grey, cosine, sine, 4 * strength, *candidates], dim=1)
        return maps.to(fringe.dtype)


def _blurred(image: Tensor, kernel: Tensor) -> Tensor:
    half = len(kernel) // 2
    padded = functional.pad(image, (half, half, half, half), mode="replicate")
    across = functional.conv2d(padded, kernel.view(1, 1, 1, -1))
    return functional.conv2d(across, kernel.view(1, 1, -1, 1))


def re_projection_loss(
    layer: CalibrationLayer, prediction_mm: Tensor, target_mm: Tensor, nearest_mm: float
) -> Tensor:
    """Mean of 1 - cos of the difference of the phases that predicted and true depth (B, 1, H, W)
    would show, over the object (target above 0); 0 without one. It does not see a whole period: as
    far as a fringe tells. Predictions count as ``nearest_mm`` and more, so that they have a
    phase."""
    mask = target_mm > 0
    predicted = layer.residual_of_depth(prediction_mm.clamp_min(nearest_mm))
    true = layer.residual_of_depth(torch.where(mask, target_mm, nearest_mm))
    return ((1 - torch.cos(predicted - true)) * mask).sum() / mask.sum().clamp_min(1)


LEAST_SPREAD = 1e-3  # of a frame that is divided by its own: a quarter of a grey level


class UNet(UShape):
    """Channels width x (1, 2, 4, 8), bottleneck width x 16 at 1/16 of the image; 31,036,481
    parameters at width 64.

    width: channels of the first level. dropout: rate of the channel dropout after the bottleneck
    (the paper's rows: 0). standardised: 1 to subtract each frame's own mean and divide by its
    standard deviation, so that no absolute grey level is seen (the paper's rows: 0). guided: 1 for
    phase and candidate depths as further input channels (`PhaseGuide`), only for the paper's rig
    (the paper's rows: 0). Probe layers: enc1..enc4 (enc1 at full resolution), bottleneck,
    dec4..dec1 (dec1 at full resolution, ``width`` channels).
    """

    name = "unet"
    rules: ClassVar = {"standardised": (0, 1), "guided": (0, 1)}

    def __init__(
        self, *, width: int = 64, dropout: float = 0.0, standardised: int = 0, guided: int = 0
    ) -> None:
        flags = {"standardised": standardised, "guided": guided}
        given = {name: 1 for name, flag in flags.items() if flag}
        bottleneck = DoubleConvolution(8 * width, 16 * width)
        base.initialise(bottleneck, "convolutions")
        deepest = nn.Sequential(bottleneck, nn.Dropout2d(dropout))
        super().__init__(width, deepest, GUIDED_CHANNELS if guided else 1, dropout=dropout, **given)
        self.guide = PhaseGuide() if guided else None

    def represent(self, fringe: Tensor) -> Tensor:
        if "standardised" in self.options:
            spread, mean = torch.std_mean(fringe, dim=(2, 3), keepdim=True)
            fringe = (fringe - mean) / spread.clamp_min(LEAST_SPREAD)
        return super().represent(fringe if self.guide is None else self.guide(fringe))


LAYERS = 8
HEADS = 12
MLP_RATIO = 4


class TokenBottleneck(nn.Module):
    """Patches of a map through a transformer and back, (B, c_in, m, m) -> (B, c_out, m, m). Each p
    x p patch of all ``c_in`` channels becomes one token of ``channels`` numbers, a learned position
    is added, pre-norm layers and a last layer norm follow, and one linear layer turns a token into
    its p x p x ``c_out`` patch."""

    def __init__(self, c_in: int, c_out: int, channels: int, map_size: int, patch: int) -> None:
        super().__init__()
        self.grid = map_size // patch
        self.patch = patch
        self.embed = nn.Conv2d(c_in, channels, patch, patch)
        self.position = nn.Parameter(torch.empty(1, self.grid**2, channels))
        self.layers = nn.Sequential(
            *(base.TransformerLayer(channels, HEADS, MLP_RATIO) for _ in range(LAYERS))
        )
        self.norm = nn.LayerNorm(channels)
        self.unembed = nn.Linear(channels, c_out * patch**2)
        base.initialise(self, "tokens")
        for weight in (self.position, self.embed.weight):
            nn.init.trunc_normal_(weight, std=0.02)
        if self.embed.bias is not None:
            nn.init.zeros_(self.embed.bias)

    def forward(self, x: Tensor) -> Tensor:
        tokens = self.embed(x).flatten(2).transpose(1, 2) + self.position
        patches = self.unembed(self.norm(self.layers(tokens)))
        maps = patches.transpose(1, 2).reshape(-1, patches.shape[2], self.grid, self.grid)
        return functional.pixel_shuffle(maps, self.patch)


class TransUNet(UShape):
    """Encoder and decoder of the UNet around 8 transformer layers of 12 heads; 116,162,881
    parameters at the defaults.

    width: channels of the first level; tokens have 12 x width numbers. map_size: side of the
    bottleneck map, 1/16 of the image side, to which the learned positions tie the network. patch:
    side of a patch, a divisor of ``map_size``.
    """

    name = "transunet"
    rules: ClassVar = {"map_size": (2, 1)}

    def __init__(self, *, width: int = 64, patch: int = 6, map_size: int = 60) -> None:
        if map_size % patch:
            raise NetworkError(
                f"{self.name}: patch must divide map_size; they were {patch} and {map_size}"
            )
        bottleneck = TokenBottleneck(8 * width, 16 * width, 12 * width, map_size, patch)
        super().__init__(width, bottleneck, patch=patch, map_size=map_size)

    def check_size(self, height: int, width: int) -> None:
        side = self.stride * int(self.options["map_size"])
        if (height, width) != (side, side):
            raise NetworkError(
                f"{self.name} was built for images of {side}x{side} px (map_size "
                f"{self.options['map_size']}); it was "
                f"given {height}x{width}; build it with map_size = image side / {self.stride} for "
                f"another size"
            )


class ResUNet(Levels):
    """Channels width x (1, 2, 4, 8), two residual blocks a level; 88,941,841 parameters at width
    120. The paper's four levels end at 1/8 of the image, and the bottleneck, two blocks more, stays
    there. Each level but the first starts with stride 2. Convolutions start Kaiming-normal (fan
    out). Decoder layers: dec3..dec1."""

    name = "resunet"
    stride = 8
    pooled = False

    def __init__(self, *, width: int = 120) -> None:
        super().__init__(width=width)
        widths = [width * 2**level for level in range(4)]
        self.encoder = nn.ModuleList(
            nn.Sequential(
                ResidualBlock(c_in, c_out, 1 if c_in == 1 else 2), ResidualBlock(c_out, c_out)
            )
            for c_in, c_out in pairwise([1, *widths])
        )
        self.bottleneck = nn.Sequential(*(ResidualBlock(widths[3], widths[3]) for _ in range(2)))
        self.decoder = nn.ModuleList(
            Join(
                2 * c,
                c,
                nn.Sequential(ResidualBlock(2 * c, c), ResidualBlock(c, c)),
                skip_first=False,
            )
            for c in reversed(widths[:3])
        )
        self.head = nn.Conv2d(width, 1, 1)
        base.initialise(self, "convolutions")
