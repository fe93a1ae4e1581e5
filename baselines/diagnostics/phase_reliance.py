"""The phase-reliance score (own definition): how far a prediction follows the fringe's phase and nothing else, 0 to 1.

A sample's score is the product of `follows`, over moves of the phase within the object, and of 1 - `relative_change`
under other outlines over the same phase, at least 0. The method's score is the mean over samples, with a bootstrap over
objects. docs/reliance.md defines and explains it: units, missing predictions, and *order-free* values, which allow
errors of whole periods.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.counterfactual_scenes import Counterfactuals, Move, SceneSet
from fpp_ml_bench.baselines.diagnostics.probe import Progress, mean_of, silent
from fpp_ml_bench.baselines.diagnostics.scene_renderer import MovedPhase, Scene, SceneRenderer
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.evaluation.protocol import PROTOCOL_VERSION
from fpp_ml_bench.evaluation.result import RELIANCE_VERSION, Reliance, RelianceParts
from fpp_ml_bench.evaluation.score import object_interval
from fpp_ml_bench.loaders.storage import DatasetFolder

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.diagnostics.subjects import Subject
    from fpp_ml_bench.baselines.method import Method

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
        if self.in_mm:
            return depth_mm
        inside = depth_mm[mask]
        low, span = float(inside.min()), float(np.ptp(inside))
        return (depth_mm - low) / span if span > 0 else np.zeros_like(depth_mm)


def measure_sample(predictor: ScenePredictor, scenes: Counterfactuals) -> SampleReliance:
    """Runs the method on every scene of a sample and compares."""
    original, within = scenes.original, scenes.moves_within()
    target = original.target & (original.depth_mm > 0)
    before, truth = predictor.predict(original.scene), predictor.true_depth(original.depth_mm, target)

    def change(after: Map, depth_mm: NDArray[np.float64], mask: NDArray[np.bool_], where: NDArray[np.bool_]) -> Change:
        expected = predictor.true_depth(depth_mm, mask) - truth
        return Change.of(before, after, expected, where, predictor.in_mm)

    def followed(moves: Iterable[Move], scene_of: Callable[[Move], Scene]) -> float | None:
        return follows([change(predictor.predict(scene_of(move)), move.depth_mm, target, target) for move in moves])

    moved = [(predictor.predict(move.phase), move.depth_mm) for move in within]
    phase_changes = [change(after, depth_mm, target, target) for after, depth_mm in moved]
    unit, follow = rms_expected(phase_changes), follows(phase_changes)
    outlined = [(predictor.predict(other.scene), other, other.scene.mask & target) for other in scenes.outline_changes]
    outline_changes = [
        change(after, other.depth_mm, other.scene.mask & (other.depth_mm > 0), where)
        for after, other, where in outlined
        if where.any()
    ]
    outline = relative_change(outline_changes, unit)
    one_way = [move for move in within if move.amplitude_rad > 0]
    constant = [move for move in scenes.moves if move.name == "constant" and predictor.in_mm]
    parts: dict[str, float | None] = {
        "follows_phase": follow,
        "change_outline": outline,
        "follows_light": followed(one_way, lambda move: move.light),
        "follows_both": followed(one_way, lambda move: move.both),
        "follows_constant": followed(constant, lambda move: move.phase),
    }
    for name, scene in scenes.reprojected.items():
        key = name.replace(" ", "_")
        other = Change.of(before, predictor.predict(scene), np.zeros(target.shape), target, predictor.in_mm)
        kept = other.answered
        parts[f"change_{key}"] = relative_change([Change(other.expected[kept], other.actual[kept], kept[kept])], unit)
        if name.startswith("no fringe"):
            parts[f"answered_{key}"] = float(other.answered.mean())
    order_free_score = None
    if predictor.in_mm:
        moved_turns = [_phase_change(scenes, before, after, depth_mm, target) for after, depth_mm in moved]
        outline_turns = [_phase_change(scenes, before, after, original.depth_mm, where) for after, _, where in outlined]
        chords = rms_expected(order_free(moved_turns))
        parts["order_free_follows_phase"] = order_free_follows(moved_turns)
        parts["order_free_change_outline"] = relative_change(order_free(outline_turns), chords)
        order_free_score = sample_score(parts["order_free_follows_phase"], parts["order_free_change_outline"])
    return SampleReliance(original.sample, original.object, sample_score(follow, outline), order_free_score, parts)


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
