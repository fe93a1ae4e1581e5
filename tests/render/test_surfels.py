"""Surfels and the pixels at the borders of shadows, against what plane geometry says."""

import numpy as np

from fpp_ml_bench.loaders.render.bounces import at_points
from fpp_ml_bench.loaders.render.pixels import mixed_pixels
from fpp_ml_bench.loaders.render.raycast import Hits, PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import SolidMesh
from fpp_ml_bench.loaders.render.surfels import place_surfels
from fpp_ml_bench.optics.named_rigs import paper_rig

SQUARE = np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.4, 0.4, 0.0], [0.0, 0.4, 0.0]])
UP = np.array([[0, 1, 2], [0, 2, 3]])


def test_surfels_of_a_step_keep_its_two_levels_apart() -> None:
    low = SQUARE[UP]
    _, alone = place_surfels(low)
    step_m = alone.cell_m / 2
    high = low * [0.5, 1, 1] + [0.4, 0, step_m]
    points, grid = place_surfels(np.concatenate([low, high]))
    assert np.isclose(grid.area_m2.sum(), 0.16 + 0.08)
    np.testing.assert_allclose(points.mean(points.position_m), grid.position_m)
    level = (grid.position_m[:, 2:] > step_m / 2).astype(np.float64)
    across = np.linspace(0.35, 0.45, 21)
    places = np.column_stack([across, np.full(21, 0.2), np.where(across > 0.4, step_m, 0.0)])
    seen = at_points(grid, level, places, np.tile([0.0, 0.0, 1.0], (21, 1)))
    np.testing.assert_allclose(seen[0], across > 0.4, atol=1e-6)


def test_pixels_on_both_sides_of_a_border_of_light_get_more_rays() -> None:
    rig = paper_rig(48)
    corners = (SQUARE - [0.2, 0.2, 0.0]) * [1, -1, 1] + [0.0, 0.0, 1.8]
    traced = TracedObject(SolidMesh("plate", corners, UP.astype(np.int32)), corners)
    hits: Hits = traced.primary(PixelRays.of(rig.camera))
    column = hits.pixels % 48
    plain = mixed_pixels(traced, hits, rig, 2)
    border = mixed_pixels(traced, hits, rig, 2, column < 24)
    added = np.setdiff1d(border.pixels, plain.pixels)
    assert set(added % 48) == {23, 24}
    assert set(np.unique(hits.pixels // 48)) - set(added // 48) <= set(plain.pixels // 48)
    assert not border.void[np.isin(border.pixels, added)].any()  # one surface, whatever its light
