"""Reflectance: the matte part, GGX against Walter et al.'s formulas as printed, reciprocity, conservation of energy."""

import numpy as np
import pytest

from fpp_ml_bench.loaders.render.illumination import reflectance


def directions(cosine, azimuth):
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1)


def printed_ggx(light, view, roughness):
    """f of a GGX conductor without Fresnel loss, (n,): Walter et al. 2007, equations 33, 34 and 20, with angles."""
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


def test_light_and_view_may_change_places():
    light, view = pairs()
    np.testing.assert_allclose(pi_f(light, view, 0.7, 0.4, 0.3), pi_f(view, light, 0.7, 0.4, 0.3), rtol=1e-12)


def returned_share(view_cosine, albedo, gloss, roughness, n=400):
    """Share of the light from ``view_cosine`` that leaves again, by the midpoint rule: over the whole hemisphere for
    the matte part, and over half vectors spread like the facets (eq. 35) for the lobe."""
    alpha = roughness**2
    xi, turn = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n * 2 * np.pi)
    cosine = np.sqrt((1 - xi) / (1 + xi * (alpha**2 - 1)))
    half = directions(cosine, turn)
    view = directions(np.array(view_cosine), np.array(0.0))
    along = (half * view).sum(axis=-1)
    light = 2 * along[..., None] * half - view
    seen = (light[..., 2] > 1e-6) & (along > 0)
    facets = alpha**2 / (np.pi * (cosine**2 * (alpha**2 - 1) + 1) ** 2)
    lobe = reflectance(light[..., 2], np.broadcast_to(view_cosine, cosine.shape), cosine, 0.0, gloss, roughness)
    # d light = 4 (view . half) d half, and half vectors have the density D cos.
    share = np.where(seen, lobe / np.pi * light[..., 2] * 4 * along / (facets * cosine), 0).mean()
    matte = reflectance(np.array([0.5]), np.array([0.5]), np.array([0.5]), albedo, 0.0, roughness)[0] * (1 - gloss)
    return matte + share


@pytest.mark.parametrize("roughness", [0.05, 0.25, 0.5, 0.95])
def test_no_more_light_leaves_than_arrives(roughness):
    for view_cosine in (0.05, 0.3, 0.7, 0.999):
        for gloss in (0.3, 1.0):
            share = returned_share(view_cosine, 0.95, gloss, roughness)
            assert share <= (1 - gloss) * 0.95 + gloss + 1e-3
            assert share > (1 - gloss) * 0.95
    # A nearly smooth mirror returns all of it: Smith's term hides next to nothing.
    assert returned_share(0.9, 0.95, 1.0, 0.05) == pytest.approx(1.0, abs=2e-3)


def test_grazing_directions_stay_finite():
    zero = np.zeros(3)
    values = reflectance(zero, zero, np.array([0.0, 0.5, 1.0]), 0.8, 0.5, 0.05)
    assert np.isfinite(values).all() and (values >= 0).all()
