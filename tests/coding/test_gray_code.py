"""The half-period Gray code: against its definition, at every sub-pixel position, with noise, blur and damage."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fpp_ml_bench.coding.gray_code import (
    absolute_phase,
    binary_to_gray,
    bits_needed,
    cell_centres_rad,
    cell_count,
    cell_of,
    decode_cells,
    gray_to_binary,
)
from fpp_ml_bench.coding.phase_shift import wrapped_phase


def test_code_is_the_reflected_code():
    # Built by reflection, which is how the code is defined.
    code = [0, 1]
    while len(code) < 1024:
        code += [value + len(code) for value in reversed(code)]
    assert binary_to_gray(np.arange(1024)).tolist() == code
    assert gray_to_binary(code).tolist() == list(range(1024))


@given(st.lists(st.integers(0, 2**31 - 1), min_size=1, max_size=50))
def test_code_round_trips(values):
    assert gray_to_binary(binary_to_gray(values)).tolist() == values


@pytest.mark.parametrize(
    "length, pitch, cells, bits",
    [
        (912, 18, 102, 7),
        (1140, 18, 127, 7),
        (1140, 17, 135, 8),
        (1152, 18, 128, 7),
        (1153, 18, 129, 8),
        (8, 8, 2, 1),
        (64, 12.8, 10, 4),
    ],
)
def test_cells_and_bits(length, pitch, cells, bits):
    assert cell_count(length, pitch) == cells and bits_needed(length, pitch) == bits
    assert len(np.unique(cell_of(np.arange(length), pitch))) == cells


@pytest.mark.parametrize("pitch", [4, 5, 7.5, 12.8, 18, 21.3])
def test_centres_are_the_means_of_the_pixels(pitch):
    length = round(pitch * 6)
    position = np.arange(2 * length)
    cell = cell_of(position, pitch)
    expected = [position[cell == j].mean() * 2 * np.pi / pitch for j in range(cell_count(length, pitch))]
    np.testing.assert_allclose(cell_centres_rad(length, pitch), expected, atol=1e-12)


def captured_at(u, pitch, length, steps, blur_px, noise, modulation, seed, gray_shift_px=0.0):
    """Frames at sub-pixel positions u, (frames, 1, n): interpolated and box-blurred as by a camera pixel.

    ``gray_shift_px`` displaces the code against the sinusoids, as a misread edge would.
    """
    rng = np.random.default_rng(seed)
    bits = bits_needed(length, pitch)
    w = np.arange(length)
    gray = binary_to_gray(cell_of(w, pitch))
    sinusoids = [127.5 + 127.5 * np.cos(2 * np.pi * (w / pitch + n / steps)) for n in range(steps)]
    codes = [(gray >> (bits - 1 - b) & 1) * 255.0 for b in range(bits)]
    offsets = np.linspace(-blur_px / 2, blur_px / 2, 9)
    scale = modulation / 127.5
    images = []
    for profile, shift in [(np.rint(s), 0.0) for s in sinusoids] + [(c, gray_shift_px) for c in codes]:
        grey = np.mean([np.interp(u + o + shift, w, profile) for o in offsets], axis=0)
        images.append(np.rint(10 + scale * grey + noise * rng.standard_normal(u.shape)))
    return np.clip(np.stack(images)[:, None, :], 0, 255)


def orders(images, pitch, length, steps):
    wrapped = wrapped_phase(images[:steps])
    cells, trusted = decode_cells(images[steps:], wrapped.mean, wrapped.modulation)
    phase, consistent = absolute_phase(wrapped.phase, cells, cell_centres_rad(length, pitch))
    return phase[0] * pitch / (2 * np.pi), (trusted & consistent)[0]


@pytest.mark.parametrize("pitch, length", [(18, 912), (18, 1140), (12.8, 400), (6, 200)])
@pytest.mark.parametrize("blur_px, noise, modulation", [(0.0, 1.0, 60.0), (1.5, 2.0, 40.0), (3.0, 1.5, 25.0)])
def test_no_position_ever_slips_a_period(pitch, length, blur_px, noise, modulation):
    u = np.arange(2, length - 3, 0.0137)
    measured, trusted = orders(captured_at(u, pitch, length, 18, blur_px, noise, modulation, seed=1), pitch, length, 18)
    assert np.abs(measured - u)[trusted].max() < pitch / 8  # an order wrong by 1 is a whole pitch
    assert trusted.mean() > 0.999


@pytest.mark.parametrize("shift", [-4.0, -3.0, -1.0, 1.0, 3.0, 4.0])
def test_code_edges_may_be_off_by_almost_a_quarter_period(shift):
    """Misread cells at the edges: displaced by up to 4 px of 18, under a quarter period (4.5 px), no order is wrong."""
    u = np.arange(6, 900, 0.05)
    images = captured_at(u, 18, 912, 18, 1.0, 0.5, 60.0, seed=2, gray_shift_px=shift)
    wrapped = wrapped_phase(images[:18])
    cells, _ = decode_cells(images[18:], wrapped.mean, wrapped.modulation)
    phase, _ = absolute_phase(wrapped.phase, cells, cell_centres_rad(912, 18))
    assert np.abs(phase[0] * 18 / (2 * np.pi) - u).max() < 1.0


def test_a_single_ambiguous_bit_is_trusted_only_at_its_edge():
    bits, mean, modulation = 5, np.full((1, 1), 100.0), np.full((1, 1), 50.0)
    for cell in range(2**bits):
        code = [100 + 50 * (1 if binary_to_gray(cell) >> (bits - 1 - b) & 1 else -1) for b in range(bits)]
        for blurred in range(bits):
            frames = np.array(code, dtype=float).reshape(bits, 1, 1)
            frames[blurred] = 100 + (3 if frames[blurred] > 100 else -3)
            cells, trusted = decode_cells(frames, mean, modulation)
            neighbour = gray_to_binary(binary_to_gray(cell) ^ (1 << (bits - 1 - blurred)))
            assert cells[0, 0] == cell
            assert trusted[0, 0] == (abs(int(neighbour) - cell) == 1)
            frames[(blurred + 1) % bits] = 101
            assert not decode_cells(frames, mean, modulation)[1].any()  # two ambiguous bits are never trusted


@given(cell=st.integers(0, 101), offset=st.floats(-0.49, 0.49))
@settings(max_examples=200, deadline=None)
def test_consistent_pairs_are_kept_and_give_the_position(cell, offset):
    centres = cell_centres_rad(912, 18)
    phase = centres[cell] + offset * np.pi
    wrapped = np.array([[(phase + np.pi) % (2 * np.pi) - np.pi]])
    absolute, good = absolute_phase(wrapped, np.array([[cell]], dtype=np.int32), centres)
    assert good.all() and absolute[0, 0] == pytest.approx(phase, abs=1e-9)


def test_phase_on_the_far_side_of_the_circle_and_cells_off_the_pattern_are_rejected():
    centres = cell_centres_rad(912, 18)
    wrapped = (centres[:, None] + 0.9 * np.pi + np.pi) % (2 * np.pi) - np.pi
    assert not absolute_phase(wrapped, np.arange(102, dtype=np.int32)[:, None], centres)[1].any()
    beyond = np.array([[102, 127]], dtype=np.int32)
    assert not absolute_phase(np.zeros((1, 2)), beyond, centres)[1].any()
