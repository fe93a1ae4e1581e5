"""Exposing frames: pattern light on lit pixels, through the sensor, to 8 bit.

Nothing is traced twice: where each pixel reads the pattern and how bright it is are computed once a view
(`loaders.render.illumination`) and shared by all its frames. Frames can be exposed for any subset of pixels; the
bytes are those that the whole frames have there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.loaders.render.illumination import LitPixels
from fpp_ml_bench.loaders.render.sensor import Noise, normal_table, quantise, stream_keys
from fpp_ml_bench.machine import numba_enabled
from fpp_ml_bench.optics import Rig, pattern_profiles

_FLOAT = np.float32


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
        self,
        frames: Sequence[int],
        lit: LitPixels,
        pixels: NDArray[np.uint32],
        stream: tuple[object, ...],
        out: NDArray[np.uint8] | None = None,
    ) -> NDArray[np.uint8]:
        """Frames at flat image positions ``pixels`` uint32 (n,), which ``lit`` describes in that order.

        ``stream`` names the view's noise, ``(seed, object, view)``. Returns uint8 (k, n), one row per entry of
        ``frames``, written into ``out`` if given.
        """
        result = np.empty((len(frames), pixels.size), dtype=np.uint8) if out is None else out
        keys = np.array([stream_keys(*stream, index) for index in frames], dtype=np.uint32).reshape(-1, 2)
        u, v = lit.lookup["vertical"], lit.lookup["horizontal"]
        if numba_enabled():
            from fpp_ml_bench.loaders.render.sensor_kernel import expose_kernel

            expose_kernel(
                result,
                np.array(frames, dtype=np.int64),
                self.light,
                self.vertical,
                u.index,
                u.weight,
                v.index,
                v.weight,
                lit.gain,
                lit.ambient,
                pixels,
                normal_table(),
                keys,
                _FLOAT(self.noise.read_variance),
                _FLOAT(self.noise.shot_per_grey),
            )
            return result
        for row, index in enumerate(frames):
            lookup, light = (u if self.vertical[index] else v), self.light[index]
            low = light[lookup.index]
            pattern = low + lookup.weight * (light[lookup.index + np.uint16(1)] - low)
            result[row] = quantise(lit.ambient + lit.gain * pattern, pixels, keys[row], self.noise)
        return result
