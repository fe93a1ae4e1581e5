"""The camera's optics: pixels with an area, the blur of its lens, vignetting.

A pixel's light is the mean of what the rays across it see. More than the central ray is traced only
for pixels that mix surfaces: the object and what is behind it, parts at different depths, sides of
an edge, or light and shadow.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.loaders.render.raycast import Hits, PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import along_rays
from fpp_ml_bench.machine import njit
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import Rig

APART_MM = 2.0
"""Rays of a pixel see different surfaces where a depth is this far from the plane that the central
ray sees."""
_EDGE_COSINE = 0.9
"""Least cosine between normals on one side of an edge: 26 degrees; more is a crease."""


@dataclass(frozen=True)
class MixedPixels:
    """Pixels that need more than their central ray. Flat ``pixels`` int64 (m,) ascending; per pixel
    and ray, (m s^2,) in turn: ``points_m`` and ``normals`` float64 (m s^2, 3), on the ``triangle``
    int32, a row of the mesh's faces, or on the background plane: -1. ``void`` bool (m,): whether
    surfaces at different depths mix. ``share`` float64 (m,): of the rays, on the surface that the
    central ray sees."""

    pixels: NDArray[np.int64]
    points_m: NDArray[np.float64]
    normals: NDArray[np.float64]
    triangle: NDArray[np.int32]
    void: NDArray[np.bool_]
    share: NDArray[np.float64]


@np.errstate(divide="ignore", invalid="ignore")
def mixed_pixels(
    traced: TracedObject, hits: Hits, rig: Rig, across: int, lit: NDArray[np.bool_] | None = None
) -> MixedPixels:
    """The pixels of a view that mix surfaces, seen with ``across`` x ``across`` rays each; ``hits``
    of the central. ``lit`` bool, one a hit: adds the pixels on both sides of where it changes,
    borders of shadows."""
    camera, total = rig.camera, across * across
    width, count = camera.width, camera.width * camera.height
    ray_x, ray_y = (axis.ravel() for axis in camera.rays())
    central = np.full(count, -1, dtype=np.int64)
    central[hits.pixels] = np.arange(hits.pixels.size)
    chosen = np.zeros(count, dtype=bool)
    n = hits.normals
    distance = hits.depth_m * (
        n[:, 0] * ray_x[hits.pixels] + n[:, 1] * ray_y[hits.pixels] + n[:, 2]
    )
    mark_neighbours(width, central, hits.pixels, hits.depth_m, n, distance, ray_x, ray_y, chosen)
    state = np.zeros(
        (camera.height, width), dtype=np.int8
    )  # without light to tell apart no borders
    if lit is not None:
        state.ravel()[hits.pixels] = np.where(lit, 1, -1)
    borders = at_borders(state)
    pixels = np.flatnonzero(chosen | borders)
    fine = PixelRays.of(camera.scaled(width * across))
    ray = _fine_pixels(pixels, width, across)
    wanted = np.zeros(fine.x.shape, dtype=bool)
    within = ray < wanted.size  # a camera whose height does not scale to a whole number of rays
    wanted.ravel()[ray[within]] = True
    sub = traced.primary(fine, wanted)
    x, y = (axis.ravel()[np.where(within, ray, 0)] for axis in (fine.x, fine.y))
    # Rays are sorted by pixel, hits by their place in the finer image: `of` is the hit of each ray,
    # -1 for none.
    of = np.full(ray.size, -1, dtype=np.int64)
    if sub.pixels.size:
        place = np.minimum(np.searchsorted(sub.pixels, ray), sub.pixels.size - 1)
        of = np.where(sub.pixels[place] == ray, place, -1)
    hit = of >= 0
    depth_m, triangle = np.full(ray.size, rig.background), np.full(ray.size, -1, dtype=np.int32)
    normals = np.tile([0.0, 0.0, -1.0], (ray.size, 1))
    depth_m[hit], triangle[hit], normals[hit] = (
        sub.depth_m[of[hit]],
        sub.triangle[of[hit]],
        sub.normals[of[hit]],
    )
    seen = np.repeat(central[pixels], total)
    same = (
        ~hit
    )  # on the surface that the central ray sees: the background, or near the object's plane there
    own = np.flatnonzero(seen >= 0)
    plane = n[seen[own]]
    plane_m = distance[seen[own]] / (plane[:, 0] * x[own] + plane[:, 1] * y[own] + plane[:, 2])
    same[own] = hit[own] & (np.abs(plane_m - depth_m[own]) * MM_PER_M <= APART_MM)
    alike = np.ones(ray.size, dtype=bool)
    alike[own] = (plane * normals[own]).sum(axis=1) >= _EDGE_COSINE
    share = same.reshape(-1, total).mean(axis=1)
    mixes = (share < 1.0) | ~alike.reshape(-1, total).all(axis=1) | borders[pixels]
    of_mixed = np.repeat(mixes, total)
    points = along_rays(x, y, depth_m)[of_mixed]
    pixels, share = pixels[mixes], share[mixes]
    return MixedPixels(pixels, points, normals[of_mixed], triangle[of_mixed], share < 1.0, share)


@njit
def mark_neighbours(width, central, pixels, depth_m, normals, distance, x, y, chosen):  # type: ignore[no-untyped-def]
    """Mark in ``chosen`` bool (H W,) the pixels of which a neighbour sees another surface, or
    another side of an edge, and that neighbour. ``central`` int64 (H W,): each pixel's row in the
    arrays of hits, -1 for none; ``distance`` (n,) of the hits' planes from the camera; rays ``x``
    and ``y`` (H W,)."""
    height = central.size // width
    for i in range(pixels.size):
        row, column = pixels[i] // width, pixels[i] % width
        for down in range(max(row - 1, 0), min(row + 2, height)):
            for right in range(max(column - 1, 0), min(column + 2, width)):
                other = down * width + right
                j = central[other]
                apart = j < 0
                if not apart:
                    a, b, c = normals[i, 0], normals[i, 1], normals[i, 2]
                    plane_m = distance[i] / (a * x[other] + b * y[other] + c)
                    turn = a * normals[j, 0] + b * normals[j, 1] + c * normals[j, 2]
                    apart = not (
                        abs(plane_m - depth_m[j]) * 1000.0 <= APART_MM and turn >= _EDGE_COSINE
                    )
                if apart:
                    chosen[pixels[i]] = True
                    chosen[other] = True


def at_borders(state: NDArray[np.int8]) -> NDArray[np.bool_]:
    """The pixels beside one, across or along, with the opposite sign of ``state`` (H, W); bool (H
    W,)."""
    border = np.zeros(state.shape, dtype=bool)
    for part, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        changes = state[part] * state[other] < 0
        border[part] |= changes
        border[other] |= changes
    return border.ravel()


def _fine_pixels(pixels: NDArray[np.int64], width: int, across: int) -> NDArray[np.int64]:
    """Flat positions of the pixels' rays in the finer image, row by row of each pixel; int64 (m
    across^2,)."""
    row, column = np.divmod(pixels, width)
    down, right = np.divmod(np.arange(across * across), across)
    return (
        (row[:, None] * across + down) * (width * across) + column[:, None] * across + right
    ).ravel()


def vignetting(camera: Pinhole, power: int) -> NDArray[np.float32]:
    """Share of the light that reaches each pixel, cos^power of its angle to the axis; float32 (H
    W,)."""
    x, y = (axis.ravel() for axis in camera.rays())
    cosine = 1.0 / np.sqrt(x * x + y * y + 1.0)
    share = np.ones_like(cosine)
    for _ in range(power):
        share *= cosine
    return np.nan_to_num(share).astype(np.float32)


@njit
def blur_image(image, weights, between):  # type: ignore[no-untyped-def]
    """Convolve ``image`` float32 (H, W) with ``weights`` (2 r + 1,) along both axes, in place; the
    border repeats. ``between`` float32 (H, W) is overwritten."""
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
