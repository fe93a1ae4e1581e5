"""Scenes that differ from a dataset's sample in one thing: the phase, the outline, or where and what fringes there are.

What moves the phase are smooth shifts over the object: ramps and a bump, and for who puts out mm also a constant. They
reach up to 0.4 of a period, as far as the working range allows: less than half, so that a shift can't be taken for one
the other way.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.counterfactual_original import Original, Recut, original
from fpp_ml_bench.baselines.diagnostics.counterfactual_outlines import recuts
from fpp_ml_bench.baselines.diagnostics.synth import Darkroom, Projected, Scene
from fpp_ml_bench.baselines.diagnostics.synth_surface import Field, Surface, moved
from fpp_ml_bench.baselines.phase_route.calibration_layer import TAU, CalibrationLayer
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.frames import Direction
from fpp_ml_bench.loaders.store import DatasetFolder
from fpp_ml_bench.pixel_sets import object_mask

LARGEST_SHIFT_RAD = 0.4 * TAU
SMALLEST_SHIFT_RAD = 0.05 * TAU
"""A shift that the working range holds below this says nothing; the move is left out."""
REPROJECTED: tuple[Projected, ...] = ("no fringe inside", "no fringe outside", "other direction", "other pitch")
VIEWS_PER_OBJECT = 2
_KEPT_PX = 300
"""Scenes of images up to this wide are kept in memory; larger ones are made again for each method."""


@dataclass(frozen=True)
class Move:
    """The surface moved so that its phase changes by ``amplitude_rad`` times the field ``name``; its ``depth_mm``.

    ``phase``: only the phase is the moved surface's, every pixel keeps its brightness. ``light``: only the brightness
    is. ``both``: the moved surface as it would be photographed.
    """

    name: str
    amplitude_rad: float
    phase: Scene
    light: Scene
    both: Scene
    depth_mm: NDArray[np.float64]


@dataclass(frozen=True)
class Counterfactuals:
    """All that is asked of one sample. ``direction``: of the phase that moves."""

    original: Original
    direction: Direction
    layer: CalibrationLayer
    moves: tuple[Move, ...]
    recuts: tuple[Recut, ...]
    reprojected: dict[str, Scene]

    def moves_within(self) -> tuple[Move, ...]:
        """Those that vary over the object."""
        return tuple(move for move in self.moves if move.name != "constant")


def counterfactuals(
    dataset: DatasetFolder, room: Darkroom, sample: str, direction: Direction, others: Sequence[str] = ()
) -> Counterfactuals:
    """Every scene of ``sample``; ``others`` are samples whose outlines it may be cut to. Raises `DiagnosisError` for a
    sample without an object."""
    outlines = [object_mask(dataset.depth_mm(other)) for other in others]
    found = original(dataset, room, sample)
    if not found.target.any():
        raise DiagnosisError(f"{dataset.path}: {sample} shows no object; choose samples with one")
    return Counterfactuals(
        original=found,
        direction=direction,
        layer=CalibrationLayer.of(room.rig, direction),
        moves=tuple(_moves(found, room, direction)),
        recuts=tuple(recuts(found, room, outlines)),
        reprojected={name: replace(found.scene, projected=name) for name in REPROJECTED},
    )


def fields(surface: Surface) -> dict[str, Field]:
    """Shifts of largest size 1 over the object's box: constant, ramps across and down, a bump in the middle."""
    middle = [(axis.min() + axis.max()) / 2 for axis in (surface.x, surface.y)]
    half = [max((axis.max() - axis.min()) / 2, 1e-9) for axis in (surface.x, surface.y)]

    def scaled(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
        return (x - middle[0]) / half[0], (y - middle[1]) / half[1]

    return {
        "constant": lambda x, y: np.ones_like(x),
        "ramp across": lambda x, y: scaled(x, y)[0],
        "ramp down": lambda x, y: scaled(x, y)[1],
        "bump": lambda x, y: np.exp(-2.0 * (scaled(x, y)[0] ** 2 + scaled(x, y)[1] ** 2)),
    }


def _times(field: Field, amplitude: float, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return amplitude * field(x, y)


def _moves(found: Original, room: Darkroom, direction: Direction) -> Iterator[Move]:
    surface = found.surface
    for name, field in fields(surface).items():
        for sign in (1.0, -1.0):
            amplitude = sign * _room_for(surface, room, direction, field, sign)
            if abs(amplitude) < SMALLEST_SHIFT_RAD:
                continue
            there = moved(surface, room.rig, direction, partial(_times, field, amplitude))
            lit = room.light(there)
            before = found.scene.lit
            yield Move(
                name,
                amplitude,
                phase=replace(found.scene, lit=replace(lit, gain=before.gain, ambient=before.ambient)),
                light=replace(found.scene, lit=replace(before, gain=lit.gain, ambient=lit.ambient)),
                both=replace(found.scene, lit=lit),
                depth_mm=there.depth_mm(room.shape),
            )


def _room_for(surface: Surface, room: Darkroom, direction: Direction, field: Field, sign: float) -> float:
    """The largest shift, up to `LARGEST_SHIFT_RAD`, that leaves every pixel within the working range."""
    layer = CalibrationLayer.of(room.rig, direction, (surface.x, surface.y))
    here = layer.absolute_phase(surface.depth_m * MM_PER_M)
    ends = [layer.absolute_phase(end) - here for end in room.rig.working_range_mm]
    low, high = np.minimum(*ends), np.maximum(*ends)
    shift = sign * field(surface.x, surface.y)
    with np.errstate(divide="ignore", invalid="ignore"):
        limits = np.where(shift > 0, high / shift, np.where(shift < 0, low / shift, np.inf))
    return float(np.clip(limits.min(), 0.0, LARGEST_SHIFT_RAD))


def chosen_samples(dataset: DatasetFolder, split: str, views: int) -> list[tuple[str, list[str]]]:
    """``views`` samples of each object of ``split``, each with one sample of every other object, whose outlines it may
    be cut to. Raises `DiagnosisError` for a split without an object."""
    by_object: dict[str, list[str]] = {}
    for sample in dataset.samples(split):
        if object_mask(dataset.depth_mm(sample)).any():
            by_object.setdefault(dataset.measured(sample)["object"], []).append(sample)
    if not by_object:
        raise DiagnosisError(f"{dataset.path}: {split} holds no sample with an object")
    found = []
    for place, (name, samples) in enumerate(by_object.items()):
        # Every other view first: views 180 degrees apart show nearly the same outline.
        ordered = [*samples[0::2], *samples[1::2]]
        for number in range(min(views, len(ordered))):
            view = (number + place) % len(ordered)
            others = [theirs[view % len(theirs)] for other, theirs in by_object.items() if other != name]
            found.append((ordered[view], others))
    return found


class SceneBook:
    """The counterfactual scenes of a dataset, shared by every method that is asked about them: ``views`` samples of
    each object of ``split``. Raises `DiagnosisError` for a split without an object."""

    def __init__(self, dataset: DatasetFolder, views: int = VIEWS_PER_OBJECT, split: str = "test") -> None:
        self.dataset, self.room = dataset, Darkroom.of(dataset)
        self.chosen = chosen_samples(dataset, split, views)
        self._kept: dict[tuple[str, Direction], Counterfactuals] = {}

    def scenes(self, direction: Direction) -> Iterator[Counterfactuals]:
        """Those of every sample, the phase of ``direction`` moved."""
        for sample, others in self.chosen:
            key = sample, direction
            found = self._kept.get(key) or counterfactuals(self.dataset, self.room, sample, direction, others)
            if self.dataset.size[1] <= _KEPT_PX:
                self._kept[key] = found
            yield found
