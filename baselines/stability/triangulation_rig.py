"""Triangulation with baselines down to 0.01 mm, ranges to 100 m, parallel rays, wrong sides and single precision; rigs
with nearly singular intrinsics, rotations off orthonormal and lenses that fold."""

import json
import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench import decoding, optics
from fpp_ml_bench.baselines.phase_route import CalibrationLayer
from fpp_ml_bench.baselines.stability.cases import (
    U32,
    U64,
    Floats,
    Group,
    Outcome,
    difference,
    high_precision,
    masked,
    rounded,
    worst,
    wrong,
)
from fpp_ml_bench.baselines.stability.phase_order import inside_pattern, plane_stack
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.loaders.render import Lighting, light_surface

TRIANGULATION, RIG = Group("triangulation"), Group("rig")
BASELINES = (160.0, 50.0, 10.0, 1.0, 0.1, 0.01)
DIRECTIONS: tuple[optics.Direction, ...] = ("vertical", "horizontal")
_TURN = (0.05, -0.09, 0.12)
_WEIGHTS = (0.7, 1.3)


def scaled_baseline(baseline_mm: float, ahead: float = 0.0, turned: bool = False) -> optics.Rig:
    """The paper's rig with a shorter baseline and the projector ``ahead`` of the camera by that share of it."""
    rig = optics.paper_rig(24)
    t = np.array([*rig.translation_m[:2], -ahead * rig.baseline_m])
    t *= baseline_mm / MM_PER_M / np.linalg.norm(t)
    turn = optics.rotation_matrix(_TURN) if turned else np.eye(3)
    return replace(rig, rotation=turn.tolist(), translation_m=(float(t[0]), float(t[1]), float(t[2])))


def rays(count: int = 40) -> optics.Maps:
    """Normalised coordinates of camera rays across the paper's field of view, seeded."""
    rng = np.random.default_rng(5)
    return rng.uniform(-0.2, 0.2, count), rng.uniform(-0.2, 0.2, count)


def _optics(rig: optics.Rig, axis: int) -> tuple[float, float]:
    """Focal length and principal point of the projector in px, along an axis."""
    device = rig.projector
    return (device.fx, device.fy)[axis], (device.cx, device.cy)[axis]


def _turned(mp: Any, rig: optics.Rig, x: float, y: float) -> list:
    """A ray in the projector's axes, in 50 digits."""
    ray = (mp.mpf(float(x)), mp.mpf(float(y)), mp.mpf(1))
    return [mp.fsum(mp.mpf(float(rig.R[i, j])) * ray[j] for j in range(3)) for i in range(3)]


def _ideal(mp: Any, rig: optics.Rig, coordinate: float, axis: int) -> Any:
    """A projector coordinate without focal length and principal point, in 50 digits."""
    focal, centre = _optics(rig, axis)
    return (mp.mpf(float(coordinate)) - mp.mpf(centre)) / mp.mpf(focal)


def exact_coordinates(ray_maps: optics.Maps, depth_m: float, rig: optics.Rig) -> tuple[Floats, Floats]:
    """Projector px of points at ``depth_m`` on the rays, in 50 digits, rounded once."""
    mp = high_precision()
    device, u, v = rig.projector, [], []
    for x, y in zip(*ray_maps, strict=True):
        p = [a * depth_m + mp.mpf(float(t)) for a, t in zip(_turned(mp, rig, x, y), rig.t, strict=True)]
        u.append(mp.mpf(device.fx) * p[0] / p[2] + mp.mpf(device.cx))
        v.append(mp.mpf(device.fy) * p[1] / p[2] + mp.mpf(device.cy))
    return rounded(u), rounded(v)


def _exact_depth(ray_maps: optics.Maps, coordinate: NDArray, rig: optics.Rig, axis: int) -> list:
    """Depth in mm of these float64 inputs in 50 digits, by the closed form."""
    mp = high_precision()
    depths = []
    for x, y, w in zip(*ray_maps, coordinate, strict=True):
        a, ideal = _turned(mp, rig, x, y), _ideal(mp, rig, w, axis)
        bottom = a[axis] - ideal * a[2]
        top = ideal * mp.mpf(float(rig.t[2])) - mp.mpf(float(rig.t[axis]))
        depths.append(1000 * top / bottom if bottom != 0 else mp.inf)
    return depths


def relative(depth_mm: NDArray, exact: list) -> Floats:
    """Relative error of depths, against high-precision numbers."""
    return difference(depth_mm, exact) / np.abs(rounded(exact))


def conditioning(ray_maps: optics.Maps, coordinate: NDArray, rig: optics.Rig, axis: int) -> tuple[NDArray, NDArray]:
    """Bound of the closed form's relative error, and its condition number: sum of magnitudes over |a - x_p a_2|.

    Running error analysis: x_p has 2 roundings; a, a_2 have 3 each of sums of magnitudes; the difference and the top
    cancel; 4 more for the last quotient and the change to mm.
    """
    x, y = ray_maps
    focal, centre = _optics(rig, axis)
    ideal = (coordinate - centre) / focal
    size = [np.abs(row[0]) * np.abs(x) + np.abs(row[1]) * np.abs(y) + np.abs(row[2]) for row in rig.R]
    a = [row[0] * x + row[1] * y + row[2] for row in rig.R]
    condition = (size[axis] + np.abs(ideal) * size[2]) / np.abs(a[axis] - ideal * a[2])
    above = (np.abs(ideal) * abs(rig.t[2]) + abs(rig.t[axis])) / np.abs(ideal * rig.t[2] - rig.t[axis])
    return U64 * (8 * condition + 5 * above + 4), condition


def one_coordinate(baseline_mm: float, range_m: float, direction: optics.Direction, turned: bool = False) -> Outcome:
    rig = scaled_baseline(baseline_mm, 0.3 if turned else 0.0, turned)
    ray_maps, axis = rays(), DIRECTIONS.index(direction)
    coordinate = exact_coordinates(ray_maps, range_m, rig)[axis]
    depth_mm = decoding.depth_from_coordinate(ray_maps, coordinate, rig, direction)
    bound, condition = conditioning(ray_maps, coordinate, rig, axis)
    error = relative(depth_mm, _exact_depth(ray_maps, coordinate, rig, axis))
    return worst(error, bound, np.isnan(depth_mm), condition=float(condition.max()))


_CLOSED = (
    "depth from one coordinate{}; against the closed form on the same float64 inputs in 50 digits; bound: u (8 kappa + "
    "5 kappa_top + 4), kappa = sum of magnitudes over |a - x_p a_2|: running error analysis"
)
TRIANGULATION.family(
    "baseline", "relative", about=_CLOSED.format(" at 1.8 m"), direction=DIRECTIONS, range_m=(1.8,),
    baseline_mm=BASELINES,
)(one_coordinate)  # fmt: skip
TRIANGULATION.family(
    "range", "relative", about=_CLOSED.format(""), direction=DIRECTIONS, baseline_mm=(160.0,),
    range_m=(0.3, 1.0, 1.8, 5.0, 20.0, 100.0),
)(one_coordinate)  # fmt: skip
TRIANGULATION.family(
    "short baseline and long range", "relative", about=_CLOSED.format(""), direction=("vertical",),
    baseline_mm=(1.0, 0.01), range_m=(20.0, 100.0),
)(one_coordinate)  # fmt: skip
TRIANGULATION.family(
    "turned projector ahead of the camera", "relative", about=_CLOSED.format(", general pose"), direction=DIRECTIONS,
    range_m=(0.3, 1.8, 100.0), baseline_mm=(160.0, 0.01), turned=(1,),
)(one_coordinate)  # fmt: skip


def _least_squares(ray_maps: optics.Maps, u: NDArray, v: NDArray, rig: optics.Rig) -> tuple[list, NDArray, NDArray]:
    """Depth mm that minimises the weighted misfit, by Newton in 50 digits; contraction of Gauss-Newton; its start's
    relative error."""
    mp = high_precision()
    device, wu, wv = rig.projector, mp.mpf(_WEIGHTS[0]), mp.mpf(_WEIGHTS[1])
    t = [mp.mpf(float(value)) for value in rig.t]
    depths, contraction, start = [], [], []
    for x, y, pu, pv in zip(*ray_maps, u, v, strict=True):
        a = _turned(mp, rig, x, y)
        measured = [_ideal(mp, rig, pu, 0), _ideal(mp, rig, pv, 1)]
        c = [f * (a[i] - measured[i] * a[2]) for i, f in enumerate((device.fx, device.fy))]
        d = [f * (measured[i] * t[2] - t[i]) for i, f in enumerate((device.fx, device.fy))]
        w = first = (wu * c[0] * d[0] + wv * c[1] * d[1]) / (wu * d[0] ** 2 + wv * d[1] ** 2)
        for _ in range(15):
            q = a[2] + t[2] * w
            r = [(c[i] - d[i] * w) / q for i in range(2)]
            g = [(d[i] + r[i] * t[2]) / q for i in range(2)]  # -dr/dw
            h = [2 * t[2] * g[i] / q for i in range(2)]  # d2r/dw2
            slope = wu * r[0] * g[0] + wv * r[1] * g[1]
            square = wu * g[0] ** 2 + wv * g[1] ** 2
            bend = wu * r[0] * h[0] + wv * r[1] * h[1]
            w += slope / (square + bend)
        depths.append(1000 / w)
        contraction.append(abs(float(bend / square)))
        start.append(abs(float((first - w) / w)))
    return depths, np.array(contraction), np.array(start)


@TRIANGULATION.family(
    "both directions", "relative", expects="either", noise_px=(0.0, 0.5), ahead=(0.0, 0.3, 1.0),
    baseline_mm=BASELINES[:4],
)  # fmt: skip
def both_coordinates(baseline_mm: float, ahead: float, noise_px: float) -> Outcome:
    """depth by weighted least squares of both coordinates; against the minimum, by Newton's method in 50 digits; bound:
    8 x the closed form's bound + start error x (Gauss-Newton contraction + 4 start error)^3"""
    rig, ray_maps = scaled_baseline(baseline_mm, ahead, True), rays(16)
    rng = np.random.default_rng(6)
    u, v = (axis + noise_px * rng.standard_normal(axis.shape) for axis in exact_coordinates(ray_maps, 1.8, rig))
    exact, contraction, start = _least_squares(ray_maps, u, v, rig)
    depth_mm = decoding.depth_from_both(ray_maps, u, v, rig, *_WEIGHTS).depth_mm
    in_front = rounded(exact) > 0
    bounds, conditions = zip(*(conditioning(ray_maps, axis, rig, i) for i, axis in enumerate((u, v))), strict=True)
    bound = 8 * np.maximum(*bounds) + start * (contraction + 4 * start) ** 3
    error = np.where(in_front, relative(depth_mm, exact), 0.0)
    condition = float(np.max(conditions))
    return worst(error, bound, np.isnan(depth_mm), float(np.mean(~in_front)), condition)


@TRIANGULATION.family("noise law", "1", direction=DIRECTIONS, baseline_mm=BASELINES)
def noise_law(baseline_mm: float, direction: optics.Direction) -> Outcome:
    """rms depth error over sigma_u Z^2 / (f_p b), minus 1; or the share without depth, minus Phi; against rig.md's law;
    where noise is over a fifth of the depth, the normal law of inverse depth; bound: 4 standard errors of 20,000 draws,
    and 8 (sigma_Z / Z)^2 of second order"""
    rig = scaled_baseline(baseline_mm)
    count, depth_m, modulation = 20_000, 1.8, 60.0
    coordinate = exact_coordinates((np.zeros(1), np.zeros(1)), depth_m, rig)[DIRECTIONS.index(direction)][0]
    sigma_px = rig.pitch(direction) * math.sqrt(2 / 18) / modulation / (2 * math.pi)
    noisy = coordinate + sigma_px * np.random.default_rng(8).standard_normal(count)
    depths_mm = decoding.depth_from_coordinate((np.zeros(count), np.zeros(count)), noisy, rig, direction)
    law = float(decoding.depth_noise_mm(rig, depth_m * MM_PER_M, direction, 18, modulation))
    share = law / (depth_m * MM_PER_M)
    if share < 0.2:
        rms = float(np.sqrt(np.mean((depths_mm - depth_m * MM_PER_M) ** 2)))
        return Outcome(abs(rms / law - 1), 4 / math.sqrt(2 * count) + 8 * share**2, condition=1 / share)
    # Inverse depth is exactly linear in u: it is negative, and there is no depth, with the probability Phi(-1/share).
    nowhere = 0.5 * math.erfc(1 / share / math.sqrt(2))
    bound = 4 * math.sqrt(nowhere * (1 - nowhere) / count) + 1 / count
    return Outcome(abs(float(np.isnan(depths_mm).mean()) - nowhere), bound, condition=1 / share)


@TRIANGULATION.family(
    "nearly parallel rays", "relative", expects="either",
    shift_px=(10.0, 1.0, 1e-3, 1e-6, 1e-9, 1e-11, 1e-12, 0.0, -1e-6, -1.0),
)  # fmt: skip
def near_parallel(shift_px: float) -> Outcome:
    """depth of a projector plane this many px from parallel; against the closed form on the same float64 inputs in 50
    digits; bound: u (8 kappa + 5 kappa_top + 4), kappa = sum of magnitudes over |a - x_p a_2|: running error analysis;
    masked where it lies behind"""
    rig, ray_maps = optics.paper_rig(24), rays()
    focal, centre = _optics(rig, 0)
    coordinate = focal * ray_maps[0] + centre + shift_px  # depth f b / shift, up to a point at infinity
    exact = _exact_depth(ray_maps, coordinate, rig, 0)
    depth_mm = decoding.depth_from_coordinate(ray_maps, coordinate, rig, "vertical")
    bound, condition = conditioning(ray_maps, coordinate, rig, 0)
    # Where the bound exceeds half of the depth, the number is round-off and must be masked, as behind the camera.
    nothing = ~(bound < 0.5) | ~(rounded(exact) > 0)
    error = np.where(nothing, np.inf, relative(depth_mm, exact))
    size = (np.abs(coordinate) + centre) / focal + np.abs(ray_maps[0])
    may_flag = float(np.mean(nothing | (8 * U64 * size * focal > 0.2 * abs(shift_px))))
    return worst(error, bound, np.isnan(depth_mm), may_flag, condition=float(np.max(condition)))


@TRIANGULATION.family("point at infinity", "mm", expects="refusal")
def point_at_infinity() -> Outcome:
    """depth where ray and projector plane are exactly parallel; against there is none; bound: must be masked"""
    rig, ray_maps = optics.paper_rig(24), (np.array([0.0, 0.125, -0.25]), np.zeros(3))  # where its coordinate is exact
    coordinate = rig.projector.fx * ray_maps[0] + rig.projector.cx
    return masked(np.isnan(decoding.depth_from_coordinate(ray_maps, coordinate, rig, "vertical")))


@TRIANGULATION.family("far plane through the decoder", "mm", expects="refusal", range_m=(0.3, 1.0, 3.2, 20.0, 100.0))
def decoded_far(range_m: float) -> Outcome:
    """decoded depth of a plane outside the working range; against the working range; bound: must be masked"""
    rig = optics.paper_rig(32)
    frames, exact = plane_stack(rig, range_m)  # at the farthest its parallax is under a hundredth of a pixel
    inside = inside_pattern(rig, exact)
    depth_mm = decoding.decode_stack(frames, rig, mask=inside).depth_mm[inside]
    return worst(depth_mm, 0.0, depth_mm == 0, 1.0)


@TRIANGULATION.family("behind the projector", "mm", expects="refusal", ahead_m=(0.5, 1.0, 3.0))
def behind_projector(ahead_m: float) -> Outcome:
    """depth of points that lie behind a projector ahead of the camera; against there is none; bound: must be masked"""
    rig, ray_maps = replace(optics.paper_rig(24), translation_m=(0.125, -0.1, -ahead_m)), rays()
    points = np.stack([*ray_maps, np.ones(len(ray_maps[0]))], axis=1) * (0.5 * ahead_m) + rig.t
    mirrored = rig.projector.fx * points[:, 0] / points[:, 2] + rig.projector.cx
    return masked(np.isnan(decoding.depth_from_coordinate(ray_maps, mirrored, rig, "vertical")))


@TRIANGULATION.family("projector behind the surface", "grey", expects="refusal")
def lit_from_behind() -> Outcome:
    """projector light on a surface lit from its far side; against none reaches the camera; bound: exactly 0, so the
    decoder masks it for want of modulation"""
    turn = optics.rotation_matrix((0.0, math.pi, 0.0))
    centre = np.array([-0.125, 0.1, 3.0])
    rig = replace(optics.paper_rig(24), rotation=turn.tolist(), translation_m=tuple((-turn @ centre).tolist()))
    x, y = rays()
    points = np.stack([x, y, np.ones(len(x))], axis=1) * 1.8
    lit = light_surface(points, np.broadcast_to([0.0, 0.0, -1.0], points.shape), rig, Lighting())
    return worst(lit.gain, 0.0, lit.gain == 0)


@TRIANGULATION.family(
    "float32 coordinate", "relative", expects="either", range_m=(0.3, 1.8, 100.0), baseline_mm=BASELINES
)
def single_coordinate(baseline_mm: float, range_m: float) -> Outcome:
    """depth from a coordinate rounded to float32; against depth from the float64 coordinate, 50 digits; bound: 2^-24
    kappa, kappa = u_p / (u_p - u_infinity); not checked where that is over 1/2"""
    rig, ray_maps = scaled_baseline(baseline_mm), rays()
    coordinate = exact_coordinates(ray_maps, range_m, rig)[0]
    depth_mm = decoding.depth_from_coordinate(ray_maps, coordinate.astype(np.float32), rig, "vertical")
    focal, centre = _optics(rig, 0)
    slope = np.abs(coordinate) / focal / np.abs((coordinate - centre) / focal - ray_maps[0])
    shift = slope * U32
    bound = np.where(shift < 0.5, shift / (1 - np.minimum(shift, 0.5)), 1.0) * 1.001
    error = np.where(shift < 0.5, relative(depth_mm, _exact_depth(ray_maps, coordinate, rig, 0)), 0.0)
    return worst(error, bound, np.isnan(depth_mm), float(np.mean(shift >= 0.5)), condition=float(slope.max()))


@TRIANGULATION.family("float32 calibration layer", "relative", range_m=(0.3, 1.8, 100.0), baseline_mm=BASELINES)
def single_layer(baseline_mm: float, range_m: float) -> Outcome:
    """depth by the phase route's calibration layer in float32; against the depth put in; bound: 2^-24 (sum of phase
    magnitudes / |psi| + 6)"""
    ray_maps = rays()
    layer = CalibrationLayer.of(scaled_baseline(baseline_mm), "vertical", ray_maps)
    total = layer.absolute_phase(np.full(len(ray_maps[0]), range_m * MM_PER_M))
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
    rounding = condition * U32 + 6 * U32
    useless = rounding >= 0.5
    error = np.where(useless, 0.0, depth_mm / (range_m * MM_PER_M) - 1)
    bound = np.where(useless, 1.0, rounding / (1 - np.minimum(rounding, 0.5)))
    return worst(error, bound, condition=float(condition.max()))


@TRIANGULATION.family(
    "impossible coordinates", "mm", expects="either", value=(1e308, -1e308, 1e16, float("inf"), float("nan"))
)
def overflowing(value: float) -> Outcome:
    """depth from coordinates that no projector has; against finite and positive, or masked; bound: must be masked where
    there is no depth"""
    rig, ray_maps = optics.paper_rig(24), rays()
    u = np.full(ray_maps[0].shape, value)
    from_both = decoding.depth_from_both(ray_maps, u, u, rig).depth_mm
    depths = decoding.depth_from_coordinate(ray_maps, u, rig, "vertical"), from_both
    legal = [np.isnan(depth) | (np.isfinite(depth) & (depth > 0)) for depth in depths]
    return worst(np.where(np.all(legal, axis=0), 0.0, np.inf), 0.0, np.isnan(depths).all(axis=0), 1.0)


@TRIANGULATION.family("no weight", "mm", expects="refusal")
def no_weight() -> Outcome:
    """depth from two directions without modulation; against there is none; bound: must be masked"""
    rig, ray_maps = optics.paper_rig(24), rays()
    u, v = exact_coordinates(ray_maps, 1.8, rig)
    return masked(np.isnan(decoding.depth_from_both(ray_maps, u, v, rig, 0.0, 0.0).depth_mm))


def intrinsics(focal_px: float, centre_px: float) -> Outcome:
    camera = optics.Pinhole(960, 960, focal_px, focal_px, centre_px, centre_px)
    u = np.linspace(-0.5, 959.5, 97)
    if not all(np.isfinite(axis).all() for axis in camera.rays()):
        return Outcome(math.inf, 1.0, note="rays that are not finite")
    back = camera.pixels(*camera.normalised(u, u))[0]
    bound = 3 * U64 * (np.abs(u - centre_px) + abs(centre_px)) + U64 * np.abs(u)
    return worst(back - u, bound, condition=float(np.max((np.abs(u - centre_px) + abs(centre_px)) / 960)))


_BACK = (
    "pixel to ray and back; against the pixel; bound: 3 u (|u - c| + |c|) + u |u|; refused from a condition number of "
    "2^26 on"
)
RIG.family(
    "intrinsic matrix", "px", about=_BACK + ", half of the digits", refuses=RigError,
    expects=lambda focal_px, centre_px: "number" if 1e-3 <= focal_px <= 1e8 else "either",
    centre_px=(479.5,), focal_px=(2e3, 1.0, 1e-3, 1e-6, 1e-8, 1e-12, 1e-300, 5e-324, 1e8, 1e12, 1e300),
)(intrinsics)  # fmt: skip
RIG.family(
    "far principal point", "px", about=_BACK, refuses=RigError,
    expects=lambda focal_px, centre_px: "number" if centre_px <= 1e6 else "either",
    focal_px=(2e3,), centre_px=(1e3, 1e6, 1e12, 1e16),
)(intrinsics)  # fmt: skip


@RIG.family(
    "rotation off orthonormal", "relative", refuses=RigError,
    expects=lambda kind, off: "number" if off < 1e-6 else "refusal",
    kind=("scaled", "sheared"), off=(0.0, 1e-9, 1e-7, 9.9e-7, 1.1e-6, 1e-4, 1e-2),
)  # fmt: skip
def off_orthonormal(off: float, kind: str) -> Outcome:
    """depth through this matrix; against depth through the rotation, 1800 mm; bound: 2 |R R^T - I| kappa + round-off;
    over 1e-6 a rig is refused"""
    turn = optics.rotation_matrix(_TURN)
    base = replace(optics.paper_rig(24), rotation=turn.tolist())
    if kind == "scaled":  # R R^T - I is (1 + s)^2 - 1
        matrix = turn * (1 + off / 2)
    else:  # R R^T - I is off between the first two rows
        matrix = turn.copy()
        matrix[0] += off * turn[1]
    rig, ray_maps = replace(base, rotation=matrix.tolist()), rays()
    coordinate = exact_coordinates(ray_maps, 1.8, base)[0]
    depth_mm = decoding.depth_from_coordinate(ray_maps, coordinate, rig, "vertical")
    rounding, condition = conditioning(ray_maps, coordinate, base, 0)
    # Each row of R moves by off at most: the difference a - x_p a_2 by off times the condition number, twice.
    bound = rounding + 2 * off * condition
    return worst(depth_mm / 1800.0 - 1, bound / (1 - bound), np.isnan(depth_mm), condition=float(condition.max()))


@RIG.family(
    "rotation vector", "1", refuses=RigError, expects=lambda angle_rad: "number" if angle_rad <= 1e8 else "either",
    angle_rad=(0.0, 1e-300, 1e-12, 1e-4, 1.0, 3.141592653589793, 6.283185307179586, 1e3, 1e8, 1e12, 1e15),
)  # fmt: skip
def rotation_vector(angle_rad: float) -> Outcome:
    """rotation matrix by Rodrigues' formula; against the same formula in 50 digits; bound: 8 u (1 + angle): the angle
    carries its own rounding; refused where that is over 1e-6"""
    vector = np.array([0.48, -0.6, 0.64]) * angle_rad
    matrix = optics.rotation_matrix(tuple(vector.tolist()))
    replace(optics.paper_rig(24), rotation=matrix.tolist())  # which may refuse it
    mp = high_precision()
    x, y, z = (mp.mpf(float(value)) for value in vector)
    angle = mp.sqrt(x * x + y * y + z * z)
    cross = mp.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    first = mp.sin(angle) / angle if angle != 0 else mp.mpf(1)
    second = (1 - mp.cos(angle)) / angle**2 if angle != 0 else mp.mpf(0.5)
    exact = mp.eye(3) + first * cross + second * cross * cross
    return worst(difference(matrix.ravel(), list(exact)), 8 * U64 * (1 + angle_rad), condition=angle_rad)


def lens_inverse(k1: float, k2: float, k3: float) -> Outcome:
    """ideal radius of distorted ones up to 1.6; against bisection in 50 digits below the fold; bound: 32 u / slope of
    the model: a residual of some roundings; masked where no point maps there"""
    coefficients = (k1, k2, 0.0, 0.0, k3)
    fold = math.sqrt(optics.fold_radius_squared(coefficients))
    radius = np.linspace(0.0, 1.6, 81)[1:]
    turn = 0.7
    radii = np.hypot(*optics.undistort(radius * math.cos(turn), radius * math.sin(turn), coefficients))
    mp = high_precision()

    def forward(r: Any) -> Any:
        r2 = r * r
        return r * (1 + r2 * (mp.mpf(k1) + r2 * (mp.mpf(k2) + r2 * mp.mpf(k3))))

    largest = forward(mp.mpf(fold)) if math.isfinite(fold) else mp.inf
    exact, slopes, exists = [], [], []
    for distorted in radius:
        target = mp.mpf(float(distorted))
        exists.append(bool(target < largest))
        low, high = mp.mpf(0), mp.mpf(fold) if math.isfinite(fold) else mp.mpf(4)
        for _ in range(80 if exists[-1] else 1):
            middle = (low + high) / 2
            low, high = (middle, high) if forward(middle) < target else (low, middle)
        exact.append(low)
        slopes.append(max(float(mp.diff(forward, low)) if exists[-1] else 1.0, 1e-9))
    invertible, slope = np.array(exists), np.array(slopes)
    error = np.where(invertible, radii - rounded(exact), np.where(np.isnan(radii), 0.0, np.inf))
    near = np.abs(radius - float(largest)) < 1e-3 if math.isfinite(fold) else np.zeros(len(radius), bool)
    may_flag = float(np.mean(~invertible | near))
    return worst(error, 32 * U64 / slope, np.isnan(radii), may_flag, condition=float(1 / slope[invertible].min()))


RIG.family("lens inverse, k1", "1", k1=(-0.1, -0.3, -1.0, -5.0, 0.5, 5.0, 100.0), k2=(0.0,), k3=(0.0,))(lens_inverse)
RIG.family("lens inverse, several terms", "1", k1=(-0.8, 0.6), k2=(0.9, -1.5), k3=(-0.3, 2.0))(lens_inverse)


@RIG.family("tangential lens", "1", expects="either", p1=(0.001, 0.01, 0.05, 0.1, 0.3))
def tangential(p1: float) -> Outcome:
    """ideal points of a grid under tangential distortion; against Newton continuation from the axis in 200 steps;
    another branch is no answer; bound: 32 u / least slope of the model there: a residual of some roundings"""
    coefficients = (-0.2, 0.0, p1, -p1, 0.0)
    grid = np.linspace(-0.8, 0.8, 33)
    xd, yd = (axis.ravel() for axis in np.meshgrid(grid, grid))
    x, y = optics.undistort(xd, yd, coefficients)
    finite = np.isfinite(x)
    residual = np.hypot(*(a - b for a, b in zip(optics.distort(x, y, coefficients), (xd, yd), strict=True)))
    px, py = np.zeros_like(xd), np.zeros_like(yd)
    lost = np.zeros(xd.shape, bool)
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
    right = ~lost & (px * px + py * py < optics.fold_radius_squared(coefficients))
    trace = jxx + jyy
    slope = (trace - np.sqrt(np.maximum(trace * trace - 4 * determinant, 0))) / 2  # the Jacobian is symmetric
    off = np.where(right, np.hypot(x - px, y - py), np.inf)  # no solution off that branch
    bound = np.where(right, 32 * U64 / np.maximum(slope, 1e-6), 1.0)
    return worst(np.where(finite, np.maximum(off, residual), 0.0), bound, ~finite, float(np.mean(~right)))


@RIG.family("lens without inverse at the corner", "mm", expects="either", k1=(-0.1, -0.5, -2.0, -10.0))
def folding_camera(k1: float) -> Outcome:
    """decoded depth where the lens model has no inverse; against there is none; bound: must be masked"""
    base = optics.paper_rig(32)
    camera = replace(base.camera, fx=base.camera.fx / 4, fy=base.camera.fy / 4, distortion=(k1, 0.0, 0.0, 0.0, 0.0))
    frames, _ = plane_stack(replace(base, camera=replace(camera, distortion=(0.0,) * 5)))
    x, y = camera.rays()
    without = np.isnan(x) | np.isnan(y)
    decoded = decoding.decode_stack(frames, replace(base, camera=camera), direction="vertical")
    given = without & ((decoded.depth_mm != 0) | (decoded.reason == decoding.Reason.DECODED))
    note = f"{without.mean():.0%} of the pixels have no ray; the corner {'has none' if without[0, 0] else 'has a ray'}"
    return worst(np.where(given, np.inf, 0.0), 0.0, decoded.depth_mm == 0, 1.0, note=note)


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
def impossible_rig(change: str) -> Outcome:
    """a rig from a file; against there is no such rig; bound: must be refused"""
    data: Any = optics.paper_rig(24).to_dict()
    (*way, last), value = _IMPOSSIBLE[change]
    part = data
    for key in way:
        part = part[key]
    part[last] = value
    optics.rig_from_dict(data)
    return Outcome(0.0)


@RIG.family("file round trip", "bits", suffix=(".yaml", ".json"))
def file_round_trip(suffix: str) -> Outcome:
    """a rig of awkward numbers, written and read; against the rig; bound: exact"""
    base = optics.paper_rig(24)
    awkward = (0.1 + 0.2, 1e-17, math.nextafter(0.125, 1.0), 5e-324, -1 / 3)
    camera = replace(base.camera, cx=math.pi * 1e2, cy=2 / 3 * 1e2, distortion=awkward)
    rig = replace(
        base, camera=camera, translation_m=(math.nextafter(0.125, 0.0), -0.1 - 1e-17, 1e-300),
        rotation=optics.rotation_matrix((1e-9, 2e-9, -3e-9)).tolist(), pitch_vertical_px=18 + 2**-48,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"rig{suffix}"
        optics.save_rig(rig, path)
        loaded = optics.load_rig(path)
    same = loaded == rig and json.dumps(loaded.to_dict()) == json.dumps(rig.to_dict())
    return Outcome(0.0) if same else wrong()
