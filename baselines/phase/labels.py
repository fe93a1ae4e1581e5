"""The candidate order of each pixel by sequential tree-reweighted message passing (Kolmogorov 2006, "TRW-S").

Plain belief propagation does not improve on its first sweep where smoothness is strong and brightness weak. There are
two implementations with the same results: compiled code in `label_kernels`, and NumPy here. A node depends on its left
and upper neighbours (backwards: right and lower), so all nodes of an anti-diagonal can be computed at once: row d of a
sheared map holds the nodes (i, d - i), at index i.
"""

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import Image
from fpp_ml_bench.machine import numba_enabled

Field = tuple[Image, Image, Image, Image, np.float32]

ROUNDS = 10
LARGE = np.float32(1e4)  # cost of a candidate that does not exist


def least_energy(
    unary: Image, phase_rad: Image, link_x: Image, link_y: Image, limit_rad: float, rounds: int = ROUNDS
) -> tuple[NDArray[np.int32], Image]:
    """Index of the chosen candidate, int32 (H, W), and its margin to the second best, float32 (at most `LARGE`).
    ``unary`` (K, H, W): costs of K candidates; ``phase_rad`` (K, H, W): residual phase of each; ``link_x`` (H, W - 1)
    and ``link_y`` (H - 1, W): weight of the smoothness between neighbours, 0 where one of them is not object;
    ``limit_rad``: a jump from which on it costs no more."""
    if numba_enabled():
        from fpp_ml_bench.baselines.phase.label_kernels import decide, iterate
    else:
        decide, iterate = _decide, _iterate
    count, height, width = unary.shape
    # One node's candidates side by side.
    costs, phases = (np.ascontiguousarray(maps.transpose(1, 2, 0), np.float32) for maps in (unary, phase_rad))
    links = np.ascontiguousarray(link_x, np.float32), np.ascontiguousarray(link_y, np.float32)
    field = (costs, phases, *links, np.float32(limit_rad))
    messages = np.zeros((height, width, 4, count), np.float32)
    iterate(field, rounds, messages)
    choice, margin = np.zeros((height, width), np.int32), np.zeros((height, width), np.float32)
    decide(field, messages, choice, margin)
    return choice, np.minimum(margin, LARGE)


def _sheared(image: NDArray) -> NDArray:
    """``image`` (height, width, ...) as (height + width - 1, height, ...), zeros where there is no node."""
    height, width, *rest = image.shape
    out = np.zeros((height + width - 1, height, *rest), image.dtype)
    i, j = np.indices((height, width))
    out[i + j, i] = image
    return out


def _straight(image: NDArray, height: int, width: int) -> NDArray:
    i, j = np.indices((height, width))
    return image[i + j, i]


def _links(link_x: Image, link_y: Image) -> list[Image]:
    """Weight towards the left, upper, right and lower neighbour, 0 beyond the border, sheared."""
    before, after = (((0, 0), (1, 0)), ((1, 0), (0, 0))), (((0, 0), (0, 1)), ((0, 1), (0, 0)))
    links = (link_x, link_y)
    return [_sheared(np.pad(link, pad)) for side in (before, after) for link, pad in zip(links, side, strict=True)]


def _send(
    costs: Image, returned: Image, phases: Image, neighbour_phases: Image, weight: Image, limit: np.float32
) -> Image:
    jump = np.minimum(np.abs(phases[:, :, None] - neighbour_phases[:, None, :]), limit) * weight[:, None, None]
    out: Image = ((costs - returned)[:, :, None] + jump).min(axis=1)
    return out - out.min(axis=1, keepdims=True)


def _iterate(field: Field, rounds: int, messages: Image) -> None:
    """As `label_kernels.iterate`: ``messages`` (H, W, 4, K) are updated in place."""
    unary, phase, link_x, link_y, limit = field
    height, width, _ = unary.shape
    left, up, right, down = _links(link_x, link_y)
    cost, phases, passed = (_sheared(maps) for maps in (unary, phase, messages))
    ahead, behind = (np.add(across > 0, along > 0, dtype=np.float32) for across, along in ((right, down), (left, up)))
    share = np.maximum(np.maximum(ahead, behind), np.float32(1))
    last = height + width - 2
    forward = (range(last), 1, right, down, 2, slice(None, -1), slice(1, None))
    backward = (range(last, 0, -1), -1, left, up, 0, slice(1, None), slice(None, -1))
    for _ in range(rounds):
        for diagonals, step, across, along, here, own, other in (forward, backward):
            there = 2 - here
            for d in diagonals:
                n = d + step
                received = (passed[d, :, 0] + passed[d, :, 1]) + (passed[d, :, 2] + passed[d, :, 3])
                total = (cost[d] + received) / share[d][:, None]
                linked = across[d] > 0
                message = _send(total, passed[d, :, here], phases[d], phases[n], across[d], limit)
                passed[n, linked, there] = message[linked]
                linked = along[d, own] > 0
                returned = passed[d, own, here + 1]
                message = _send(total[own], returned, phases[d, own], phases[n, other], along[d, own], limit)
                passed[n, other, there + 1][linked] = message[linked]
    messages[:] = _straight(passed, height, width)


def _decide(field: Field, messages: Image, choice: NDArray[np.int32], margin: Image) -> None:
    """As `label_kernels.decide`: ``choice`` and ``margin`` (H, W) are written."""
    unary, phase, link_x, link_y, limit = field
    height, width, count = unary.shape
    left, up, _, _ = _links(link_x, link_y)
    cost, phases, passed = (_sheared(maps) for maps in (unary, phase, messages))
    labels, margins = np.zeros(cost.shape[:2], np.int32), np.zeros(cost.shape[:2], np.float32)
    chosen_phase = np.zeros(height, np.float32)
    for d in range(height + width - 1):
        total = cost[d] + (passed[d, :, 2] + passed[d, :, 3])
        if d:
            total = total + np.minimum(np.abs(chosen_phase[:, None] - phases[d]), limit) * left[d][:, None]
            above = np.concatenate([chosen_phase[:1], chosen_phase[:-1]])
            total = total + np.minimum(np.abs(above[:, None] - phases[d]), limit) * up[d][:, None]
        labels[d] = total.argmin(axis=1)
        chosen_phase = np.take_along_axis(phases[d], labels[d][:, None].astype(np.intp), axis=1)[:, 0]
        ordered = np.sort(total, axis=1)
        margins[d] = ordered[:, 1] - ordered[:, 0] if count > 1 else np.inf
    choice[:], margin[:] = _straight(labels, height, width), _straight(margins, height, width)
