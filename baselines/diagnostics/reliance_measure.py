"""Measures phase reliance: runs a method on counterfactual scenes and makes the reliance block of a result."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.counterfactual_scenes import Counterfactuals, Move, SceneSet
from fpp_ml_bench.baselines.diagnostics.probe import Progress, silent
from fpp_ml_bench.baselines.diagnostics.reliance import (
    Change,
    follows,
    order_free,
    order_free_follows,
    relative_change,
    rms_expected,
    sample_score,
)
from fpp_ml_bench.baselines.diagnostics.synth import Scene, SceneRenderer
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.evaluation.protocol import PROTOCOL_VERSION
from fpp_ml_bench.evaluation.result import RELIANCE_VERSION, Reliance, RelianceParts
from fpp_ml_bench.evaluation.score import object_interval
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.optics import Direction

Map = NDArray[np.floating[Any]]


class DepthMethod(Protocol):
    """The part of a method, or of the subject of a diagnosis, that is needed here."""

    @property
    def frames_used(self) -> tuple[int, ...]: ...
    @property
    def units(self) -> str: ...
    @property
    def uses_ground_truth_mask(self) -> bool: ...

    def predict(self, frames: Sequence[NDArray[np.uint8] | None]) -> NDArray[np.float32]: ...


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

    def __init__(self, method: DepthMethod, renderer: SceneRenderer) -> None:
        self.method, self.renderer = method, renderer
        units = method.units
        if units not in ("mm", "normalised"):
            raise DiagnosisError(f"units {units!r}: reliance is measured for predictions in mm, or normalised")
        self.units: Literal["mm", "normalised"] = "mm" if units == "mm" else "normalised"
        self._masked = method.uses_ground_truth_mask

    @property
    def in_mm(self) -> bool:
        return self.units == "mm"

    def predict(self, scene: Scene) -> NDArray[np.float32]:
        """Predicted depth (H, W) in ``units``."""
        return self.method.predict(self.renderer.frames(scene, self.method.frames_used, self._masked))

    def true_depth(self, depth_mm: NDArray[np.float64], mask: NDArray[np.bool_]) -> NDArray[np.float64]:
        """``depth_mm`` (H, W) in ``units``: mm, or normalised to its range over ``mask``."""
        if self.in_mm:
            return depth_mm
        inside = depth_mm[mask]
        low, span = float(inside.min()), float(np.ptp(inside))
        return (depth_mm - low) / span if span > 0 else np.zeros_like(depth_mm)


def measure_sample(predictor: ScenePredictor, scenes: Counterfactuals) -> SampleReliance:
    """Runs the method on every scene of a sample and compares."""
    original = scenes.original
    target = original.target & (original.depth_mm > 0)
    before, truth = predictor.predict(original.scene), predictor.true_depth(original.depth_mm, target)
    within = scenes.moves_within()

    def change(after: Map, expected: Map, where: NDArray[np.bool_]) -> Change:
        return Change.of(before, after, expected, where, predictor.in_mm)

    def expected_change(move: Move) -> Map:
        return predictor.true_depth(move.depth_mm, target) - truth

    answers = [predictor.predict(move.phase) for move in within]
    phase_changes = [change(after, expected_change(move), target) for move, after in zip(within, answers, strict=True)]
    unit, follow = rms_expected(phase_changes), follows(phase_changes)
    outline_answers = [predictor.predict(outline_change.scene) for outline_change in scenes.outline_changes]
    outline_changes = []
    for outline_change, after in zip(scenes.outline_changes, outline_answers, strict=True):
        where = outline_change.unchanged & target
        if where.any():
            expected = (
                predictor.true_depth(outline_change.depth_mm, outline_change.scene.mask & (outline_change.depth_mm > 0))
                - truth
            )
            outline_changes.append(change(after, expected, where))
    outline = relative_change(outline_changes, unit)
    parts: dict[str, float | None] = {"follows_phase": follow, "change_outline": outline}
    both_ways = [move for move in within if move.amplitude_rad > 0]
    for name in ("light", "both"):
        changes = [change(predictor.predict(getattr(move, name)), expected_change(move), target) for move in both_ways]
        parts[f"follows_{name}"] = follows(changes)
    constant = [move for move in scenes.moves if move.name == "constant"] if predictor.in_mm else []
    parts["follows_constant"] = follows(
        [change(predictor.predict(m.phase), expected_change(m), target) for m in constant]
    )
    for name, scene in scenes.reprojected.items():
        key = name.replace(" ", "_")
        reprojected_change = change(predictor.predict(scene), np.zeros(target.shape), target)
        answered = reprojected_change.answered
        answered_change = Change(
            reprojected_change.expected[answered], reprojected_change.actual[answered], answered[answered]
        )
        parts[f"change_{key}"] = relative_change([answered_change], unit)
        if name.startswith("no fringe"):
            parts[f"answered_{key}"] = float(answered.mean())
    order_free_score: float | None = None
    if predictor.in_mm:
        phase_turns = [_phase_change(scenes, before, after, move.depth_mm, target)
                 for move, after in zip(within, answers, strict=True)]  # fmt: skip
        parts["order_free_follows_phase"] = order_free_follows(phase_turns)
        outline_turns = [_phase_change(scenes, before, after, original.depth_mm, outline_change.unchanged & target)
               for outline_change, after in zip(scenes.outline_changes, outline_answers, strict=True)]  # fmt: skip
        parts["order_free_change_outline"] = relative_change(
            order_free(outline_turns), rms_expected(order_free(phase_turns))
        )
        order_free_score = sample_score(parts["order_free_follows_phase"], parts["order_free_change_outline"])
    return SampleReliance(original.sample, original.object, sample_score(follow, outline), order_free_score, parts)


def _phase_change(scenes: Counterfactuals, before: Map, after: Map, depth_mm: Map, where: NDArray[np.bool_]) -> Change:
    """Change in rad of the phase of predictions in mm, and of the true phase."""
    layer = scenes.layer.at(where)
    expected = layer.absolute_phase(depth_mm[where]) - layer.absolute_phase(scenes.original.depth_mm[where])
    answered = (before[where] > 0) & (after[where] > 0)
    first, second = (layer.absolute_phase(np.where(answered, answer[where], 1000.0)) for answer in (before, after))
    return Change(expected, np.where(answered, second - first, 0.0), answered)


def reliance_of(
    predictor: ScenePredictor, samples: Sequence[SampleReliance], dataset: DatasetFolder, direction: Direction,
    weights_sha256: str | None = None,
) -> Reliance:  # fmt: skip
    """The reliance block of a result from its samples. Raises `DiagnosisError` where no sample has a score."""
    scored = [sample for sample in samples if sample.score is not None]
    if not scored:
        raise DiagnosisError("no sample's phase can be moved within the working range, so there is no score")
    interval = object_interval([sample.score for sample in scored], [sample.object for sample in scored])
    return Reliance(
        version=RELIANCE_VERSION,
        score=_mean([sample.score for sample in scored]) or 0.0,
        interval=[None, None] if interval is None else [min(max(end, 0.0), 1.0) for end in interval],
        order_free_score=_mean([sample.order_free_score for sample in scored]),
        parts=RelianceParts(
            **{key: _mean([sample.parts.get(key) for sample in scored]) for key in RelianceParts.model_fields}
        ),
        units=predictor.units,
        direction=direction,
        samples=len(scored),
        objects=len({sample.object for sample in scored}),
        dataset_fingerprint=dataset.fingerprint,
        protocol_version=PROTOCOL_VERSION,
        weights_sha256=weights_sha256,
    )


def _mean(values: Iterable[float | None]) -> float | None:
    defined = [value for value in values if value is not None]
    return float(np.mean(defined)) if defined else None


def measure(
    method: DepthMethod, scene_set: SceneSet, weights_sha256: str | None = None, progress: Progress = silent
) -> tuple[Reliance, list[SampleReliance]]:
    """The reliance block of a method, and the values of every sample.

    Raises `DiagnosisError` as `ScenePredictor` and `reliance_of`.
    """
    predictor, direction = (
        ScenePredictor(method, scene_set.renderer),
        direction_read(method.frames_used, scene_set.dataset),
    )
    samples: list[SampleReliance] = []
    for scenes in scene_set.scenes(direction):
        progress(len(samples), len(scene_set.samples), scenes.original.sample)
        samples.append(measure_sample(predictor, scenes))
    return reliance_of(predictor, samples, scene_set.dataset, direction, weights_sha256), samples


def direction_read(frames: Sequence[int], dataset: DatasetFolder) -> Direction:
    """The direction whose phase is moved for a method of these frames: their own. For both directions it is the
    vertical, whose period is the shorter in depth."""
    directions = {dataset.sequence.frames[index].direction for index in frames}
    return "vertical" if "vertical" in directions else "horizontal"
