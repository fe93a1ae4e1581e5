"""The surface that each pixel sees: a dataset's sample, a surface moved along the camera's rays, or a plane."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route import TAU, CalibrationLayer
from fpp_ml_bench.constants import MM_PER_M, VIEW_DEGREES, VIEWS
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.loaders.render import MESH_FOLDER, PixelRays, TracedObject, UserMesh, load_user_mesh, turned
from fpp_ml_bench.loaders.sample import DEPTH, DEPTH_EXACT
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.optics import Direction, Rig

Field = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""A smooth function of normalised ray coordinates x, y (n,), with values (n,)."""

_STEP = 1e-6
"""Step of difference quotients in normalised ray coordinates: far below a pixel, far above rounding."""
_SAME_SURFACE_M = 1e-3
"""A traced depth that differs from the stored depth by more belongs to another triangle."""
_GRAZING = 0.02
"""Smallest cosine between ray and normal at which the tangent plane is extrapolated to a neighbouring ray."""


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

    def at(self, chosen: NDArray) -> "Surface":
        """The part at ``chosen``, a mask (n,) or indices (k,)."""
        return Surface(self.pixels[chosen], self.x[chosen], self.y[chosen], self.depth_m[chosen], self.normals[chosen])

    def depth_mm(self, shape: tuple[int, int]) -> NDArray[np.float64]:
        """Depth map (H, W) in mm, 0 outside the surface."""
        whole = np.zeros(shape[0] * shape[1])
        whole[self.pixels] = self.depth_m * MM_PER_M
        return whole.reshape(shape)


def surface_of_sample(dataset: DatasetFolder, sample: str) -> Surface:
    """The object of ``sample``: exact depth where the dataset has it, else the decoded depth.

    Normals come from the mesh in a built dataset. Without a mesh (an imported dataset), and at pixels whose ray misses
    it, they come from the depth map.
    """
    depth_mm = dataset.depth_mm(sample, DEPTH_EXACT if dataset.has_exact else DEPTH).astype(np.float64)
    x, y = dataset.rig.camera.rays()
    pixels = np.flatnonzero(object_mask(depth_mm))
    normals, depth_m = normals_of_depth(depth_mm, x, y)[pixels], depth_mm.ravel()[pixels] / MM_PER_M
    record = dataset.measured(sample)
    mesh_file = dataset.path / MESH_FOLDER / f"{record['object']}.ply"
    if mesh_file.is_file() and record.get("distance_mm") is not None:
        solid = load_user_mesh(UserMesh(mesh_file.stem, str(mesh_file), centre=False))
        vertices_m = turned(solid.vertices_m, VIEW_DEGREES[VIEWS.index(record["view"])])
        placed_m = vertices_m + np.array([0, 0, record["distance_mm"] / MM_PER_M])
        hits = TracedObject(solid, placed_m).primary(PixelRays.of(dataset.rig.camera))
        hit_index = np.full(x.size, -1)
        hit_index[hits.pixels] = np.arange(hits.pixels.size)
        traced = hit_index[pixels] >= 0
        traced[traced] = np.abs(hits.depth_m[hit_index[pixels[traced]]] - depth_m[traced]) < _SAME_SURFACE_M
        normals[traced] = hits.normals[hit_index[pixels[traced]]]
        depth_m[traced] = hits.depth_m[hit_index[pixels[traced]]]  # the stored depth is rounded to float32
    return Surface(pixels, x.ravel()[pixels], y.ravel()[pixels], depth_m, normals)


def normals_of_depth(depth_mm: NDArray[np.float64], x: NDArray, y: NDArray) -> NDArray[np.float64]:
    """Unit normals (H W, 3) toward the camera of a depth map (H, W), 0 = background.

    They come from differences between neighbouring object pixels; a pixel without neighbours gets (0, 0, -1).
    """
    inside = object_mask(depth_mm)
    points = np.stack([x, y, np.ones_like(x)], axis=-1) * depth_mm[..., None]
    tangents = []
    for axis in (1, 0):
        ahead, behind = np.roll(points, -1, axis), np.roll(points, 1, axis)
        has_ahead, has_behind = np.roll(inside, -1, axis), np.roll(inside, 1, axis)
        np.moveaxis(has_ahead, axis, 0)[-1] = False  # np.roll wraps around the image's edge
        np.moveaxis(has_behind, axis, 0)[0] = False
        ahead = np.where(has_ahead[..., None], ahead, points)
        behind = np.where(has_behind[..., None], behind, points)
        tangents.append(ahead - behind)
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
    depth_m = distance_m / (1 - across * x - down * y)
    normal = np.array([across, down, -1.0])
    return Surface(pixels, x, y, depth_m, np.tile(normal / np.linalg.norm(normal), (pixels.size, 1)))


def moved(surface: Surface, rig: Rig, direction: Direction, shift_rad: Field) -> Surface:
    """``surface`` moved along the camera's rays so that the phase of ``direction`` changes by ``shift_rad``.

    Each pixel keeps its ray, so the outline stays. Normals are those of the moved surface.
    """
    new_m = _moved_m(surface.x, surface.y, surface.depth_m, rig, direction, shift_rad)
    rays = np.column_stack([surface.x, surface.y, np.ones_like(surface.x)])
    facing = np.einsum("ij,ij->i", surface.normals, rays)
    usable = np.abs(facing) > _GRAZING * np.linalg.norm(rays, axis=1)
    gradient = []
    for axis in (0, 1):
        # The tangent plane gives the depth on a neighbouring ray, which is moved in the same way as the pixel.
        x, y = surface.x + _STEP * (axis == 0), surface.y + _STEP * (axis == 1)
        facing_beside = np.where(usable, facing + _STEP * surface.normals[:, axis], 1.0)
        beside_m = np.where(usable, surface.depth_m * facing / facing_beside, surface.depth_m)
        gradient.append((_moved_m(x, y, beside_m, rig, direction, shift_rad) - new_m) / _STEP)
    across, down = gradient
    # Z(x, y) has the normal (Z_x, Z_y, -(Z + x Z_x + y Z_y)), up to its length.
    normals = np.column_stack([across, down, -(new_m + surface.x * across + surface.y * down)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(usable[:, None] & np.isfinite(normals), normals, surface.normals)
    return Surface(surface.pixels, surface.x, surface.y, new_m, normals)


def _moved_m(
    x: NDArray, y: NDArray, depth_m: NDArray, rig: Rig, direction: Direction, shift_rad: Field
) -> NDArray[np.float64]:
    layer = CalibrationLayer.of(rig, direction, (x, y))
    phase = layer.absolute_phase(depth_m * MM_PER_M) + shift_rad(x, y)
    residual = phase - layer.infinity_rad - TAU * layer.infinity_order
    depth: NDArray[np.float64] = layer.depth_of_residual_mm(residual) / MM_PER_M
    return depth
