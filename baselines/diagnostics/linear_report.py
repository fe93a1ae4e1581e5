"""Linear probing: scores of the probes, and the report on them: the paper's table and figure, and the controls."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fpp_ml_bench.baselines.diagnostics.fits import INPUT, MEASURED, OBJECT_DEPTH, POSITION, SILHOUETTE
from fpp_ml_bench.baselines.diagnostics.probe import Cell, Figure, Sheet, Table, with_interval
from fpp_ml_bench.evaluation.score import object_interval
from fpp_ml_bench.paper import AVERAGE, LAYERS, paper_layers, said_by_paper

PAPER = "linear_probing"
TITLES = {
    "edges": "edges",
    "depth": "depth, whole image",
    OBJECT_DEPTH: "depth, object",
    "distance": "depth in mm, object",
    "phase": "wrapped phase",
    "order": "fringe order",
}
CONTROL_TITLES = {INPUT: "raw input", SILHOUETTE: "object's mask alone", POSITION: "pixel's position alone"}
_LINES = dict(zip(CONTROL_TITLES, (":", "-.", "--"), strict=True))

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
        "mse": mse,
        "mse_interval": object_interval(sample_means.tolist(), objects),
        "r2": r2,
        "r2_interval": None if deviation is None else (r2 - deviation[1], r2 - deviation[0]),
        "seeds": (1 - table.mean(axis=1) / mean_error).tolist(),
        "mse_of_mean": mean_error,
    }


def values(linear: Scores, spatial: Scores) -> dict[str, Any]:
    """For ``diagnose.json``."""
    return {
        "four_convolutions": spatial,
        "ratio": mean_ratio(spatial[TRAINED]),
        "ratio_of_means": ratio_of_means(spatial[CONTROLS][INPUT]),
        "linear": linear,
    }


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
    trained, controls = spatial[TRAINED], spatial[CONTROLS]
    raw, mask = controls[INPUT], controls[SILHOUETTE]
    edges, depth, on_object = (mean_over(trained, target, "r2") for target in MEASURED)
    papers = paper_layers(PAPER)[AVERAGE]["ratio"]
    text = (
        f"The paper's ratio, depth MSE over edge MSE, is {mean_ratio(trained):.2f} (paper: {papers:.2f}). The raw "
        f"input alone gives {mean_ratio({INPUT: raw}):.2f}, and a probe that predicts each target's mean "
        f"{ratio_of_means(raw):.2f}, because the two errors have different units. On average over layers R2 is "
        f"{edges:.2f} for edges and {depth:.2f} for depth. The object's mask alone gives {mask['edges']['r2']:.2f} and "
        f"{mask['depth']['r2']:.2f}, so R2 over the whole image can come from the outline and does not show which of "
        f"the two is easier to read. For depth on object pixels R2 is {on_object:.2f} (random weights "
        f"{mean_over(spatial[UNTRAINED], OBJECT_DEPTH, 'r2'):.2f}, raw input {raw[OBJECT_DEPTH]['r2']:.2f}, mask "
        f"{mask[OBJECT_DEPTH]['r2']:.2f})."
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
    rows |= {"Average": trained, "Average, random weights": untrained}
    rows |= {CONTROL_TITLES[name]: {name: targets} for name, targets in spatial[CONTROLS].items()}
    beside = {*trained, AVERAGE} == set(paper_layers(PAPER))
    errors: list[tuple[Cell, ...]] = [
        (
            f"{name} (paper's {LAYERS[name]})" if beside and LAYERS.get(name, name) != name else name,
            *(mean_over(row, key) for key in MEASURED),
            mean_ratio(row),
            said_by_paper(PAPER, name.lower()) if beside else None,
        )
        for name, row in rows.items()
    ]
    errors.append(("Predicting the mean", *(raw[key]["mse_of_mean"] for key in MEASURED), ratio_of_means(raw), None))

    paper = ("Layer", *(TITLES[key] for key in MEASURED), "Ratio depth / edges", "Paper: edges, depth, ratio")
    return [
        Table("Four-convolution probes, validation MSE (the paper's table; lower is easier to read)", paper, errors),
        _shares("The same probes, share of variance explained (R2)", spatial, intervals=True),
        _shares("Linear (1 x 1) probes, R2 (intervals: figure and JSON)", linear, intervals=False),
    ]


def _shares(title: str, scores: Scores, intervals: bool) -> Table:
    """R2 of each layer beside that of random weights, and of the controls, by target."""
    targets = list(next(iter(scores[CONTROLS].values())))
    rows = [(layer, of_layer, scores[UNTRAINED][layer]) for layer, of_layer in scores[TRAINED].items()]
    rows += [(CONTROL_TITLES[name], of_control, {}) for name, of_control in scores[CONTROLS].items()]

    def r2(one: Score | None) -> str | None:
        return None if one is None else with_interval(one["r2"], one["r2_interval"] if intervals else None)

    lines = [(name, *(r2(one.get(key)) for key in targets for one in pair)) for name, *pair in rows]
    return Table(title, ["Layer", *(text for key in targets for text in (TITLES[key], "random weights"))], lines)


def draw_four_convolutions(spatial: Scores, folder: Path) -> Figure:
    """The paper's figure, and the same probes as shares of variance."""
    layers = list(spatial[TRAINED])
    sheet = Sheet(1, 2, 11, 4.0)
    for axis, key, targets, title in (
        (sheet.axes[0, 0], "mse", ("edges", "depth"), "Validation MSE: the paper's figure (different units!)"),
        (sheet.axes[0, 1], "r2", tuple(MEASURED), "The same probes: share of variance explained"),
    ):
        width = 0.78 / len(targets)
        for number, target in enumerate(targets):
            positions = np.arange(len(layers)) + (number - (len(targets) - 1) / 2) * width
            colour = sheet.COLOURS[target]
            scores = [spatial[TRAINED][layer][target] for layer in layers]
            bars = [(one[key], one[f"{key}_interval"]) for one in scores]
            sheet.bars(axis, positions, bars, width=width, color=colour, label=TITLES[target])
            random = [spatial[UNTRAINED][layer][target][key] for layer in layers]
            label = None if number else "random weights"
            mark = {"marker": "_", "markersize": 7, "markeredgewidth": 2, "color": "black", "label": label}
            axis.plot(positions, random, linestyle="none", **mark)
            for control, of_target in spatial[CONTROLS].items():
                style = {"color": colour, "linewidth": 1, "linestyle": _LINES[control]}
                axis.axhline(of_target[target][key], label=f"{CONTROL_TITLES[control]}: {TITLES[target]}", **style)
        _name_layers(axis, layers)
        sheet.tidy(axis, title, y="MSE" if key == "mse" else "R2")
    sheet.legend(sheet.axes[0, 1], 4)
    alt = "Error and share of variance explained of edge and depth probes by layer, with random weights and controls"
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
        for control, scores in linear[CONTROLS].items():
            style = {"linestyle": _LINES[control], "label": CONTROL_TITLES[control]}
            axis.axhline(scores[target]["r2"], color="black", linewidth=1, **style)
        axis.axhline(0, color=sheet.GRID, linewidth=1)
        axis.set_ylim(min(-0.1, max(-0.5, min(one["r2"] for one in trained) - 0.05)), 1.02)
        _name_layers(axis, layers)
        sheet.tidy(axis, TITLES[target], y="R2")
    for axis in sheet.axes.flat[len(targets) :]:
        axis.axis("off")
    sheet.legend(sheet.axes.flat[0], 5)
    alt = f"R2 of linear probes for {', '.join(TITLES[target] for target in targets)} by layer, with controls"
    return sheet.save(folder, "linear_one_by_one.png", "Linear (1 x 1) probes by layer and target", alt)


def _name_layers(axis: Any, layers: Sequence[str]) -> None:
    axis.set_xticks(np.arange(len(layers)), layers, rotation=40, ha="right", rotation_mode="anchor")
