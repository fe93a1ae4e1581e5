"""Exposing frames: pattern light on lit pixels, through the sensor, to 8 bit.

Nothing is traced twice: where each pixel reads the pattern and how bright it is are computed once a view
(`fpp_ml_bench.loaders.illumination`) and shared by all its frames. A frame can be exposed for any subset of pixels; the
bytes are those that the whole frame has there.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.acceleration import numba_enabled
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.frames import Frame
from fpp_ml_bench.loaders.illumination import LitPixels, PatternLookup
from fpp_ml_bench.loaders.sensor import Noise, normal_table, quantise, stream_keys
from fpp_ml_bench.patterns import pattern_profile
from fpp_ml_bench.rig import Rig

_FLOAT = np.float32


@dataclass(frozen=True)
class Exposure:
    """What every frame of a dataset shares: pattern light in [0, 1] (its last entry doubled), and the noise."""

    frames: tuple[Frame, ...]
    light: tuple[NDArray[np.float32], ...]
    noise: Noise

    @classmethod
    def of(cls, rig: Rig, noise: Noise) -> "Exposure":
        """Pattern light as the projector's 8-bit images give it."""
        profiles = (
            pattern_profile(rig, frame.index).astype(np.float32) / _FLOAT(GREY_LEVELS) for frame in rig.sequence
        )
        return cls(rig.sequence.frames, tuple(np.append(p, p[-1:]) for p in profiles), noise)

    def expose(
        self, index: int, lit: LitPixels, pixels: NDArray[np.uint32], stream: tuple[object, ...],
        out: NDArray[np.uint8] | None = None,
    ) -> NDArray[np.uint8]:  # fmt: skip
        """Frame ``index`` at flat image positions ``pixels`` uint32 (n,), which ``lit`` describes in that order.

        ``stream`` names the view's noise, ``(seed, object, view)``. Returns uint8 (n,), written into ``out`` if given.
        """
        frame, light = self.frames[index], self.light[index]
        keys = stream_keys(*stream, index)
        out = np.empty(pixels.size, dtype=np.uint8) if out is None else out
        lookup = lit.lookup[frame.direction] if frame.direction else _first_entry(pixels.size)
        read, shot = _FLOAT(self.noise.read_variance), _FLOAT(self.noise.shot_per_grey)
        if numba_enabled():
            from fpp_ml_bench.loaders.sensor_kernel import expose_kernel

            contiguous = pixels.size > 0 and int(pixels[-1]) - int(pixels[0]) == pixels.size - 1
            expose_kernel(
                out,
                light,
                lookup.index,
                lookup.weight,
                lit.gain,
                lit.ambient,
                pixels,
                contiguous,
                normal_table(),
                keys,
                read,
                shot,
            )
            return out
        low = light[lookup.index]
        pattern = low + lookup.weight * (light[lookup.index + 1] - low)
        out[:] = quantise(lit.ambient + lit.gain * pattern, pixels, keys, self.noise)
        return out


_FIRST: dict[int, PatternLookup] = {}


def _first_entry(size: int) -> PatternLookup:
    """Lookup of black and white, whose profile has one value for all pixels; the latest size is kept."""
    if size not in _FIRST:
        _FIRST.clear()
        _FIRST[size] = PatternLookup(np.zeros(size, dtype=np.uint16), np.zeros(size, dtype=np.float32))
    return _FIRST[size]
