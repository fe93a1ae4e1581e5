"""Checks of the fringe order: blended, flipped and missing bits, and phases at the wrap."""

import numpy as np

from fpp_ml_bench.baselines.stability.case import Outcome, refusal, worst
from fpp_ml_bench.baselines.stability.frames import (
    MEAN,
    coded_rig,
    direction_levels,
    frame_gain,
    grey,
    plan,
    plane_stack,
    shifts,
    sinusoids,
    worst_angle,
)
from fpp_ml_bench.baselines.stability.roundoff import U64, difference, high_precision
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding import Limits, Reason, decode_direction, decode_stack, minus_atan2
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.machine import numba_enabled
from fpp_ml_bench.optics import (
    INCONSISTENT_RAD,
    Direction,
    Rig,
    Sequence,
    absolute_phase,
    binary_to_gray,
    cell_centres_rad,
    cell_count,
    gray_to_binary,
    paper_rig,
)

_MODULATION = 100.0


def _quantised_px(rig: Rig) -> float:
    """Largest error of a coordinate in px by rounding frames to whole grey levels."""
    return rig.pitch("vertical") / (2 * np.pi) * worst_angle(0.5 * frame_gain(rig.sequence.steps), _MODULATION)


def edge_blend(pitch_px: float, blend: float) -> Outcome:
    """Pixels that see two neighbouring cells at once: every bit is a mixture of both codes."""
    rig = coded_rig(pitch_px)
    length, half = rig.pattern_length("vertical"), pitch_px / 2
    edges = np.ceil(np.arange(1, cell_count(length, pitch_px)) * half)
    positions_px = edges - 1 + blend  # between the last pixel of a cell and the first of the next
    below, above = direction_levels(rig, edges - 1), direction_levels(rig, edges)
    levels = direction_levels(rig, positions_px)
    steps = rig.sequence.steps
    levels[steps:] = (1 - blend) * below[steps:] + blend * above[steps:]
    decoded = decode_direction(grey(levels), plan(rig), Limits())
    return worst(decoded.coordinate_px - positions_px, _quantised_px(rig), decoded.reason != Reason.DECODED)


def wrap_at_pi(pitch_px: float, bit_noise: float) -> Outcome:
    """Pixels at phase +-pi exactly, where the sign of the sine is arbitrary, with noisy but readable bits."""
    rig = coded_rig(pitch_px)
    periods = int(rig.pattern_length("vertical") / pitch_px) - 1
    positions_px = (np.arange(periods) + 0.5) * pitch_px
    levels = direction_levels(rig, positions_px)
    steps = rig.sequence.steps
    levels[steps:] += bit_noise * _MODULATION * np.random.default_rng(1).uniform(-1, 1, levels[steps:].shape)
    decoded = decode_direction(grey(levels), plan(rig), Limits())
    return worst(decoded.coordinate_px - positions_px, _quantised_px(rig), decoded.reason != Reason.DECODED)


def order_of_pi(phase_rad: float) -> Outcome:
    """The order rule for a phase at the wrap, in every cell: no period may be lost or gained."""
    rig = paper_rig(32)
    pitch, length = rig.pitch("vertical"), rig.pattern_length("vertical")
    centres = cell_centres_rad(length, pitch)
    cells = np.arange(len(centres), dtype=np.int32)
    absolute, agrees = absolute_phase(np.full(len(cells), phase_rad), cells, centres)
    mp = high_precision()
    exact = []
    for centre in centres:
        order = mp.floor((mp.mpf(float(centre)) - mp.mpf(phase_rad)) / (2 * mp.pi) + mp.mpf(0.5))
        exact.append(mp.mpf(phase_rad) + 2 * mp.pi * order)
    bound = 4 * U64 * np.abs(absolute).max()
    near = np.array([abs(float(value) - centre) for value, centre in zip(exact, centres, strict=True)])
    may_flag = float(np.mean(near > INCONSISTENT_RAD - 1e-9))
    return worst(difference(absolute, exact), bound, ~agrees, may_flag)


def arctangent(scale: float, code: str) -> Outcome:
    """The phase's arctangent in every octant, on the axes, and close to +-pi."""
    turn = np.concatenate(
        [
            np.linspace(-np.pi, np.pi, 97),
            np.pi - np.logspace(-15, -1, 15),
            -np.pi + np.logspace(-15, -1, 15),
            np.pi / 8 + np.array([-1e-15, 0, 1e-15]),
        ]
    )
    cosine, sine = scale * np.cos(turn), scale * np.sin(turn)
    cosine = np.concatenate([cosine, scale * np.array([1.0, -1, 0, 0, -1, 1])])
    sine = np.concatenate([sine, scale * np.array([0.0, 0, 1, -1, -1e-17, 1e-300])])
    if code == "compiled" and numba_enabled():
        from fpp_ml_bench.decoding.kernels import _minus_atan2

        phase = np.array([_minus_atan2(a, b) for a, b in zip(sine, cosine, strict=True)])
    else:
        phase = minus_atan2(sine, cosine)
    mp = high_precision()
    exact = [-mp.atan2(mp.mpf(float(a)), mp.mpf(float(b))) for a, b in zip(sine, cosine, strict=True)]
    error = difference(phase, exact)
    error = error - 2 * np.pi * np.rint(error / (2 * np.pi))  # +pi and -pi are the same angle
    bound = np.maximum(4 * U64 * np.abs(phase), 2.0**-1073)
    return worst(error, np.maximum(bound, 8 * U64 * (np.abs(phase) > 3.0)))


def order_range() -> Outcome:
    """The result is never +pi: the interval is [-pi, pi), also for signed zeros."""
    sine, cosine = np.array([0.0, -0.0, 1e-300, -1e-300, -0.0]), np.array([-1.0, -1.0, -1.0, -1.0, -1e-300])
    phase = minus_atan2(sine, cosine)
    return worst(np.maximum(phase - np.nextafter(np.pi, 0), 0) + np.maximum(-np.pi - phase, 0), 0.0)


def flipped_bit_both(bit: int, direction: Direction) -> Outcome:
    rig = coded_rig(size=96)
    frames, exact = plane_stack(rig)
    flipped = rig.sequence.gray(direction)[bit]
    turned_over = frames[flipped]
    frames[flipped] = None if turned_over is None else 255 - turned_over
    u, v = exact["vertical"], exact["horizontal"]
    inside = (u > 3) & (u < rig.projector.width - 4) & (v > 3) & (v < rig.projector.height - 4)
    decoded = decode_stack(frames, rig, mask=inside)
    per_metre = rig.projector.fx * rig.translation_m[0] / 1.8**2
    bound_mm = _quantised_px(rig) / per_metre * MM_PER_M * np.sqrt(2) * 1.01
    return worst(decoded.depth_mm[inside] - 1800.0, bound_mm, decoded.reason[inside] != Reason.DECODED, 1.0)


def flipped_bit_alone(bit: int) -> Outcome:
    """A single direction can't detect a flipped bit: the error must be the whole periods of the misread cell."""
    rig = coded_rig()
    pitch, bits = 18.0, rig.sequence.bits("vertical")
    positions_px = np.arange(3.0, rig.pattern_length("vertical") - 3.0, 0.25)
    levels = direction_levels(rig, positions_px)
    row = rig.sequence.steps + bit
    levels[row] = 2 * MEAN - levels[row]
    decoded = decode_direction(grey(levels), plan(rig), Limits())
    cells = np.floor(np.rint(positions_px) / (pitch / 2)).astype(int)
    read = np.asarray(gray_to_binary(binary_to_gray(cells) ^ (1 << (bits - 1 - bit))))
    centres = cell_centres_rad(912, pitch)
    exists = read < len(centres)
    centre = centres[np.minimum(read, len(centres) - 1)]
    absolute = positions_px * 2 * np.pi / pitch
    slip = np.floor((centre - absolute) / (2 * np.pi) + 0.5)
    refused = ~exists | (np.abs(absolute + 2 * np.pi * slip - centre) > INCONSISTENT_RAD)
    refused |= (positions_px + pitch * slip < -0.5) | (positions_px + pitch * slip > 911.5)
    flagged = decoded.reason != Reason.DECODED
    error = decoded.coordinate_px - (positions_px + pitch * slip)
    silent = float(np.mean(~flagged & (slip != 0)))
    # Within half a grey level of a limit both results are correct.
    near = np.abs(np.abs(absolute + 2 * np.pi * slip - centre) - INCONSISTENT_RAD) < 0.01
    wrong_flag = (flagged != refused) & ~near
    note = f"{silent:.0%} of the pixels are wrong by whole periods, which only both directions together can detect"
    return worst(np.where(wrong_flag, np.inf, error), _quantised_px(rig), flagged & ~wrong_flag, 1.0, note=note)


def too_few_codes(bits: int) -> Outcome:
    rig = paper_rig(32)

    def make() -> Rig:
        sequence = Sequence(18, 7, bits)
        return Rig(rig.camera, rig.projector, rig.rotation, rig.translation_m, 18.0, 18.0, sequence)

    return refusal(make, RigError)


def cell_off_pattern(cell: int) -> Outcome:
    """A code that is not in the pattern: seven bits encode 128 cells, and 912 px have 102."""
    rig = paper_rig(32)
    deltas = shifts(rig.sequence.steps)
    angle = np.linspace(-3, 3, 50)
    code = int(binary_to_gray(cell))
    bits = np.array([(code >> (6 - bit)) & 1 for bit in range(7)], float)
    waves = sinusoids(angle, deltas, MEAN, _MODULATION)[:, 0]
    levels = np.concatenate([waves, np.repeat(MEAN + _MODULATION * (2 * bits[:, None] - 1), 50, axis=1)])
    decoded = decode_direction(grey(levels), plan(rig), Limits())
    return worst(np.zeros(50), 0.0, decoded.reason != Reason.DECODED, 1.0)


def code_length(bits: int) -> Outcome:
    """Every cell of a full code; 15 bits fill the compiled decoder's 16-bit integers."""
    pitch = 4.0
    rig = coded_rig(pitch, steps=3, length=min(65536, 2**bits * 2))
    positions_px = np.arange(2**bits) * 2 + 0.5
    decoded = decode_direction(grey(direction_levels(rig, positions_px)), plan(rig), Limits())
    return worst(
        decoded.coordinate_px - positions_px,
        _quantised_px(rig) + 8 * U64 * positions_px,
        decoded.reason != Reason.DECODED,
    )
