"""Asking a method about counterfactual scenes, and what its answers come to: the phase-reliance block of a result."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.counterfactual_scenes import Counterfactuals, Move, SceneBook
from fpp_ml_bench.baselines.diagnostics.probe import Progress, silent
from fpp_ml_bench.baselines.diagnostics.reliance import (
    Change,
    follows,
    order_free,
    order_free_follows,
    relative_change,
    rms_asked,
    sample_score,
)
from fpp_ml_bench.baselines.diagnostics.synth import Darkroom, Scene
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.evaluation.protocol import PROTOCOL_VERSION
from fpp_ml_bench.evaluation.reliance import RELIANCE_VERSION, Reliance, RelianceParts
from fpp_ml_bench.evaluation.uncertainty import object_interval
from fpp_ml_bench.frames import Direction
from fpp_ml_bench.loaders.store import DatasetFolder

Map = NDArray[np.floating[Any]]


class Asked(Protocol):
    """What a method or a subject of a diagnosis offers: both have more."""

    @property
    def frames_used(self) -> tuple[int, ...]: ...

    def predict(self, frames: Sequence[NDArray[np.uint8] | None]) -> NDArray[np.float32]: ...


@dataclass(frozen=True)
class SampleReliance:
    """One sample: its score, the order-free one, and ``parts`` by the names of `RelianceParts`."""

    sample: str
    object: str
    score: float | None
    order_free_score: float | None
    parts: dict[str, float | None]


class Asker:
    """Puts scenes before ``asked`` and holds its answers against the truth in the answer's own units."""

    def __init__(self, asked: Asked, room: Darkroom) -> None:
        self.asked, self.room = asked, room
        units = getattr(asked, "units", "mm")
        if units not in ("mm", "normalised"):
            raise DiagnosisError(f"units {units!r}: reliance is measured for answers in mm, or normalised")
        self.units: Literal["mm", "normalised"] = "mm" if units == "mm" else "normalised"
        self._masked = bool(getattr(asked, "uses_ground_truth_mask", False))

    @property
    def metric(self) -> bool:
        return self.units == "mm"

    def answer(self, scene: Scene) -> NDArray[np.float32]:
        """Depth (H, W) in the answer's units."""
        return self.asked.predict(self.room.frames(scene, self.asked.frames_used, self._masked))

    def truth(self, depth_mm: NDArray[np.float64], mask: NDArray[np.bool_]) -> NDArray[np.float64]:
        """``depth_mm`` (H, W) in the answer's units: mm, or the share of its range over ``mask``."""
        if self.metric:
            return depth_mm
        inside = depth_mm[mask]
        low, span = float(inside.min()), float(np.ptp(inside))
        return (depth_mm - low) / span if span > 0 else np.zeros_like(depth_mm)


def measure_sample(asker: Asker, scenes: Counterfactuals) -> SampleReliance:
    """Every scene of one sample, asked and compared."""
    found = scenes.original
    target = found.target & (found.depth_mm > 0)
    before, truth = asker.answer(found.scene), asker.truth(found.depth_mm, target)
    within = scenes.moves_within()

    def change(after: Map, asked: Map, where: NDArray[np.bool_]) -> Change:
        return Change.of(before, after, asked, where, asker.metric)

    def asked_of(move: Move) -> Map:
        return asker.truth(move.depth_mm, target) - truth

    answers = [asker.answer(move.phase) for move in within]
    moves = [change(after, asked_of(move), target) for move, after in zip(within, answers, strict=True)]
    unit, follow = rms_asked(moves), follows(moves)
    recut_answers = [asker.answer(recut.scene) for recut in scenes.recuts]
    recuts = []
    for recut, after in zip(scenes.recuts, recut_answers, strict=True):
        where = recut.keeps & target
        if where.any():
            asked = asker.truth(recut.depth_mm, recut.scene.mask & (recut.depth_mm > 0)) - truth
            recuts.append(change(after, asked, where))
    outline = relative_change(recuts, unit)
    parts: dict[str, float | None] = {"follows_phase": follow, "change_outline": outline}
    once = [move for move in within if move.amplitude_rad > 0]
    for name in ("light", "both"):
        made = [change(asker.answer(getattr(move, name)), asked_of(move), target) for move in once]
        parts[f"follows_{name}"] = follows(made)
    constant = [move for move in scenes.moves if move.name == "constant"] if asker.metric else []
    parts["follows_constant"] = follows([change(asker.answer(m.phase), asked_of(m), target) for m in constant])
    for name, scene in scenes.reprojected.items():
        key = name.replace(" ", "_")
        shown = change(asker.answer(scene), np.zeros(target.shape), target)
        there = shown.answered
        answered = Change(shown.asked[there], shown.made[there], there[there])
        parts[f"change_{key}"] = relative_change([answered], unit)
        if name.startswith("no fringe"):
            parts[f"answered_{key}"] = float(there.mean())
    free: float | None = None
    if asker.metric:
        turns = [_phase_change(scenes, before, after, move.depth_mm, target)
                 for move, after in zip(within, answers, strict=True)]  # fmt: skip
        parts["order_free_follows_phase"] = order_free_follows(turns)
        cut = [_phase_change(scenes, before, after, found.depth_mm, recut.keeps & target)
               for recut, after in zip(scenes.recuts, recut_answers, strict=True)]  # fmt: skip
        parts["order_free_change_outline"] = relative_change(order_free(cut), rms_asked(order_free(turns)))
        free = sample_score(parts["order_free_follows_phase"], parts["order_free_change_outline"])
    return SampleReliance(found.sample, found.object, sample_score(follow, outline), free, parts)


def _phase_change(scenes: Counterfactuals, before: Map, after: Map, depth_mm: Map, where: NDArray[np.bool_]) -> Change:
    """Change of the phase of answers in mm, in rad, and that of the truth."""
    layer = scenes.layer.at(where)
    asked = layer.absolute_phase(depth_mm[where]) - layer.absolute_phase(scenes.original.depth_mm[where])
    there = (before[where] > 0) & (after[where] > 0)
    first, second = (layer.absolute_phase(np.where(there, answer[where], 1000.0)) for answer in (before, after))
    return Change(asked, np.where(there, second - first, 0.0), there)


def reliance_of(
    asker: Asker, samples: Sequence[SampleReliance], dataset: DatasetFolder, direction: Direction,
    weights_sha256: str | None = None,
) -> Reliance:  # fmt: skip
    """The block of a result from its samples. Raises `DiagnosisError` where none has a score."""
    scored = [one for one in samples if one.score is not None]
    if not scored:
        raise DiagnosisError("no sample leaves room for its phase to move within the working range: nothing to score")
    interval = object_interval([one.score for one in scored], [one.object for one in scored])
    return Reliance(
        version=RELIANCE_VERSION,
        score=_mean([one.score for one in scored]) or 0.0,
        interval=[None, None] if interval is None else [min(max(end, 0.0), 1.0) for end in interval],
        order_free_score=_mean([one.order_free_score for one in scored]),
        parts=RelianceParts(
            **{key: _mean([one.parts.get(key) for one in scored]) for key in RelianceParts.model_fields}
        ),
        units=asker.units,
        direction=direction,
        samples=len(scored),
        objects=len({one.object for one in scored}),
        dataset_fingerprint=dataset.fingerprint,
        protocol_version=PROTOCOL_VERSION,
        weights_sha256=weights_sha256,
    )


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def measure(
    asked: Asked, book: SceneBook, weights_sha256: str | None = None, progress: Progress = silent
) -> tuple[Reliance, list[SampleReliance]]:
    """The block of a method, and what every sample gave. Raises `DiagnosisError` as `Asker` and `reliance_of`."""
    asker, direction = Asker(asked, book.room), direction_read(asked.frames_used, book.dataset)
    samples: list[SampleReliance] = []
    for scenes in book.scenes(direction):
        progress(len(samples), len(book.chosen), scenes.original.sample)
        samples.append(measure_sample(asker, scenes))
    return reliance_of(asker, samples, book.dataset, direction, weights_sha256), samples


def direction_read(frames: Sequence[int], dataset: DatasetFolder) -> Direction:
    """The direction whose phase is moved for a method of these frames: its own, and the vertical one, whose period is
    the shorter in depth, for one of both."""
    known = {dataset.sequence.frames[index].direction for index in frames}
    return "vertical" if "vertical" in known else "horizontal"
