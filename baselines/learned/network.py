"""The network of fringe-net, a small U-Net, its losses, and the weights that come with the
package."""

from copy import deepcopy
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from fpp_ml_bench.baselines.training.weights import (
    FRINGE_NETWORKS,
    WeightsFile,
    open_weights,
    weights_path,
)
from fpp_ml_bench.errors import NetworkError

BLOCK = 2
"""Pixels along the side of a block that the first layer takes as one."""
CARRIERS = 3
"""Of an answer: the one carrier of a frame with one, then the two of a frame with two
(`warp.PLACES`)."""
CHANNELS = 4
"""Of the input: those of `fringe_net.channels`."""
SCALE_TO_SIGMA = float(np.sqrt(2))
"""Standard deviation of a Laplace distribution, in its scale."""
LOG_SCALES = -6.0, 1.0
"""Least and largest logarithm of the scale that the network states for its phase error in rad."""


def _layers(inputs: int, outputs: int) -> nn.Sequential:
    parts: list[nn.Module] = []
    for width in (inputs, outputs):
        parts += [
            nn.Conv2d(width, outputs, 3, padding=1, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        ]
    return nn.Sequential(*parts)


class UNet(nn.Module):
    """(B, inputs, h, w) -> (B, widths[0], h, w); h and w multiples of 2^(levels - 1)."""

    def __init__(self, inputs: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.encoder = nn.ModuleList(map(_layers, (inputs, *widths), widths))
        self.decoder = nn.ModuleList(
            _layers(fine + deep, fine) for deep, fine in pairwise(reversed(widths))
        )

    def forward(self, x: Tensor) -> Tensor:
        skips: list[Tensor] = []
        for level, block in enumerate(self.encoder):
            skips.append(block(functional.max_pool2d(skips[-1], 2) if level else x))
        deep = skips.pop()
        for block in self.decoder:
            deep = block(
                torch.cat([skips.pop(), functional.interpolate(deep, scale_factor=2.0)], dim=1)
            )
        return deep


class FringeNet(nn.Module):
    """(B, `CHANNELS`, H, W) -> (B, 3 K + 1, H, W): of K = `CARRIERS` the numerators of the wrapped
    phases, then the denominators, in the amplitude of the surroundings, then the logarithms of the
    scale in rad of the phase errors; last the logit of a pixel to be object. ``widths``: channels of
    each level, the first at half the image's resolution; ``fine``: of the maps at full resolution. H
    and W must be multiples of ``stride``."""

    def __init__(self, widths: tuple[int, ...] = (32, 48, 64, 96), fine: int = 16) -> None:
        super().__init__()
        widths = tuple(widths)
        if not widths or min((*widths, fine)) < 1:
            raise NetworkError(f"expected positive widths; got {widths}, fine {fine}")
        self.options = {"widths": list(widths), "fine": fine}
        self.stride = BLOCK * 2 ** (len(widths) - 1)
        self.body = UNet(CHANNELS * BLOCK**2, widths)
        self.spread = nn.Conv2d(widths[0], fine * BLOCK**2, 1)
        self.fine = nn.Sequential(
            nn.Conv2d(fine + CHANNELS, fine, 3, padding=1), nn.ReLU(inplace=True)
        )
        self.answer = nn.Conv2d(fine, 3 * CARRIERS + 1, 1)

    def forward(self, x: Tensor) -> Tensor:
        if x.shape[-2] % self.stride or x.shape[-1] % self.stride:
            raise NetworkError(
                f"height and width: expected multiples of {self.stride}, got {tuple(x.shape[-2:])}"
            )
        deep = self.spread(self.body(functional.pixel_unshuffle(x, BLOCK)))
        answers = self.answer(
            self.fine(torch.cat([functional.pixel_shuffle(deep, BLOCK), x], dim=1))
        )
        vectors, scales = answers[:, : 2 * CARRIERS], answers[:, 2 * CARRIERS : -1]
        return torch.cat([vectors, scales.clamp(*LOG_SCALES), answers[:, -1:]], dim=1)

    def folded(self) -> Self:
        """The same network for inference, with the normalisation folded into the convolutions: less
        to compute."""
        network = deepcopy(self).eval()
        for block in (*network.body.encoder, *network.body.decoder):
            for number in (0, 3):
                block[number] = fuse_conv_bn_eval(block[number], block[number + 1])  # type: ignore[index,operator]
                block[number + 1] = nn.Identity()  # type: ignore[index,operator]
        return network.to(memory_format=torch.channels_last)  # type: ignore[no-any-return,call-overload]

    def outputs(self, x: NDArray) -> NDArray[np.float32]:
        """Its answer (3 K + 1, h, w) to one image's maps (C, h, w) of any size."""
        height, width = x.shape[-2:]
        padded = np.pad(x, [(0, 0), (0, -height % self.stride), (0, -width % self.stride)])
        batch = torch.from_numpy(padded)[None].contiguous(memory_format=torch.channels_last)
        with torch.inference_mode():
            return self(batch)[0, ..., :height, :width].numpy()  # type: ignore[no-any-return]


SHIPPED = Path(__file__).resolve().parent / "weights"
"""Folder of the weights that come with the package."""


def load_net(name_or_path: str | Path, folded: bool = True) -> WeightsFile:
    """Weights that come with the package, or of a file; ``folded``: for inference alone, False to
    train on. Raises what `open_weights` raises."""
    file = open_weights(weights_path(name_or_path, SHIPPED), FRINGE_NETWORKS)
    return replace(file, network=file.network.folded()) if folded else file
