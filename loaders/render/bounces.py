"""Further bounces: light that reaches a surface by way of other parts of the object, or of the
background plane.

Radiosity on surfels, ``E = E_plane + F rho (E_projector + E)`` for all patterns at once: light is
linear in the pattern, so one matrix of form factors F serves every column (Goral et al. 1984,
Modeling the Interaction of Light Between Diffuse Surfaces). E is irradiance, in units of the
projector's white on a surface that faces it at the near end of the range, and rho the albedo.
Surfaces are matte for this light. Between surfels E is interpolated by distance and normal, as an
irradiance cache does (Ward, Rubinstein and Clear 1988).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from fpp_ml_bench.loaders.render.illumination import projector_centre_m, shine
from fpp_ml_bench.loaders.render.light import Light
from fpp_ml_bench.loaders.render.projector import PatternLight
from fpp_ml_bench.loaders.render.scene import turned
from fpp_ml_bench.loaders.render.surfels import OFF_PLANE, RAYS, SIDES, SLABS, SurfelGrid, Surfels
from fpp_ml_bench.machine import njit
from fpp_ml_bench.optics.rig import Rig

SMALLEST = 2e-4
"""A bounce that adds less everywhere, a twentieth of a grey level, is the last."""
MOST_BOUNCES = 64
"""Most bounces that are followed: light falls by the albedo at each, so `SMALLEST` ends them
before."""
PLANE_CELLS = 24
"""Cells along the longer side of the plane's lit part: its light changes slowly."""
PLANE_POINTS = 6
"""Points across a cell at which its mean light is taken: several, so that fringes average out."""
_TOGETHER = 64
"""Points whose sums are kept until they are written at once, so that they stay in the cache."""
_MOST = 27 * SIDES * SLABS
"""Most surfels near a point: those of 3 x 3 x 3 cells, each with `SIDES` x `SLABS`."""


class PlaneLight(NamedTuple):
    """What the lit part of the background plane sends back in each frame: ``table`` float64 (Y, X,
    F), in cells of ``cell_m`` from ``corner_m`` (x, y) on, at ``distance_m``; camera
    coordinates."""

    table: NDArray[np.float64]
    corner_m: NDArray[np.float64]
    cell_m: float
    distance_m: float

    @classmethod
    def of(cls, rig: Rig, light: Light, pattern: PatternLight) -> "PlaneLight":
        """Of the plane square to the camera's axis, without an object before it."""
        u, v = np.meshgrid([-0.5, rig.projector.width - 0.5], [-0.5, rig.projector.height - 0.5])
        x, y = rig.projector.normalised(u.ravel(), v.ravel())
        centre = projector_centre_m(rig)
        way = np.column_stack([x, y, np.ones(4)])
        way = way[:, :1] * rig.R[0] + way[:, 1:2] * rig.R[1] + way[:, 2:] * rig.R[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (rig.background - centre[2]) / way[:, 2]
        across = centre[:2] + share[:, None] * way[:, :2]
        frames = len(pattern.table)
        if not (
            np.isfinite(across).all() and (share > 0).all()
        ):  # a projector that looks past the plane
            return cls(np.zeros((1, 1, frames)), np.zeros(2), 1.0, rig.background)
        corner, extent = across.min(axis=0), np.ptp(across, axis=0)
        cell = float(extent.max()) / PLANE_CELLS
        columns, rows = (max(int(np.ceil(length / cell)), 1) for length in extent)
        fine_x = corner[0] + (np.arange(columns * PLANE_POINTS) + 0.5) * (cell / PLANE_POINTS)
        fine_y = corner[1] + (np.arange(rows * PLANE_POINTS) + 0.5) * (cell / PLANE_POINTS)
        grid = np.stack(np.meshgrid(fine_x, fine_y), axis=-1).reshape(-1, 2)
        points = np.column_stack([grid, np.full(len(grid), rig.background)])
        arriving = shine(points, np.tile([0.0, 0.0, -1.0], (len(points), 1)), rig, light, pattern)
        table = pattern.read(arriving.place, arriving.irradiance)
        cells = table.reshape(frames, rows, PLANE_POINTS, columns, PLANE_POINTS).mean(axis=(2, 4))
        return cls(
            np.ascontiguousarray(np.moveaxis(cells, 0, 2)) * light.surface.wall_albedo,
            corner,
            cell,
            rig.background,
        )

    def upon(
        self, surfels: Surfels, degrees: float, offset_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Irradiance of an object's surfels from the plane, float64 (K, F), the object turned and
        then moved."""
        way = turned(surfels.open_directions, degrees)
        start = np.repeat(
            turned(surfels.grid.position_m, degrees) + offset_m,
            np.diff(surfels.open_starts),
            axis=0,
        )
        rows, columns, frames = self.table.shape
        with np.errstate(
            divide="ignore", invalid="ignore"
        ):  # of rays along the plane, which don't meet it
            share = (self.distance_m - start[:, 2]) / way[:, 2]
            across, down = (
                (start[:, i] + share * way[:, i] - self.corner_m[i]) / self.cell_m for i in (0, 1)
            )
        met = (way[:, 2] > 0) & (across >= 0) & (across < columns) & (down >= 0) & (down < rows)
        cell = down[met].astype(np.int64) * columns + across[met].astype(np.int64)
        starts = np.concatenate([[0], np.cumsum(met)])[surfels.open_starts]
        rays = csr_array(
            (np.full(cell.size, 1 / RAYS), cell, starts), shape=(len(starts) - 1, rows * columns)
        )
        return rays @ self.table.reshape(-1, frames)  # type: ignore[no-any-return]


def between_surfels(
    surfels: Surfels,
    direct: NDArray[np.float64],
    outside: NDArray[np.float64],
    albedo: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Irradiance of each surfel by bounces, float64 (K, F): ``outside`` and all that the object
    returns of its light.

    ``direct`` from the projector and ``outside`` from surfaces beyond the object, both float64 (K,
    F); ``albedo`` float64 (K,), below 1.
    """
    total = outside.copy()
    leaving = albedo[:, None] * (direct + outside)
    for _ in range(MOST_BOUNCES):
        arriving = surfels.form_factors @ leaving
        total += arriving
        if float(np.abs(arriving).max(initial=0.0)) < SMALLEST:
            break
        leaving = albedo[:, None] * arriving
    return total


def at_points(
    grid: SurfelGrid,
    values: NDArray[np.float64],
    position_m: NDArray[np.float64],
    normal: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Values of surfels (K, F) at surface points, float32 (F, n); 0 where no surfel is near.

    ``position_m`` and unit ``normal`` float64 (n, 3), object coordinates.
    """
    out = np.empty((values.shape[1], len(position_m)), dtype=np.float32)
    interpolate(grid, values, position_m, normal, out)
    return out


@njit
def mix_frames(modes, mix, factor, points, out):  # type: ignore[no-untyped-def]
    """Frames from modes: fills ``out`` float32 (F, N) at ``points`` int64 (n,) with ``factor`` (n,)
    times the product of ``mix`` (F, J) and ``modes`` (J, n), float32."""
    for frame in range(mix.shape[0]):
        target = out[frame]
        for j in range(mix.shape[1]):
            weight = mix[frame, j]
            if weight != 0.0:
                mode = modes[j]
                for i in range(points.size):
                    target[points[i]] += weight * mode[i] * factor[i]


@njit
def interpolate(grid, values, points, facing, out):  # type: ignore[no-untyped-def]
    """Weighted means of the surfels within a cell's width of each point: fills ``out`` (F, n).

    The weight is the surfel's area, times (1 - d^2)^2 at a distance of d cells, in which the part
    along the normal counts four times, times the fourth power of the cosine between the normals: it
    fades to nothing, so the mean is continuous. Without a surfel in reach the nearest counts.
    """
    corner, cell, table, position, normal = (
        grid.corner_m,
        grid.cell_m,
        grid.table,
        grid.position_m,
        grid.normal,
    )
    area, nearby, weights = grid.area_m2, np.empty(_MOST, np.int64), np.empty(_MOST)
    sums = np.empty((_TOGETHER, values.shape[1]))
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        nx, ny, nz = facing[i, 0], facing[i, 1], facing[i, 2]
        cx, cy, cz = (
            int((x - corner[0]) / cell),
            int((y - corner[1]) / cell),
            int((z - corner[2]) / cell),
        )
        count, total = 0, 0.0
        nearest, least = -1, np.inf
        for jx in range(max(cx - 1, 0), min(cx + 2, table.shape[0])):
            for jy in range(max(cy - 1, 0), min(cy + 2, table.shape[1])):
                for jz in range(max(cz - 1, 0), min(cz + 2, table.shape[2])):
                    for k in range(table[jx, jy, jz, 0], table[jx, jy, jz, 1]):
                        cosine = normal[k, 0] * nx + normal[k, 1] * ny + normal[k, 2] * nz
                        if cosine <= 0.0:
                            continue
                        ex, ey, ez = position[k, 0] - x, position[k, 1] - y, position[k, 2] - z
                        off = ex * nx + ey * ny + ez * nz
                        apart = (ex * ex + ey * ey + ez * ez + OFF_PLANE * off * off) / (
                            cell * cell
                        )
                        if apart < least:
                            nearest, least = k, apart
                        if apart < 1.0:
                            weight = area[k] * (1.0 - apart) * (1.0 - apart)
                            weight *= cosine * cosine * cosine * cosine
                            nearby[count], weights[count] = k, weight
                            count += 1
                            total += weight
        if total <= 0.0:
            nearby[0], weights[0], total = nearest, 1.0, 1.0
            count = 1 if nearest >= 0 else 0
        row = sums[i % _TOGETHER]
        row[:] = 0.0
        for entry in range(count):
            share, source = weights[entry] / total, values[nearby[entry]]
            for f in range(row.size):
                row[f] += share * source[f]
        done = i % _TOGETHER + 1
        if done == _TOGETHER or i + 1 == points.shape[0]:
            first = i + 1 - done
            for f in range(row.size):
                for j in range(done):
                    out[f, first + j] = sums[j, f]
