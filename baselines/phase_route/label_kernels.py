"""Compiled twin of the row sweeps of `fpp_ml_bench.baselines.phase_route.labels`: the same numbers, fused.

Import only where `fpp_ml_bench.acceleration.numba_enabled`.
"""

import numpy as np

from fpp_ml_bench.acceleration import njit


@njit
def _send(rest, carried, mine, theirs, link, limit, out):  # type: ignore[no-untyped-def]
    width, count = rest.shape
    for x in range(width):
        weight = link[x]
        least = np.float32(np.inf)
        for b in range(count):
            best = np.float32(np.inf)
            for a in range(count):
                jump = min(abs(mine[x, a] - theirs[x, b]), limit) * weight
                best = min(best, (rest[x, a] + carried[x, a]) + jump)
            out[x, b] = best
            least = min(least, best)
        for b in range(count):
            out[x, b] = out[x, b] - least


@njit
def sweep_rows(rest, phase, link, limit, down, up):  # type: ignore[no-untyped-def]
    """Messages of one pass down and one up the rows of (H, W, K) costs, written into ``down`` and ``up``."""
    last = len(rest) - 1
    for here in range(last):
        _send(rest[here], down[here], phase[here], phase[here + 1], link[here], limit, down[here + 1])
    for here in range(last, 0, -1):
        _send(rest[here], up[here], phase[here], phase[here - 1], link[here - 1], limit, up[here - 1])
