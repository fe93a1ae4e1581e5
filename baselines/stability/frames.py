"""Frames whose phase, fringe order and depth are known, and what disturbs them: dim, clipped,
non-linear, coarse, few or dead frames; fringe order on code edges, at phases of +-pi exactly, and
with flipped bits; crossed fringes that are dim, clipped, or whose second direction is lost, and
rivals on the truth."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.depth import Reason as DepthReason
from fpp_ml_bench.baselines.phase.observe import TwoCarriers
from fpp_ml_bench.baselines.phase.route import two_carriers
from fpp_ml_bench.baselines.stability.cases import (
    U64,
    Floats,
    Outcome,
    difference,
    family,
    high_precision,
    minus_arctangent2,
    wide,
    worst,
)
from fpp_ml_bench.coding.code import MIN_MODULATION, Limits, Reason
from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.coding.gray_code import bits_needed, cell_count
from fpp_ml_bench.coding.phase_shift import minus_atan2, wrapped_phase
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding.blocks import plan_direction
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.optics.named_rigs import crossed_rig, paper_rig
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import AXES, Direction, Sequence

MEAN = 127.5
"""Mean grey level of the cases' fringes: the middle of 0 to 255."""
MODULATION = 100.0
"""Modulation of the cases' fringes, in grey levels: a bright fringe that is not clipped."""
PLANE_M = 1.8
"""Distance of the cases' plane in m: the paper's standoff."""
MODULATIONS = (100.0, 30.0, 10.0, 5.0, 1.0, 0.1)
"""Modulations in grey levels: from a bright fringe, across the decoder's limit of 5, to less than a
grey level."""


def phases(count: int = 720) -> Floats:
    """Phases over the whole circle in rad, (1, count), none of them a special value."""
    return -np.pi + 2 * np.pi * (np.arange(count)[None] + 0.3819) / count


def sinusoids(
    phase: NDArray, shifts: int | NDArray, mean: float = MEAN, modulation: float = MODULATION
) -> NDArray:
    """Frames A + B cos(phi + delta_n), (N, ...), of these shifts or a number of equal ones."""
    deltas = 2 * np.pi * np.arange(shifts) / shifts if isinstance(shifts, int) else shifts
    return mean + modulation * np.cos(np.add.outer(deltas, phase))


def grey(values: NDArray) -> NDArray[np.uint8]:
    """Grey levels as an 8-bit camera records them."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def phase_error(frames: NDArray) -> Floats:
    """Error in rad, on the circle, of the wrapped phase of frames of `phases`."""
    return np.angle(np.exp(1j * (wrapped_phase(frames).phase - phases())))


def rounding(steps: int = 18) -> float:
    """Largest change of (C, S) by rounding frames to whole grey levels: g / 2, g = max over phi of (2/N) sum
    |sin(phi + delta_n)|, which is 2/N times 2 / sin(pi/N) for even N and 1 / sin(pi/2N) for odd N, about 4/pi."""
    return (
        1
        / steps
        * (2 / math.sin(math.pi / steps) if steps % 2 == 0 else 1 / math.sin(math.pi / (2 * steps)))
    )


def worst_angle(shift: float, modulation: float = MODULATION) -> float:
    """Largest change of phase, rad, that moving (C, S) by ``shift`` can cause: asin(shift / B), or
    pi."""
    return math.asin(shift / modulation) if shift < modulation else math.pi


def bent(
    response: Callable[[NDArray], NDArray], mean: float, modulation: float, steps: int
) -> tuple[float, float]:
    """Sum of the harmonics kN +- 1, which N steps alias with the fringe, of a sinusoid through a
    camera's response, and its first harmonic."""
    turn = 2 * np.pi * np.arange(1 << 14) / (1 << 14)
    harmonics = np.abs(np.fft.rfft(response(mean + modulation * np.cos(turn)))) * 2 / turn.size
    order = np.arange(harmonics.size)
    aliased = (order > 1) & np.isin(order % steps, (1, steps - 1))
    return float(harmonics[aliased].sum()), float(harmonics[1])


def coded_rig(pitch_px: float = 18.0, steps: int = 18, size: int = 32) -> Rig:
    """The paper's rig with another pitch and number of steps, and as many Gray bits as these
    need."""
    rig = paper_rig(size)
    device = rig.projector
    sequence = Sequence(
        steps, *(bits_needed(side, pitch_px) for side in (device.height, device.width))
    )
    return Rig(rig.camera, device, rig.rotation, rig.translation_m, pitch_px, pitch_px, sequence)


def direction_levels(
    rig: Rig,
    coordinate_px: NDArray,
    direction: Direction = "vertical",
    mean: float = MEAN,
    modulation: float = MODULATION,
) -> Floats:
    """Grey levels of one direction's sinusoids, then Gray bits, at projector coordinates (n,);
    float64 (N + bits, n). A pixel sees one projector pixel's Gray code, the one its coordinate
    rounds to."""
    waves = sinusoids(
        2 * np.pi * coordinate_px / rig.pitch(direction), rig.sequence.steps, mean, modulation
    )
    length = rig.pattern_length(direction)
    seen = np.clip(np.rint(coordinate_px), 0, length - 1).astype(int)
    bits = rig.code(direction).profiles(length)[len(waves) :, seen]
    return np.concatenate([waves, mean + modulation * (bits / 127.5 - 1)])


def plane_stack(
    rig: Rig, mean: float = MEAN, modulation: float = MODULATION
) -> tuple[list[NDArray[np.uint8] | None], NDArray]:
    """All frames of a plane square to the axis, and the pixels more than 3 px inside the
    projector's image, (H, W)."""
    rays = rig.camera.rays()
    frames: list[NDArray[np.uint8] | None] = [None] * len(rig.sequence)
    inside = np.ones(rays[0].shape, bool)
    for direction, px in zip(AXES, rig.seen(rays, PLANE_M), strict=True):
        levels = grey(direction_levels(rig, px.ravel(), direction, mean, modulation)).reshape(
            -1, *px.shape
        )
        for index, level in zip(rig.sequence.coded(direction), levels, strict=True):
            frames[index] = level
        inside &= (px > 3) & (px < rig.pattern_length(direction) - 4)
    return frames, inside


def coordinate_error(rig: Rig, levels: NDArray, exact_px: NDArray) -> tuple[Floats, NDArray]:
    """Error in px of the vertical coordinate, decoded with the default limits, and the flagged
    pixels."""
    decoded = plan_direction(rig, "vertical", rig.sequence.steps).decode(grey(levels), Limits())
    return decoded.coordinate_px - exact_px, decoded.reason != Reason.DECODED


def rounding_px(rig: Rig) -> float:
    """Largest error of a coordinate in px by rounding frames to whole grey levels; a slip would be
    a whole period."""
    return rig.pitch("vertical") / (2 * np.pi) * worst_angle(rounding())


def _decoded_phase(mean: float, modulation: float) -> tuple[Floats, NDArray]:
    """Error of the absolute phase in rad, which includes slipped periods, of 20,000 pixels across
    the pattern; the flagged pixels."""
    rig, positions_px = coded_rig(), np.linspace(2.0, 909.0, 20_000)
    levels = direction_levels(rig, positions_px, mean=mean, modulation=modulation)
    error_px, flagged = coordinate_error(rig, levels, positions_px)
    return error_px * 2 * np.pi / 18.0, flagged


def _least_squares(frames: NDArray, deltas: NDArray[np.object_]) -> NDArray[np.object_]:
    """Phase of float64 frames (N, 1, n) at shifts ``deltas`` by least squares in 50 digits,
    (n,)."""
    mp = high_precision()
    model = mp.matrix([[1, mp.cos(delta), mp.sin(delta)] for delta in deltas])
    solve = (model.T * model) ** -1 * model.T
    _, cosine, sine = np.array(solve.tolist()) @ wide(frames[:, 0])
    return minus_arctangent2(sine, cosine)


@family(
    "phase",
    "modulation, real frames",
    "rad",
    against="least squares of the same frames in 50 digits",
    bound=(
        "sqrt(2) 2 (N + 4 pi + 2) u (A + B) / B: N + 1 roundings a sum, 4 pi + 1 in each weight, "
        "over B"
    ),
    modulation=MODULATIONS,
)
def modulation_exact(modulation: float) -> Outcome:
    """wrapped phase of 18 float64 frames"""
    condition, frames = (
        (MEAN + modulation) / modulation,
        sinusoids(phases(48), 18, MEAN, modulation),
    )
    exact = _least_squares(frames, 2 * high_precision().pi * wide(range(18)) / 18)
    bound = math.sqrt(2) * 2 * (18 + 4 * math.pi + 2) * U64 * condition + 2 * math.pi * U64
    return worst(difference(wrapped_phase(frames).phase[0], exact), bound, condition=condition)


@family(
    "phase",
    "modulation, 8-bit frames",
    "rad",
    against="the phase that the frames were made from",
    bound=(
        "asin(g / 2B), g = max (2/N) sum |sin|: half a grey level in every frame; under 5 levels "
        "refused"
    ),
    modulation=MODULATIONS,
    expects=lambda modulation: (
        "either"
        if modulation == MIN_MODULATION
        else "number"
        if modulation > MIN_MODULATION
        else "refusal"
    ),
)
def modulation_8bit(modulation: float) -> Outcome:
    """absolute phase by the decoder, 8-bit frames"""
    error, flagged = _decoded_phase(MEAN, modulation)
    return worst(error, worst_angle(rounding(), modulation), flagged)


@family(
    "phase",
    "saturation",
    "rad",
    against="the phase that the frames were made from",
    bound="asin(sum of the harmonics kN +- 1 over the first), plus half a grey level; more than 2 clipped "
    "frames of 18 must be refused",
    share=(
        0.0,
        0.05,
        0.1,
        0.2,
        0.3,
        0.4,
        0.5,
        0.6,
    ),  # clipped are floor(18 share) frames, or one more
    expects=lambda share: ("number", "number", "either", "refusal")[min(int(18 * share), 3)],
)
def saturation(share: float) -> Outcome:
    """absolute phase by the decoder, 8-bit frames clipped in a share of the period"""
    mean = 255.0 - MODULATION * math.cos(math.pi * share) if share else MEAN
    leak, first = bent(lambda level: np.minimum(level, 255.0), mean, MODULATION, 18)
    error, flagged = _decoded_phase(mean, MODULATION)
    return worst(error, worst_angle(leak + rounding(), first), flagged)


@family(
    "phase",
    "gamma",
    "rad",
    against="the phase that the frames were made from",
    bound="asin(sum of the harmonics kN +- 1 over the first), which N steps alias with the fringe",
    steps=(18, 4, 3),
    gamma=(1.0, 1.5, 2.2, 3.0),
)
def gamma_bend(gamma: float, steps: int) -> Outcome:
    """wrapped phase of frames 255 (I / 255)^gamma"""

    def response(level: NDArray) -> NDArray:
        return 255.0 * (level / 255.0) ** gamma

    frames = response(sinusoids(phases(), steps, MEAN, 120.0))
    return worst(phase_error(frames), worst_angle(*bent(response, MEAN, 120.0, steps)) + 100 * U64)


@family(
    "phase",
    "quantisation",
    "rad",
    against="the phase that the frames were made from",
    bound=(
        "asin(q g / 2B), q = 255 / (2^bits - 1), g = max (2/N) sum |sin|; pi / N where one bit "
        "leaves 2N states or N"
    ),
    steps=(3, 4, 5, 7, 12, 18),
    bits=(1, 2, 4, 8, 16),
)
def quantisation(bits: int, steps: int) -> Outcome:
    """wrapped phase of frames of this bit depth, B = 100"""
    levels = 2**bits - 1
    frames = np.rint(sinusoids(phases(), steps) / 255.0 * levels) * (255.0 / levels)
    limit = math.pi / steps if bits == 1 else math.pi
    return worst(
        phase_error(frames), min(worst_angle(255.0 / levels * rounding(steps)), limit) + 100 * U64
    )


@family(
    "phase",
    "steps close together",
    "rad",
    against="least squares of the same frames in 50 digits",
    bound=(
        "8 N u cond (A + B) / B (pinv M = I to u cond) + N u ||I|| / (sigma_min B); cond > 1e6 "
        "refused"
    ),
    expects=lambda spread_rad: "number" if spread_rad > 5e-3 else "either",
    spread_rad=(1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 1e-4, 1e-8),
)
def close_steps(spread_rad: float) -> Outcome:
    """wrapped phase at shifts 0, s, 2 s"""
    deltas = spread_rad * np.arange(3)
    frames = sinusoids(phases(48), deltas)
    model = np.stack([np.ones(3), np.cos(deltas), np.sin(deltas)], axis=1)
    largest, _, least = map(float, np.linalg.svd(model, compute_uv=False))
    strength = float(np.linalg.norm(frames[:, 0], axis=0).max())
    bound = (
        8 * 3 * U64 * (largest / least) * (MEAN + 100.0) / 100.0
        + 3 * U64 * strength / least / 100.0
    )
    error = difference(wrapped_phase(frames, deltas).phase[0], _least_squares(frames, wide(deltas)))
    return worst(error, bound, condition=largest / least)


@family(
    "phase",
    "dead frame",
    "mm",
    against="the frame's mean contradicts the N - 1 others",
    bound=(
        "frame means follow A + C cos + S sin too; from 4 steps on the dead frame must be refused"
    ),
    expects="refusal",
    steps=(18, 9, 6, 4),
    level=(0, 255),
)
def dead_frame(steps: int, level: int) -> Outcome:
    """a plane's depth with one frame entirely black or white"""
    rig = coded_rig(steps=steps)
    frames, _ = plane_stack(rig, mean=120.0)
    frames[rig.sequence.sinusoids("vertical")[1]] = np.full((32, 32), level, np.uint8)
    depth_mm = decode_stack(frames, rig).depth_mm
    return worst(depth_mm, flagged=depth_mm == 0)


@family(
    "order",
    "pitch",
    "px",
    against="the coordinate that the frames were made from",
    bound="P / 2 pi asin(g / 2B): 8-bit frames alone; a slip would be a whole period; under 4 px or beyond "
    "the pattern refused",
    expects=lambda pitch_px, **_: "number" if 4 <= pitch_px <= 912 else "refusal",
    bit_noise=(0.0, 0.7),
    pitch_px=(2.5, 3.9, 4.0, 5.3, 18.0, 36.7, 100.0, 912.0, 1000.0),
)
def pitch(pitch_px: float, bit_noise: float) -> Outcome:
    """projector coordinate by the decoder, 8-bit frames with noise in the Gray bits, over the whole
    pattern and in the middle of every period"""
    rig = coded_rig(pitch_px)
    middles = (
        np.arange(int(912 / pitch_px)) + 0.5
    ) * pitch_px  # phases of +-pi: the sign of the sine is arbitrary
    positions_px = np.concatenate([np.linspace(2.0, 909.0, 20_000), middles])
    levels = direction_levels(rig, positions_px)
    bits = levels[rig.sequence.steps :]
    bits += bit_noise * MODULATION * np.random.default_rng(1).uniform(-1, 1, bits.shape)
    error_px, flagged = coordinate_error(rig, levels, positions_px)
    return worst(error_px, rounding_px(rig), flagged)


@family(
    "order",
    "on a Gray edge",
    "px",
    against="the coordinate that the frames were made from",
    bound="P / 2 pi asin(g / 2B): 8-bit frames alone; a slip would be a whole period",
    pitch_px=(4.0, 18.0, 37.3),
    blend=(0.0, 0.25, 0.5, 0.75, 1.0),
)
def edge_blend(pitch_px: float, blend: float) -> Outcome:
    """coordinate of pixels that see both cells, at every edge of the code"""
    rig = coded_rig(pitch_px)
    cells = cell_count(rig.pattern_length("vertical"), pitch_px)
    edges = np.ceil(np.arange(1, cells) * (pitch_px / 2))
    positions_px = edges - 1 + blend  # between the last pixel of a cell and the first of the next
    levels, below, above = (direction_levels(rig, px) for px in (positions_px, edges - 1, edges))
    bits = slice(rig.sequence.steps, None)
    levels[bits] = (1 - blend) * below[bits] + blend * above[bits]
    error_px, flagged = coordinate_error(rig, levels, positions_px)
    return worst(error_px, rounding_px(rig), flagged)


@family(
    "order",
    "arctangent",
    "rad",
    against="50 digits, in [-pi, pi)",
    bound="4 u |phi|, the 2 ulp that it promises",
    scale=(1.0, 255.0, 1e-12, 1e-150, 1e150),
)
def arctangent(scale: float) -> Outcome:
    """-atan2 in all octants, on the axes, beside +-pi, of signed zeros"""
    beside = np.logspace(-15, -1, 15)
    turn = np.concatenate([np.linspace(-np.pi, np.pi, 97), np.pi - beside, -np.pi + beside])
    cosine = scale * np.concatenate([np.cos(turn), [1.0, -1, -1, 0, 0, -1, -1, 1]])
    sine = scale * np.concatenate([np.sin(turn), [0.0, 0, -0.0, 1, -1, -1e-17, -1e-300, 1e-300]])
    phase = minus_atan2(sine, cosine)
    error = difference(phase, minus_arctangent2(wide(sine), wide(cosine)))
    error -= 2 * np.pi * np.rint(error / (2 * np.pi))  # +pi and -pi are the same angle
    error[(phase < -np.pi) | (phase >= np.pi)] = np.inf
    return worst(error, np.maximum(4 * U64 * np.abs(phase), 2.0**-1073))


@family(
    "order",
    "flipped bit, both directions",
    "mm",
    against="the plane, 1800 mm",
    bound=(
        "8-bit frames, by rig.md's slope; slipped pixels flagged: 18 px are 11 px off the epipolar "
        "line"
    ),
    expects="either",
    direction=AXES,
    bit=range(7),
)
def flipped_bit(bit: int, direction: Direction) -> Outcome:
    """depth of a plane with one Gray bit inverted in the whole image"""
    rig = coded_rig(size=96)
    frames, inside = plane_stack(rig)
    flipped = rig.sequence.gray(direction)[bit]
    frames[flipped] = 255 - np.asarray(frames[flipped])
    decoded = decode_stack(frames, rig, mask=inside)
    px_per_m = rig.projector.fx * rig.translation_m[0] / PLANE_M**2  # f b / Z^2
    error = decoded.depth_mm[inside] - PLANE_M * MM_PER_M
    bound_mm = rounding_px(rig) / px_per_m * MM_PER_M * math.sqrt(2) * 1.01
    return worst(error, bound_mm, decoded.reason[inside] != Reason.DECODED)


CROSSED_RIG = replace(crossed_rig(320, "crossed-18"), background_m=None)
CARRIERS: Crossed = CROSSED_RIG.crossed  # type: ignore[assignment]
DEPTH_M = 1.78
"""Distance of the plane that crossed fringes light, in m: near the standoff of 1.8 m, not at it."""
AMBIENT = 6.0
"""Ambient light of these frames, in grey levels."""
NOISE = 0.7
"""Standard deviation of their noise, in grey levels."""
MIDDLE = slice(120, 200), slice(120, 200)
"""Pixels that are judged: no window of theirs leaves the mask."""


def plane_outcome(
    family: Crossed,
    white: float = 160.0,
    rig: Rig = CROSSED_RIG,
    measured_as: Crossed | None = None,
) -> Outcome:
    """The worst pixel of a plane that ``family`` lights, flagged where the route gives a reason or
    no depth. ``measured_as``: the family that the route takes it for."""
    u, v = rig.seen(rig.camera.rays(), DEPTH_M)
    pairs = zip(family.weights, family.cycles_per_px, strict=True)
    waves = sum(weight * np.cos(2 * np.pi * (a * u + b * v)) for weight, (a, b) in pairs)
    noise = np.random.default_rng(4).normal(0, NOISE, u.shape)
    grey = np.clip(np.rint(AMBIENT + white * (0.5 + 0.5 * waves) + noise), 0, 255).astype(np.uint8)
    mask = np.zeros(u.shape, bool)
    mask[60:260, 60:260] = True
    model = TwoCarriers(rig, family=measured_as or family)
    measured = two_carriers(model).measure(grey, mask)
    depth_mm, exact_mm = measured.depth_mm[MIDDLE], DEPTH_M * 1000
    flagged = (depth_mm == 0) | (measured.reason[MIDDLE] != DepthReason.MEASURED)
    bound_mm = float(np.median(model.carriers.mm_per_rad(np.full(u.shape, exact_mm)))) * math.pi / 2
    return worst(depth_mm - exact_mm, bound_mm, flagged)


@family(
    "crossed",
    "dim or saturated",
    "mm",
    against="the plane's depth, closed form",
    bound=(
        "pi / 2 of the joint phase: a rival order is further off, and a pixel that may be one must "
        "say so"
    ),
    expects=lambda white: "number" if 40 <= white <= 220 else "either",
    white=(2000.0, 600.0, 400.0, 300.0, 260.0, 220.0, 160.0, 80.0, 40.0, 20.0, 10.0, 5.0, 2.0, 0.0),
)
def exposed(white: float) -> Outcome:
    """depth of a plane at this grey level of white, noise 0.7, its crests clipped at 255"""
    return plane_outcome(CARRIERS, white)


@family(
    "crossed",
    "one direction lost",
    "mm",
    against="the plane's depth, closed form",
    bound="pi / 2 of the joint phase",
    expects=lambda weight: "number" if weight >= 0.3 else "either",
    weight=(0.5, 0.3, 0.1, 0.05, 0.02, 1e-9),
)
def lost(weight: float) -> Outcome:
    """depth of a plane whose second carrier has this weight, and not the 0.5 that the route knows
    of"""
    return plane_outcome(replace(CARRIERS, weights=(0.5, weight)), measured_as=CARRIERS)


@family(
    "crossed",
    "a rival on the truth",
    "mm",
    against="the plane's depth, closed form",
    bound="pi / 2 of the joint phase",
    expects="either",
    ratio=(0.5, 1 / 3, 0.25, 0.2),
)
def rival(ratio: float) -> Outcome:
    """depth of a plane by periods of 12 px whose gains have this ratio, over four and more periods:
    with 1 / 2 and 1 / 3 another order fits exactly"""
    turn_deg = math.degrees(math.atan(ratio))
    along_deg = 128.66  # of the paper's epipolar lines
    return plane_outcome(Crossed((12.0, 12.0), (along_deg + turn_deg, along_deg - 90 + turn_deg)))


@family(
    "crossed",
    "baseline along one axis",
    "mm",
    against="the plane's depth, closed form",
    bound="pi / 2 of the joint phase",
    expects="either",
    angle_deg=(0.0, 20.0, 45.0),
)
def along_one_axis(angle_deg: float) -> Outcome:
    """depth of a plane where the projector is above the camera and the carriers are turned by this
    angle: at 0 the second carrier tells no depth"""
    rig = replace(CROSSED_RIG, translation_m=(0.0, -0.16, 0.0))
    return plane_outcome(Crossed((18.0, 18.0), (angle_deg, angle_deg + 90)), rig=rig)
