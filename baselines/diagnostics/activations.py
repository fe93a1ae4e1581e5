"""Looking into a frozen network batch by batch: every layer's activations are reduced as they come, and let go."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from fpp_ml_bench.baselines.diagnostics.subject import Subject, checked_output
from fpp_ml_bench.errors import DiagnosisError

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.store import DatasetFolder

BATCH = 8
PIXELS_AT_ONCE = BATCH * 224 * 224
"""Images in a batch at most, and their pixels: a full-width network at 960 px is looked into one image at a time."""
INPUT = "input"
"""The raw input as a layer of its own: the control that every layer is measured against."""


@contextmanager
def tapped(layers: dict[str, nn.Module], take: Callable[[Tensor], Tensor]) -> Iterator[dict[str, Tensor]]:
    """Inside this block each forward pass leaves ``take(activations)`` of every layer, by name, in what is yielded.

    ``take`` is called while the layer's output is as the layer made it (a later layer may work in place on it), and its
    result must not be a view of that. Raises `DiagnosisError` for a layer whose output is not (B, C, h, w).
    """
    caught: dict[str, Tensor] = {}

    def hook(name: str) -> Any:
        def catch(module: nn.Module, inputs: object, output: object) -> None:
            if not isinstance(output, Tensor) or output.dim() != 4:
                shape = tuple(output.shape) if isinstance(output, Tensor) else type(output).__name__
                raise DiagnosisError(f"layer {name!r}: expected activations (B, C, h, w), got {shape}; leave it out")
            caught[name] = take(output.float())

        return catch

    handles = [layer.register_forward_hook(hook(name)) for name, layer in layers.items()]
    try:
        yield caught
    finally:
        for handle in handles:
            handle.remove()


def run(network: nn.Module, fringe: Tensor, layers: Sequence[str], caught: dict[str, Tensor], name: str) -> None:
    """One forward pass that fills ``caught``. Raises `DiagnosisError` for an output that is no depth map, and for a
    layer that the pass does not go through."""
    caught.clear()
    with torch.no_grad():
        checked_output(network(fringe), fringe, name)
    silent = [layer for layer in layers if layer not in caught]
    if silent:
        raise DiagnosisError(f"{name}: layer {silent[0]!r} takes no part in a forward pass; leave it out")


def batches(
    subject: Subject, dataset: "DatasetFolder", samples: Sequence[str], size: int | None = None
) -> Iterator[tuple[list[str], Tensor]]:
    """``samples`` in batches of ``size`` (default: `batch_size`), with their input (B, 1, H, W)."""
    size = batch_size(subject) if size is None else size
    for start in range(0, len(samples), size):
        names = list(samples[start : start + size])
        yield names, subject.input_batch([subject.captured(dataset, name) for name in names])


def batch_size(subject: Subject) -> int:
    """Images in a batch, for networks that keep what they compute."""
    return max(1, min(BATCH, PIXELS_AT_ONCE // (subject.image_size[0] * subject.image_size[1])))


def at_size(features: Tensor, side: tuple[int, int]) -> Tensor:
    """Activations (B, C, h, w) as (B, C, *side), a new tensor: mean over areas where finer, bilinear where coarser."""
    if tuple(features.shape[2:]) == side:
        return features.clone()
    if features.shape[2] >= side[0] and features.shape[3] >= side[1]:
        return functional.adaptive_avg_pool2d(features, side)
    return functional.interpolate(features, size=side, mode="bilinear", align_corners=False)


def at_pixels(features: Tensor, pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """Activations (B, C, h, w) at image ``pixels`` (B, P), flat places in an image of ``size``: (B, P, C).

    The layer's own value where it has a pixel for each of the image's, else bilinear between its pixel centres.
    """
    if tuple(features.shape[2:]) == size:
        flat = features.flatten(2)
        return flat.gather(2, pixels[:, None].expand(-1, flat.shape[1], -1)).transpose(1, 2)
    rows, columns = pixels // size[1], pixels % size[1]
    place = torch.stack([(2 * columns + 1) / size[1] - 1, (2 * rows + 1) / size[0] - 1], dim=-1).to(features.dtype)
    found = functional.grid_sample(
        features, place[:, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return found[:, :, 0].transpose(1, 2)
