"""What counterfactual scenes say, in words, tables and two figures: the scenes with their answers, and the parts."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics import figures
from fpp_ml_bench.baselines.diagnostics.counterfactual_scenes import Counterfactuals, SceneBook
from fpp_ml_bench.baselines.diagnostics.probe import Cell, Figure, Table
from fpp_ml_bench.baselines.diagnostics.reliance_measure import Asked, Asker, SampleReliance
from fpp_ml_bench.baselines.diagnostics.synth import Scene
from fpp_ml_bench.evaluation.reliance import PART_TITLES, Reliance
from fpp_ml_bench.evaluation.uncertainty import caution

_WIDE, _GAP = 11.5, 2
"""Width of the figure of scenes in inches, and px between two scenes."""
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


def summary(found: Reliance) -> str:
    """The score, what it is made of, and which hypothesis that speaks for."""
    parts = found.parts
    low, high = found.interval
    span = f" (95% interval {low:.2f} to {high:.2f})" if low is not None and high is not None else ""
    free = (
        f"; {found.order_free_score:.2f} where whole periods are forgiven" if found.order_free_score is not None else ""
    )
    text = (
        f"Phase reliance {found.score:.2f}{span}{free}. Of a change of phase within the object the answer follows "
        f"{_two(parts.follows_phase)}, of a change of brightness alone {_two(parts.follows_light)}; another outline "
        f"over the same phase changes it by {_two(parts.change_outline)} of what the phase asked. "
    )
    if found.score >= 0.5 or (found.order_free_score or 0.0) >= 0.5:
        text += "It reads the phase."
    elif found.score >= 0.1:
        text += "It reads the phase in part."
    else:
        text += "It does not follow the phase: whatever it answers from, it is not the fringe's phase."
    return f"{text} {warning}" if (warning := caution(found.objects)) else text


def tables(found: Reliance, samples: Sequence[SampleReliance]) -> list[Table]:
    """The parts, and the score of every sample."""
    parts: list[list[Cell]] = [[words, getattr(found.parts, key)] for key, words in PART_TITLES.items()]
    rows: list[list[Cell]] = [
        [one.sample, one.score, one.order_free_score, one.parts.get("follows_phase"), one.parts.get("follows_light"),
         one.parts.get("change_outline")]
        for one in samples
    ]  # fmt: skip
    return [
        Table("What the score is made of, and what stands beside it", ("Part", "Mean over samples"), parts),
        Table(
            "Sample by sample",
            ("Sample", "Score", "Whole periods aside", "Follows phase", "Follows brightness", "Change by outline"),
            rows,
        ),
    ]


def draw(
    asked: Asked, book: SceneBook, found: Reliance, samples: Sequence[SampleReliance], folder: Path
) -> list[Figure]:
    """Both figures, written into ``folder``; the scenes are those of the sample in the middle of the list, the same for
    every method."""
    middle = samples[len(samples) // 2].sample
    shown = next(scenes for scenes in book.scenes(found.direction) if scenes.original.sample == middle)
    return [_scenes(Asker(asked, book.room), shown, folder), _parts(found, samples, folder)]


def _scenes(asker: Asker, scenes: Counterfactuals, folder: Path) -> Figure:
    """A column a scene: what was captured, the truth, the answer, the change asked and the change made."""
    found = scenes.original
    target = found.target & (found.depth_mm > 0)
    truth, before = asker.truth(found.depth_mm, target), asker.answer(found.scene)
    shown = _shown(asker, scenes, truth, target)
    box = _box(np.logical_or.reduce([mask for *_, mask in shown]))
    index, masked = asker.asked.frames_used[0], bool(getattr(asker.asked, "uses_ground_truth_mask", False))
    unit = "mm" if asker.metric else "share of range"
    margin = 0.5 * (float(np.ptp(truth[target])) or 1.0)
    depths = float(truth[target].min()) - margin, float(truth[target].max()) + margin
    moves = [asker.truth(move.depth_mm, target) - truth for move in scenes.moves_within()]
    most = max(float(np.abs(move[target]).max()) for move in moves)
    looks = (
        ("captured", "gray", 0.0, 255.0),
        (f"truth,\n{unit}", "viridis", *depths), (f"answer,\n{unit}", "viridis", *depths),
        (f"change asked,\n{unit}", "coolwarm", -most, most), (f"change made,\n{unit}", "coolwarm", -most, most),
    )  # fmt: skip
    tiles: list[list[NDArray[np.float64]]] = []
    for _, scene, true, mask in shown:
        answer, both = asker.answer(scene), mask & target
        missing = asker.metric & (answer == 0)
        column = (
            asker.room.frames(scene, [index], masked)[index],
            np.where(mask, true, np.nan),
            np.where(mask & ~missing, answer, np.nan),
            np.where(both, true - truth, np.nan),
            np.where(both & ~missing & ~(asker.metric & (before == 0)), answer - before, np.nan),
        )
        tiles.append(
            [np.pad(np.asarray(image, dtype=np.float64)[box], _GAP, constant_values=np.nan) for image in column]
        )
    height, width = tiles[0][0].shape
    figure, axes = figures.drawing(5, 1, _WIDE, 5 * 0.9 * _WIDE / len(tiles) * height / width + 0.9)
    for line, (title, colours, low, high) in enumerate(looks):
        axis = axes[line, 0]
        # One image a row: fifty small axes take ten times as long to lay out.
        drawn = figures.picture(axis, np.hstack([column[line] for column in tiles]), "", colours, low, high)
        axis.set_facecolor("#e8e8e8" if line else "white")
        axis.set_ylabel(title, fontsize=8)
        figure.colorbar(drawn, ax=axis, fraction=0.012, pad=0.008).ax.tick_params(labelsize=6)
    axes[0, 0].xaxis.tick_top()
    axes[0, 0].set_xticks([width * (place + 0.5) for place in range(len(shown))], [name for name, *_ in shown])
    axes[0, 0].tick_params(axis="x", length=0, labelsize=7)
    figure.suptitle(
        f"{found.sample}: one thing changed at a time; {scenes.direction} phase; grey: no answer", fontsize=10
    )
    figures.save_png(figure, folder / SCENES_FILE)
    return Figure(
        "One thing changed at a time", SCENES_FILE,
        f"Scenes of {found.sample} with the phase, the outline or the fringes changed; truth, answer and its change",
    )  # fmt: skip


def _shown(
    asker: Asker, scenes: Counterfactuals, truth: NDArray[np.float64], target: NDArray[np.bool_]
) -> list[tuple[str, Scene, NDArray[np.float64], NDArray[np.bool_]]]:
    """Scenes of the figure: title, scene, its truth in the answer's units, where that is."""
    shown = [("as it is", scenes.original.scene, truth, target)]
    for name in ("ramp across", "ramp down", "bump"):
        move = next((move for move in scenes.moves if move.name == name), None)
        if move is not None:
            shown.append((f"phase moved:\n{name}", move.phase, asker.truth(move.depth_mm, target), target))
    for recut in scenes.recuts:
        mask = recut.scene.mask & (recut.depth_mm > 0)
        name = recut.name.replace("another object's outline", "another\nobject's")
        shown.append((f"outline: {name}", recut.scene, asker.truth(recut.depth_mm, mask), mask))
    for name, scene in scenes.reprojected.items():
        shown.append((name.replace("fringe ", "fringe\n").replace("other ", "other\n"), scene, truth, target))
    return shown


def _parts(found: Reliance, samples: Sequence[SampleReliance], folder: Path) -> Figure:
    """Bars of the parts with a point a sample."""
    figure, axes = figures.drawing(1, 2, 9.2, 3.2)
    sides = (
        (_FOLLOWS, "Follows, share of the change asked", figures.PHASE, 1.05),
        (_CHANGES, "Changes, in units of what the phase asks", figures.DEPTH, None),
    )
    for axis, (names, title, colour, top) in zip(axes[0], sides, strict=True):
        known = {key: name for key, name in names.items() if getattr(found.parts, key) is not None}
        values = [getattr(found.parts, key) for key in known]
        axis.bar(range(len(known)), values, 0.6, color=colour, alpha=0.75)
        for place, key in enumerate(known):
            points = [value for one in samples if (value := one.parts.get(key)) is not None]
            axis.plot([place] * len(points), points, ".", color="#191c20", markersize=4, alpha=0.6)
        axis.set_xticks(range(len(known)), list(known.values()))
        figures.tidy(axis, title)
        axis.tick_params(axis="x", labelsize=7)
        axis.set_ylim(0, top)
    figure.suptitle(f"Phase reliance {found.score:.2f}; a point is a sample", fontsize=10)
    figures.save_png(figure, folder / PARTS_FILE)
    return Figure("What the score is made of", PARTS_FILE, "Bars of how far the answer follows and what changes it")


def _box(mask: NDArray[np.bool_], margin: int = 6) -> tuple[slice, slice]:
    down, across = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return slice(max(down[0] - margin, 0), down[-1] + margin + 1), slice(
        max(across[0] - margin, 0), across[-1] + margin + 1
    )


def _two(value: float | None) -> str:
    return "not asked" if value is None else f"{value:.2f}"
