"""Frames whose phase, fringe order and depth are known, which the cases disturb, and the error of what is decoded."""

import math

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench import coding, decoding, optics
from fpp_ml_bench.baselines.stability.cases import Floats, Outcome, worst

MEAN, MODULATION = 127.5, 100.0


def phases(count: int = 720) -> Floats:
    """Phases over the whole circle in rad, none of them a special value."""
    return -np.pi + 2 * np.pi * (np.arange(count) + 0.3819) / count


def sinusoids(phase: NDArray, shifts: int | NDArray, mean: float = MEAN, modulation: float = MODULATION) -> NDArray:
    """Frames A + B cos(phi + delta_n), (N, 1, n), of these shifts or a number of equal ones."""
    deltas = 2 * np.pi * np.arange(shifts) / shifts if isinstance(shifts, int) else shifts
    return mean + modulation * np.cos(phase[None, None, :] + np.reshape(deltas, (-1, 1, 1)))


def grey(values: NDArray) -> NDArray[np.uint8]:
    """Grey levels as an 8-bit camera records them."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def phase_error(frames: NDArray, deltas: NDArray | None = None) -> Floats:
    """Error in rad, on the circle, of the wrapped phase of frames of `phases`."""
    return np.angle(np.exp(1j * (coding.wrapped_phase(frames, deltas).phase[0] - phases())))


def frame_gain(steps: int) -> float:
    """max over phi of (2/N) sum |sin(phi + delta_n)|: largest change of (C, S) by errors of one grey level per frame;
    2/N times 2 / sin(pi/N) for even N and 1 / sin(pi/2N) for odd N, about 4/pi."""
    return 2 / steps * (2 / math.sin(math.pi / steps) if steps % 2 == 0 else 1 / math.sin(math.pi / (2 * steps)))


ROUNDING = 0.5 * frame_gain(18)
"""Largest change of the modulation by rounding 18 frames to whole grey levels."""


def worst_angle(shift: float, modulation: float = MODULATION) -> float:
    """Largest change of phase, rad, that moving (C, S) by ``shift`` can cause: asin(shift / B), or pi."""
    return math.asin(shift / modulation) if shift < modulation else math.pi


def coded_rig(pitch_px: float = 18.0, steps: int = 18, size: int = 32, length: int | None = None) -> optics.Rig:
    """The paper's rig with another pitch and number of steps, and as many Gray bits as these need."""
    rig = optics.paper_rig(size)
    device = rig.projector
    if length is not None:
        focal = device.fx * length / device.width
        device = optics.Pinhole(length, length, focal, focal, (length - 1) / 2, (length - 1) / 2)
    sequence = optics.Sequence(steps, *(coding.bits_needed(side, pitch_px) for side in (device.height, device.width)))
    return optics.Rig(rig.camera, device, rig.rotation, rig.translation_m, pitch_px, pitch_px, sequence)


def direction_levels(
    rig: optics.Rig,
    coordinate_px: NDArray,
    direction: optics.Direction = "vertical",
    mean: float = MEAN,
    modulation: float = MODULATION,
) -> Floats:
    """Grey levels of one direction's sinusoids, then Gray bits, at projector coordinates (n,); float64 (N + bits, n).
    A pixel sees one projector pixel's Gray code, the one its coordinate rounds to."""
    pitch, bits = rig.pitch(direction), rig.sequence.bits(direction)
    waves = sinusoids(2 * np.pi * coordinate_px / pitch, rig.sequence.steps, mean, modulation)[:, 0]
    code = coding.binary_to_gray(coding.cell_of(np.rint(coordinate_px), pitch))
    bright = (code >> np.arange(bits - 1, -1, -1)[:, None]) & 1
    return np.concatenate([waves, mean + modulation * (2.0 * bright - 1.0)])


def plane_stack(
    rig: optics.Rig, depth_m: float = 1.8, mean: float = MEAN, modulation: float = MODULATION
) -> tuple[list[NDArray[np.uint8] | None], NDArray]:
    """All frames of a plane square to the axis, and the pixels more than 3 px inside the projector's image, (H, W)."""
    x, y = rig.camera.rays()
    exact = rig.project(np.stack([x, y, np.ones_like(x)], axis=-1) * depth_m)
    frames: list[NDArray[np.uint8] | None] = [None] * len(rig.sequence)
    for direction, coordinate_px in zip(optics.AXES, exact, strict=True):
        levels = grey(direction_levels(rig, coordinate_px.ravel(), direction, mean, modulation))
        indices = [*rig.sequence.sinusoids(direction), *rig.sequence.gray(direction)]
        for index, level in zip(indices, levels, strict=True):
            frames[index] = level.reshape(x.shape)
    sides = rig.projector.width, rig.projector.height
    return frames, np.logical_and(*((w > 3) & (w < side - 4) for w, side in zip(exact, sides, strict=True)))


def coordinate_error(rig: optics.Rig, levels: NDArray, exact_px: NDArray) -> tuple[Floats, NDArray]:
    """Error in px of the vertical coordinate, decoded with the default limits, and the flagged pixels."""
    plan = decoding.plain_plan(rig, "vertical", rig.sequence.steps, coding.Limits())
    decoded = decoding.decode_direction(grey(levels), plan, coding.Limits())
    return decoded.coordinate_px - exact_px, decoded.reason != coding.Reason.DECODED


def decoded_coordinate(
    rig: optics.Rig, levels: NDArray, exact_px: NDArray, further_px: float | NDArray = 0.0
) -> Outcome:
    """The outcome of coordinates with the error of 8-bit frames and of ``further_px``."""
    error_px, flagged = coordinate_error(rig, levels, exact_px)
    return worst(error_px, rounding_px(rig) + further_px, flagged)


def px_per_m(rig: optics.Rig) -> float:
    """Change of u with depth at 1.8 m: f b / Z^2."""
    return rig.projector.fx * rig.translation_m[0] / 1.8**2


def rounding_px(rig: optics.Rig) -> float:
    """Largest error of a coordinate in px by rounding frames to whole grey levels."""
    return rig.pitch("vertical") / (2 * np.pi) * worst_angle(0.5 * frame_gain(rig.sequence.steps))
