"""Linear probing: scores of the probes, and the report on them: the paper's table and figure, and the controls."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fpp_ml_bench.baselines.diagnostics.fits import INPUT
from fpp_ml_bench.baselines.diagnostics.probe import Cell, Figure, Sheet, Table, with_interval
from fpp_ml_bench.evaluation.score import object_interval
from fpp_ml_bench.paper import AVERAGE, LAYERS, paper_layers, said_by_paper

PAPER = "linear_probing"
TITLES = {
    "edges": "edges", "depth": "depth, whole image", "distance": "depth in mm, object", "phase": "wrapped phase",
    "order": "fringe order",
}  # fmt: skip
_CONTROLS = {INPUT: "raw input", "position": "pixel's position alone"}
_BAR = 0.38


TRAINED, UNTRAINED, CONTROLS = "trained", "untrained", "controls"
Score = dict[str, Any]
"""``mse``: mean over samples and seeds. ``mse_of_mean``: error of predicting the training samples' mean everywhere.
``r2`` = 1 - mse / mse_of_mean: 1 is perfect, 0 is no better than the mean. Intervals: 95%, resampled over objects; that
of r2, a ratio of two means, to first order. ``seeds``: r2 of each seed."""
Scores = dict[str, dict[str, dict[str, Score]]]
"""Scores by `TRAINED`, `UNTRAINED` or `CONTROLS`, then layer, then target."""


def score(errors: Sequence[Sequence[float]], reference: Sequence[float], objects: Sequence[str]) -> Score:
    """`Score` of ``errors`` (seeds, samples), squared, against those of the mean, ``reference`` (samples,). Raises
    ``ValueError`` where the reference error is 0, so for a constant target."""
    table = np.asarray(errors, dtype=np.float64)
    mean_error = float(np.mean(reference))
    if not mean_error > 0:
        raise ValueError("the target is constant, so there is nothing to explain")
    sample_means = table.mean(axis=0)
    mse = float(sample_means.mean())
    r2 = 1 - mse / mean_error
    # To first order, r2 of a resample differs by -mean(sample_means - (1 - r2) reference) / mean_error. Large objects
    # have large errors in both terms, which cancels.
    deviation = object_interval(((sample_means - (1 - r2) * np.asarray(reference)) / mean_error).tolist(), objects)
    return {
        "mse": mse, "mse_interval": object_interval(sample_means.tolist(), objects), "r2": r2,
        "r2_interval": None if deviation is None else (r2 - deviation[1], r2 - deviation[0]),
        "seeds": (1 - table.mean(axis=1) / mean_error).tolist(), "mse_of_mean": mean_error,
    }  # fmt: skip


def values(linear: Scores, spatial: Scores) -> dict[str, Any]:
    """For ``diagnose.json``."""
    return {
        "four_convolutions": spatial, "ratio": mean_ratio(spatial[TRAINED]),
        "ratio_of_means": ratio_of_means(spatial[CONTROLS][INPUT]), "linear": linear,
    }  # fmt: skip


def mean_over(layers: Mapping[str, Mapping[str, Score]], target: str, key: str = "mse") -> float:
    """Mean over layers, as in the paper's bottom row."""
    return float(np.mean([targets[target][key] for targets in layers.values()]))


def mean_ratio(layers: Mapping[str, Mapping[str, Score]]) -> float:
    """The paper's ratio: mean over layers of the depth probes' MSE, over that of the edge probes."""
    return mean_over(layers, "depth") / mean_over(layers, "edges")


def ratio_of_means(layer: Mapping[str, Score]) -> float:
    """The paper's ratio for a probe that predicts the means, so the ratio of the targets' variances."""
    return float(layer["depth"]["mse_of_mean"] / layer["edges"]["mse_of_mean"])


def summary(linear: Scores, spatial: Scores) -> str:
    """The result in a few sentences."""
    trained, raw = spatial[TRAINED], spatial[CONTROLS]
    edges, depth = (mean_over(trained, target, "r2") for target in ("edges", "depth"))
    easier = "edges are" if edges > depth else "depth is"
    papers = paper_layers(PAPER)[AVERAGE]["ratio"]
    text = (
        f"The paper's ratio, depth MSE over edge MSE, is {mean_ratio(trained):.2f} (paper: {papers:.2f}). The raw "
        f"input alone gives {mean_ratio(raw):.2f}, and a probe that predicts each target's mean "
        f"{ratio_of_means(raw[INPUT]):.2f}, because the two errors have different units. As a share of the explained "
        f"variance, {easier} easier to read on average over layers (R2 {edges:.2f} for edges, {depth:.2f} for depth)."
    )
    if "phase" in linear[CONTROLS][INPUT]:
        r2 = {layer: scores["phase"]["r2"] for layer, scores in linear[TRAINED].items()}
        best, last = max(r2, key=r2.__getitem__), list(r2)[-1]
        text += (
            f" Linear probes read the wrapped phase best from {best} (R2 {r2[best]:.2f}). From the last layer, {last}, "
            f"they reach R2 {r2[last]:.2f}; with random weights {linear[UNTRAINED][last]['phase']['r2']:.2f}."
        )
    return text


def tables(linear: Scores, spatial: Scores) -> list[Table]:
    """The paper's table first, then the same probes as shares of variance, then the linear probes; with controls."""
    trained, untrained, raw = spatial[TRAINED], spatial[UNTRAINED], spatial[CONTROLS][INPUT]
    rows = {layer: {layer: targets} for layer, targets in trained.items()}
    rows |= {"Average": trained, "Average, random weights": untrained, "Raw input": spatial[CONTROLS]}
    keys = ("edges", "depth")
    beside = {*trained, AVERAGE} == set(paper_layers(PAPER))
    errors: list[tuple[Cell, ...]] = [
        (
            f"{name} (paper's {LAYERS[name]})" if beside and LAYERS.get(name, name) != name else name,
            *(mean_over(row, key) for key in keys), mean_ratio(row),
            said_by_paper(PAPER, name.lower()) if beside else None,
        )
        for name, row in rows.items()
    ]  # fmt: skip
    errors.append(("Predicting the mean", *(raw[key]["mse_of_mean"] for key in keys), ratio_of_means(raw), None))

    def r2(one: Score) -> str:
        return with_interval(one["r2"], one["r2_interval"])

    shares = [(layer, *(r2(one[layer][key]) for key in keys for one in (trained, untrained))) for layer in trained]
    targets = list(next(iter(linear[TRAINED].values())))
    one_by_one: list[list[str | None]] = []
    for layer, scores in linear[TRAINED].items():
        pairs = ((scores[target], linear[UNTRAINED][layer][target]) for target in targets)
        one_by_one.append([layer, *(f"{one['r2']:.3f}" for pair in pairs for one in pair)])
    for layer, scores in linear[CONTROLS].items():
        cells = ((f"{scores[target]['r2']:.3f}", None) for target in targets)
        one_by_one.append([_CONTROLS[layer], *(cell for pair in cells for cell in pair)])
    paper = ("Layer", "Edges MSE", "Depth MSE", "Ratio depth / edges", "Paper: edges, depth, ratio")
    both = ("Layer", "Edges R2", "random weights", "Depth R2", "random weights")
    each = ["Layer", *(title for target in targets for title in (TITLES[target], "random"))]
    of_raw = ("Raw input", r2(raw["edges"]), None, r2(raw["depth"]), None)
    return [
        Table("Four-convolution probes, validation MSE (the paper's table; lower is easier to read)", paper, errors),
        Table("The same probes, share of variance explained (R2)", both, [*shares, of_raw]),
        Table("Linear (1 x 1) probes, R2, and that of random weights (intervals: figure and JSON)", each, one_by_one),
    ]


def draw_four_convolutions(spatial: Scores, folder: Path) -> Figure:
    """The paper's figure, and the same probes as shares of variance."""
    layers, raw = list(spatial[TRAINED]), spatial[CONTROLS][INPUT]
    sheet = Sheet(1, 2, 10, 3.6)
    for axis, key, title in (
        (sheet.axes[0, 0], "mse", "Validation MSE: the paper's figure (different units!)"),
        (sheet.axes[0, 1], "r2", "The same probes: share of variance explained"),
    ):
        for shift, target in ((-1, "edges"), (1, "depth")):
            positions, colour = np.arange(len(layers)) + shift * _BAR / 2, sheet.COLOURS[target]
            scores = [spatial[TRAINED][layer][target] for layer in layers]
            bars = [(one[key], one[f"{key}_interval"]) for one in scores]
            sheet.bars(axis, positions, bars, width=_BAR, color=colour, label=target)
            random = [spatial[UNTRAINED][layer][target][key] for layer in layers]
            label = "random weights" if shift > 0 else None
            mark = {"marker": "_", "markersize": 9, "markeredgewidth": 2, "color": "black", "label": label}
            axis.plot(positions, random, linestyle="none", **mark)
            style = {"color": colour, "linewidth": 1, "linestyle": ":"}
            axis.axhline(raw[target][key], label=f"raw input, {target}", **style)
        _name_layers(axis, layers)
        sheet.tidy(axis, title, y="MSE" if key == "mse" else "R2")
    handles, labels = sheet.axes[0, 0].get_legend_handles_labels()
    sheet.figure.legend(handles, labels, fontsize=8, frameon=False, ncols=5, loc="outside lower center")
    alt = "Edge and depth probe error and of variance explained for each layer, with random weights and raw input"
    return sheet.save(folder, "linear_four_convolutions.png", "Four-convolution probes by layer", alt)


def draw_one_by_one(linear: Scores, folder: Path) -> Figure:
    """R2 of the linear probes by layer, for each target, with random weights and controls."""
    layers = list(linear[TRAINED])
    targets, positions = list(linear[TRAINED][layers[0]]), np.arange(len(layers))
    columns = 3 if len(targets) > 2 else 2
    rows = -(-len(targets) // columns)
    sheet = Sheet(rows, columns, 10, 2.7 * rows)
    for axis, target in zip(sheet.axes.flat, targets, strict=False):
        colour, grey = sheet.COLOURS[target], sheet.COLOURS["random"]
        trained, random = ([linear[source][layer][target] for layer in layers] for source in (TRAINED, UNTRAINED))
        low, high = ([end(one["seeds"]) for one in random] for end in (min, max))
        axis.fill_between(positions, low, high, color=grey, alpha=0.4, linewidth=0)
        axis.plot(positions, [one["r2"] for one in random], color=grey, label="random weights")
        style = {"color": colour, "marker": "o", "markersize": 4, "label": "trained"}
        axis.plot(positions, [one["r2"] for one in trained], **style)
        for x, one in zip(positions, trained, strict=True):
            if one["r2_interval"] is not None:
                axis.plot([x, x], one["r2_interval"], color=colour, linewidth=1)
        for control, label, line in ((INPUT, "raw input", ":"), ("position", "pixel's position", "--")):
            r2 = linear[CONTROLS][control][target]["r2"]
            axis.axhline(r2, color="black", linewidth=1, linestyle=line, label=label)
        axis.axhline(0, color=sheet.GRID, linewidth=1)
        axis.set_ylim(min(-0.1, max(-0.5, min(one["r2"] for one in trained) - 0.05)), 1.02)
        _name_layers(axis, layers)
        sheet.tidy(axis, TITLES[target], y="R2")
    for axis in sheet.axes.flat[len(targets) :]:
        axis.axis("off")
    if len(targets) < rows * columns:
        handles, labels = sheet.axes.flat[0].get_legend_handles_labels()
        sheet.axes.flat[-1].legend(handles, labels, fontsize=8, frameon=False, loc="center")
    else:
        sheet.axes.flat[0].legend(fontsize=7, frameon=False)
    alt = f"R2 of linear probes for {', '.join(TITLES[target] for target in targets)} by layer, with controls"
    return sheet.save(folder, "linear_one_by_one.png", "Linear (1 x 1) probes by layer and target", alt)


def _name_layers(axis: Any, layers: Sequence[str]) -> None:
    axis.set_xticks(np.arange(len(layers)), layers, rotation=40, ha="right", rotation_mode="anchor")
