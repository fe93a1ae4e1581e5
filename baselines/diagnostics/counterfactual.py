"""Phase reliance (own probe): does the predicted depth follow the fringe's phase, or the object's
outline? From 0 to 1.

Each test object is rendered again with a single property changed, so that the correct change of
depth is known, and is compared with the change of the prediction. A sample's score is the product
of `follows`, over moves of the phase within the object, and of 1 - `relative_change` under other
outlines over the same phase, at least 0. The method's score is the mean over samples, with a
bootstrap over objects. docs/diagnosis.md defines and explains it: units, missing predictions, and
*order-free* values, which allow errors of whole periods.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.probe import (
    Figure,
    Finding,
    Probe,
    ProbeSettings,
    Progress,
    silent,
    table_of,
)
from fpp_ml_bench.baselines.diagnostics.scenes import (
    REPROJECTED,
    VIEWS_PER_OBJECT,
    Mask,
    MovedPhase,
    Scene,
    SceneRenderer,
    Variant,
    chosen_samples,
    counterfactuals,
    layer_of,
    original,
)
from fpp_ml_bench.baselines.method import checked
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.evaluation.protocol import PROTOCOL_VERSION
from fpp_ml_bench.evaluation.result.parts import RELIANCE_VERSION, Reliance, RelianceParts
from fpp_ml_bench.evaluation.score.uncertainty import caution, mean_of, object_interval
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.style import ERROR_COLOURS, Picture, gallery

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.diagnostics.subjects import Subject
    from fpp_ml_bench.baselines.method import Method

MARGIN_PX = 6
"""Margin around the objects in the picture, in px."""
Map = NDArray[np.floating]


@dataclass(frozen=True)
class Change:
    """Change of the prediction in a counterfactual scene, at the pixels that are compared.
    ``expected`` and ``actual`` change (n,) in the prediction's units; ``answered`` bool (n,): a
    prediction exists before and after."""

    expected: NDArray[np.float64]
    actual: NDArray[np.float64]
    answered: NDArray[np.bool_]

    @classmethod
    def of(cls, before: Map, after: Map, expected: Map, answered: Mask) -> "Change":
        """From two predictions and the expected change (n,); where it is not ``answered``, the
        actual change is 0."""
        actual = np.where(answered, np.subtract(after, before, dtype=np.float64), 0.0)
        return cls(np.asarray(expected, dtype=np.float64), actual, answered)


def follows(changes: Sequence[Change]) -> float | None:
    """Purity <d, t> / sqrt(<d, d> <t, t>) times min(gain, 1 / gain), gain = <d, t> / <t, t>, over
    all pixels of ``changes``, with d the actual and t the expected change; 0 where <d, t> is not
    positive, None where t is 0."""
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
    values = np.concatenate([np.zeros(0), *(change.expected for change in changes)])
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


def relative_change(changes: Sequence[Change], unit: float) -> float | None:
    """Root mean square of actual minus expected change, or of the actual change if that is less,
    divided by ``unit``, as which a pixel that lost its prediction counts. None without pixels or
    with ``unit`` 0."""
    size, total = sum(change.actual.size for change in changes), 0.0
    if unit <= 0 or not size:
        return None
    for change in changes:
        differences = [
            np.where(change.answered, change.actual - expected, unit)
            for expected in (change.expected, 0.0)
        ]
        total += min(float(np.dot(values, values)) for values in differences)
    return float(np.sqrt(total / size) / unit)


def order_free_follows(changes: Sequence[Change]) -> float | None:
    """`follows` for changes of phase in rad, modulo whole periods: 1 - (1 - <cos(d - t)>) / (1 -
    <cos t>), at least 0. A random prediction gets no credit: its <cos(d - t)> is 0, below that of a
    constant prediction."""
    actual, expected = (
        np.concatenate([np.zeros(0), *(getattr(change, key) for change in changes)])
        for key in ("actual", "expected")
    )
    standing_still = 1 - float(np.mean(np.cos(expected))) if expected.size else 0.0
    if standing_still <= 0:
        return None
    return max(0.0, 1 - (1 - float(np.mean(np.cos(actual - expected)))) / standing_still)


def order_free(changes: Sequence[Change]) -> list[Change]:
    """Changes of phase in rad as chords, for `relative_change`: a whole period is no change."""
    return [
        Change(2 * np.sin(change.expected / 2), 2 * np.sin(change.actual / 2), change.answered)
        for change in changes
    ]


def sample_score(follow: float | None, change: float | None) -> float | None:
    """The score of a sample; an outline that could not be changed counts as ignored."""
    return None if follow is None else follow * (1.0 if change is None else max(0.0, 1.0 - change))


class SampleScenes:
    """The scenes of a sample, and what ``method`` predicts of them, in its own units.
    ``outline_samples``: whose outlines the object may be cut to."""

    def __init__(
        self,
        method: "Method | Subject",
        dataset: DatasetFolder,
        renderer: SceneRenderer,
        sample: str,
        outline_samples: Sequence[str],
    ) -> None:
        self.method, self.renderer, self.in_mm = method, renderer, method.units == "mm"
        self.original = original(dataset, renderer, sample)
        self.direction = direction_read(method.frames_used, dataset)
        outlines = [object_mask(dataset.depth_mm(name)) for name in outline_samples]
        self.layer = layer_of(renderer.rig, self.direction)
        self.variants = counterfactuals(renderer, self.original, self.direction, outlines)
        self.truth, self.before = self.true_depth(self.original), self.predict(self.original)

    def predict(self, scene: Scene) -> NDArray[np.float32]:
        """Predicted depth (H, W) in the units of the method."""
        frames = self.renderer.frames(
            scene, self.method.frames_used, self.method.uses_ground_truth_mask
        )
        return checked(self.method.answer(frames), scene.depth_mm.shape, self.method.title).depth

    def true_depth(self, scene: Scene) -> NDArray[np.float64]:
        """True depth (H, W) in the units of the method: mm, or normalised to its range over the
        scene's mask."""
        depth_mm = scene.depth_mm
        if self.in_mm or not scene.mask.any():
            return depth_mm
        inside = depth_mm[scene.mask]
        return (depth_mm - inside.min()) / (np.ptp(inside) or np.inf)  # type: ignore[no-any-return]

    def changes(self, variant: Variant) -> tuple[Change, Change | None]:
        """The change of a prediction, and of a prediction in mm that of its phase in rad."""
        where = variant.scene.mask & self.original.mask
        before, after = self.before[where], self.predict(variant.scene)[where]
        expected = self.true_depth(variant.scene)[where] - self.truth[where]
        if not self.in_mm:
            return Change.of(before, after, expected, np.ones(before.shape, dtype=bool)), None
        change = Change.of(before, after, expected, (before != 0) & (after != 0))
        layer, answered = self.layer.at(where), (before > 0) & (after > 0)
        first, second = (
            layer.absolute_phase(np.where(answered, depth_mm, 1000.0))
            for depth_mm in (before, after)
        )
        true, moved = (
            layer.absolute_phase(scene.depth_mm[where]) for scene in (self.original, variant.scene)
        )
        return change, Change.of(first, second, moved - true, answered)

    def parts(self) -> dict[str, float | None]:
        """Both scores, ``score`` and ``order_free_score``, and the parts by the names of
        `RelianceParts`."""
        changes: dict[str, list[Change]] = defaultdict(list)
        turns: dict[str, list[Change]] = defaultdict(list)
        for variant in self.variants:
            if variant.kind == "constant" and not self.in_mm:
                continue
            change, turn = self.changes(variant)
            key = variant.name.replace(" ", "_") if variant.kind == "projected" else variant.kind
            changes[key].append(change)
            if turn is not None:
                turns[key].append(turn)
        unit = rms_expected(changes["phase"])
        parts: dict[str, float | None] = {"score": None, "order_free_score": None}
        parts |= {
            f"follows_{kind}": follows(changes[kind])
            for kind in ("phase", "light", "both", "constant")
        }
        parts["change_outline"] = relative_change(changes["outline"], unit)
        parts["score"] = sample_score(parts["follows_phase"], parts["change_outline"])
        for key in (name.replace(" ", "_") for name in REPROJECTED):
            (other,) = changes[key]
            kept = other.answered
            change = Change(other.expected[kept], other.actual[kept], kept[kept])
            parts[f"change_{key}"] = relative_change([change], unit)
            if key.startswith("no_fringe"):
                parts[f"answered_{key}"] = float(kept.mean())
        if self.in_mm:
            follow, chords = (
                order_free_follows(turns["phase"]),
                rms_expected(order_free(turns["phase"])),
            )
            outline = relative_change(order_free(turns["outline"]), chords)
            parts |= {"order_free_follows_phase": follow, "order_free_change_outline": outline}
            parts["order_free_score"] = sample_score(follow, outline)
        return parts


PartsBySample = dict[str, dict[str, float | None]]
"""What `SampleScenes.parts` says of each sample."""


def measure(
    method: "Method | Subject",
    dataset: DatasetFolder,
    chosen: Sequence[tuple[str, list[str]]],
    progress: Progress = silent,
) -> tuple[Reliance, PartsBySample]:
    """The reliance block of a method on samples as of `chosen_samples`, and the values of every
    sample. Raises `DiagnosisError` for a method of other units, and where no sample has a score."""
    if method.units not in ("mm", "normalised"):
        raise DiagnosisError(
            f"units {method.units!r}: reliance is measured for predictions in mm, or normalised"
        )
    renderer, samples = SceneRenderer.of(dataset), PartsBySample()
    for sample, outline_samples in chosen:
        progress(len(samples), len(chosen), sample)
        samples[sample] = SampleScenes(method, dataset, renderer, sample, outline_samples).parts()
    scored = {name: parts for name, parts in samples.items() if parts["score"] is not None}
    if not scored:
        raise DiagnosisError(
            "no sample's phase can be moved within the working range, so there is no score"
        )
    objects = [dataset.measured(name)["object"] for name in scored]
    interval = object_interval([parts["score"] for parts in scored.values()], objects)
    keys = ("score", "order_free_score", *RelianceParts.model_fields)
    means = {key: mean_of(parts.get(key) for parts in scored.values()) for key in keys}
    reliance = Reliance(
        version=RELIANCE_VERSION,
        score=means.pop("score") or 0.0,
        interval=[None, None]
        if interval is None
        else [min(max(end, 0.0), 1.0) for end in interval],
        order_free_score=means.pop("order_free_score"),
        parts=RelianceParts(**means),
        units="mm" if method.units == "mm" else "normalised",
        direction=direction_read(method.frames_used, dataset),
        samples=len(scored),
        objects=len(set(objects)),
        dataset_fingerprint=dataset.fingerprint,
        protocol_version=PROTOCOL_VERSION,
        weights_sha256=method.weights_sha256,
    )
    return reliance, samples


def direction_read(frames: Sequence[int], dataset: DatasetFolder) -> MovedPhase:
    """The direction whose phase is moved for a method of these frames: their own. For both
    directions it is the vertical, whose period is the shorter in depth."""
    if all(dataset.sequence.frames[index].kind == "crossed" for index in frames):
        return "crossed"
    directions = {dataset.sequence.frames[index].direction for index in frames}
    return "vertical" if "vertical" in directions else "horizontal"


class Counterfactual(Probe):
    """The phase-reliance score over the counterfactual scenes of all test objects, with its parts
    and pictures."""

    name = "counterfactual"
    title = "Counterfactual scenes"
    version = 2
    question = "Does the predicted depth follow the fringe's phase, or the object's outline?"

    def run(
        self,
        subject: "Subject",
        dataset: DatasetFolder,
        settings: ProbeSettings,
        progress: Progress,
    ) -> Finding:
        views = 1 if settings.quick else VIEWS_PER_OBJECT
        if settings.samples is not None:
            views = max(settings.samples // len(chosen_samples(dataset, "test", 1)), 1)
        chosen = chosen_samples(dataset, "test", views)
        reliance, per_sample = measure(subject, dataset, chosen, progress)
        values = {"reliance": reliance.model_dump(mode="json"), "per_sample": per_sample}
        rows = {words: {"mean": value} for words, value in reliance.parts.titled().items()}
        title = "Parts of the score, and further measurements"
        parts = table_of(title, "Part", rows, {"mean": "Mean over samples"})
        # The middle sample of the list, which is the same for every method.
        name, outline_samples = chosen[len(chosen) // 2]
        sample = SampleScenes(subject, dataset, SceneRenderer.of(dataset), name, outline_samples)
        return Finding(summary(reliance), values, parts, _draw_scenes(name, sample))


def summary(reliance: Reliance) -> str:
    """The score, and the hypothesis that it supports."""
    (low, high), order_free = reliance.interval, reliance.order_free_score
    interval = (
        f" (95% interval {low:.2f} to {high:.2f})" if low is not None and high is not None else ""
    )
    whole_periods = (
        "" if order_free is None else f"; {order_free:.2f} ignoring errors of whole periods"
    )
    verdict = (
        "It reads the phase in part." if reliance.score >= 0.1 else "It does not follow the phase."
    )
    if reliance.score >= 0.5 or (order_free or 0.0) >= 0.5:
        verdict = "It reads the phase."
    text = f"Phase reliance {reliance.score:.2f}{interval}{whole_periods}. {verdict}"
    return f"{text} {warning}" if (warning := caution(reliance.objects)) else text


def _draw_scenes(name: str, sample: SampleScenes) -> Figure:
    """One column per scene: captured frame, expected change and actual change."""
    shown = [
        variant
        for variant in sample.variants
        if variant.kind in ("phase", "outline", "projected") and variant.amplitude_rad >= 0
    ]
    seen = np.logical_or.reduce([variant.scene.mask for variant in shown])
    left, top, width, height = cv2.boundingRect(seen.astype(np.uint8))
    box = np.s_[
        max(top - MARGIN_PX, 0) : top + height + MARGIN_PX,
        max(left - MARGIN_PX, 0) : left + width + MARGIN_PX,
    ]
    method, columns = sample.method, []
    for variant in shown:
        scene, index = variant.scene, method.frames_used[0]
        change, maps = sample.changes(variant)[0], np.full((2, *scene.mask.shape), np.nan)
        maps[:, scene.mask & sample.original.mask] = (
            change.expected,
            np.where(change.answered, change.actual, np.nan),
        )
        images = sample.renderer.frames(scene, [index], method.uses_ground_truth_mask)[index], *maps
        columns.append([np.asarray(image)[box] for image in images])
    frames, *changes = zip(*columns, strict=True)
    largest = float(np.nanmax(np.abs(changes[0])))
    rows = {"captured": [Picture(frame) for frame in frames]}
    for title, maps in zip(("expected change", "actual change"), changes, strict=True):
        rows[title] = [Picture(change_map, ERROR_COLOURS, -largest, largest) for change_map in maps]
    unit = "mm" if sample.in_mm else "of the range"
    title = (
        f"{name}: one thing changed at a time; {sample.direction} phase; blue to red: "
        f"-{largest:.3g} to {largest:.3g} "
        f"{unit}; white: no prediction"
    )
    alt = (
        f"Scenes of {name} with changed phase, outline or fringes, and the change of its prediction"
    )
    titles = [f"{variant.kind}:\n{variant.name.replace(' ', chr(10), 1)}" for variant in shown]
    return Figure(title, alt, gallery(rows, titles, 1.3))
