"""The figures of linear probing: the paper's bars, and each layer beside the controls."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fpp_ml_bench.baselines.diagnostics import figures
from fpp_ml_bench.baselines.diagnostics.activations import INPUT
from fpp_ml_bench.baselines.diagnostics.linear_tables import TITLES
from fpp_ml_bench.baselines.diagnostics.probe import Figure
from fpp_ml_bench.baselines.diagnostics.scores import CONTROLS, TRAINED, UNTRAINED, Scores

_COLOURS = {
    "edges": figures.EDGES, "depth": figures.DEPTH, "distance": figures.DEPTH, "phase": figures.PHASE,
    "order": figures.ORDER,
}  # fmt: skip
_BARS = 0.38


def draw(linear: Scores, spatial: Scores, folder: Path) -> list[Figure]:
    """Both figures, written into ``folder``."""
    return [_paper(spatial, folder), _curves(linear, folder)]


def _paper(spatial: Scores, folder: Path) -> Figure:
    layers = list(spatial[TRAINED])
    figure, axes = figures.drawing(1, 2, 10, 3.6)
    positions = np.arange(len(layers))
    for axis, key, interval, title in (
        (axes[0, 0], "mse", "mse_interval", "Validation MSE: the paper's figure (different units!)"),
        (axes[0, 1], "r2", "r2_interval", "The same probes: share of variance explained"),
    ):
        for shift, target in ((-1, "edges"), (1, "depth")):
            scores = [spatial[TRAINED][layer][target] for layer in layers]
            figures.bars_of(
                axis, positions + shift * _BARS / 2, [getattr(layer_score, key) for layer_score in scores],
                [getattr(layer_score, interval) for layer_score in scores], _BARS, _COLOURS[target], target,
            )  # fmt: skip
            random = [getattr(spatial[UNTRAINED][layer][target], key) for layer in layers]
            axis.plot(
                positions + shift * _BARS / 2, random, linestyle="none", marker="_", markersize=9, markeredgewidth=2,
                color="black", label="random weights" if shift > 0 else None,
            )  # fmt: skip
            raw = getattr(spatial[CONTROLS][INPUT][target], key)
            axis.axhline(raw, color=_COLOURS[target], linewidth=1, linestyle=":", label=f"raw input, {target}")
        _layers(axis, layers)
        figures.tidy(axis, title, y="MSE" if key == "mse" else "R2")
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), fontsize=8, frameon=False, ncols=5, loc="outside lower center"
    )
    file = "linear_four_convolutions.png"
    figures.save_png(figure, folder / file)
    return Figure(
        "Four-convolution probes by layer",
        file,
        "Edge and depth probe error and of variance explained for each layer, with random weights and raw input",
    )


def _curves(linear: Scores, folder: Path) -> Figure:
    layers = list(linear[TRAINED])
    targets = list(linear[TRAINED][layers[0]])
    columns = 3 if len(targets) > 2 else 2
    rows = -(-len(targets) // columns)
    figure, axes = figures.drawing(rows, columns, 10, 2.7 * rows)
    positions = np.arange(len(layers))
    for axis, target in zip(axes.flat, targets, strict=False):
        scores = [linear[TRAINED][layer][target] for layer in layers]
        random = [linear[UNTRAINED][layer][target] for layer in layers]
        low, high = (
            [min(layer_score.seeds) for layer_score in random],
            [max(layer_score.seeds) for layer_score in random],
        )
        axis.fill_between(positions, low, high, color=figures.RANDOM, alpha=0.4, linewidth=0)
        axis.plot(positions, [layer_score.r2 for layer_score in random], color=figures.RANDOM, label="random weights")
        axis.plot(
            positions,
            [layer_score.r2 for layer_score in scores],
            color=_COLOURS[target],
            marker="o",
            markersize=4,
            label="trained",
        )
        spans = [
            (x, layer_score.r2_interval)
            for x, layer_score in zip(positions, scores, strict=True)
            if layer_score.r2_interval is not None
        ]
        for x, span in spans:
            axis.plot([x, x], span, color=_COLOURS[target], linewidth=1)
        for control, style in ((INPUT, ":"), ("position", "--")):
            label = "raw input" if control == INPUT else "pixel's position"
            axis.axhline(linear[CONTROLS][control][target].r2, color="black", linewidth=1, linestyle=style, label=label)
        axis.axhline(0, color="#dfe1e5", linewidth=1)
        axis.set_ylim(min(-0.1, max(-0.5, min(layer_score.r2 for layer_score in scores) - 0.05)), 1.02)
        _layers(axis, layers)
        figures.tidy(axis, TITLES[target], y="R2")
    for axis in axes.flat[len(targets) :]:
        axis.axis("off")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    if len(targets) < rows * columns:
        axes.flat[-1].legend(handles, labels, fontsize=8, frameon=False, loc="center")
    else:
        axes.flat[0].legend(fontsize=7, frameon=False)
    file = "linear_one_by_one.png"
    figures.save_png(figure, folder / file)
    description = f"R2 of linear probes for {', '.join(TITLES[target] for target in targets)} by layer, with controls"
    return Figure("Linear (1 x 1) probes by layer and target", file, description)


def _layers(axis: Any, layers: Sequence[str]) -> None:
    axis.set_xticks(np.arange(len(layers)), layers, rotation=40, ha="right", rotation_mode="anchor")
