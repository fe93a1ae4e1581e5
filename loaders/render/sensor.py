"""The camera's sensor: counter-based noise and 8-bit quantisation, the same bytes in any order of computation.

The noise of a pixel is a pure function of (dataset seed, object, view, frame, pixel): a 32-bit integer hash of the
pixel number under two keys of the frame, and from its bits the sum of two entries of a table of 4,096 normal quantiles.
The sum of two normals is normal; it reaches 5.2 sigma and has 16 million levels, and the table stays in the first-level
cache. This makes noise cheap (see docs/generating.md) and keeps its distribution normal (tests/test_sensor.py).
"""

from dataclasses import dataclass
from functools import cache
from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

TABLE_BITS = 12
_FLOAT = np.float32
_MID_GREY = 127.5


@dataclass(frozen=True)
class Noise:
    """Shot and read noise in grey levels: variance = ``read_variance`` + ``shot_per_grey`` x signal."""

    read_variance: float
    shot_per_grey: float

    @classmethod
    def of_sigma(cls, sigma_grey: float) -> "Noise":
        """Noise of standard deviation ``sigma_grey`` at mid-grey (127.5); half its variance is shot noise."""
        variance = float(sigma_grey) ** 2
        return cls(read_variance=variance / 2, shot_per_grey=variance / 2 / _MID_GREY)


@cache
def normal_table() -> NDArray[np.float32]:
    """4,096 quantiles of a normal distribution of variance 1/2, exact in mean and variance; float32, read-only."""
    from scipy.special import ndtri

    entries = 1 << TABLE_BITS
    quantiles = ndtri((np.arange(entries) + 0.5) / entries)
    table = (quantiles / np.sqrt(2 * np.mean(quantiles**2))).astype(np.float32)
    table.flags.writeable = False
    return table


def stream_keys(*name: object) -> NDArray[np.uint32]:
    """Two 32-bit keys of a named noise stream, such as ``(seed, object, view, frame)``; uint32 (2,)."""
    digest = blake2b("\x1f".join(map(str, name)).encode(), digest_size=8).digest()
    return np.frombuffer(digest, dtype="<u4").astype(np.uint32)


def uniform(*name: object) -> float:
    """A number in [0, 1) that depends only on ``name``."""
    digest = blake2b("\x1f".join(map(str, name)).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") / 2.0**64


def hash_pixels(pixels: NDArray[np.uint32], keys: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """32-bit hash of each pixel number: a keyed two-round multiply-xorshift, a bijection of the pixel number."""
    with np.errstate(over="ignore"):
        h = (pixels * np.uint32(0x9E3779B1)) ^ keys[0]
        h ^= h >> np.uint32(16)
        h *= np.uint32(0x7FEB352D)
        h ^= h >> np.uint32(15)
        h += keys[1]
        h *= np.uint32(0x846CA68B)
        h ^= h >> np.uint32(16)
    return h


def standard_normal(pixels: NDArray[np.uint32], keys: NDArray[np.uint32]) -> NDArray[np.float32]:
    """Standard normal deviate of each pixel number under a stream's keys; float32."""
    mask, table = np.uint32((1 << TABLE_BITS) - 1), normal_table()
    h = hash_pixels(pixels, keys)
    return table[h & mask] + table[(h >> np.uint32(TABLE_BITS)) & mask]


def quantise(
    signal_grey: NDArray[np.float32], pixels: NDArray[np.uint32], keys: NDArray[np.uint32], noise: Noise
) -> NDArray[np.uint8]:
    """The sensor's grey levels: signal plus noise, rounded and clipped to 0..255; uint8 of the signal's shape."""
    sigma = np.sqrt(_FLOAT(noise.read_variance) + _FLOAT(noise.shot_per_grey) * signal_grey)
    value = signal_grey + sigma * standard_normal(pixels, keys) + _FLOAT(0.5)
    return np.clip(value, _FLOAT(0), _FLOAT(255)).astype(np.uint8)
