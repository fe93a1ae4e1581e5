"""Small surface elements of an object, and which of them see which: the geometry of light between
its parts.

A surfel is the surface inside one cell of a grid, with the normals of one of six directions, and
inside one of the cell's slabs across that direction, so that the steps of a surface are apart. Form
factors are the shares of cosine-weighted rays from surfel i that meet surfel j (Cohen and Wallace
1993, Radiosity and Realistic Image Synthesis, chapter 4). All of it is in object coordinates, once
an object, for all of its views. The rays' directions are a fixed sequence, so the same object gives
the same bits.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from fpp_ml_bench.constants import GOLDEN, PLASTIC
from fpp_ml_bench.loaders.render.raycast import TracedObject
from fpp_ml_bench.loaders.render.scene import SolidMesh
from fpp_ml_bench.machine import njit
from fpp_ml_bench.portable import cosine_of_turns, dot, sine_of_turns

POINTS = 1 << 15
"""Points on the surface that carry the projector's light into the surfels: several of each."""
SURFELS = 3000
"""Aimed at on flat ground; an object has up to three times as many, by its slopes and steps."""
RAYS = 64
"""From each surfel. A point's light comes from several surfels, so their noise is small
(docs/light.md)."""
_PLASTIC_SQUARED = 0.5698402909980532
"""Square of `PLASTIC`: the second of two steps that spread points evenly over a square."""
_OFFSET_M = 1e-5
"""Distance in m by which a ray starts off its surfel, so that it does not meet its own surface by
rounding."""
OFF_PLANE = 15.0
"""Distance along the normal counts four times: a surfel on another step is not beside the point."""
SIDES = 6
"""Directions that a surfel of a cell may face: along and against each axis. Surfaces back to back
do not share one."""
SLABS = 4
"""Layers of a cell across the side that its surfels face, so that close steps of a surface do not
share one."""


class SurfacePoints(NamedTuple):
    """Points spread evenly over an object: ``position_m`` and unit ``normal`` float64 (P, 3),
    sorted by the surfel that each belongs to: those of surfel k are ``starts[k]:starts[k + 1]``,
    int64 (K + 1,). ``triangle`` int64 (P,): the rows of the mesh's faces that they lie on."""

    position_m: NDArray[np.float64]
    normal: NDArray[np.float64]
    starts: NDArray[np.int64]
    triangle: NDArray[np.int64]

    def mean(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean of values (P, ...) over each surfel's points, (K, ...)."""
        counts = np.diff(self.starts).reshape(-1, *[1] * (values.ndim - 1))
        return np.add.reduceat(values, self.starts[:-1], axis=0) / counts


class SurfelGrid(NamedTuple):
    """Finds surfels by place: ``table`` int32 (X, Y, Z, 2), the first of each cell's and the one
    after its last; cells of ``cell_m`` from ``corner_m`` (3,) on; of each surfel the mean
    ``position_m`` and ``normal`` (K, 3), and its ``area_m2``."""

    corner_m: NDArray[np.float64]
    cell_m: float
    table: NDArray[np.int32]
    position_m: NDArray[np.float64]
    normal: NDArray[np.float64]
    area_m2: NDArray[np.float64]


@dataclass(frozen=True)
class Surfels:
    """An object's surfels with their ``form_factors``, a sparse float64 (K, K): row k has the
    shares of surfel k's rays that meet each other surfel. ``open_directions`` float64 (E, 3) are
    those of the rays that leave the object, sorted by surfel: ``open_starts`` int64 (K + 1,); each
    carries 1 / `RAYS` of its surfel's hemisphere."""

    points: SurfacePoints
    grid: SurfelGrid
    form_factors: csr_array
    open_starts: NDArray[np.int64]
    open_directions: NDArray[np.float64]

    @property
    def open_share(self) -> NDArray[np.float64]:
        """The share of each surfel's hemisphere, by cosine, that the object leaves open; float64
        (K,)."""
        return np.diff(self.open_starts) / RAYS

    @classmethod
    def of(cls, mesh: SolidMesh) -> "Surfels":
        """The surfels of ``mesh``. A mesh that does not enclose a volume has them on both of its
        sides."""
        traced = TracedObject(mesh, mesh.vertices_m)
        points, grid = place_surfels(_sides(mesh), len(mesh.faces))
        count = len(grid.area_m2)
        turn = np.arange(count) * GOLDEN
        disk = np.arange(RAYS) * GOLDEN
        height = (np.arange(RAYS) + 0.5) / RAYS
        radius = np.sqrt(height)
        local = np.column_stack(
            [radius * cosine_of_turns(disk), radius * sine_of_turns(disk), np.sqrt(1.0 - height)]
        )
        origin_m, direction = aim_rays(points, local, cosine_of_turns(turn), sine_of_turns(turn))
        reach_m = float(np.sqrt((np.ptp(mesh.vertices_m, axis=0) ** 2).sum())) + 1.0
        way = reach_m * direction
        along, triangle = traced.met(origin_m, origin_m + way)
        facing, hit = traced.normals[triangle], triangle >= 0
        behind = dot(facing, way) > 0.0
        target: NDArray[np.int32] = np.full(len(along), -1, dtype=np.int32)
        place_m = origin_m + along[:, None] * way
        assign_hits(
            place_m, np.where(behind[:, None], -facing, facing), np.flatnonzero(hit), grid, target
        )
        target = target.reshape(count, RAYS)
        left = target < 0
        open_starts = np.concatenate([[0], np.cumsum(left.sum(axis=1))])
        row, meeting = np.nonzero(~left)
        entries = (
            np.full(row.size, 1 / RAYS),
            (row, target[row, meeting]),
        )  # those at one place are added up
        return cls(
            points,
            grid,
            csr_array(entries, shape=(count, count)),
            open_starts,
            direction[left.ravel()],
        )


def _sides(mesh: SolidMesh) -> NDArray[np.float64]:
    """Corners float64 (F, 3, 3) of triangles whose normals point out; of a surface with a border,
    both sides."""
    corners = mesh.vertices_m[mesh.faces]
    edges = np.concatenate([mesh.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]).astype(
        np.int64
    )
    forward = edges[:, 0] * len(mesh.vertices_m) + edges[:, 1]
    backward = edges[:, 1] * len(mesh.vertices_m) + edges[:, 0]
    if not np.array_equal(np.sort(forward), np.sort(backward)):
        return np.concatenate([corners, corners[:, ::-1]])
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    volume = (a * np.cross(b, c)).sum()
    return corners if volume > 0 else corners[:, ::-1]


def place_surfels(
    corners: NDArray[np.float64], faces: int | None = None
) -> tuple[SurfacePoints, SurfelGrid]:
    """Points spread over the triangles ``corners`` (F, 3, 3) by area, and the surfels that they
    make. After ``faces`` triangles the same ones come again, from behind."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double = np.sqrt(dot(normal, normal))
    behind = np.cumsum(double / 2)
    area_m2 = float(behind[-1])
    number = np.arange(POINTS)
    triangle = np.minimum(
        np.searchsorted(behind, (number + 0.5) * (area_m2 / POINTS), "right"), len(corners) - 1
    )
    first, second = np.sqrt((0.5 + number * PLASTIC) % 1.0), (0.5 + number * _PLASTIC_SQUARED) % 1.0
    weights = np.stack([1.0 - first, first * (1.0 - second), first * second], axis=1)
    position = dot(weights[..., None], corners[triangle])
    facing = normal[triangle] / double[triangle, None]
    cell_m = (
        float(np.sqrt(area_m2 / SURFELS)) * 1.2
    )  # a cell holds 1.2^2 times its cross-section of slanted surface
    corner = corners.reshape(-1, 3).min(axis=0) - cell_m
    shape = tuple(
        int(n) for n in np.ceil((corners.reshape(-1, 3).max(axis=0) - corner) / cell_m) + 1
    )
    cell = np.floor((position - corner) / cell_m).astype(np.int64)
    steepest = np.abs(facing).argmax(axis=1)
    side = 2 * steepest + (facing[number, steepest] < 0)
    across = ((position - corner) / cell_m)[number, steepest]
    slab = np.floor((across - np.floor(across)) * SLABS).astype(np.int64)
    key = np.ravel_multi_index((*cell.T, side, slab), (*shape, SIDES, SLABS))
    order = np.argsort(key, kind="stable")
    keys, starts = np.unique(key[order], return_index=True)
    points = SurfacePoints(
        position[order],
        facing[order],
        np.append(starts, POINTS),
        triangle[order] % (faces or len(corners)),
    )
    mean_normal = points.mean(points.normal)
    mean_normal /= np.sqrt((mean_normal * mean_normal).sum(axis=1))[:, None]
    bounds = np.arange(np.prod(shape) + 1) * (SIDES * SLABS)
    first = np.searchsorted(keys, bounds).astype(np.int32)
    table = np.stack([first[:-1], first[1:]], axis=-1).reshape(*shape, 2)
    area = np.diff(points.starts) * (area_m2 / POINTS)
    return points, SurfelGrid(
        corner, cell_m, table, points.mean(points.position_m), mean_normal, area
    )


def aim_rays(
    points: SurfacePoints,
    local: NDArray[np.float64],
    cosine: NDArray[np.float64],
    sine: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays of every surfel from its points: their origins and directions, float64 (K RAYS, 3) each.

    ``local`` (RAYS, 3): directions about z; of surfel k they are turned by (``cosine[k]``,
    ``sine[k]``) about the normal. Frame about a normal: Duff et al. 2017, Building an Orthonormal
    Basis, Revisited.
    """
    point = (points.starts[:-1, None] + np.arange(RAYS) % np.diff(points.starts)[:, None]).ravel()
    normal = points.normal[point]
    nx, ny, nz = normal.T
    sign = np.where(nz >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    x = (local[:, 0] * cosine[:, None] - local[:, 1] * sine[:, None]).ravel()
    y = (local[:, 0] * sine[:, None] + local[:, 1] * cosine[:, None]).ravel()
    z = np.tile(local[:, 2], len(cosine))
    across = x * (1.0 + sign * nx * nx * a) + y * b + z * nx
    down = x * (sign * b) + y * (sign + ny * ny * a) + z * ny
    direction = np.column_stack([across, down, -x * (sign * nx) - y * ny + z * nz])
    return points.position_m[point] + _OFFSET_M * normal, direction


@njit
def assign_hits(place, facing, rays, grid, target):  # type: ignore[no-untyped-def]
    """The surfel of a `SurfelGrid` that each of the ``rays`` (m,) meets at its ``place`` (n, 3),
    the nearest one with the normal that is ``facing`` (n, 3) the ray there: fills ``target``
    (n,)."""
    corner, cell, table, position, normal = (
        grid.corner_m,
        grid.cell_m,
        grid.table,
        grid.position_m,
        grid.normal,
    )
    for i in rays:
        x, y, z = place[i, 0], place[i, 1], place[i, 2]
        nx, ny, nz = facing[i, 0], facing[i, 1], facing[i, 2]
        cx, cy, cz = (
            int((x - corner[0]) / cell),
            int((y - corner[1]) / cell),
            int((z - corner[2]) / cell),
        )
        best = np.inf
        for around in range(2):  # where no point fell into this cell, the cells about it
            for jx in range(max(cx - around, 0), min(cx + around + 1, table.shape[0])):
                for jy in range(max(cy - around, 0), min(cy + around + 1, table.shape[1])):
                    for jz in range(max(cz - around, 0), min(cz + around + 1, table.shape[2])):
                        for k in range(table[jx, jy, jz, 0], table[jx, jy, jz, 1]):
                            if normal[k, 0] * nx + normal[k, 1] * ny + normal[k, 2] * nz < 0.3:
                                continue
                            ex, ey, ez = position[k, 0] - x, position[k, 1] - y, position[k, 2] - z
                            off = ex * nx + ey * ny + ez * nz
                            apart = ex * ex + ey * ey + ez * ez + OFF_PLANE * off * off
                            if apart < best:
                                best, target[i] = apart, k
            if target[i] >= 0:
                break
