"""Running a trained network: images in the range it was trained on, finite outputs, outputs of inner layers."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.loaders.training import unit_range

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.networks.base import FringeNetwork

Fringe = NDArray[np.uint8] | NDArray[np.floating[Any]]


def fringe_batch(fringes: Sequence[Fringe] | Fringe, size: tuple[int, int], trained_on: str) -> Tensor:
    """Images (B, H, W), uint8 or float in [0, 1], as the network's input: float32 (B, 1, H, W) in [0, 1], on the CPU.

    ``size`` (H, W) is what the network ``trained_on`` was trained at. Raises `PredictionError` for another size, shape
    or dtype, and for values that are NaN or outside [0, 1].
    """
    images = [np.asarray(image) for image in fringes]
    if not images:
        raise PredictionError("expected at least one fringe image, got none")
    batch = torch.empty(len(images), 1, *size)
    for number, image in enumerate(images):
        _check_image(image, size, trained_on)
        row = batch[number, 0].numpy()
        if image.dtype == np.uint8:
            unit_range(np.ascontiguousarray(image), row)
        else:
            row[...] = image
    return batch


def _check_image(image: NDArray[Any], size: tuple[int, int], trained_on: str) -> None:
    if image.ndim != 2:
        raise PredictionError(f"expected one fringe image (H, W), got shape {image.shape}; give a single grey channel")
    if image.shape != size:
        raise PredictionError(
            f"expected a fringe image of {size[0]}x{size[1]} px (H x W), the size {trained_on} was trained at, got "
            f"{image.shape[0]}x{image.shape[1]}: the fringe period in px depends on the size, so a network works at "
            "one size only; use weights of that size, or a dataset built at this one"
        )
    if image.dtype == np.uint8:
        return
    if not np.issubdtype(image.dtype, np.floating):
        raise PredictionError(f"expected a fringe image in uint8 (0 to 255) or float (0 to 1), got {image.dtype}")
    low, high = float(image.min()), float(image.max())
    if not (low >= 0 and high <= 1):  # NaN fails this too
        raise PredictionError(
            f"expected a float fringe image within [0, 1], got values from {low:g} to {high:g}; divide grey levels by "
            "their largest possible value (255 for 8 bits), and leave no NaN"
        )


def represent(network: nn.Module, fringe: Tensor, name: str) -> Tensor:
    """Output (B, 1, H, W) of ``network``; `PredictionError` where it holds a value that is not finite."""
    output: Tensor = network(fringe)
    not_finite = int((~output.isfinite()).sum())
    if not_finite:
        raise PredictionError(
            f"{name}: the network gave {not_finite} of {output.numel()} values that are NaN or infinite; its weights "
            "come from a training that diverged, or the precision it runs in is too low: train it again"
        )
    return output


class Probe:
    """Outputs of two layers of a network for the last batch: see `probed`."""

    def __init__(self) -> None:
        self.outputs: dict[str, Tensor] = {}

    def pooled(self) -> Tensor:
        """Mean and spread over the pixels of each bottleneck channel, float64 (B, 2 C), on the CPU."""
        layer = self.outputs["bottleneck"].double().flatten(2)
        return torch.cat([layer.mean(2), layer.std(2, correction=0)], dim=1).cpu()

    def pixels(self, size: tuple[int, int]) -> Tensor:
        """Features of the last decoder layer (B, C, H, W) at ``size``; bilinear where the layer is coarser."""
        layer = self.outputs["last"]
        if layer.shape[2:] == size:
            return layer
        return functional.interpolate(layer, size=size, mode="bilinear", align_corners=False)


@contextmanager
def probed(network: "FringeNetwork") -> Iterator[Probe]:
    """Record the outputs of the bottleneck and the last decoder layer for every batch inside this block."""
    probe = Probe()
    layers = network.probe_layers

    def record(name: str, layer: str) -> Any:
        def hook(module: nn.Module, inputs: object, output: Tensor) -> None:
            probe.outputs[name] = output

        return layers[layer].register_forward_hook(hook)

    handles = [record("bottleneck", "bottleneck"), record("last", network.last_layer)]
    try:
        yield probe
    finally:
        for handle in handles:
            handle.remove()
