"""Wrapped phase, modulation and mean from N phase-shifted frames (paper Eqs. 1 and 2).

``I_n = A + B cos(phi + delta_n)`` with ``delta_n = 2 pi n / N`` is linear as ``A + C cos delta_n + S sin delta_n``, C =
B cos phi, S = -B sin phi: least squares is a weighted sum of the frames for each of A, C and S, and ``phi = -atan2(S,
C)``. For equal steps the weights are 1/N, (2/N) cos delta_n and (2/N) sin delta_n (Eq. 2).
"""

from collections.abc import Iterable
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.machine import numba_enabled
from fpp_ml_bench.portable import arctangent2, cosine_of_turns, sine_of_turns


class Phase(NamedTuple):
    """``phase`` in rad, [-pi, pi); ``modulation`` B and ``mean`` A in grey levels; all (H, W)."""

    phase: NDArray[np.floating]
    modulation: NDArray[np.floating]
    mean: NDArray[np.floating]


def compiled_kernels() -> ModuleType | None:
    """The codes' compiled kernels, or None where NumPy is to be used."""
    if not numba_enabled():
        return None
    from fpp_ml_bench.coding import kernels

    return kernels


def choose_steps(steps: int, count: int) -> tuple[int, ...]:
    """``count`` of ``steps`` frames, spread as evenly as they go: floor(i steps / count + 1/2). Raises `DecodeError`
    for fewer than 3 or more than ``steps``."""
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or not 3 <= count <= steps:
        raise DecodeError(f"steps: expected a whole number from 3 to the {steps} that were projected, got {count!r}")
    return tuple((2 * i * steps + count) // (2 * count) for i in range(count))


def phase_weights(shifts_rad: ArrayLike) -> NDArray[np.float64]:
    """Weights of the frames in A, C and S: float64 (3, N) for N phase shifts in rad. Closed form for equal steps, else
    the least-squares pseudo-inverse. Raises `DecodeError` for fewer than three different shifts."""
    shifts = np.asarray(shifts_rad, dtype=np.float64)
    if shifts.ndim != 1 or len(shifts) < 3 or not np.all(np.isfinite(shifts)):
        raise DecodeError(f"shifts_rad: expected at least 3 finite phase shifts in rad, got {shifts_rad!r}")
    count, turns = len(shifts), shifts / (2 * np.pi)
    model = np.stack([np.ones(count), cosine_of_turns(turns), sine_of_turns(turns)], axis=1)
    weights = model.T * np.array([[1.0], [2.0], [2.0]]) / count
    if np.abs(weights @ model - np.eye(3)).max() < 1e-12:
        return np.ascontiguousarray(weights)
    if np.linalg.cond(model) > 1e6:
        listed = shifts.tolist()
        raise DecodeError(f"shifts_rad: the shifts {listed} don't determine a phase; 3 different ones are needed")
    return np.ascontiguousarray(np.linalg.pinv(model))


def wrapped_phase(
    frames: Iterable[ArrayLike], shifts_rad: ArrayLike | None = None, dtype: DTypeLike = np.float64
) -> Phase:
    """Wrapped phase, modulation and mean of N >= 3 frames (N, H, W), or N images (H, W), in grey levels. ``shifts_rad``
    (N,) defaults to equal steps, 2 pi n / N. Sums are float64 whatever ``dtype`` (float32 or float64) the results have.
    A phase of exactly +pi comes out as -pi. Where nothing is modulated the phase means nothing: look at the modulation.
    Raises `DecodeError` for too few frames, unequal shapes, or dtypes that hold no grey levels."""
    if np.dtype(dtype) not in (np.dtype(np.float32), np.dtype(np.float64)):
        raise DecodeError(f"dtype: expected float32 or float64, got {np.dtype(dtype)}")
    images = [np.asarray(frame) for frame in frames]
    if len(images) < 3:
        raise DecodeError(f"a phase needs at least 3 frames, got {len(images)}")
    for i, image in enumerate(images):
        if image.ndim != 2 or image.shape != images[0].shape:
            raise DecodeError(f"frame {i}: expected shape (H, W) = {images[0].shape} like frame 0, got {image.shape}")
        if image.dtype.kind not in "uif":
            raise DecodeError(f"frame {i}: expected integer or real grey levels, got dtype {image.dtype}")
    if shifts_rad is None:
        shifts_rad = 2 * np.pi * np.arange(len(images)) / len(images)
    weights = phase_weights(shifts_rad)
    if weights.shape[1] != len(images):
        raise DecodeError(f"shifts_rad: expected one for each of the {len(images)} frames, got {weights.shape[1]}")
    mean, cosine, sine = weighted_sums(images, weights)
    phase = minus_atan2(sine, cosine).astype(dtype)
    phase[phase >= np.asarray(np.pi, dtype=dtype)] = -np.pi  # float32 rounds the last values below pi up to it
    modulation = np.sqrt(cosine * cosine + sine * sine)
    return Phase(phase, modulation.astype(dtype, copy=False), mean.astype(dtype, copy=False))


def weighted_sums(images: Iterable[NDArray], weights: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """One weighted sum of the images for each row of ``weights``, added in frame order in float64."""
    sums: list[NDArray[np.float64]] = []
    for image, column in zip(images, weights.T, strict=True):
        grey = image.astype(np.float64)
        terms = [weight * grey for weight in column]
        for total, term in zip(sums, terms, strict=False):
            total += term
        sums = sums or terms
    return sums


def minus_atan2(sine: NDArray[np.float64], cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    """``-atan2(sine, cosine)`` in [-pi, pi), float64 to 2 ulp, with the same bits on every processor."""
    if kernels := compiled_kernels():
        phase = np.empty(np.shape(sine))
        kernels.minus_atan2_all(np.ravel(sine), np.ravel(cosine), phase.ravel())
        return phase
    phase = -arctangent2(sine, cosine)
    phase[phase >= np.pi] = -np.pi
    return phase
