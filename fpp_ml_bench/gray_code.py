"""Gray code in half periods, and the fringe order from it.

A cell is half a fringe period, so the code and the wrapped phase overlap: phase alone fixes the position up to a whole
period, the cell only has to say which period, and of the two cells of a period the phase says which. The order is the
whole number k that brings ``phi + 2 pi k`` nearest to the cell's centre. A bit misread at a cell edge shifts the centre
by half a period at a place where the phase is a quarter of a period from both centres: k stays right, with a quarter
period to spare on each side. The classical one-cell-a-period code has its edge where the phase wraps and slips there by
2 pi; a median filter hides that slip and moves depth edges.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray


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
    """Cell of half a period that the projector pixel ``position_px`` (whole numbers) lies in, int64."""
    return np.floor(np.asarray(position_px, dtype=np.float64) / (pitch_px / 2)).astype(np.int64)
