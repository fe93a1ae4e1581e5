"""The camera's optics: pixels with an area, the blur of its lens, vignetting.

A pixel's light is the mean of what the rays across it see. More than the central ray is traced only for pixels that mix
surfaces: the object and what is behind it, parts at different depths, sides of an edge, or light and shadow.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.loaders.render.raycast import Hits, PixelRays, TracedObject
from fpp_ml_bench.machine import njit
from fpp_ml_bench.optics import Pinhole, Rig

APART_MM = 2.0
"""Rays of a pixel see different surfaces where a depth is this far from the plane that the central ray sees."""
_EDGE_COSINE = 0.9


@dataclass(frozen=True)
class MixedPixels:
    """Pixels that need more than their central ray. Flat ``pixels`` int64 (m,) ascending; per pixel and ray, (m s^2,)
    in turn: ``points_m`` and ``normals`` float64 (m s^2, 3), on the ``triangle`` int32, a row of the mesh's faces, or
    on the background plane: -1. ``void`` bool (m,): whether surfaces at different depths mix. ``share`` float64 (m,):
    of the rays, on the surface that the central ray sees."""

    pixels: NDArray[np.int64]
    points_m: NDArray[np.float64]
    normals: NDArray[np.float64]
    triangle: NDArray[np.int32]
    void: NDArray[np.bool_]
    share: NDArray[np.float64]

    @property
    def on_object(self) -> NDArray[np.bool_]:
        """Which rays meet the object; bool (m s^2,)."""
        return self.triangle >= 0


@np.errstate(divide="ignore", invalid="ignore")
def mixed_pixels(
    traced: TracedObject, hits: Hits, rig: Rig, across: int, lit: NDArray[np.bool_] | None = None
) -> MixedPixels:
    """The pixels of a view that mix surfaces, seen with ``across`` x ``across`` rays each; ``hits`` of the central.
    ``lit`` bool, one a hit: adds the pixels on both sides of where it changes, borders of shadows."""
    camera = rig.camera
    width, count = camera.width, camera.width * camera.height
    fine = PixelRays.of(camera.scaled(width * across))
    sub = traced.primary(fine)
    row, column = np.divmod(sub.pixels, width * across)
    parent = row // across * width + column // across
    inside = parent < count
    if not inside.all():  # a camera whose height does not scale to a whole number of rays
        row, column, parent = row[inside], column[inside], parent[inside]
        sub = Hits(sub.pixels[inside], sub.depth_m[inside], sub.normals[inside], sub.triangle[inside])
    central = np.full(count, -1, dtype=np.int64)
    central[hits.pixels] = np.arange(hits.pixels.size)
    seen = central[parent]
    x, y = fine.x.ravel()[sub.pixels], fine.y.ravel()[sub.pixels]
    same = seen >= 0
    at = np.where(same, seen, 0)
    if hits.pixels.size:
        normal = hits.normals[at]
        ray_x, ray_y = (axis.ravel()[hits.pixels] for axis in camera.rays())
        n = hits.normals
        distance = hits.depth_m * (n[:, 0] * ray_x + n[:, 1] * ray_y + n[:, 2])
        plane_m = distance[at] / (normal[:, 0] * x + normal[:, 1] * y + normal[:, 2])
        apart = ~(np.abs(plane_m - sub.depth_m) * MM_PER_M <= APART_MM)
        turn = normal[:, 0] * sub.normals[:, 0] + normal[:, 1] * sub.normals[:, 1] + normal[:, 2] * sub.normals[:, 2]
        edge = ~(turn >= _EDGE_COSINE)
    else:
        apart = edge = np.ones(len(parent), dtype=bool)
    total = across * across
    on_object = np.bincount(parent, minlength=count)
    of_surface = np.bincount(parent[same & ~apart], minlength=count)
    void = np.where(central >= 0, of_surface < total, on_object > 0)
    needs = void.copy()
    needs[parent[same & edge]] = True
    if lit is not None:
        needs |= _at_borders(hits, lit, camera)
    pixels = np.flatnonzero(needs)
    number = np.full(count, -1, dtype=np.int64)
    number[pixels] = np.arange(pixels.size)
    slot = number[parent] * total + row % across * across + column % across
    chosen = np.flatnonzero(number[parent] >= 0)
    of = np.full(pixels.size * total, -1, dtype=np.int64)
    of[slot[chosen]] = chosen
    ray = _fine_pixels(pixels, width, across)
    hit = of >= 0
    depth_m = np.where(hit, sub.depth_m[of] if sub.depth_m.size else 0.0, rig.background_m)
    direction = np.column_stack([fine.x.ravel()[ray], fine.y.ravel()[ray], np.ones(ray.size)])
    normals = np.tile([0.0, 0.0, -1.0], (ray.size, 1))
    normals[hit] = sub.normals[of[hit]]
    triangle = np.full(ray.size, -1, dtype=np.int32)
    triangle[hit] = sub.triangle[of[hit]]
    share = np.where(central >= 0, of_surface, total - on_object)[pixels] / total
    return MixedPixels(pixels, direction * depth_m[:, None], normals, triangle, void[pixels], share)


def _at_borders(hits: Hits, lit: NDArray[np.bool_], camera: Pinhole) -> NDArray[np.bool_]:
    """Hit pixels beside one, across or along, that is lit where they are not, or the reverse; bool (H W,)."""
    state = np.zeros((camera.height, camera.width), dtype=np.int8)
    state.ravel()[hits.pixels] = np.where(lit, 1, -1)
    border = np.zeros(state.shape, dtype=bool)
    for one, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        changes = state[one] * state[other] < 0
        border[one] |= changes
        border[other] |= changes
    return border.ravel()


def _fine_pixels(pixels: NDArray[np.int64], width: int, across: int) -> NDArray[np.int64]:
    """Flat positions of the pixels' rays in the finer image, row by row of each pixel; int64 (m across^2,)."""
    row, column = np.divmod(pixels, width)
    down, right = np.divmod(np.arange(across * across), across)
    return ((row[:, None] * across + down) * (width * across) + column[:, None] * across + right).ravel()


def vignetting(camera: Pinhole, power: int) -> NDArray[np.float32]:
    """Share of the light that reaches each pixel, cos^power of its angle to the axis; float32 (H W,)."""
    x, y = (axis.ravel() for axis in camera.rays())
    cosine = 1.0 / np.sqrt(x * x + y * y + 1.0)
    share = np.ones_like(cosine)
    for _ in range(power):
        share *= cosine
    return np.nan_to_num(share).astype(np.float32)


@njit
def blur_image(image, weights, between):  # type: ignore[no-untyped-def]
    """Convolve ``image`` float32 (H, W) with ``weights`` (2 r + 1,) along both axes, in place; the border repeats.
    ``between`` float32 (H, W) is overwritten."""
    height, width = image.shape
    reach = weights.size // 2
    for i in range(height):
        target = between[i]
        target[:] = np.float32(0)
        for k in range(weights.size):
            source, weight = image[min(max(i + k - reach, 0), height - 1)], weights[k]
            for j in range(width):
                target[j] += weight * source[j]
    padded = np.empty(width + 2 * reach, np.float32)
    for i in range(height):
        source, target = between[i], image[i]
        padded[:reach], padded[reach + width :] = source[0], source[width - 1]
        padded[reach : reach + width] = source
        target[:] = np.float32(0)
        for k in range(weights.size):
            weight, part = weights[k], padded[k : k + width]
            for j in range(width):
                target[j] += weight * part[j]
