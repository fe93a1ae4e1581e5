"""Sequential tree-reweighted message passing (Kolmogorov 2006, "TRW-S") over a few candidates a pixel.

Imported only where `fpp_ml_bench.machine` compiles; `label_sweeps` gives the same numbers in NumPy. Messages are
stored at the node that receives them: 0 from the left, 1 from above, 2 from the right, 3 from below.
"""

import numpy as np

from fpp_ml_bench.machine import njit


@njit
def _send(costs, returned, phases, neighbour_phases, weight, limit, out):  # type: ignore[no-untyped-def]
    """Message to a neighbour: ``costs`` minus the message ``returned`` by it, over a truncated linear jump; least entry
    0."""
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
def _gather(unary, messages, i, j, total):  # type: ignore[no-untyped-def]
    for a in range(total.shape[0]):
        total[a] = unary[i, j, a] + (
            (messages[i, j, 0, a] + messages[i, j, 1, a]) + (messages[i, j, 2, a] + messages[i, j, 3, a])
        )


@njit
def iterate(unary, phase, link_x, link_y, limit, rounds, messages):  # type: ignore[no-untyped-def]
    """``rounds`` forward and backward passes over (H, W, K) costs; ``messages`` (H, W, 4, K) are updated in place."""
    height, width, count = unary.shape
    total = np.empty(count, np.float32)
    none = np.float32(0.0)
    for _ in range(rounds):
        for i in range(height):
            for j in range(width):
                right = link_x[i, j] if j < width - 1 else none
                down = link_y[i, j] if i < height - 1 else none
                if right == none and down == none:
                    continue
                left = link_x[i, j - 1] if j > 0 else none
                up = link_y[i - 1, j] if i > 0 else none
                ahead, behind = int(right > none) + int(down > none), int(left > none) + int(up > none)
                _gather(unary, messages, i, j, total)
                for a in range(count):
                    total[a] = total[a] / np.float32(max(ahead, behind))
                if right > none:
                    _send(total, messages[i, j, 2], phase[i, j], phase[i, j + 1], right, limit, messages[i, j + 1, 0])
                if down > none:
                    _send(total, messages[i, j, 3], phase[i, j], phase[i + 1, j], down, limit, messages[i + 1, j, 1])
        for i in range(height - 1, -1, -1):
            for j in range(width - 1, -1, -1):
                left = link_x[i, j - 1] if j > 0 else none
                up = link_y[i - 1, j] if i > 0 else none
                if left == none and up == none:
                    continue
                right = link_x[i, j] if j < width - 1 else none
                down = link_y[i, j] if i < height - 1 else none
                ahead, behind = int(right > none) + int(down > none), int(left > none) + int(up > none)
                _gather(unary, messages, i, j, total)
                for a in range(count):
                    total[a] = total[a] / np.float32(max(ahead, behind))
                if left > none:
                    _send(total, messages[i, j, 0], phase[i, j], phase[i, j - 1], left, limit, messages[i, j - 1, 2])
                if up > none:
                    _send(total, messages[i, j, 1], phase[i, j], phase[i - 1, j], up, limit, messages[i - 1, j, 3])


@njit
def decide(unary, phase, link_x, link_y, limit, messages, choice, margin):  # type: ignore[no-untyped-def]
    """Labels in reading order, each given the labels before it; ``margin``: by how much the second best costs more."""
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
