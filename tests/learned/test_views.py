"""The views that fringe-net learns from: drawn lights, and unions of objects."""

import numpy as np

from fpp_ml_bench.baselines.learned.scenes import (
    View,
    companions,
    drawn_light,
    united,
    with_unions,
)


def test_drawn_lights_differ_and_repeat() -> None:
    lights = [drawn_light(np.random.default_rng([3, n])) for n in range(40)]
    assert lights[0] == drawn_light(np.random.default_rng([3, 0]))
    exposures = [light.camera.exposure for light in lights]
    assert min(exposures) < 0.35 and max(exposures) > 1.5
    assert {light.surface.textures for light in lights} == {"none", "by_kind", "checks"}
    assert any(light.bounces.shadows for light in lights) and any(
        light.projector.response != 1 for light in lights
    )


def test_unions_follow_their_group() -> None:
    def view(name: str, group: str, depth_mm: float) -> View:
        grey, depth = np.full((2, 4, 4), 9, np.uint8), np.full((4, 4), depth_mm, np.float32)
        return View(name, name, group, grey, depth, depth > 1800)

    views = [view("a", "x", 1700), view("b", "x", 1900), view("c", "y", 1600)]
    seen = list(with_unions(views, unions=2, seed=3))
    assert [item.name for item in seen if not item.united] == ["a", "b", "c"]
    assert [item.united for item in seen] == [
        False,
        False,
        True,
        True,
        True,
        True,
        False,
    ]  # c is alone in its light
    assert all(
        (item.depth_mm == 1700).all() and not item.void.any() for item in seen if item.united
    )


def test_a_union_shows_the_nearest_surface_and_keeps_shadows() -> None:
    """Two surfaces through each other before one background, on which one of them has a shadow."""
    random, shape = np.random.default_rng(0), (8, 8)
    empty, nothing = np.full(shape, 90, np.uint8), np.zeros(shape, bool)
    rows, columns = np.indices(shape)
    depths = [np.where(rows < 5, 1700, 0), np.where(columns > 2, 1650 + 25 * rows, 0)]
    images = [
        np.where(depth > 0, random.integers(100, 200, shape, np.uint8), empty) for depth in depths
    ]
    images[1][7, 0] = 0
    both = [
        View(name, name, "x", image[None], depth.astype(np.float32), nothing)
        for name, image, depth in zip("ab", images, depths, strict=True)
    ]
    union = united(both)
    first = (depths[0] > 0) & ((depths[1] == 0) | (depths[0] <= depths[1]))
    second = (depths[1] > 0) & ~first
    assert (first & (depths[1] > 0)).any() and (second & (depths[0] > 0)).any()
    expected = np.where(first, images[0], np.where(second, images[1], empty))
    expected[7, 0] = 0
    assert np.array_equal(union.frames[0], expected) and union.frames.dtype == np.uint8
    assert np.array_equal(union.depth_mm, np.where(first, depths[0], depths[1]))
    assert union.depth_mm.dtype == np.float32


def test_companions_are_other_objects() -> None:
    objects = {f"{view}_{name}": name for name in ("mug", "large_clamp", "pen") for view in (0, 60)}
    counts = set()
    for seed in range(40):
        names = companions(objects, "60_mug", np.random.default_rng(seed))
        shown = [objects[name] for name in names]
        assert "mug" not in shown and len(set(shown)) == len(shown)
        counts.add(len(names))
    assert counts == {1, 2}
    assert companions({"0_mug": "mug", "60_mug": "mug"}, "0_mug", np.random.default_rng(0)) == []
