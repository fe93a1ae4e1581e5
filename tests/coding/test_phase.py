"""Phase, modulation and mean against closed forms, and the paper's Eq. 2."""

import numpy as np
import pytest

from fpp_ml_bench.coding.phase_shift import choose_steps, phase_weights, wrapped_phase
from fpp_ml_bench.decoding.blocks import CLIPPED_STEPS_DIVISOR
from fpp_ml_bench.errors import DecodeError


def frames_of(phase, shifts, mean=120.0, modulation=80.0):
    return mean + modulation * np.cos(np.asarray(phase) + np.reshape(shifts, (-1, 1, 1)))


def equal(count):
    return 2 * np.pi * np.arange(count) / count


@pytest.mark.parametrize("count", [3, 4, 7, 18])
@pytest.mark.parametrize("dtype, rounding", [(np.float64, 0), (np.float32, 2**-24)])
def test_exact_frames_give_exact_phase(count, dtype, rounding):
    """All sums are float64; their results are rounded once to ``dtype``."""
    phase = np.linspace(-np.pi, np.pi, 400, endpoint=False).reshape(8, 50)
    wrapped = wrapped_phase(frames_of(phase, equal(count)), dtype=dtype)
    assert all(array.dtype == dtype for array in wrapped)
    difference = np.angle(np.exp(1j * (wrapped.phase.astype(np.float64) - phase)))
    assert np.abs(difference).max() < 1e-13 + rounding * np.pi
    assert (wrapped.phase >= -np.pi).all() and (wrapped.phase < np.pi).all()
    np.testing.assert_allclose(wrapped.modulation, 80, rtol=1e-12 + rounding)
    np.testing.assert_allclose(wrapped.mean, 120, rtol=1e-12 + rounding)


def test_equal_steps_are_the_papers_equation():
    frames = np.random.default_rng(0).integers(0, 256, (18, 20, 30), dtype=np.uint8)
    delta = equal(18).reshape(-1, 1, 1)
    expected = -np.arctan2(
        (frames * np.sin(delta)).sum(axis=0), (frames * np.cos(delta)).sum(axis=0)
    )
    np.testing.assert_allclose(wrapped_phase(frames).phase, expected, atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_plus_pi_comes_out_as_minus_pi(dtype):
    for frames in ([0, 1, 2, 1], [0.0, 5.0, 10.0, 5.0]):  # cos(phi + delta) with phi = pi
        stack = np.array(frames, dtype=dtype).reshape(4, 1, 1)
        assert wrapped_phase(stack, dtype=dtype).phase[0, 0] == dtype(-np.pi)
    # Just below pi in float64 rounds up to pi in float32.
    wrapped = wrapped_phase(frames_of([[np.pi - 1e-9]], equal(18)), dtype=np.float32)
    assert wrapped.phase[0, 0] == np.float32(-np.pi)


@pytest.mark.parametrize("count", range(3, 19))
def test_chosen_steps_are_distinct_even_and_sufficient(count):
    chosen = choose_steps(18, count)
    assert len(set(chosen)) == count and chosen[0] == 0 and max(chosen) < 18
    gaps = np.diff([*chosen, 18])
    assert gaps.max() - gaps.min() <= 1
    if 18 % count == 0:
        assert chosen == tuple(range(0, 18, 18 // count))
    # The noise gain of the weights stays within a tenth of that of equal steps, sqrt(2 / n).
    gain = np.sqrt((phase_weights(2 * np.pi * np.array(chosen) / 18)[1:] ** 2).sum(axis=1)).max()
    assert gain < 1.1 * np.sqrt(2 / count)


@pytest.mark.parametrize("count", [2, 19, 4.0, True])
def test_impossible_numbers_of_steps_are_refused(count):
    with pytest.raises(DecodeError, match="3 to the 18"):
        choose_steps(18, count)


@pytest.mark.parametrize("steps", [9, 12, 18, 27])
def test_the_clipping_that_the_decoder_allows_moves_the_phase_by_under_five_mrad(steps):
    """What `CLIPPED_STEPS_DIVISOR` promises, by exhaustion over phase and clipping level."""
    phase = np.linspace(-np.pi, np.pi, 2000, endpoint=False).reshape(1, -1)
    worst = 0.0
    for ceiling in np.linspace(0.5, 1.0, 60):
        frames = np.minimum(np.cos(phase + equal(steps).reshape(-1, 1, 1)), ceiling)
        allowed = (frames >= ceiling).sum(axis=0) <= steps // CLIPPED_STEPS_DIVISOR
        error = np.angle(np.exp(1j * (wrapped_phase(frames).phase - phase)))
        worst = max(worst, np.abs(error[allowed]).max(initial=0.0))
    assert 0 < worst < 5e-3


@pytest.mark.parametrize(
    "frames, arguments, message",
    [
        (np.zeros((2, 3, 3)), {}, "at least 3 frames, got 2"),
        (
            [np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 4))],
            {},
            r"frame 2: expected shape.*\(3, 4\)",
        ),
        (np.zeros((3, 3, 3), dtype=complex), {}, "dtype complex128"),
        (np.zeros((3, 3, 3)), {"dtype": np.float16}, "float32 or float64"),
        (np.zeros((3, 3, 3)), {"shifts_rad": [0, 1, 2, 3]}, "each of the 3 frames, got 4"),
        (np.zeros((3, 3, 3)), {"shifts_rad": [0, 1, np.nan]}, "finite"),
        (np.zeros((3, 3, 3)), {"shifts_rad": [0, 1e-9, 2e-9]}, "don't determine"),
    ],
)
def test_frames_that_hold_no_phase_are_refused(frames, arguments, message):
    with pytest.raises(DecodeError, match=message):
        wrapped_phase(frames, **arguments)


def test_weights_of_the_chosen_subset_are_the_least_squares_solution():
    shifts = 2 * np.pi * np.array([0, 4, 7, 11, 14]) / 18
    model = np.stack([np.ones(5), np.cos(shifts), np.sin(shifts)], axis=1)
    np.testing.assert_allclose(
        phase_weights(shifts), np.linalg.lstsq(model, np.eye(5), rcond=None)[0], atol=1e-14
    )
