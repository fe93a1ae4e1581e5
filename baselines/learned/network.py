"""The networks inside a route, a small U-Net with heads each: of a phase (order, mask, correction,
scale), and of a decoded depth (neighbours' weights, mask, scale). Also the losses of these heads,
and their weights by name."""

from copy import deepcopy
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from fpp_ml_bench.baselines.learned.inputs import PHASE_CHANNELS, SIDES, STEPS
from fpp_ml_bench.baselines.training.weights import (
    PHASE_NETWORKS,
    Family,
    WeightsFile,
    open_weights,
    weights_path,
)
from fpp_ml_bench.errors import NetworkError

BLOCK = 2  # pixels along the side of a block that the first layer takes as one
COARSE = 4  # pixels along a block that the order's branch averages
ORDER_SHARE = 0.1  # share of the order's gradient that reaches the branch of phase and mask
TRUST = 6.0  # start value of the factor by which a proposal's brightness misfit lowers its logit
FIRST_BIAS = 2.5  # start value of the biases of the base order and of no correction
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


class Refiner(nn.Module):
    """A network inside a route: `UNet` bodies with heads, built again by ``options``. The first
    input is (B, C, h, w), h and w multiples of ``stride``."""

    options: dict[str, Any]
    stride: int

    def check(self, x: Tensor) -> None:
        if x.shape[-2] % self.stride or x.shape[-1] % self.stride:
            raise NetworkError(
                f"height and width: expected multiples of {self.stride}, got {tuple(x.shape[-2:])}"
            )

    def folded(self) -> Self:
        """The same network for inference, with the normalisation folded into the convolutions: less
        to compute."""
        network = deepcopy(self).eval()
        for body in network.modules():
            for block in (*body.encoder, *body.decoder) if isinstance(body, UNet) else ():
                for number in (0, 3):
                    block[number] = fuse_conv_bn_eval(block[number], block[number + 1])
                    block[number + 1] = nn.Identity()
        return network.to(memory_format=torch.channels_last)  # type: ignore[no-any-return,call-overload]

    def outputs(self, *maps: NDArray) -> list[NDArray]:
        """Its outputs (..., h, w) for one image's ``maps`` (..., h, w) of any size."""
        height, width = maps[0].shape[-2:]
        pad = [(0, -height % self.stride), (0, -width % self.stride)]
        batch = [
            torch.from_numpy(np.pad(part, [(0, 0)] * (part.ndim - 2) + pad))[None] for part in maps
        ]
        batch[0] = batch[0].contiguous(memory_format=torch.channels_last)
        with torch.inference_mode():
            return [out[0, ..., :height, :width].numpy() for out in self(*batch)]


def _first_answers(layer: nn.Conv2d, biases: list[int], value: float) -> nn.Conv2d:
    """``layer`` with small weights and biases of 0, but ``value`` for the answers ``biases``."""
    nn.init.normal_(layer.weight, std=0.05)
    bias = torch.zeros(layer.out_channels)
    bias[biases] = value
    layer.bias = nn.Parameter(bias)
    return layer


class PhaseNet(Refiner):
    """(B, C, H, W) -> order logits (B, 3, H, W), mask logits (B, H, W), phase correction in rad (B,
    H, W), and the logarithm of the scale in rad of the phase error that is left (B, H, W). The
    correction is a weighted average of the corrections that a pixel's surroundings propose
    (`inputs.SIDES`) and of none, with weights from the network, plus a free part of at most half of
    ``bound_rad``, clipped at ``bound_rad``. ``uncertain``: that it states this scale; networks of
    earlier versions, which did not, are refused. ``channels``: maps that it takes, the last of them
    the corrections of the sides, the misfit of none, and theirs. ``widths``: channels of each
    level, the first at half the image's resolution; ``squeezed`` and ``fine``: of the maps at full
    resolution, before and after them; ``order_widths``: of the branch that looks for the order, at
    a quarter of the resolution. H and W must be multiples of ``stride``."""

    def __init__(
        self,
        widths: tuple[int, ...] = (24, 32, 48, 64),
        fine: int = 14,
        squeezed: int = 20,
        order_widths: tuple[int, ...] = (32, 48, 64),
        bound_rad: float = 1.5708,
        channels: int = len(PHASE_CHANNELS),
        uncertain: bool = True,
    ) -> None:
        super().__init__()
        widths, order_widths = tuple(widths), tuple(order_widths)
        if (
            min((*widths, *order_widths, fine, squeezed, channels - 2 * len(SIDES))) < 1
            or not 0 < bound_rad < 3.1416
        ):
            raise NetworkError(
                f"expected positive widths and bound_rad between 0 and pi; got widths {widths}, "
                f"order_widths "
                f"{order_widths}, fine {fine}, squeezed {squeezed}, bound_rad {bound_rad}"
            )
        if not uncertain:
            raise NetworkError(
                "expected a network that states its uncertainty, uncertain true; train it again"
            )
        self.options = {
            "widths": list(widths),
            "fine": fine,
            "squeezed": squeezed,
            "order_widths": list(order_widths),
            "bound_rad": bound_rad,
            "channels": channels,
            "uncertain": uncertain,
        }
        self.bound_rad, self.uncertain = bound_rad, uncertain
        self.stride = max(BLOCK * 2 ** (len(widths) - 1), COARSE * 2 ** (len(order_widths) - 1))
        self.squeeze = nn.Sequential(nn.Conv2d(channels, squeezed, 1), nn.ReLU(inplace=True))
        self.body = UNet(squeezed * BLOCK**2, widths)
        self.spread = nn.Conv2d(widths[0], fine * BLOCK**2, 1)
        self.fine = nn.Sequential(
            nn.Conv2d(fine + squeezed, fine, 3, padding=1), nn.ReLU(inplace=True)
        )
        self.answer = nn.Conv2d(fine, len(STEPS) + 2 + 1 + len(SIDES) + 1, 1)
        self.trust = nn.Parameter(torch.tensor(TRUST))
        self.order_body = UNet(channels, order_widths)
        self.order_answer = nn.Conv2d(order_widths[0], len(STEPS), 1)
        _first_answers(self.answer, [1, 5], FIRST_BIAS)

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        self.check(x)
        squeezed = self.squeeze(x)
        deep = self.body(functional.pixel_unshuffle(squeezed, BLOCK))
        pixels = functional.pixel_shuffle(self.spread(deep), BLOCK)
        answers = self.answer(self.fine(torch.cat([pixels, squeezed], dim=1)))
        order = self.order_answer(self.order_body(functional.avg_pool2d(x, COARSE)))
        order = functional.interpolate(
            order, scale_factor=float(COARSE), mode="bilinear", align_corners=False
        )
        # The order's loss is large where a whole region is wrong; it must not outweigh the phase's
        # loss in the layers that both use.
        order = order + ORDER_SHARE * answers[:, :3] + (1 - ORDER_SHARE) * answers[:, :3].detach()
        sides = len(SIDES)
        proposed, misfits = x[:, -2 * sides - 1 : -sides - 1], x[:, -sides - 1 :]
        shares = torch.softmax(answers[:, 5 : 6 + sides] - self.trust * misfits, dim=1)[:, 1:]
        correction = (shares * proposed).sum(dim=1) + 0.5 * self.bound_rad * torch.tanh(
            answers[:, 4]
        )
        bounded = correction.clamp(-self.bound_rad, self.bound_rad)
        return order, answers[:, 3], bounded, answers[:, -1].clamp(*LOG_SCALES)


class FringeNet(Refiner):
    """(B, C, H, W) -> (B, 3 K, H, W): of K ``carriers`` the numerators of the wrapped phases, then
    the denominators, in the amplitude of the surroundings, then the logarithms of the scale in rad
    of the phase errors; and with ``mask`` (B, 3 K + 1, H, W): last the logit of a pixel to be
    object, for which the input has two channels more. ``widths``: channels of each level, the first
    at half the image's resolution; ``fine``: of the maps at full resolution. H and W must be
    multiples of ``stride``."""

    def __init__(
        self,
        carriers: int = 1,
        widths: tuple[int, ...] = (32, 48, 64, 96),
        fine: int = 16,
        mask: bool = False,
    ) -> None:
        super().__init__()
        widths = tuple(widths)
        if not widths or min((*widths, fine)) < 1 or carriers not in (1, 2, 3):
            raise NetworkError(
                f"expected 1 to 3 carriers and positive widths; got {carriers}, {widths}, fine "
                f"{fine}"
            )
        self.options = {"carriers": carriers, "widths": list(widths), "fine": fine}
        self.options |= {"mask": True} if mask else {}
        self.channels, self.mask = 4 if mask else 2, mask
        self.stride, self.carriers = BLOCK * 2 ** (len(widths) - 1), carriers
        self.body = UNet(self.channels * BLOCK**2, widths)
        self.spread = nn.Conv2d(widths[0], fine * BLOCK**2, 1)
        self.fine = nn.Sequential(
            nn.Conv2d(fine + self.channels, fine, 3, padding=1), nn.ReLU(inplace=True)
        )
        self.answer = nn.Conv2d(fine, 3 * carriers + mask, 1)

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        self.check(x)
        deep = self.spread(self.body(functional.pixel_unshuffle(x, BLOCK)))
        answers = self.answer(
            self.fine(torch.cat([functional.pixel_shuffle(deep, BLOCK), x], dim=1))
        )
        count = self.carriers
        vectors, scales = answers[:, : 2 * count], answers[:, 2 * count : 3 * count]
        return (torch.cat([vectors, scales.clamp(*LOG_SCALES), answers[:, 3 * count :]], dim=1),)


REACH = 2  # px to the farthest neighbour along an axis
NEIGHBOURS = (2 * REACH + 1) ** 2
OWN_BIAS = 3.0  # start value of the bias of the pixel itself
ABSENT = -1e4  # logit of a neighbour without a depth: finite, for gradients to stay so
BOUND_SIGMAS = 3.0  # largest change of a depth, in its own standard uncertainties
LOG_UNITS = -4.0, 3.0  # the same of a scale in median sigmas


class DepthFilter(Refiner):
    """Depth as a weighted average of the depths around it (a kernel-predicting network, Bako et al.
    2017): it can't give a depth that no neighbour has. Takes ``x`` (B, C, h, w), and (B, h, w) each
    ``depth_mm``, ``sigma_mm`` and ``found`` of a `DepthScene`. Gives (B, h, w) each the depth in
    mm, changed by at most `BOUND_SIGMAS` where one was found; the logit of a pixel to be object;
    the logarithm of the scale of the error that is left, in median sigmas of the scene; and whether
    a neighbour has a depth. h and w must be multiples of ``stride``."""

    def __init__(self, channels: int, widths: tuple[int, ...] = (16, 24, 32)) -> None:
        super().__init__()
        widths = tuple(widths)
        if not widths or min((*widths, channels)) < 1:
            raise NetworkError(
                f"expected positive widths and channels; got widths {widths}, channels {channels}"
            )
        self.options = {"channels": channels, "widths": list(widths)}
        self.stride = 2 ** (len(widths) - 1)
        self.body = UNet(channels, widths)
        self.answer = _first_answers(
            nn.Conv2d(widths[0], NEIGHBOURS + 2, 1), [NEIGHBOURS // 2], OWN_BIAS
        )

    def forward(
        self, x: Tensor, depth_mm: Tensor, sigma_mm: Tensor, found: Tensor
    ) -> tuple[Tensor, ...]:
        self.check(x)
        answers = self.answer(self.body(x))
        depths, present = _around(depth_mm), _around(found.to(x.dtype)) > 0
        logits = torch.where(present, answers[:, :NEIGHBOURS], torch.tensor(ABSENT))
        average = (torch.softmax(logits, dim=1) * depths).sum(dim=1)
        most = BOUND_SIGMAS * sigma_mm
        bounded = depth_mm + torch.maximum(torch.minimum(average - depth_mm, most), -most)
        depth = torch.where(found, bounded, average)
        return (
            depth,
            answers[:, NEIGHBOURS],
            answers[:, NEIGHBOURS + 1].clamp(*LOG_UNITS),
            present.any(dim=1),
        )


def _around(maps: Tensor) -> Tensor:
    """Values (B, `NEIGHBOURS`, h, w) of every pixel's neighbours in maps (B, h, w), 0 outside the
    image."""
    batch, height, width = maps.shape
    return functional.unfold(maps[:, None], 2 * REACH + 1, padding=REACH).view(
        batch, NEIGHBOURS, height, width
    )


SHIPPED = Path(__file__).resolve().parent / "weights"
"""Folder of the weights that come with the package."""
DEFAULT = "phase-net-one-albedo"


def load_net(
    name_or_path: str | Path = DEFAULT, folded: bool = True, family: Family = PHASE_NETWORKS
) -> WeightsFile:
    """Weights of a learned method that come with the package, or of a file; ``folded``: for
    inference alone (`PhaseNet.folded`), False to train on. Raises what `open_weights` raises."""
    file = open_weights(weights_path(name_or_path, SHIPPED), family)
    return replace(file, network=file.network.folded()) if folded else file


def mean_over(values: Tensor, where: Tensor) -> Tensor:
    """Mean of ``values`` over the pixels ``where``; 0 without one."""
    return (values * where).sum() / where.sum().clamp(min=1)


def mask_loss(logit: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """Binary cross-entropy of the object's ``logit`` over ``valid`` pixels."""
    by_pixel = functional.binary_cross_entropy_with_logits(logit, target.float(), reduction="none")
    return mean_over(by_pixel, valid)


def scale_loss(error: Tensor, scale: Tensor, where: Tensor) -> Tensor:
    """Negative log-likelihood of an absolute ``error`` under a Laplace distribution of ``scale``, a
    logarithm."""
    return mean_over(error * torch.exp(-scale) + scale, where)
