"""The message passing of `label_kernels` in NumPy, where compiled kernels are switched off: the same numbers.

A node depends on its left and upper neighbours (backwards: right and lower), so all nodes of an anti-diagonal can be
computed at once. Maps are sheared for that: row d of a sheared map holds the nodes (i, d - i), at index i.
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
    towards = {side: np.zeros((height, width), np.float32) for side in ("left", "right", "up", "down")}
    towards["right"][:, : width - 1], towards["left"][:, 1:] = link_x, link_x
    towards["down"][: height - 1], towards["up"][1:] = link_y, link_y
    return {side: _sheared(weights, height, width) for side, weights in towards.items()}


def _send(
    costs: Array, returned: Array, phases: Array, neighbour_phases: Array, weight: Array, limit: np.float32
) -> Array:
    jump = np.minimum(np.abs(phases[:, :, None] - neighbour_phases[:, None, :]), limit) * weight[:, None, None]
    out: Array = ((costs - returned)[:, :, None] + jump).min(axis=1)
    return out - out.min(axis=1, keepdims=True)


def iterate(
    unary: Array, phase: Array, link_x: Array, link_y: Array, limit: np.float32, rounds: int, messages: Array
) -> None:
    """As `label_kernels.iterate`: ``messages`` (H, W, 4, K) are updated in place."""
    height, width, _ = unary.shape
    towards = _links(link_x, link_y, height, width)
    cost, phases, passed = (_sheared(maps, height, width) for maps in (unary, phase, messages))
    ahead = (towards["right"] > 0).astype(np.float32) + (towards["down"] > 0)
    behind = (towards["left"] > 0).astype(np.float32) + (towards["up"] > 0)
    share = np.maximum(np.maximum(ahead, behind), 1).astype(np.float32)
    last = height + width - 2
    for _ in range(rounds):
        for d in range(last):
            total = _gather(cost[d], passed[d]) / share[d][:, None]
            linked = towards["right"][d] > 0
            message = _send(total, passed[d, :, 2], phases[d], phases[d + 1], towards["right"][d], limit)
            passed[d + 1, linked, 0] = message[linked]
            down = towards["down"][d, :-1]
            message = _send(total[:-1], passed[d, :-1, 3], phases[d, :-1], phases[d + 1, 1:], down, limit)
            passed[d + 1, 1:, 1][down > 0] = message[down > 0]
        for d in range(last, 0, -1):
            total = _gather(cost[d], passed[d]) / share[d][:, None]
            linked = towards["left"][d] > 0
            message = _send(total, passed[d, :, 0], phases[d], phases[d - 1], towards["left"][d], limit)
            passed[d - 1, linked, 2] = message[linked]
            up = towards["up"][d, 1:]
            message = _send(total[1:], passed[d, 1:, 1], phases[d, 1:], phases[d - 1, :-1], up, limit)
            passed[d - 1, :-1, 3][up > 0] = message[up > 0]
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
    towards = _links(link_x, link_y, height, width)
    cost, phases = _sheared(unary, height, width), _sheared(phase, height, width)
    passed = _sheared(messages, height, width)
    labels, margins = np.zeros(cost.shape[:2], np.int32), np.zeros(cost.shape[:2], np.float32)
    chosen_phase = np.zeros(height, np.float32)
    for d in range(height + width - 1):
        total = cost[d] + (passed[d, :, 2] + passed[d, :, 3])
        if d:
            total = total + np.minimum(np.abs(chosen_phase[:, None] - phases[d]), limit) * towards["left"][d][:, None]
            above = np.concatenate([chosen_phase[:1], chosen_phase[:-1]])
            total = total + np.minimum(np.abs(above[:, None] - phases[d]), limit) * towards["up"][d][:, None]
        labels[d] = total.argmin(axis=1)
        chosen_phase = np.take_along_axis(phases[d], labels[d][:, None].astype(np.intp), axis=1)[:, 0]
        ordered = np.sort(total, axis=1)
        margins[d] = ordered[:, 1] - ordered[:, 0] if count > 1 else np.inf
    choice[:], margin[:] = _straight(labels, height, width), _straight(margins, height, width)
