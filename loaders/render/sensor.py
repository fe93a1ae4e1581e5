"""From lit pixels to the bytes of frames: pattern light, counter-based noise and 8-bit quantisation.

The noise of a pixel is a pure function of (dataset seed, object, view, frame, pixel): a 32-bit hash of the pixel number
under two keys of the frame, and from its bits the sum of two entries of a table of 4,096 normal quantiles, which is
normal, reaches 5.2 sigma and has 16 million levels (docs/generating.md). So any subset of pixels can be exposed alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.loaders.render.illumination import LitPixels
from fpp_ml_bench.machine import njit, numba_enabled
from fpp_ml_bench.optics import Rig, pattern_profiles

TABLE_BITS = 12
_FLOAT = np.float32
_MID_GREY = 127.5
_CHUNK = 2048
_MASK = (1 << TABLE_BITS) - 1


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
    entries = 1 << TABLE_BITS
    quantiles = ndtri((np.arange(entries) + 0.5) / entries)
    table = (quantiles / np.sqrt(2 * np.mean(quantiles**2))).astype(np.float32)
    table.flags.writeable = False
    return table


def stream_keys(*name: object) -> NDArray[np.uint32]:
    """Two 32-bit keys of a named noise stream, such as ``(seed, object, view, frame)``; uint32 (2,)."""
    digest = blake2b("\x1f".join(map(str, name)).encode(), digest_size=8).digest()
    return np.frombuffer(digest, dtype="<u4").astype(np.uint32)


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


@dataclass(frozen=True)
class Exposure:
    """What every frame of a dataset shares.

    ``light`` float32 (F, L + 1): pattern light in [0, 1] along the coordinate each frame varies with, the last entry
    repeated; ``vertical`` bool (F,): whether that is the projector's u (else v; black and white vary with neither).
    """

    light: NDArray[np.float32]
    vertical: NDArray[np.bool_]
    noise: Noise

    @classmethod
    def of(cls, rig: Rig, noise: Noise) -> "Exposure":
        """Pattern light as the projector's 8-bit images give it."""
        light = pattern_profiles(rig).astype(np.float32) / _FLOAT(GREY_LEVELS)
        vertical = np.array([frame.direction == "vertical" for frame in rig.sequence])
        return cls(np.pad(light, ((0, 0), (0, 1)), mode="edge"), vertical, noise)

    def expose(
        self, frames: Sequence[int], lit: LitPixels, pixels: NDArray[np.uint32], stream: tuple[object, ...],
        out: NDArray[np.uint8] | None = None,
    ) -> NDArray[np.uint8]:  # fmt: skip
        """Frames at flat image positions ``pixels`` uint32 (n,), which ``lit`` describes in that order.

        ``stream`` names the view's noise, ``(seed, object, view)``. Returns uint8 (k, n), one row per entry of
        ``frames``, written into ``out`` if given.
        """
        result = np.empty((len(frames), pixels.size), dtype=np.uint8) if out is None else out
        keys = np.array([stream_keys(*stream, index) for index in frames], dtype=np.uint32).reshape(-1, 2)
        u, v = lit.lookup["vertical"], lit.lookup["horizontal"]
        if numba_enabled():
            expose_kernel(
                result, np.array(frames, dtype=np.int64), self.light, self.vertical, u.index, u.weight, v.index,
                v.weight, lit.gain, lit.ambient, pixels, normal_table(), keys, _FLOAT(self.noise.read_variance),
                _FLOAT(self.noise.shot_per_grey),
            )  # fmt: skip
            return result
        for row, index in enumerate(frames):
            lookup, light = (u if self.vertical[index] else v), self.light[index]
            low = light[lookup.index]
            pattern = low + lookup.weight * (light[lookup.index + np.uint16(1)] - low)
            result[row] = quantise(lit.ambient + lit.gain * pattern, pixels, keys[row], self.noise)
        return result


@njit
def expose_kernel(  # type: ignore[no-untyped-def]
    out, frames, light, vertical, u_index, u_weight, v_index, v_weight, gain, ambient, pixels, table, keys,
    read_variance, shot_per_grey,
):  # fmt: skip
    """Expose ``frames`` (k,) at n pixels: row i of ``out`` uint8 (k, n) is frame ``frames[i]``.

    ``light`` float32 (F, L + 1): pattern light along the coordinate in which it varies, u where ``vertical`` bool (F,)
    is True, else v. Per pixel: indices and weights of the lookup, ``gain``, ``ambient``, pixel number ``pixels``
    uint32. ``keys`` uint32 (k, 2): noise streams.

    Pixels are processed in chunks, with all frames for each chunk, so that values common to the frames (a pixel's place
    in the pattern, its brightness) are read from memory once. Each stage is a separate loop, because the compiler turns
    simple loops into vector instructions (2.5 times faster here than a single loop with all stages).
    """
    numbers = np.empty(_CHUNK, np.uint32)
    hashes = np.empty(_CHUNK, np.uint32)
    normal = np.empty(_CHUNK, np.float32)
    lit = np.empty(_CHUNK, np.float32)
    for start in range(0, pixels.size, _CHUNK):
        # Slices, not offsets: only then does the compiler see plain loops over plain arrays (1.75 times faster).
        stop = min(start + _CHUNK, pixels.size)
        n = stop - start
        u_low, u_share = u_index[start:stop], u_weight[start:stop]
        v_low, v_share = v_index[start:stop], v_weight[start:stop]
        factor, offset, number = gain[start:stop], ambient[start:stop], pixels[start:stop]
        for k in range(n):
            numbers[k] = np.uint32(number[k] * np.uint32(0x9E3779B1))
        for row in range(frames.size):
            profile, target = light[frames[row]], out[row, start:stop]
            first, second = keys[row, 0], keys[row, 1]
            for k in range(n):
                h = numbers[k] ^ first
                h ^= h >> np.uint32(16)
                h = np.uint32(h * np.uint32(0x7FEB352D))
                h ^= h >> np.uint32(15)
                h = np.uint32(h + second)
                h = np.uint32(h * np.uint32(0x846CA68B))
                h ^= h >> np.uint32(16)
                hashes[k] = h
            for k in range(n):
                h = hashes[k]
                normal[k] = table[h & np.uint32(_MASK)] + table[(h >> np.uint32(TABLE_BITS)) & np.uint32(_MASK)]
            index, weight = (u_low, u_share) if vertical[frames[row]] else (v_low, v_share)
            for k in range(n):
                low = profile[index[k]]
                lit[k] = low + weight[k] * (profile[index[k] + 1] - low)
            for k in range(n):
                signal = offset[k] + factor[k] * lit[k]
                value = signal + np.sqrt(read_variance + shot_per_grey * signal) * normal[k] + np.float32(0.5)
                value = min(max(value, np.float32(0)), np.float32(255))
                target[k] = np.uint8(np.int32(value))
