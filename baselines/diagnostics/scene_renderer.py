"""Surfaces seen by a rig's camera, and rendered frames of scenes with them that are not in a dataset.

Scenes are in direct light (`direct_light`): a changed scene is compared with its sample in the same light, never with
the dataset's frames. Projector, brightness and sensor are the dataset's. An unchanged scene gives the frames of a
dataset in direct light, noise included, except for a few pixels in 50,000 that differ by a grey level
(tests/diagnostics/test_counterfactual_scenes.py). The noise of a pixel depends only on the dataset's seed, the object,
view, frame and pixel, so it is the same in a changed scene.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property, lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import TAU, CalibrationLayer
from fpp_ml_bench.constants import MM_PER_M, VIEW_DEGREES, VIEWS
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.loaders.render.illumination import LitPixels, light_surface
from fpp_ml_bench.loaders.render.light import Light, named_light
from fpp_ml_bench.loaders.render.meshes import load_user_mesh
from fpp_ml_bench.loaders.render.raycast import PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import UserMesh
from fpp_ml_bench.loaders.render.scene import turned as render_turned
from fpp_ml_bench.loaders.render.sensor import Exposure
from fpp_ml_bench.loaders.sample import DEPTH, DEPTH_EXACT
from fpp_ml_bench.loaders.storage.manifest import MESH_FOLDER
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.pinhole import Maps
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import Direction

Field = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""A smooth function of normalised ray coordinates x, y (n,), with values (n,)."""

_STEP = 1e-6  # step of difference quotients in normalised ray coordinates: far below a pixel, far above rounding
_SAME_SURFACE_M = 1e-3  # a traced depth that differs from the stored depth by more belongs to another triangle
_GRAZING = 0.02
"""Smallest cosine between ray and normal at which the tangent plane is extrapolated to a neighbouring ray."""


def constant(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """The `Field` that is 1 everywhere."""
    return np.ones_like(x)


@dataclass(frozen=True)
class Surface:
    """The surface seen by some pixels: flat image indices ``pixels`` int64 (n,), normalised rays ``x``, ``y`` (n,),
    ``depth_m`` float64 (n,), and unit ``normals`` (n, 3) toward the camera, in camera coordinates."""

    pixels: NDArray[np.int64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    depth_m: NDArray[np.float64]
    normals: NDArray[np.float64]

    def points_m(self) -> NDArray[np.float64]:
        """Camera coordinates in metres (n, 3)."""
        return np.column_stack([self.x, self.y, np.ones_like(self.x)]) * self.depth_m[:, None]

    def joined(self, other: "Surface") -> "Surface":
        """The pixels of both."""
        names = (part.name for part in fields(self))
        return Surface(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))

    def depth_mm(self, shape: tuple[int, int]) -> NDArray[np.float64]:
        """Depth map (H, W) in mm, 0 outside the surface."""
        whole = np.zeros(shape[0] * shape[1])
        whole[self.pixels] = self.depth_m * MM_PER_M
        return whole.reshape(shape)


def surface_of_sample(dataset: DatasetFolder, sample: str) -> Surface:
    """The object of ``sample``: exact depth where the dataset has it, else the decoded depth. Normals come from a built
    dataset's mesh, and without one (imported), or where the ray misses it, from the depth map."""
    depth_mm = dataset.depth_mm(sample, DEPTH_EXACT if dataset.has_exact else DEPTH).astype(np.float64)
    x, y = dataset.rig.camera.rays()
    pixels = np.flatnonzero(object_mask(depth_mm))
    normals, depth_m = normals_of_depth(depth_mm, x, y)[pixels], depth_mm.ravel()[pixels] / MM_PER_M
    record = dataset.measured(sample)
    mesh_file = dataset.path / MESH_FOLDER / f"{record['object']}.ply"
    if mesh_file.is_file() and record.get("distance_mm") is not None:
        solid = load_user_mesh(UserMesh(mesh_file.stem, str(mesh_file), centre=False))
        vertices_m = render_turned(solid.vertices_m, VIEW_DEGREES[VIEWS.index(record["view"])])
        placed_m = vertices_m + np.array([0, 0, record["distance_mm"] / MM_PER_M])
        hits = TracedObject(solid, placed_m).primary(PixelRays.of(dataset.rig.camera))
        _, seen, hit = np.intersect1d(pixels, hits.pixels, assume_unique=True, return_indices=True)
        same = np.abs(hits.depth_m[hit] - depth_m[seen]) < _SAME_SURFACE_M
        normals[seen[same]] = hits.normals[hit[same]]
        depth_m[seen[same]] = hits.depth_m[hit[same]]  # the stored depth is rounded to float32
    return Surface(pixels, x.ravel()[pixels], y.ravel()[pixels], depth_m, normals)


def normals_of_depth(depth_mm: NDArray[np.float64], x: NDArray, y: NDArray) -> NDArray[np.float64]:
    """Unit normals (H W, 3) toward the camera of a depth map (H, W), 0 = background, from differences between
    neighbouring object pixels; a pixel without neighbours gets (0, 0, -1)."""
    inside = object_mask(depth_mm)
    points = np.stack([x, y, np.ones_like(x)], axis=-1) * depth_mm[..., None]
    tangents = []
    for axis in (1, 0):
        ends = []
        for step, edge in ((-1, -1), (1, 0)):
            has = np.roll(inside, step, axis)
            np.moveaxis(has, axis, 0)[edge] = False  # np.roll wraps around the image's edge
            ends.append(np.where(has[..., None], np.roll(points, step, axis), points))
        tangents.append(ends[0] - ends[1])
    normals = np.cross(tangents[1], tangents[0]).reshape(-1, 3)
    lengths = np.linalg.norm(normals, axis=1)
    defined = inside.ravel() & (lengths > 0)
    normals[defined] /= lengths[defined, None]
    normals[~defined] = (0.0, 0.0, -1.0)
    return normals


def plane(
    rig: Rig, distance_m: float, tilt_deg: tuple[float, float] = (0.0, 0.0), mask: NDArray[np.bool_] | None = None
) -> Surface:
    """A plane that crosses the camera's axis at ``distance_m``, tilted by ``tilt_deg`` so that it recedes to the right
    and downward. It fills the frame, or is cut to ``mask`` (H, W)."""
    x, y = (rays.ravel() for rays in rig.camera.rays())
    across, down = np.tan(np.deg2rad(tilt_deg))
    pixels = np.arange(x.size) if mask is None else np.flatnonzero(mask)
    x, y = x[pixels], y[pixels]
    depth_m, normal = distance_m / (1 - across * x - down * y), np.array([across, down, -1.0])
    return Surface(pixels, x, y, depth_m, np.tile(normal / np.linalg.norm(normal), (pixels.size, 1)))


MovedPhase = Direction | Literal["crossed"]
"""Whose phase a move is measured in: the fringes of a direction, or the carrier of crossed frames that changes faster
with depth. The surface itself is moved, so every fringe on it moves as it must."""


def layer_of(rig: Rig, phase: MovedPhase, rays: Maps | None = None) -> CalibrationLayer:
    """The calibration layer of `MovedPhase` for a rig, at all pixels or at normalised ``rays`` (x, y). Raises
    `DiagnosisError` for crossed fringes of a rig without them."""
    if phase != "crossed":
        return CalibrationLayer.of(rig, phase, rays)
    if rig.crossed is None:
        raise DiagnosisError("crossed: this rig projects no crossed frames whose phase could be moved")
    carriers = [CalibrationLayer.of_carrier(rig, cycles, rays) for cycles in rig.crossed.cycles_per_px]
    return max(carriers, key=lambda layer: float(np.median(np.abs(layer.gain))))


def moved(surface: Surface, rig: Rig, direction: MovedPhase, field: Field, amplitude_rad: float = 1.0) -> Surface:
    """``surface`` moved along the camera's rays so that the phase of ``direction`` changes by ``amplitude_rad`` times
    ``field``, with its new normals; the outline stays."""

    def moved_m(x: NDArray[np.float64], y: NDArray[np.float64], depth_m: NDArray[np.float64]) -> NDArray[np.float64]:
        layer = layer_of(rig, direction, (x, y))
        phase = layer.absolute_phase(depth_m * MM_PER_M) + amplitude_rad * field(x, y)
        return layer.depth_of_residual_mm(phase - layer.infinity_rad - TAU * layer.infinity_order) / MM_PER_M

    new_m = moved_m(surface.x, surface.y, surface.depth_m)
    rays = np.column_stack([surface.x, surface.y, np.ones_like(surface.x)])
    facing = np.einsum("ij,ij->i", surface.normals, rays)
    usable = np.abs(facing) > _GRAZING * np.linalg.norm(rays, axis=1)
    gradient = []
    for axis in (0, 1):
        # The tangent plane gives the depth on a neighbouring ray, which is moved in the same way as the pixel.
        x, y = surface.x + _STEP * (axis == 0), surface.y + _STEP * (axis == 1)
        facing_beside = np.where(usable, facing + _STEP * surface.normals[:, axis], 1.0)
        beside_m = np.where(usable, surface.depth_m * facing / facing_beside, surface.depth_m)
        gradient.append((moved_m(x, y, beside_m) - new_m) / _STEP)
    across, down = gradient
    # Z(x, y) has the normal (Z_x, Z_y, -(Z + x Z_x + y Z_y)), up to its length.
    normals = np.column_stack([across, down, -(new_m + surface.x * across + surface.y * down)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(usable[:, None] & np.isfinite(normals), normals, surface.normals)
    return Surface(surface.pixels, surface.x, surface.y, new_m, normals)


Projected = Literal["sequence", "no fringe inside", "no fringe outside", "other direction", "other pitch"]
PITCH_FACTOR = 4 / 3  # factor of the changed pitch: 18 px become 24


@dataclass(frozen=True)
class Scene:
    """Lit pixels in front of the empty scene, and the pattern that is projected on them. ``pixels`` uint32 (n,), with
    ``lit`` in the same order. ``mask`` bool (H, W): the object mask for methods that use it. ``stream``: key of the
    noise. With ``no fringe`` the mean light of the sequence is projected. The other direction of crossed fringes has
    both angles mirrored; turned by 90 degrees, a square pair would be itself."""

    pixels: NDArray[np.uint32]
    lit: LitPixels
    mask: NDArray[np.bool_]
    stream: tuple[object, ...]
    projected: Projected = "sequence"


def direct_light(light: Light) -> Light:
    """What a surface without a mesh or pixels around it can show of ``light``: no further bounces, shadows, gloss,
    albedo maps, lens or movement, and one exposure, the middle of a range; ambient light is that in the open. A
    camera pixel's width still blurs the pattern where the light has pixels with an area."""
    exposure = light.camera.exposure
    middle = float(np.sqrt(exposure[0] * exposure[1])) if isinstance(exposure, tuple) else exposure
    return (
        light.changed(motion_mm=0.0, calibration_px=0.0)
        .changed("surface", gloss=0.0, textures="none")
        .changed("bounces", interreflection=False, ambient_occlusion=False, shadows=False)
        .changed("camera", blur_px=0.0, falloff=0, exposure=middle)
    )


class SceneRenderer:
    """Renders scenes with the direct light, sensor and empty background of a rig; keeps the last backgrounds."""

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
        """With the pattern ``sequence``, its mean light (``uniform``), ``other pitch`` or ``other direction``; kept."""
        rig, pair = self.rig, self.rig.crossed
        if pattern == "other pitch":
            names = ("pitch_horizontal_px", "pitch_vertical_px")
            rig = replace(rig, **{name: PITCH_FACTOR * getattr(rig, name) for name in names})
        if pair is not None and pattern.startswith("other"):
            key, factor = ("pitches_px", PITCH_FACTOR) if pattern == "other pitch" else ("angles_deg", -1)
            first, second = getattr(pair, key)
            rig = rig.with_crossed(replace(pair, **{key: (factor * first, factor * second)}))
        exposure = Exposure.of(rig, self.lamp)
        return replace(exposure, pattern=exposure.pattern.uniform(rig)) if pattern == "uniform" else exposure

    @cached_property
    def _empty(self) -> LitPixels:
        x, y = (rays.ravel() for rays in self.rig.camera.rays())
        points_m = np.column_stack([x, y, np.ones_like(x)]) * self.rig.background
        return self._lit(points_m, np.broadcast_to([0.0, 0.0, -1.0], points_m.shape))

    def light(self, surface: Surface) -> LitPixels:
        """The direct light on ``surface``."""
        return self._lit(surface.points_m(), surface.normals)

    def _lit(self, points_m: NDArray[np.float64], normals: NDArray[np.float64]) -> LitPixels:
        lit = light_surface(points_m, normals, self.rig, self.lamp, self._exposure("sequence").pattern)
        return lit.brighter(np.float32(self.lamp.camera.exposure))  # type: ignore[arg-type]  # direct light has one

    def frames(self, scene: Scene, indices: Sequence[int], masked: bool = False) -> list[NDArray[np.uint8] | None]:
        """Frames ``indices`` of ``scene``, uint8 (H, W), by number, else None; ``masked``: 0 outside ``scene.mask``."""
        turned = scene.projected == "other direction"
        other = scene.projected == "other pitch" or (turned and self.rig.crossed is not None)
        usual: str = scene.projected if other else "sequence"
        inside, outside = (
            "uniform" if scene.projected == f"no fringe {where}" else usual for where in ("inside", "outside")
        )
        projected_indices = [self._partner(index) if turned else index for index in indices]
        object_values = self._exposure(inside).expose(projected_indices, scene.lit, scene.pixels, scene.stream)
        frames: list[NDArray[np.uint8] | None] = [None] * len(self.rig.sequence)
        for index, projected_index, values in zip(indices, projected_indices, object_values, strict=True):
            image = self._background(scene.stream, projected_index, outside).copy()
            image.ravel()[scene.pixels] = values
            frames[index] = image * scene.mask if masked else image
        return frames

    def decoded_mm(self, scene: Scene) -> NDArray[np.float32]:
        """Depth (H, W) in mm decoded from the whole sequence on the scene's pixels, as a dataset's is; 0 beyond."""
        seen = np.zeros(self.shape, dtype=bool)
        seen.ravel()[scene.pixels] = True
        frames = np.stack(self.frames(scene, range(len(self.rig.sequence))))  # type: ignore[arg-type]  # all are asked
        return decode_stack(frames, self.rig, direction="both", mask=seen, reasons=False).depth_mm

    @lru_cache(maxsize=128)  # noqa: B019  # two patterns of a sample's frames
    def _background(self, stream: tuple[object, ...], index: int, pattern: str) -> NDArray[np.uint8]:
        pixels = np.arange(self.shape[0] * self.shape[1], dtype=np.uint32)
        return self._exposure(pattern).expose([index], self._empty, pixels, stream)[0].reshape(self.shape)

    def _partner(self, index: int) -> int:
        """The frame of the other direction with the same step or bit; black and white frames map to themselves."""
        sequence, frame = self.rig.sequence, self.rig.sequence.frames[index]
        if frame.direction is None:
            return index
        frames_of = sequence.sinusoids if frame.kind == "sinusoid" else sequence.gray
        others = frames_of("vertical" if frame.direction == "horizontal" else "horizontal")
        return others[min(frame.step, len(others) - 1)]
