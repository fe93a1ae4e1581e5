"""Further bounces: light that reaches a surface by way of other parts of the object, or of the background plane.

Radiosity on surfels, ``E = E_plane + F rho (E_projector + E)`` for all patterns at once: light is linear in the
pattern, so one matrix of form factors F serves every column (Goral et al. 1984, Modeling the Interaction of Light
Between Diffuse Surfaces). E is irradiance, in units of the projector's white on a surface that faces it at the near end
of the range, and rho the albedo. Surfaces are matte for this light. Between surfels E is interpolated by distance and
normal, as an irradiance cache does (Ward, Rubinstein and Clear 1988).
"""

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.loaders.render.surfels import RAYS, SurfelGrid, Surfels
from fpp_ml_bench.machine import njit

SMALLEST = 2e-4
"""A bounce that adds less everywhere, a twentieth of a grey level, is the last."""
MOST_BOUNCES = 64


def between_surfels(
    surfels: Surfels, direct: NDArray[np.float64], outside: NDArray[np.float64], albedo: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Irradiance of each surfel by bounces, float64 (K, F): ``outside`` and all that the object returns of its light.

    ``direct`` from the projector and ``outside`` from surfaces beyond the object, both float64 (K, F); ``albedo``
    float64 (K,), below 1.
    """
    total = outside.copy()
    arriving = np.empty_like(direct)
    leaving = albedo[:, None] * (direct + outside)
    for _ in range(MOST_BOUNCES):
        gather_form_factors(surfels.starts, surfels.seen, surfels.share, leaving, arriving)
        total += arriving
        if float(arriving.max(initial=0.0)) < SMALLEST:
            break
        leaving = albedo[:, None] * arriving
    return total


@njit
def gather_form_factors(starts, seen, share, leaving, arriving):  # type: ignore[no-untyped-def]
    """``arriving`` (K, F) = F ``leaving`` (K, F), F in compressed rows; in the order of its entries."""
    for k in range(starts.size - 1):
        row = arriving[k]
        row[:] = 0.0
        for entry in range(starts[k], starts[k + 1]):
            weight, source = share[entry], leaving[seen[entry]]
            for f in range(row.size):
                row[f] += weight * source[f]


@njit
def from_plane(  # type: ignore[no-untyped-def]
    starts, directions, position, distance, corner, cell, table, arriving
):
    """Irradiance from the plane z = ``distance``: adds to ``arriving`` (K, F) what each open ray meets there.

    ``directions`` (E, 3) and ``position`` (K, 3) in camera coordinates; ``table`` (Y, X, F): what leaves the plane, in
    cells of ``cell`` m from ``corner`` (x, y) on, and nothing beyond.
    """
    for k in range(starts.size - 1):
        row = arriving[k]
        for entry in range(starts[k], starts[k + 1]):
            dz = directions[entry, 2]
            if dz <= 0.0:
                continue
            way = (distance - position[k, 2]) / dz
            across = (position[k, 0] + way * directions[entry, 0] - corner[0]) / cell
            down = (position[k, 1] + way * directions[entry, 1] - corner[1]) / cell
            if 0.0 <= across < table.shape[1] and 0.0 <= down < table.shape[0]:
                source = table[int(down), int(across)]
                for f in range(row.size):
                    row[f] += source[f] / RAYS


def at_points(
    grid: SurfelGrid, values: NDArray[np.float64], position_m: NDArray[np.float64], normal: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Values of surfels (K, F) at surface points, float32 (n, F); 0 where no surfel is near.

    ``position_m`` and unit ``normal`` float64 (n, 3), object coordinates.
    """
    out = np.empty((len(position_m), values.shape[1]), dtype=np.float32)
    interpolate(
        grid.corner_m, grid.cell_m, grid.table, grid.position_m, grid.normal, grid.area_m2, values, position_m, normal,
        out,
    )  # fmt: skip
    return out


@njit
def interpolate(  # type: ignore[no-untyped-def]
    corner, cell, table, position, normal, area, values, points, facing, out
):
    """Weighted means of the surfels within a cell's width of each point: fills ``out`` (n, F).

    The weight is the surfel's area, times (1 - d^2)^2 at a distance of d cells, times the fourth power of the cosine
    between the normals: it fades to nothing, so the mean is continuous. Without a surfel in reach the nearest counts.
    """
    nearby, weights = np.empty(27 * 6, np.int64), np.empty(27 * 6)
    sums = np.empty(values.shape[1])
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        nx, ny, nz = facing[i, 0], facing[i, 1], facing[i, 2]
        cx, cy, cz = int((x - corner[0]) / cell), int((y - corner[1]) / cell), int((z - corner[2]) / cell)
        count, total = 0, 0.0
        nearest, least = -1, np.inf
        for jx in range(max(cx - 1, 0), min(cx + 2, table.shape[0])):
            for jy in range(max(cy - 1, 0), min(cy + 2, table.shape[1])):
                for jz in range(max(cz - 1, 0), min(cz + 2, table.shape[2])):
                    for side in range(table.shape[3]):
                        k = table[jx, jy, jz, side]
                        if k < 0:
                            continue
                        cosine = normal[k, 0] * nx + normal[k, 1] * ny + normal[k, 2] * nz
                        if cosine <= 0.0:
                            continue
                        ex, ey, ez = position[k, 0] - x, position[k, 1] - y, position[k, 2] - z
                        apart = (ex * ex + ey * ey + ez * ez) / (cell * cell)
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
        sums[:] = 0.0
        for entry in range(count):
            share, source = weights[entry] / total, values[nearby[entry]]
            for f in range(sums.size):
                sums[f] += share * source[f]
        for f in range(sums.size):
            out[i, f] = sums[f]
