"""What is true of a dataset's sample, and scenes that differ from it in a single property: its
phase, its outline, or its fringes.

Scenes are in direct light (`direct_light`): a changed scene is compared with its sample in the same
light, never with the dataset's frames. Projector, brightness and sensor are the dataset's. An
unchanged scene gives the frames of a dataset in direct light, noise included, except for a few
pixels in 50,000 that differ by a grey level (tests/diagnostics/test_scenes.py). The noise of a
pixel depends only on the dataset's seed, the object, view, frame and pixel, so it is the same in a
changed scene.

The phase is moved by smooth shifts over the object: ramps and a bump, and for methods that predict
mm also a constant. The shifts reach up to 0.4 of a period, or as far as the working range allows.
They stay below half a period so that a shift can't be confused with the opposite one.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, shift

from fpp_ml_bench.baselines.phase.geometry import TAU, CalibrationLayer
from fpp_ml_bench.constants import MM_PER_M, VIEW_DEGREES, VIEWS
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.depth import normalise, object_mask
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.loaders.captures.exports import pixel_normals
from fpp_ml_bench.loaders.render.illumination import LitPixels, light_surface
from fpp_ml_bench.loaders.render.light import Light, named_light
from fpp_ml_bench.loaders.render.meshes import load_user_mesh
from fpp_ml_bench.loaders.render.raycast import PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import UserMesh, along_rays, turned
from fpp_ml_bench.loaders.render.sensor import Exposure
from fpp_ml_bench.loaders.sample import DEPTH, DEPTH_EXACT
from fpp_ml_bench.loaders.storage.manifest import MESH_FOLDER
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.pinhole import Maps
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import Direction

Values = NDArray[np.float64]
Mask = NDArray[np.bool_]
Field = Callable[[Values, Values], Values]
"""A smooth function of normalised ray coordinates x, y (n,), with values (n,)."""
MovedPhase = Direction | Literal["crossed"]
"""Whose phase a move is measured in: the fringes of a direction, or the carrier of crossed frames
that changes faster with depth. The surface itself is moved, so every fringe on it moves as it
must."""
Projected = Literal[
    "sequence", "no fringe inside", "no fringe outside", "other direction", "other pitch"
]
REPROJECTED: tuple[Projected, ...] = (
    "no fringe inside",
    "no fringe outside",
    "other direction",
    "other pitch",
)
PITCH_FACTOR = 4 / 3
"""Factor of the changed pitch: 18 px become 24."""
LARGEST_SHIFT_RAD = 0.4 * TAU
"""Largest shift of the phase, in rad: less than half a period, so that the nearest order stays the
moved one's own."""
SMALLEST_SHIFT_RAD = 0.05 * TAU
"""Where the working range allows only smaller shifts, the move is left out."""
VIEWS_PER_OBJECT = 2
"""Views of each object that are changed: every change is rendered, which takes time."""
GROWTH = 0.1
"""How far a grown object reaches beyond its outline, in units of sqrt(area): it gains about half
its area."""
KEPT_SHARE = 0.5
"""Share of the object that an ellipse leaves; of the other objects' outlines the nearest to this
share is used."""
ONE_SURFACE = 1e9
"""Steepness up to which neighbours belong to one surface: all pixels of an object do."""
_STEP = 1e-6
"""Step of difference quotients in normalised ray coordinates: far below a pixel, far above
rounding."""
_GRAZING = 0.02
"""Smallest cosine between ray and normal at which the tangent plane is extrapolated to a
neighbouring ray."""


def truth(depth_mm: NDArray[np.float32], rig: Rig, direction: Direction) -> dict[str, NDArray]:
    """Ground truth of a depth map (H, W) in mm, 0 = background, seen by ``rig`` under fringes of
    ``direction``. ``object``: its mask. ``edges``: `edge_map`, [0, 1]. ``depth``: normalised to the
    sample's own range, background 0 (the paper's target). ``depth_mm``. ``sine``, ``cosine``: of
    the wrapped phase, 0 outside the object. ``order``: the fringe order minus that of a plane at
    the rig's standoff, 0 outside the object; the plane's order follows from the pixel's position
    alone. All are float32. Raises ``ValueError`` for a map without an object."""
    inside, layer, standoff_mm = (
        object_mask(depth_mm),
        CalibrationLayer.of(rig, direction),
        rig.standoff_m * MM_PER_M,
    )
    # Of the background as if it were at the standoff.
    phase = layer.absolute_phase(np.where(inside, depth_mm, standoff_mm))
    maps = {
        "object": inside,
        "edges": edge_map(depth_mm),
        "depth": normalise(
            depth_mm, "individual", float(depth_mm[inside].min()), float(depth_mm[inside].max())
        ),
        "depth_mm": depth_mm,
        "sine": np.where(inside, np.sin(phase), 0.0),
        "cosine": np.where(inside, np.cos(phase), 0.0),
        "order": np.floor(phase / TAU) - np.floor(layer.absolute_phase(standoff_mm) / TAU),
    }
    return {name: np.array(values, dtype=np.float32) for name, values in maps.items()}


def edge_map(depth_mm: NDArray) -> NDArray[np.float32]:
    """Sobel gradient magnitude (3 x 3) of a depth map (H, W), float32, divided by its largest
    value, a scale that the paper leaves open; 0 for a constant map."""
    depth = np.asarray(depth_mm, dtype=np.float32)
    across, down = (cv2.Sobel(depth, cv2.CV_32F, *order, ksize=3) for order in ((1, 0), (0, 1)))
    strength: NDArray[np.float32] = np.hypot(across, down)
    return strength / np.float32(strength.max() or 1)


@dataclass(frozen=True)
class Surface:
    """The surface seen by some pixels: flat image indices ``pixels`` int64 (n,), normalised rays
    ``x``, ``y`` (n,), ``depth_m`` float64 (n,), and unit ``normals`` (n, 3) toward the camera, in
    camera coordinates."""

    pixels: NDArray[np.int64]
    x: Values
    y: Values
    depth_m: Values
    normals: Values

    def points_m(self) -> Values:
        """Camera coordinates in metres (n, 3)."""
        return along_rays(self.x, self.y, self.depth_m)

    def depth_mm(self, shape: tuple[int, int]) -> Values:
        """Depth map (H, W) in mm, 0 outside the surface."""
        whole = np.zeros(shape)
        whole.ravel()[self.pixels] = self.depth_m * MM_PER_M
        return whole


def seen_by(rig: Rig, pixels: NDArray[np.int64], depth_m: Values, normals: Values) -> Surface:
    """The surface on the rays of ``pixels`` (n,), with depth (n,) and normals (n, 3)."""
    x, y = (rays.ravel()[pixels] for rays in rig.camera.rays())
    return Surface(pixels, x, y, depth_m, normals)


def surface_of_sample(dataset: DatasetFolder, sample: str) -> Surface:
    """The object of ``sample``: a built dataset's mesh as its camera sees it, of an imported
    dataset the depth map with `pixel_normals`."""
    rig, record = dataset.rig, dataset.measured(sample)
    mesh_file = dataset.path / MESH_FOLDER / f"{record['object']}.ply"
    if mesh_file.is_file() and record.get("distance_mm") is not None:
        mesh = load_user_mesh(UserMesh(mesh_file.stem, str(mesh_file), centre=False))
        placed_m = turned(mesh.vertices_m, VIEW_DEGREES[VIEWS.index(record["view"])])
        placed_m += np.array([0, 0, record["distance_mm"] / MM_PER_M])
        hits = TracedObject(mesh, placed_m).primary(PixelRays.of(rig.camera))
        return seen_by(rig, hits.pixels, hits.depth_m, hits.normals)
    depth_mm = dataset.depth_mm(sample, DEPTH_EXACT if dataset.has_exact else DEPTH).astype(
        np.float64
    )
    pixels = np.flatnonzero(object_mask(depth_mm))
    normals = pixel_normals(depth_mm, rig.camera, ONE_SURFACE).reshape(-1, 3)[pixels]
    return seen_by(rig, pixels, depth_mm.ravel()[pixels] / MM_PER_M, normals)


def plane(
    rig: Rig,
    distance_m: float,
    tilt_deg: tuple[float, float] = (0.0, 0.0),
    mask: Mask | None = None,
) -> Surface:
    """A plane that crosses the camera's axis at ``distance_m``, tilted by ``tilt_deg`` so that it
    recedes to the right and downward. It fills the frame, or is cut to ``mask`` (H, W)."""
    x, y = (rays.ravel() for rays in rig.camera.rays())
    across, down = np.tan(np.deg2rad(tilt_deg))
    pixels = np.arange(x.size) if mask is None else np.flatnonzero(mask)
    x, y = x[pixels], y[pixels]
    depth_m, normal = distance_m / (1 - across * x - down * y), np.array([across, down, -1.0])
    return Surface(
        pixels, x, y, depth_m, np.tile(normal / np.linalg.norm(normal), (pixels.size, 1))
    )


def layer_of(rig: Rig, phase: MovedPhase, rays: Maps | None = None) -> CalibrationLayer:
    """The calibration layer of `MovedPhase` for a rig, at all pixels or at normalised ``rays`` (x,
    y). Raises `DiagnosisError` for crossed fringes of a rig without them."""
    if phase != "crossed":
        return CalibrationLayer.of(rig, phase, rays)
    if rig.crossed is None:
        raise DiagnosisError(
            "crossed: this rig projects no crossed frames whose phase could be moved"
        )
    carriers = [
        CalibrationLayer.of_carrier(rig, cycles, rays) for cycles in rig.crossed.cycles_per_px
    ]
    return max(carriers, key=lambda layer: float(np.median(np.abs(layer.gain))))


def constant(x: Values, y: Values) -> Values:
    """The `Field` that is 1 everywhere."""
    return np.ones_like(x)


def moved(
    surface: Surface, rig: Rig, direction: MovedPhase, field: Field, amplitude_rad: float = 1.0
) -> Surface:
    """``surface`` moved along the camera's rays so that the phase of ``direction`` changes by
    ``amplitude_rad`` times ``field``, with its new normals; the outline stays."""

    def moved_m(x: Values, y: Values, depth_m: Values) -> Values:
        layer = layer_of(rig, direction, (x, y))
        phase = layer.absolute_phase(depth_m * MM_PER_M) + amplitude_rad * field(x, y)
        return (
            layer.depth_of_residual_mm(phase - layer.infinity_rad - TAU * layer.infinity_order)
            / MM_PER_M
        )

    new_m = moved_m(surface.x, surface.y, surface.depth_m)
    rays = np.column_stack([surface.x, surface.y, np.ones_like(surface.x)])
    facing = np.einsum("ij,ij->i", surface.normals, rays)
    usable = np.abs(facing) > _GRAZING * np.linalg.norm(rays, axis=1)
    gradient = []
    for axis in (0, 1):
        # The tangent plane gives the depth on a neighbouring ray, which is moved in the same way as
        # the pixel.
        x, y = surface.x + _STEP * (axis == 0), surface.y + _STEP * (axis == 1)
        facing_beside = np.where(usable, facing + _STEP * surface.normals[:, axis], 1.0)
        beside_m = np.where(usable, surface.depth_m * facing / facing_beside, surface.depth_m)
        gradient.append((moved_m(x, y, beside_m) - new_m) / _STEP)
    across, down = gradient
    # Z(x, y) has the normal (Z_x, Z_y, -(Z + x Z_x + y Z_y)), up to its length.
    normals = np.column_stack([across, down, -(new_m + surface.x * across + surface.y * down)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(usable[:, None] & np.isfinite(normals), normals, surface.normals)
    return replace(surface, depth_m=new_m, normals=normals)


@dataclass(frozen=True)
class Scene:
    """A ``surface`` in front of the empty scene, how its pixels are ``lit``, in its order, and the
    pattern that is projected. ``mask`` bool (H, W): the object mask, which methods may be given; of
    a sample the pixels with a decoded depth, which are scored. ``stream``: key of the noise. With
    ``no fringe`` the mean light of the sequence is projected. The other direction of crossed
    fringes has both angles mirrored; turned by 90 degrees, a square pair would be itself."""

    surface: Surface
    lit: LitPixels
    mask: Mask
    stream: tuple[object, ...]
    projected: Projected = "sequence"

    @property
    def depth_mm(self) -> Values:
        """True depth (H, W) in mm, 0 outside the surface."""
        return self.surface.depth_mm(self.mask.shape)  # type: ignore[arg-type]


def direct_light(light: Light) -> Light:
    """What a surface without a mesh or pixels around it can show of ``light``: no further bounces,
    shadows, gloss, albedo maps, lens or movement, and one exposure, the middle of a range; ambient
    light is that in the open. A camera pixel's width still blurs the pattern where the light has
    pixels with an area."""
    middle = float(np.sqrt(np.prod(np.broadcast_to(light.camera.exposure, 2))))
    return (
        light.changed(motion_mm=0.0, calibration_px=0.0)
        .changed("surface", gloss=0.0, textures="none")
        .changed("bounces", interreflection=False, ambient_occlusion=False, shadows=False)
        .changed("camera", blur_px=0.0, falloff=0, exposure=middle)
    )


class SceneRenderer:
    """Renders scenes with the direct light, sensor and empty background of a rig; keeps the last
    backgrounds."""

    def __init__(self, rig: Rig, light: Light | None = None) -> None:
        self.rig, self.lamp = rig, direct_light(light or named_light("paper"))
        self.shape = (rig.camera.height, rig.camera.width)

    @classmethod
    def of(cls, dataset: DatasetFolder) -> "SceneRenderer":
        """The renderer for ``dataset``: its light, and the paper's for an imported one."""
        light = dataset.manifest.settings.get("light")
        return cls(dataset.rig, None if light is None else Light.model_validate(light))

    @cache  # noqa: B019
    def _exposure(self, pattern: str) -> Exposure:
        """With the pattern ``sequence``, its mean light (``uniform``), ``other pitch`` or ``other
        direction``; kept."""
        rig, pair = self.rig, self.rig.crossed
        if pattern == "other pitch":
            names = ("pitch_horizontal_px", "pitch_vertical_px")
            rig = replace(rig, **{name: PITCH_FACTOR * getattr(rig, name) for name in names})
        if pair is not None and pattern.startswith("other"):
            key, factor = (
                ("pitches_px", PITCH_FACTOR) if pattern == "other pitch" else ("angles_deg", -1)
            )
            first, second = getattr(pair, key)
            rig = rig.with_crossed(replace(pair, **{key: (factor * first, factor * second)}))
        exposure = Exposure.of(rig, self.lamp)
        return (
            replace(exposure, pattern=exposure.pattern.uniform(rig))
            if pattern == "uniform"
            else exposure
        )

    def light(self, surface: Surface) -> LitPixels:
        """The direct light on ``surface``."""
        pattern = self._exposure("sequence").pattern
        lit = light_surface(surface.points_m(), surface.normals, self.rig, self.lamp, pattern)
        return lit.brighter(np.float32(self.lamp.camera.exposure))  # type: ignore[arg-type]  # direct light has one

    def frames(
        self, scene: Scene, indices: Sequence[int], masked: bool = False
    ) -> list[NDArray[np.uint8] | None]:
        """Frames ``indices`` of ``scene``, uint8 (H, W), by number, else None; ``masked``: 0
        outside ``scene.mask``."""
        turned_round = scene.projected == "other direction"
        other = scene.projected == "other pitch" or (turned_round and self.rig.crossed is not None)
        usual: str = scene.projected if other else "sequence"
        inside, outside = (
            "uniform" if scene.projected == f"no fringe {where}" else usual
            for where in ("inside", "outside")
        )
        projected = tuple(self._partner(index) if turned_round else index for index in indices)
        pixels = scene.surface.pixels
        images = self._background(scene.stream, projected, outside).copy()
        images[:, pixels] = self._exposure(inside).expose(
            projected, scene.lit, pixels.astype(np.uint32), scene.stream
        )
        frames: list[NDArray[np.uint8] | None] = [None] * len(self.rig.sequence)
        for index, image in zip(indices, images.reshape(-1, *self.shape), strict=True):
            frames[index] = image * scene.mask if masked else image
        return frames

    def decoded_mm(self, scene: Scene) -> NDArray[np.float32]:
        """Depth (H, W) in mm decoded from the whole sequence on the scene's pixels, as a dataset's
        is; 0 beyond."""
        frames = np.stack(self.frames(scene, range(len(self.rig.sequence))))  # type: ignore[arg-type]  # all are asked
        return decode_stack(
            frames, self.rig, direction="both", mask=scene.depth_mm > 0, reasons=False
        ).depth_mm

    @cached_property
    def _empty(self) -> LitPixels:
        return self.light(plane(self.rig, self.rig.background))

    @lru_cache(maxsize=4)  # noqa: B019  # all frames and those of a method, of two patterns
    def _background(
        self, stream: tuple[object, ...], indices: tuple[int, ...], pattern: str
    ) -> NDArray[np.uint8]:
        pixels = np.arange(self.shape[0] * self.shape[1], dtype=np.uint32)
        return self._exposure(pattern).expose(indices, self._empty, pixels, stream)

    def _partner(self, index: int) -> int:
        """The frame of the other direction with the same step or bit; black and white frames map to
        themselves."""
        sequence, frame = self.rig.sequence, self.rig.sequence.frames[index]
        if frame.direction is None:
            return index
        frames_of = sequence.sinusoids if frame.kind == "sinusoid" else sequence.gray
        others = frames_of("vertical" if frame.direction == "horizontal" else "horizontal")
        return others[min(frame.step, len(others) - 1)]


def original(dataset: DatasetFolder, renderer: SceneRenderer, sample: str) -> Scene:
    """``sample`` as the dataset shows it, in the renderer's light. What is scored of it is decoded
    from the scene: in a dataset with further bounces or mixed pixels, others have a depth."""
    record, surface = dataset.measured(sample), surface_of_sample(dataset, sample)
    stream = (dataset.manifest.settings.get("seed", 0), record["object"], record["view"])
    scene = Scene(surface, renderer.light(surface), np.zeros(renderer.shape, dtype=bool), stream)
    return replace(scene, mask=object_mask(renderer.decoded_mm(scene)))


Kind = Literal["phase", "constant", "light", "both", "outline", "projected"]


@dataclass(frozen=True)
class Variant:
    """A scene that differs from that of its sample in one property. ``kind``:

    - ``phase`` and ``constant``: the surface moved so that its phase changes by
      ``amplitude_rad`` times the field ``name``, with the brightness of the original; for
      ``constant`` by the same everywhere
    - ``light``: the brightness of the moved surface with the phase of the original
    - ``both``: the moved surface as it would be photographed
    - ``outline``: the same phase under another outline; scored pixels within the scene's mask
      show the object before and after
    - ``projected``: another pattern, ``name`` of `REPROJECTED`"""

    kind: Kind
    name: str
    scene: Scene
    amplitude_rad: float = 0.0


def counterfactuals(
    renderer: SceneRenderer, unchanged: Scene, direction: MovedPhase, outlines: Sequence[Mask]
) -> list[Variant]:
    """Every variant of a sample's scene: the phase of ``direction`` moved, the object cut to
    ``outlines`` of others."""
    variants = [
        *_moves(unchanged, renderer, direction),
        *_outline_changes(unchanged, renderer, outlines),
    ]
    return variants + [
        Variant("projected", name, replace(unchanged, projected=name)) for name in REPROJECTED
    ]


FIELDS: dict[str, Field] = {
    "constant": constant,
    "ramp across": lambda x, y: x,
    "ramp down": lambda x, y: y,
    "bump": lambda x, y: np.exp(-2.0 * (x**2 + y**2)),
}
"""Shifts of at most 1 over an object's bounding box, whose coordinates are -1 to 1."""


def _over_box(field: Field, surface: Surface) -> Field:
    """A field of `FIELDS` over the surface's bounding box."""
    (left, right), (top, bottom) = ((axis.min(), axis.max()) for axis in (surface.x, surface.y))
    across, down = max((right - left) / 2, 1e-9), max((bottom - top) / 2, 1e-9)
    return lambda x, y: field((x - (left + right) / 2) / across, (y - (top + bottom) / 2) / down)


def _moves(sample: Scene, renderer: SceneRenderer, direction: MovedPhase) -> Iterator[Variant]:
    surface, before = sample.surface, sample.lit
    for name, field in FIELDS.items():
        field = _over_box(field, surface)
        for sign in (1.0, -1.0):
            amplitude = sign * _largest_shift_rad(surface, renderer.rig, direction, field, sign)
            if abs(amplitude) < SMALLEST_SHIFT_RAD:
                continue
            moved_surface = moved(surface, renderer.rig, direction, field, amplitude)
            lit = renderer.light(moved_surface)
            lights: dict[Kind, tuple[LitPixels, LitPixels]] = {
                "constant" if name == "constant" else "phase": (lit, before)
            }
            if name != "constant" and sign > 0:
                lights |= {"light": (before, lit), "both": (lit, lit)}
            for kind, (place, brightness) in lights.items():
                shown = replace(place, gain=brightness.gain, ambient=brightness.ambient)
                yield Variant(
                    kind, name, replace(sample, surface=moved_surface, lit=shown), amplitude
                )


def _largest_shift_rad(
    surface: Surface, rig: Rig, direction: MovedPhase, field: Field, sign: float
) -> float:
    """The largest shift, up to `LARGEST_SHIFT_RAD`, that keeps every pixel within the working
    range."""
    layer = layer_of(rig, direction, (surface.x, surface.y))
    phase = layer.absolute_phase(surface.depth_m * MM_PER_M)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = [
            (layer.absolute_phase(end) - phase) / (sign * field(surface.x, surface.y))
            for end in rig.working_range_mm
        ]
    return float(np.clip(np.nanmin(np.maximum(*ends)), 0.0, LARGEST_SHIFT_RAD))


def _outline_changes(
    sample: Scene, renderer: SceneRenderer, outlines: Sequence[Mask]
) -> Iterator[Variant]:
    """The sample under three other outlines, two without ``outlines`` (masks (H, W) of other
    objects)."""
    surface, target = sample.surface, sample.mask
    cuts = {"ellipse": _ellipse(target)}
    if shifted := [_laid_over(outline, target) for outline in outlines]:
        # An outline that covers the whole object would change nothing.
        shares = [(cut & target).sum() / target.sum() for cut in shifted]
        cuts["another object's outline"] = shifted[
            int(np.argmin(np.abs(np.array(shares) - KEPT_SHARE)))
        ]
    for name, cut in cuts.items():
        kept = cut.ravel()[surface.pixels]
        part = seen_by(
            renderer.rig, surface.pixels[kept], surface.depth_m[kept], surface.normals[kept]
        )
        yield Variant(
            "outline",
            name,
            replace(sample, surface=part, lit=renderer.light(part), mask=target & cut),
        )
    yield Variant("outline", "grown", _grown(sample, renderer))


def _grown(sample: Scene, renderer: SceneRenderer) -> Scene:
    """The surface extended beyond its outline with depth and brightness of the nearest target
    pixel."""
    surface, target = sample.surface, sample.mask
    surface_index = np.full(target.shape, -1)
    surface_index.ravel()[surface.pixels] = np.arange(surface.pixels.size)
    distance_px, nearest = distance_transform_edt(~target, return_indices=True)
    ring = (distance_px > 0) & (distance_px <= GROWTH * np.sqrt(target.sum())) & (surface_index < 0)
    source = surface_index[tuple(nearest)][ring]
    both = seen_by(
        renderer.rig,
        np.concatenate([surface.pixels, np.flatnonzero(ring)]),
        np.concatenate([surface.depth_m, surface.depth_m[source]]),
        np.concatenate([surface.normals, surface.normals[source]]),
    )
    lit = replace(
        renderer.light(both), gain=np.concatenate([sample.lit.gain, sample.lit.gain[source]])
    )
    return replace(sample, surface=both, lit=lit, mask=target | ring)


def _laid_over(outline: Mask, target: Mask) -> Mask:
    """``outline`` shifted so that its centre lies on the target's."""
    centres = [np.argwhere(mask).mean(axis=0) for mask in (target, outline)]
    return shift(outline.astype(np.uint8), np.rint(centres[0] - centres[1]), order=0).astype(bool)


def _ellipse(target: Mask) -> Mask:
    """An ellipse that holds `KEPT_SHARE` of the target's pixels, with its centre and shape
    (standard deviations)."""
    points = np.argwhere(target).astype(np.float64)
    spread = np.maximum(points.std(axis=0), 1.0)
    rows, columns = np.indices(target.shape)
    centre = points.mean(axis=0)
    radius = np.hypot((rows - centre[0]) / spread[0], (columns - centre[1]) / spread[1])
    return np.asarray(radius <= np.quantile(radius[target], KEPT_SHARE))


def chosen_samples(dataset: DatasetFolder, split: str, views: int) -> list[tuple[str, list[str]]]:
    """``views`` samples of each object of ``split``, each with a sample of every other object,
    whose outlines it may be cut to. Raises `DiagnosisError` for a split without an object."""
    views_by_object = {
        name: [sample for sample in samples if object_mask(dataset.depth_mm(sample)).any()]
        for name, samples in dataset.samples_by_object(split).items()
    }
    by_object = {name: samples for name, samples in views_by_object.items() if samples}
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
