"""Triangulation with baselines down to 0.01 mm, ranges to 100 m, parallel rays, wrong sides and single precision; rigs
with nearly singular intrinsics, rotations off orthonormal and lenses that fold."""

import json
import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.baselines.phase_route.calibration_layer import CalibrationLayer
from fpp_ml_bench.baselines.stability.cases import (
    U32,
    U64,
    Floats,
    Group,
    Outcome,
    difference,
    high_precision,
    wide,
    worst,
    wrong,
)
from fpp_ml_bench.baselines.stability.frames import plane_stack
from fpp_ml_bench.coding.code import Reason
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.decoding.triangulation import depth_from_both, depth_from_coordinate, depth_noise_mm
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.loaders.render.illumination import light_surface
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.render.projector import PatternLight
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.pinhole import Maps, Pinhole, distort, fold_radius_squared, undistort
from fpp_ml_bench.optics.rig import Rig, rotation_matrix
from fpp_ml_bench.optics.rig_file import load_rig, rig_from_dict, save_rig
from fpp_ml_bench.optics.sequence import AXES, Direction

TRIANGULATION = Group(
    "triangulation",
    "the closed form on the same float64 inputs in 50 digits",
    "u (8 kappa + 5 kappa_top + 4), kappa = sum of magnitudes over |a - x_p a_2|: running error analysis",
)
RIG = Group("rig")
BASELINES = (160.0, 50.0, 10.0, 1.0, 0.1, 0.01)
PAPER = paper_rig(24)
TURN = rotation_matrix((0.05, -0.09, 0.12))
_WEIGHTS = (0.7, 1.3)


def _rays(count: int) -> Maps:
    """Normalised coordinates of camera rays across the paper's field of view, seeded."""
    x, y = np.random.default_rng(5).uniform(-0.2, 0.2, (2, count))
    return x, y


def _ahead(rays: Maps) -> Floats:
    """Rays as points at z = 1, (3, n)."""
    return np.stack([*rays, np.ones(len(rays[0]))])


RAYS = _rays(40)


def scaled_baseline(baseline_mm: float, ahead: float = 0.0, turned: bool = False) -> Rig:
    """The paper's rig with a shorter baseline and the projector ``ahead`` of the camera by that share of it."""
    t = np.array([*PAPER.translation_m[:2], -ahead * PAPER.baseline_m])
    t *= baseline_mm / MM_PER_M / np.linalg.norm(t)
    return replace(PAPER, rotation=(TURN if turned else np.eye(3)).tolist(), translation_m=tuple(t.tolist()))


def _device(rig: Rig) -> tuple[Floats, Floats]:
    """Focal lengths and principal point of the projector in px, (2, 1)."""
    device = rig.projector
    return np.array([[device.fx], [device.fy]]), np.array([[device.cx], [device.cy]])


def _turned(rig: Rig, rays: Maps) -> NDArray[np.object_]:
    """Rays in the projector's axes in 50 digits, (3, n)."""
    return wide(rig.R) @ wide(_ahead(rays))


def exact_coordinates(depth_m: float, rig: Rig, rays: Maps = RAYS) -> Floats:
    """Projector px (2, n) of points at ``depth_m`` on the rays, in 50 digits, rounded once."""
    focal, centre = _device(rig)
    points = _turned(rig, rays) * depth_m + wide(rig.t)[:, None]
    return (wide(focal) * points[:2] / points[2] + centre).astype(float)


def exact_depth_mm(coordinate: NDArray, rig: Rig, axis: int = 0) -> NDArray[np.object_]:
    """Depth of these float64 inputs in 50 digits, by the closed form."""
    focal, centre = _device(rig)
    a, ideal = _turned(rig, RAYS), (wide(coordinate) - centre[axis]) / focal[axis]
    top, bottom = ideal * rig.t[2] - rig.t[axis], a[axis] - ideal * a[2]
    return np.where(bottom == 0, math.inf, 1000 * top / np.where(bottom == 0, 1, bottom))


def relative(depth_mm: NDArray, exact: NDArray[np.object_]) -> Floats:
    return difference(depth_mm, exact) / np.abs(exact.astype(float))


def depth_of(coordinate: NDArray, rig: Rig, axis: int = 0) -> Floats:
    """The benchmark's depth in mm."""
    return depth_from_coordinate(RAYS, coordinate, rig, AXES[axis])


def conditioning(coordinate: NDArray, rig: Rig, axis: int = 0, rays: Maps = RAYS) -> tuple[Floats, ...]:
    """Bound of the closed form's relative error, and its condition number: sum of magnitudes over |a - x_p a_2|.
    Running error analysis: x_p has 2 roundings; a, a_2 have 3 each of sums of magnitudes; the difference and the top
    cancel; 4 more for the last quotient and the change to mm."""
    (focal, centre), t = _device(rig), rig.t
    ideal, terms = (coordinate - centre[axis]) / focal[axis], rig.R[:, :, None] * _ahead(rays)
    size, a = np.abs(terms).sum(axis=1), terms.sum(axis=1)
    condition = (size[axis] + np.abs(ideal) * size[2]) / np.abs(a[axis] - ideal * a[2])
    above = (np.abs(ideal) * abs(t[2]) + abs(t[axis])) / np.abs(ideal * t[2] - t[axis])
    return U64 * (8 * condition + 5 * above + 4), condition


def closed_form(coordinate: NDArray, rig: Rig, axis: int = 0, indistinct: NDArray | bool = False) -> Outcome:
    """The outcome of depths from one coordinate; the ``indistinct`` ones may be masked."""
    exact, depth_mm = exact_depth_mm(coordinate, rig, axis), depth_of(coordinate, rig, axis)
    bound, condition = conditioning(coordinate, rig, axis)
    # Where the bound exceeds half of the depth, the number is round-off and must be as behind the camera.
    nothing = ~(bound < 0.5) | ~(exact.astype(float) > 0)
    error, may_flag = np.where(nothing, np.inf, relative(depth_mm, exact)), float(np.mean(nothing | indistinct))
    return worst(error, bound, np.isnan(depth_mm), may_flag, float(condition.max()))


# Decorators apply from the bottom: the lowest family comes first.
@TRIANGULATION.family(
    "turned projector ahead of the camera",
    "relative",
    about="depth from one coordinate, general pose",
    direction=AXES,
    range_m=(0.3, 1.8, 100.0),
    baseline_mm=(160.0, 0.01),
    turned=(1,),
)
@TRIANGULATION.family(
    "short baseline and long range",
    "relative",
    direction=("vertical",),
    baseline_mm=(1.0, 0.01),
    range_m=(20.0, 100.0),
)
@TRIANGULATION.family(
    "range",
    "relative",
    direction=AXES,
    baseline_mm=(160.0,),
    range_m=(0.3, 1.0, 1.8, 5.0, 20.0, 100.0),
)
@TRIANGULATION.family(
    "baseline",
    "relative",
    about="depth from one coordinate at 1.8 m",
    direction=AXES,
    range_m=(1.8,),
    baseline_mm=BASELINES,
)
def one_coordinate(baseline_mm: float, range_m: float, direction: Direction, turned: int = 0) -> Outcome:
    """depth from one coordinate"""
    rig, axis = scaled_baseline(baseline_mm, 0.3 * turned, turned > 0), AXES.index(direction)
    return closed_form(exact_coordinates(range_m, rig)[axis], rig, axis)


def _least_squares(measured_px: NDArray, rig: Rig, rays: Maps) -> tuple[NDArray, Floats, Floats]:
    """Depth mm that minimises the weighted misfit, by Newton in 50 digits; contraction of Gauss-Newton; its start's
    relative error."""
    focal, centre = _device(rig)
    a, t, weights = _turned(rig, rays), wide(rig.t), wide(_WEIGHTS)
    ideal = (wide(measured_px) - centre) / focal
    c, d = wide(focal) * (a[:2] - ideal * a[2]), wide(focal) * (ideal * t[2] - t[:2, None])
    w = first = weights @ (c * d) / (weights @ d**2)
    for _ in range(15):
        q = a[2] + t[2] * w
        r = (c - d * w) / q
        g = (d + r * t[2]) / q  # -dr/dw
        h = 2 * t[2] * g / q  # d2r/dw2
        square, bend = weights @ g**2, weights @ (r * h)
        w = w + weights @ (r * g) / (square + bend)
    return 1000 / w, np.abs(bend / square).astype(float), np.abs((first - w) / w).astype(float)


@TRIANGULATION.family(
    "both directions",
    "relative",
    expects="either",
    noise_px=(0.0, 0.5),
    ahead=(0.0, 0.3, 1.0),
    baseline_mm=BASELINES[:4],
)
def both_coordinates(baseline_mm: float, ahead: float, noise_px: float) -> Outcome:
    """depth by weighted least squares of both coordinates; against the minimum, by Newton's method in 50 digits; bound:
    8 x the closed form's bound + start error x (Gauss-Newton contraction + 4 start error)^3"""
    rig, rays, rng = scaled_baseline(baseline_mm, ahead, True), _rays(16), np.random.default_rng(6)
    measured_px = exact_coordinates(1.8, rig, rays)
    measured_px += noise_px * rng.standard_normal(measured_px.shape)
    exact, contraction, start = _least_squares(measured_px, rig, rays)
    depth_mm = depth_from_both(rays, measured_px[0], measured_px[1], rig, *_WEIGHTS).depth_mm
    bounds, conditions = zip(*(conditioning(measured_px[i], rig, i, rays) for i in (0, 1)), strict=True)
    in_front = exact.astype(float) > 0
    bound = 8 * np.maximum(*bounds) + start * (contraction + 4 * start) ** 3
    error = np.where(in_front, relative(depth_mm, exact), 0.0)
    return worst(error, bound, np.isnan(depth_mm), float(np.mean(~in_front)), float(np.max(conditions)))


@TRIANGULATION.family("noise law", "1", direction=AXES, baseline_mm=BASELINES)
def noise_law(baseline_mm: float, direction: Direction) -> Outcome:
    """rms depth error over sigma_u Z^2 / (f_p b), minus 1; or the share without depth, minus Phi; against rig.md's law;
    where noise is over a fifth of the depth, the normal law of inverse depth; bound: 4 standard errors of 20,000 draws,
    and 8 (sigma_Z / Z)^2 of second order"""
    rig, count, modulation, axis = scaled_baseline(baseline_mm), 20_000, 60.0, np.zeros(20_000)
    coordinate = exact_coordinates(1.8, rig, (axis[:1], axis[:1]))[AXES.index(direction)][0]
    sigma_px = rig.pitch(direction) * math.sqrt(2 / 18) / modulation / (2 * math.pi)
    noisy = coordinate + sigma_px * np.random.default_rng(8).standard_normal(count)
    depths_mm = depth_from_coordinate((axis, axis), noisy, rig, direction)
    law = float(depth_noise_mm(rig, 1800.0, direction, 18, modulation))
    share = law / 1800.0
    if share < 0.2:
        rms = float(np.sqrt(np.mean((depths_mm - 1800.0) ** 2)))
        return Outcome(abs(rms / law - 1), 4 / math.sqrt(2 * count) + 8 * share**2, condition=1 / share)
    # Inverse depth is exactly linear in u: it is negative, and there is no depth, with the probability Phi(-1/share).
    nowhere = 0.5 * math.erfc(1 / share / math.sqrt(2))
    bound = 4 * math.sqrt(nowhere * (1 - nowhere) / count) + 1 / count
    return Outcome(abs(float(np.isnan(depths_mm).mean()) - nowhere), bound, condition=1 / share)


@TRIANGULATION.family(
    "nearly parallel rays",
    "relative",
    expects="either",
    about=f"depth of a projector plane this many px from parallel; bound: {TRIANGULATION.predicts}; masked where it "
    "lies behind",
    shift_px=(10.0, 1.0, 1e-3, 1e-6, 1e-9, 1e-11, 1e-12, 0.0, -1e-6, -1.0),
)
def near_parallel(shift_px: float) -> Outcome:
    focal, centre = PAPER.projector.fx, PAPER.projector.cx
    coordinate = focal * RAYS[0] + centre + shift_px  # depth f b / shift, up to a point at infinity
    size = (np.abs(coordinate) + centre) / focal + np.abs(RAYS[0])
    return closed_form(coordinate, PAPER, 0, 8 * U64 * size * focal > 0.2 * abs(shift_px))


@TRIANGULATION.family("point at infinity", "mm", expects="refusal")
def point_at_infinity() -> Outcome:
    """depth where ray and projector plane are exactly parallel; against there is none; bound: must be masked"""
    rays = np.array([0.0, 0.125, -0.25]), np.zeros(3)  # where its coordinate is exact
    coordinate = PAPER.projector.fx * rays[0] + PAPER.projector.cx
    return worst(0.0, flagged=np.isnan(depth_from_coordinate(rays, coordinate, PAPER, "vertical")))


@TRIANGULATION.family("far plane through the decoder", "mm", expects="refusal", range_m=(0.3, 1.0, 3.2, 20.0, 100.0))
def decoded_far(range_m: float) -> Outcome:
    """decoded depth of a plane outside the working range; against the working range; bound: must be masked"""
    rig = paper_rig(32)
    frames, inside = plane_stack(rig, range_m)  # at the farthest its parallax is under a hundredth of a pixel
    depth_mm = decode_stack(frames, rig, mask=inside).depth_mm[inside]
    return worst(depth_mm, 0.0, depth_mm == 0)


@TRIANGULATION.family("behind the projector", "mm", expects="refusal", ahead_m=(0.5, 1.0, 3.0))
def behind_projector(ahead_m: float) -> Outcome:
    """depth of points that lie behind a projector ahead of the camera; against there is none; bound: must be masked"""
    rig = replace(PAPER, translation_m=(0.125, -0.1, -ahead_m))
    points = _ahead(RAYS).T * (0.5 * ahead_m) + rig.t
    mirrored = rig.projector.fx * points[:, 0] / points[:, 2] + rig.projector.cx
    return worst(0.0, flagged=np.isnan(depth_of(mirrored, rig)))


@TRIANGULATION.family("projector behind the surface", "grey", expects="refusal")
def lit_from_behind() -> Outcome:
    """projector light on a surface lit from its far side; against none reaches the camera; bound: exactly 0, so the
    decoder masks it for want of modulation"""
    turn = rotation_matrix((0.0, math.pi, 0.0))
    shift = -turn @ np.array([-0.125, 0.1, 3.0])
    rig = replace(PAPER, rotation=turn.tolist(), translation_m=tuple(shift.tolist()))
    light = named_light("paper")
    pattern = PatternLight.of(PAPER, light.projector)
    lit = light_surface(_ahead(RAYS).T * 1.8, np.tile([0.0, 0.0, -1.0], (40, 1)), rig, light, pattern)
    return worst(lit.gain, 0.0, lit.gain == 0)


@TRIANGULATION.family(
    "float32 coordinate", "relative", expects="either", range_m=(0.3, 1.8, 100.0), baseline_mm=BASELINES
)
def single_coordinate(baseline_mm: float, range_m: float) -> Outcome:
    """depth from a coordinate rounded to float32; against depth from the float64 coordinate, 50 digits; bound: 2^-24
    kappa, kappa = u_p / (u_p - u_infinity); not checked where that is over 1/2"""
    rig = scaled_baseline(baseline_mm)
    coordinate, focal, centre = exact_coordinates(range_m, rig)[0], rig.projector.fx, rig.projector.cx
    depth_mm = depth_of(coordinate.astype(np.float32), rig)
    slope = np.abs(coordinate) / focal / np.abs((coordinate - centre) / focal - RAYS[0])
    error = relative(depth_mm, exact_depth_mm(coordinate, rig))
    return _rounded_input(error, slope * U32, slope, np.isnan(depth_mm), 1.001)


def _rounded_input(
    error: Floats, rounding: Floats, condition: Floats, flagged: ArrayLike = False, slack: float = 1.0
) -> Outcome:
    """The outcome of numbers with this relative error by rounding, which is not checked where that is over 1/2."""
    useless = rounding >= 0.5
    bound = slack * np.where(useless, 1.0, rounding / (1 - np.minimum(rounding, 0.5)))
    return worst(np.where(useless, 0.0, error), bound, flagged, float(useless.mean()), float(condition.max()))


@TRIANGULATION.family("float32 calibration layer", "relative", range_m=(0.3, 1.8, 100.0), baseline_mm=BASELINES)
def single_layer(baseline_mm: float, range_m: float) -> Outcome:
    """depth by the phase route's calibration layer in float32; against the depth put in; bound: 2^-24 (sum of phase
    magnitudes / |psi| + 6)"""
    layer = CalibrationLayer.of(scaled_baseline(baseline_mm), "vertical", RAYS)
    total = layer.absolute_phase(np.full(len(RAYS[0]), range_m * MM_PER_M))
    order = np.floor(total / (2 * np.pi) + 0.5)
    phase = (total - 2 * np.pi * order).astype(np.float32)
    fields = ("infinity_rad", "gain", "infinity_order", "forward")
    narrow = replace(layer, **{name: getattr(layer, name).astype(np.float32) for name in fields})
    depth_mm = narrow.depth_mm(phase, order.astype(np.float32))
    # The layer subtracts small phases, so only the phase's own rounding is amplified.
    psi = np.abs(layer.gain / (layer.forward * range_m + layer.back_m))
    turns = 2 * np.pi * np.abs(order - layer.infinity_order)
    lost = np.abs(phase) + np.abs(layer.infinity_rad) + np.abs(phase - layer.infinity_rad) + 2 * turns + psi
    condition = lost / psi
    return _rounded_input(depth_mm / (range_m * MM_PER_M) - 1, condition * U32 + 6 * U32, condition)


@TRIANGULATION.family("impossible coordinates", "mm", expects="either", value=(1e308, -1e308, 1e16, math.inf, math.nan))
def overflowing(value: float) -> Outcome:
    """depth from coordinates that no projector has; against finite and positive, or masked; bound: must be masked where
    there is no depth"""
    u = np.full(RAYS[0].shape, value)
    depths = np.stack([depth_of(u, PAPER), depth_from_both(RAYS, u, u, PAPER).depth_mm])
    legal = np.isnan(depths) | (np.isfinite(depths) & (depths > 0))
    return worst(np.where(legal.all(axis=0), 0.0, np.inf), 0.0, np.isnan(depths).all(axis=0))


@TRIANGULATION.family("no weight", "mm", expects="refusal")
def no_weight() -> Outcome:
    """depth from two directions without modulation; against there is none; bound: must be masked"""
    u, v = exact_coordinates(1.8, PAPER)
    return worst(0.0, flagged=np.isnan(depth_from_both(RAYS, u, v, PAPER, 0.0, 0.0).depth_mm))


def intrinsics(focal_px: float, centre_px: float) -> Outcome:
    camera, u = Pinhole(960, 960, focal_px, focal_px, centre_px, centre_px), np.linspace(-0.5, 959.5, 97)
    if not np.isfinite(camera.rays()).all():
        return Outcome(math.inf, 1.0, note="rays that are not finite")
    size = np.abs(u - centre_px) + abs(centre_px)
    back = camera.pixels(*camera.normalised(u, u))[0]
    return worst(back - u, 3 * U64 * size + U64 * np.abs(u), condition=float(np.max(size / 960)))


_BACK = "pixel to ray and back; against the pixel; bound: 3 u (|u - c| + |c|) + u |u|; refused from a condition number "
RIG.family(
    "intrinsic matrix",
    "px",
    about=f"{_BACK}of 2^26 on, half of the digits",
    refuses=RigError,
    expects=lambda focal_px, centre_px: "number" if 1e-3 <= focal_px <= 1e8 else "either",
    centre_px=(479.5,),
    focal_px=(2e3, 1.0, 1e-3, 1e-6, 1e-8, 1e-12, 1e-300, 5e-324, 1e8, 1e12, 1e300),
)(intrinsics)
RIG.family(
    "far principal point",
    "px",
    about=f"{_BACK}of 2^26 on",
    refuses=RigError,
    focal_px=(2e3,),
    expects=lambda focal_px, centre_px: "number" if centre_px <= 1e6 else "either",
    centre_px=(1e3, 1e6, 1e12, 1e16),
)(intrinsics)


@RIG.family(
    "rotation off orthonormal",
    "relative",
    refuses=RigError,
    kind=("scaled", "sheared"),
    off=(0.0, 1e-9, 1e-7, 9.9e-7, 1.1e-6, 1e-4, 1e-2),
    expects=lambda kind, off: "number" if off < 1e-6 else "refusal",
)
def off_orthonormal(off: float, kind: str) -> Outcome:
    """depth through this matrix; against depth through the rotation, 1800 mm; bound: 2 |R R^T - I| kappa + round-off;
    over 1e-6 a rig is refused"""
    # R R^T - I is (1 + s)^2 - 1 or off between the first two rows.
    matrix = TURN * (1 + off / 2) if kind == "scaled" else TURN + np.outer([off, 0, 0], TURN[1])
    base, rig = (replace(PAPER, rotation=turn.tolist()) for turn in (TURN, matrix))
    coordinate = exact_coordinates(1.8, base)[0]
    depth_mm = depth_of(coordinate, rig)
    rounding, condition = conditioning(coordinate, base)
    # Each row of R moves by off at most: the difference a - x_p a_2 by off times the condition number, twice.
    bound = rounding + 2 * off * condition
    return worst(depth_mm / 1800.0 - 1, bound / (1 - bound), np.isnan(depth_mm), condition=float(condition.max()))


@RIG.family(
    "rotation vector",
    "1",
    angle_rad=(0.0, 1e-300, 1e-12, 1e-4, 1.0, math.pi, math.tau, 1e3, 1e8, 1e12, 1e15),
    refuses=RigError,
    expects=lambda angle_rad: "number" if angle_rad <= 1e8 else "either",
)
def rotation_vector(angle_rad: float) -> Outcome:
    """rotation matrix by Rodrigues' formula; against the same formula in 50 digits; bound: 8 u (1 + angle): the angle
    carries its own rounding; refused where that is over 1e-6"""
    vector = np.array([0.48, -0.6, 0.64]) * angle_rad
    matrix = rotation_matrix(tuple(vector.tolist()))
    replace(PAPER, rotation=matrix.tolist())  # which may refuse it
    mp, (x, y, z) = high_precision(), wide(vector)
    angle, cross = mp.sqrt(x * x + y * y + z * z), np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    # sin(angle) / angle and (1 - cos(angle)) / angle^2
    exact = np.eye(3) + mp.sinc(angle) * cross + mp.sinc(angle / 2) ** 2 / 2 * (cross @ cross)
    return worst(difference(matrix, exact), 8 * U64 * (1 + angle_rad), condition=angle_rad)


def lens_inverse(k1: float, k2: float, k3: float) -> Outcome:
    """ideal radius of distorted ones up to 1.6; against bisection in 50 digits below the fold; bound: 32 u / slope of
    the model: a residual of some roundings; masked where no point maps there"""
    coefficients = (k1, k2, 0.0, 0.0, k3)
    fold, radius = math.sqrt(fold_radius_squared(coefficients)), np.linspace(0.0, 1.6, 81)[1:]
    radii = np.hypot(*undistort(radius * math.cos(0.7), radius * math.sin(0.7), coefficients))
    a, b, c = wide((k1, k2, k3))

    def forward(r: Any) -> Any:
        return r * (1 + r * r * (a + r * r * (b + r * r * c)))

    top = wide(min(fold, 4.0))
    largest = forward(top) if math.isfinite(fold) else wide(math.inf)
    target, low, high = wide(radius), 0 * wide(radius), top + 0 * wide(radius)
    for _ in range(80):
        middle = (low + high) / 2
        below = forward(middle) < target
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    square = low * low
    slope = np.maximum((1 + square * (3 * a + square * (5 * b + square * 7 * c))).astype(float), 1e-9)
    invertible = target < largest
    error = np.where(invertible, radii - low.astype(float), np.where(np.isnan(radii), 0.0, np.inf))
    near = np.abs(radius - float(largest)) < 1e-3
    may_flag, bound = float(np.mean(~invertible | near)), 32 * U64 / np.where(invertible, slope, 1.0)
    return worst(error, bound, np.isnan(radii), may_flag, condition=float(1 / slope[invertible].min()))


RIG.family("lens inverse, k1", "1", k1=(-0.1, -0.3, -1.0, -5.0, 0.5, 5.0, 100.0), k2=(0.0,), k3=(0.0,))(lens_inverse)
RIG.family("lens inverse, several terms", "1", k1=(-0.8, 0.6), k2=(0.9, -1.5), k3=(-0.3, 2.0))(lens_inverse)


@RIG.family("tangential lens", "1", expects="either", p1=(0.001, 0.01, 0.05, 0.1, 0.3))
def tangential(p1: float) -> Outcome:
    """ideal points of a grid under tangential distortion; against Newton continuation from the axis in 200 steps;
    another branch is no answer; bound: 32 u / least slope of the model there: a residual of some roundings"""
    coefficients = (-0.2, 0.0, p1, -p1, 0.0)
    xd, yd = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-0.8, 0.8, 33)] * 2))
    x, y = undistort(xd, yd, coefficients)
    residual = np.hypot(*(a - b for a, b in zip(distort(x, y, coefficients), (xd, yd), strict=True)))
    px, py, lost = np.zeros_like(xd), np.zeros_like(yd), np.zeros(xd.shape, bool)
    k1, _, q1, q2, _ = coefficients
    for step in np.linspace(0, 1, 201)[1:]:
        for _ in range(4 if step < 1 else 20):
            r2 = px * px + py * py
            fx = px * (1 + k1 * r2) + 2 * q1 * px * py + q2 * (r2 + 2 * px * px) - step * xd
            fy = py * (1 + k1 * r2) + q1 * (r2 + 2 * py * py) + 2 * q2 * px * py - step * yd
            jxx = 1 + k1 * r2 + 2 * k1 * px * px + 2 * q1 * py + 6 * q2 * px
            jyy = 1 + k1 * r2 + 2 * k1 * py * py + 6 * q1 * py + 2 * q2 * px
            jxy = 2 * k1 * px * py + 2 * q1 * px + 2 * q2 * py
            determinant = jxx * jyy - jxy * jxy
            lost |= ~(determinant > 1e-6)
            px, py = px - (jyy * fx - jxy * fy) / determinant, py - (jxx * fy - jxy * fx) / determinant
    right = ~lost & (px * px + py * py < fold_radius_squared(coefficients))
    trace = jxx + jyy
    slope = (trace - np.sqrt(np.maximum(trace * trace - 4 * determinant, 0))) / 2  # the Jacobian is symmetric
    off = np.where(right, np.hypot(x - px, y - py), np.inf)  # no solution off that branch
    bound = np.where(right, 32 * U64 / np.maximum(slope, 1e-6), 1.0)
    masked = ~np.isfinite(x)
    return worst(np.where(masked, 0.0, np.maximum(off, residual)), bound, masked, float(np.mean(~right)))


@RIG.family("lens without inverse at the corner", "mm", expects="either", k1=(-0.1, -0.5, -2.0, -10.0))
def folding_camera(k1: float) -> Outcome:
    """decoded depth where the lens model has no inverse; against there is none; bound: must be masked"""
    base, none = paper_rig(32), (0.0,) * 4
    camera = replace(base.camera, fx=base.camera.fx / 4, fy=base.camera.fy / 4, distortion=(k1, *none))
    frames, _ = plane_stack(replace(base, camera=replace(camera, distortion=(0.0, *none))))
    x, y = camera.rays()
    without = np.isnan(x) | np.isnan(y)
    decoded = decode_stack(frames, replace(base, camera=camera), direction="vertical")
    given = without & ((decoded.depth_mm != 0) | (decoded.reason == Reason.DECODED))
    note = f"{without.mean():.0%} of the pixels have no ray; the corner {'has none' if without[0, 0] else 'has a ray'}"
    return worst(np.where(given, np.inf, 0.0), 0.0, decoded.depth_mm == 0, note=note)


_IMPOSSIBLE: dict[str, tuple[tuple[Any, ...], Any]] = {
    "mirror": (("rotation",), [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "zero baseline": (("translation_m",), [0.0, 0.0, 0.0]),
    "NaN in rotation": (("rotation", 1, 1), math.nan),
    "infinite focal length": (("camera", "fx"), math.inf),
    "zero focal length": (("projector", "fy"), 0.0),
    "zero matrix": (("rotation",), [[0.0] * 3] * 3),
    "rank 2": (("rotation",), [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]),
}
"""Where in a rig file a change is made, and the value put there."""


@RIG.family("impossible rig", "1", expects="refusal", refuses=RigError, change=_IMPOSSIBLE)
def impossible_rig(change: str) -> None:
    """a rig from a file; against there is no such rig; bound: must be refused"""
    part: Any = (data := PAPER.to_dict())
    (*way, last), value = _IMPOSSIBLE[change]
    for key in way:
        part = part[key]
    part[last] = value
    rig_from_dict(data)


@RIG.family("file round trip", "bits", suffix=(".yaml", ".json"))
def file_round_trip(suffix: str) -> Outcome:
    """a rig of awkward numbers, written and read; against the rig; bound: exact"""
    awkward = (0.1 + 0.2, 1e-17, math.nextafter(0.125, 1.0), 5e-324, -1 / 3)
    rig = replace(
        PAPER,
        camera=replace(PAPER.camera, cx=math.pi * 1e2, cy=2 / 3 * 1e2, distortion=awkward),
        translation_m=(math.nextafter(0.125, 0.0), -0.1 - 1e-17, 1e-300),
        pitch_vertical_px=18 + 2**-48,
        rotation=rotation_matrix((1e-9, 2e-9, -3e-9)).tolist(),
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"rig{suffix}"
        save_rig(rig, path)
        loaded = load_rig(path)
    same = loaded == rig and json.dumps(loaded.to_dict()) == json.dumps(rig.to_dict())
    return Outcome(0.0) if same else wrong()
