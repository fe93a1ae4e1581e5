"""The network: a small U-Net that works on 2 x 2 blocks of pixels and answers for every pixel.

Three answers a pixel: a logit for each of three neighbouring orders, a logit for being object, and a correction of the
phase that a tanh keeps within ``bound_rad``. It starts as the measured route: at the first step it moves nothing.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from fpp_ml_bench.baselines.phase_network.inputs import CHANNELS, STEPS
from fpp_ml_bench.errors import NetworkError

BLOCK = 2
"""Pixels along a block that the first layer takes at once."""
BASE_LEAD = 4.0
"""Logit by which the base order leads before anything is learned."""


def _layers(inputs: int, outputs: int) -> nn.Sequential:
    parts: list[nn.Module] = []
    for number in range(2):
        parts += [
            nn.Conv2d(inputs if number == 0 else outputs, outputs, 3, padding=1, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        ]
    return nn.Sequential(*parts)


class PhaseNet(nn.Module):
    """(B, 17, H, W) -> order logits (B, 3, H, W), mask logits (B, H, W), phase correction in rad (B, H, W).

    ``widths``: channels of each level, the first at half the image's resolution; ``bound_rad``: largest correction.
    H and W must be multiples of ``stride``.
    """

    def __init__(self, widths: tuple[int, ...] = (32, 48, 64, 80), fine: int = 16, bound_rad: float = 1.5708) -> None:
        super().__init__()
        widths = tuple(widths)
        if len(widths) < 2 or min(widths) < 1 or fine < 1 or not 0 < bound_rad < 3.1416:
            raise NetworkError(
                f"expected two or more positive widths, fine above 0, bound_rad between 0 and pi; got widths {widths}, "
                f"fine {fine}, bound_rad {bound_rad}"
            )
        self.options: dict[str, Any] = {"widths": list(widths), "fine": fine, "bound_rad": bound_rad}
        self.bound_rad, self.stride = bound_rad, BLOCK * 2 ** (len(widths) - 1)
        inputs = len(CHANNELS)
        self.encoder = nn.ModuleList(
            _layers(inputs * BLOCK**2 if level == 0 else widths[level - 1], width) for level, width in enumerate(widths)
        )
        self.decoder = nn.ModuleList(
            _layers(widths[level] + widths[level + 1], widths[level]) for level in reversed(range(len(widths) - 1))
        )
        self.spread = nn.Conv2d(widths[0], fine * BLOCK**2, 1)
        self.fine = nn.Sequential(nn.Conv2d(fine + inputs, fine, 3, padding=1), nn.ReLU(inplace=True))
        self.answer = nn.Conv2d(fine, len(STEPS) + 2, 1)
        nn.init.zeros_(self.answer.weight)
        with torch.no_grad():
            self.answer.bias.copy_(torch.tensor([0.0, BASE_LEAD, 0.0, 0.0, 0.0]))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        if x.shape[-2] % self.stride or x.shape[-1] % self.stride:
            raise NetworkError(f"height and width: expected multiples of {self.stride}, got {tuple(x.shape[-2:])}")
        kept = []
        deep = functional.pixel_unshuffle(x, BLOCK)
        for level, block in enumerate(self.encoder):
            deep = block(functional.max_pool2d(deep, 2) if level else deep)
            kept.append(deep)
        for level, block in zip(reversed(range(len(kept) - 1)), self.decoder, strict=True):
            deep = block(torch.cat([kept[level], functional.interpolate(deep, scale_factor=2.0)], dim=1))
        pixels = functional.pixel_shuffle(self.spread(deep), BLOCK)
        out = self.answer(self.fine(torch.cat([pixels, x], dim=1)))
        return out[:, :3], out[:, 3], self.bound_rad * torch.tanh(out[:, 4])
