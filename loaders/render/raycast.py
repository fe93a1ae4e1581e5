"""Which pixel sees which triangle of an object, the exact depth and normal there, and what lies in
shadow.

The camera's rays go through a depth buffer over the pixels' own rays, any other ray through a box
tree (`ray_kernels.py`).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import MeshError
from fpp_ml_bench.loaders.render.ray_kernels import SLACK, build_tree, nearest_hit, rasterise
from fpp_ml_bench.loaders.render.scene import SolidMesh
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.portable import dot

LEAF = 4
"""Most triangles in a leaf of the box tree."""
_SHADOW_OFFSET_M = 1e-4
"""Distance in m by which a ray to the light starts off its surface, so that it does not meet that
surface itself by rounding."""


@dataclass(frozen=True)
class Hits:
    """Pixels that see the object: flat ``pixels`` int64 (n,) ascending, ``depth_m`` float64 (n,),
    ``normals`` float64 (n, 3), unit vectors turned toward the camera, so that a mesh with flipped
    triangles shades like one without, and ``triangle`` int32 (n,), rows of the mesh's faces."""

    pixels: NDArray[np.int64]
    depth_m: NDArray[np.float64]
    normals: NDArray[np.float64]
    triangle: NDArray[np.int32]


class PixelRays:
    """The rays of an image: ``x`` and ``y`` float64 (H, W), undistorted normalised coordinates, NaN
    without a ray.

    ``columns`` float64 (2, W): the greatest x up to each column, and the least x from it on;
    ``rows`` (2, H) for y.
    """

    def __init__(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
        self.x, self.y = np.ascontiguousarray(x), np.ascontiguousarray(y)
        self.columns, self.rows = _bounds(self.x, 0), _bounds(self.y, 1)

    @staticmethod
    @lru_cache(maxsize=2)
    def of(camera: Pinhole) -> "PixelRays":
        """The rays of a camera; those of the two latest cameras are kept."""
        return PixelRays(*camera.rays())


def _bounds(rays: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    greatest = np.fmax.reduce(rays, axis=axis, initial=-np.inf)  # of those that are not NaN
    least = np.fmin.reduce(rays, axis=axis, initial=np.inf)
    return np.stack([np.maximum.accumulate(greatest), np.minimum.accumulate(least[::-1])[::-1]])


class TracedObject:
    """One placed object, ready for rays: ``vertices_m`` (V, 3) in camera coordinates. ``corners``
    float64 (F, 3, 3) and unit ``normals`` float64 (F, 3) are those of its triangles that have an
    area."""

    def __init__(self, mesh: SolidMesh, vertices_m: NDArray[np.float64]) -> None:
        corners = vertices_m[mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.sqrt(dot(normals, normals))
        solid = lengths > 0
        if not solid.any():
            raise MeshError(f"object {mesh.name!r} has no triangle with an area")
        self._row = np.flatnonzero(solid).astype(np.int32)
        self.corners = np.ascontiguousarray(corners[solid], dtype=np.float64)
        self.normals = normals[solid] / lengths[solid, None]
        self._offsets = dot(self.normals, self.corners[:, 0])
        self._vertices_m = vertices_m

    def primary(self, rays: PixelRays, wanted: NDArray[np.bool_] | None = None) -> Hits:
        """What the camera's rays meet first; with ``wanted`` bool (H, W) only those."""
        window = self._window(rays)
        (top, bottom), (left, right) = window
        shape = (max(bottom - top, 0), max(right - left, 0))
        depth_m, triangle = np.full(shape, np.inf), np.full(shape, -1, dtype=np.int32)
        if triangle.size:
            rasterise(
                self.corners,
                self.normals,
                self._offsets,
                rays.x,
                rays.y,
                rays.columns,
                rays.rows,
                left,
                top,
                np.ones(rays.x.shape, dtype=bool) if wanted is None else wanted,
                depth_m,
                triangle,
            )
        row, column = np.nonzero(triangle >= 0)
        seen = triangle[row, column]
        row, column = row + top, column + left
        normals = self.normals[seen]
        facing = (
            normals[:, 0] * rays.x[row, column]
            + normals[:, 1] * rays.y[row, column]
            + normals[:, 2]
        )
        return Hits(
            pixels=row * rays.x.shape[1] + column,
            depth_m=depth_m[row - top, column - left],
            normals=np.where((facing > 0)[:, None], -normals, normals),
            triangle=self._row[seen],
        )

    def _window(self, rays: PixelRays) -> tuple[tuple[int, int], tuple[int, int]]:
        """First row and column, and those behind the last, of the box that the object can cover in
        the image."""
        z = self.corners[..., 2]
        if z.min() <= 0:
            return (0, rays.x.shape[0]), (0, rays.x.shape[1])
        spans = []
        for bounds, across in (
            (rays.rows, self.corners[..., 1] / z),
            (rays.columns, self.corners[..., 0] / z),
        ):
            first = np.searchsorted(bounds[0], across.min() - SLACK, "left")
            behind = np.searchsorted(bounds[1], across.max() + SLACK, "right")
            spans.append((int(first), int(behind)))
        return spans[0], spans[1]

    def may_shadow(
        self, from_light_m: NDArray[np.float64], light_m: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Which points the object can hide from the light at ``light_m`` (3,); bool (n,).

        ``from_light_m`` float64 (3, n): from the light to each point, along the camera's axes.
        Points outside the object's bounding box as the light sees it lie on lines that miss the
        object.
        """
        x, y, z = from_light_m
        around = self._vertices_m - light_m
        if around[:, 2].min() <= 0:
            return np.ones(z.size, dtype=bool)
        possible = z > 0
        for along, across in ((x, around[:, 0] / around[:, 2]), (y, around[:, 1] / around[:, 2])):
            possible &= (along >= (across.min() - SLACK) * z) & (
                along <= (across.max() + SLACK) * z
            )
        return possible

    def shadowed(
        self, points_m: NDArray[np.float64], light_m: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Which surface points (n, 3) the object itself hides from the light at ``light_m`` (3,);
        bool (n,)."""
        toward = light_m - points_m
        lengths = np.sqrt(dot(toward, toward))
        origins = points_m + toward * (_SHADOW_OFFSET_M / lengths)[:, None]
        return (
            self.met(origins, np.broadcast_to(light_m, points_m.shape), any_suffices=True)[1] >= 0
        )

    def met(
        self,
        origins_m: NDArray[np.float64],
        targets_m: NDArray[np.float64],
        any_suffices: bool = False,
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Where the lines from origins to targets, both (n, 3), first meet the object: the share of
        the way, float64 (n,), and the triangle as a row of ``corners``, int64 (n,), -1 for none.
        `nearest_hit` says more."""
        along, triangle = np.empty(len(origins_m)), np.empty(len(origins_m), dtype=np.int32)
        order, corners, starts, boxes = self._tree
        nearest_hit(corners, starts, boxes, origins_m, targets_m, any_suffices, along, triangle)
        return along, np.where(triangle >= 0, order[triangle], -1)

    @cached_property
    def _tree(
        self,
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
        """The order of the triangles in a box tree, their corners in it, where its leaves start,
        and its boxes."""
        count = len(self.corners)
        leaves = 1 << (-(-count // LEAF) - 1).bit_length()
        order, starts, boxes = (
            np.empty(count, np.int64),
            np.empty(leaves + 1, np.int64),
            np.empty((2 * leaves, 6)),
        )
        build_tree(self.corners, order, starts, boxes)
        return order, self.corners[order], starts, boxes
