"""UNet, the paper's baseline (section 5.3.1): four levels down, four up, instance normalisation."""

from torch import Tensor, nn
from torch.nn import functional

from fpp_ml_bench.baselines.networks.base import FringeNetwork, in_full_precision, initialise_convolutions, rate, whole
from fpp_ml_bench.baselines.networks.blocks import DoubleConvolution, Join


class UShape(FringeNetwork):
    """The UNet's encoder and decoder around any ``bottleneck``: (B, 8 width, h, w) -> (B, 16 width, h, w).

    Convolutions start Kaiming-normal (fan out); the bottleneck is left as it comes.
    """

    stride = 16
    last_layer = "dec1"

    def __init__(self, width: int, bottleneck: nn.Module, **options: int | float) -> None:
        super().__init__(width=width, **options)
        widths = [width * 2**level for level in range(5)]
        self.encoder = nn.ModuleList(
            DoubleConvolution(c_in, c_out) for c_in, c_out in zip([1, *widths], widths[:4], strict=False)
        )
        self.decoder = nn.ModuleList(
            Join(2 * c_out, c_out, DoubleConvolution(2 * c_out, c_out)) for c_out in reversed(widths[:4])
        )
        self.head = nn.Conv2d(width, 1, 1)
        initialise_convolutions(self)
        self.bottleneck = bottleneck

    @property
    def probe_layers(self) -> dict[str, nn.Module]:
        layers = {f"enc{level}": block for level, block in enumerate(self.encoder, 1)}
        layers["bottleneck"] = self.bottleneck
        return layers | {f"dec{4 - step}": block for step, block in enumerate(self.decoder)}

    def represent(self, fringe: Tensor) -> Tensor:
        x, skips = fringe, []
        for block in self.encoder:
            x = block(x)
            skips.append(x)
            x = functional.max_pool2d(x, 2)
        x = self.bottleneck(x)
        for block in self.decoder:
            x = block(x, skips.pop())
        return in_full_precision(self.head, x)


class UNet(UShape):
    """Channels width x (1, 2, 4, 8), bottleneck width x 16 at 1/16 of the image; 31,036,481 parameters at width 64.

    width: channels of the first level. dropout: rate of the channel dropout after the bottleneck (the paper's rows: 0).
    Probe layers: enc1..enc4 (enc1 at full resolution), bottleneck, dec4..dec1 (dec1 at full resolution, ``width``
    channels).
    """

    name = "unet"

    def __init__(self, *, width: int = 64, dropout: float = 0.0) -> None:
        width = whole(self.name, "width", width)
        dropout = rate(self.name, "dropout", dropout)
        bottleneck = DoubleConvolution(8 * width, 16 * width)
        initialise_convolutions(bottleneck)
        super().__init__(width, nn.Sequential(bottleneck, nn.Dropout2d(dropout)), dropout=dropout)
