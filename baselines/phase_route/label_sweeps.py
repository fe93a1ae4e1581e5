"""The message passing of `label_kernels` in NumPy, where compiled kernels are switched off: the same numbers.

A node waits for its left and upper neighbours (backwards: right and lower), so all nodes of one anti-diagonal can be
worked off at once. Maps are sheared for that: row d of a sheared map holds the nodes (i, d - i), at place i.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


def _sheared(image: NDArray, height: int, width: int) -> NDArray:
    """``image`` (height, width, ...) as (height + width - 1, height, ...), zeros where there is no node."""
    i, j = np.indices((height, width))
    out = np.zeros((height + width - 1, height, *image.shape[2:]), image.dtype)
    out[i + j, i] = image
    return out


def _straight(image: NDArray, height: int, width: int) -> NDArray:
    i, j = np.indices((height, width))
    return image[i + j, i]


def _links(link_x: Array, link_y: Array, height: int, width: int) -> dict[str, Array]:
    """Weight towards each neighbour, 0 beyond the border, sheared."""
    to = {side: np.zeros((height, width), np.float32) for side in ("left", "right", "up", "down")}
    to["right"][:, : width - 1], to["left"][:, 1:] = link_x, link_x
    to["down"][: height - 1], to["up"][1:] = link_y, link_y
    return {side: _sheared(one, height, width) for side, one in to.items()}


def _send(own: Array, back: Array, mine: Array, theirs: Array, weight: Array, limit: np.float32) -> Array:
    jump = np.minimum(np.abs(mine[:, :, None] - theirs[:, None, :]), limit) * weight[:, None, None]
    out: Array = ((own - back)[:, :, None] + jump).min(axis=1)
    return out - out.min(axis=1, keepdims=True)


def iterate(
    unary: Array, phase: Array, link_x: Array, link_y: Array, limit: np.float32, rounds: int, messages: Array
) -> None:
    """As `label_kernels.iterate`: ``messages`` (H, W, 4, K) are updated in place."""
    height, width, _ = unary.shape
    to = _links(link_x, link_y, height, width)
    cost, seen, passed = (_sheared(one, height, width) for one in (unary, phase, messages))
    ahead = (to["right"] > 0).astype(np.float32) + (to["down"] > 0)
    behind = (to["left"] > 0).astype(np.float32) + (to["up"] > 0)
    share = np.maximum(np.maximum(ahead, behind), 1).astype(np.float32)
    last = height + width - 2
    for _ in range(rounds):
        for d in range(last):
            total = _gather(cost[d], passed[d]) / share[d][:, None]
            some = to["right"][d] > 0
            sent = _send(total, passed[d, :, 2], seen[d], seen[d + 1], to["right"][d], limit)
            passed[d + 1, some, 0] = sent[some]
            down = to["down"][d, :-1]
            sent = _send(total[:-1], passed[d, :-1, 3], seen[d, :-1], seen[d + 1, 1:], down, limit)
            passed[d + 1, 1:, 1][down > 0] = sent[down > 0]
        for d in range(last, 0, -1):
            total = _gather(cost[d], passed[d]) / share[d][:, None]
            some = to["left"][d] > 0
            sent = _send(total, passed[d, :, 0], seen[d], seen[d - 1], to["left"][d], limit)
            passed[d - 1, some, 2] = sent[some]
            up = to["up"][d, 1:]
            sent = _send(total[1:], passed[d, 1:, 1], seen[d, 1:], seen[d - 1, :-1], up, limit)
            passed[d - 1, :-1, 3][up > 0] = sent[up > 0]
    messages[:] = _straight(passed, height, width)


def _gather(cost: Array, passed: Array) -> Array:
    total: Array = cost + ((passed[:, 0] + passed[:, 1]) + (passed[:, 2] + passed[:, 3]))
    return total


def decide(
    unary: Array, phase: Array, link_x: Array, link_y: Array, limit: np.float32, messages: Array,
    choice: NDArray[np.int32], margin: Array,
) -> None:  # fmt: skip
    """As `label_kernels.decide`: ``choice`` and ``margin`` (H, W) are written."""
    height, width, count = unary.shape
    to = _links(link_x, link_y, height, width)
    cost, seen = _sheared(unary, height, width), _sheared(phase, height, width)
    passed = _sheared(messages, height, width)
    taken, lead = np.zeros(cost.shape[:2], np.int32), np.zeros(cost.shape[:2], np.float32)
    held = np.zeros(height, np.float32)
    for d in range(height + width - 1):
        total = cost[d] + (passed[d, :, 2] + passed[d, :, 3])
        if d:
            total = total + np.minimum(np.abs(held[:, None] - seen[d]), limit) * to["left"][d][:, None]
            above = np.concatenate([held[:1], held[:-1]])
            total = total + np.minimum(np.abs(above[:, None] - seen[d]), limit) * to["up"][d][:, None]
        taken[d] = total.argmin(axis=1)
        held = np.take_along_axis(seen[d], taken[d][:, None].astype(np.intp), axis=1)[:, 0]
        ordered = np.sort(total, axis=1)
        lead[d] = ordered[:, 1] - ordered[:, 0] if count > 1 else np.inf
    choice[:], margin[:] = _straight(taken, height, width), _straight(lead, height, width)
