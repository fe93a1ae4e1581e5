"""The network: a weight for each neighbour of a pixel, whether a pixel is object, and the error that is left."""

from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from fpp_ml_bench.baselines.learned.network import UNet, fold
from fpp_ml_bench.errors import NetworkError

REACH = 2  # px to the farthest neighbour along an axis
NEIGHBOURS = (2 * REACH + 1) ** 2
FIRST_BIAS = 3.0  # start value of the bias of the pixel itself
ABSENT = -1e4  # logit of a neighbour without a depth: finite, for gradients to stay so
BOUND_SIGMAS = 3.0  # largest change of a depth, in its own standard uncertainties
LOG_SCALES = -4.0, 3.0  # least and largest logarithm of the scale that the network states


class DepthFilter(nn.Module):
    """Depth as a weighted average of the depths around it (a kernel-predicting network, Bako et al. 2017): it can't
    give a depth that no neighbour has. Takes ``x`` (B, C, h, w), and (B, h, w) each ``depth_mm``, ``sigma_mm`` and
    ``found`` of a `DepthScene`. Gives (B, h, w) each the depth in mm, changed by at most `BOUND_SIGMAS` where one was
    found; the logit of a pixel to be object; the logarithm of the scale of the error that is left, in median sigmas of
    the scene; and whether a neighbour has a depth. h and w must be multiples of ``stride``."""

    def __init__(self, channels: int, widths: tuple[int, ...] = (16, 24, 32)) -> None:
        super().__init__()
        widths = tuple(widths)
        if not widths or min((*widths, channels)) < 1:
            raise NetworkError(f"expected positive widths and channels; got widths {widths}, channels {channels}")
        self.options: dict[str, Any] = {"channels": channels, "widths": list(widths)}
        self.stride = 2 ** (len(widths) - 1)
        self.body = UNet(channels, widths)
        self.answer = nn.Conv2d(widths[0], NEIGHBOURS + 2, 1)
        nn.init.normal_(self.answer.weight, std=0.05)
        bias = torch.zeros(NEIGHBOURS + 2)
        bias[NEIGHBOURS // 2] = FIRST_BIAS
        self.answer.bias = nn.Parameter(bias)

    def folded(self) -> "DepthFilter":
        """The same network for inference, with the normalisation folded into the convolutions."""
        network = deepcopy(self).eval()
        fold(network.body)
        return network

    def forward(self, x: Tensor, depth_mm: Tensor, sigma_mm: Tensor, found: Tensor) -> tuple[Tensor, ...]:
        if x.shape[-2] % self.stride or x.shape[-1] % self.stride:
            raise NetworkError(f"height and width: expected multiples of {self.stride}, got {tuple(x.shape[-2:])}")
        answers = self.answer(self.body(x))
        depths, present = _around(depth_mm), _around(found.to(x.dtype)) > 0
        logits = torch.where(present, answers[:, :NEIGHBOURS], torch.tensor(ABSENT))
        average = (torch.softmax(logits, dim=1) * depths).sum(dim=1)
        most = BOUND_SIGMAS * sigma_mm
        bounded = depth_mm + torch.maximum(torch.minimum(average - depth_mm, most), -most)
        depth = torch.where(found, bounded, average)
        return depth, answers[:, NEIGHBOURS], answers[:, NEIGHBOURS + 1].clamp(*LOG_SCALES), present.any(dim=1)


def _around(maps: Tensor) -> Tensor:
    """Values (B, `NEIGHBOURS`, h, w) of every pixel's neighbours in maps (B, h, w), 0 outside the image."""
    batch, height, width = maps.shape
    return functional.unfold(maps[:, None], 2 * REACH + 1, padding=REACH).view(batch, NEIGHBOURS, height, width)
