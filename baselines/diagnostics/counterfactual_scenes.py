"""Scenes that differ from a dataset's sample in a single property: its phase, its outline, or its fringes.

The phase is moved by smooth shifts over the object: ramps and a bump, and for methods that predict mm also a constant.
The shifts reach up to 0.4 of a period, or as far as the working range allows. They stay below half a period so that a
shift can't be confused with the opposite one.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, shift

from fpp_ml_bench.baselines.diagnostics import scene_renderer as rendering
from fpp_ml_bench.baselines.diagnostics.scene_renderer import (
    Field,
    MovedPhase,
    Projected,
    Scene,
    SceneRenderer,
    Surface,
    layer_of,
)
from fpp_ml_bench.baselines.phase.calibration_layer import TAU, CalibrationLayer
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.loaders.render.illumination import LitPixels
from fpp_ml_bench.loaders.storage.store import DatasetFolder

LARGEST_SHIFT_RAD = 0.4 * TAU
SMALLEST_SHIFT_RAD = 0.05 * TAU  # where the working range allows only smaller shifts, the move is left out
REPROJECTED: tuple[Projected, ...] = ("no fringe inside", "no fringe outside", "other direction", "other pitch")
VIEWS_PER_OBJECT = 2
GROWTH = 0.1  # how far a grown object reaches beyond its outline, in units of sqrt(area): it gains about half its area
KEPT_SHARE = 0.5
"""Share of the object that an ellipse leaves; of the other objects' outlines the nearest to this share is used."""


@dataclass(frozen=True)
class Original:
    """An unchanged sample: its ``object``, ``surface`` and ``scene``, exact ``depth_mm`` float64 (H, W), and ``target``
    bool (H, W): the pixels with a decoded depth, which are scored. They are decoded from the scene: in a dataset with
    further bounces or mixed pixels, others have a depth."""

    sample: str
    object: str
    surface: Surface
    scene: Scene
    target: NDArray[np.bool_]
    depth_mm: NDArray[np.float64]


def original(dataset: DatasetFolder, renderer: SceneRenderer, sample: str) -> Original:
    """``sample`` as the dataset shows it, in the renderer's light."""
    record, surface = dataset.measured(sample), rendering.surface_of_sample(dataset, sample)
    stream = (dataset.manifest.settings.get("seed", 0), record["object"], record["view"])
    depth_mm = surface.depth_mm(renderer.shape)
    scene = Scene(surface.pixels.astype(np.uint32), renderer.light(surface), object_mask(depth_mm), stream)
    target = object_mask(renderer.decoded_mm(scene))
    return Original(sample, record["object"], surface, replace(scene, mask=target), target, depth_mm)


Kind = Literal["phase", "constant", "light", "both", "outline", "projected"]


@dataclass(frozen=True)
class Variant:
    """A scene that differs from its `Original` in one property, and its true depth (H, W). ``kind``:

    - ``phase`` and ``constant``: the surface moved so that its phase changes by ``amplitude_rad`` times the field
      ``name``, with the brightness of the original; for ``constant`` by the same everywhere
    - ``light``: the brightness of the moved surface with the phase of the original
    - ``both``: the moved surface as it would be photographed
    - ``outline``: the same phase under another outline; target pixels within the scene's mask show the object before
      and after
    - ``projected``: another pattern, ``name`` of `REPROJECTED`"""

    kind: Kind
    name: str
    scene: Scene
    depth_mm: NDArray[np.float64]
    amplitude_rad: float = 0.0


@dataclass(frozen=True)
class Counterfactuals:
    """All scenes of a sample. ``direction``: whose phase is moved."""

    original: Original
    direction: MovedPhase
    layer: CalibrationLayer
    variants: tuple[Variant, ...]

    def of_kind(self, *kinds: str) -> list[Variant]:
        """Those of some kinds."""
        return [variant for variant in self.variants if variant.kind in kinds]


def counterfactuals(
    dataset: DatasetFolder, renderer: SceneRenderer, sample: str, direction: MovedPhase, outline_samples: Sequence[str]
) -> Counterfactuals:
    """Every scene of ``sample``, which shows an object and may be cut to the outlines of ``outline_samples``."""
    unchanged = original(dataset, renderer, sample)
    outlines = [object_mask(dataset.depth_mm(outline_sample)) for outline_sample in outline_samples]
    variants = [*_moves(unchanged, renderer, direction), *_outline_changes(unchanged, renderer, outlines)]
    for name in REPROJECTED:
        variants.append(Variant("projected", name, replace(unchanged.scene, projected=name), unchanged.depth_mm))
    return Counterfactuals(unchanged, direction, layer_of(renderer.rig, direction), tuple(variants))


def fields(surface: Surface) -> dict[str, Field]:
    """Shifts of at most 1 over the object's bounding box: constant, ramps across and down, a bump in the centre."""
    middle = [(axis.min() + axis.max()) / 2 for axis in (surface.x, surface.y)]
    half = [max((axis.max() - axis.min()) / 2, 1e-9) for axis in (surface.x, surface.y)]
    return {
        "constant": rendering.constant,
        "ramp across": lambda x, y: (x - middle[0]) / half[0],
        "ramp down": lambda x, y: (y - middle[1]) / half[1],
        "bump": lambda x, y: np.exp(-2.0 * (((x - middle[0]) / half[0]) ** 2 + ((y - middle[1]) / half[1]) ** 2)),
    }


def _moves(sample: Original, renderer: SceneRenderer, direction: MovedPhase) -> Iterator[Variant]:
    surface, before = sample.surface, sample.scene.lit
    for name, field in fields(surface).items():
        for sign in (1.0, -1.0):
            amplitude = sign * _largest_shift_rad(surface, renderer, direction, field, sign)
            if abs(amplitude) < SMALLEST_SHIFT_RAD:
                continue
            moved_surface = rendering.moved(surface, renderer.rig, direction, field, amplitude)
            lit = renderer.light(moved_surface)
            lights: dict[Kind, tuple[LitPixels, LitPixels]] = {
                "constant" if name == "constant" else "phase": (lit, before)
            }
            if name != "constant" and sign > 0:
                lights |= {"light": (before, lit), "both": (lit, lit)}
            for kind, (place, brightness) in lights.items():
                scene = replace(sample.scene, lit=replace(place, gain=brightness.gain, ambient=brightness.ambient))
                yield Variant(kind, name, scene, moved_surface.depth_mm(renderer.shape), amplitude)


def _largest_shift_rad(
    surface: Surface, renderer: SceneRenderer, direction: MovedPhase, field: Field, sign: float
) -> float:
    """The largest shift, up to `LARGEST_SHIFT_RAD`, that keeps every pixel within the working range."""
    layer = layer_of(renderer.rig, direction, (surface.x, surface.y))
    phase = layer.absolute_phase(surface.depth_m * MM_PER_M)
    ends = [layer.absolute_phase(end) - phase for end in renderer.rig.working_range_mm]
    low, high = np.minimum(*ends), np.maximum(*ends)
    shift = sign * field(surface.x, surface.y)
    with np.errstate(divide="ignore", invalid="ignore"):
        limits = np.where(shift > 0, high / shift, np.where(shift < 0, low / shift, np.inf))
    return float(np.clip(limits.min(), 0.0, LARGEST_SHIFT_RAD))


def _outline_changes(
    sample: Original, renderer: SceneRenderer, outlines: Sequence[NDArray[np.bool_]]
) -> Iterator[Variant]:
    """The sample under three other outlines, two without ``outlines`` (masks (H, W) of other objects)."""
    inside = np.zeros(renderer.shape, dtype=bool)
    inside.ravel()[sample.surface.pixels] = True
    cuts = {"ellipse": _ellipse(sample)}
    moved = [_laid_over(outline, sample.target) for outline in outlines]
    if moved:
        # An outline that covers the whole object would change nothing.
        shares = [(cut & sample.target).sum() / sample.target.sum() for cut in moved]
        cuts["another object's outline"] = moved[int(np.argmin(np.abs(np.array(shares) - KEPT_SHARE)))]
    for name, cut in cuts.items():
        inside_cut = cut.ravel()[sample.surface.pixels]
        lit, place = sample.scene.lit, sample.scene.lit.place
        place = place._replace(**{key: values[inside_cut] for key, values in place._asdict().items() if values.size})
        lit = replace(lit, place=place, gain=lit.gain[inside_cut], ambient=lit.ambient[inside_cut])
        scene = replace(sample.scene, pixels=sample.scene.pixels[inside_cut], lit=lit, mask=sample.target & cut)
        yield Variant("outline", name, scene, sample.depth_mm * (inside & cut))
    yield _grown(sample, renderer, inside)


def _grown(sample: Original, renderer: SceneRenderer, inside: NDArray[np.bool_]) -> Variant:
    """The surface extended beyond its outline with depth and brightness of the nearest target pixel."""
    surface = sample.surface
    distance_px, nearest = distance_transform_edt(~sample.target, return_indices=True)
    ring = (distance_px > 0) & (distance_px <= GROWTH * np.sqrt(sample.target.sum())) & ~inside
    surface_index = np.full(renderer.shape, -1)
    surface_index.ravel()[surface.pixels] = np.arange(surface.pixels.size)
    source = surface_index[tuple(nearest)][ring]
    x, y = (rays[ring] for rays in renderer.rig.camera.rays())
    both = surface.joined(Surface(np.flatnonzero(ring), x, y, surface.depth_m[source], surface.normals[source]))
    gain = np.concatenate([sample.scene.lit.gain, sample.scene.lit.gain[source]])
    lit = replace(renderer.light(both), gain=gain)
    scene = replace(sample.scene, pixels=both.pixels.astype(np.uint32), lit=lit, mask=sample.target | ring)
    return Variant("outline", "grown", scene, both.depth_mm(renderer.shape))


def _laid_over(outline: NDArray[np.bool_], target: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``outline`` shifted so that its centre lies on the target's."""
    centres = [np.argwhere(mask).mean(axis=0) for mask in (target, outline)]
    return shift(outline.astype(np.uint8), np.rint(centres[0] - centres[1]), order=0).astype(bool)


def _ellipse(sample: Original) -> NDArray[np.bool_]:
    """An ellipse that holds `KEPT_SHARE` of the target's pixels, with its centre and shape (standard deviations)."""
    points = np.argwhere(sample.target).astype(np.float64)
    spread = np.maximum(points.std(axis=0), 1.0)
    rows, columns = np.indices(sample.target.shape)
    centre = points.mean(axis=0)
    radius = np.hypot((rows - centre[0]) / spread[0], (columns - centre[1]) / spread[1])
    return np.asarray(radius <= np.quantile(radius[sample.target], KEPT_SHARE))


def chosen_samples(dataset: DatasetFolder, split: str, views: int) -> list[tuple[str, list[str]]]:
    """``views`` samples of each object of ``split``, each with a sample of every other object, whose outlines it may be
    cut to. Raises `DiagnosisError` for a split without an object."""
    by_object: dict[str, list[str]] = {}
    for sample in dataset.samples(split):
        if object_mask(dataset.depth_mm(sample)).any():
            by_object.setdefault(dataset.measured(sample)["object"], []).append(sample)
    if not by_object:
        raise DiagnosisError(f"{dataset.path}: {split} holds no sample with an object")
    chosen = []
    for object_number, (name, samples) in enumerate(by_object.items()):
        # Every other view first: views 180 degrees apart show nearly the same outline.
        ordered = [*samples[0::2], *samples[1::2]]
        for view_number in range(min(views, len(ordered))):
            view = (view_number + object_number) % len(ordered)
            others = [other for other_name, other in by_object.items() if other_name != name]
            chosen.append((ordered[view], [other[view % len(other)] for other in others]))
    return chosen


class SceneSet:
    """The counterfactual scenes of ``views`` samples of each object of ``split``. Raises
    `DiagnosisError` for a split without an object."""

    def __init__(self, dataset: DatasetFolder, views: int = VIEWS_PER_OBJECT, split: str = "test") -> None:
        self.dataset, self.renderer = dataset, SceneRenderer.of(dataset)
        self.samples = chosen_samples(dataset, split, views)

    def scenes(self, direction: MovedPhase) -> Iterator[Counterfactuals]:
        """The scenes of every sample, with the phase of ``direction`` moved."""
        for place in range(len(self.samples)):
            yield self.scenes_of(place, direction)

    def scenes_of(self, place: int, direction: MovedPhase) -> Counterfactuals:
        """Those of the sample at a place of ``samples``."""
        sample, outline_samples = self.samples[place]
        return counterfactuals(self.dataset, self.renderer, sample, direction, outline_samples)
