"""The compiled twin of `fpp_ml_bench.loaders.camera.expose`: pattern lookup, shading, noise, quantising, in one pass.

Each stage is a loop of its own over a chunk that stays in the cache: simple loops are what the compiler turns into
vector instructions (2.5 times faster here than one loop that does it all).
"""

import numpy as np

from fpp_ml_bench.acceleration import njit
from fpp_ml_bench.loaders.sensor import TABLE_BITS

_CHUNK = 4096
_MASK = (1 << TABLE_BITS) - 1


@njit
def expose_kernel(  # type: ignore[no-untyped-def]
    out, profile, index, weight, gain, ambient, pixels, contiguous, table, keys, read_variance, shot_per_grey
):
    """Expose one frame: ``out`` uint8 (n,); per pixel ``index``, ``weight``, ``gain``, ``pixels`` as in `expose`."""
    total = out.size
    hashes = np.empty(_CHUNK, np.uint32)
    normal = np.empty(_CHUNK, np.float32)
    light = np.empty(_CHUNK, np.float32)
    for start in range(0, total, _CHUNK):
        n = min(_CHUNK, total - start)
        if contiguous:
            first = np.uint32(pixels[0] + start)
            for k in range(n):
                hashes[k] = np.uint32(first + np.uint32(k))
        else:
            for k in range(n):
                hashes[k] = pixels[start + k]
        for k in range(n):
            h = np.uint32(hashes[k] * np.uint32(0x9E3779B1)) ^ keys[0]
            h ^= h >> np.uint32(16)
            h = np.uint32(h * np.uint32(0x7FEB352D))
            h ^= h >> np.uint32(15)
            h = np.uint32(h + keys[1])
            h = np.uint32(h * np.uint32(0x846CA68B))
            h ^= h >> np.uint32(16)
            hashes[k] = h
        for k in range(n):
            h = hashes[k]
            normal[k] = table[h & np.uint32(_MASK)] + table[(h >> np.uint32(TABLE_BITS)) & np.uint32(_MASK)]
        for k in range(n):
            i = index[start + k]
            low = profile[i]
            light[k] = low + weight[start + k] * (profile[i + 1] - low)
        for k in range(n):
            signal = ambient[start + k] + gain[start + k] * light[k]
            value = signal + np.sqrt(read_variance + shot_per_grey * signal) * normal[k] + np.float32(0.5)
            value = min(max(value, np.float32(0)), np.float32(255))
            out[start + k] = np.uint8(np.int32(value))
