"""Reflectance: the matte part, GGX against Walter et al.'s formulas as printed, grazing
directions."""

import numpy as np
import pytest

from fpp_ml_bench.loaders.render.illumination import reflectance


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
