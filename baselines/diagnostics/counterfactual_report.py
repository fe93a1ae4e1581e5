"""Summary, tables and figures of the counterfactual scenes: their predictions, and the parts of the score."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics import figures
from fpp_ml_bench.baselines.diagnostics.counterfactual_scenes import Counterfactuals, SceneSet
from fpp_ml_bench.baselines.diagnostics.probe import Cell, Figure, Table
from fpp_ml_bench.baselines.diagnostics.reliance_measure import DepthMethod, SampleReliance, ScenePredictor
from fpp_ml_bench.baselines.diagnostics.synth import Scene
from fpp_ml_bench.evaluation.result import PART_TITLES, Reliance
from fpp_ml_bench.evaluation.score import caution

_WIDE, _GAP = 11.5, 2
"""Width of the figure of scenes in inches, and gap between two scenes in px."""
SCENES_FILE, PARTS_FILE = "counterfactual_scenes.png", "counterfactual_parts.png"
_FOLLOWS = {
    "follows_phase": "phase alone", "follows_light": "brightness alone", "follows_both": "both, as in\na photograph",
    "follows_constant": "phase, by\na constant", "order_free_follows_phase": "phase, whole\nperiods aside",
}  # fmt: skip
_CHANGES = {
    "change_outline": "other\noutline", "change_no_fringe_inside": "no fringe\ninside",
    "change_no_fringe_outside": "no fringe\noutside", "change_other_direction": "other\ndirection",
    "change_other_pitch": "other\npitch", "order_free_change_outline": "other outline,\nperiods aside",
}  # fmt: skip


def summary(reliance: Reliance) -> str:
    """The score, its parts, and the hypothesis that they support."""
    parts = reliance.parts
    low, high = reliance.interval
    interval = f" (95% interval {low:.2f} to {high:.2f})" if low is not None and high is not None else ""
    order_free = (
        f"; {reliance.order_free_score:.2f} ignoring errors of whole periods"
        if reliance.order_free_score is not None
        else ""
    )
    text = (
        f"Phase reliance {reliance.score:.2f}{interval}{order_free}. The prediction follows a change of phase within "
        f"the object by {_two(parts.follows_phase)}, and a change of brightness alone by {_two(parts.follows_light)}. "
        f"Another outline over the same phase changes it by {_two(parts.change_outline)} of what a moved phase does. "
    )
    if reliance.score >= 0.5 or (reliance.order_free_score or 0.0) >= 0.5:
        text += "It reads the phase."
    elif reliance.score >= 0.1:
        text += "It reads the phase in part."
    else:
        text += "It does not follow the phase."
    return f"{text} {warning}" if (warning := caution(reliance.objects)) else text


def tables(reliance: Reliance, samples: Sequence[SampleReliance]) -> list[Table]:
    """The parts of the score, and the score of every sample."""
    parts: list[list[Cell]] = [[words, getattr(reliance.parts, key)] for key, words in PART_TITLES.items()]
    rows: list[list[Cell]] = [
        [sample.sample, sample.score, sample.order_free_score,
         *(sample.parts.get(part) for part in ("follows_phase", "follows_light", "change_outline"))]
        for sample in samples
    ]  # fmt: skip
    return [
        Table("Parts of the score, and further measurements", ("Part", "Mean over samples"), parts),
        Table(
            "Sample by sample",
            ("Sample", "Score", "Whole periods aside", "Follows phase", "Follows brightness", "Change by outline"),
            rows,
        ),
    ]


def draw(
    method: DepthMethod, scene_set: SceneSet, reliance: Reliance, samples: Sequence[SampleReliance], folder: Path
) -> list[Figure]:
    """Both figures, written into ``folder``. The scenes are those of the middle sample of the list, so they are the
    same for every method."""
    middle = samples[len(samples) // 2].sample
    sample_scenes = next(scenes for scenes in scene_set.scenes(reliance.direction) if scenes.original.sample == middle)
    return [
        _scenes(ScenePredictor(method, scene_set.renderer), sample_scenes, folder),
        _parts(reliance, samples, folder),
    ]


def _scenes(predictor: ScenePredictor, scenes: Counterfactuals, folder: Path) -> Figure:
    """One column per scene: captured frame, true depth, prediction, expected change and actual change."""
    original = scenes.original
    target = original.target & (original.depth_mm > 0)
    truth, before = predictor.true_depth(original.depth_mm, target), predictor.predict(original.scene)
    columns = _figure_columns(predictor, scenes, truth, target)
    box = _box(np.logical_or.reduce([mask for *_, mask in columns]))
    index, masked = predictor.method.frames_used[0], predictor.method.uses_ground_truth_mask
    unit = "mm" if predictor.in_mm else "share of range"
    margin = 0.5 * (float(np.ptp(truth[target])) or 1.0)
    depths = float(truth[target].min()) - margin, float(truth[target].max()) + margin
    moves = [predictor.true_depth(move.depth_mm, target) - truth for move in scenes.moves_within()]
    largest = max(float(np.abs(move[target]).max()) for move in moves)
    rows = (
        ("captured", "gray", 0.0, 255.0),
        (f"truth,\n{unit}", "viridis", *depths), (f"prediction,\n{unit}", "viridis", *depths),
        (f"expected change,\n{unit}", "coolwarm", -largest, largest),
        (f"actual change,\n{unit}", "coolwarm", -largest, largest),
    )  # fmt: skip
    tiles: list[list[NDArray[np.float64]]] = []
    for _, scene, true_depth, mask in columns:
        answer, compared = predictor.predict(scene), mask & target
        missing = predictor.in_mm & (answer == 0)
        column = (
            predictor.renderer.frames(scene, [index], masked)[index],
            np.where(mask, true_depth, np.nan),
            np.where(mask & ~missing, answer, np.nan),
            np.where(compared, true_depth - truth, np.nan),
            np.where(compared & ~missing & ~(predictor.in_mm & (before == 0)), answer - before, np.nan),
        )
        tiles.append(
            [np.pad(np.asarray(image, dtype=np.float64)[box], _GAP, constant_values=np.nan) for image in column]
        )
    height, width = tiles[0][0].shape
    figure, axes = figures.drawing(5, 1, _WIDE, 5 * 0.9 * _WIDE / len(tiles) * height / width + 0.9)
    for row_index, (title, colours, low, high) in enumerate(rows):
        axis = axes[row_index, 0]
        # One image per row: fifty small axes take ten times as long to lay out.
        drawn = figures.picture(axis, np.hstack([column[row_index] for column in tiles]), "", colours, low, high)
        axis.set_facecolor("#e8e8e8" if row_index else "white")
        axis.set_ylabel(title, fontsize=8)
        figure.colorbar(drawn, ax=axis, fraction=0.012, pad=0.008).ax.tick_params(labelsize=6)
    axes[0, 0].xaxis.tick_top()
    axes[0, 0].set_xticks([width * (number + 0.5) for number in range(len(columns))], [name for name, *_ in columns])
    axes[0, 0].tick_params(axis="x", length=0, labelsize=7)
    figure.suptitle(
        f"{original.sample}: one thing changed at a time; {scenes.direction} phase; grey: no prediction", fontsize=10
    )
    figures.save_png(figure, folder / SCENES_FILE)
    return Figure(
        "One thing changed at a time", SCENES_FILE,
        f"Scenes of {original.sample} with changed phase, outline or fringes; truth, prediction and its change",
    )  # fmt: skip


def _figure_columns(
    predictor: ScenePredictor, scenes: Counterfactuals, truth: NDArray[np.float64], target: NDArray[np.bool_]
) -> list[tuple[str, Scene, NDArray[np.float64], NDArray[np.bool_]]]:
    """Scenes of the figure: title, scene, its true depth in the prediction's units, and the mask of that depth."""
    columns = [("as it is", scenes.original.scene, truth, target)]
    for name in ("ramp across", "ramp down", "bump"):
        move = next((move for move in scenes.moves if move.name == name), None)
        if move is not None:
            columns.append((f"phase moved:\n{name}", move.phase, predictor.true_depth(move.depth_mm, target), target))
    for outline_change in scenes.outline_changes:
        mask = outline_change.scene.mask & (outline_change.depth_mm > 0)
        name = outline_change.name.replace("another object's outline", "another\nobject's")
        columns.append(
            (f"outline: {name}", outline_change.scene, predictor.true_depth(outline_change.depth_mm, mask), mask)
        )
    for name, scene in scenes.reprojected.items():
        columns.append((name.replace("fringe ", "fringe\n").replace("other ", "other\n"), scene, truth, target))
    return columns


def _parts(reliance: Reliance, samples: Sequence[SampleReliance], folder: Path) -> Figure:
    """Bars of the parts, with a point for each sample."""
    figure, axes = figures.drawing(1, 2, 9.2, 3.2)
    sides = (
        (_FOLLOWS, "Follows, share of the expected change", figures.PHASE, 1.05),
        (_CHANGES, "Changes, relative to a moved phase", figures.DEPTH, None),
    )
    for axis, (names, title, colour, top) in zip(axes[0], sides, strict=True):
        measured = {key: name for key, name in names.items() if getattr(reliance.parts, key) is not None}
        values = [getattr(reliance.parts, key) for key in measured]
        axis.bar(range(len(measured)), values, 0.6, color=colour, alpha=0.75)
        for number, key in enumerate(measured):
            points = [value for sample in samples if (value := sample.parts.get(key)) is not None]
            axis.plot([number] * len(points), points, ".", color="#191c20", markersize=4, alpha=0.6)
        axis.set_xticks(range(len(measured)), list(measured.values()))
        figures.tidy(axis, title)
        axis.tick_params(axis="x", labelsize=7)
        axis.set_ylim(0, top)
    figure.suptitle(f"Phase reliance {reliance.score:.2f}; a point is a sample", fontsize=10)
    figures.save_png(figure, folder / PARTS_FILE)
    return Figure("What the score is made of", PARTS_FILE, "Bars of how far the answer follows and what changes it")


def _box(mask: NDArray[np.bool_], margin: int = 6) -> tuple[slice, slice]:
    down, across = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return slice(max(down[0] - margin, 0), down[-1] + margin + 1), slice(
        max(across[0] - margin, 0), across[-1] + margin + 1
    )


def _two(value: float | None) -> str:
    return "not measured" if value is None else f"{value:.2f}"
