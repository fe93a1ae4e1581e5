"""The tables of linear probing: the paper's, and the same probes beside their controls."""

import numpy as np

from fpp_ml_bench.baselines.diagnostics.activations import INPUT
from fpp_ml_bench.baselines.diagnostics.probe import Cell, Table
from fpp_ml_bench.baselines.diagnostics.scores import (
    CONTROLS,
    TRAINED,
    UNTRAINED,
    Layers,
    Score,
    Scores,
    mean_ratio,
    ratio,
    ratio_of_means,
)

TITLES = {
    "edges": "edges", "depth": "depth, whole image", "distance": "depth in mm, object", "phase": "wrapped phase",
    "order": "fringe order",
}  # fmt: skip
_CONTROL_TITLES = {INPUT: "raw input", "position": "pixel's position alone"}


def tables(linear: Scores, spatial: Scores) -> list[Table]:
    """All tables, the paper's first."""
    return [paper_table(spatial), variance_table(spatial), linear_table(linear)]


def paper_table(spatial: Scores) -> Table:
    """Validation MSE of the four-convolution probes by layer, and their ratio."""
    rows: list[list[Cell]] = [
        [layer, targets["edges"].mse, targets["depth"].mse, ratio(targets)]
        for layer, targets in spatial[TRAINED].items()
    ]
    rows += [
        [title, *(_mean(layers, target) for target in ("edges", "depth")), mean_ratio(layers)]
        for title, layers in (
            ("Average", spatial[TRAINED]),
            ("Average, random weights", spatial[UNTRAINED]),
            ("Raw input", spatial[CONTROLS]),
        )
    ]
    raw = spatial[CONTROLS][INPUT]
    rows.append(["Predicting the mean", raw["edges"].mse_of_mean, raw["depth"].mse_of_mean, ratio_of_means(raw)])
    return Table(
        "Four-convolution probes, validation MSE (the paper's table; lower is easier to read)",
        ("Layer", "Edges MSE", "Depth MSE", "Ratio depth / edges"),
        rows,
    )


def variance_table(spatial: Scores) -> Table:
    """The same probes as a share of variance explained, against the same probe on random weights."""
    header = ("Layer", "Edges R2", "random weights", "Depth R2", "random weights")
    rows: list[list[Cell]] = [
        [
            layer,
            *(score_text(layers[layer][target]) for target in ("edges", "depth") for layers in _pair(spatial)),
        ]
        for layer in spatial[TRAINED]
    ]
    raw = spatial[CONTROLS][INPUT]
    rows.append(["Raw input", score_text(raw["edges"]), None, score_text(raw["depth"]), None])
    return Table("The same probes, share of variance explained (R2)", header, rows)


def linear_table(linear: Scores) -> Table:
    """R2 of the 1 x 1 probes by layer and target, beside random weights, with the controls below."""
    targets = list(next(iter(linear[TRAINED].values())))
    rows: list[list[Cell]] = []
    for layer, scores in linear[TRAINED].items():
        pairs = [(scores[target], linear[UNTRAINED][layer][target]) for target in targets]
        rows.append([layer, *(f"{target_score.r2:.3f}" for pair in pairs for target_score in pair)])
    for layer, scores in linear[CONTROLS].items():
        rows.append(
            [_CONTROL_TITLES[layer], *(cell for target in targets for cell in (f"{scores[target].r2:.3f}", None))]
        )
    header = ["Layer", *(title for target in targets for title in (TITLES[target], "random"))]
    return Table("Linear (1 x 1) probes, R2, and that of random weights (intervals: figure and JSON)", header, rows)


def score_text(score: Score) -> str:
    """R2 with its interval, for a table cell."""
    if score.r2_interval is None:
        return f"{score.r2:.3f}"
    low, high = score.r2_interval
    return f"{score.r2:.3f} ({low:.3f} to {high:.3f})"


def _pair(scores: Scores) -> tuple[Layers, Layers]:
    return scores[TRAINED], scores[UNTRAINED]


def _mean(layers: Layers, target: str) -> float:
    return float(np.mean([targets[target].mse for targets in layers.values()]))
