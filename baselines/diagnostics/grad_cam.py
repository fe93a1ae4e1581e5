"""Grad-CAM for regression (paper Section 7.2): which pixels of a layer's activations change the mean prediction.

The heatmap of a layer is the ReLU of its channels' sum, each weighted by the mean gradient of the mean predicted value
with respect to that channel (Selvaraju et al. 2017), resized to the image. It is correlated (Pearson, over all pixels)
with the edges of the true depth and with the local standard deviation of the fringe. As a sanity check (Adebayo et al.
2018) the heatmaps of random weights are measured too: if they are the same, they do not depend on what was learned.
"""

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from captum.attr import LayerAttribution, LayerGradCam
from numpy.typing import NDArray
from torch import Tensor, nn

from fpp_ml_bench.baselines.diagnostics import probe
from fpp_ml_bench.baselines.diagnostics.fits import edge_map
from fpp_ml_bench.baselines.diagnostics.probe import Figure, Finding, ProbeSettings, Progress, Sheet, Table, mean_of
from fpp_ml_bench.baselines.diagnostics.probe import with_interval as text_of
from fpp_ml_bench.baselines.diagnostics.subjects import Subject
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.evaluation.score import Interval, object_interval
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.paper import AVERAGE, LAYERS, paper_layers, said_by_paper

Image = NDArray[np.float32]

PAPER = "grad_cam"
SAMPLES, QUICK_SAMPLES = 30, 6
SEEDS = 2
EDGES, FRINGES, OWN = "edges", "fringes", "own"
_LEAST_SPREAD = 1e-12
_EXAMPLES = 3
_BAR = 0.2


class GradCam(probe.Probe):
    """Heatmaps of the test split against edges and fringes, for the network and for random weights."""

    name = "grad-cam"
    title = "Grad-CAM"
    question = "Which pixels change the mean prediction: those at edges, or those with fringes?"
    without_network = "it has no gradient to follow"
    version = 2

    def run(
        self, subject: Subject, dataset: DatasetFolder, settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        samples = settings.choose(dataset.samples("test"), SAMPLES, QUICK_SAMPLES)
        if not samples:
            raise DiagnosisError(f"{dataset.path}: split test holds no sample, which Grad-CAM needs")
        seeds = settings.seeds or (1 if settings.quick else SEEDS)
        layers = cam_layers(subject)
        correlations = measure(subject, dataset, samples, layers, seeds, progress)
        if correlations.average(EDGES).r is None:
            return self.skip(f"the heatmaps of every layer of {subject.name} ({', '.join(layers)}) are constant.")
        protocol = {
            "split": "test",
            "samples": len(samples),
            "seeds": seeds,
            "layers": list(layers),
            "score": "mean prediction",
            "heatmap": "ReLU, bilinear to the image",
        }
        values = {"protocol": protocol, **correlations.to_dict()}
        drawn = _draw_bars(correlations, folder), _draw_heatmaps(subject, dataset, samples, layers, folder)
        return self.finding(summary(correlations), values, tables(correlations), *drawn)


def cam_layers(subject: Subject) -> tuple[str, ...]:
    """The paper's six layers where the subject has them, else all its probed layers."""
    six = tuple(name for name in subject.layer_names if name in paper_layers(PAPER))
    return six if set(six) | {AVERAGE} == set(paper_layers(PAPER)) else subject.layer_names


def heatmaps(network: nn.Module, layers: dict[str, nn.Module], fringe: Tensor) -> dict[str, Tensor]:
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


def maps(
    subject: Subject, network: nn.Module, dataset: DatasetFolder, samples: Sequence[str], layers: Sequence[str]
) -> Iterator[tuple[str, dict[str, Image]]]:
    """Each sample with its heatmaps by layer after the ReLU, float32 (H, W)."""
    network_layers = subject.layers_of(network)
    for names, fringe in subject.batches(dataset, samples):
        heat = heatmaps(network, {name: network_layers[name] for name in layers}, fringe)
        for number, sample in enumerate(names):
            yield sample, {layer: batch_heat[number].clamp(min=0).numpy() for layer, batch_heat in heat.items()}


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


class Mean(NamedTuple):
    """Mean ``r`` of some ``samples``' correlations and its 95% interval, resampled over objects; None without one."""

    r: float | None
    interval: Interval | None
    samples: int


class Correlations:
    """Correlations by weights (``trained``, ``untrained 0``, ...), layer and reference, of samples of ``objects``."""

    def __init__(self, layers: Sequence[str], objects: list[str]) -> None:
        self.layers, self.objects = tuple(layers), objects
        self.values: dict[tuple[str, str, str], list[float | None]] = {}
        self.edges_with_fringes: list[float | None] = []

    def add(self, weights: str, layer: str, reference: str, r: float | None) -> None:
        """Append the next sample's ``r`` of a layer with a reference; `OWN` is the trained network's heatmap."""
        self.values.setdefault((weights, layer, reference), []).append(r)

    def mean(self, layer: str, reference: str, trained: bool = True) -> Mean:
        """Mean over samples; with random weights, of each sample's mean over seeds."""
        return self._over_samples(self._sample_means((layer,), reference, trained))

    def average(self, reference: str, trained: bool = True) -> Mean:
        """Mean over layers, as in the paper's bottom row, with an interval over samples."""
        means = [self.mean(layer, reference, trained).r for layer in self.layers]
        interval = self._over_samples(self._sample_means(self.layers, reference, trained)).interval
        return Mean(mean_of(means), interval, sum(r is not None for r in means))

    @property
    def references(self) -> Mean:
        """Mean correlation of edges with fringes."""
        return self._over_samples(self.edges_with_fringes)

    def _sample_means(self, layers: Sequence[str], reference: str, trained: bool) -> list[float | None]:
        columns = [
            values
            for (weights, layer, target), values in self.values.items()
            if layer in layers and target == reference and (weights == "trained") == trained
        ]
        return [mean_of([values[sample] for values in columns]) for sample in range(len(self.objects))]

    def _over_samples(self, values: Sequence[float | None]) -> Mean:
        return Mean(mean_of(values), object_interval(values, self.objects), sum(r is not None for r in values))

    def to_dict(self) -> dict[str, Any]:
        """For ``diagnose.json``."""
        layers, average = {}, {target: self.average(target) for target in (EDGES, FRINGES)}
        for layer in self.layers:
            trained = {target: self.mean(layer, target) for target in (EDGES, FRINGES)}
            random = {target: self.mean(layer, target, trained=False)._asdict() for target in (EDGES, FRINGES, OWN)}
            layers[layer] = {**_with_ratio(trained), "random": random}
        random = {target: self.average(target, trained=False)._asdict() for target in (EDGES, FRINGES, OWN)}
        return {
            "layers": layers,
            "average": _with_ratio(average),
            "random_average": random,
            "edges_with_fringes": self.references._asdict(),
        }


def _with_ratio(means: dict[str, Mean]) -> dict[str, Any]:
    return {**{key: mean._asdict() for key, mean in means.items()}, "ratio": ratio(means[EDGES].r, means[FRINGES].r)}


def ratio(edges: float | None, fringes: float | None) -> float | None:
    """The paper's ratio: correlation with edges over correlation with fringes; None where undefined."""
    return None if edges is None or not fringes else edges / fringes


def measure(
    subject: Subject,
    dataset: DatasetFolder,
    samples: Sequence[str],
    layers: Sequence[str],
    seeds: int,
    progress: Progress,
) -> Correlations:
    """Correlations of every heatmap with both references, and of random weights' heatmaps with the trained ones."""
    network, untrained = subject.networks()
    correlations = Correlations(layers, [split_sample_name(name)[0] for name in samples])
    total, done = len(samples) * (1 + seeds), 0
    networks = {"trained": network} | {f"untrained {seed}": untrained(seed) for seed in range(seeds)}
    for start in range(0, len(samples), subject.batch_size):
        batch_samples = samples[start : start + subject.batch_size]
        reference_maps = {sample: references(subject, dataset, sample) for sample in batch_samples}
        correlations.edges_with_fringes += [correlation(*of_sample.values()) for of_sample in reference_maps.values()]
        trained_maps: dict[str, dict[str, Image]] = {}
        for weights, one_network in networks.items():
            heatmaps_of = dict(maps(subject, one_network, dataset, batch_samples, layers))
            for sample, layer in product(batch_samples, layers):
                own = {OWN: trained_maps[sample][layer]} if trained_maps else {}
                for target, reference in {**reference_maps[sample], **own}.items():
                    correlations.add(weights, layer, target, correlation(heatmaps_of[sample][layer], reference))
            trained_maps = trained_maps or heatmaps_of
            done += len(batch_samples)
            progress(done, total, "Grad-CAM" if weights == "trained" else "Grad-CAM of random weights")
    return correlations


def summary(correlations: Correlations) -> str:
    """The result in a few sentences."""
    edges, fringes = correlations.average(EDGES), correlations.average(FRINGES)
    random = [text_of(correlations.average(target, trained=False).r, None) for target in (EDGES, FRINGES)]
    own, paper = correlations.average(OWN, trained=False).r, said_by_paper(PAPER, AVERAGE)
    text = (
        f"Over the layers, heatmaps correlate with edges by {text_of(edges.r, None)} and with fringe variation by "
        f"{text_of(fringes.r, None)}, {ratio_text(edges, fringes)} (paper: {paper}). Random "
        f"weights: {random[0]} and {random[1]}; edges and fringe variation themselves correlate by "
        f"{text_of(correlations.references.r, None)}, because both are strong where the object is."
    )
    return text if own is None else f"{text} Random weights' heatmaps agree with the trained ones by {own:.2f}."


def ratio_text(edges: Mean, fringes: Mean) -> str:
    """The ratio, with a note where the interval of the divisor holds 0."""
    quotient, span = ratio(edges.r, fringes.r), fringes.interval
    if quotient is None:
        return "no ratio"
    note = ", which says nothing: its divisor can't be told from 0"
    return f"ratio {quotient:.2f}{note if span is not None and span[0] <= 0 <= span[1] else ''}"


def tables(correlations: Correlations) -> list[Table]:
    """The paper's table with random weights beside it, and the sanity check."""
    beside = {*correlations.layers, AVERAGE} == set(paper_layers(PAPER))
    pairs = {}
    for layer in correlations.layers:
        name = f"{layer} (paper's {LAYERS[layer]})" if beside and LAYERS[layer] != layer else layer
        pairs[name] = layer, [correlations.mean(layer, target) for target in (EDGES, FRINGES)]
    for name, place, trained in (("Average", AVERAGE, True), ("Average, random weights", "", False)):
        pairs[name] = place, [correlations.average(target, trained) for target in (EDGES, FRINGES)]
    rows: list[tuple[probe.Cell, ...]] = [
        (
            name,
            *(text_of(*mean[:2]) for mean in pair),
            ratio(pair[0].r, pair[1].r),
            said_by_paper(PAPER, layer) if beside else None,
        )
        for name, (layer, pair) in pairs.items()
    ]
    rows.append(("Edges with fringes", text_of(*correlations.references[:2]), None, None, None))
    random = []
    for layer in correlations.layers:
        means = (correlations.mean(layer, target, trained=False) for target in (EDGES, FRINGES, OWN))
        random.append((layer, *(text_of(*mean[:2]) for mean in means)))
    count, header = len(correlations.objects), ("Layer", "r(CAM, edges)", "r(CAM, fringes)")
    title = f"Correlation of Grad-CAM with edges and fringes, {count} test samples (the paper's table)"
    sanity = "Sanity check: the same with random weights"
    compared = Table(title, (*header, "Ratio", "Paper: edges, fringes, ratio"), rows)
    return [compared, Table(sanity, (*header, "r(CAM, trained CAM)"), random)]


def _draw_bars(correlations: Correlations, folder: Path) -> Figure:
    sheet = Sheet(1, 1, 9, 3.4)
    axis, layers, positions = sheet.axes[0, 0], correlations.layers, np.arange(len(correlations.layers))
    series = (
        (EDGES, True, "edges", "edges"),
        (FRINGES, True, "phase", "fringes"),
        (EDGES, False, "random", "edges, random weights"),
        (FRINGES, False, "raw", "fringes, random weights"),
    )
    for number, (target, trained, colour, label) in enumerate(series):
        bars = [correlations.mean(layer, target, trained)[:2] for layer in layers]
        sheet.bars(axis, positions + (number - 1.5) * _BAR, bars, width=_BAR, color=sheet.COLOURS[colour], label=label)
    axis.axhline(0, color=sheet.INK, linewidth=0.8)
    axis.set_xticks(positions, layers, rotation=30 if len(layers) > 8 else 0)
    sheet.tidy(axis, f"Grad-CAM against edges and fringes, {len(correlations.objects)} test samples", y="Pearson r")
    axis.legend(fontsize=8, frameon=False, ncols=2)
    alt = "Correlation of Grad-CAM with edges and with fringes by layer"
    return sheet.save(folder, "grad_cam_correlations.png", "Correlation by layer", alt)


def _draw_heatmaps(
    subject: Subject, dataset: DatasetFolder, samples: Sequence[str], layers: Sequence[str], folder: Path
) -> Figure:
    picks = sorted({round(share * (len(samples) - 1)) for share in np.linspace(0, 1, _EXAMPLES)})
    examples = [samples[pick] for pick in picks]
    sheet = Sheet(len(examples), 3 + len(layers), 1.25 * (3 + len(layers)), 1.4 * len(examples))
    sample_maps = maps(subject, subject.networks()[0], dataset, examples, layers)
    titles = ["input", "edges", "fringes", *layers]
    for row, (sample, heat) in zip(sheet.axes, sample_maps, strict=True):
        frame = np.asarray(subject.captured(dataset, sample)[subject.frames_used[0]])
        images = [frame, *references(subject, dataset, sample).values(), *(heat[layer] for layer in layers)]
        for number, (axis, image, title) in enumerate(zip(row, images, titles, strict=True)):
            top = 255 if not number else float(image.max()) or (1.0 if number > 2 else 0.0)
            sheet.picture(axis, image, title, "gray" if number < 3 else "inferno", 0, top)
        row[0].set_ylabel(sample, fontsize=7)
        titles = [""] * len(titles)  # only above the first row
    title, alt = "Heatmaps, each scaled to its own largest value", "Input, edges, fringes and Grad-CAM by layer"
    return sheet.save(folder, "grad_cam_heatmaps.png", title, alt)
