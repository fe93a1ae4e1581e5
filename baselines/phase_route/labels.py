"""Which candidate order each pixel takes: belief propagation over the two or three that the rig allows.

The energy is a sum over pixels of what the candidate's brightness and the priors say, and over neighbours of how far
their residual phases part, linear up to a limit: surfaces are smooth, and where they jump, a jump of any height costs
the same. Min-sum belief propagation in whole-row and whole-column sweeps (Tappen and Freeman 2003, "BP-M") carries a
decision across an object in one sweep; a few of them settle it. The grid is every `STRIDE`-th pixel, as phases are
smooth; each pixel then takes its own candidate nearest to its grid point's.
"""

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.acceleration import numba_enabled

Image = NDArray[np.float32]

SWEEPS = 4
LARGE = np.float32(1e4)
"""Cost of a candidate that there is not."""


def propagate(
    unary: NDArray[np.float32], phase_rad: NDArray[np.float32], link_x: Image, link_y: Image, limit_rad: float,
    sweeps: int = SWEEPS,
) -> NDArray[np.float32]:  # fmt: skip
    """Beliefs (K, H, W) float32, smaller is better, of K candidates with costs ``unary`` (K, H, W).

    ``phase_rad`` (K, H, W): residual phase of each; ``link_x`` (H, W - 1) and ``link_y`` (H - 1, W): weight of the
    smoothness between neighbours, 0 where one of them is not object; ``limit_rad``: a jump from which on it costs no
    more.
    """
    count, height, width = unary.shape
    if numba_enabled():
        from fpp_ml_bench.baselines.phase_route.label_kernels import sweep_rows
    else:
        sweep_rows = _sweep_rows
    # Messages come to rest where they arrive: from the left, the right, above, below. (W, H)-ordered copies make the
    # sweep along x the same code as that along y.
    cost = np.ascontiguousarray(unary.transpose(1, 2, 0))
    phase = np.ascontiguousarray(phase_rad.transpose(1, 2, 0))
    cost_t, phase_t = (np.ascontiguousarray(a.transpose(1, 0, 2)) for a in (cost, phase))
    link_t = np.ascontiguousarray(link_x.T)
    down, up = np.zeros((height, width, count), np.float32), np.zeros((height, width, count), np.float32)
    right, left = np.zeros((width, height, count), np.float32), np.zeros((width, height, count), np.float32)
    limit = np.float32(limit_rad)
    for _ in range(sweeps):
        rest = cost_t + (down + up).transpose(1, 0, 2)
        sweep_rows(rest, phase_t, link_t, limit, right, left)
        rest = cost + (right + left).transpose(1, 0, 2)
        sweep_rows(rest, phase, np.ascontiguousarray(link_y), limit, down, up)
    belief = cost + down + up + (right + left).transpose(1, 0, 2)
    return np.ascontiguousarray(belief.transpose(2, 0, 1))


def _sweep_rows(rest: NDArray, phase: NDArray, link: Image, limit: np.float32, down: NDArray, up: NDArray) -> None:
    """Messages of one pass down and one up the rows of (H, W, K) costs, written into ``down`` and ``up``."""
    last = len(rest) - 1
    for here in range(last):
        _send(rest[here] + down[here], phase[here], phase[here + 1], link[here], limit, down[here + 1])
    for here in range(last, 0, -1):
        _send(rest[here] + up[here], phase[here], phase[here - 1], link[here - 1], limit, up[here - 1])


def _send(known: NDArray, mine: NDArray, theirs: NDArray, link: NDArray, limit: np.float32, out: NDArray) -> None:
    """One row of messages: the least of own cost plus smoothness, its minimum taken off; (W, K) arrays, (W,) links."""
    jump = np.minimum(np.abs(mine[:, :, None] - theirs[:, None, :]), limit) * link[:, None, None]
    message = (known[:, :, None] + jump).min(axis=1)
    out[:] = message - message.min(axis=1, keepdims=True)


def best_and_margin(belief: NDArray[np.float32]) -> tuple[NDArray[np.int32], Image]:
    """The best candidate's place (H, W) int32, and by how much the second best is worse (H, W); `LARGE` where alone."""
    best = belief.argmin(axis=0).astype(np.int32)
    if len(belief) == 1:
        return best, np.full(best.shape, LARGE, np.float32)
    two = np.partition(belief, 1, axis=0)[:2]
    return best, np.minimum(two[1] - two[0], LARGE)
