"""The same surface under another outline: cut to another object's, cut to an ellipse, or grown beyond its own."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.counterfactual_original import Original, OutlineChange
from fpp_ml_bench.baselines.diagnostics.synth import Scene, SceneRenderer
from fpp_ml_bench.baselines.diagnostics.synth_surface import Surface
from fpp_ml_bench.loaders.render import LitPixels

GROWTH = 0.1
"""How far a grown object reaches beyond its outline, in units of sqrt(area): it gains about half its area."""
KEPT_SHARE = 0.5
"""Share of the object that an ellipse leaves; of the other objects' outlines the nearest to this share is used."""


def outline_changes(
    sample: Original, renderer: SceneRenderer, outlines: Sequence[NDArray[np.bool_]]
) -> Iterator[OutlineChange]:
    """The sample under three other outlines, two without ``outlines`` (masks (H, W) of other objects)."""
    inside = np.zeros(renderer.shape, dtype=bool)
    inside.ravel()[sample.surface.pixels] = True
    cuts = {"ellipse": _ellipse(sample)}
    moved = [_laid_over(outline, sample.target) for outline in outlines]
    if moved:
        # An outline that covers the whole object would change nothing.
        shares = [(cut & sample.target).sum() / sample.target.sum() for cut in moved]
        cuts["another object's outline"] = moved[int(np.argmin(np.abs(np.array(shares) - KEPT_SHARE)))]
    for name, cut in cuts.items():
        inside_cut = cut.ravel()[sample.surface.pixels]
        scene = replace(
            sample.scene,
            pixels=sample.scene.pixels[inside_cut],
            lit=_part(sample.scene, inside_cut),
            mask=sample.target & cut,
        )
        yield OutlineChange(name, scene, sample.target & cut, sample.depth_mm * (inside & cut))
    yield _grown(sample, renderer, inside)


def _grown(sample: Original, renderer: SceneRenderer, inside: NDArray[np.bool_]) -> OutlineChange:
    """The surface extended beyond its outline with depth and brightness of the nearest target pixel."""
    from scipy.ndimage import distance_transform_edt

    distance_px, nearest = distance_transform_edt(~sample.target, return_indices=True)
    ring = (distance_px > 0) & (distance_px <= GROWTH * np.sqrt(sample.target.sum())) & ~inside
    surface_index = np.full(renderer.shape, -1)
    surface_index.ravel()[sample.surface.pixels] = np.arange(sample.surface.pixels.size)
    source = surface_index[tuple(nearest)][ring]
    x, y = (rays[ring] for rays in renderer.rig.camera.rays())
    grown = Surface(np.flatnonzero(ring), x, y, sample.surface.depth_m[source], sample.surface.normals[source])
    both = Surface(
        np.concatenate([sample.surface.pixels, grown.pixels]),
        np.concatenate([sample.surface.x, grown.x]),
        np.concatenate([sample.surface.y, grown.y]),
        np.concatenate([sample.surface.depth_m, grown.depth_m]),
        np.concatenate([sample.surface.normals, grown.normals]),
    )
    lit = renderer.light(both)
    gain = np.concatenate([sample.scene.lit.gain, sample.scene.lit.gain[source]])
    scene = replace(
        sample.scene, pixels=both.pixels.astype(np.uint32), lit=replace(lit, gain=gain), mask=sample.target | ring
    )
    return OutlineChange("grown", scene, sample.target, both.depth_mm(renderer.shape))


def _part(scene: Scene, selection: NDArray[np.bool_]) -> LitPixels:
    lit = scene.lit
    lookup = {
        name: replace(entry, index=entry.index[selection], weight=entry.weight[selection])
        for name, entry in lit.lookup.items()
    }
    return replace(lit, lookup=lookup, gain=lit.gain[selection], ambient=lit.ambient[selection])


def _laid_over(outline: NDArray[np.bool_], target: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``outline`` shifted so that its centre lies on the target's."""
    centres = [np.argwhere(mask).mean(axis=0) for mask in (target, outline)]
    down, across = np.rint(centres[0] - centres[1]).astype(int)
    shifted = np.zeros_like(outline)
    rows, columns = np.nonzero(outline)
    rows, columns = rows + down, columns + across
    in_image = (rows >= 0) & (rows < shifted.shape[0]) & (columns >= 0) & (columns < shifted.shape[1])
    shifted[rows[in_image], columns[in_image]] = True
    return shifted


def _ellipse(sample: Original) -> NDArray[np.bool_]:
    """An ellipse at the target's centre, with axes in proportion to its standard deviations, that holds `KEPT_SHARE` of
    its pixels."""
    points = np.argwhere(sample.target).astype(np.float64)
    spread = np.maximum(points.std(axis=0), 1.0)
    rows, columns = np.indices(sample.target.shape)
    centre = points.mean(axis=0)
    radius = np.hypot((rows - centre[0]) / spread[0], (columns - centre[1]) / spread[1])
    return np.asarray(radius <= np.quantile(radius[sample.target], KEPT_SHARE))
