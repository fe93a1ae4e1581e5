"""Grad-CAM for regression (paper Section 7.2): which pixels of a layer's activations change the mean prediction.

The heatmap of a layer is the ReLU of its channels' sum, each weighted by the mean gradient of the mean predicted value
with respect to that channel (Selvaraju et al. 2017), resized to the image. It is correlated (Pearson, over all pixels)
with the edges of the true depth and with the local standard deviation of the fringe. As a sanity check (Adebayo et al.
2018) the heatmaps of random weights are measured too: if they are the same, they do not depend on what was learned.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import cv2
import numpy as np
from captum.attr import LayerAttribution, LayerGradCam
from numpy.typing import NDArray
from torch import Tensor, nn

from fpp_ml_bench.baselines.diagnostics import probe
from fpp_ml_bench.baselines.diagnostics.fits import edge_map
from fpp_ml_bench.baselines.diagnostics.probe import (
    COLOURS,
    TRAINED,
    UNTRAINED,
    Figure,
    Line,
    Panel,
    Picture,
    Table,
    layer_title,
    mean_of,
    said_of_layers,
)
from fpp_ml_bench.baselines.diagnostics.probe import with_interval as text_of
from fpp_ml_bench.baselines.diagnostics.subjects import Subject
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.evaluation.score.uncertainty import object_interval
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.paper import AVERAGE, paper_layers, said_by_paper

Image = NDArray[np.float32]
Mean = dict[str, Any]
"""``r``: mean of the correlations of so many ``samples``, and its 95% ``interval``, resampled over objects; None where
there is none."""
Correlations = dict[tuple[str, str, str], list[float | None]]
"""Pearson's r of each sample, by weights (``trained``, ``untrained 0``, ...), layer and reference."""

PAPER = "grad_cam"
SAMPLES, QUICK_SAMPLES = 30, 6
SEEDS = 2
EDGES, FRINGES, OWN = "edges", "fringes", "own"
"""References; `OWN` is the trained network's heatmap."""
_LEAST_SPREAD = 1e-12
_EXAMPLES = 3


class GradCam(probe.Probe):
    """Heatmaps of the test split against edges and fringes, for the network and for random weights."""

    name = "grad-cam"
    title = "Grad-CAM"
    question = "Which pixels change the mean prediction: those at edges, or those with fringes?"
    without_network = "it has no gradient to follow"
    version = 2

    def run(
        self, subject: Subject, dataset: DatasetFolder, settings: probe.ProbeSettings, progress: probe.Progress
    ) -> probe.Finding:
        samples = settings.choose(dataset.samples("test"), SAMPLES, QUICK_SAMPLES)
        if not samples:
            raise DiagnosisError(f"{dataset.path}: split test holds no sample, which Grad-CAM needs")
        seeds = settings.seeds or (1 if settings.quick else SEEDS)
        layers = cam_layers(subject)
        means = measure(subject, dataset, samples, layers, seeds, progress)
        if means["average"][EDGES]["r"] is None:
            return self.skip(f"the heatmaps of every layer of {subject.name} ({', '.join(layers)}) are constant.")
        protocol = {
            "split": "test",
            "samples": len(samples),
            "seeds": seeds,
            "layers": list(layers),
            "score": "mean prediction",
            "heatmap": "ReLU, bilinear to the image",
        }
        drawn = _draw_correlations(means, len(samples)), _draw_heatmaps(subject, dataset, samples, layers)
        return self.finding(summary(means), {"protocol": protocol, **means}, tables(means, len(samples)), *drawn)


def cam_layers(subject: Subject) -> tuple[str, ...]:
    """The paper's six layers where the subject has them, else all its probed layers."""
    six = tuple(name for name in subject.layer_names if name in paper_layers(PAPER))
    return six if set(six) | {AVERAGE} == set(paper_layers(PAPER)) else subject.layer_names


def heatmaps(network: nn.Module, layers: Mapping[str, nn.Module], fringe: Tensor) -> dict[str, Tensor]:
    """Grad-CAM of the mean prediction before its ReLU, by layer: (B, H, W) at the size of ``fringe`` (B, 1, H, W).
    Raises `DiagnosisError` for a layer whose output is not (B, C, h, w) or does not reach the prediction."""
    heatmaps_by_layer = {}
    for name, layer in layers.items():
        cam = LayerGradCam(lambda x: network(x).mean(dim=(1, 2, 3)), layer)
        try:
            # The image requires a gradient, so that frozen weights have a graph.
            heat = cam.attribute(fringe.detach().requires_grad_(True))
        except (RuntimeError, AssertionError, IndexError, AttributeError, TypeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise DiagnosisError(f"layer {name!r}: Grad-CAM failed ({reason}); leave it out") from None
        if not isinstance(heat, Tensor) or heat.dim() != 4:
            raise DiagnosisError(f"layer {name!r}: expected activations (B, C, h, w); leave it out")
        scaled = LayerAttribution.interpolate(heat, tuple(fringe.shape[2:]), "bilinear")
        heatmaps_by_layer[name] = scaled[:, 0].detach()  # type: ignore[index]
    return heatmaps_by_layer


def heat_by_layer(subject: Subject, network: nn.Module, fringe: Tensor, layers: Sequence[str]) -> dict[str, Image]:
    """`heatmaps` of a ``network`` of the subject's architecture after the ReLU, float32 (B, H, W) by layer."""
    modules = subject.layers_of(network)
    heat = heatmaps(network, {name: modules[name] for name in layers}, fringe)
    return {name: values.clamp(min=0).numpy() for name, values in heat.items()}


def references(subject: Subject, dataset: DatasetFolder, sample: str) -> dict[str, Image]:
    """Reference maps for the heatmaps of ``sample``: edges, and the fringe's local standard deviation."""
    frame = subject.captured(dataset, sample)[subject.frames_used[0]]
    # Image px per fringe period at the standoff; of horizontal fringes where the frame has no direction.
    period_px = dataset.rig.image_px_per_period("vertical" if subject.direction == "vertical" else "horizontal")
    return {EDGES: edge_map(dataset.depth_mm(sample)), FRINGES: fringe_variation(np.asarray(frame), period_px)}


def fringe_variation(grey: NDArray[np.uint8], period_px: float) -> Image:
    """Standard deviation of a fringe image (H, W) over a square window of one period, in grey levels, float32. The
    window side is the smallest odd number of px that covers ``period_px``, at least 3; the border is mirrored."""
    side = max(3, 2 * int(np.ceil((period_px - 1) / 2)) + 1)
    image = np.asarray(grey, dtype=np.float64)
    mean, square = (cv2.blur(of, (side, side), borderType=cv2.BORDER_REFLECT_101) for of in (image, image * image))
    return np.sqrt(np.maximum(square - mean * mean, 0)).astype(np.float32)


def correlation(first: NDArray, second: NDArray) -> float | None:
    """Pearson's r of two maps of the same shape over all pixels; None where either is constant."""
    a, b = first.astype(np.float64).ravel(), second.astype(np.float64).ravel()
    a, b = a - a.mean(), b - b.mean()
    sizes = float(np.sqrt((a @ a) * (b @ b)))
    scale = max(1.0, float(np.abs(first).max()) * float(np.abs(second).max())) * a.size
    return None if sizes <= _LEAST_SPREAD * min(1.0, scale) else float(np.clip(a @ b / sizes, -1, 1))


def measure(
    subject: Subject,
    dataset: DatasetFolder,
    samples: Sequence[str],
    layers: Sequence[str],
    seeds: int,
    progress: probe.Progress,
) -> dict[str, Any]:
    """`means_of` the correlations of every heatmap with both references, and of random weights' heatmaps with the
    trained ones."""
    network, untrained = subject.networks()
    networks = {TRAINED: network} | {f"{UNTRAINED} {seed}": untrained(seed) for seed in range(seeds)}
    found: Correlations = {}
    edges_with_fringes: list[float | None] = []
    done = 0
    for names, fringe in subject.batches(dataset, samples):
        compared: list[dict[str, Any]] = [{**references(subject, dataset, name)} for name in names]
        edges_with_fringes += [correlation(*maps.values()) for maps in compared]
        for weights, one_network in networks.items():
            heat = heat_by_layer(subject, one_network, fringe, layers)
            for (number, maps), layer in product(enumerate(compared), layers):
                for target, reference in maps.items():
                    r = correlation(heat[layer][number], reference[layer] if target == OWN else reference)
                    found.setdefault((weights, layer, target), []).append(r)
            if weights == TRAINED:
                for number, maps in enumerate(compared):
                    maps[OWN] = {layer: values[number] for layer, values in heat.items()}
            done += len(names)
            progress(
                done, len(samples) * len(networks), "Grad-CAM" + ("" if weights == TRAINED else " of random weights")
            )
    objects = [split_sample_name(name)[0] for name in samples]
    return means_of(found, layers, objects) | {"edges_with_fringes": _mean([edges_with_fringes], objects)}


def _mean(columns: Sequence[Sequence[float | None]], objects: Sequence[str]) -> Mean:
    """`Mean` over samples of each sample's mean over ``columns``."""
    values = [mean_of(of_sample) for of_sample in zip(*columns, strict=True)]
    interval = object_interval(values, objects)
    return {"r": mean_of(values), "interval": interval, "samples": sum(r is not None for r in values)}


def means_of(found: Correlations, layers: Sequence[str], objects: Sequence[str]) -> dict[str, Any]:
    """For ``diagnose.json``: `Mean` by layer and reference, and of all layers, with the ratio; those of random weights
    are means over seeds."""

    def by_reference(names: Sequence[str], trained: bool) -> dict[str, Mean]:
        means = {}
        for target in (EDGES, FRINGES) if trained else (EDGES, FRINGES, OWN):
            columns = [
                values
                for (weights, layer, reference), values in found.items()
                if layer in names and reference == target and (weights == TRAINED) == trained
            ]
            means[target] = _mean(columns, objects)
        return means

    def average(trained: bool) -> dict[str, Mean]:
        """As in the paper's bottom row, with an interval over samples."""
        means = by_reference(layers, trained)
        for target, mean in means.items():
            of_layers = [by_reference((layer,), trained)[target]["r"] for layer in layers]
            mean |= {"r": mean_of(of_layers), "samples": sum(r is not None for r in of_layers)}
        return means

    of_layers = {
        layer: {**_with_ratio(by_reference((layer,), True)), "random": by_reference((layer,), False)}
        for layer in layers
    }
    return {"layers": of_layers, "average": _with_ratio(average(True)), "random_average": average(False)}


def _with_ratio(means: Mapping[str, Mean]) -> dict[str, Any]:
    """With the paper's ratio: correlation with edges over correlation with fringes; None where undefined."""
    edges, fringes = means[EDGES]["r"], means[FRINGES]["r"]
    return {**means, "ratio": None if edges is None or not fringes else edges / fringes}


def summary(means: Mapping[str, Any]) -> str:
    """The result in a few sentences."""
    average, random = means["average"], means["random_average"]
    edges, fringes, random_edges, random_fringes, both = (
        text_of(mean["r"])
        for mean in (average[EDGES], average[FRINGES], random[EDGES], random[FRINGES], means["edges_with_fringes"])
    )
    text = (
        f"Over the layers, heatmaps correlate with edges by {edges} and with fringe variation by {fringes}, "
        f"{ratio_text(average)} (paper: {said_by_paper(PAPER, AVERAGE)}). Random weights: {random_edges} and "
        f"{random_fringes}; edges and fringe variation themselves correlate by {both}, because both are strong where "
        "the object is."
    )
    own = random[OWN]["r"]
    return text if own is None else f"{text} Random weights' heatmaps agree with the trained ones by {own:.2f}."


def ratio_text(average: Mapping[str, Any]) -> str:
    """The ratio, with a note where the interval of the divisor holds 0."""
    span = average[FRINGES]["interval"]
    if average["ratio"] is None:
        return "no ratio"
    note = ", which says nothing: its divisor can't be told from 0"
    return f"ratio {average['ratio']:.2f}{note if span is not None and span[0] <= 0 <= span[1] else ''}"


def tables(means: Mapping[str, Any], samples: int) -> list[Table]:
    """The paper's table with random weights beside it, and the sanity check."""
    layers = means["layers"]
    said = said_of_layers(PAPER, layers)
    rows = {layer_title(layer) if said else layer: row | {"paper": said.get(layer)} for layer, row in layers.items()}
    rows["Average"] = means["average"] | {"paper": said.get(AVERAGE)}
    rows["Average, random weights"] = _with_ratio(means["random_average"])
    rows["Edges with fringes"] = {EDGES: means["edges_with_fringes"]}
    columns = {EDGES: "r(CAM, edges)", FRINGES: "r(CAM, fringes)"}
    title = f"Correlation of Grad-CAM with edges and fringes, {samples} test samples (the paper's table)"
    random = {layer: row["random"] for layer, row in layers.items()}
    return [
        Table.of(title, "Layer", rows, columns | {"ratio": "Ratio", "paper": "Paper: edges, fringes, ratio"}),
        Table.of("Sanity check: the same with random weights", "Layer", random, columns | {OWN: "r(CAM, trained CAM)"}),
    ]


def _draw_correlations(means: Mapping[str, Any], samples: int) -> Figure:
    lines = []
    for target, colour, grey in ((EDGES, "edges", "random"), (FRINGES, "phase", "raw")):
        trained = {layer: row[target] for layer, row in means["layers"].items()}
        random = {layer: row["random"][target] for layer, row in means["layers"].items()}
        lines.append(Line.of(target, trained, "r", COLOURS[colour], "o-", "interval"))
        lines.append(Line.of(f"{target}, random weights", random, "r", COLOURS[grey], "s--", "interval"))
    panel = Panel(f"Grad-CAM against edges and fringes, {samples} test samples", lines, y="Pearson r")
    alt = "Correlation of Grad-CAM with edges and with fringes by layer"
    return Figure("Correlation by layer", "grad_cam_correlations.png", alt, probe.chart([panel], 1, (9.0, 3.4)))


def _draw_heatmaps(subject: Subject, dataset: DatasetFolder, samples: Sequence[str], layers: Sequence[str]) -> Figure:
    rows = {}
    for sample in dict.fromkeys(samples[round(share * (len(samples) - 1))] for share in np.linspace(0, 1, _EXAMPLES)):
        frames = subject.captured(dataset, sample)
        heat = heat_by_layer(subject, subject.networks()[0], subject.input_batch([frames]), layers)
        maps = [*references(subject, dataset, sample).values(), *(values[0] for values in heat.values())]
        colours = ["gray"] * 2 + ["inferno"] * len(layers)
        rows[sample] = [Picture(np.asarray(frames[subject.frames_used[0]]))]
        rows[sample] += [Picture(*pair, high=float(pair[0].max())) for pair in zip(maps, colours, strict=True)]
    title, alt = "Heatmaps, each scaled to its own largest value", "Input, edges, fringes and Grad-CAM by layer"
    return Figure(title, "grad_cam_heatmaps.png", alt, probe.gallery(rows, ("input", EDGES, FRINGES, *layers)))
