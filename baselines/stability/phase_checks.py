"""Checks of the wrapped phase from frames that are dim, clipped, non-linear, coarse, few, uneven or dead."""

import math

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.stability.case import Expects, Outcome, refusal, worst
from fpp_ml_bench.baselines.stability.frames import (
    MEAN,
    coded_rig,
    direction_levels,
    frame_gain,
    grey,
    phases,
    plan,
    plane_stack,
    shifts,
    sinusoids,
    worst_angle,
)
from fpp_ml_bench.baselines.stability.roundoff import U64, angle_between, difference, high_precision
from fpp_ml_bench.decoding import (
    MIN_MODULATION,
    Limits,
    Reason,
    choose_steps,
    decode_direction,
    decode_stack,
    phase_weights,
    wrapped_phase,
)
from fpp_ml_bench.errors import DecodeError, RigError
from fpp_ml_bench.optics import Rig

_MARGIN_PX = 2.0


def _exact_phase(frames: NDArray, deltas: list) -> list:
    """Least-squares phase of float64 frames (N, n) in 50 digits, for any shifts (exact numbers)."""
    mp = high_precision()
    model = mp.matrix([[1, mp.cos(d), mp.sin(d)] for d in deltas])
    solve = (model.T * model) ** -1 * model.T
    phases_rad = []
    for pixel in frames.T:
        levels = [mp.mpf(float(level)) for level in pixel]
        cosine, sine = (mp.fsum(solve[row, n] * level for n, level in enumerate(levels)) for row in (1, 2))
        phases_rad.append(-mp.atan2(sine, cosine))
    return phases_rad


def modulation_exact(modulation: float, steps: int = 18) -> Outcome:
    phase = phases(48)
    frames = sinusoids(phase, shifts(steps), MEAN, modulation)
    mp = high_precision()
    exact = _exact_phase(frames[:, 0], [2 * mp.pi * n / steps for n in range(steps)])
    measured = wrapped_phase(frames).phase[0]
    condition = (MEAN + modulation) / modulation
    bound = math.sqrt(2) * 2 * (steps + 4 * math.pi + 2) * U64 * condition + 2 * math.pi * U64
    return worst(difference(measured, exact), bound, condition=condition)


def _decoded_phase(levels: NDArray[np.uint8], rig: Rig, exact_px: NDArray) -> tuple[NDArray, NDArray]:
    """Error of the absolute phase in rad, which includes slipped periods, and the flagged pixels."""
    decoded = decode_direction(levels, plan(rig), Limits())
    return (decoded.coordinate_px - exact_px) * 2 * np.pi / rig.pitch("vertical"), decoded.reason != Reason.DECODED


def _coordinates(rig: Rig, count: int = 2000) -> NDArray[np.float64]:
    length = rig.pattern_length("vertical")
    return np.linspace(_MARGIN_PX, length - 1 - _MARGIN_PX, count)


def modulation_8bit(modulation: float) -> Outcome:
    rig = coded_rig()
    positions_px = _coordinates(rig)
    error, flagged = _decoded_phase(grey(direction_levels(rig, positions_px, modulation=modulation)), rig, positions_px)
    shift = 0.5 * frame_gain(18)
    may_flag = 0.0 if modulation - shift >= MIN_MODULATION else 1.0
    return worst(error, worst_angle(shift, modulation), flagged, may_flag)


def expects_modulation(modulation: float) -> Expects:
    shift = 0.5 * frame_gain(18)
    if modulation + shift < MIN_MODULATION:
        return "refusal"
    return "number" if modulation - shift >= MIN_MODULATION else "either"


def noise(modulation: float, noise_grey: float = 1.0) -> Outcome:
    rig, rng = coded_rig(), np.random.default_rng(7)
    positions_px = _coordinates(rig, 20_000)
    levels = direction_levels(rig, positions_px, modulation=modulation)
    error, flagged = _decoded_phase(grey(levels + noise_grey * rng.standard_normal(levels.shape)), rig, positions_px)
    sigma = math.sqrt(2 / 18) * math.hypot(noise_grey, math.sqrt(1 / 12)) / modulation
    unflagged = error[~flagged]
    # Up to six sigma of noise above the limit of the modulation, pixels may be flagged.
    may_flag = 0.0 if modulation > MIN_MODULATION + 6 * sigma * modulation else 1.0
    if not unflagged.size:
        return Outcome(None, flagged=1.0, note="every pixel is masked: low modulation")
    bound = sigma * (1 + 2 * sigma**2 + 4 / math.sqrt(2 * unflagged.size))
    return Outcome(float(np.sqrt(np.mean(unflagged**2))), bound, float(flagged.mean()), may_flag)


def expects_noise(modulation: float) -> Expects:
    sigma = math.sqrt(2 / 18) * math.hypot(1.0, math.sqrt(1 / 12))
    if modulation + 6 * sigma < MIN_MODULATION:
        return "refusal"
    return "number" if modulation - 6 * sigma > MIN_MODULATION else "either"


def _clipped(share: float) -> tuple[float, float]:
    """Mean and modulation with which ``share`` of a period is above 255."""
    modulation = 100.0
    return 255.0 - modulation * math.cos(math.pi * share) if share else MEAN, modulation


def _clip_harmonic(order: int, alpha: float) -> float:
    """Fourier coefficient of max(cos t - cos alpha, 0): (2/pi) times its integral against cos(order t), 0..alpha."""
    if order == 1:
        return (alpha - math.sin(alpha) * math.cos(alpha)) / math.pi
    total = math.sin((order - 1) * alpha) / (order - 1) + math.sin((order + 1) * alpha) / (order + 1)
    return (total - 2 * math.cos(alpha) * math.sin(order * alpha) / order) / math.pi


def saturation_phase(share: float, steps: int) -> Outcome:
    mean, modulation = _clipped(share)
    phase = phases()
    frames = np.minimum(sinusoids(phase, shifts(steps), mean, modulation), 255.0)
    alpha, highest = math.pi * share, 4000
    aliases = [k * steps + side for k in range(1, highest) for side in (-1, 1)]
    leak = sum(abs(_clip_harmonic(order, alpha)) for order in aliases) if share else 0.0
    rest = 8 / (math.pi * (steps * highest) * steps)  # of the tail: |coefficient| <= 4 / (pi order^2)
    bound = worst_angle(leak + (rest if share else 0.0), 1 - _clip_harmonic(1, alpha)) + 100 * U64
    return worst(angle_between(wrapped_phase(frames).phase[0], phase), bound)


def saturation_decoder(share: float) -> Outcome:
    rig = coded_rig()
    positions_px = _coordinates(rig)
    mean, modulation = _clipped(share)
    error, flagged = _decoded_phase(
        grey(direction_levels(rig, positions_px, mean=mean, modulation=modulation)), rig, positions_px
    )
    alpha = math.pi * share
    left = modulation * (1 - _clip_harmonic(1, alpha))
    leak = modulation * sum(abs(_clip_harmonic(k * 18 + side, alpha)) for k in range(1, 500) for side in (-1, 1))
    most = math.floor(18 * share) + 1
    may_flag = 0.0 if most <= 2 else 1.0
    return worst(error, worst_angle(leak + 0.5 * frame_gain(18), left), flagged, may_flag)


def expects_saturation(share: float) -> Expects:
    return "refusal" if math.floor(18 * share) > 2 else "number" if math.floor(18 * share) + 1 <= 2 else "either"


def gamma_bend(gamma: float, steps: int) -> Outcome:
    phase = phases()
    frames = 255.0 * (sinusoids(phase, shifts(steps), MEAN, 120.0) / 255.0) ** gamma
    theta = 2 * np.pi * np.arange(1 << 14) / (1 << 14)
    harmonics = np.abs(np.fft.rfft((0.5 + 120.0 / 255.0 * np.cos(theta)) ** gamma)) / theta.size
    aliases = [k * steps + side for k in range(1, 4000 // steps) for side in (-1, 1)]
    bound = worst_angle(float(sum(harmonics[order] for order in aliases)), float(harmonics[1])) + 100 * U64
    return worst(angle_between(wrapped_phase(frames).phase[0], phase), bound)


def quantisation(bits: int, steps: int = 18) -> Outcome:
    phase = phases()
    levels = 2**bits - 1
    frames = np.rint(sinusoids(phase, shifts(steps), MEAN, 100.0) / 255.0 * levels) * (255.0 / levels)
    bound = worst_angle(255.0 / levels / 2 * frame_gain(steps), 100.0)
    if bits == 1:
        bound = min(bound, math.pi / steps)
    return worst(angle_between(wrapped_phase(frames).phase[0], phase), bound + 100 * U64)


def few_steps(steps: int) -> Outcome:
    phase = phases()
    frames = grey(sinusoids(phase, shifts(steps), MEAN, 100.0))
    return worst(angle_between(wrapped_phase(frames).phase[0], phase), worst_angle(0.5 * frame_gain(steps), 100.0))


def uneven_steps(chosen: int) -> Outcome:
    deltas = 2 * np.pi * np.array(choose_steps(18, chosen)) / 18
    phase = phases()
    frames = grey(sinusoids(phase, deltas, MEAN, 100.0))
    model = np.stack([np.ones(chosen), np.cos(deltas), np.sin(deltas)], axis=1)
    solve = np.linalg.inv(model.T @ model) @ model.T
    turn = np.linspace(0, np.pi, 3601)
    shift = np.abs(np.cos(turn)[:, None] * solve[1] + np.sin(turn)[:, None] * solve[2]).sum(axis=1).max()
    bound = worst_angle(0.5 * float(shift) * (1 + 1e-6), 100.0)
    return worst(angle_between(wrapped_phase(frames, deltas).phase[0], phase), bound)


def close_steps(spread_rad: float) -> Outcome:
    deltas = np.array([0.0, spread_rad, 2 * spread_rad])
    phase = phases(48)
    frames = sinusoids(phase, deltas, MEAN, 100.0)
    try:
        measured = wrapped_phase(frames, deltas).phase[0]
    except DecodeError as error:
        return Outcome(None, flagged=1.0, note=str(error))
    mp = high_precision()
    exact = _exact_phase(frames[:, 0], [mp.mpf(float(delta)) for delta in deltas])
    model = np.stack([np.ones(3), np.cos(deltas), np.sin(deltas)], axis=1)
    singular = np.linalg.svd(model, compute_uv=False)
    condition = float(singular[0] / singular[-1])
    strength = float(np.linalg.norm(frames[:, 0], axis=0).max())
    bound = 8 * 3 * U64 * condition * (MEAN + 100.0) / 100.0 + 3 * U64 * strength / float(singular[-1]) / 100.0
    return worst(difference(measured, exact), bound, condition=condition)


def equal_steps_twice() -> Outcome:
    return refusal(lambda: phase_weights([0.0, 1.0, 1.0]), DecodeError)


def dead_frame(steps: int, level: int) -> Outcome:
    rig = coded_rig(steps=steps)
    frames, _ = plane_stack(rig, 1.8, 120.0, 100.0)
    dead = rig.sequence.sinusoids("vertical")[1]
    frames[dead] = np.full_like(frames[dead], level)  # type: ignore[arg-type]
    try:
        decoded = decode_stack(frames, rig)
    except DecodeError as error:
        return Outcome(None, flagged=1.0, note=str(error))
    depth = decoded.depth_mm
    # The epipolar check allows 1.5 px across the line, and e px of u alone are e sin(alpha) across.
    tx, ty, _ = rig.translation_m
    slip_px = 1.5 / (abs(ty) / math.hypot(tx, ty))
    per_metre = rig.projector.fx * tx / 1.8**2
    return worst((depth - 1800.0), 1000.0 * slip_px / per_metre * 1.1, depth == 0, 1.0)


def repeated_frame(steps: int) -> Outcome:
    phase = phases()
    frames = sinusoids(phase, shifts(steps), MEAN, 100.0)
    frames[1] = frames[0]
    bound = worst_angle(2 / steps * 2 * math.sin(math.pi / steps), 1.0)
    return worst(angle_between(wrapped_phase(frames).phase[0], phase), bound)


def pitch(pitch_px: float) -> Outcome:
    try:
        rig = coded_rig(pitch_px)
    except RigError as error:
        return Outcome(None, flagged=1.0, note=str(error))
    positions_px = _coordinates(rig, 20_000)
    decoded = decode_direction(grey(direction_levels(rig, positions_px)), plan(rig), Limits())
    bound = pitch_px / (2 * math.pi) * worst_angle(0.5 * frame_gain(18), 100.0)
    return worst(decoded.coordinate_px - positions_px, bound, decoded.reason != Reason.DECODED)
