"""Elementary functions that give the same bits on every processor, for what decides a byte of a dataset.

The last bits of NumPy, the C library and BLAS differ between processors; the operations here (addition,
multiplication, division, square root) IEEE 754 rounds correctly.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

_COSINE = [(-1.0) ** k / math.factorial(2 * k) for k in range(9)]
_SINE = [(-1.0) ** k / math.factorial(2 * k + 1) for k in range(9)]
_EXPONENTIAL = [1.0 / math.factorial(k) for k in range(15)]
_LOGARITHM = [2.0 / (2 * k + 1) for k in range(12)]
"""Taylor coefficients; the first one left out is below 2^-56 of the result over the reduced range of each function."""
ATAN_TOP = (
    -6.485021904942025371773e1,
    -1.228866684490136173410e2,
    -7.500855792314704667340e1,
    -1.615753718733365076637e1,
    -8.750608600031904122785e-1,
)
ATAN_BOTTOM = (
    1.945506571482613964425e2,
    4.853903996359136964868e2,
    4.328810604912902668951e2,
    1.650270098316988542046e2,
    2.485846490142306297962e1,
    1.0,
)
"""Cephes (Moshier 1989): atan(t) = t + t z P(z) / Q(z) with z = t^2 on [0, tan(pi/8)], lowest coefficient first."""
TAN_EIGHTH = math.sqrt(2.0) - 1.0
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
    """cos(2 pi ``turns``), float64 of the same shape, within 2^-52; exact at whole, half and quarter turns."""
    return _cosine_and_sine(turns)[0]


def sine_of_turns(turns: ArrayLike) -> NDArray[np.float64]:
    """sin(2 pi ``turns``), as `cosine_of_turns`."""
    return _cosine_and_sine(turns)[1]


def arctangent2(y: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """atan2(``y``, ``x``) in [-pi, pi], float64, to 2 units in the last place; 0 where both are 0. The same operations
    as in `fpp_ml_bench.decoding.kernels`, which is faster."""
    ax, ay = np.abs(x), np.abs(y)
    small, large = np.minimum(ax, ay), np.maximum(ax, ay)
    upper = small > TAN_EIGHTH * large
    top, bottom = np.where(upper, small - large, small), np.where(upper, small + large, large)
    t = top / np.where(bottom > 0.0, bottom, 1.0)
    z = t * t
    angle = t + t * z * (_polynomial(z, ATAN_TOP) / _polynomial(z, ATAN_BOTTOM))
    angle = np.where(upper, angle + math.pi / 4, angle)
    angle = np.where(ay > ax, math.pi / 2 - angle, angle)
    angle = np.where(x < 0.0, math.pi - angle, angle)
    return np.where(y < 0.0, -angle, angle)


def power(base: NDArray[np.float64], exponent: float) -> NDArray[np.float64]:
    """``base ** exponent`` of numbers from 0 to 1, float64, relative error below 1e-15 for exponents up to 10."""
    mantissa, binary = np.frexp(np.maximum(base, np.finfo(np.float64).tiny))
    low = mantissa < math.sqrt(0.5)
    mantissa = np.where(low, 2.0 * mantissa, mantissa)
    s = (mantissa - 1.0) / (mantissa + 1.0)
    logarithm = s * _polynomial(s * s, _LOGARITHM) + (binary - low) * _LN2
    return np.where(base > 0.0, exponential(exponent * logarithm), 0.0 if exponent > 0 else 1.0)


def exponential(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """e to the ``x``, float64 of the same shape, relative error below 1e-15 for x from -20 to 20."""
    whole = np.rint(x / _LN2)
    return np.ldexp(_polynomial(x - whole * _LN2, _EXPONENTIAL), whole.astype(np.int32))


def gaussian_weights(variance: float, sigmas: float = 4.0) -> NDArray[np.float64]:
    """A Gaussian of ``variance`` > 0 samples^2 at whole samples, up to ``sigmas``, summing to 1; float64 (2 r + 1,).
    Below 0.4, where samples of a Gaussian have another variance, the three weights that have it."""
    if variance < 0.4:
        return np.array([variance / 2, 1.0 - variance, variance / 2])
    reach = math.ceil(sigmas * math.sqrt(variance))
    weights = exponential(np.arange(-reach, reach + 1.0) ** 2 / (-2.0 * variance))
    return weights / math.fsum(weights)
