"""Grey levels to [0, 1] in one pass over memory; the NumPy version is in `fpp_ml_bench.loaders.training`."""

import numpy as np

from fpp_ml_bench.machine import njit


@njit
def scale_kernel(grey, out, factor):  # type: ignore[no-untyped-def]
    """``out`` float32 (n,) = ``grey`` uint8 (n,) x ``factor`` float32."""
    for k in range(grey.size):
        out[k] = np.float32(grey[k]) * factor
