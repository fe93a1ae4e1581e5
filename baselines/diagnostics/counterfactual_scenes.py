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

from fpp_ml_bench.baselines.diagnostics.synth import Darkroom, Projected, Scene
from fpp_ml_bench.baselines.diagnostics.synth_surface import Field, Surface, moved, surface_of_sample
from fpp_ml_bench.baselines.phase_route.calibration_layer import TAU, CalibrationLayer
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.frames import Direction
from fpp_ml_bench.loaders.illumination import LitPixels
from fpp_ml_bench.loaders.store import DatasetFolder
from fpp_ml_bench.pixel_sets import object_mask

LARGEST_SHIFT_RAD = 0.4 * TAU
SMALLEST_SHIFT_RAD = 0.05 * TAU
"""A shift that the working range holds below this says nothing; the move is left out."""
GROWTH = 0.1
"""How far a grown object reaches beyond its outline, in roots of its area: it gains about half its area."""
ROUND_SHARE = 0.5
"""Share of the object's area that the ellipse has which it is cut to."""
PROJECTED: dict[str, Projected] = {
    "no fringe inside": "no fringe inside",
    "no fringe outside": "no fringe outside",
    "other direction": "other direction",
    "other pitch": "other pitch",
}


@dataclass(frozen=True)
class Original:
    """A sample as it is: ``surface`` and ``scene``, ``target`` bool (H, W) (pixels with a decoded depth, those that are
    scored), exact ``depth_mm`` float64 (H, W), and its object."""

    sample: str
    object: str
    surface: Surface
    scene: Scene
    target: NDArray[np.bool_]
    depth_mm: NDArray[np.float64]


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
class Recut:
    """The same phase under another outline; ``keeps`` bool (H, W): target pixels that are object before and after."""

    name: str
    scene: Scene
    keeps: NDArray[np.bool_]
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


def original(dataset: DatasetFolder, room: Darkroom, sample: str) -> Original:
    """The sample as the dataset shows it."""
    about, surface = dataset.measured(sample), surface_of_sample(dataset, sample)
    target = object_mask(dataset.depth_mm(sample))
    stream = (dataset.manifest.settings.get("seed", 0), about["object"], about["view"])
    scene = Scene(surface.pixels.astype(np.uint32), room.light(surface), target, stream)
    return Original(sample, about["object"], surface, scene, target, surface.depth_mm(room.shape))


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
        recuts=tuple(_recuts(found, room, outlines)),
        reprojected={name: replace(found.scene, projected=value) for name, value in PROJECTED.items()},
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


def _recuts(found: Original, room: Darkroom, outlines: Sequence[NDArray[np.bool_]]) -> Iterator[Recut]:
    inside = np.zeros(room.shape, dtype=bool)
    inside.ravel()[found.surface.pixels] = True
    cuts = {"ellipse": _ellipse(found)}
    laid = [_laid_over(outline, found.target) for outline in outlines]
    if laid:
        # The one that leaves nearest to half: an outline that covers the object changes nothing.
        kept = [(cut & found.target).sum() / found.target.sum() for cut in laid]
        cuts["another object's outline"] = laid[int(np.argmin(np.abs(np.array(kept) - ROUND_SHARE)))]
    for name, cut in cuts.items():
        chosen = cut.ravel()[found.surface.pixels]
        scene = replace(
            found.scene,
            pixels=found.scene.pixels[chosen],
            lit=_part(found.scene, chosen),
            mask=found.target & cut,
        )
        yield Recut(name, scene, found.target & cut, found.depth_mm * (inside & cut))
    yield _grown(found, room, inside)


def _grown(found: Original, room: Darkroom, inside: NDArray[np.bool_]) -> Recut:
    """The surface carried on beyond its outline: depth and brightness of the nearest pixel of the target."""
    from scipy.ndimage import distance_transform_edt

    away, nearest = distance_transform_edt(~found.target, return_indices=True)
    ring = (away > 0) & (away <= GROWTH * np.sqrt(found.target.sum())) & ~inside
    place = np.full(room.shape, -1)
    place.ravel()[found.surface.pixels] = np.arange(found.surface.pixels.size)
    source = place[tuple(nearest)][ring]
    x, y = (rays[ring] for rays in room.rig.camera.rays())
    grown = Surface(np.flatnonzero(ring), x, y, found.surface.depth_m[source], found.surface.normals[source])
    both = Surface(
        np.concatenate([found.surface.pixels, grown.pixels]),
        np.concatenate([found.surface.x, grown.x]),
        np.concatenate([found.surface.y, grown.y]),
        np.concatenate([found.surface.depth_m, grown.depth_m]),
        np.concatenate([found.surface.normals, grown.normals]),
    )
    lit = room.light(both)
    gain = np.concatenate([found.scene.lit.gain, found.scene.lit.gain[source]])
    scene = replace(
        found.scene, pixels=both.pixels.astype(np.uint32), lit=replace(lit, gain=gain), mask=found.target | ring
    )
    return Recut("grown", scene, found.target, both.depth_mm(room.shape))


def _part(scene: Scene, chosen: NDArray[np.bool_]) -> LitPixels:
    lit = scene.lit
    lookup = {
        name: replace(found, index=found.index[chosen], weight=found.weight[chosen])
        for name, found in lit.lookup.items()
    }
    return replace(lit, lookup=lookup, gain=lit.gain[chosen], ambient=lit.ambient[chosen])


def _laid_over(outline: NDArray[np.bool_], target: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``outline`` shifted so that its middle lies on the target's."""
    middles = [np.argwhere(mask).mean(axis=0) for mask in (target, outline)]
    down, across = np.rint(middles[0] - middles[1]).astype(int)
    laid = np.zeros_like(outline)
    rows, columns = np.nonzero(outline)
    rows, columns = rows + down, columns + across
    there = (rows >= 0) & (rows < laid.shape[0]) & (columns >= 0) & (columns < laid.shape[1])
    laid[rows[there], columns[there]] = True
    return laid


def _ellipse(found: Original) -> NDArray[np.bool_]:
    """An ellipse on the target's middle, shaped as its spread, that holds `ROUND_SHARE` of its pixels."""
    points = np.argwhere(found.target).astype(np.float64)
    spread = np.maximum(points.std(axis=0), 1.0)
    rows, columns = np.indices(found.target.shape)
    middle = points.mean(axis=0)
    radius = np.hypot((rows - middle[0]) / spread[0], (columns - middle[1]) / spread[1])
    return np.asarray(radius <= np.quantile(radius[found.target], ROUND_SHARE))


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
