"""The candidate order of each pixel by sequential tree-reweighted message passing (Kolmogorov 2006,
"TRW-S").

Plain belief propagation does not improve on its first sweep where smoothness is strong and
brightness weak. The code is always compiled. A ``field`` is what `least_energy` makes of its
arguments: costs and phases (H, W, K), the links along x and y, and the limit of a jump. Messages
are stored at the node that receives them: 0 from the left, 1 from above, 2 from the right, 3 from
below.
"""

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.geometry import Image
from fpp_ml_bench.baselines.phase.order import LARGE
from fpp_ml_bench.machine import njit

MESSAGE_ROUNDS = 10
"""Rounds of message passing, each one forward and one backward pass. The time grows with them;
after fewer, the energy is higher."""


def least_energy(
    unary: Image, phase_rad: Image, link_x: Image, link_y: Image, limit_rad: float
) -> tuple[NDArray[np.int32], Image]:
    """Index of the chosen candidate, int32 (H, W), and its margin to the second best, float32 (at
    most `LARGE`). ``unary`` (K, H, W): costs of K candidates; ``phase_rad`` (K, H, W): residual
    phase of each; ``link_x`` (H, W - 1) and ``link_y`` (H - 1, W): weight of the smoothness between
    neighbours, 0 where one of them is not object; ``limit_rad``: a jump from which on it costs no
    more."""
    count, height, width = unary.shape
    # One node's candidates side by side.
    costs, phases = (
        np.ascontiguousarray(maps.transpose(1, 2, 0), np.float32) for maps in (unary, phase_rad)
    )
    links = np.ascontiguousarray(link_x, np.float32), np.ascontiguousarray(link_y, np.float32)
    field = (costs, phases, *links, np.float32(limit_rad))
    messages = np.zeros((height, width, 4, count), np.float32)
    iterate(field, MESSAGE_ROUNDS, messages)
    choice, margin = np.zeros((height, width), np.int32), np.zeros((height, width), np.float32)
    decide(field, messages, choice, margin)
    return choice, np.minimum(margin, LARGE)


@njit
def _send(costs, returned, phases, neighbour_phases, weight, limit, out):  # type: ignore[no-untyped-def]
    """Message to a neighbour, least entry 0: ``costs`` less the message ``returned``, over a
    truncated linear jump."""
    count = costs.shape[0]
    least = np.float32(np.inf)
    for b in range(count):
        best = np.float32(np.inf)
        for a in range(count):
            jump = min(abs(phases[a] - neighbour_phases[b]), limit) * weight
            best = min(best, (costs[a] - returned[a]) + jump)
        out[b] = best
        least = min(least, best)
    for b in range(count):
        out[b] = out[b] - least


@njit
def iterate(field, rounds, messages):  # type: ignore[no-untyped-def]
    """``rounds`` forward and backward passes over a field; ``messages`` (H, W, 4, K) are updated in
    place."""
    unary, phase, link_x, link_y, limit = field
    height, width, count = unary.shape
    total = np.empty(count, np.float32)
    none = np.float32(0.0)
    for number in range(2 * rounds):
        step = 1 if number % 2 == 0 else -1
        # What the neighbours ahead have returned lies here, and what they receive goes there; + 1:
        # above and below.
        here, there = (2, 0) if step > 0 else (0, 2)
        for row in range(height):
            i = row if step > 0 else height - 1 - row
            for column in range(width):
                j = column if step > 0 else width - 1 - column
                left = link_x[i, j - 1] if j > 0 else none
                up = link_y[i - 1, j] if i > 0 else none
                right = link_x[i, j] if j < width - 1 else none
                down = link_y[i, j] if i < height - 1 else none
                across, along = (right, down) if step > 0 else (left, up)
                if across == none and along == none:
                    continue
                ahead, behind = (
                    int(right > none) + int(down > none),
                    int(left > none) + int(up > none),
                )
                share = np.float32(max(ahead, behind))
                for a in range(count):
                    received = (messages[i, j, 0, a] + messages[i, j, 1, a]) + (
                        messages[i, j, 2, a] + messages[i, j, 3, a]
                    )
                    total[a] = (unary[i, j, a] + received) / share
                if across > none:
                    out = messages[i, j + step, there]
                    _send(
                        total,
                        messages[i, j, here],
                        phase[i, j],
                        phase[i, j + step],
                        across,
                        limit,
                        out,
                    )
                if along > none:
                    out = messages[i + step, j, there + 1]
                    _send(
                        total,
                        messages[i, j, here + 1],
                        phase[i, j],
                        phase[i + step, j],
                        along,
                        limit,
                        out,
                    )


@njit
def decide(field, messages, choice, margin):  # type: ignore[no-untyped-def]
    """Labels in reading order, each given the labels before it; ``margin``: by how much the second
    best costs more."""
    unary, phase, link_x, link_y, limit = field
    height, width, count = unary.shape
    for i in range(height):
        for j in range(width):
            best, second, label = np.float32(np.inf), np.float32(np.inf), 0
            for a in range(count):
                cost = unary[i, j, a] + (messages[i, j, 2, a] + messages[i, j, 3, a])
                if j > 0:
                    neighbour_phase = phase[i, j - 1, choice[i, j - 1]]
                    cost += min(abs(neighbour_phase - phase[i, j, a]), limit) * link_x[i, j - 1]
                if i > 0:
                    neighbour_phase = phase[i - 1, j, choice[i - 1, j]]
                    cost += min(abs(neighbour_phase - phase[i, j, a]), limit) * link_y[i - 1, j]
                if cost < best:
                    best, second, label = cost, best, a
                elif cost < second:
                    second = cost
            choice[i, j] = label
            margin[i, j] = second - best
