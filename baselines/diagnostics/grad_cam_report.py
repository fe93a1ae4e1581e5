"""Summary of Grad-CAM, the paper's table, and the paper's two figures."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fpp_ml_bench.baselines.diagnostics import figures
from fpp_ml_bench.baselines.diagnostics.correlation import EDGES, FRINGES, OWN, Correlations, Mean, ratio
from fpp_ml_bench.baselines.diagnostics.grad_cam import PAPER_LAYERS, maps, references
from fpp_ml_bench.baselines.diagnostics.probe import Cell, Figure, Table
from fpp_ml_bench.baselines.diagnostics.subjects import Subject

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.storage import DatasetFolder

PAPER_RATIO = 1.28
_EXAMPLES = 3
_BARS = 0.2


def summary(correlations: Correlations) -> str:
    """The result in a few sentences."""
    edges, fringes = correlations.average(EDGES), correlations.average(FRINGES)
    random = correlations.average(EDGES, trained=False), correlations.average(FRINGES, trained=False)
    own = correlations.average(OWN, trained=False).r
    text = (
        f"Over the layers, heatmaps correlate with edges by {_r(edges.r)} and with fringe variation by "
        f"{_r(fringes.r)}, {ratio_text(edges, fringes)} (paper: 0.136, 0.107, {PAPER_RATIO}). Random weights: "
        f"{_r(random[0].r)} and {_r(random[1].r)}; edges and fringe variation themselves correlate by "
        f"{_r(correlations.references.r)}, because both are strong where the object is."
    )
    if own is not None:
        text += f" Random weights' heatmaps agree with the trained ones by {own:.2f}."
    return text


def ratio_text(edges: Mean, fringes: Mean) -> str:
    """The ratio, with a note where the interval of the divisor holds 0."""
    quotient, span = ratio(edges.r, fringes.r), fringes.interval
    if quotient is None:
        return "no ratio"
    if span is not None and span[0] <= 0 <= span[1]:
        return f"ratio {quotient:.2f}, which says nothing: its divisor can't be told from 0"
    return f"ratio {quotient:.2f}"


def tables(correlations: Correlations) -> list[Table]:
    """The paper's table with random weights beside it, and the sanity check."""
    has_paper_layers = set(correlations.layers) == set(PAPER_LAYERS)
    rows: list[list[Cell]] = []
    for layer in correlations.layers:
        edges, fringes = correlations.mean(layer, EDGES), correlations.mean(layer, FRINGES)
        name = (
            f"{layer} (paper's {PAPER_LAYERS[layer]})" if has_paper_layers and PAPER_LAYERS[layer] != layer else layer
        )
        rows.append([name, _cell(edges), _cell(fringes), ratio(edges.r, fringes.r)])
    for title, trained in (("Average", True), ("Average, random weights", False)):
        edges, fringes = correlations.average(EDGES, trained), correlations.average(FRINGES, trained)
        rows.append([title, _cell(edges), _cell(fringes), ratio(edges.r, fringes.r)])
    between = correlations.references
    rows.append(["Edges with fringes", _cell(between), None, None])
    check: list[list[Cell]] = [
        [
            layer,
            _cell(correlations.mean(layer, EDGES, trained=False)),
            _cell(correlations.mean(layer, FRINGES, trained=False)),
            _cell(correlations.mean(layer, OWN, trained=False)),
        ]
        for layer in correlations.layers
    ]
    count = len(correlations.objects)
    return [
        Table(
            f"Correlation of Grad-CAM with edges and fringes, {count} test samples (the paper's table)",
            ("Layer", "r(CAM, edges)", "r(CAM, fringes)", "Ratio"), rows,
        ),
        Table(
            "Sanity check: the same with random weights",
            ("Layer", "r(CAM, edges)", "r(CAM, fringes)", "r(CAM, trained CAM)"), check,
        ),
    ]  # fmt: skip


def draw(
    correlations: Correlations, subject: Subject, dataset: "DatasetFolder", samples: Sequence[str],
    layers: Sequence[str], folder: Path,
) -> list[Figure]:  # fmt: skip
    """Both figures, written into ``folder``."""
    return [_bars(correlations, folder), _heatmaps(subject, dataset, samples, layers, folder)]


def _bars(correlations: Correlations, folder: Path) -> Figure:
    figure, axes = figures.drawing(1, 1, 9, 3.4)
    axis, positions = axes[0, 0], np.arange(len(correlations.layers))
    series = (
        (EDGES, True, figures.EDGES, "edges"), (FRINGES, True, figures.PHASE, "fringes"),
        (EDGES, False, figures.RANDOM, "edges, random weights"),
        (FRINGES, False, figures.RAW, "fringes, random weights"),
    )  # fmt: skip
    for number, (target, trained, colour, label) in enumerate(series):
        means = [correlations.mean(layer, target, trained) for layer in correlations.layers]
        shift = (number - 1.5) * _BARS
        figures.bars_of(
            axis, positions + shift, [m.r for m in means], [m.interval for m in means], _BARS, colour, label
        )
    axis.axhline(0, color="#191c20", linewidth=0.8)
    axis.set_xticks(positions, correlations.layers, rotation=30 if len(correlations.layers) > 8 else 0)
    figures.tidy(axis, f"Grad-CAM against edges and fringes, {len(correlations.objects)} test samples", y="Pearson r")
    axis.legend(fontsize=8, frameon=False, ncols=2)
    file = "grad_cam_correlations.png"
    figures.save_png(figure, folder / file)
    return Figure("Correlation by layer", file, "Correlation of Grad-CAM with edges and with fringes by layer")


def _heatmaps(
    subject: Subject, dataset: "DatasetFolder", samples: Sequence[str], layers: Sequence[str], folder: Path
) -> Figure:
    picks = sorted({round(share * (len(samples) - 1)) for share in np.linspace(0, 1, _EXAMPLES)})
    examples = [samples[pick] for pick in picks]
    if subject.network is None:
        raise ValueError("heatmaps need a network")
    figure, axes = figures.drawing(len(examples), 3 + len(layers), 1.25 * (3 + len(layers)), 1.4 * len(examples))
    (index,) = subject.frames_used
    sample_maps = maps(subject, subject.network, dataset, examples, layers)
    for row_index, (row, (sample, heat)) in enumerate(zip(axes, sample_maps, strict=True)):
        reference_maps = references(subject, dataset, sample)
        first = row_index == 0
        frame = subject.as_input(dataset.frame(sample, index), dataset.depth_mm(sample))
        figures.picture(row[0], frame, "input" if first else "", low=0, high=255)
        figures.picture(row[1], reference_maps["edges"], "edges" if first else "", low=0)
        figures.picture(row[2], reference_maps["fringes"], "fringes" if first else "", low=0)
        row[0].set_ylabel(sample, fontsize=7)
        for axis, layer in zip(row[3:], layers, strict=True):
            figures.picture(axis, heat[layer], layer if first else "", "inferno", 0, float(heat[layer].max()) or 1.0)
    file = "grad_cam_heatmaps.png"
    figures.save_png(figure, folder / file)
    return Figure("Heatmaps, each scaled to its own largest value", file, "Input, edges, fringes and Grad-CAM by layer")


def _r(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _cell(mean: Mean) -> str:
    if mean.r is None:
        return "-"
    span = "" if mean.interval is None else f" ({mean.interval[0]:.3f} to {mean.interval[1]:.3f})"
    return f"{mean.r:.3f}{span}"
