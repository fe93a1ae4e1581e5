"""Fringe order on code edges, at phases of +-pi exactly, with flipped bits and with more periods than codes."""

import math
from dataclasses import replace

import numpy as np

from fpp_ml_bench import coding, decoding, optics
from fpp_ml_bench.baselines.stability import cases
from fpp_ml_bench.baselines.stability.cases import U64, Group, Outcome, difference, wide, worst
from fpp_ml_bench.baselines.stability.coded_frames import (
    MEAN,
    MODULATION,
    coded_rig,
    coordinate_error,
    decoded_coordinate,
    direction_levels,
    plane_stack,
    px_per_m,
    rounding_px,
    sinusoids,
)
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.machine import numba_enabled

ORDER = Group(
    "order",
    "the coordinate that the frames were made from",
    "P / 2 pi asin(g / 2B): 8-bit frames alone; a slip would be a whole period",
)


@ORDER.family("on a Gray edge", "px", pitch_px=(4.0, 18.0, 37.3), blend=(0.0, 0.25, 0.5, 0.75, 1.0))
def edge_blend(pitch_px: float, blend: float) -> Outcome:
    """coordinate of pixels that see both cells, at every edge of the code"""
    rig = coded_rig(pitch_px)
    cells = coding.cell_count(rig.pattern_length("vertical"), pitch_px)
    edges = np.ceil(np.arange(1, cells) * (pitch_px / 2))
    positions_px = edges - 1 + blend  # between the last pixel of a cell and the first of the next
    levels, steps = direction_levels(rig, positions_px), rig.sequence.steps
    below, above = (direction_levels(rig, px)[steps:] for px in (edges - 1, edges))
    levels[steps:] = (1 - blend) * below + blend * above
    return decoded_coordinate(rig, levels, positions_px)


@ORDER.family("phase at +-pi", "px", pitch_px=(4.0, 18.0, 100.0), bit_noise=(0.0, 0.7))
def wrap_at_pi(pitch_px: float, bit_noise: float) -> Outcome:
    """coordinate of pixels in the middle of every period"""
    rig = coded_rig(pitch_px)
    periods = int(rig.pattern_length("vertical") / pitch_px) - 1
    positions_px = (np.arange(periods) + 0.5) * pitch_px  # where the sign of the sine is arbitrary
    levels, steps = direction_levels(rig, positions_px), rig.sequence.steps
    levels[steps:] += bit_noise * MODULATION * np.random.default_rng(1).uniform(-1, 1, levels[steps:].shape)
    return decoded_coordinate(rig, levels, positions_px)


@ORDER.family(
    "order of a phase at the wrap",
    "rad",
    phase_rad=(-math.pi, math.pi, 3.1415926535897927, -3.1415926535897927, 0.0, -0.0, math.pi / 2),
)
def order_of_pi(phase_rad: float) -> Outcome:
    """absolute phase in each of 102 cells; against the same rule in 50 digits; bound: 4 u |Phi|: one product and two
    sums"""
    centres = coding.cell_centres_rad(912, 18.0)
    cells = np.arange(len(centres), dtype=np.int32)
    absolute, agrees = coding.absolute_phase(np.full(len(cells), phase_rad), cells, centres)
    two_pi = 2 * cases.high_precision().pi
    exact = phase_rad + two_pi * cases.by_mpmath("floor", (wide(centres) - phase_rad) / two_pi + 0.5)
    near = np.abs(exact.astype(float) - centres)
    may_flag = float(np.mean(near > coding.INCONSISTENT_RAD - 1e-9))
    return worst(difference(absolute, exact), 4 * U64 * np.abs(absolute).max(), ~agrees, may_flag)


@ORDER.family("arctangent", "rad", code=("compiled", "NumPy"), scale=(1.0, 255.0, 1e-12, 1e-150, 1e150))
def arctangent(scale: float, code: str) -> Outcome:
    """-atan2 in all octants, on the axes, beside +-pi; against 50 digits; bound: 4 u |phi|, the 2 ulp that the compiled
    arctangent promises"""
    beside, eighth = np.logspace(-15, -1, 15), np.pi / 8 + np.array([-1e-15, 0, 1e-15])
    turn = np.concatenate([np.linspace(-np.pi, np.pi, 97), np.pi - beside, -np.pi + beside, eighth])
    cosine = scale * np.concatenate([np.cos(turn), [1.0, -1, 0, 0, -1, 1]])
    sine = scale * np.concatenate([np.sin(turn), [0.0, 0, 1, -1, -1e-17, 1e-300]])
    if code == "compiled" and numba_enabled():
        from fpp_ml_bench.coding.kernels import _minus_atan2

        phase = np.array([_minus_atan2(a, b) for a, b in zip(sine, cosine, strict=True)])
    else:
        phase = coding.minus_atan2(sine, cosine)
    error = difference(phase, -cases.by_mpmath("atan2", wide(sine), wide(cosine)))
    error = error - 2 * np.pi * np.rint(error / (2 * np.pi))  # +pi and -pi are the same angle
    bound = np.maximum(4 * U64 * np.abs(phase), 2.0**-1073)
    return worst(error, np.maximum(bound, 8 * U64 * (np.abs(phase) > 3.0)))


@ORDER.family("interval of the phase", "rad")
def order_range() -> Outcome:
    """-atan2 of signed zeros and the smallest sines at a negative cosine; against the interval [-pi, pi); bound: exact:
    +pi is mapped to -pi"""
    phase = coding.minus_atan2(np.array([0.0, -0.0, 1e-300, -1e-300, -0.0]), np.array([-1.0] * 4 + [-1e-300]))
    return worst(np.maximum(phase - np.nextafter(np.pi, 0), 0) + np.maximum(-np.pi - phase, 0))


@ORDER.family("flipped bit, both directions", "mm", expects="either", direction=optics.AXES, bit=range(7))
def flipped_bit_both(bit: int, direction: optics.Direction) -> Outcome:
    """depth of a plane with one Gray bit inverted in the whole image; against the plane, 1800 mm; bound: 8-bit frames,
    by rig.md's slope; slipped pixels flagged: 18 px are 11 px off the epipolar line"""
    rig = coded_rig(size=96)
    frames, inside = plane_stack(rig)
    flipped = rig.sequence.gray(direction)[bit]
    frames[flipped] = 255 - np.asarray(frames[flipped])
    decoded = decoding.decode_stack(frames, rig, mask=inside)
    bound_mm = rounding_px(rig) / px_per_m(rig) * MM_PER_M * np.sqrt(2) * 1.01
    return worst(decoded.depth_mm[inside] - 1800.0, bound_mm, decoded.reason[inside] != coding.Reason.DECODED)


@ORDER.family("flipped bit, one direction", "px", expects="either", bit=range(7))
def flipped_bit_alone(bit: int) -> Outcome:
    """coordinate with one bit inverted, and the flagged pixels; against integer arithmetic on the misread cell: error
    in whole periods, or refused"""
    rig, pitch = coded_rig(), 18.0
    positions_px = np.arange(3.0, 909.0, 0.25)
    levels, row = direction_levels(rig, positions_px), rig.sequence.steps + bit
    levels[row] = 2 * MEAN - levels[row]
    cells, bits = np.floor(np.rint(positions_px) / (pitch / 2)).astype(int), rig.sequence.bits("vertical")
    read = np.asarray(coding.gray_to_binary(coding.binary_to_gray(cells) ^ (1 << (bits - 1 - bit))))
    centres = coding.cell_centres_rad(912, pitch)
    centre = centres[np.minimum(read, len(centres) - 1)]
    absolute = positions_px * 2 * np.pi / pitch
    slip = np.floor((centre - absolute) / (2 * np.pi) + 0.5)
    slipped_px = positions_px + pitch * slip
    off = np.abs(absolute + 2 * np.pi * slip - centre)
    refused = (read >= len(centres)) | (off > coding.INCONSISTENT_RAD) | (slipped_px < -0.5) | (slipped_px > 911.5)
    error, flagged = coordinate_error(rig, levels, slipped_px)
    # Within half a grey level of a limit both results are correct.
    wrong_flag = (flagged != refused) & ~(np.abs(off - coding.INCONSISTENT_RAD) < 0.01)
    silent = float(np.mean(~flagged & (slip != 0)))
    note = f"{silent:.0%} of the pixels are wrong by whole periods, which only both directions together can detect"
    return worst(np.where(wrong_flag, np.inf, error), rounding_px(rig), flagged & ~wrong_flag, note=note)


ORDER.family(
    "more periods than codes",
    "px",
    expects="refusal",
    refuses=RigError,
    bits=(1, 4, 5, 6),
    about="a rig of 51 "
    "periods with this number of Gray bits; against 102 cells need 7 bits; bound: the code would repeat",
)(lambda bits: replace(optics.paper_rig(32), sequence=optics.Sequence(18, 7, bits)))


@ORDER.family("cell off the pattern", "px", expects="refusal", cell=(102, 103, 111, 127))
def cell_off_pattern(cell: int) -> Outcome:
    """a pixel whose code names a cell beyond the pattern; against there is no such cell; bound: must be masked"""
    rig = optics.paper_rig(32)
    bright = (int(coding.binary_to_gray(cell)) >> np.arange(6, -1, -1)[:, None]) & 1
    waves = sinusoids(np.linspace(-3, 3, 50), rig.sequence.steps)[:, 0]
    levels = np.concatenate([waves, np.repeat(MEAN + MODULATION * (2.0 * bright - 1), 50, axis=1)])
    return worst(0.0, flagged=coordinate_error(rig, levels, np.zeros(50))[1])


@ORDER.family("code length", "px", bits=(1, 2, 7, 10, 13, 15))
def code_length(bits: int) -> Outcome:
    """coordinate in every cell of a full code, pitch 4 px, 3 steps; bound: P / 2 pi asin(g / 2B): 8-bit frames alone; a
    slip would be a whole period plus 8 u w"""
    # 15 bits fill the compiled decoder's 16-bit integers.
    rig = coded_rig(4.0, steps=3, length=min(65536, 2**bits * 2))
    positions_px = np.arange(2**bits) * 2 + 0.5
    return decoded_coordinate(rig, direction_levels(rig, positions_px), positions_px, 8 * U64 * positions_px)
