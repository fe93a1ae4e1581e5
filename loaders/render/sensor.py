"""From light to the bytes of frames: pattern light, bounces, electrons, counter-based noise,
converter and response.

The noise of a pixel is a pure function of (dataset seed, object, view, frame, pixel): a 32-bit hash
of the pixel number under two keys of the frame, and from its bits the sum of two entries of a table
of 4,096 normal quantiles, which is normal, reaches 5.2 sigma and has 16 million levels
(docs/results/generating.md). So any pixels can be exposed alone. Noise follows EMVA 1288: a
variance of read noise, and one of shot noise that is the number of electrons.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.loaders.render.illumination import LitPixels
from fpp_ml_bench.loaders.render.light import CameraLight, Light
from fpp_ml_bench.loaders.render.projector import PatternLight, PatternPlace, fill_frame, respond
from fpp_ml_bench.loaders.render.scene import modulation_at, name_bytes
from fpp_ml_bench.machine import njit
from fpp_ml_bench.optics.rig import Rig

TABLE_BITS = 12
"""Bits of a hash that pick a quantile of the normal table: 4,096 entries of 4 bytes stay in the
cache, and a noise value is the sum of two, of 16 million pairs."""
_FLOAT = np.float32
_MID_GREY = 127.5
"""Grey level at which the noise of a camera is stated: the middle of 0 to 255."""
_CHUNK = 2048
"""Samples that are made at once: their arrays stay in the cache."""
_MASK = (1 << TABLE_BITS) - 1
_FIRST_FACTOR = np.uint32(0x9E3779B1)
"""Of the hash of a pixel number."""


class Noise(NamedTuple):
    """Shot and read noise in grey levels: variance = ``read_variance`` + ``shot_per_grey`` x
    signal."""

    read_variance: float | np.float32
    shot_per_grey: float | np.float32

    @classmethod
    def of_camera(cls, camera: CameraLight) -> "Noise":
        """Noise of a camera with its full well at grey level 255; none without a full well."""
        if camera.full_well_e is None:
            return cls(0.0, 0.0)
        electrons = camera.full_well_e / GREY_LEVELS
        return cls(
            read_variance=(camera.read_noise_e / electrons) ** 2, shot_per_grey=1.0 / electrons
        )


def camera_noise(sigma_grey: float) -> dict[str, float | None]:
    """Full well and read noise of a camera with a noise of ``sigma_grey`` grey levels at mid-grey
    (127.5), half of its variance shot noise; as values for `CameraLight`."""
    if sigma_grey == 0:
        return {"full_well_e": None, "read_noise_e": 0.0}
    electrons = 2 * _MID_GREY / float(sigma_grey) ** 2
    return {
        "full_well_e": electrons * GREY_LEVELS,
        "read_noise_e": float(sigma_grey) / np.sqrt(2) * electrons,
    }


def fringe_noise_at(rig: Rig, depth_mm: float, light: Light) -> float:
    """Standard deviation in grey levels of the camera's noise at the mean grey level of a fringe on
    a surface at ``depth_mm`` that faces the projector."""
    noise, grey = (
        Noise.of_camera(light.camera),
        modulation_at(rig, depth_mm, light) + light.ambient_grey,
    )
    return float(np.sqrt(noise.read_variance + noise.shot_per_grey * grey))


@cache
def normal_table() -> NDArray[np.float32]:
    """4,096 quantiles of a normal distribution of variance 1/2, exact in mean and variance;
    float32, read-only."""
    entries = 1 << TABLE_BITS
    quantiles = ndtri((np.arange(entries) + 0.5) / entries)
    table = (quantiles / np.sqrt(2 * np.mean(quantiles**2))).astype(np.float32)
    table.flags.writeable = False
    return table


def stream_keys(*name: object) -> NDArray[np.uint32]:
    """Two 32-bit keys of a named noise stream, such as ``(seed, object, view, frame)``; uint32
    (2,)."""
    return np.frombuffer(name_bytes(*name), dtype="<u4").astype(np.uint32)


def frame_keys(stream: tuple[object, ...], frames: Sequence[int]) -> NDArray[np.uint32]:
    """`stream_keys` of each of a view's k ``frames``; uint32 (k, 2)."""
    return np.array([stream_keys(*stream, index) for index in frames], dtype=np.uint32).reshape(
        -1, 2
    )


def hash_pixels(pixels: NDArray[np.uint32], keys: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """32-bit hash of each pixel number: a keyed two-round multiply-xorshift, a bijection of the
    pixel number."""
    hashes = np.empty(pixels.size, dtype=np.uint32)
    fill_hashes(hashes, pixels * _FIRST_FACTOR, keys)
    return hashes


def standard_normal(pixels: NDArray[np.uint32], keys: NDArray[np.uint32]) -> NDArray[np.float32]:
    """Standard normal deviate of each pixel number under a stream's keys; float32."""
    normal = np.empty(pixels.size, dtype=np.float32)
    fill_normal(normal, hash_pixels(pixels, keys), normal_table())
    return normal


class Sensor(NamedTuple):
    """What turns the light of a pixel into a byte: black level in grey levels, noise, the 8-bit
    grey level of each code of the converter, uint8 (2^bits,), whether the two are the same, and the
    `normal_table`."""

    black_grey: np.float32
    noise: Noise
    grey_of_code: NDArray[np.uint8]
    plain: bool
    table: NDArray[np.float32]

    @classmethod
    def of(cls, camera: CameraLight) -> "Sensor":
        codes = np.arange(1 << camera.bits)
        grey = np.rint(GREY_LEVELS * respond(camera.response, codes / codes[-1])).astype(np.uint8)
        noise = Noise(*map(_FLOAT, Noise.of_camera(camera)))
        return cls(
            _FLOAT(camera.black_grey), noise, grey, np.array_equal(grey, codes), normal_table()
        )


@dataclass(frozen=True)
class Exposure:
    """What every frame of a dataset shares. ``flicker``: relative sigma of the lamp from frame to
    frame."""

    pattern: PatternLight
    sensor: Sensor
    flicker: float = 0.0

    @classmethod
    def of(cls, rig: Rig, light: Light) -> "Exposure":
        pattern = PatternLight.of(rig, light.projector, light.camera.rays_across > 1)
        return cls(pattern, Sensor.of(light.camera), light.projector.flicker)

    def expose(
        self,
        frames: Sequence[int],
        lit: LitPixels,
        pixels: NDArray[np.uint32],
        stream: tuple[object, ...],
        out: NDArray[np.uint8] | None = None,
    ) -> NDArray[np.uint8]:
        """Frames at flat image positions ``pixels`` uint32 (n,), which ``lit`` describes in that
        order; where it has m times as many points, a pixel is the mean of m in turn.

        ``stream`` names the view's noise, ``(seed, object, view)``. Returns uint8 (k, n), one row
        per entry of ``frames``, written into ``out`` if given.
        """
        result = np.empty((len(frames), pixels.size), dtype=np.uint8) if out is None else out
        expose_kernel(
            result,
            self._light(frames, lit, stream),
            pixels,
            frame_keys(stream, frames),
            self.sensor,
        )
        return result

    def radiance(
        self,
        frames: Sequence[int],
        lit: LitPixels,
        stream: tuple[object, ...],
        out: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """The light of pixels in grey levels before the lens and the sensor: fills ``out`` float32
        (k, n)."""
        radiance_kernel(out, self._light(frames, lit, stream))
        return out

    def sense(
        self,
        frames: Sequence[int],
        radiance: NDArray[np.float32],
        pixels: NDArray[np.uint32],
        stream: tuple[object, ...],
        out: NDArray[np.uint8],
    ) -> NDArray[np.uint8]:
        """The sensor's answer to ``radiance`` (k, n): fills ``out`` uint8 (k, n)."""
        sense_kernel(out, radiance, pixels, frame_keys(stream, frames), self.sensor)
        return out

    def _light(
        self, frames: Sequence[int], lit: LitPixels, stream: tuple[object, ...]
    ) -> "PointLight":
        lamp = np.ones(len(frames), dtype=np.float32)
        if self.flicker:
            keys = frame_keys((*stream, "lamp"), frames)
            lamp += np.float32(self.flicker) * np.array(
                [standard_normal(np.zeros(1, np.uint32), k)[0] for k in keys]
            )
        bounced = np.empty((0, 0), dtype=np.float32) if lit.bounced is None else lit.bounced
        indices = np.array(frames, dtype=np.int64)
        return PointLight(indices, lamp, self.pattern, lit.place, lit.gain, lit.ambient, bounced)


class PointLight(NamedTuple):
    """What `fill_signal` needs: the ``frames`` int64 (k,) and the strength of the ``lamp`` float32
    (k,) in each; and what `LitPixels` says of the points, with the pattern."""

    frames: NDArray[np.int64]
    lamp: NDArray[np.float32]
    pattern: PatternLight
    place: PatternPlace
    gain: NDArray[np.float32]
    ambient: NDArray[np.float32]
    bounced: NDArray[np.float32]


@njit
def fill_signal(signal, row, light, start):  # type: ignore[no-untyped-def]
    """Light of the points from ``start`` on in frame number ``row`` of a `PointLight`: fills
    ``signal`` (n,)."""
    stop, p, frame = start + signal.size, light.place, light.frames[row]
    # Slices, not offsets: only then does the compiler see plain loops over plain arrays (1.75 times
    # faster).
    place = PatternPlace(
        p.u_index[start:stop],
        p.u_weight[start:stop],
        p.v_index[start:stop],
        p.v_weight[start:stop],
        p.level[start:stop],
        p.level_weight[start:stop],
    )
    fill_frame(signal, frame, light.pattern, place)
    factor, offset, flash = light.gain[start:stop], light.ambient[start:stop], light.lamp[row]
    for k in range(signal.size):
        signal[k] = offset[k] + flash * factor[k] * signal[k]
    if light.bounced.size > 0:
        # Without the higher harmonics of a projector's response (`PatternLight.modes`) it can be
        # below 0.
        more = light.bounced[frame, start:stop]
        for k in range(signal.size):
            signal[k] = max(signal[k] + flash * more[k], np.float32(0))


@njit
def average(signal, pixels, samples):  # type: ignore[no-untyped-def]
    """Means of ``samples`` points in turn, in place, into the first ``pixels`` entries."""
    if samples > 1:
        share = np.float32(1.0 / samples)
        for k in range(pixels):
            total = np.float32(0)
            for j in range(samples):
                total += signal[k * samples + j]
            signal[k] = total * share


@njit
def fill_hashes(hashes, numbers, keys):  # type: ignore[no-untyped-def]
    """Hashes of pixel numbers, given times `_FIRST_FACTOR`: fills ``hashes`` uint32 (n,)."""
    first, second = keys[0], keys[1]
    for k in range(hashes.size):
        h = numbers[k] ^ first
        h ^= h >> np.uint32(16)
        h = np.uint32(h * np.uint32(0x7FEB352D))
        h ^= h >> np.uint32(15)
        h = np.uint32(h + second)
        h = np.uint32(h * np.uint32(0x846CA68B))
        h ^= h >> np.uint32(16)
        hashes[k] = h


@njit
def fill_normal(normal, hashes, table):  # type: ignore[no-untyped-def]
    """Standard normal deviates of hashes, by the `normal_table`: fills ``normal`` float32 (n,)."""
    for k in range(normal.size):
        h = hashes[k]
        normal[k] = (
            table[h & np.uint32(_MASK)] + table[(h >> np.uint32(TABLE_BITS)) & np.uint32(_MASK)]
        )


@njit
def fill_bytes(target, signal, numbers, hashes, normal, keys, sensor):  # type: ignore[no-untyped-def]
    """The answer of a `Sensor` to ``signal`` under the ``keys`` (2,) of a noise stream: fills
    ``target`` uint8 (n,). ``numbers``: pixel numbers times `_FIRST_FACTOR`, uint32 (n,)."""
    n, grey_of_code = target.size, sensor.grey_of_code
    read_variance, shot_per_grey, black = (
        sensor.noise.read_variance,
        sensor.noise.shot_per_grey,
        sensor.black_grey,
    )
    fill_hashes(hashes[:n], numbers, keys)
    fill_normal(normal[:n], hashes, sensor.table)
    if sensor.plain:
        for k in range(n):
            value = (
                signal[k]
                + black
                + np.sqrt(read_variance + shot_per_grey * signal[k]) * normal[k]
                + np.float32(0.5)
            )
            value = min(max(value, np.float32(0)), np.float32(255))
            target[k] = np.uint8(np.int32(value))
    else:
        most = grey_of_code.size - 1
        scale = np.float32(most / 255.0)
        for k in range(n):
            value = (
                signal[k] + black + np.sqrt(read_variance + shot_per_grey * signal[k]) * normal[k]
            )
            code = min(max(value * scale + np.float32(0.5), np.float32(0)), np.float32(most))
            target[k] = grey_of_code[np.int32(code)]


@njit
def expose_kernel(out, light, pixels, keys, sensor):  # type: ignore[no-untyped-def]
    """Expose k frames of a `PointLight` at n ``pixels`` uint32 (n,): row i of ``out`` uint8 (k, n)
    is its frame i, as the `Sensor` has it under the ``keys`` uint32 (k, 2) of the noise streams.

    Pixels are processed in chunks, with all frames for each chunk, so that values common to the
    frames (a pixel's place in the pattern, its brightness) are read from memory once. Each stage is
    a separate loop, because the compiler turns simple loops into vector instructions (2.5 times
    faster here than a single loop with all stages).
    """
    samples = light.gain.size // max(pixels.size, 1)
    step = max(_CHUNK // max(samples, 1), 1)
    numbers, hashes = np.empty(step, np.uint32), np.empty(step, np.uint32)
    normal, signal = np.empty(step, np.float32), np.empty(step * max(samples, 1), np.float32)
    for start in range(0, pixels.size, step):
        n = min(start + step, pixels.size) - start
        number = pixels[start : start + n]
        for k in range(n):
            numbers[k] = np.uint32(number[k] * _FIRST_FACTOR)
        for row in range(light.frames.size):
            fill_signal(signal[: n * samples], row, light, start * samples)
            average(signal, n, samples)
            fill_bytes(
                out[row, start : start + n], signal[:n], numbers, hashes, normal, keys[row], sensor
            )


@njit
def radiance_kernel(out, light):  # type: ignore[no-untyped-def]
    """The light of k frames of a `PointLight` at n pixels: fills ``out`` float32 (k, n)."""
    count = out.shape[1]
    samples = light.gain.size // max(count, 1)
    signal = np.empty(_CHUNK * max(samples, 1), np.float32)
    for start in range(0, count, _CHUNK):
        n = min(start + _CHUNK, count) - start
        for row in range(light.frames.size):
            fill_signal(signal[: n * samples], row, light, start * samples)
            average(signal, n, samples)
            out[row, start : start + n] = signal[:n]


@njit
def sense_kernel(out, radiance, pixels, keys, sensor):  # type: ignore[no-untyped-def]
    """The answer of a `Sensor` to ``radiance`` float32 (k, n) at n pixels: fills ``out`` uint8 (k,
    n)."""
    numbers, hashes, normal = (
        np.empty(_CHUNK, np.uint32),
        np.empty(_CHUNK, np.uint32),
        np.empty(_CHUNK, np.float32),
    )
    for start in range(0, pixels.size, _CHUNK):
        n = min(start + _CHUNK, pixels.size) - start
        for k in range(n):
            numbers[k] = np.uint32(pixels[start + k] * _FIRST_FACTOR)
        for row in range(out.shape[0]):
            answer = out[row, start : start + n]
            fill_bytes(
                answer, radiance[row, start : start + n], numbers, hashes, normal, keys[row], sensor
            )
