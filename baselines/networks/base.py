"""The base of all networks: input check, the options that rebuild them, and the layers for probes."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from fpp_ml_bench.errors import NetworkError


class FringeNetwork(nn.Module, ABC):
    """A network from one fringe image to one depth map in the training representation.

    ``forward`` takes a floating tensor (B, 1, H, W), fringe in [0, 1], and gives the same shape. H and W must be
    multiples of `stride` and at least twice it (at a single bottleneck pixel, instance and batch normalisation would
    have no spread to divide by); another input raises `NetworkError`.

    name: what `build` calls it. options: JSON scalars with which `build` makes it again.
    last_layer: name in `probe_layers` of the last decoder layer, whose output is (B, C, H, W), before the 1x1 head.
    """

    name: str
    stride: int
    last_layer: str

    def __init__(self, **options: int | float) -> None:
        super().__init__()
        self.options = options

    @property
    @abstractmethod
    def probe_layers(self) -> dict[str, nn.Module]:
        """Layers by name, in forward order, each giving (B, C, h, w); "bottleneck" is always among them."""

    @abstractmethod
    def represent(self, fringe: Tensor) -> Tensor:
        """The network itself, on input that `check_input` has passed."""

    def forward(self, fringe: Tensor) -> Tensor:
        self.check_input(fringe)
        return self.represent(fringe)

    def check_input(self, fringe: Tensor) -> None:
        """Raises `NetworkError` unless ``fringe`` is floating (B, 1, H, W) of a size that the network takes."""
        shape = tuple(fringe.shape)
        if fringe.dim() != 4 or shape[1] != 1:
            raise NetworkError(f"{self.name} takes one fringe channel, (B, 1, H, W); it was given {shape}")
        if not fringe.is_floating_point():
            raise NetworkError(
                f"{self.name} takes floating fringe in [0, 1]; it was given {fringe.dtype}; divide by 255"
            )
        self.check_size(shape[2], shape[3])

    def check_size(self, height: int, width: int) -> None:
        """Raises `NetworkError`, with the nearest sizes that would do, unless the network takes ``height x width``."""
        stride, least = self.stride, 2 * self.stride
        if height % stride or width % stride or height < least or width < least:
            nearest = "x".join(_nearest(side, stride, least) for side in (height, width))
            raise NetworkError(
                f"{self.name} takes heights and widths that are multiples of {stride}, at least {least} px; it was "
                f"given {height}x{width}; the nearest it takes: {nearest}; crop, pad or build the dataset at that size"
            )


def in_full_precision(layer: nn.Module, features: Tensor) -> Tensor:
    """``layer`` of ``features`` outside of autocast, in float32 where that was a half precision: bfloat16 has steps of
    8 mm at 1.8 m, and the last layer is where mm come out."""
    kind = features.device.type
    if not torch.amp.is_autocast_available(kind) or not torch.is_autocast_enabled(kind):
        return layer(features)
    with torch.autocast(kind, enabled=False):
        return layer(features.float())


def _nearest(side: int, stride: int, least: int) -> str:
    below = max(side // stride * stride, least)
    above = max(-(-side // stride) * stride, least)
    return str(below) if below == above else f"({below} or {above})"


def whole(network: str, option: str, value: object, least: int = 1, multiple: int = 1) -> int:
    """``value`` if it is a whole number, at least ``least`` and a multiple of ``multiple``; else `NetworkError`."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least or value % multiple:
        rule = f"a whole number, at least {least}" + (f" and a multiple of {multiple}" if multiple > 1 else "")
        raise NetworkError(f"{network}: {option} must be {rule}; it was {value!r}")
    return value


def rate(network: str, option: str, value: object) -> float:
    """``value`` as a float if it is in [0, 1); else `NetworkError`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1:
        raise NetworkError(f"{network}: {option} must be a number in [0, 1); it was {value!r}")
    return float(value)


def parameter_count(module: nn.Module) -> int:
    """Trainable numbers in ``module``."""
    return sum(p.numel() for p in module.parameters() if p.requires_grad)


def initialise_convolutions(module: nn.Module) -> None:
    """Kaiming-normal weights (fan out, ReLU) and zero biases in every convolution, transposed ones too."""
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
            nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def initialise_tokens(module: nn.Module) -> None:
    """Normal weights of spread 0.02, cut at two units of the weight, and zero biases in every linear layer."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            nn.init.trunc_normal_(layer.weight, std=0.02)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def initialise_normal(module: nn.Module, spread: float = 0.02) -> None:
    """Weights from N(0, ``spread``) and zero biases in every convolution (the GAN's rule)."""
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
            nn.init.normal_(layer.weight, 0.0, spread)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


__all__ = [
    "FringeNetwork",
    "initialise_convolutions",
    "initialise_normal",
    "initialise_tokens",
    "parameter_count",
    "rate",
    "whole",
]
