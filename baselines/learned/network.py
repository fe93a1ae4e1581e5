"""The network: a small U-Net on 2 x 2 blocks of pixels. For each pixel it gives the order, object or background, and a
phase correction. Also the weights files of all networks inside a route: written in half precision, read and checked."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from fpp_ml_bench.baselines.learned.inputs import CHANNELS, SIDES, STEPS
from fpp_ml_bench.baselines.training.weights import (
    PHASE_NETWORKS,
    Family,
    NetConfig,
    read_file,
    weights_path,
    write_file,
)
from fpp_ml_bench.errors import NetworkError, WeightsError
from fpp_ml_bench.files import printable

BLOCK = 2  # pixels along the side of a block that the first layer takes as one
COARSE = 4  # pixels along a block that the order's branch averages
ORDER_SHARE = 0.1  # share of the order's gradient that reaches the branch of phase and mask
TRUST = 6.0  # start value of the factor by which a proposal's brightness misfit lowers its logit
FIRST_BIAS = 2.5  # start value of the biases of the base order and of no correction
LOG_SCALES = -6.0, 1.0  # least and largest logarithm of the scale that the network states for its phase error in rad


def _layers(inputs: int, outputs: int) -> nn.Sequential:
    parts: list[nn.Module] = []
    for width in (inputs, outputs):
        parts += [nn.Conv2d(width, outputs, 3, padding=1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)]
    return nn.Sequential(*parts)


class UNet(nn.Module):
    """(B, inputs, h, w) -> (B, widths[0], h, w); h and w multiples of 2^(levels - 1)."""

    def __init__(self, inputs: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.encoder = nn.ModuleList(map(_layers, (inputs, *widths), widths))
        self.decoder = nn.ModuleList(_layers(fine + deep, fine) for deep, fine in pairwise(reversed(widths)))

    def forward(self, x: Tensor) -> Tensor:
        skips: list[Tensor] = []
        for level, block in enumerate(self.encoder):
            skips.append(block(functional.max_pool2d(skips[-1], 2) if level else x))
        deep = skips.pop()
        for block in self.decoder:
            deep = block(torch.cat([skips.pop(), functional.interpolate(deep, scale_factor=2.0)], dim=1))
        return deep


def fold(body: UNet) -> None:
    """Fold the normalisation of ``body`` into its convolutions, for inference: less to compute."""
    for block in (*body.encoder, *body.decoder):
        for number in (0, 3):
            block[number] = fuse_conv_bn_eval(block[number], block[number + 1])
            block[number + 1] = nn.Identity()


class PhaseNet(nn.Module):
    """(B, C, H, W) -> order logits (B, 3, H, W), mask logits (B, H, W), phase correction in rad (B, H, W), and the
    logarithm of the scale in rad of the phase error that is left (B, H, W). The correction is a weighted average of the
    corrections that a pixel's surroundings propose (`inputs.SIDES`) and of none, with weights from the network, plus a
    free part of at most half of ``bound_rad``, clipped at ``bound_rad``.
    ``uncertain``: that it states this scale; networks of earlier versions, which did not, are refused.
    ``channels``: maps that it takes, the last of them the corrections of the sides, the misfit of none, and theirs.
    ``widths``: channels of each level, the first at half the image's resolution; ``squeezed`` and ``fine``: of the maps
    at full resolution, before and after them; ``order_widths``: of the branch that looks for the order, at a quarter of
    the resolution. H and W must be multiples of ``stride``."""

    def __init__(
        self,
        widths: tuple[int, ...] = (24, 32, 48, 64),
        fine: int = 14,
        squeezed: int = 20,
        order_widths: tuple[int, ...] = (32, 48, 64),
        bound_rad: float = 1.5708,
        channels: int = len(CHANNELS),
        uncertain: bool = True,
    ) -> None:
        super().__init__()
        widths, order_widths = tuple(widths), tuple(order_widths)
        if min((*widths, *order_widths, fine, squeezed, channels - 2 * len(SIDES))) < 1 or not 0 < bound_rad < 3.1416:
            raise NetworkError(
                f"expected positive widths and bound_rad between 0 and pi; got widths {widths}, order_widths "
                f"{order_widths}, fine {fine}, squeezed {squeezed}, bound_rad {bound_rad}"
            )
        if not uncertain:
            raise NetworkError("expected a network that states its uncertainty, uncertain true; train it again")
        self.options: dict[str, Any] = {
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
        self.fine = nn.Sequential(nn.Conv2d(fine + squeezed, fine, 3, padding=1), nn.ReLU(inplace=True))
        self.answer = nn.Conv2d(fine, len(STEPS) + 2 + 1 + len(SIDES) + 1, 1)
        self.trust = nn.Parameter(torch.tensor(TRUST))
        self.order_body = UNet(channels, order_widths)
        self.order_answer = nn.Conv2d(order_widths[0], len(STEPS), 1)
        nn.init.normal_(self.answer.weight, std=0.05)
        bias = torch.zeros(self.answer.out_channels)
        bias[[1, 5]] = FIRST_BIAS
        self.answer.bias = nn.Parameter(bias)

    def folded(self) -> "PhaseNet":
        """The same network for inference, with the normalisation folded into the convolutions."""
        network = deepcopy(self).eval()
        for body in (network.body, network.order_body):
            fold(body)
        return network.to(memory_format=torch.channels_last)  # type: ignore[no-any-return,call-overload]

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        if x.shape[-2] % self.stride or x.shape[-1] % self.stride:
            raise NetworkError(f"height and width: expected multiples of {self.stride}, got {tuple(x.shape[-2:])}")
        squeezed = self.squeeze(x)
        deep = self.body(functional.pixel_unshuffle(squeezed, BLOCK))
        pixels = functional.pixel_shuffle(self.spread(deep), BLOCK)
        answers = self.answer(self.fine(torch.cat([pixels, squeezed], dim=1)))
        order = self.order_answer(self.order_body(functional.avg_pool2d(x, COARSE)))
        order = functional.interpolate(order, scale_factor=float(COARSE), mode="bilinear", align_corners=False)
        # The order's loss is large where a whole region is wrong; it must not outweigh the phase's loss in the layers
        # that both use.
        order = order + ORDER_SHARE * answers[:, :3] + (1 - ORDER_SHARE) * answers[:, :3].detach()
        sides = len(SIDES)
        proposed, misfits = x[:, -2 * sides - 1 : -sides - 1], x[:, -sides - 1 :]
        shares = torch.softmax(answers[:, 5 : 6 + sides] - self.trust * misfits, dim=1)[:, 1:]
        correction = (shares * proposed).sum(dim=1) + 0.5 * self.bound_rad * torch.tanh(answers[:, 4])
        bounded = correction.clamp(-self.bound_rad, self.bound_rad)
        return order, answers[:, 3], bounded, answers[:, -1].clamp(*LOG_SCALES)


SHIPPED = Path(__file__).resolve().parent / "weights"  # folder of the weights that come with the package
DEFAULT = "phase-net-one-albedo"


@dataclass(frozen=True)
class NetFile:
    """A checked file and the network in it, ready to run."""

    path: Path
    config: NetConfig
    network: PhaseNet
    sha256: str


def save_net(path: Path, network: nn.Module, config: NetConfig, family: Family = PHASE_NETWORKS) -> str:
    """Write ``network`` to ``path`` in half precision, complete or not at all; the file's SHA-256. `WeightsError` for
    tensors that are not finite in half precision, and for a path that can't be written."""
    tensors = {}
    for name, tensor in network.state_dict().items():
        tensors[name] = tensor.detach().cpu().half() if tensor.is_floating_point() else tensor
        if not bool(tensors[name].isfinite().all()):
            raise WeightsError(f"{path}: {name} is not finite in half precision; the training diverged")
    return write_file(path, family, config, tensors)


Network = TypeVar("Network", bound=nn.Module)


def read_net(
    path: Path, build: Callable[..., Network], family: Family = PHASE_NETWORKS
) -> tuple[NetConfig, Network, str]:
    """Configuration, network, float32, and SHA-256 of a file of ``family`` whose options ``build`` takes.
    `WeightsError` for a file that is absent, damaged, of another kind or version, or whose tensors do not fit its
    configuration."""
    shown = printable(str(path), 500)
    config, tensors, digest = read_file(path, family)
    try:
        network = build(**config.options)
        network.load_state_dict({name: t.float() if t.is_floating_point() else t for name, t in tensors.items()})
    except (NetworkError, TypeError, ValueError, RuntimeError) as error:
        raise WeightsError(f"{shown}: its tensors are not those of its network: {printable(str(error), 300)}") from None
    if not all(bool(torch.isfinite(t).all()) for t in network.state_dict().values()):
        raise WeightsError(f"{shown}: holds values that are not finite; copy or train it again")
    return config, network, digest


def load_net(name_or_path: str | Path = DEFAULT, folded: bool = True, shipped: Path = SHIPPED) -> NetFile:
    """Weights in the folder ``shipped`` or of a file, float32; ``folded``: for inference alone (`PhaseNet.folded`),
    False to train on. Raises what `read_net` raises."""
    path = weights_path(name_or_path, shipped)
    config, network, digest = read_net(path, PhaseNet)
    return NetFile(path, config, network.folded() if folded else network, digest)
