"""The projector: response, blur of sinusoids and Gray edges against closed forms, where points read
a pattern."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from rendering import PAPER, RIG
from scipy.special import erf

from fpp_ml_bench.loaders.render.projector import (
    PatternLight,
    response_table,
)
from fpp_ml_bench.optics.patterns import pattern_profiles
from fpp_ml_bench.optics.sequence import Sequence

SMALL = replace(RIG, sequence=Sequence(steps=3))
"""Fewer frames, the same patterns."""
PITCH = 18.0
DISTANCES_M = np.array([1.5, 1.6, 1.7, 1.8, 1.9, 2.0, 2.1, 2.6, 3.2])


def projector(**values):
    return PAPER.changed("projector", **values).projector


@cache
def pattern_light(light, pixel_area=False):
    return PatternLight.of(SMALL, light, pixel_area)


def read(light, frame, coordinate_px, distance_m, pixel_area=False):
    """Light (n,) of a frame at projector coordinates (n,), along the one it varies with, at a
    distance."""
    pattern = pattern_light(light, pixel_area)
    place = pattern.place(
        coordinate_px, coordinate_px, np.full(coordinate_px.size, distance_m), SMALL, light
    )
    return pattern.read(place, np.ones(coordinate_px.size))[frame]


def modulation(light, frame, distance_m, pixel_area=False):
    """Amplitude of the fundamental over 20 periods."""
    w = 270 + np.arange(20 * 18 * 16) / 16
    return 2 * abs(
        np.mean(read(light, frame, w, distance_m, pixel_area) * np.exp(-2j * np.pi * w / PITCH))
    )


def sigma_px(light, distance_m):
    """By hand: grows with the difference in dioptres, and is ``defocus_px`` at 2.1 m."""
    return light.defocus_px * abs(
        (1 / distance_m - 1 / light.focus_m) / (1 / 2.1 - 1 / light.focus_m)
    )


def test_response_is_a_power_or_a_measured_curve():
    level = np.arange(256) / 255
    np.testing.assert_array_equal(response_table(1.0), level)
    for power in (0.45, 2.2):
        np.testing.assert_allclose(response_table(power), level**power, rtol=1e-14)
    curve = (0.0, 0.1, 0.35, 1.0)
    by_hand = [0.0, 0.1, 0.1 + 0.25 * (3 * 127 / 255 - 1), 0.35, 1.0]
    np.testing.assert_allclose(response_table(curve)[[0, 85, 127, 170, 255]], by_hand, atol=1e-12)
    assert (np.diff(response_table(curve)) > 0).all()


@pytest.mark.parametrize("response", [1.0, 2.2, (0.0, 0.2, 1.0)])
def test_every_pattern_level_shines_by_the_response(response):
    light = projector(response=response)
    w = np.arange(912.0)
    for index, profile in enumerate(pattern_profiles(SMALL)[:, :912]):
        expected = response_table(response)[
            profile if len(set(profile)) > 1 else np.full(912, profile[0])
        ]
        if SMALL.sequence.frames[index].direction == "vertical":
            expected[911] = read(light, index, w, 1.8)[
                911
            ]  # the last pixel of the row is checked below
        np.testing.assert_allclose(read(light, index, w, 1.8), expected, atol=1e-7)


@pytest.mark.long
@pytest.mark.parametrize("frame", [0, 4])  # horizontal, vertical
@pytest.mark.parametrize(
    "light",
    [
        projector(pixel_blur_px=0.5),
        projector(pixel_blur_px=2.0),
        projector(pixel_blur_px=0.5, defocus_px=1.5),
        projector(defocus_px=3.0, focus_m=1.7),
    ],
)
def test_blur_takes_the_modulation_that_a_gaussian_takes(light, frame):
    """Against exp(-2 pi^2 sigma^2 / P^2) of what there is without blur, at nine distances."""
    sharp = modulation(projector(), frame, 1.8)
    for distance_m in DISTANCES_M if light.defocus_px else [1.8]:
        variance = light.pixel_blur_px**2 + sigma_px(light, distance_m) ** 2
        left = modulation(light, frame, distance_m) / sharp
        assert left == pytest.approx(
            np.exp(-2 * np.pi**2 * variance / PITCH**2), rel=5e-3, abs=5e-4
        ), distance_m


def test_unblurred_modulation_is_that_of_lines_between_pixels():
    # Straight lines between samples P / 18 apart take 1 - sinc^2(1 / 18); rounding to 8 bit another
    # 0.2%.
    assert modulation(projector(), 0, 1.8) == pytest.approx(0.5 * np.sinc(1 / 18) ** 2, rel=2.5e-3)


@pytest.mark.parametrize(
    ("blur_px", "defocus_px", "distance_m", "tolerance"),
    [
        (0.8, 0.0, 1.8, 0.03),
        (2.0, 0.0, 1.8, 0.005),
        (0.8, 1.5, 2.1, 0.005),
    ],  # samples a pixel: 1, 1, 4
)
def test_gray_edge_is_soft_like_the_error_function(blur_px, defocus_px, distance_m, tolerance):
    """A step between pixels 455 and 456 (the first Gray bit of the vertical code changes at a cell
    of 9 px)."""
    light = projector(pixel_blur_px=blur_px, defocus_px=defocus_px)
    frame = SMALL.sequence.gray("vertical")[0]
    profile = pattern_profiles(SMALL)[frame][:912].astype(int)
    (edge,) = np.flatnonzero(np.diff(profile))[:1]
    w = edge + 0.5 + np.linspace(-6, 6, 97)
    sign = np.sign(profile[edge + 1] - profile[edge])
    # The line between two pixels is the step seen through a width of 1 px: variance 1/12 more.
    sigma = np.sqrt(blur_px**2 + sigma_px(light, distance_m) ** 2 + 1 / 12)
    expected = 0.5 + sign * 0.5 * erf((w - edge - 0.5) / (np.sqrt(2) * sigma))
    np.testing.assert_allclose(read(light, frame, w, distance_m), expected, atol=tolerance)


def test_a_camera_pixel_sees_the_mean_of_its_footprint():
    """Its width on the pattern, w, takes sinc(w / P); the Gaussian of the same variance 0.2% less
    at 176 px."""
    for frame, direction in ((0, "horizontal"), (4, "vertical")):
        width = PITCH / SMALL.image_px_per_period(direction)
        left = modulation(projector(), frame, 1.8, pixel_area=True) / modulation(
            projector(), frame, 1.8
        )
        assert left == pytest.approx(np.sinc(width / PITCH), rel=3e-3)
        assert left == pytest.approx(np.exp(-2 * np.pi**2 * width**2 / 12 / PITCH**2), rel=1e-3)
