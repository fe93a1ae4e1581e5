"""The same surface under another outline: cut to another object's, cut to an ellipse, or grown beyond its own."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.counterfactual_original import Original, Recut
from fpp_ml_bench.baselines.diagnostics.synth import Darkroom, Scene
from fpp_ml_bench.baselines.diagnostics.synth_surface import Surface
from fpp_ml_bench.loaders.illumination import LitPixels

GROWTH = 0.1
"""How far a grown object reaches beyond its outline, in roots of its area: it gains about half its area."""
KEPT_SHARE = 0.5
"""Share of the object that an ellipse leaves; of other objects' outlines that is taken which leaves nearest to it."""


def recuts(found: Original, room: Darkroom, outlines: Sequence[NDArray[np.bool_]]) -> Iterator[Recut]:
    """The sample under three other outlines, two without ``outlines`` (masks (H, W) of other objects)."""
    inside = np.zeros(room.shape, dtype=bool)
    inside.ravel()[found.surface.pixels] = True
    cuts = {"ellipse": _ellipse(found)}
    laid = [_laid_over(outline, found.target) for outline in outlines]
    if laid:
        # The one that leaves nearest to half: an outline that covers the object changes nothing.
        kept = [(cut & found.target).sum() / found.target.sum() for cut in laid]
        cuts["another object's outline"] = laid[int(np.argmin(np.abs(np.array(kept) - KEPT_SHARE)))]
    for name, cut in cuts.items():
        chosen = cut.ravel()[found.surface.pixels]
        scene = replace(
            found.scene,
            pixels=found.scene.pixels[chosen],
            lit=_part(found.scene, chosen),
            mask=found.target & cut,
        )
        yield Recut(name, scene, found.target & cut, found.depth_mm * (inside & cut))
    yield _grown(found, room, inside)


def _grown(found: Original, room: Darkroom, inside: NDArray[np.bool_]) -> Recut:
    """The surface carried on beyond its outline: depth and brightness of the nearest pixel of the target."""
    from scipy.ndimage import distance_transform_edt

    away, nearest = distance_transform_edt(~found.target, return_indices=True)
    ring = (away > 0) & (away <= GROWTH * np.sqrt(found.target.sum())) & ~inside
    place = np.full(room.shape, -1)
    place.ravel()[found.surface.pixels] = np.arange(found.surface.pixels.size)
    source = place[tuple(nearest)][ring]
    x, y = (rays[ring] for rays in room.rig.camera.rays())
    grown = Surface(np.flatnonzero(ring), x, y, found.surface.depth_m[source], found.surface.normals[source])
    both = Surface(
        np.concatenate([found.surface.pixels, grown.pixels]),
        np.concatenate([found.surface.x, grown.x]),
        np.concatenate([found.surface.y, grown.y]),
        np.concatenate([found.surface.depth_m, grown.depth_m]),
        np.concatenate([found.surface.normals, grown.normals]),
    )
    lit = room.light(both)
    gain = np.concatenate([found.scene.lit.gain, found.scene.lit.gain[source]])
    scene = replace(
        found.scene, pixels=both.pixels.astype(np.uint32), lit=replace(lit, gain=gain), mask=found.target | ring
    )
    return Recut("grown", scene, found.target, both.depth_mm(room.shape))


def _part(scene: Scene, chosen: NDArray[np.bool_]) -> LitPixels:
    lit = scene.lit
    lookup = {
        name: replace(found, index=found.index[chosen], weight=found.weight[chosen])
        for name, found in lit.lookup.items()
    }
    return replace(lit, lookup=lookup, gain=lit.gain[chosen], ambient=lit.ambient[chosen])


def _laid_over(outline: NDArray[np.bool_], target: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``outline`` shifted so that its middle lies on the target's."""
    middles = [np.argwhere(mask).mean(axis=0) for mask in (target, outline)]
    down, across = np.rint(middles[0] - middles[1]).astype(int)
    laid = np.zeros_like(outline)
    rows, columns = np.nonzero(outline)
    rows, columns = rows + down, columns + across
    there = (rows >= 0) & (rows < laid.shape[0]) & (columns >= 0) & (columns < laid.shape[1])
    laid[rows[there], columns[there]] = True
    return laid


def _ellipse(found: Original) -> NDArray[np.bool_]:
    """An ellipse on the target's middle, shaped as its spread, that holds `KEPT_SHARE` of its pixels."""
    points = np.argwhere(found.target).astype(np.float64)
    spread = np.maximum(points.std(axis=0), 1.0)
    rows, columns = np.indices(found.target.shape)
    middle = points.mean(axis=0)
    radius = np.hypot((rows - middle[0]) / spread[0], (columns - middle[1]) / spread[1])
    return np.asarray(radius <= np.quantile(radius[found.target], KEPT_SHARE))
