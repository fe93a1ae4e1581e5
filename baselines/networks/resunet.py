"""ResUNet (paper section 5.6): a UNet of residual blocks on four levels, with batch normalisation."""

from torch import Tensor, nn

from fpp_ml_bench.baselines.networks.base import FringeNetwork, in_full_precision, initialise_convolutions, whole
from fpp_ml_bench.baselines.networks.blocks import Join, ResidualBlock


class ResUNet(FringeNetwork):
    """Channels width x (1, 2, 4, 8), two residual blocks a level; 88,941,841 parameters at width 120.

    The paper's four levels end at 1/8 of the image, and the bottleneck, two blocks more, stays there. Each level but
    the first starts with stride 2. Convolutions start Kaiming-normal (fan out). Probe layers: enc1..enc4, bottleneck,
    dec3..dec1 (dec1 at full resolution, ``width`` channels).
    """

    name = "resunet"
    stride = 8
    last_layer = "dec1"

    def __init__(self, *, width: int = 120) -> None:
        width = whole(self.name, "width", width)
        super().__init__(width=width)
        widths = [width * 2**level for level in range(4)]
        self.encoder = nn.ModuleList(
            nn.Sequential(ResidualBlock(c_in, c_out, 1 if c_in == 1 else 2), ResidualBlock(c_out, c_out))
            for c_in, c_out in zip([1, *widths], widths, strict=False)
        )
        self.bottleneck = nn.Sequential(*(ResidualBlock(widths[3], widths[3]) for _ in range(2)))
        self.decoder = nn.ModuleList(
            Join(
                2 * c_out,
                c_out,
                nn.Sequential(ResidualBlock(2 * c_out, c_out), ResidualBlock(c_out, c_out)),
                skip_first=False,
            )
            for c_out in reversed(widths[:3])
        )
        self.head = nn.Conv2d(width, 1, 1)
        initialise_convolutions(self)

    @property
    def probe_layers(self) -> dict[str, nn.Module]:
        layers = {f"enc{level}": block for level, block in enumerate(self.encoder, 1)}
        layers["bottleneck"] = self.bottleneck
        return layers | {f"dec{3 - step}": block for step, block in enumerate(self.decoder)}

    def represent(self, fringe: Tensor) -> Tensor:
        x, skips = fringe, []
        for block in self.encoder:
            x = block(x)
            skips.append(x)
        x = self.bottleneck(skips.pop())
        for block in self.decoder:
            x = block(x, skips.pop())
        return in_full_precision(self.head, x)
