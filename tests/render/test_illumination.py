"""Brightness of single points against closed forms: inverse square, cosine, falloff, gloss, the
pattern's rim."""

from dataclasses import replace

import numpy as np
import pytest
from rendering import ALL_PIXELS, CENTRE, DIRECT, RIG, X, Y, plane

from fpp_ml_bench.loaders.render.illumination import (
    Material,
    light_surface,
    reflectance,
)
from fpp_ml_bench.loaders.render.projector import PatternLight
from fpp_ml_bench.loaders.render.sensor import Exposure, camera_noise
from fpp_ml_bench.optics.rig import rotation_matrix

PATTERN = PatternLight.of(RIG, DIRECT.projector)
REFERENCE_GREY = 180.0


def lit_by(light, points, normals):
    return light_surface(points, normals, RIG, light, PATTERN)


def test_light_on_the_far_side_does_not_reach_the_camera():
    """A projector 3 m ahead that looks back: exactly 0, so that the decoder masks it for want of
    modulation."""
    turn = rotation_matrix((0.0, np.pi, 0.0))
    behind = replace(
        RIG,
        rotation=turn.tolist(),
        translation_m=tuple((-turn @ np.array([-0.125, 0.1, 3.0])).tolist()),
    )
    assert not light_surface(*plane(1.8), behind, DIRECT, PATTERN).gain.any()


@pytest.mark.parametrize("z_m", [1.5, 1.8, 2.1, 3.2])
def test_matte_plane_follows_cosine_and_inverse_square(z_m):
    points, normals = plane(z_m)
    lit = lit_by(DIRECT, points, normals)
    distance = np.sqrt((points[:, 0] + 0.125) ** 2 + (points[:, 1] - 0.1) ** 2 + z_m**2)
    expected = REFERENCE_GREY * (1.5 / distance) ** 2 * (z_m / distance)
    u, v = RIG.project(points)
    outside = (u < -0.5) | (u > 911.5) | (v < -0.5) | (v > 1139.5)
    expected[outside] = 0
    np.testing.assert_allclose(lit.gain, expected, rtol=1e-6)
    assert (lit.ambient == np.float32(6.0)).all()
    assert not outside.all()


@pytest.mark.parametrize("falloff", [-3, 2, 4])
def test_falloff_is_a_power_of_the_cosine_to_the_projectors_axis(falloff):
    points, normals = plane(1.8)
    plain = lit_by(DIRECT, points, normals).gain
    cosine = points[:, 2] / np.linalg.norm(points - CENTRE, axis=1)
    light = DIRECT.changed("projector", falloff=falloff)
    np.testing.assert_allclose(
        lit_by(light, points, normals).gain, plain * cosine**falloff, rtol=2e-6
    )


def test_reference_grey_is_that_of_the_matte_part():
    """A facing surface at 1.5 m along the axis: 180 of any albedo; with gloss the lobe comes on top
    of it."""
    point, normal = np.array([[-0.125, 0.1, 1.5]]), np.array([[0.0, 0.0, -1.0]])
    for albedo in (0.2, 0.8):
        light = DIRECT.changed("surface", albedo=albedo)
        assert lit_by(light, point, normal).gain[0] == pytest.approx(180, rel=1e-6)
        assert lit_by(light, point, normal).ambient[0] == pytest.approx(6, rel=1e-6)


def test_gloss_is_where_the_mirror_direction_is():
    """A plane of glossy material: brightest, over what a matte one is, half-way between the two
    centres, and there as `reflectance` says with the half vector on the normal."""
    points, normals = plane(1.8)
    matte = lit_by(DIRECT, points, normals).gain
    light = DIRECT.changed("surface", gloss=0.3, roughness=0.25)
    glossy = light_surface(points, normals, RIG, light, PATTERN, Material(0.8, 0.3)).gain
    lit = matte > 0
    ratio = glossy[lit] / matte[lit]
    best = points[lit][ratio.argmax()]
    np.testing.assert_allclose(best[:2], CENTRE[:2] / 2, atol=1.8 / RIG.camera.fx)
    to_light, to_camera = (v / np.linalg.norm(v) for v in (CENTRE - best, -best))
    half = (to_light + to_camera) / np.linalg.norm(to_light + to_camera)
    lobe_and_matte = reflectance(-to_light[2:], -to_camera[2:], -half[2:], 0.8, 0.3, 0.25)[0]
    assert ratio.max() == pytest.approx(lobe_and_matte / (0.7 * 0.8), rel=1e-5)
    assert ratio.min() >= 1 - 1e-6
    # The wall behind objects is the matte part alone.
    np.testing.assert_allclose(lit_by(light, points, normals).gain, matte, rtol=1e-6)


def test_the_pattern_ends_with_its_outer_pixels():
    """Beyond there is ambient light alone: see the matte plane."""
    u, v = np.array([-0.5, 911.5, -0.51, np.nan]), np.array([0.0, 1139.5, 0, 0])
    inside = RIG.projector.holds(u, v)
    assert inside.tolist() == [True, True, False, False]


def test_rays_that_see_nothing_stay_dark():
    points, normals = plane(2.0)
    points = points.copy()
    points[:10] = np.nan
    lit = lit_by(DIRECT, points, normals)
    assert (lit.gain[:10] == 0).all() and (lit.ambient[:10] == 0).all()
    assert np.isfinite(lit.gain).all()
    read = Exposure.of(RIG, DIRECT).expose([51], lit, ALL_PIXELS, (1, "a", "A0"))[0]
    assert (read[:10] == 0).all()


def test_nothing_in_range_saturates_at_the_defaults():
    """Any surface from 1.5 m on, turned any way, white pattern, default noise: below 255 on every
    pixel."""
    rng = np.random.default_rng(1)
    depth = rng.uniform(1.5, 2.1, X.size)
    depth[: X.size // 4] = 1.5
    points = np.column_stack([X.ravel(), Y.ravel(), np.ones(X.size)]) * depth[:, None]
    toward = CENTRE - points  # the brightest a patch can be
    normals = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    lit = lit_by(DIRECT, points, normals)
    assert (lit.gain + lit.ambient).max() < 235
    exposure = Exposure.of(RIG, DIRECT.changed("camera", **camera_noise(1.0)))
    for seed in range(5):
        read = exposure.expose([0, 51], lit, ALL_PIXELS, (seed, "a", "A0"))
        assert read.max() < 250


# ---- reflectance: GGX against Walter et al.'s formulas as printed


def directions(cosine, azimuth):
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1)


def printed_ggx(light, view, roughness):
    """f of a GGX conductor without Fresnel loss, (n,): Walter et al. 2007, equations 33, 34 and 20,
    with angles."""
    alpha = roughness**2
    half = light + view
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    theta = np.arccos(half[..., 2])
    d = alpha**2 / (np.pi * np.cos(theta) ** 4 * (alpha**2 + np.tan(theta) ** 2) ** 2)

    def g1(direction):
        return 2 / (1 + np.sqrt(1 + alpha**2 * np.tan(np.arccos(direction[..., 2])) ** 2))

    return d * g1(light) * g1(view) / (4 * light[..., 2] * view[..., 2])


def pi_f(light, view, albedo, gloss, roughness):
    half = light + view
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    return reflectance(light[..., 2], view[..., 2], half[..., 2], albedo, gloss, roughness)


def pairs(n=5000):
    rng = np.random.default_rng(1)
    return [directions(rng.uniform(0.02, 1, n), rng.uniform(0, 2 * np.pi, n)) for _ in range(2)]


def test_a_matte_surface_is_the_same_from_everywhere():
    light, view = pairs()
    np.testing.assert_array_equal(pi_f(light, view, 0.8, 0.0, 0.5), 0.8)
    albedo = np.linspace(0, 1, len(light))
    np.testing.assert_array_equal(pi_f(light, view, albedo, 0.0, 0.5), albedo)


@pytest.mark.parametrize("roughness", [0.1, 0.25, 0.5, 0.95])
@pytest.mark.parametrize("gloss", [0.2, 1.0])
def test_glossy_lobe_is_the_printed_formula(roughness, gloss):
    light, view = pairs()
    expected = (1 - gloss) * 0.7 + gloss * np.pi * printed_ggx(light, view, roughness)
    np.testing.assert_allclose(pi_f(light, view, 0.7, gloss, roughness), expected, rtol=1e-9)


def test_grazing_directions_stay_finite():
    zero = np.zeros(3)
    values = reflectance(zero, zero, np.array([0.0, 0.5, 1.0]), 0.8, 0.5, 0.05)
    assert np.isfinite(values).all() and (values >= 0).all()
