"""Albedo maps: in range, repeatable, of the object and not of the view, and plain where nothing is
printed."""

import numpy as np
import pytest
from rendering import PAPER, RIG

from fpp_ml_bench.constants import OBJECTS, UNSEEN, VIEW_DEGREES
from fpp_ml_bench.loaders.render.light import SurfaceLight
from fpp_ml_bench.loaders.render.lighting import Lighting, ObjectLight
from fpp_ml_bench.loaders.render.projector import PatternLight
from fpp_ml_bench.loaders.render.raycast import TracedObject
from fpp_ml_bench.loaders.render.scene import SolidMesh, turned
from fpp_ml_bench.loaders.render.textures import (
    CHECK_MM,
    KINDS,
    MAPS,
    checks,
    material_of,
    smooth_noise,
)

RNG = np.random.default_rng(7)
PLACE_MM = RNG.uniform(-150, 150, (20_000, 3))
NORMAL = RNG.normal(size=(20_000, 3))
NORMAL /= np.linalg.norm(NORMAL, axis=1, keepdims=True)
TRIANGLE = np.zeros((3, 3)), np.array([[0, 1, 2]], dtype=np.int32)


def mesh(name):
    return SolidMesh(name, *TRIANGLE)


def test_every_object_named_is_one_of_the_benchmarks_and_has_one_kind():
    names = [name for kind in KINDS.values() for name in kind]
    assert len(names) == len(set(names)) and set(names) <= {*OBJECTS, *UNSEEN}
    assert set(KINDS) | {"stains"} == set(MAPS)


@pytest.mark.parametrize("kind", MAPS)
def test_maps_stay_in_range_and_have_light_and_dark(kind):
    dark = MAPS[kind](PLACE_MM, NORMAL, "thing")
    assert dark.shape == (20_000,) and dark.min() >= 0 and dark.max() <= 1
    assert dark.std() > 0.1 and dark.max() > 0.85 and dark.min() < 0.05


@pytest.mark.parametrize("kind", MAPS)
def test_maps_are_functions_of_place_and_name(kind):
    dark = MAPS[kind](PLACE_MM, NORMAL, "thing")
    order = RNG.permutation(len(dark))
    np.testing.assert_array_equal(MAPS[kind](PLACE_MM[order], NORMAL[order], "thing"), dark[order])
    if kind != "checks":
        assert (MAPS[kind](PLACE_MM, NORMAL, "another") != dark).mean() > 0.02


def test_checks_by_hand():
    front = np.array([[0.0, -1.0, 0.0]] * 4)  # across x, down -z
    place = np.array(
        [[1.0, 0, -1], [CHECK_MM + 1, 0, -1], [CHECK_MM + 1, 0, -CHECK_MM - 1], [-1, 0, -1]]
    )
    np.testing.assert_array_equal(checks(place, front, ""), [0, 1, 0, 1])


def test_noise_is_continuous_and_takes_its_corners_values():
    along = np.zeros((4001, 3))
    along[:, 0] = np.linspace(-2, 2, 4001)
    values = smooth_noise(along, "thing")
    assert values.min() >= 0 and values.max() <= 1
    assert (
        np.abs(np.diff(values)).max() < 1.6e-3
    )  # at most 1.5 of the difference of two corners a unit
    assert np.abs(np.diff(values[::1000])).max() > 0  # corners differ


@pytest.mark.parametrize("kind", ["by_kind", "checks"])
def test_without_contrast_a_surface_is_plain(kind):
    for name in ("mug", "cracker_box", "users_part"):
        surface = SurfaceLight(albedo=0.6, textures=kind, contrast=0.0)
        np.testing.assert_array_equal(
            material_of(mesh(name), PLACE_MM / 1000, NORMAL, surface).albedo, 0.6
        )
    plain = material_of(
        mesh("mug"), PLACE_MM / 1000, NORMAL, SurfaceLight(albedo=0.6, gloss=0.3, contrast=0.9)
    )
    assert (plain.albedo, plain.gloss) == (0.6, 0.3)


def test_contrast_sets_how_dark_the_dark_parts_are():
    surface = SurfaceLight(albedo=0.8, gloss=0.5, textures="by_kind", contrast=0.75)
    material = material_of(mesh("mug"), PLACE_MM / 1000, NORMAL, surface)  # a mug has checks
    np.testing.assert_allclose(np.unique(material.albedo), [0.2, 0.8])
    glosses = {
        name: material_of(mesh(name), PLACE_MM[:1] / 1000, NORMAL[:1], surface).gloss
        for name in OBJECTS
    }
    assert (
        min(glosses.values()) >= 0
        and max(glosses.values()) < 0.5
        and len(set(glosses.values())) == 50
    )


def test_a_map_sticks_to_its_object_in_every_view():
    """The same place of the object has the same albedo, however the object is turned and moved:
    from the light that two views of it get, by way of `Lighting`, without what the views themselves
    change."""
    light = PAPER.changed("surface", textures="by_kind", contrast=0.9).changed(
        "bounces", interreflection=False, ambient_occlusion=False
    )
    lighting = Lighting(RIG, light, PatternLight.of(RIG, light.projector))
    place = RNG.uniform(-0.05, 0.05, (2000, 3))
    normal = NORMAL[:2000]
    for name in ("cracker_box", "wood_block", "power_drill", "master_chef_can"):
        own = SolidMesh(name, np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]]), TRIANGLE[1])
        expected = material_of(own, place, normal, light.surface).albedo
        for degrees, away_m in zip(VIEW_DEGREES[:3], (1.7, 1.8, 1.95), strict=False):
            offset = np.array([0.0, 0.0, away_m])
            traced = TracedObject(own, turned(own.vertices_m, degrees) + offset)
            lit = ObjectLight(lighting, own, traced, degrees, offset).at(
                turned(place, degrees) + offset,
                turned(normal, degrees),
                np.zeros(len(place), dtype=np.int64),
            )
            # Ambient light is not shaped by place or direction: it is the albedo's.
            off = np.abs(lit.ambient - light.ambient_grey * expected / light.surface.albedo) > 1e-4
            assert off.mean() < 2e-3  # rounding at the very edge of a letter
