"""The views that the phase networks learn from: drawn lights, splits that stay apart, unions of objects."""

import numpy as np
from flat_planes import plane_depth_m, plane_fringe

from fpp_ml_bench.baselines.learned.scenes import View, companions, drawn_light, groups_of, united, with_unions
from fpp_ml_bench.optics.named_rigs import paper_rig

RIG = paper_rig(240)


def test_drawn_lights_differ_and_repeat() -> None:
    lights = [drawn_light(np.random.default_rng([3, n])) for n in range(40)]
    assert lights[0] == drawn_light(np.random.default_rng([3, 0]))
    exposures = [light.camera.exposure for light in lights]
    assert min(exposures) < 0.35 and max(exposures) > 1.5
    assert {light.surface.textures for light in lights} == {"none", "by_kind", "checks"}
    assert any(light.bounces.shadows for light in lights) and any(light.projector.response != 1 for light in lights)


def test_groups_keep_the_splits_apart() -> None:
    groups = groups_of(lights=3, views_a_light=4, seed=0)
    splits = "train", "validation"
    shown = {split: {name for g in groups if g.split == split for name, _ in g.views} for split in splits}
    assert len(shown["train"]) == 40 and len(shown["validation"]) == 5
    assert not shown["train"] & shown["validation"]
    assert all(len({name for name, _ in g.views}) == 4 for g in groups if g.name.startswith("drawn"))


def test_most_lights_show_one_material_where_that_is_asked_for() -> None:
    groups = groups_of(lights=6, views_a_light=4, seed=0, textured_every=3, validation_lights=3)
    drawn = [group.light.surface for group in groups if group.name.startswith(("plain", "drawn"))]
    assert [(surface.textures, surface.gloss) == ("none", 0) for surface in drawn[:2]] == [True, True]
    assert len(drawn) == 6 and sum(group.name.startswith("drawn") for group in groups) == 2
    every = groups_of(lights=6, views_a_light=4, seed=0)
    assert drawn[2] == every[3].light.surface and [group.views for group in every[:7]] == [g.views for g in groups[:7]]
    assert sum(group.split == "validation" for group in groups) == 5


def test_unions_follow_their_group() -> None:
    def view(name: str, group: str, depth_mm: float) -> View:
        grey, depth = np.full((2, 4, 4), 9, np.uint8), np.full((4, 4), depth_mm, np.float32)
        return View(name, name, group, grey, depth, depth > 1800)

    views = [view("a", "x", 1700), view("b", "x", 1900), view("c", "y", 1600)]
    seen = list(with_unions(views, unions=2, seed=3))
    assert [item.name for item in seen if not item.united] == ["a", "b", "c"]
    assert [item.united for item in seen] == [False, False, True, True, True, True, False]  # c is alone in its light
    assert all((item.depth_mm == 1700).all() and not item.void.any() for item in seen if item.united)


def test_a_union_is_what_the_rig_captures_of_both() -> None:
    """Two tilted surfaces through each other before a plane, all in the benchmark's own light."""
    rows, columns = np.indices((RIG.camera.height, RIG.camera.width))
    behind, tilts = 2.1, [(0.1, -0.1), (-0.3, 0.2)]
    depths = [
        np.where(rows < 160, plane_depth_m(RIG, 1.7, tilts[0]), 0),
        np.where(columns > 90, plane_depth_m(RIG, 1.72, tilts[1]), 0),
    ]
    empty = plane_fringe(RIG, 0, np.full(rows.shape, behind), (0.0, 0.0), noise=0)
    images = [
        np.where(depth > 0, plane_fringe(RIG, 0, np.where(depth > 0, depth, behind), tilt, noise=0), empty)
        for depth, tilt in zip(depths, tilts, strict=True)
    ]
    images[1][-1, 0] = 0  # a shadow on the plane stays
    nothing = np.zeros(rows.shape, bool)
    both = [
        View(name, name, "x", image[None], (1000 * depth_m).astype(np.float32), nothing)
        for name, image, depth_m in zip("ab", images, depths, strict=True)
    ]
    union = united(both)
    (image,), depth_mm = union.frames, union.depth_mm
    first = (depths[0] > 0) & ((depths[1] == 0) | (depths[0] <= depths[1]))
    second = (depths[1] > 0) & ~first
    assert (first & (depths[1] > 0)).mean() > 0.05 and (second & (depths[0] > 0)).mean() > 0.05
    expected = np.where(first, images[0], np.where(second, images[1], empty))
    expected[-1, 0] = 0
    assert np.array_equal(image, expected)
    # float32 numbers from 1024 to 2048 mm are 2**-13 mm apart.
    np.testing.assert_allclose(depth_mm, 1000 * np.where(first, depths[0], depths[1]), rtol=0, atol=2**-14)
    assert image.dtype == np.uint8 and depth_mm.dtype == np.float32


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
