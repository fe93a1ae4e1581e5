"""Grey levels of pixels with known projector coordinates: the input of the decoding cases."""

import math

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.decoding import DirectionPlan, Limits, plan_direction
from fpp_ml_bench.optics import (
    DIRECTIONS,
    Direction,
    Pinhole,
    Rig,
    Sequence,
    binary_to_gray,
    bits_needed,
    cell_of,
    paper_rig,
)

MEAN = 127.5


def phases(count: int = 720) -> NDArray[np.float64]:
    """Phases over the whole circle in rad, none of them a special value."""
    return -np.pi + 2 * np.pi * (np.arange(count) + 0.3819) / count


def shifts(steps: int) -> NDArray[np.float64]:
    """Equal phase shifts 2 pi n / N."""
    return 2 * np.pi * np.arange(steps) / steps


def sinusoids(phase: NDArray, deltas: NDArray, mean: float, modulation: float) -> NDArray[np.float64]:
    """Frames A + B cos(phi + delta_n), (N, 1, n)."""
    return mean + modulation * np.cos(phase[None, None, :] + np.reshape(deltas, (-1, 1, 1)))


def grey(values: NDArray) -> NDArray[np.uint8]:
    """Grey levels as an 8-bit camera records them."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def frame_gain(steps: int) -> float:
    """max over phi of (2/N) sum |sin(phi + delta_n)|: largest change of (C, S) by errors of one grey level per frame.

    2/N times 2 / sin(pi/N) for even N and 1 / sin(pi/2N) for odd N, about 4/pi.
    """
    return 2 / steps * (2 / math.sin(math.pi / steps) if steps % 2 == 0 else 1 / math.sin(math.pi / (2 * steps)))


def worst_angle(shift: float, modulation: float) -> float:
    """Largest change of phase, rad, that moving (C, S) by ``shift`` can cause: asin(shift / B), or pi."""
    return math.asin(shift / modulation) if shift < modulation else math.pi


def coded_rig(pitch_px: float = 18.0, steps: int = 18, size: int = 32, length: int | None = None) -> Rig:
    """The paper's rig with another pitch and number of steps, and as many Gray bits as these need."""
    rig = paper_rig(size)
    device = rig.projector
    if length is not None:
        focal = device.fx * length / device.width
        device = Pinhole(length, length, focal, focal, (length - 1) / 2, (length - 1) / 2)
    bits_v, bits_u = (bits_needed(side, pitch_px) for side in (device.height, device.width))
    sequence = Sequence(steps, bits_v, bits_u)
    return Rig(rig.camera, device, rig.rotation, rig.translation_m, pitch_px, pitch_px, sequence)


def direction_levels(
    rig: Rig, coordinate_px: NDArray, direction: Direction = "vertical", mean: float = MEAN, modulation: float = 100.0
) -> NDArray[np.float64]:
    """Grey levels of one direction's sinusoids, then Gray bits, at projector coordinates (n,); float64 (N + bits, n).

    A pixel sees one projector pixel's Gray code, the one its coordinate rounds to.
    """
    pitch, bits = rig.pitch(direction), rig.sequence.bits(direction)
    angle = 2 * np.pi * coordinate_px / pitch
    waves = sinusoids(angle, shifts(rig.sequence.steps), mean, modulation)[:, 0]
    code = binary_to_gray(cell_of(np.rint(coordinate_px), pitch))
    bright = np.stack([(code >> (bits - 1 - bit)) & 1 for bit in range(bits)])
    return np.concatenate([waves, mean + modulation * (2.0 * bright - 1.0)])


def plan(rig: Rig, direction: Direction = "vertical", steps: int | None = None) -> DirectionPlan:
    """The decoder's plan for one direction with its default limits."""
    return plan_direction(rig, direction, rig.sequence.steps if steps is None else steps, Limits())


def plane_stack(
    rig: Rig, depth_m: float = 1.8, mean: float = MEAN, modulation: float = 100.0
) -> tuple[list[NDArray[np.uint8] | None], dict[Direction, NDArray[np.float64]]]:
    """All frames of a plane square to the axis, and its exact projector coordinates by direction, (H, W)."""
    x, y = rig.camera.rays()
    u, v = rig.project(np.stack([x, y, np.ones_like(x)], axis=-1) * depth_m)
    exact: dict[Direction, NDArray[np.float64]] = {"vertical": u, "horizontal": v}
    frames: list[NDArray[np.uint8] | None] = [None] * len(rig.sequence)
    for direction in DIRECTIONS:
        levels = grey(direction_levels(rig, exact[direction].ravel(), direction, mean, modulation))
        indices = [*rig.sequence.sinusoids(direction), *rig.sequence.gray(direction)]
        for index, level in zip(indices, levels, strict=True):
            frames[index] = level.reshape(x.shape)
    return frames, exact
