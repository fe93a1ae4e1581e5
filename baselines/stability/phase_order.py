"""Phase of frames that are dim, clipped, non-linear, coarse, few, unequal or dead; fringe order on code edges, at
phases of +-pi exactly, with flipped bits and with more periods than codes."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench import coding, decoding, optics
from fpp_ml_bench.baselines.stability import cases
from fpp_ml_bench.baselines.stability.cases import U64, Floats, Group, Outcome, difference, wide, worst
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import DecodeError, RigError
from fpp_ml_bench.machine import numba_enabled

PHASE = Group("phase", "the phase that the frames were made from")
ORDER = Group("order", "the coordinate that the frames were made from",
              "P / 2 pi asin(g / 2B): 8-bit frames alone; a slip would be a whole period")  # fmt: skip
MEAN, MODULATION = 127.5, 100.0
MODULATIONS = (100.0, 30.0, 10.0, 5.0, 3.0, 1.0, 0.3, 0.1)
SHARES = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
NOISE = math.sqrt(2 / 18) * math.hypot(1.0, math.sqrt(1 / 12))
"""Standard deviation of the modulation by noise and rounding of one grey level, 18 steps."""


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


def direction_levels(rig: optics.Rig, coordinate_px: NDArray, direction: optics.Direction = "vertical",
                     mean: float = MEAN, modulation: float = MODULATION) -> Floats:  # fmt: skip
    """Grey levels of one direction's sinusoids, then Gray bits, at projector coordinates (n,); float64 (N + bits, n).
    A pixel sees one projector pixel's Gray code, the one its coordinate rounds to."""
    pitch, bits = rig.pitch(direction), rig.sequence.bits(direction)
    waves = sinusoids(2 * np.pi * coordinate_px / pitch, rig.sequence.steps, mean, modulation)[:, 0]
    code = coding.binary_to_gray(coding.cell_of(np.rint(coordinate_px), pitch))
    bright = (code >> np.arange(bits - 1, -1, -1)[:, None]) & 1
    return np.concatenate([waves, mean + modulation * (2.0 * bright - 1.0)])


def plane_stack(rig: optics.Rig, depth_m: float = 1.8, mean: float = MEAN,
                modulation: float = MODULATION) -> tuple[list[NDArray[np.uint8] | None], NDArray]:  # fmt: skip
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


def _decoded(rig: optics.Rig, levels: NDArray, exact_px: NDArray, rounding_px: float | NDArray = 0.0) -> Outcome:
    """The outcome of coordinates with the error of 8-bit frames and of ``rounding_px``."""
    error_px, flagged = coordinate_error(rig, levels, exact_px)
    return worst(error_px, _rounding_px(rig) + rounding_px, flagged)


def _decoded_phase(mean: float = MEAN, modulation: float = MODULATION, count: int = 2000,
                   noise_grey: float = 0.0) -> tuple[Floats, NDArray]:  # fmt: skip
    """Error of the absolute phase in rad, which includes slipped periods, across the pattern; the flagged pixels."""
    rig, positions_px = coded_rig(), np.linspace(2.0, 909.0, count)
    levels = direction_levels(rig, positions_px, mean=mean, modulation=modulation)
    levels += noise_grey * np.random.default_rng(7).standard_normal(levels.shape)
    error_px, flagged = coordinate_error(rig, levels, positions_px)
    return error_px * 2 * np.pi / 18.0, flagged


def _px_per_m(rig: optics.Rig) -> float:
    """Change of u with depth at 1.8 m: f b / Z^2."""
    return rig.projector.fx * rig.translation_m[0] / 1.8**2


def _rounding_px(rig: optics.Rig) -> float:
    """Largest error of a coordinate in px by rounding frames to whole grey levels."""
    return rig.pitch("vertical") / (2 * np.pi) * worst_angle(0.5 * frame_gain(rig.sequence.steps))


def _exact_phase(frames: NDArray, deltas: NDArray[np.object_]) -> NDArray[np.object_]:
    """Least-squares phase of float64 frames (N, 1, n) in 50 digits, for any shifts (50-digit numbers)."""
    mp = cases.high_precision()
    model = mp.matrix([[1, mp.cos(delta), mp.sin(delta)] for delta in deltas])
    solve = (model.T * model) ** -1 * model.T
    _, cosine, sine = np.array(solve.tolist()) @ wide(frames[:, 0])
    return -cases.by_mpmath("atan2", sine, cosine)


@PHASE.family("modulation, real frames", "rad", modulation=MODULATIONS)
def modulation_exact(modulation: float, steps: int = 18) -> Outcome:
    """wrapped phase of 18 float64 frames; against least squares of the same frames in 50 digits; bound: sqrt(2) 2 (N +
    4 pi + 2) u (A + B) / B: N + 1 roundings a sum, 4 pi + 1 in each weight, over B"""
    frames = sinusoids(phases(48), steps, MEAN, modulation)
    exact = _exact_phase(frames, 2 * cases.high_precision().pi * wide(range(steps)) / steps)
    condition = (MEAN + modulation) / modulation
    bound = math.sqrt(2) * 2 * (steps + 4 * math.pi + 2) * U64 * condition + 2 * math.pi * U64
    return worst(difference(coding.wrapped_phase(frames).phase[0], exact), bound, condition=condition)


def _expects(modulation: float, spread: float) -> cases.Expects:
    """What is expected of a modulation that is measured within ``spread`` of its value."""
    if abs(modulation - coding.MIN_MODULATION) <= spread:
        return "either"
    return "number" if modulation > coding.MIN_MODULATION else "refusal"


@PHASE.family("modulation, 8-bit frames", "rad", modulation=MODULATIONS,
              expects=lambda modulation: _expects(modulation, ROUNDING))  # fmt: skip
def modulation_8bit(modulation: float) -> Outcome:
    """absolute phase by the decoder, 8-bit frames; bound: asin(g / 2B), g = max (2/N) sum |sin|: half a grey level in
    every frame; under 5 levels refused"""
    error, flagged = _decoded_phase(modulation=modulation)
    return worst(error, worst_angle(ROUNDING, modulation), flagged)


@PHASE.family("modulation, noise of 1 grey level", "rad", modulation=MODULATIONS,  # up to six sigma off the limit:
              expects=lambda modulation: _expects(modulation, 6 * NOISE))  # fmt: skip
def noise(modulation: float) -> Outcome:
    """rms error of absolute phase, 20,000 pixels; bound: sqrt(2/N) sigma / B with sigma^2 = 1 + 1/12, second order 2
    sigma_phi^2, 4 standard errors"""
    error, flagged = _decoded_phase(modulation=modulation, count=20_000, noise_grey=1.0)
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
    highest = 4000
    mean, leak, left = _clipped(share, steps, highest)
    frames = np.minimum(sinusoids(phases(), steps, mean), 255.0)
    rest = 8 / (math.pi * (steps * highest) * steps) if share else 0.0  # of the tail: |coefficient| <= 4 / (pi order^2)
    return worst(phase_error(frames), worst_angle(leak + rest, left) + 100 * U64)


@PHASE.family("saturation, decoder", "rad", share=SHARES,  # clipped are floor(18 share) frames, or one more
              expects=lambda share: ("number", "number", "either", "refusal")[min(int(18 * share), 3)])  # fmt: skip
def saturation_decoder(share: float) -> Outcome:
    """absolute phase by the decoder, 8-bit frames; bound: as above, plus half a grey level; more than 2 clipped frames
    of 18 must be refused"""
    mean, leak, left = _clipped(share, 18, 500)
    error, flagged = _decoded_phase(mean)
    return worst(error, worst_angle(MODULATION * leak + ROUNDING, MODULATION * left), flagged)


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
    bound = worst_angle(255.0 / levels / 2 * frame_gain(steps))
    return worst(phase_error(frames), (min(bound, math.pi / steps) if bits == 1 else bound) + 100 * U64)


@PHASE.family("few steps", "rad", steps=(3, 4, 5, 6, 7, 9, 12, 18))
def few_steps(steps: int) -> Outcome:
    """wrapped phase of 8-bit frames, B = 100; bound: asin(g / 2B), g = max (2/N) sum |sin|"""
    return worst(phase_error(grey(sinusoids(phases(), steps))), worst_angle(0.5 * frame_gain(steps)))


@PHASE.family("unequal steps", "rad", chosen=(3, 4, 5, 7, 8, 11, 13, 17))
def uneven_steps(chosen: int) -> Outcome:
    """wrapped phase of this number of 18 steps, 8-bit frames; bound: asin(g' / 2B), g' = max over directions of sum
    |least-squares weight|"""
    deltas = 2 * np.pi * np.array(coding.choose_steps(18, chosen)) / 18
    model = np.stack([np.ones(chosen), np.cos(deltas), np.sin(deltas)], axis=1)
    solve = np.linalg.inv(model.T @ model) @ model.T
    turn = np.linspace(0, np.pi, 3601)
    shift = np.abs(np.cos(turn)[:, None] * solve[1] + np.sin(turn)[:, None] * solve[2]).sum(axis=1).max()
    return worst(phase_error(grey(sinusoids(phases(), deltas)), deltas), worst_angle(0.5 * float(shift) * (1 + 1e-6)))


@PHASE.family("steps close together", "rad", refuses=DecodeError,
              expects=lambda spread_rad: "number" if spread_rad > 5e-3 else "either",
              spread_rad=(1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 1e-4, 1e-8))  # fmt: skip
def close_steps(spread_rad: float) -> Outcome:
    """wrapped phase at shifts 0, s, 2 s; against least squares of the same frames in 50 digits; bound: 8 N u cond (A +
    B) / B (pinv M = I to u cond) + N u ||I|| / (sigma_min B); cond > 1e6 refused"""
    deltas = spread_rad * np.arange(3)
    frames = sinusoids(phases(48), deltas)
    model = np.stack([np.ones(3), np.cos(deltas), np.sin(deltas)], axis=1)
    largest, _, least = map(float, np.linalg.svd(model, compute_uv=False))
    strength = float(np.linalg.norm(frames[:, 0], axis=0).max())
    bound = 8 * 3 * U64 * (largest / least) * (MEAN + 100.0) / 100.0 + 3 * U64 * strength / least / 100.0
    error = difference(coding.wrapped_phase(frames, deltas).phase[0], _exact_phase(frames, wide(deltas)))
    return worst(error, bound, condition=largest / least)


PHASE.family(
    "equal shifts", "rad", expects="refusal", refuses=DecodeError, about="weights of the shifts 0, 1, 1 rad; against "
    "there is no such phase; bound: two different shifts do not determine the phase",
)(lambda: coding.phase_weights([0.0, 1.0, 1.0]))  # fmt: skip


@PHASE.family("dead frame", "mm", expects="refusal", refuses=DecodeError, steps=(18, 9, 6, 4), level=(0, 255))
def dead_frame(steps: int, level: int) -> Outcome:
    """a plane's depth with one frame entirely black or white; against the frame's mean contradicts the N - 1 others;
    bound: frame means follow A + C cos + S sin too; from 4 steps on the dead frame must be refused"""
    rig = coded_rig(steps=steps)
    frames, _ = plane_stack(rig, mean=120.0)
    frames[rig.sequence.sinusoids("vertical")[1]] = np.full((32, 32), level, np.uint8)
    depth = decoding.decode_stack(frames, rig).depth_mm
    # The epipolar check allows 1.5 px across the line, and e px of u alone are e sin(alpha) across.
    tx, ty, _ = rig.translation_m
    slip_px = 1.5 / (abs(ty) / math.hypot(tx, ty))
    return worst(depth - 1800.0, MM_PER_M * slip_px / _px_per_m(rig) * 1.1, depth == 0)


PHASE.family(
    "dead frame of three", "mm", expects="either", refuses=DecodeError, steps=(3,), level=(0, 255),
    about="a plane's depth with one of three frames black or white; against the plane, 1800 mm; bound: no redundancy; "
    "the epipolar check allows 1.5 px across, hence 1.5 px / sin(alpha) of u",
)(dead_frame)  # fmt: skip


@PHASE.family("repeated frame", "rad", steps=(18, 9, 4))
def repeated_frame(steps: int) -> Outcome:
    """wrapped phase where frame 1 is frame 0 again; bound: asin((2/N) 2 sin(pi/N)): one frame off by 2 B sin(pi/N) at
    most"""
    frames = sinusoids(phases(), steps)
    frames[1] = frames[0]
    return worst(phase_error(frames), worst_angle(2 / steps * 2 * math.sin(math.pi / steps), 1.0))


@PHASE.family("pitch", "px", refuses=RigError, expects=lambda pitch_px: "number" if 4 <= pitch_px <= 912 else "refusal",
              pitch_px=(2.5, 3.9, 4.0, 5.3, 9.0, 18.0, 36.7, 100.0, 456.0, 912.0, 1000.0))  # fmt: skip
def pitch(pitch_px: float) -> Outcome:
    """projector coordinate by the decoder, 8-bit frames; against the coordinate of the pixel; bound: P / 2 pi asin(g /
    2B) over the whole pattern; under 4 px or beyond the pattern refused"""
    rig, positions_px = coded_rig(pitch_px), np.linspace(2.0, 909.0, 20_000)
    return _decoded(rig, direction_levels(rig, positions_px), positions_px)


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
    return _decoded(rig, levels, positions_px)


@ORDER.family("phase at +-pi", "px", pitch_px=(4.0, 18.0, 100.0), bit_noise=(0.0, 0.7))
def wrap_at_pi(pitch_px: float, bit_noise: float) -> Outcome:
    """coordinate of pixels in the middle of every period"""
    rig = coded_rig(pitch_px)
    periods = int(rig.pattern_length("vertical") / pitch_px) - 1
    positions_px = (np.arange(periods) + 0.5) * pitch_px  # where the sign of the sine is arbitrary
    levels, steps = direction_levels(rig, positions_px), rig.sequence.steps
    levels[steps:] += bit_noise * MODULATION * np.random.default_rng(1).uniform(-1, 1, levels[steps:].shape)
    return _decoded(rig, levels, positions_px)


@ORDER.family("order of a phase at the wrap", "rad", phase_rad=(
    -math.pi, math.pi, 3.1415926535897927, -3.1415926535897927, 0.0, -0.0, math.pi / 2))  # fmt: skip
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
    bound_mm = _rounding_px(rig) / _px_per_m(rig) * MM_PER_M * np.sqrt(2) * 1.01
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
    return worst(np.where(wrong_flag, np.inf, error), _rounding_px(rig), flagged & ~wrong_flag, note=note)


ORDER.family(
    "more periods than codes", "px", expects="refusal", refuses=RigError, bits=(1, 4, 5, 6), about="a rig of 51 "
    "periods with this number of Gray bits; against 102 cells need 7 bits; bound: the code would repeat",
)(lambda bits: replace(optics.paper_rig(32), sequence=optics.Sequence(18, 7, bits)))  # fmt: skip


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
    return _decoded(rig, direction_levels(rig, positions_px), positions_px, 8 * U64 * positions_px)
