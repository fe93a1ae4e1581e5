"""Phase reliance (own probe): does the predicted depth follow the fringe's phase, or the object's outline? From 0 to 1.

Each test object is rendered again with a single property changed, so that the correct change of depth is known, and is
compared with the change of the prediction. A sample's score is the product of `follows`, over moves of the phase within
the object, and of 1 - `relative_change` under other outlines over the same phase, at least 0. The method's score is the
mean over samples, with a bootstrap over objects. docs/diagnosis.md defines and explains it: units, missing predictions,
and *order-free* values, which allow errors of whole periods.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics import probe
from fpp_ml_bench.baselines.diagnostics.counterfactual_scenes import (
    REPROJECTED,
    VIEWS_PER_OBJECT,
    Counterfactuals,
    SceneSet,
)
from fpp_ml_bench.baselines.diagnostics.probe import (
    Figure,
    Picture,
    Progress,
    Table,
    gallery,
    mean_of,
    silent,
)
from fpp_ml_bench.baselines.diagnostics.scene_renderer import MovedPhase, Scene, SceneRenderer
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.evaluation.protocol import PROTOCOL_VERSION
from fpp_ml_bench.evaluation.result.parts import PART_TITLES, RELIANCE_VERSION, Reliance, RelianceParts
from fpp_ml_bench.evaluation.score.uncertainty import caution, object_interval
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.style import ERROR_COLOURS

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.diagnostics.subjects import Subject
    from fpp_ml_bench.baselines.method import Method

MOST_VIEWS = 6
Map = NDArray[np.floating]


@dataclass(frozen=True)
class Change:
    """Change of the prediction in a counterfactual scene, at the pixels that are compared. ``expected`` and ``actual``
    change (n,) in the prediction's units; ``answered`` bool (n,): a prediction exists before and after."""

    expected: NDArray[np.float64]
    actual: NDArray[np.float64]
    answered: NDArray[np.bool_]

    @classmethod
    def of(cls, before: Map, after: Map, expected: Map, where: NDArray[np.bool_], zero_is_none: bool) -> "Change":
        """From two predictions and the expected change, maps (H, W), at the pixels ``where`` (H, W). With
        ``zero_is_none`` a 0 means that there is no prediction, and the actual change there is 0."""
        first, second = before[where].astype(np.float64), after[where].astype(np.float64)
        answered = (first != 0) & (second != 0) if zero_is_none else np.ones(first.shape, dtype=bool)
        return cls(np.asarray(expected[where], dtype=np.float64), np.where(answered, second - first, 0.0), answered)


def follows(changes: Sequence[Change]) -> float | None:
    """Purity <d, t> / sqrt(<d, d> <t, t>) times min(gain, 1 / gain), gain = <d, t> / <t, t>, over all pixels of
    ``changes``, with d the actual and t the expected change; 0 where <d, t> is not positive, None where t is 0."""
    product, actual, expected = (
        sum(float(getattr(change, a) @ getattr(change, b)) for change in changes)
        for a, b in (("actual", "expected"), ("actual", "actual"), ("expected", "expected"))
    )
    if expected <= 0:
        return None
    if product <= 0:
        return 0.0
    gain, purity = product / expected, product / np.sqrt(actual * expected)
    return float(min(purity, 1.0) * min(gain, 1 / gain))


def rms_expected(changes: Sequence[Change]) -> float:
    """Root mean square of the expected change over all pixels of ``changes``; 0 without pixels."""
    values = np.concatenate([change.expected for change in changes]) if changes else np.zeros(0)
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


def relative_change(changes: Sequence[Change], unit: float) -> float | None:
    """Root mean square of actual minus expected change, or of the actual change if that is less, divided by ``unit``,
    as which a pixel that lost its prediction counts. None without pixels or with ``unit`` 0."""
    size, total = sum(change.actual.size for change in changes), 0.0
    if unit <= 0 or not size:
        return None
    for change in changes:
        differences = [np.where(change.answered, change.actual - expected, unit) for expected in (change.expected, 0.0)]
        total += min(float(np.dot(values, values)) for values in differences)
    return float(np.sqrt(total / size) / unit)


def order_free_follows(changes: Sequence[Change]) -> float | None:
    """`follows` for changes of phase in rad, modulo whole periods: 1 - (1 - <cos(d - t)>) / (1 - <cos t>), at least 0.
    A random prediction gets no credit: its <cos(d - t)> is 0, below that of a constant prediction."""
    actual, expected = (np.concatenate([getattr(change, key) for change in changes]) for key in ("actual", "expected"))
    standing_still = 1 - float(np.mean(np.cos(expected))) if expected.size else 0.0
    if standing_still <= 0:
        return None
    return max(0.0, 1 - (1 - float(np.mean(np.cos(actual - expected)))) / standing_still)


def order_free(changes: Sequence[Change]) -> list[Change]:
    """Changes of phase in rad as chords, for `relative_change`: a whole period is no change."""
    return [Change(2 * np.sin(one.expected / 2), 2 * np.sin(one.actual / 2), one.answered) for one in changes]


def sample_score(follow: float | None, change: float | None) -> float | None:
    """The score of a sample; an outline that could not be changed counts as ignored."""
    return None if follow is None else follow * (1.0 if change is None else max(0.0, 1.0 - change))


@dataclass(frozen=True)
class SampleReliance:
    """A sample's score, order-free score, and ``parts`` by the names of `RelianceParts`."""

    sample: str
    object: str
    score: float | None
    order_free_score: float | None
    parts: dict[str, float | None]


class ScenePredictor:
    """Runs ``method`` on scenes and gives the true depth in the units of its predictions."""

    def __init__(self, method: "Method | Subject", renderer: SceneRenderer) -> None:
        self.method, self.renderer, self.in_mm = method, renderer, method.units == "mm"
        if method.units not in ("mm", "normalised"):
            raise DiagnosisError(f"units {method.units!r}: reliance is measured for predictions in mm, or normalised")

    def predict(self, scene: Scene) -> NDArray[np.float32]:
        """Predicted depth (H, W) in the units of the method."""
        frames = self.renderer.frames(scene, self.method.frames_used, self.method.uses_ground_truth_mask)
        return self.method.predict(frames)

    def true_depth(self, depth_mm: NDArray[np.float64], mask: NDArray[np.bool_]) -> NDArray[np.float64]:
        """``depth_mm`` (H, W) in the units of the method: mm, or normalised to its range over ``mask``."""
        if self.in_mm or not mask.any():
            return depth_mm
        inside = depth_mm[mask]
        low, span = float(inside.min()), float(np.ptp(inside))
        return (depth_mm - low) / span if span > 0 else np.zeros_like(depth_mm)


def measure_sample(predictor: ScenePredictor, scenes: Counterfactuals) -> SampleReliance:
    """Runs the method on every scene of a sample and compares."""
    original = scenes.original
    target = original.target & (original.depth_mm > 0)
    before, truth = predictor.predict(original.scene), predictor.true_depth(original.depth_mm, target)
    changes: dict[str, list[Change]] = defaultdict(list)
    turns: dict[str, list[Change]] = defaultdict(list)
    for variant in scenes.variants:
        if variant.kind == "constant" and not predictor.in_mm:
            continue
        after, where = predictor.predict(variant.scene), variant.scene.mask & target
        key = variant.name.replace(" ", "_") if variant.kind == "projected" else variant.kind
        true_depth = predictor.true_depth(variant.depth_mm, variant.scene.mask & (variant.depth_mm > 0))
        changes[key].append(Change.of(before, after, true_depth - truth, where, predictor.in_mm))
        if predictor.in_mm and key in ("phase", "outline"):
            turns[key].append(_phase_change(scenes, before, after, variant.depth_mm, where))
    unit = rms_expected(changes["phase"])
    parts: dict[str, float | None] = {
        "follows_phase": follows(changes["phase"]),
        "change_outline": relative_change(changes["outline"], unit),
        **{f"follows_{kind}": follows(changes[kind]) for kind in ("light", "both", "constant")},
    }
    for name in REPROJECTED:
        key = name.replace(" ", "_")
        (other,) = changes[key]
        kept = other.answered
        parts[f"change_{key}"] = relative_change([Change(other.expected[kept], other.actual[kept], kept[kept])], unit)
        if name.startswith("no fringe"):
            parts[f"answered_{key}"] = float(kept.mean())
    order_free_score = None
    if predictor.in_mm:
        parts["order_free_follows_phase"] = order_free_follows(turns["phase"])
        chords = rms_expected(order_free(turns["phase"]))
        parts["order_free_change_outline"] = relative_change(order_free(turns["outline"]), chords)
        order_free_score = sample_score(parts["order_free_follows_phase"], parts["order_free_change_outline"])
    score = sample_score(parts["follows_phase"], parts["change_outline"])
    return SampleReliance(original.sample, original.object, score, order_free_score, parts)


def _phase_change(scenes: Counterfactuals, before: Map, after: Map, depth_mm: Map, where: NDArray[np.bool_]) -> Change:
    """Change in rad of the phase of predictions in mm, and of the true phase."""
    layer = scenes.layer.at(where)
    expected = layer.absolute_phase(depth_mm[where]) - layer.absolute_phase(scenes.original.depth_mm[where])
    answered = (before[where] > 0) & (after[where] > 0)
    first, second = (layer.absolute_phase(np.where(answered, answer[where], 1000.0)) for answer in (before, after))
    return Change(expected, np.where(answered, second - first, 0.0), answered)


def measure(
    method: "Method | Subject", scene_set: SceneSet, weights_sha256: str | None = None, progress: Progress = silent
) -> tuple[Reliance, list[SampleReliance]]:
    """The reliance block of a method, and the values of every sample. Raises `DiagnosisError` for a method of other
    units, and where no sample has a score."""
    predictor = ScenePredictor(method, scene_set.renderer)
    direction = direction_read(method.frames_used, scene_set.dataset)
    samples: list[SampleReliance] = []
    for scenes in scene_set.scenes(direction):
        progress(len(samples), len(scene_set.samples), scenes.original.sample)
        samples.append(measure_sample(predictor, scenes))
    scored = [sample for sample in samples if sample.score is not None]
    if not scored:
        raise DiagnosisError("no sample's phase can be moved within the working range, so there is no score")
    interval = object_interval([sample.score for sample in scored], [sample.object for sample in scored])
    reliance = Reliance(
        version=RELIANCE_VERSION,
        score=mean_of(sample.score for sample in scored) or 0.0,
        interval=[None, None] if interval is None else [min(max(end, 0.0), 1.0) for end in interval],
        order_free_score=mean_of(sample.order_free_score for sample in scored),
        parts=RelianceParts(
            **{key: mean_of(sample.parts.get(key) for sample in scored) for key in RelianceParts.model_fields}
        ),
        units="mm" if predictor.in_mm else "normalised",
        direction=direction,
        samples=len(scored),
        objects=len({sample.object for sample in scored}),
        dataset_fingerprint=scene_set.dataset.fingerprint,
        protocol_version=PROTOCOL_VERSION,
        weights_sha256=weights_sha256,
    )
    return reliance, samples


def direction_read(frames: Sequence[int], dataset: DatasetFolder) -> MovedPhase:
    """The direction whose phase is moved for a method of these frames: their own. For both directions it is the
    vertical, whose period is the shorter in depth."""
    if all(dataset.sequence.frames[index].kind == "crossed" for index in frames):
        return "crossed"
    directions = {dataset.sequence.frames[index].direction for index in frames}
    return "vertical" if "vertical" in directions else "horizontal"


class Counterfactual(probe.Probe):
    """The phase-reliance score over the counterfactual scenes of all test objects, with its parts and pictures."""

    name = "counterfactual"
    title = "Counterfactual scenes"
    version = 2
    question = "Does the predicted depth follow the fringe's phase, or the object's outline?"

    def run(
        self, subject: "Subject", dataset: DatasetFolder, settings: probe.ProbeSettings, progress: Progress
    ) -> probe.Finding:
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
        scenes = scene_set.scenes_of(len(samples) // 2, reliance.direction)
        values = {"reliance": reliance.model_dump(mode="json"), "per_sample": per_sample}
        rows = [(words, getattr(reliance.parts, key)) for key, words in PART_TITLES.items()]
        parts = Table("Parts of the score, and further measurements", ("Part", "Mean over samples"), rows)
        drawn = _draw_scenes(ScenePredictor(subject, scene_set.renderer), scenes)
        return self.finding(summary(reliance), values, parts, drawn)


def summary(reliance: Reliance) -> str:
    """The score, and the hypothesis that it supports."""
    (low, high), order_free = reliance.interval, reliance.order_free_score
    interval = f" (95% interval {low:.2f} to {high:.2f})" if low is not None and high is not None else ""
    whole_periods = "" if order_free is None else f"; {order_free:.2f} ignoring errors of whole periods"
    verdict = "It reads the phase in part." if reliance.score >= 0.1 else "It does not follow the phase."
    if reliance.score >= 0.5 or (order_free or 0.0) >= 0.5:
        verdict = "It reads the phase."
    text = f"Phase reliance {reliance.score:.2f}{interval}{whole_periods}. {verdict}"
    return f"{text} {warning}" if (warning := caution(reliance.objects)) else text


def _draw_scenes(predictor: ScenePredictor, scenes: Counterfactuals) -> Figure:
    """One column per scene: captured frame, expected change and actual change."""
    original = scenes.original
    target = original.target & (original.depth_mm > 0)
    truth, before = predictor.true_depth(original.depth_mm, target), predictor.predict(original.scene)
    shown = [one for one in scenes.of_kind("phase", "outline", "projected") if one.amplitude_rad >= 0]
    method, box = predictor.method, _box(np.logical_or.reduce([variant.scene.mask for variant in shown]))
    index, columns = method.frames_used[0], []
    for variant in shown:
        scene, after = variant.scene, predictor.predict(variant.scene)
        mask = scene.mask & (variant.depth_mm > 0)
        missing = predictor.in_mm & ((before == 0) | (after == 0))
        images = (
            predictor.renderer.frames(scene, [index], method.uses_ground_truth_mask)[index],
            np.where(mask & target, predictor.true_depth(variant.depth_mm, mask) - truth, np.nan),
            np.where(mask & target & ~missing, after - before, np.nan),
        )
        columns.append([np.asarray(image)[box] for image in images])
    frames, *changes = zip(*columns, strict=True)
    largest = float(np.nanmax(np.abs(changes[0])))
    rows = {"captured": [Picture(frame) for frame in frames]}
    for name, maps in zip(("expected change", "actual change"), changes, strict=True):
        rows[name] = [Picture(one, ERROR_COLOURS, -largest, largest) for one in maps]
    unit = "mm" if predictor.in_mm else "of the range"
    title = (
        f"{original.sample}: one thing changed at a time; {scenes.direction} phase; blue to red: -{largest:.3g} to "
        f"{largest:.3g} {unit}; white: no prediction"
    )
    alt = f"Scenes of {original.sample} with changed phase, outline or fringes, and the change of its prediction"
    titles = [f"{variant.kind}:\n{variant.name.replace(' ', chr(10), 1)}" for variant in shown]
    return Figure(title, alt, gallery(rows, titles, 1.3))


def _box(mask: NDArray[np.bool_], margin: int = 6) -> tuple[slice, ...]:
    """The part of the image around ``mask``."""
    seen = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return tuple(slice(max(places[0] - margin, 0), places[-1] + margin + 1) for places in seen)
