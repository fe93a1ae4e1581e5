"""The candidate order of each pixel, by the least energy over the two or three candidates that the rig allows.

The energy is a sum over pixels of costs from brightness and priors, and over neighbours of the difference of their
residual phases, linear up to a limit: surfaces are smooth, and where they jump, a jump of any height costs the same.
For a single pixel smoothness is strong and brightness weak; plain belief propagation then keeps the result of its first
sweep (it put a plane at 2.1 m a whole period too near although brightness favoured the right order at 97% of the
pixels). The tree-reweighted kind counts the evidence of every pixel once and finds the right order.
"""

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.machine import numba_enabled

Image = NDArray[np.float32]

ROUNDS = 10
LARGE = np.float32(1e4)
"""Cost of a candidate that does not exist."""


def least_energy(
    unary: NDArray[np.float32],
    phase_rad: NDArray[np.float32],
    link_x: Image,
    link_y: Image,
    limit_rad: float,
    rounds: int = ROUNDS,
) -> tuple[NDArray[np.int32], Image]:
    """Index of the chosen candidate, int32 (H, W), and its margin to the second best, float32 (at most `LARGE`).

    ``unary`` (K, H, W): costs of K candidates; ``phase_rad`` (K, H, W): residual phase of each; ``link_x`` (H, W - 1)
    and ``link_y`` (H - 1, W): weight of the smoothness between neighbours, 0 where one of them is not object;
    ``limit_rad``: a jump from which on it costs no more.
    """
    if numba_enabled():
        from fpp_ml_bench.baselines.phase_route.label_kernels import decide, iterate
    else:
        from fpp_ml_bench.baselines.phase_route.label_sweeps import decide, iterate
    count, height, width = unary.shape
    costs = np.ascontiguousarray(unary.transpose(1, 2, 0), dtype=np.float32)
    phases = np.ascontiguousarray(phase_rad.transpose(1, 2, 0), dtype=np.float32)
    links = np.ascontiguousarray(link_x, dtype=np.float32), np.ascontiguousarray(link_y, dtype=np.float32)
    limit = np.float32(limit_rad)
    messages = np.zeros((height, width, 4, count), np.float32)
    iterate(costs, phases, *links, limit, rounds, messages)
    choice, margin = np.zeros((height, width), np.int32), np.zeros((height, width), np.float32)
    decide(costs, phases, *links, limit, messages, choice, margin)
    return choice, np.minimum(margin, LARGE)
