"""Gray code in half periods, and the fringe order from it.

The fringe order is the whole number k that brings ``phi + 2 pi k`` nearest to the cell's centre. A bit misread at an
edge gives the neighbouring cell, half a period away; but at an edge the true phase is a quarter of a period from BOTH
centres, so k stays right. The classical code with one cell per period has its edges where the phase wraps, and there
the order can be wrong by 1; a median filter hides such errors but moves depth edges.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

AMBIGUOUS_FRACTION = 0.25
"""A bit nearer to the threshold than this part of the modulation is ambiguous. A code bit swings by the full
modulation, so noise must reach 1.25 times the modulation before a clear bit is misread unnoticed."""
INCONSISTENT_RAD = 0.75 * math.pi
"""Largest accepted distance from absolute phase to cell centre: pi/2 reaches the cell's edge, pi/4 more allows for a
bit misread at the edge."""


def binary_to_gray(value: ArrayLike) -> NDArray[np.int64]:
    """Reflected binary (Gray) code of non-negative integers, int64."""
    number = np.asarray(value, dtype=np.int64)
    return number ^ (number >> 1)


def gray_to_binary(code: ArrayLike) -> NDArray[np.int64]:
    """Inverse of `binary_to_gray` for codes of up to 32 bits, int64."""
    number = np.array(code, dtype=np.int64)
    for shift in (1, 2, 4, 8, 16):
        number ^= number >> shift
    return number


def cell_of(position_px: ArrayLike, pitch_px: float) -> NDArray[np.int64]:
    """Number of the half-period cell that contains the projector pixel ``position_px`` (whole numbers), int64."""
    return np.floor(np.asarray(position_px, dtype=np.float64) / (pitch_px / 2)).astype(np.int64)


def cell_count(length_px: float, pitch_px: float) -> int:
    """Gray-code cells of half a period on a pattern ``length_px`` long."""
    return int(cell_of(length_px - 1, pitch_px)) + 1


def bits_needed(length_px: float, pitch_px: float) -> int:
    """Gray bits that tell all cells of a pattern apart: ceil(log2(cells)), at least 1."""
    return max(1, (cell_count(length_px, pitch_px) - 1).bit_length())


def cell_centres_rad(length_px: int, pitch_px: float) -> NDArray[np.float64]:
    """Absolute phase at the centre of the pixels of each cell, float64 (cells,): with 9 px per cell 9j + 4. Half a
    pixel later, at (j + 1/2) P/2, it would reduce the tolerance of a quarter period."""
    edges = np.ceil(np.arange(cell_count(length_px, pitch_px) + 1) * (pitch_px / 2))
    return (edges[:-1] + edges[1:] - 1) / 2 * (2 * np.pi / pitch_px)


def decode_cells(
    bits: ArrayLike, threshold: ArrayLike, modulation: ArrayLike, ambiguous_fraction: float = AMBIGUOUS_FRACTION
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Cell numbers and whether they can be trusted, int32 and bool (H, W), from the Gray frames of a direction.
    ``bits`` (n, H, W) grey levels, most significant bit first; ``threshold`` and ``modulation`` (H, W): the mean A and
    amplitude B of its sinusoids. A bit within ``ambiguous_fraction`` B of the threshold is ambiguous; a cell is trusted
    when no bit is, or when a single bit is and flipping it gives a neighbour."""
    mean, amplitude = np.asarray(threshold, dtype=np.float64), np.asarray(modulation, dtype=np.float64)
    margin = ambiguous_fraction * amplitude
    cells = np.zeros(mean.shape, dtype=np.int32)
    ambiguous = np.zeros(mean.shape, dtype=np.int32)
    previous = np.zeros(mean.shape, dtype=bool)
    dark, bright = mean - margin, mean + margin
    for frame in np.asarray(bits):
        previous = previous ^ (frame > mean)
        cells = cells * 2 + previous
        ambiguous = ambiguous * 2 + ((frame > dark) & (frame < bright))
    # The neighbours of n differ from it in bit 0 and in the lowest set bit of n (even) or n + 1 (odd).
    even = cells + (cells & 1)
    trusted = (ambiguous <= 1) | (ambiguous == (even & -even))
    return cells, trusted


def absolute_phase(
    phase: NDArray[np.float64], cells: NDArray[np.int32], centres_rad: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Absolute phase ``phi + 2 pi k`` with k nearest to the cell's centre, float64 rad (H, W), and whether the two
    agree, bool (H, W): the cell exists and its centre, of `cell_centres_rad`, is within `INCONSISTENT_RAD`."""
    centre = centres_rad[np.minimum(cells, len(centres_rad) - 1)]
    absolute = phase + 2 * np.pi * np.floor((centre - phase) / (2 * np.pi) + 0.5)
    return absolute, (cells < len(centres_rad)) & (np.abs(absolute - centre) <= INCONSISTENT_RAD)
