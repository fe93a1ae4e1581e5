"""Elementary functions that give the same bits on every processor, for what decides a byte of a
dataset.

The last bits of NumPy, the C library and BLAS differ between processors; the operations here
(addition, multiplication, division, square root) IEEE 754 rounds correctly.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

_COSINE = [(-1.0) ** k / math.factorial(2 * k) for k in range(9)]
_SINE = [(-1.0) ** k / math.factorial(2 * k + 1) for k in range(9)]
_EXPONENTIAL = [1.0 / math.factorial(k) for k in range(15)]
_LOGARITHM = [2.0 / (2 * k + 1) for k in range(12)]
"""Taylor coefficients; the first one left out is below 2^-56 of the result over the reduced range
of each function."""
_LN2 = 0.6931471805599453


def _polynomial(x: NDArray[np.float64], coefficients: Sequence[float]) -> NDArray[np.float64]:
    """Horner's rule, lowest coefficient first."""
    total = np.full(x.shape, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total *= x
        total += coefficient
    return total


def _cosine_and_sine(turns: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    t = np.asarray(turns, dtype=np.float64)
    quarter = np.rint(4.0 * t)
    x = 2.0 * math.pi * (t - quarter / 4.0)
    square = x * x
    cosine, sine = _polynomial(square, _COSINE), x * _polynomial(square, _SINE)
    place = np.mod(quarter, 4.0)
    swapped = (place == 1) | (place == 3)
    first, second = np.where(swapped, sine, cosine), np.where(swapped, cosine, sine)
    first = np.where((place == 1) | (place == 2), -first, first)
    second = np.where((place == 2) | (place == 3), -second, second)
    return first + 0.0, second + 0.0  # no negative zero


def cosine_of_turns(turns: ArrayLike) -> NDArray[np.float64]:
    """cos(2 pi ``turns``), float64 of the same shape, within 2^-52; exact at whole, half and
    quarter turns."""
    return _cosine_and_sine(turns)[0]


def sine_of_turns(turns: ArrayLike) -> NDArray[np.float64]:
    """sin(2 pi ``turns``), as `cosine_of_turns`."""
    return _cosine_and_sine(turns)[1]


def power(base: NDArray[np.float64], exponent: float) -> NDArray[np.float64]:
    """``base ** exponent`` of numbers from 0 to 1, float64, relative error below 1e-15 for
    exponents up to 10."""
    mantissa, binary = np.frexp(np.maximum(base, np.finfo(np.float64).tiny))
    low = mantissa < math.sqrt(0.5)
    mantissa = np.where(low, 2.0 * mantissa, mantissa)
    s = (mantissa - 1.0) / (mantissa + 1.0)
    logarithm = s * _polynomial(s * s, _LOGARITHM) + (binary - low) * _LN2
    return np.where(base > 0.0, exponential(exponent * logarithm), 0.0 if exponent > 0 else 1.0)


def exponential(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """e to the ``x``, float64 of the same shape, relative error below 1e-15 for x from -20 to
    20."""
    whole = np.rint(x / _LN2)
    return np.ldexp(_polynomial(x - whole * _LN2, _EXPONENTIAL), whole.astype(np.int32))


def gaussian_weights(variance: float, sigmas: float = 4.0) -> NDArray[np.float64]:
    """A Gaussian of ``variance`` > 0 samples^2 at whole samples, up to ``sigmas``, summing to 1;
    float64 (2 r + 1,). Below 0.4, where samples of a Gaussian have another variance, the three
    weights that have it."""
    if variance < 0.4:
        return np.array([variance / 2, 1.0 - variance, variance / 2])
    reach = math.ceil(sigmas * math.sqrt(variance))
    weights = exponential(np.arange(-reach, reach + 1.0) ** 2 / (-2.0 * variance))
    return weights / math.fsum(weights)


def dot(a: NDArray, b: NDArray) -> NDArray[np.float64]:
    """Dot products along the second axis, of three entries, added in order: `einsum` may fuse
    multiplications and additions."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def matrix_product(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix product of (3, 3) and (3, n), added in order."""
    return a[:, :1] * b[0] + a[:, 1:2] * b[1] + a[:, 2:] * b[2]
