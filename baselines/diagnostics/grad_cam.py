"""Grad-CAM for regression (paper Section 7.2): where a layer's activations move the mean prediction, and what is there.

The heatmap of a layer is the ReLU of its channels' sum, each weighted by the mean gradient of the mean predicted value
with respect to that channel (Selvaraju et al. 2017; `captum.attr.LayerGradCam`), brought to the image's size. It is
correlated (Pearson, over all pixels) with the edges of the true depth and with the local standard deviation of the
fringe. The sanity check is that of Adebayo et al. (2018): a heatmap that random weights give as well says nothing about
what was learned.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.activations import batch_size, batches
from fpp_ml_bench.baselines.diagnostics.correlation import EDGES, FRINGES, OWN, Correlations, correlation
from fpp_ml_bench.baselines.diagnostics.probe import Finding, ProbeSettings, Progress, spread
from fpp_ml_bench.baselines.diagnostics.subject import Subject
from fpp_ml_bench.baselines.diagnostics.targets import edge_map, fringe_variation
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.errors import DiagnosisError

if TYPE_CHECKING:
    from torch import Tensor, nn

    from fpp_ml_bench.loaders.store import DatasetFolder

Image = NDArray[np.float32]

PAPER_LAYERS = {
    "enc3": "enc3", "enc4": "enc4", "bottleneck": "bottleneck", "dec4": "dec1", "dec2": "dec3", "dec1": "dec4",
}  # fmt: skip
"""The six layers of the paper's table in our names (dec4 is the coarsest, as enc4), and in the paper's (dec1 is)."""
SAMPLES, QUICK_SAMPLES = 30, 6
SEEDS = 2


class GradCam:
    """Heatmaps of the test split against edges and fringes, for the network and for random weights."""

    name = "grad-cam"
    title = "Grad-CAM"
    question = "Which pixels move the mean prediction: those at edges, or those with fringes?"
    version = 1

    def applies_to(self, subject: Subject) -> str | None:
        if subject.network is None:
            return f"{subject.name} is a method without a network: there is no gradient to follow."
        return None

    def run(
        self, subject: Subject, dataset: "DatasetFolder", settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        from fpp_ml_bench.baselines.diagnostics.grad_cam_report import draw, summary, tables

        wanted = settings.samples or (QUICK_SAMPLES if settings.quick else SAMPLES)
        samples = spread(dataset.samples("test"), wanted)
        if not samples:
            raise DiagnosisError(f"{dataset.path}: split test holds no sample, and Grad-CAM looks at that")
        seeds = settings.seeds or (1 if settings.quick else SEEDS)
        layers = chosen(subject)
        found = measure(subject, dataset, samples, layers, seeds, progress)
        return Finding(
            self.name,
            self.title,
            summary(found),
            {
                "protocol": {
                    "split": "test", "samples": len(samples), "seeds": seeds, "layers": list(layers),
                    "score": "mean prediction", "heatmap": "ReLU, bilinear to the image",
                },
                **found.to_dict(),
            },
            tables(found),
            draw(found, subject, dataset, samples, layers, folder),
        )  # fmt: skip


def chosen(subject: Subject) -> tuple[str, ...]:
    """The paper's six layers where the subject has them, else every layer it is looked into at."""
    six = tuple(name for name in subject.layer_names if name in PAPER_LAYERS)
    return six if len(six) == len(PAPER_LAYERS) else subject.layer_names


def heatmaps(network: "nn.Module", layers: "dict[str, nn.Module]", fringe: "Tensor") -> "dict[str, Tensor]":
    """Grad-CAM of the mean prediction before its ReLU, by layer: (B, H, W) at the size of ``fringe`` (B, 1, H, W).

    Raises `DiagnosisError` for a layer whose output is no map of channels or does not reach the prediction.
    """
    import torch
    from captum.attr import LayerAttribution, LayerGradCam

    found = {}
    for name, layer in layers.items():
        cam = LayerGradCam(lambda x: network(x).mean(dim=(1, 2, 3)), layer)
        try:
            # The image asks for a gradient so that there is one with frozen weights.
            heat = cam.attribute(fringe.detach().requires_grad_(True))
        except (RuntimeError, AssertionError, IndexError, AttributeError, TypeError) as error:
            said = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise DiagnosisError(f"layer {name!r}: no Grad-CAM can be made of it ({said}); leave it out") from None
        if not isinstance(heat, torch.Tensor) or heat.dim() != 4:
            raise DiagnosisError(f"layer {name!r}: expected activations (B, C, h, w); leave it out")
        scaled = LayerAttribution.interpolate(heat, tuple(fringe.shape[2:]), "bilinear")
        found[name] = scaled[:, 0].detach()  # type: ignore[index]
    return found


def maps(
    subject: Subject, network: "nn.Module", dataset: "DatasetFolder", samples: Sequence[str], layers: Sequence[str]
) -> Iterator[tuple[str, dict[str, Image]]]:
    """Each sample with its heatmaps by layer, float32 (H, W), ReLU taken, a batch at a time."""
    found = subject.layers_of(network)
    for names, fringe in batches(subject, dataset, samples):
        heat = heatmaps(network, {name: found[name] for name in layers}, fringe)
        for place, sample in enumerate(names):
            yield sample, {layer: one[place].clamp(min=0).numpy() for layer, one in heat.items()}


def references(subject: Subject, dataset: "DatasetFolder", sample: str) -> dict[str, Image]:
    """What heatmaps of ``sample`` are compared with: edges, and the fringe's local standard deviation."""
    (index,) = subject.frames_used
    depth_mm = dataset.depth_mm(sample)
    frame = subject.as_given(dataset.frame(sample, index), depth_mm)
    return {EDGES: edge_map(depth_mm), FRINGES: fringe_variation(frame, period_px(subject, dataset))}


def period_px(subject: Subject, dataset: "DatasetFolder") -> float:
    """Image px of a fringe period at the standoff; of the horizontal fringes where the frame has no direction."""
    direction = subject.direction
    return dataset.rig.image_px_per_period("horizontal" if direction == "both" else direction)


def measure(
    subject: Subject, dataset: "DatasetFolder", samples: Sequence[str], layers: Sequence[str], seeds: int,
    progress: Progress,
) -> Correlations:  # fmt: skip
    """Correlations of every heatmap with both references, and of the random networks' with the trained one's."""
    network, untrained = subject.network, subject.untrained
    if network is None or untrained is None:
        raise DiagnosisError(f"{subject.name}: has no network to follow a gradient through")
    found = Correlations(tuple(layers), [split_sample_name(name)[0] for name in samples])
    total, done = len(samples) * (1 + seeds), 0
    others: list[Any] = [untrained(seed) for seed in range(seeds)]
    batch = batch_size(subject)
    for start in range(0, len(samples), batch):
        part = samples[start : start + batch]
        own = dict(maps(subject, network, dataset, part, layers))
        known = {sample: references(subject, dataset, sample) for sample in part}
        for sample in part:
            found.add_references(correlation(known[sample][EDGES], known[sample][FRINGES]))
            for layer, heat in own[sample].items():
                for what, reference in known[sample].items():
                    found.add("trained", layer, what, correlation(heat, reference))
        done += len(part)
        progress(done, total, "Grad-CAM")
        for number, other in enumerate(others):
            for sample, heat_of in maps(subject, other, dataset, part, layers):
                for layer, heat in heat_of.items():
                    for what, reference in (*known[sample].items(), (OWN, own[sample][layer])):
                        found.add(f"untrained {number}", layer, what, correlation(heat, reference))
            done += len(part)
            progress(done, total, "Grad-CAM of random weights")
    return found
