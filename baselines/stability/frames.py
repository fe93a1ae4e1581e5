"""Frames whose phase, fringe order and depth are known, and what disturbs them: dim, clipped, non-linear, coarse, few,
unequal or dead frames; fringe order on code edges, at phases of +-pi exactly, with flipped bits, and with more periods
than codes."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.stability.cases import (
    U64,
    Expects,
    Floats,
    Group,
    Outcome,
    by_mpmath,
    difference,
    high_precision,
    wide,
    worst,
)
from fpp_ml_bench.coding.code import MIN_MODULATION, Limits, Reason
from fpp_ml_bench.coding.gray_code import (
    INCONSISTENT_RAD,
    absolute_phase,
    binary_to_gray,
    bits_needed,
    cell_centres_rad,
    cell_count,
    cell_of,
    gray_to_binary,
)
from fpp_ml_bench.coding.phase_shift import choose_steps, minus_atan2, phase_weights, wrapped_phase
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding.blocks import decode_direction, plain_plan
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.errors import DecodeError, RigError
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import AXES, Direction, Sequence
from fpp_ml_bench.portable import arctangent2

PHASE = Group("phase", "the phase that the frames were made from")
ORDER = Group(
    "order",
    "the coordinate that the frames were made from",
    "P / 2 pi asin(g / 2B): 8-bit frames alone; a slip would be a whole period",
)
MEAN, MODULATION = 127.5, 100.0
MODULATIONS = (100.0, 30.0, 10.0, 5.0, 3.0, 1.0, 0.3, 0.1)
SHARES = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
NOISE = math.sqrt(2 / 18) * math.hypot(1.0, math.sqrt(1 / 12))
"""Standard deviation of the modulation by noise and rounding of one grey level, 18 steps."""


def phases(count: int = 720) -> Floats:
    """Phases over the whole circle in rad, (1, count), none of them a special value."""
    return -np.pi + 2 * np.pi * (np.arange(count)[None] + 0.3819) / count


def sinusoids(phase: NDArray, shifts: int | NDArray, mean: float = MEAN, modulation: float = MODULATION) -> NDArray:
    """Frames A + B cos(phi + delta_n), (N, ...), of these shifts or a number of equal ones."""
    deltas = 2 * np.pi * np.arange(shifts) / shifts if isinstance(shifts, int) else shifts
    return mean + modulation * np.cos(np.add.outer(deltas, phase))


def grey(values: NDArray) -> NDArray[np.uint8]:
    """Grey levels as an 8-bit camera records them."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def phase_error(frames: NDArray, deltas: NDArray | None = None) -> Floats:
    """Error in rad, on the circle, of the wrapped phase of frames of `phases`."""
    return np.angle(np.exp(1j * (wrapped_phase(frames, deltas).phase - phases())))


def rounding(steps: int = 18) -> float:
    """Largest change of (C, S) by rounding frames to whole grey levels: g / 2, g = max over phi of (2/N) sum
    |sin(phi + delta_n)|, which is 2/N times 2 / sin(pi/N) for even N and 1 / sin(pi/2N) for odd N, about 4/pi."""
    return 1 / steps * (2 / math.sin(math.pi / steps) if steps % 2 == 0 else 1 / math.sin(math.pi / (2 * steps)))


def worst_angle(shift: float, modulation: float = MODULATION) -> float:
    """Largest change of phase, rad, that moving (C, S) by ``shift`` can cause: asin(shift / B), or pi."""
    return math.asin(shift / modulation) if shift < modulation else math.pi


def coded_rig(pitch_px: float = 18.0, steps: int = 18, size: int = 32, length: int | None = None) -> Rig:
    """The paper's rig with another pitch and number of steps, and as many Gray bits as these need; ``length``: sides of
    the projector's image in px."""
    rig = paper_rig(size)
    device = rig.projector
    if length is not None:
        focal = device.fx * length / device.width
        device = Pinhole(length, length, focal, focal, (length - 1) / 2, (length - 1) / 2)
    sequence = Sequence(steps, *(bits_needed(side, pitch_px) for side in (device.height, device.width)))
    return Rig(rig.camera, device, rig.rotation, rig.translation_m, pitch_px, pitch_px, sequence)


def gray_levels(cells: NDArray, bits: int, mean: float = MEAN, modulation: float = MODULATION) -> NDArray:
    """Grey levels of the Gray bits of cells (n,), float64 (bits, n)."""
    bright = (binary_to_gray(cells) >> np.arange(bits - 1, -1, -1)[:, None]) & 1
    return mean + modulation * (2.0 * bright - 1.0)


def direction_levels(
    rig: Rig,
    coordinate_px: NDArray,
    direction: Direction = "vertical",
    mean: float = MEAN,
    modulation: float = MODULATION,
) -> Floats:
    """Grey levels of one direction's sinusoids, then Gray bits, at projector coordinates (n,); float64 (N + bits, n).
    A pixel sees one projector pixel's Gray code, the one its coordinate rounds to."""
    pitch, sequence = rig.pitch(direction), rig.sequence
    waves = sinusoids(2 * np.pi * coordinate_px / pitch, sequence.steps, mean, modulation)
    cells = cell_of(np.rint(coordinate_px), pitch)
    return np.concatenate([waves, gray_levels(cells, sequence.bits(direction), mean, modulation)])


def plane_stack(
    rig: Rig, depth_m: float = 1.8, mean: float = MEAN, modulation: float = MODULATION
) -> tuple[list[NDArray[np.uint8] | None], NDArray]:
    """All frames of a plane square to the axis, and the pixels more than 3 px inside the projector's image, (H, W)."""
    x, y = rig.camera.rays()
    exact = rig.project(np.stack([x, y, np.ones_like(x)], axis=-1) * depth_m)
    frames: list[NDArray[np.uint8] | None] = [None] * len(rig.sequence)
    inside, sides = np.ones(x.shape, bool), (rig.projector.width, rig.projector.height)
    for direction, px, side in zip(AXES, exact, sides, strict=True):
        levels = grey(direction_levels(rig, px.ravel(), direction, mean, modulation)).reshape(-1, *x.shape)
        for index, level in zip(
            [*rig.sequence.sinusoids(direction), *rig.sequence.gray(direction)], levels, strict=True
        ):
            frames[index] = level
        inside &= (px > 3) & (px < side - 4)
    return frames, inside


def coordinate_error(rig: Rig, levels: NDArray, exact_px: NDArray) -> tuple[Floats, NDArray]:
    """Error in px of the vertical coordinate, decoded with the default limits, and the flagged pixels."""
    plan = plain_plan(rig, "vertical", rig.sequence.steps, Limits())
    decoded = decode_direction(grey(levels), plan, Limits())
    return decoded.coordinate_px - exact_px, decoded.reason != Reason.DECODED


def rounding_px(rig: Rig) -> float:
    """Largest error of a coordinate in px by rounding frames to whole grey levels."""
    return rig.pitch("vertical") / (2 * np.pi) * worst_angle(rounding(rig.sequence.steps))


def decoded_coordinate(
    rig: Rig, exact_px: NDArray, levels: NDArray | None = None, further_px: float | NDArray = 0.0
) -> Outcome:
    """The outcome of coordinates with the error of 8-bit frames and of ``further_px``; ``levels``: what the camera sees
    of them, where disturbed."""
    error_px, flagged = coordinate_error(rig, direction_levels(rig, exact_px) if levels is None else levels, exact_px)
    return worst(error_px, rounding_px(rig) + further_px, flagged)


def px_per_m(rig: Rig) -> float:
    """Change of u with depth at 1.8 m: f b / Z^2."""
    return rig.projector.fx * rig.translation_m[0] / 1.8**2


def _decoded_phase(
    mean: float, modulation: float, count: int = 2000, noise_grey: float = 0.0
) -> tuple[Floats, NDArray]:
    """Error of the absolute phase in rad, which includes slipped periods, across the pattern; the flagged pixels."""
    rig, positions_px = coded_rig(), np.linspace(2.0, 909.0, count)
    levels = direction_levels(rig, positions_px, mean=mean, modulation=modulation)
    levels += noise_grey * np.random.default_rng(7).standard_normal(levels.shape)
    error_px, flagged = coordinate_error(rig, levels, positions_px)
    return error_px * 2 * np.pi / 18.0, flagged


def _least_squares(
    frames: NDArray, shifts: NDArray | None, deltas: NDArray[np.object_], bound: float, condition: float
) -> Outcome:
    """The outcome of the wrapped phase of float64 frames (N, 1, n) at ``shifts``, against least squares of the same
    frames in 50 digits at the same shifts, ``deltas``."""
    mp = high_precision()
    model = mp.matrix([[1, mp.cos(delta), mp.sin(delta)] for delta in deltas])
    solve = (model.T * model) ** -1 * model.T
    _, cosine, sine = np.array(solve.tolist()) @ wide(frames[:, 0])
    error = difference(wrapped_phase(frames, shifts).phase[0], -by_mpmath("atan2", sine, cosine))
    return worst(error, bound, condition=condition)


@PHASE.family("modulation, real frames", "rad", modulation=MODULATIONS)
def modulation_exact(modulation: float) -> Outcome:
    """wrapped phase of 18 float64 frames; against least squares of the same frames in 50 digits; bound: sqrt(2) 2 (N +
    4 pi + 2) u (A + B) / B: N + 1 roundings a sum, 4 pi + 1 in each weight, over B"""
    condition, exact = (MEAN + modulation) / modulation, 2 * high_precision().pi * wide(range(18)) / 18
    bound = math.sqrt(2) * 2 * (18 + 4 * math.pi + 2) * U64 * condition + 2 * math.pi * U64
    return _least_squares(sinusoids(phases(48), 18, MEAN, modulation), None, exact, bound, condition)


def _expects(modulation: float, spread: float) -> Expects:
    """What is expected of a modulation that is measured within ``spread`` of its value."""
    if abs(modulation - MIN_MODULATION) <= spread:
        return "either"
    return "number" if modulation > MIN_MODULATION else "refusal"


@PHASE.family(
    "modulation, 8-bit frames",
    "rad",
    modulation=MODULATIONS,
    expects=lambda modulation: _expects(modulation, rounding()),
)
def modulation_8bit(modulation: float) -> Outcome:
    """absolute phase by the decoder, 8-bit frames; bound: asin(g / 2B), g = max (2/N) sum |sin|: half a grey level in
    every frame; under 5 levels refused"""
    error, flagged = _decoded_phase(MEAN, modulation)
    return worst(error, worst_angle(rounding(), modulation), flagged)


@PHASE.family(
    "modulation, noise of 1 grey level",
    "rad",
    modulation=MODULATIONS,  # up to six sigma off the limit:
    expects=lambda modulation: _expects(modulation, 6 * NOISE),
)
def noise(modulation: float) -> Outcome:
    """rms error of absolute phase, 20,000 pixels; bound: sqrt(2/N) sigma / B with sigma^2 = 1 + 1/12, second order 2
    sigma_phi^2, 4 standard errors"""
    error, flagged = _decoded_phase(MEAN, modulation, 20_000, 1.0)
    sigma, unflagged = NOISE / modulation, error[~flagged]
    if not unflagged.size:
        return Outcome(None, flagged=1.0, note="every pixel is masked: low modulation")
    bound = sigma * (1 + 2 * sigma**2 + 4 / math.sqrt(2 * unflagged.size))
    return Outcome(float(np.sqrt(np.mean(unflagged**2))), bound, float(flagged.mean()))


def _clip_harmonic(order: int, alpha: float) -> float:
    """Fourier coefficient of max(cos t - cos alpha, 0): (2/pi) times its integral against cos(order t), 0..alpha."""
    if order == 1:
        return (alpha - math.sin(alpha) * math.cos(alpha)) / math.pi
    total = math.sin((order - 1) * alpha) / (order - 1) + math.sin((order + 1) * alpha) / (order + 1)
    return (total - 2 * math.cos(alpha) * math.sin(order * alpha) / order) / math.pi


def _aliases(steps: int, highest: int) -> list[int]:
    """The harmonics kN +- 1, which N steps alias with the fringe."""
    return [k * steps + side for k in range(1, highest) for side in (-1, 1)]


def _clipped(share: float, steps: int, highest: int) -> tuple[float, float, float]:
    """The mean with which ``share`` of a period is above 255; aliased harmonics, and what is left of the first."""
    alpha = math.pi * share
    leak = sum(abs(_clip_harmonic(order, alpha)) for order in _aliases(steps, highest))
    return 255.0 - MODULATION * math.cos(alpha) if share else MEAN, leak, 1 - _clip_harmonic(1, alpha)


@PHASE.family("saturation, phase alone", "rad", steps=(18, 3), share=SHARES)
def saturation_phase(share: float, steps: int) -> Outcome:
    """wrapped phase of frames clipped in a share of the period; bound: asin(sum |c_(kN-1)| + |c_(kN+1)| over c_1):
    aliased harmonics of a clipped cosine, closed form"""
    mean, leak, left = _clipped(share, steps, 4000)
    rest = 8 / (math.pi * (steps * 4000) * steps) if share else 0.0  # of the tail: |coefficient| <= 4 / (pi order^2)
    frames = np.minimum(sinusoids(phases(), steps, mean), 255.0)
    return worst(phase_error(frames), worst_angle(leak + rest, left) + 100 * U64)


@PHASE.family(
    "saturation, decoder",
    "rad",
    share=SHARES,  # clipped are floor(18 share) frames, or one more
    expects=lambda share: ("number", "number", "either", "refusal")[min(int(18 * share), 3)],
)
def saturation_decoder(share: float) -> Outcome:
    """absolute phase by the decoder, 8-bit frames; bound: as above, plus half a grey level; more than 2 clipped frames
    of 18 must be refused"""
    mean, leak, left = _clipped(share, 18, 500)
    error, flagged = _decoded_phase(mean, MODULATION)
    return worst(error, worst_angle(MODULATION * leak + rounding(), MODULATION * left), flagged)


@PHASE.family("gamma", "rad", steps=(18, 4, 3), gamma=(1.0, 1.5, 2.2, 3.0))
def gamma_bend(gamma: float, steps: int) -> Outcome:
    """wrapped phase of frames 255 (I / 255)^gamma; bound: asin(sum of the harmonics kN +- 1 over the first), which N
    steps alias with the fringe"""
    frames = 255.0 * (sinusoids(phases(), steps, MEAN, 120.0) / 255.0) ** gamma
    theta = 2 * np.pi * np.arange(1 << 14) / (1 << 14)
    harmonics = np.abs(np.fft.rfft((0.5 + 120.0 / 255.0 * np.cos(theta)) ** gamma)) / theta.size
    leak = float(sum(harmonics[order] for order in _aliases(steps, 4000 // steps)))
    return worst(phase_error(frames), worst_angle(leak, float(harmonics[1])) + 100 * U64)


@PHASE.family("quantisation", "rad", steps=(18, 3), bits=(1, 2, 3, 4, 6, 8, 10, 12, 14, 16))
def quantisation(bits: int, steps: int) -> Outcome:
    """wrapped phase of frames of this bit depth, B = 100; bound: asin(q g / 2B), q = 255 / (2^bits - 1); pi / N where
    one bit leaves 2N states or N"""
    levels = 2**bits - 1
    frames = np.rint(sinusoids(phases(), steps) / 255.0 * levels) * (255.0 / levels)
    limit = math.pi / steps if bits == 1 else math.pi
    return worst(phase_error(frames), min(worst_angle(255.0 / levels * rounding(steps)), limit) + 100 * U64)


@PHASE.family("few steps", "rad", steps=(3, 4, 5, 6, 7, 9, 12, 18))
def few_steps(steps: int) -> Outcome:
    """wrapped phase of 8-bit frames, B = 100; bound: asin(g / 2B), g = max (2/N) sum |sin|"""
    return worst(phase_error(grey(sinusoids(phases(), steps))), worst_angle(rounding(steps)))


@PHASE.family("unequal steps", "rad", chosen=(3, 4, 5, 7, 8, 11, 13, 17))
def uneven_steps(chosen: int) -> Outcome:
    """wrapped phase of this number of 18 steps, 8-bit frames; bound: asin(g' / 2B), g' = max over directions of sum
    |least-squares weight|"""
    deltas = 2 * np.pi * np.array(choose_steps(18, chosen)) / 18
    model = np.stack([np.ones(chosen), np.cos(deltas), np.sin(deltas)], axis=1)
    _, cosine, sine = np.linalg.inv(model.T @ model) @ model.T
    turn = np.linspace(0, np.pi, 3601)[:, None]
    shift = float(np.abs(np.cos(turn) * cosine + np.sin(turn) * sine).sum(axis=1).max())
    return worst(phase_error(grey(sinusoids(phases(), deltas)), deltas), worst_angle(0.5 * shift * (1 + 1e-6)))


@PHASE.family(
    "steps close together",
    "rad",
    refuses=DecodeError,
    expects=lambda spread_rad: "number" if spread_rad > 5e-3 else "either",
    spread_rad=(1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 1e-4, 1e-8),
)
def close_steps(spread_rad: float) -> Outcome:
    """wrapped phase at shifts 0, s, 2 s; against least squares of the same frames in 50 digits; bound: 8 N u cond (A +
    B) / B (pinv M = I to u cond) + N u ||I|| / (sigma_min B); cond > 1e6 refused"""
    deltas = spread_rad * np.arange(3)
    frames = sinusoids(phases(48), deltas)
    model = np.stack([np.ones(3), np.cos(deltas), np.sin(deltas)], axis=1)
    largest, _, least = map(float, np.linalg.svd(model, compute_uv=False))
    strength = float(np.linalg.norm(frames[:, 0], axis=0).max())
    bound = 8 * 3 * U64 * (largest / least) * (MEAN + 100.0) / 100.0 + 3 * U64 * strength / least / 100.0
    return _least_squares(frames, deltas, wide(deltas), bound, largest / least)


PHASE.family(
    "equal shifts",
    "rad",
    expects="refusal",
    refuses=DecodeError,
    about="weights of the shifts 0, 1, 1 rad; against "
    "there is no such phase; bound: two different shifts do not determine the phase",
)(lambda: phase_weights([0.0, 1.0, 1.0]))


@PHASE.family("dead frame", "mm", expects="refusal", refuses=DecodeError, steps=(18, 9, 6, 4), level=(0, 255))
def dead_frame(steps: int, level: int) -> Outcome:
    """a plane's depth with one frame entirely black or white; against the frame's mean contradicts the N - 1 others;
    bound: frame means follow A + C cos + S sin too; from 4 steps on the dead frame must be refused"""
    rig = coded_rig(steps=steps)
    frames, _ = plane_stack(rig, mean=120.0)
    frames[rig.sequence.sinusoids("vertical")[1]] = np.full((32, 32), level, np.uint8)
    depth = decode_stack(frames, rig).depth_mm
    # The epipolar check allows 1.5 px across the line, and e px of u alone are e sin(alpha) across.
    tx, ty, _ = rig.translation_m
    slip_px = 1.5 / (abs(ty) / math.hypot(tx, ty))
    return worst(depth - 1800.0, MM_PER_M * slip_px / px_per_m(rig) * 1.1, depth == 0)


PHASE.family(
    "dead frame of three",
    "mm",
    expects="either",
    refuses=DecodeError,
    steps=(3,),
    level=(0, 255),
    about="a plane's depth with one of three frames black or white; against the plane, 1800 mm; bound: no redundancy; "
    "the epipolar check allows 1.5 px across, hence 1.5 px / sin(alpha) of u",
)(dead_frame)


@PHASE.family("repeated frame", "rad", steps=(18, 9, 4))
def repeated_frame(steps: int) -> Outcome:
    """wrapped phase where frame 1 is frame 0 again; bound: asin((2/N) 2 sin(pi/N)): one frame off by 2 B sin(pi/N) at
    most"""
    frames = sinusoids(phases(), steps)
    frames[1] = frames[0]
    return worst(phase_error(frames), worst_angle(2 / steps * 2 * math.sin(math.pi / steps), 1.0))


@PHASE.family(
    "pitch",
    "px",
    refuses=RigError,
    expects=lambda pitch_px: "number" if 4 <= pitch_px <= 912 else "refusal",
    pitch_px=(2.5, 3.9, 4.0, 5.3, 9.0, 18.0, 36.7, 100.0, 456.0, 912.0, 1000.0),
)
def pitch(pitch_px: float) -> Outcome:
    """projector coordinate by the decoder, 8-bit frames; against the coordinate of the pixel; bound: P / 2 pi asin(g /
    2B) over the whole pattern; under 4 px or beyond the pattern refused"""
    return decoded_coordinate(coded_rig(pitch_px), np.linspace(2.0, 909.0, 20_000))


@ORDER.family("on a Gray edge", "px", pitch_px=(4.0, 18.0, 37.3), blend=(0.0, 0.25, 0.5, 0.75, 1.0))
def edge_blend(pitch_px: float, blend: float) -> Outcome:
    """coordinate of pixels that see both cells, at every edge of the code"""
    rig = coded_rig(pitch_px)
    cells = cell_count(rig.pattern_length("vertical"), pitch_px)
    edges = np.ceil(np.arange(1, cells) * (pitch_px / 2))
    positions_px = edges - 1 + blend  # between the last pixel of a cell and the first of the next
    levels, below, above = (direction_levels(rig, px) for px in (positions_px, edges - 1, edges))
    bits = slice(rig.sequence.steps, None)
    levels[bits] = (1 - blend) * below[bits] + blend * above[bits]
    return decoded_coordinate(rig, positions_px, levels)


@ORDER.family("phase at +-pi", "px", pitch_px=(4.0, 18.0, 100.0), bit_noise=(0.0, 0.7))
def wrap_at_pi(pitch_px: float, bit_noise: float) -> Outcome:
    """coordinate of pixels in the middle of every period"""
    rig = coded_rig(pitch_px)
    periods = int(rig.pattern_length("vertical") / pitch_px) - 1
    positions_px = (np.arange(periods) + 0.5) * pitch_px  # where the sign of the sine is arbitrary
    levels = direction_levels(rig, positions_px)
    bits = levels[rig.sequence.steps :]
    bits += bit_noise * MODULATION * np.random.default_rng(1).uniform(-1, 1, bits.shape)
    return decoded_coordinate(rig, positions_px, levels)


@ORDER.family(
    "order of a phase at the wrap",
    "rad",
    phase_rad=(-math.pi, math.pi, 3.1415926535897927, -3.1415926535897927, 0.0, -0.0, math.pi / 2),
)
def order_of_pi(phase_rad: float) -> Outcome:
    """absolute phase in each of 102 cells; against the same rule in 50 digits; bound: 4 u |Phi|: one product and two
    sums"""
    centres = cell_centres_rad(912, 18.0)
    cells = np.arange(len(centres), dtype=np.int32)
    absolute, agrees = absolute_phase(np.full(len(cells), phase_rad), cells, centres)
    two_pi = 2 * high_precision().pi
    exact = phase_rad + two_pi * by_mpmath("floor", (wide(centres) - phase_rad) / two_pi + 0.5)
    near = np.abs(exact.astype(float) - centres)
    may_flag = float(np.mean(near > INCONSISTENT_RAD - 1e-9))
    return worst(difference(absolute, exact), 4 * U64 * np.abs(absolute).max(), ~agrees, may_flag)


@ORDER.family("arctangent", "rad", code=("compiled", "NumPy"), scale=(1.0, 255.0, 1e-12, 1e-150, 1e150))
def arctangent(scale: float, code: str) -> Outcome:
    """-atan2 in all octants, on the axes, beside +-pi; against 50 digits; bound: 4 u |phi|, the 2 ulp that the compiled
    arctangent promises"""
    beside, eighth = np.logspace(-15, -1, 15), np.pi / 8 + np.array([-1e-15, 0, 1e-15])
    turn = np.concatenate([np.linspace(-np.pi, np.pi, 97), np.pi - beside, -np.pi + beside, eighth])
    cosine = scale * np.concatenate([np.cos(turn), [1.0, -1, 0, 0, -1, 1]])
    sine = scale * np.concatenate([np.sin(turn), [0.0, 0, 1, -1, -1e-17, 1e-300]])
    phase = minus_atan2(sine, cosine) if code == "compiled" else -arctangent2(sine, cosine)
    error = difference(phase, -by_mpmath("atan2", wide(sine), wide(cosine)))
    error = error - 2 * np.pi * np.rint(error / (2 * np.pi))  # +pi and -pi are the same angle
    bound = np.maximum(4 * U64 * np.abs(phase), 2.0**-1073)
    return worst(error, np.maximum(bound, 8 * U64 * (np.abs(phase) > 3.0)))


@ORDER.family("interval of the phase", "rad")
def order_range() -> Outcome:
    """-atan2 of signed zeros and the smallest sines at a negative cosine; against the interval [-pi, pi); bound: exact:
    +pi is mapped to -pi"""
    phase = minus_atan2(np.array([0.0, -0.0, 1e-300, -1e-300, -0.0]), np.array([-1.0] * 4 + [-1e-300]))
    return worst(np.maximum(phase - np.nextafter(np.pi, 0), 0) + np.maximum(-np.pi - phase, 0))


@ORDER.family("flipped bit, both directions", "mm", expects="either", direction=AXES, bit=range(7))
def flipped_bit_both(bit: int, direction: Direction) -> Outcome:
    """depth of a plane with one Gray bit inverted in the whole image; against the plane, 1800 mm; bound: 8-bit frames,
    by rig.md's slope; slipped pixels flagged: 18 px are 11 px off the epipolar line"""
    rig = coded_rig(size=96)
    frames, inside = plane_stack(rig)
    flipped = rig.sequence.gray(direction)[bit]
    frames[flipped] = 255 - np.asarray(frames[flipped])
    decoded = decode_stack(frames, rig, mask=inside)
    bound_mm = rounding_px(rig) / px_per_m(rig) * MM_PER_M * np.sqrt(2) * 1.01
    return worst(decoded.depth_mm[inside] - 1800.0, bound_mm, decoded.reason[inside] != Reason.DECODED)


@ORDER.family("flipped bit, one direction", "px", expects="either", bit=range(7))
def flipped_bit_alone(bit: int) -> Outcome:
    """coordinate with one bit inverted, and the flagged pixels; against integer arithmetic on the misread cell: error
    in whole periods, or refused"""
    rig, pitch = coded_rig(), 18.0
    positions_px = np.arange(3.0, 909.0, 0.25)
    levels, row = direction_levels(rig, positions_px), rig.sequence.steps + bit
    levels[row] = 2 * MEAN - levels[row]
    cells, bits = np.floor(np.rint(positions_px) / (pitch / 2)).astype(int), rig.sequence.bits("vertical")
    read = np.asarray(gray_to_binary(binary_to_gray(cells) ^ (1 << (bits - 1 - bit))))
    centres = cell_centres_rad(912, pitch)
    centre = centres[np.minimum(read, len(centres) - 1)]
    absolute = positions_px * 2 * np.pi / pitch
    slip = np.floor((centre - absolute) / (2 * np.pi) + 0.5)
    slipped_px = positions_px + pitch * slip
    off = np.abs(absolute + 2 * np.pi * slip - centre)
    refused = (read >= len(centres)) | (off > INCONSISTENT_RAD) | (slipped_px < -0.5) | (slipped_px > 911.5)
    error, flagged = coordinate_error(rig, levels, slipped_px)
    # Within half a grey level of a limit both results are correct.
    wrong_flag = (flagged != refused) & ~(np.abs(off - INCONSISTENT_RAD) < 0.01)
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
)(lambda bits: replace(paper_rig(32), sequence=Sequence(18, 7, bits)))


@ORDER.family("cell off the pattern", "px", expects="refusal", cell=(102, 103, 111, 127))
def cell_off_pattern(cell: int) -> Outcome:
    """a pixel whose code names a cell beyond the pattern; against there is no such cell; bound: must be masked"""
    waves = sinusoids(np.linspace(-3, 3, 50), 18)
    levels = np.concatenate([waves, gray_levels(np.full(50, cell), 7)])
    return worst(0.0, flagged=coordinate_error(paper_rig(32), levels, np.zeros(50))[1])


@ORDER.family("code length", "px", bits=(1, 2, 7, 10, 13, 15))
def code_length(bits: int) -> Outcome:
    """coordinate in every cell of a full code, pitch 4 px, 3 steps; bound: P / 2 pi asin(g / 2B): 8-bit frames alone; a
    slip would be a whole period plus 8 u w"""
    # 15 bits fill the compiled decoder's 16-bit integers.
    positions_px = np.arange(2**bits) * 2 + 0.5
    rig = coded_rig(4.0, steps=3, length=min(65536, 2**bits * 2))
    return decoded_coordinate(rig, positions_px, further_px=8 * U64 * positions_px)
