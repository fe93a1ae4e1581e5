"""The half-period Gray code: against its definition, at every sub-pixel position, with noise, blur and damage."""

import numpy as np
import pytest

from fpp_ml_bench.coding.code import Limits, Reason
from fpp_ml_bench.coding.gray_code import (
    GrayCells,
    binary_to_gray,
    bits_needed,
    cell_centres_rad,
    cell_count,
    cell_of,
    decode_cells,
    gray_to_binary,
)
from fpp_ml_bench.coding.phase_shift import Fringes, PhaseShift, equal_shifts


def test_code_is_the_reflected_code():
    # Built by reflection, which is how the code is defined.
    code = [0, 1]
    while len(code) < 1024:
        code += [value + len(code) for value in reversed(code)]
    assert binary_to_gray(np.arange(1024)).tolist() == code
    assert gray_to_binary(code).tolist() == list(range(1024))


@pytest.mark.parametrize(
    "length, pitch, cells, bits",
    [
        (912, 18, 102, 7),
        (1140, 17, 135, 8),
        (1152, 18, 128, 7),
        (1153, 18, 129, 8),
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


def decoded(levels, pitch, length, steps):
    """What the code of a period in equal steps and Gray code in half periods makes of grey levels (frames, n)."""
    code = PhaseShift((Fringes(pitch, equal_shifts(steps, 1)),), 0.0, GrayCells(pitch / 2, len(levels) - steps))
    return code.decode(levels, length, Limits())


@pytest.mark.parametrize("pitch, length", [(18, 912), (12.8, 400), (6, 200)])
@pytest.mark.parametrize("blur_px, noise, modulation", [(0.0, 1.0, 60.0), (1.5, 2.0, 40.0), (3.0, 1.5, 25.0)])
def test_no_position_ever_slips_a_period(pitch, length, blur_px, noise, modulation):
    u = np.arange(2, length - 3, 0.0137)
    images = captured_at(u, pitch, length, 18, blur_px, noise, modulation, seed=1)
    measured = decoded(images[:, 0], pitch, length, 18)
    trusted = measured.reason == 0
    assert np.abs(measured.coordinate_px - u)[trusted].max() < pitch / 8  # an order wrong by 1 is a whole pitch
    assert trusted.mean() > 0.999


@pytest.mark.parametrize("shift", [-4.0, 4.0])
def test_code_edges_may_be_off_by_almost_a_quarter_period(shift):
    """Misread cells at the edges: displaced by up to 4 px of 18, under a quarter period (4.5 px), no order is wrong."""
    u = np.arange(6, 900, 0.05)
    images = captured_at(u, 18, 912, 18, 1.0, 0.5, 60.0, seed=2, gray_shift_px=shift)
    assert np.abs(decoded(images[:, 0], 18, 912, 18).coordinate_px - u).max() < 1.0


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


def test_phase_on_the_far_side_of_the_circle_and_cells_off_the_pattern_are_rejected():
    far = levels_of(cell_centres_rad(912, 18) + 0.9 * np.pi, np.arange(102))
    beyond = levels_of(np.zeros(2), np.array([102, 127]))
    for levels in (far, beyond):
        assert (decoded(levels, 18, 912, 4).reason == Reason.INCONSISTENT_ORDER).all()


def levels_of(phase, cell):
    """Four steps and seven bits of mean 100 and modulation 50, (11, n)."""
    steps = [100 + 50 * np.cos(phase + step * np.pi / 2) for step in range(4)]
    bits = [100 + 50 * (2 * (binary_to_gray(cell) >> (6 - bit) & 1) - 1) for bit in range(7)]
    return np.array([*steps, *bits])
