"""Unit round-offs, and the 50-digit arithmetic that references are computed in."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

U64 = 2.0**-53
U32 = 2.0**-24
U16 = 2.0**-11
UB16 = 2.0**-8
DIGITS = 50


def high_precision() -> Any:
    """A separate mpmath context of `DIGITS` digits, so that the global precision does not change."""
    import mpmath

    context = mpmath.MPContext()
    context.dps = DIGITS
    return context


def gamma(operations: float, unit: float = U64) -> float:
    """Largest relative error of ``operations`` roundings in a row: n u / (1 - n u)  (Higham, Lemma 3.1)."""
    return operations * unit / (1 - operations * unit)


def floats(values: Iterable[Any]) -> NDArray[np.float64]:
    """High-precision numbers rounded once to float64."""
    return np.array([float(value) for value in values])


def difference(values: NDArray, exact: Iterable[Any]) -> NDArray[np.float64]:
    """``values`` (n,) minus high-precision numbers, subtracted before it is rounded."""
    context = high_precision()
    return np.array([float(context.mpf(float(a)) - b) for a, b in zip(values, exact, strict=True)])


def angle_between(values: NDArray, exact: NDArray) -> NDArray[np.float64]:
    """Difference of angles in rad, on the circle."""
    return np.angle(np.exp(1j * (np.asarray(values, float) - np.asarray(exact, float))))
