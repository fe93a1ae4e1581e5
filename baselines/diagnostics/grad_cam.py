"""Grad-CAM for regression (paper Section 7.2): which pixels of a layer's activations change the mean prediction.

The heatmap of a layer is the ReLU of its channels' sum, each weighted by the mean gradient of the mean predicted value
with respect to that channel (Selvaraju et al. 2017; `captum.attr.LayerGradCam`), resized to the image. It is correlated
(Pearson, over all pixels) with the edges of the true depth and with the local standard deviation of the fringe. As a
sanity check (Adebayo et al. 2018) the heatmaps of random weights are measured too: if they are the same, the heatmap
does not depend on what was learned.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.activations import batch_size, batches
from fpp_ml_bench.baselines.diagnostics.correlation import EDGES, FRINGES, OWN, Correlations, correlation
from fpp_ml_bench.baselines.diagnostics.probe import Finding, ProbeSettings, Progress, spread
from fpp_ml_bench.baselines.diagnostics.subjects import Subject
from fpp_ml_bench.baselines.diagnostics.targets import edge_map, fringe_variation
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.errors import DiagnosisError

if TYPE_CHECKING:
    from torch import Tensor, nn

    from fpp_ml_bench.loaders.storage import DatasetFolder

Image = NDArray[np.float32]

PAPER_LAYERS = {
    "enc3": "enc3", "enc4": "enc4", "bottleneck": "bottleneck", "dec4": "dec1", "dec2": "dec3", "dec1": "dec4",
}  # fmt: skip
"""The six layers of the paper's table by our names (dec4 is the coarsest), with the paper's names (dec1 is)."""
SAMPLES, QUICK_SAMPLES = 30, 6
SEEDS = 2


class GradCam:
    """Heatmaps of the test split against edges and fringes, for the network and for random weights."""

    name = "grad-cam"
    title = "Grad-CAM"
    question = "Which pixels change the mean prediction: those at edges, or those with fringes?"
    version = 1

    def applies_to(self, subject: Subject) -> str | None:
        if subject.network is None:
            return f"{subject.name} is a method without a network: it has no gradient to follow."
        return None

    def run(
        self, subject: Subject, dataset: "DatasetFolder", settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        from fpp_ml_bench.baselines.diagnostics.grad_cam_report import draw, summary, tables

        most_samples = settings.samples or (QUICK_SAMPLES if settings.quick else SAMPLES)
        samples = spread(dataset.samples("test"), most_samples)
        if not samples:
            raise DiagnosisError(f"{dataset.path}: split test holds no sample, which Grad-CAM needs")
        seeds = settings.seeds or (1 if settings.quick else SEEDS)
        layers = cam_layers(subject)
        correlations = measure(subject, dataset, samples, layers, seeds, progress)
        return Finding(
            self.name,
            self.title,
            summary(correlations),
            {
                "protocol": {
                    "split": "test", "samples": len(samples), "seeds": seeds, "layers": list(layers),
                    "score": "mean prediction", "heatmap": "ReLU, bilinear to the image",
                },
                **correlations.to_dict(),
            },
            tables(correlations),
            draw(correlations, subject, dataset, samples, layers, folder),
        )  # fmt: skip


def cam_layers(subject: Subject) -> tuple[str, ...]:
    """The paper's six layers where the subject has them, else all its probed layers."""
    six = tuple(name for name in subject.layer_names if name in PAPER_LAYERS)
    return six if len(six) == len(PAPER_LAYERS) else subject.layer_names


def heatmaps(network: "nn.Module", layers: "dict[str, nn.Module]", fringe: "Tensor") -> "dict[str, Tensor]":
    """Grad-CAM of the mean prediction before its ReLU, by layer: (B, H, W) at the size of ``fringe`` (B, 1, H, W).

    Raises `DiagnosisError` for a layer whose output is not (B, C, h, w) or does not reach the prediction.
    """
    import torch
    from captum.attr import LayerAttribution, LayerGradCam

    heatmaps_by_layer = {}
    for name, layer in layers.items():
        cam = LayerGradCam(lambda x: network(x).mean(dim=(1, 2, 3)), layer)
        try:
            # The image requires a gradient, so that frozen weights have a graph.
            heat = cam.attribute(fringe.detach().requires_grad_(True))
        except (RuntimeError, AssertionError, IndexError, AttributeError, TypeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise DiagnosisError(f"layer {name!r}: Grad-CAM failed ({reason}); leave it out") from None
        if not isinstance(heat, torch.Tensor) or heat.dim() != 4:
            raise DiagnosisError(f"layer {name!r}: expected activations (B, C, h, w); leave it out")
        scaled = LayerAttribution.interpolate(heat, tuple(fringe.shape[2:]), "bilinear")
        heatmaps_by_layer[name] = scaled[:, 0].detach()  # type: ignore[index]
    return heatmaps_by_layer


def maps(
    subject: Subject, network: "nn.Module", dataset: "DatasetFolder", samples: Sequence[str], layers: Sequence[str]
) -> Iterator[tuple[str, dict[str, Image]]]:
    """Each sample with its heatmaps by layer after the ReLU, float32 (H, W)."""
    network_layers = subject.layers_of(network)
    for names, fringe in batches(subject, dataset, samples):
        heat = heatmaps(network, {name: network_layers[name] for name in layers}, fringe)
        for number, sample in enumerate(names):
            yield sample, {layer: batch_heat[number].clamp(min=0).numpy() for layer, batch_heat in heat.items()}


def references(subject: Subject, dataset: "DatasetFolder", sample: str) -> dict[str, Image]:
    """Reference maps for the heatmaps of ``sample``: edges, and the fringe's local standard deviation."""
    (index,) = subject.frames_used
    depth_mm = dataset.depth_mm(sample)
    frame = subject.as_input(dataset.frame(sample, index), depth_mm)
    return {EDGES: edge_map(depth_mm), FRINGES: fringe_variation(frame, period_px(subject, dataset))}


def period_px(subject: Subject, dataset: "DatasetFolder") -> float:
    """Image px per fringe period at the standoff; of horizontal fringes where the frame has no direction."""
    direction = subject.direction
    return dataset.rig.image_px_per_period("horizontal" if direction == "both" else direction)


def measure(
    subject: Subject, dataset: "DatasetFolder", samples: Sequence[str], layers: Sequence[str], seeds: int,
    progress: Progress,
) -> Correlations:  # fmt: skip
    """Correlations of every heatmap with both references, and of random weights' heatmaps with the trained ones."""
    network, untrained = subject.network, subject.untrained
    if network is None or untrained is None:
        raise DiagnosisError(f"{subject.name}: has no network to follow a gradient through")
    correlations = Correlations(tuple(layers), [split_sample_name(name)[0] for name in samples])
    total, done = len(samples) * (1 + seeds), 0
    random_networks: list[Any] = [untrained(seed) for seed in range(seeds)]
    size = batch_size(subject)
    for start in range(0, len(samples), size):
        batch_samples = samples[start : start + size]
        trained_maps = dict(maps(subject, network, dataset, batch_samples, layers))
        reference_maps = {sample: references(subject, dataset, sample) for sample in batch_samples}
        for sample in batch_samples:
            correlations.add_references(correlation(reference_maps[sample][EDGES], reference_maps[sample][FRINGES]))
            for layer, heat in trained_maps[sample].items():
                for target, reference in reference_maps[sample].items():
                    correlations.add("trained", layer, target, correlation(heat, reference))
        done += len(batch_samples)
        progress(done, total, "Grad-CAM")
        for number, random_network in enumerate(random_networks):
            for sample, heat_of in maps(subject, random_network, dataset, batch_samples, layers):
                for layer, heat in heat_of.items():
                    for target, reference in (*reference_maps[sample].items(), (OWN, trained_maps[sample][layer])):
                        correlations.add(f"untrained {number}", layer, target, correlation(heat, reference))
            done += len(batch_samples)
            progress(done, total, "Grad-CAM of random weights")
    return correlations
