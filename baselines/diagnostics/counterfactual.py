"""Counterfactual scenes (own probe): does the predicted depth follow the fringe's phase, or the object's outline?

Each test object is rendered again with a single property changed, so that the correct change of depth is known. A score
compares it with the change of the prediction (`fpp_ml_bench.baselines.diagnostics.phase_reliance`).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.counterfactual_scenes import VIEWS_PER_OBJECT, Counterfactuals, SceneSet
from fpp_ml_bench.baselines.diagnostics.phase_reliance import SampleReliance, ScenePredictor, measure
from fpp_ml_bench.baselines.diagnostics.probe import Figure, Finding, Probe, ProbeSettings, Progress, Sheet, Table
from fpp_ml_bench.baselines.diagnostics.scene_renderer import Scene
from fpp_ml_bench.baselines.diagnostics.subjects import Subject
from fpp_ml_bench.evaluation.result import PART_TITLES, Reliance
from fpp_ml_bench.evaluation.score import caution
from fpp_ml_bench.loaders.storage import DatasetFolder

MOST_VIEWS = 6
_WIDE, _GAP = 11.5, 2  # width of the figure of scenes in inches, and gap between two scenes in px
_FOLLOWS = {
    "follows_phase": "phase alone",
    "follows_light": "brightness alone",
    "follows_both": "both, as in\na photograph",
    "follows_constant": "phase, by\na constant",
    "order_free_follows_phase": "phase, whole\nperiods aside",
}
_CHANGES = {
    "change_outline": "other\noutline",
    "change_no_fringe_inside": "no fringe\ninside",
    "change_no_fringe_outside": "no fringe\noutside",
    "change_other_direction": "other\ndirection",
    "change_other_pitch": "other\npitch",
    "order_free_change_outline": "other outline,\nperiods aside",
}


class Counterfactual(Probe):
    """The phase-reliance score over the counterfactual scenes of all test objects, with its parts and pictures."""

    name = "counterfactual"
    title = "Counterfactual scenes"
    version = 2
    question = "Does the predicted depth follow the fringe's phase, or the object's outline?"

    def run(
        self, subject: Subject, dataset: DatasetFolder, settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        views = 1 if settings.quick else VIEWS_PER_OBJECT
        if settings.samples is not None:
            objects = len({dataset.measured(sample)["object"] for sample in dataset.samples("test")})
            views = min(max(settings.samples // max(objects, 1), 1), MOST_VIEWS)
        scene_set = SceneSet(dataset, views)
        reliance, samples = measure(subject, scene_set, subject.weights_sha256, progress)
        per_sample = {
            sample.sample: {"score": sample.score, "order_free_score": sample.order_free_score, **sample.parts}
            for sample in samples
        }
        # The middle sample of the list, which is the same for every method.
        middle = samples[len(samples) // 2].sample
        scenes = next(scenes for scenes in scene_set.scenes(reliance.direction) if scenes.original.sample == middle)
        values = {"reliance": reliance.model_dump(mode="json"), "per_sample": per_sample}
        drawn = _draw_scenes(ScenePredictor(subject, scene_set.renderer), scenes, folder)
        bars = _draw_parts(reliance, samples, folder)
        return self.finding(summary(reliance), values, tables(reliance, samples), drawn, bars)


def summary(reliance: Reliance) -> str:
    """The score, its parts, and the hypothesis that they support."""
    parts, (low, high), order_free = reliance.parts, reliance.interval, reliance.order_free_score
    interval = f" (95% interval {low:.2f} to {high:.2f})" if low is not None and high is not None else ""
    whole_periods = "" if order_free is None else f"; {order_free:.2f} ignoring errors of whole periods"
    verdict = "It reads the phase in part." if reliance.score >= 0.1 else "It does not follow the phase."
    if reliance.score >= 0.5 or (order_free or 0.0) >= 0.5:
        verdict = "It reads the phase."
    phase, light, outline = (
        "not measured" if value is None else f"{value:.2f}"
        for value in (parts.follows_phase, parts.follows_light, parts.change_outline)
    )
    text = (
        f"Phase reliance {reliance.score:.2f}{interval}{whole_periods}. The prediction follows a change of phase "
        f"within the object by {phase}, and a change of brightness alone by {light}. Another outline over the same "
        f"phase changes it by {outline} of what a moved phase does. {verdict}"
    )
    return f"{text} {warning}" if (warning := caution(reliance.objects)) else text


def tables(reliance: Reliance, samples: Sequence[SampleReliance]) -> list[Table]:
    """The parts of the score, and the score of every sample."""
    shown = ("follows_phase", "follows_light", "change_outline")
    parts = [(words, getattr(reliance.parts, key)) for key, words in PART_TITLES.items()]
    header = ("Sample", "Score", "Whole periods aside", "Follows phase", "Follows brightness", "Change by outline")
    rows = [(s.sample, s.score, s.order_free_score, *(s.parts.get(part) for part in shown)) for s in samples]
    means = Table("Parts of the score, and further measurements", ("Part", "Mean over samples"), parts)
    return [means, Table("Sample by sample", header, rows)]


def _draw_scenes(predictor: ScenePredictor, scenes: Counterfactuals, folder: Path) -> Figure:
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
        (f"truth,\n{unit}", "viridis", *depths),
        (f"prediction,\n{unit}", "viridis", *depths),
        (f"expected change,\n{unit}", "coolwarm", -largest, largest),
        (f"actual change,\n{unit}", "coolwarm", -largest, largest),
    )
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
        images = (np.asarray(image, dtype=np.float64)[box] for image in column)
        tiles.append([np.pad(image, _GAP, constant_values=np.nan) for image in images])
    height, width = tiles[0][0].shape
    sheet = Sheet(5, 1, _WIDE, 5 * 0.9 * _WIDE / len(tiles) * height / width + 0.9)
    for row, (axis, (title, colours, low, high)) in enumerate(zip(sheet.axes[:, 0], rows, strict=True)):
        # One image per row: fifty small axes take ten times as long to lay out.
        drawn = sheet.picture(axis, np.hstack([column[row] for column in tiles]), "", colours, low, high)
        axis.set_facecolor("#e8e8e8" if row else "white")
        axis.set_ylabel(title, fontsize=8)
        sheet.scale(drawn, axis, 6, fraction=0.012, pad=0.008)
    top = sheet.axes[0, 0]
    top.xaxis.tick_top()
    top.set_xticks([width * (number + 0.5) for number in range(len(columns))], [name for name, *_ in columns])
    top.tick_params(axis="x", length=0, labelsize=7)
    title = f"{original.sample}: one thing changed at a time; {scenes.direction} phase; grey: no prediction"
    sheet.figure.suptitle(title, fontsize=10)
    alt = f"Scenes of {original.sample} with changed phase, outline or fringes; truth, prediction and its change"
    return sheet.save(folder, "counterfactual_scenes.png", "One thing changed at a time", alt)


def _figure_columns(
    predictor: ScenePredictor, scenes: Counterfactuals, truth: NDArray[np.float64], target: NDArray[np.bool_]
) -> list[tuple[str, Scene, NDArray[np.float64], NDArray[np.bool_]]]:
    """Scenes of the figure: title, scene, its true depth in the prediction's units, and the mask of that depth."""
    columns = [("as it is", scenes.original.scene, truth, target)]
    first = {move.name: move for move in reversed(scenes.moves_within())}
    for name in ("ramp across", "ramp down", "bump"):
        if move := first.get(name):
            columns.append((f"phase moved:\n{name}", move.phase, predictor.true_depth(move.depth_mm, target), target))
    for change in scenes.outline_changes:
        mask = change.scene.mask & (change.depth_mm > 0)
        name = change.name.replace("another object's outline", "another\nobject's")
        columns.append((f"outline: {name}", change.scene, predictor.true_depth(change.depth_mm, mask), mask))
    for name, scene in scenes.reprojected.items():
        columns.append((name.replace("fringe ", "fringe\n").replace("other ", "other\n"), scene, truth, target))
    return columns


def _box(mask: NDArray[np.bool_], margin: int = 6) -> tuple[slice, ...]:
    """The part of the image around ``mask``."""
    seen = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return tuple(slice(max(places[0] - margin, 0), places[-1] + margin + 1) for places in seen)


def _draw_parts(reliance: Reliance, samples: Sequence[SampleReliance], folder: Path) -> Figure:
    """Bars of the parts, with a point for each sample."""
    sheet = Sheet(1, 2, 9.2, 3.2)
    sides = (
        (_FOLLOWS, "Follows, share of the expected change", "phase", 1.05),
        (_CHANGES, "Changes, relative to a moved phase", "depth", None),
    )
    for axis, (names, title, colour, top) in zip(sheet.axes[0], sides, strict=True):
        measured = {key: name for key, name in names.items() if getattr(reliance.parts, key) is not None}
        values = [getattr(reliance.parts, key) for key in measured]
        axis.bar(range(len(measured)), values, 0.6, color=sheet.COLOURS[colour], alpha=0.75)
        for number, key in enumerate(measured):
            points = [value for sample in samples if (value := sample.parts.get(key)) is not None]
            axis.plot([number] * len(points), points, ".", color=sheet.INK, markersize=4, alpha=0.6)
        axis.set_xticks(range(len(measured)), list(measured.values()))
        sheet.tidy(axis, title)
        axis.tick_params(axis="x", labelsize=7)
        axis.set_ylim(0, top)
    sheet.figure.suptitle(f"Phase reliance {reliance.score:.2f}; a point is a sample", fontsize=10)
    alt = "Bars of how far the answer follows and what changes it"
    return sheet.save(folder, "counterfactual_parts.png", "What the score is made of", alt)
