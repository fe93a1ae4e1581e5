"""The portable elementary functions against 50 digits."""

import mpmath
import numpy as np
import pytest

from fpp_ml_bench.portable import cosine_of_turns, power, sine_of_turns

mpmath.mp.dps = 50


def test_cosine_and_sine_within_two_units_in_the_last_place():
    turns = np.concatenate(
        [np.linspace(-2, 2, 4001), np.random.default_rng(0).uniform(-60, 60, 2000)]
    )
    for function, exact in ((cosine_of_turns, mpmath.cos), (sine_of_turns, mpmath.sin)):
        expected = np.array([float(exact(2 * mpmath.pi * mpmath.mpf(float(t)))) for t in turns])
        np.testing.assert_allclose(function(turns), expected, rtol=0, atol=2.0**-52)


def test_quarter_turns_are_exact():
    turns = np.arange(-8, 9) / 4
    np.testing.assert_array_equal(cosine_of_turns(turns), [1, 0, -1, 0] * 4 + [1])
    np.testing.assert_array_equal(sine_of_turns(turns), [0, 1, 0, -1] * 4 + [0])
    assert cosine_of_turns(0.25).shape == () and not np.signbit(cosine_of_turns(0.25))


@pytest.mark.parametrize("exponent", [0.0, 0.4555, 1.0, 2.5, 10.0])
def test_power(exponent):
    base = np.concatenate([10.0 ** np.linspace(-12, 0, 1001), np.linspace(0.4, 1, 501)])
    expected = np.array(
        [float(mpmath.power(mpmath.mpf(float(b)), mpmath.mpf(exponent))) for b in base]
    )
    # An error of one unit in exponent x log of the base, at most 280 here, is that much relative to
    # the power.
    allowed = 4e-16 * np.maximum(1, exponent * np.abs(np.log(base)))
    assert (np.abs(power(base, exponent) - expected) <= allowed * expected).all()
    assert power(np.array([0.0, 1.0]), exponent).tolist() == (
        [1.0, 1.0] if exponent == 0 else [0.0, 1.0]
    )
