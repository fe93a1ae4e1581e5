"""Primary rays through Embree: which pixel sees which triangle, and the exact depth and normal there.

Embree answers in float32; it is only asked for the triangle. Depth comes from that triangle's plane in float64.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import MeshError
from fpp_ml_bench.loaders.scene import SolidMesh
from fpp_ml_bench.skipping import skipping_enabled

_SHADOW_OFFSET_M = 1e-4


@dataclass(frozen=True)
class Hits:
    """Pixels that see the object: flat ``pixels`` int64 (n,), ``depth_m`` float64 (n,), ``normals`` float64 (n, 3).

    Normals are unit vectors turned toward the camera, so a mesh with flipped triangles shades like one without.
    ``rays`` counts the primary rays that may hit the object: those that are traced, unless skipping is switched off.
    """

    pixels: NDArray[np.int64]
    depth_m: NDArray[np.float64]
    normals: NDArray[np.float64]
    rays: int


class TracedObject:
    """One placed object, ready for rays: ``vertices_m`` (V, 3) in camera coordinates."""

    def __init__(self, mesh: SolidMesh, vertices_m: NDArray[np.float64]) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        corners = vertices_m[mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        solid = lengths > 0
        if not solid.any():
            raise MeshError(f"object {mesh.name!r} has no triangle with an area")
        self._faces = np.ascontiguousarray(mesh.faces[solid], dtype=np.int32)
        self._normals = normals[solid] / lengths[solid, None]
        self._offsets = np.einsum("ij,ij->i", self._normals, corners[solid, 0])
        self._depth_bounds = corners[solid, :, 2].min(axis=1), corners[solid, :, 2].max(axis=1)
        self._vertices_m = vertices_m
        self._scene = rtcore_scene.EmbreeScene()
        # The scene keeps no reference of its own to the mesh.
        self._triangles = TriangleMesh(self._scene, vertices_m.astype(np.float32), self._faces)

    def _first(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.int32]:
        if len(origins) == 0:
            return np.empty(0, dtype=np.int32)
        return self._scene.run(origins, directions)

    def primary(self, rays_x: NDArray[np.float64], rays_y: NDArray[np.float64]) -> Hits:
        """Trace the camera's rays, undistorted normalised coordinates (H, W); NaN rays see nothing."""
        x, y = rays_x.ravel(), rays_y.ravel()
        wanted = self._may_hit(x, y)
        rays = int(wanted.size)
        if not skipping_enabled():
            wanted = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
        directions = np.column_stack([x[wanted], y[wanted], np.ones(wanted.size)])
        triangle = self._first(np.zeros((wanted.size, 3), dtype=np.float32), directions.astype(np.float32))
        seen = triangle >= 0
        pixels, triangle, directions = wanted[seen], triangle[seen], directions[seen]
        normals = self._normals[triangle]
        facing = np.einsum("ij,ij->i", normals, directions)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth_m = self._offsets[triangle] / facing
        # Seen exactly edge-on the plane gives no depth; the triangle itself still bounds it.
        lowest, highest = self._depth_bounds[0][triangle], self._depth_bounds[1][triangle]
        depth_m = np.where(np.isfinite(depth_m), np.clip(depth_m, lowest, highest), lowest)
        normals = np.where((facing > 0)[:, None], -normals, normals)
        return Hits(pixels=pixels, depth_m=depth_m, normals=normals, rays=rays)

    def _may_hit(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.int64]:
        """Flat indices of rays inside the object's bounding box in normalised coordinates: the others can't hit it."""
        usable = np.isfinite(x) & np.isfinite(y)
        z = self._vertices_m[:, 2]
        if z.min() > 0:
            # Every triangle projects into the hull of its vertices; the hair's breadth covers Embree's float32.
            slack = 1e-6
            for rays, across in ((x, self._vertices_m[:, 0] / z), (y, self._vertices_m[:, 1] / z)):
                usable &= (rays >= across.min() - slack) & (rays <= across.max() + slack)
        return np.flatnonzero(usable)

    def may_shadow(self, from_light_m: NDArray[np.float64], light_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points the object can hide from the light at ``light_m`` (3,); bool (n,).

        ``from_light_m`` float64 (3, n): from the light to each point, along the camera's axes. Points outside the
        object's bounding box as the light sees it lie on lines that miss the object.
        """
        x, y, z = from_light_m
        around = self._vertices_m - light_m
        if around[:, 2].min() <= 0:
            return np.ones(z.size, dtype=bool)
        possible, slack = z > 0, 1e-5  # Embree's float32 moves a ray by about a micrometre
        for along, across in ((x, around[:, 0] / around[:, 2]), (y, around[:, 1] / around[:, 2])):
            possible &= (along >= (across.min() - slack) * z) & (along <= (across.max() + slack) * z)
        return possible

    def shadowed(self, points_m: NDArray[np.float64], light_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which surface points (n, 3) the object itself hides from the light at ``light_m`` (3,); bool (n,)."""
        toward = light_m - points_m
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        origins = points_m + _SHADOW_OFFSET_M * toward
        return self._first(origins.astype(np.float32), toward.astype(np.float32)) >= 0
