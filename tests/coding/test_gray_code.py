"""The half-period Gray code: against its definition, at every sub-pixel position, with noise, blur
and damage."""

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
    expected = [
        position[cell == j].mean() * 2 * np.pi / pitch for j in range(cell_count(length, pitch))
    ]
    np.testing.assert_allclose(cell_centres_rad(length, pitch), expected, atol=1e-12)


def code_of(pitch, bits, steps):
    """A period in equal steps, and Gray code in half periods."""
    return PhaseShift((Fringes(pitch, equal_shifts(steps, 1)),), 0.0, GrayCells(pitch / 2, bits))


def decoded(levels, pitch, steps):
    """What the code makes of grey levels (frames, n)."""
    return code_of(pitch, len(levels) - steps, steps).decode(levels, 912, Limits())


def captured_at(u, pitch, blur_px, noise, modulation, gray_shift_px=0.0):
    """Grey levels (frames, n) at sub-pixel positions u of 18 steps and the code, box-blurred as by
    a camera pixel; the code is displaced by ``gray_shift_px`` against the sinusoids, as a misread
    edge would be."""
    profiles = code_of(pitch, bits_needed(912, pitch), 18).profiles(912)
    levels = []
    for row, profile in enumerate(profiles):
        at = u + (gray_shift_px if row >= 18 else 0.0)
        offsets = blur_px * np.linspace(-0.5, 0.5, 9)
        levels.append(
            np.mean([np.interp(at + offset, np.arange(912), profile) for offset in offsets], axis=0)
        )
    error = noise * np.random.default_rng(1).standard_normal((len(levels), u.size))
    return np.clip(np.rint(10 + modulation / 127.5 * np.array(levels) + error), 0, 255)


@pytest.mark.long
@pytest.mark.parametrize("pitch", [18, 12.8, 6])
@pytest.mark.parametrize(
    "blur_px, noise, modulation", [(0.0, 1.0, 60.0), (1.5, 2.0, 40.0), (3.0, 1.5, 25.0)]
)
def test_no_position_ever_slips_a_period(pitch, blur_px, noise, modulation):
    u = np.arange(2, 909, 0.0137)
    measured = decoded(captured_at(u, pitch, blur_px, noise, modulation), pitch, 18)
    trusted = measured.reason == Reason.DECODED
    assert (
        np.abs(measured.coordinate_px - u)[trusted].max() < pitch / 8
    )  # an order wrong by 1 is a whole pitch
    assert trusted.mean() > 0.999


@pytest.mark.parametrize("shift", [-4.0, 4.0])
def test_code_edges_may_be_off_by_almost_a_quarter_period(shift):
    """Misread cells at the edges: displaced by up to 4 px of 18, under a quarter period (4.5 px),
    no order is wrong."""
    u = np.arange(6, 900, 0.05)
    measured = decoded(captured_at(u, 18, 1.0, 0.5, 60.0, gray_shift_px=shift), 18, 18)
    assert np.abs(measured.coordinate_px - u).max() < 1.0


def test_a_single_ambiguous_bit_is_trusted_only_at_its_edge():
    bits, mean, modulation = 5, np.full((1, 1), 100.0), np.full((1, 1), 50.0)
    for cell in range(2**bits):
        code = [
            100 + 50 * (1 if binary_to_gray(cell) >> (bits - 1 - b) & 1 else -1)
            for b in range(bits)
        ]
        for blurred in range(bits):
            frames = np.array(code, dtype=float).reshape(bits, 1, 1)
            frames[blurred] = 100 + (3 if frames[blurred] > 100 else -3)
            cells, trusted = decode_cells(frames, mean, modulation)
            neighbour = gray_to_binary(binary_to_gray(cell) ^ (1 << (bits - 1 - blurred)))
            assert cells[0, 0] == cell
            assert trusted[0, 0] == (abs(int(neighbour) - cell) == 1)
            frames[(blurred + 1) % bits] = 101
            assert not decode_cells(frames, mean, modulation)[
                1
            ].any()  # two ambiguous bits are never trusted


def test_phase_on_the_far_side_of_the_circle_and_cells_off_the_pattern_are_rejected():
    far = levels_of(cell_centres_rad(912, 18) + 0.9 * np.pi, np.arange(102))
    beyond = levels_of(np.zeros(2), np.array([102, 127]))
    for levels in (far, beyond):
        assert (decoded(levels, 18, 4).reason == Reason.INCONSISTENT_ORDER).all()


def levels_of(phase, cell):
    """Four steps and seven bits of mean 100 and modulation 50, (11, n)."""
    steps = [100 + 50 * np.cos(phase + step * np.pi / 2) for step in range(4)]
    bits = [100 + 50 * (2 * (binary_to_gray(cell) >> (6 - bit) & 1) - 1) for bit in range(7)]
    return np.array([*steps, *bits])
