"""Activations of a frozen network, batch by batch: each layer's are reduced as soon as they exist and not kept."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from fpp_ml_bench.baselines.diagnostics.subjects import Subject, checked_output
from fpp_ml_bench.errors import DiagnosisError

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.storage import DatasetFolder

BATCH = 8
PIXELS_AT_ONCE = BATCH * 224 * 224
"""Most images in a batch, and most pixels: at 960 px a batch is one image."""
INPUT = "input"
"""Name of the raw input, which is probed like a layer as a control."""


@contextmanager
def tapped(layers: dict[str, nn.Module], reduce: Callable[[Tensor], Tensor]) -> Iterator[dict[str, Tensor]]:
    """Yields a dict that each forward pass in this block fills with ``reduce(activations)`` of every layer, by name.

    ``reduce`` is called before a later layer can change the output in place. Its result must not be a view of the
    output. Raises `DiagnosisError` for a layer whose output is not (B, C, h, w).
    """
    activations: dict[str, Tensor] = {}

    def hook(name: str) -> Any:
        def record(module: nn.Module, inputs: object, output: object) -> None:
            if not isinstance(output, Tensor) or output.dim() != 4:
                shape = tuple(output.shape) if isinstance(output, Tensor) else type(output).__name__
                raise DiagnosisError(f"layer {name!r}: expected activations (B, C, h, w), got {shape}; leave it out")
            activations[name] = reduce(output.float())

        return record

    handles = [layer.register_forward_hook(hook(name)) for name, layer in layers.items()]
    try:
        yield activations
    finally:
        for handle in handles:
            handle.remove()


def run(network: nn.Module, fringe: Tensor, layers: Sequence[str], activations: dict[str, Tensor], name: str) -> None:
    """One forward pass that fills ``activations``.

    Raises `DiagnosisError` for an output that is not a depth map, and for a layer that the pass does not reach.
    """
    activations.clear()
    with torch.no_grad():
        checked_output(network(fringe), fringe, name)
    unreached = [layer for layer in layers if layer not in activations]
    if unreached:
        raise DiagnosisError(f"{name}: layer {unreached[0]!r} takes no part in a forward pass; leave it out")


def batches(
    subject: Subject, dataset: "DatasetFolder", samples: Sequence[str], size: int | None = None
) -> Iterator[tuple[list[str], Tensor]]:
    """``samples`` in batches of ``size`` (default: `batch_size`), with their input (B, 1, H, W)."""
    size = batch_size(subject) if size is None else size
    for start in range(0, len(samples), size):
        names = list(samples[start : start + size])
        yield names, subject.input_batch([subject.captured(dataset, name) for name in names])


def batch_size(subject: Subject) -> int:
    """Images in a batch, so that memory stays bounded."""
    return max(1, min(BATCH, PIXELS_AT_ONCE // (subject.image_size[0] * subject.image_size[1])))


def at_size(features: Tensor, side: tuple[int, int]) -> Tensor:
    """Activations (B, C, h, w) resized to a new tensor (B, C, *side): area means to shrink, bilinear to enlarge."""
    if tuple(features.shape[2:]) == side:
        return features.clone()
    if features.shape[2] >= side[0] and features.shape[3] >= side[1]:
        return functional.adaptive_avg_pool2d(features, side)
    return functional.interpolate(features, size=side, mode="bilinear", align_corners=False)


def at_pixels(features: Tensor, pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """Activations (B, C, h, w) at ``pixels`` (B, P), flat indices into an image of ``size``: (B, P, C).

    A layer as large as the image is read directly; others are interpolated bilinearly between their pixel centres.
    """
    if tuple(features.shape[2:]) == size:
        flat = features.flatten(2)
        return flat.gather(2, pixels[:, None].expand(-1, flat.shape[1], -1)).transpose(1, 2)
    rows, columns = pixels // size[1], pixels % size[1]
    position = torch.stack([(2 * columns + 1) / size[1] - 1, (2 * rows + 1) / size[0] - 1], dim=-1).to(features.dtype)
    values = functional.grid_sample(
        features, position[:, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return values[:, :, 0].transpose(1, 2)
