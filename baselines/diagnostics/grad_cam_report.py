"""What Grad-CAM found in words, in the paper's table, and in the paper's two figures."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fpp_ml_bench.baselines.diagnostics import figures
from fpp_ml_bench.baselines.diagnostics.correlation import EDGES, FRINGES, OWN, Correlations, Mean, ratio
from fpp_ml_bench.baselines.diagnostics.grad_cam import PAPER_LAYERS, maps, references
from fpp_ml_bench.baselines.diagnostics.probe import Cell, Figure, Table
from fpp_ml_bench.baselines.diagnostics.subject import Subject

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.store import DatasetFolder

PAPER_RATIO = 1.28
_SHOWN = 3
_BARS = 0.2


def summary(found: Correlations) -> str:
    """What the numbers say, and what they can't."""
    edges, fringes = found.average(EDGES), found.average(FRINGES)
    random = found.average(EDGES, trained=False), found.average(FRINGES, trained=False)
    own = found.average(OWN, trained=False).r
    text = (
        f"Over the layers, heatmaps correlate with edges by {_r(edges.r)} and with fringe variation by "
        f"{_r(fringes.r)}, {ratio_said(edges, fringes)} (paper: 0.136, 0.107, {PAPER_RATIO}). Random weights: "
        f"{_r(random[0].r)} and {_r(random[1].r)}; edges and fringe variation themselves correlate by "
        f"{_r(found.references.r)}, for both are strong where the object is."
    )
    if own is not None:
        text += f" Random weights' heatmaps agree with the trained ones by {own:.2f}."
    return text


def ratio_said(edges: Mean, fringes: Mean) -> str:
    """The ratio, and whether it can be one: a divisor whose interval holds 0 divides by anything."""
    quotient, span = ratio(edges.r, fringes.r), fringes.interval
    if quotient is None:
        return "no ratio"
    if span is not None and span[0] <= 0 <= span[1]:
        return f"ratio {quotient:.2f}, which says nothing: the second can't be told from 0"
    return f"ratio {quotient:.2f}"


def tables(found: Correlations) -> list[Table]:
    """The paper's table with random weights beside it, and the sanity check."""
    ours = set(found.layers) == set(PAPER_LAYERS)
    rows: list[list[Cell]] = []
    for layer in found.layers:
        edges, fringes = found.mean(layer, EDGES), found.mean(layer, FRINGES)
        name = f"{layer} (paper's {PAPER_LAYERS[layer]})" if ours and PAPER_LAYERS[layer] != layer else layer
        rows.append([name, _shown(edges), _shown(fringes), ratio(edges.r, fringes.r)])
    for title, trained in (("Average", True), ("Average, random weights", False)):
        edges, fringes = found.average(EDGES, trained), found.average(FRINGES, trained)
        rows.append([title, _shown(edges), _shown(fringes), ratio(edges.r, fringes.r)])
    between = found.references
    rows.append(["Edges with fringes", _shown(between), None, None])
    check: list[list[Cell]] = [
        [
            layer,
            _shown(found.mean(layer, EDGES, trained=False)),
            _shown(found.mean(layer, FRINGES, trained=False)),
            _shown(found.mean(layer, OWN, trained=False)),
        ]
        for layer in found.layers
    ]
    count = len(found.objects)
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
    found: Correlations, subject: Subject, dataset: "DatasetFolder", samples: Sequence[str], layers: Sequence[str],
    folder: Path,
) -> list[Figure]:  # fmt: skip
    """Both figures, written into ``folder``."""
    return [_bars(found, folder), _heatmaps(subject, dataset, samples, layers, folder)]


def _bars(found: Correlations, folder: Path) -> Figure:
    figure, axes = figures.drawing(1, 1, 9, 3.4)
    axis, place = axes[0, 0], np.arange(len(found.layers))
    series = (
        (EDGES, True, figures.EDGES, "edges"), (FRINGES, True, figures.PHASE, "fringes"),
        (EDGES, False, figures.RANDOM, "edges, random weights"),
        (FRINGES, False, figures.RAW, "fringes, random weights"),
    )  # fmt: skip
    for number, (what, trained, colour, label) in enumerate(series):
        means = [found.mean(layer, what, trained) for layer in found.layers]
        shift = (number - 1.5) * _BARS
        figures.bars_of(axis, place + shift, [m.r for m in means], [m.interval for m in means], _BARS, colour, label)
    axis.axhline(0, color="#191c20", linewidth=0.8)
    axis.set_xticks(place, found.layers, rotation=30 if len(found.layers) > 8 else 0)
    figures.tidy(axis, f"Grad-CAM against edges and fringes, {len(found.objects)} test samples", y="Pearson r")
    axis.legend(fontsize=8, frameon=False, ncols=2)
    file = "grad_cam_correlations.png"
    figures.save_png(figure, folder / file)
    return Figure("Correlation by layer", file, "Correlation of Grad-CAM with edges and with fringes by layer")


def _heatmaps(
    subject: Subject, dataset: "DatasetFolder", samples: Sequence[str], layers: Sequence[str], folder: Path
) -> Figure:
    places = sorted({round(share * (len(samples) - 1)) for share in np.linspace(0, 1, _SHOWN)})
    shown = [samples[place] for place in places]
    if subject.network is None:
        raise ValueError("heatmaps need a network")
    figure, axes = figures.drawing(len(shown), 3 + len(layers), 1.25 * (3 + len(layers)), 1.4 * len(shown))
    (index,) = subject.frames_used
    found = maps(subject, subject.network, dataset, shown, layers)
    for number, (row, (sample, heat)) in enumerate(zip(axes, found, strict=True)):
        known = references(subject, dataset, sample)
        first = number == 0
        frame = subject.as_given(dataset.frame(sample, index), dataset.depth_mm(sample))
        figures.picture(row[0], frame, "input" if first else "", low=0, high=255)
        figures.picture(row[1], known["edges"], "edges" if first else "", low=0)
        figures.picture(row[2], known["fringes"], "fringes" if first else "", low=0)
        row[0].set_ylabel(sample, fontsize=7)
        for axis, layer in zip(row[3:], layers, strict=True):
            figures.picture(axis, heat[layer], layer if first else "", "inferno", 0, float(heat[layer].max()) or 1.0)
    file = "grad_cam_heatmaps.png"
    figures.save_png(figure, folder / file)
    return Figure("Heatmaps, each scaled to its own largest value", file, "Input, edges, fringes and Grad-CAM by layer")


def _r(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _shown(mean: Mean) -> str:
    if mean.r is None:
        return "-"
    span = "" if mean.interval is None else f" ({mean.interval[0]:.3f} to {mean.interval[1]:.3f})"
    return f"{mean.r:.3f}{span}"
