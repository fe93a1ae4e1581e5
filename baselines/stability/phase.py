"""Phase of frames that are dim, clipped, non-linear, coarse, few, unequal or dead."""

import math

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench import coding, decoding
from fpp_ml_bench.baselines.stability import cases
from fpp_ml_bench.baselines.stability.cases import U64, Floats, Group, Outcome, difference, wide, worst
from fpp_ml_bench.baselines.stability.coded_frames import (
    MEAN,
    MODULATION,
    ROUNDING,
    coded_rig,
    coordinate_error,
    decoded_coordinate,
    direction_levels,
    frame_gain,
    grey,
    phase_error,
    phases,
    plane_stack,
    px_per_m,
    sinusoids,
    worst_angle,
)
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import DecodeError, RigError

PHASE = Group("phase", "the phase that the frames were made from")
MODULATIONS = (100.0, 30.0, 10.0, 5.0, 3.0, 1.0, 0.3, 0.1)
SHARES = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
NOISE = math.sqrt(2 / 18) * math.hypot(1.0, math.sqrt(1 / 12))
"""Standard deviation of the modulation by noise and rounding of one grey level, 18 steps."""


def _decoded_phase(
    mean: float = MEAN, modulation: float = MODULATION, count: int = 2000, noise_grey: float = 0.0
) -> tuple[Floats, NDArray]:
    """Error of the absolute phase in rad, which includes slipped periods, across the pattern; the flagged pixels."""
    rig, positions_px = coded_rig(), np.linspace(2.0, 909.0, count)
    levels = direction_levels(rig, positions_px, mean=mean, modulation=modulation)
    levels += noise_grey * np.random.default_rng(7).standard_normal(levels.shape)
    error_px, flagged = coordinate_error(rig, levels, positions_px)
    return error_px * 2 * np.pi / 18.0, flagged


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


@PHASE.family(
    "modulation, 8-bit frames", "rad", modulation=MODULATIONS, expects=lambda modulation: _expects(modulation, ROUNDING)
)
def modulation_8bit(modulation: float) -> Outcome:
    """absolute phase by the decoder, 8-bit frames; bound: asin(g / 2B), g = max (2/N) sum |sin|: half a grey level in
    every frame; under 5 levels refused"""
    error, flagged = _decoded_phase(modulation=modulation)
    return worst(error, worst_angle(ROUNDING, modulation), flagged)


@PHASE.family(
    "modulation, noise of 1 grey level",
    "rad",
    modulation=MODULATIONS,  # up to six sigma off the limit:
    expects=lambda modulation: _expects(modulation, 6 * NOISE),
)
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
    error = difference(coding.wrapped_phase(frames, deltas).phase[0], _exact_phase(frames, wide(deltas)))
    return worst(error, bound, condition=largest / least)


PHASE.family(
    "equal shifts",
    "rad",
    expects="refusal",
    refuses=DecodeError,
    about="weights of the shifts 0, 1, 1 rad; against "
    "there is no such phase; bound: two different shifts do not determine the phase",
)(lambda: coding.phase_weights([0.0, 1.0, 1.0]))


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
    rig, positions_px = coded_rig(pitch_px), np.linspace(2.0, 909.0, 20_000)
    return decoded_coordinate(rig, direction_levels(rig, positions_px), positions_px)
