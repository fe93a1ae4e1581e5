"""Triangulation with baselines down to 0.01 mm, ranges to 100 m, parallel rays and single precision; rigs with nearly
singular intrinsics, rotations off orthonormal and lenses that fold."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

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
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding.triangulation import depth_from_both, depth_from_coordinate, depth_noise_mm
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.pinhole import Maps, Pinhole, distortion_polynomial, fold_radius_squared, undistort
from fpp_ml_bench.optics.rig import Rig, rotation_matrix
from fpp_ml_bench.optics.sequence import AXES, Direction

TRIANGULATION, RIG = Group("triangulation"), Group("rig")
BASELINES = (160.0, 10.0, 1.0, 0.01)
PAPER = paper_rig(24)
TURN = rotation_matrix((0.05, -0.09, 0.12))
RAYS: Maps = tuple(np.random.default_rng(5).uniform(-0.2, 0.2, (2, 40)))  # type: ignore[assignment]
"""Normalised coordinates of camera rays across the paper's field of view, seeded."""
AHEAD = np.stack([*RAYS, np.ones(40)])
"""The rays as points at z = 1, (3, n)."""


def scaled_baseline(baseline_mm: float, ahead: float = 0.0) -> Rig:
    """The paper's rig with a shorter baseline and the projector ``ahead`` of the camera by that share of it, and then
    turned."""
    t = np.array([*PAPER.translation_m[:2], -ahead * PAPER.baseline_m])
    t *= baseline_mm / MM_PER_M / np.linalg.norm(t)
    return replace(PAPER, rotation=(TURN if ahead else np.eye(3)).tolist(), translation_m=tuple(t.tolist()))


def exact_coordinates(depth_m: float, rig: Rig, points: NDArray = AHEAD) -> Floats:
    """Projector px (2, n) of points at ``depth_m`` on the rays, in 50 digits, rounded once."""
    a, b, c = wide(rig.R) @ wide(points) * depth_m + wide(rig.t)[:, None]
    device = rig.projector
    return np.stack([device.fx * a / c + device.cx, device.fy * b / c + device.cy]).astype(float)


def conditioning(coordinate: NDArray, rig: Rig, axis: int = 0) -> tuple[Floats, Floats]:
    """Bound of the closed form's relative error, and its condition number: sum of magnitudes over |a - x_p a_2|.
    Running error analysis: x_p has 2 roundings; a, a_2 have 3 each of sums of magnitudes; the difference and the top
    cancel; 4 more for the last quotient and the change to mm."""
    t, terms = rig.t, rig.R[:, :, None] * AHEAD
    ideal = (coordinate - rig.projector.centre[axis]) / rig.projector.focal[axis]
    size, a = np.abs(terms).sum(axis=1), terms.sum(axis=1)
    condition = (size[axis] + np.abs(ideal) * size[2]) / np.abs(a[axis] - ideal * a[2])
    above = (np.abs(ideal) * abs(t[2]) + abs(t[axis])) / np.abs(ideal * t[2] - t[axis])
    return U64 * (8 * condition + 5 * above + 4), condition


def exact_depth_mm(coordinate: NDArray, rig: Rig, axis: int = 0) -> NDArray[np.object_]:
    """Depth of these float64 inputs in 50 digits, by the closed form; infinite where ray and plane are parallel."""
    a = wide(rig.R) @ wide(AHEAD)
    ideal = (wide(coordinate) - rig.projector.centre[axis]) / rig.projector.focal[axis]
    bottom = a[axis] - ideal * a[2]
    parallel = bottom == 0
    return np.where(parallel, math.inf, 1000 * (ideal * rig.t[2] - rig.t[axis]) / (bottom + parallel))


def relative(depth_mm: NDArray, exact: NDArray[np.object_]) -> Floats:
    return difference(depth_mm, exact) / np.abs(exact.astype(float))


def closed_form(coordinate: NDArray, rig: Rig, axis: int = 0, indistinct: NDArray | bool = False) -> Outcome:
    """The outcome of depths from one coordinate; the ``indistinct`` ones may be masked."""
    exact, depth_mm = exact_depth_mm(coordinate, rig, axis), depth_from_coordinate(RAYS, coordinate, rig, AXES[axis])
    bound, condition = conditioning(coordinate, rig, axis)
    # Where the bound exceeds half of the depth, the number is round-off and must be as behind the camera.
    nothing = ~(bound < 0.5) | ~(exact.astype(float) > 0)
    error, may_flag = np.where(nothing, np.inf, relative(depth_mm, exact)), float(np.mean(nothing | indistinct))
    return worst(error, bound, np.isnan(depth_mm), may_flag, float(condition.max()))


@TRIANGULATION.family(
    "baseline and range",
    "relative",
    direction=AXES,
    ahead=(0.0, 0.3),
    range_m=(0.3, 1.8, 100.0),
    baseline_mm=BASELINES,
)
def one_coordinate(baseline_mm: float, range_m: float, direction: Direction, ahead: float) -> Outcome:
    """depth from one coordinate, the projector beside the camera, or ahead of it and turned; against the closed form on
    the same float64 inputs in 50 digits; bound: u (8 kappa + 5 kappa_top + 4), kappa = sum of magnitudes over |a - x_p
    a_2|: running error analysis"""
    rig, axis = scaled_baseline(baseline_mm, ahead), AXES.index(direction)
    return closed_form(exact_coordinates(range_m, rig)[axis], rig, axis)


@TRIANGULATION.family("both directions", "relative", ahead=(0.0, 0.3, 1.0), baseline_mm=BASELINES)
def both_coordinates(baseline_mm: float, ahead: float) -> Outcome:
    """depth by weighted least squares of both coordinates; against the point that they were computed from in 50 digits;
    bound: 8 x the larger bound of the closed form: a weighted mean of both, and the coordinates' own rounding"""
    rig = scaled_baseline(baseline_mm, ahead)
    u, v = coordinates = exact_coordinates(1.8, rig)
    depth_mm = depth_from_both(RAYS, u, v, rig, 0.7, 1.3).depth_mm
    bounds, conditions = zip(*(conditioning(px, rig, axis) for axis, px in enumerate(coordinates)), strict=True)
    return worst(
        depth_mm / 1800.0 - 1, 8 * np.maximum(*bounds), np.isnan(depth_mm), condition=float(np.max(conditions))
    )


@TRIANGULATION.family("noise law", "1", direction=AXES, baseline_mm=(160.0, 50.0, 10.0, 1.0))
def noise_law(baseline_mm: float, direction: Direction) -> Outcome:
    """rms depth error over sigma_u Z^2 / (f_p b), minus 1; against rig.md's law; bound: 4 standard errors of 20,000
    draws, and 8 (sigma_Z / Z)^2 of second order"""
    rig, count, modulation, axis = scaled_baseline(baseline_mm), 20_000, 60.0, np.zeros(20_000)
    coordinate = exact_coordinates(1.8, rig, np.array([[0], [0], [1]]))[AXES.index(direction)]
    sigma_px = rig.pitch(direction) * math.sqrt(2 / 18) / modulation / (2 * math.pi)
    noisy = coordinate + sigma_px * np.random.default_rng(8).standard_normal(count)
    errors = depth_from_coordinate((axis, axis), noisy, rig, direction) - 1800.0
    law = float(depth_noise_mm(rig, 1800.0, direction, 18, modulation))
    bound = 4 / math.sqrt(2 * count) + 8 * (law / 1800.0) ** 2
    return worst(np.sqrt(np.mean(errors**2)) / law - 1, bound, condition=1800.0 / law)


@TRIANGULATION.family(
    "nearly parallel rays",
    "relative",
    expects="either",
    shift_px=(10.0, 1.0, 1e-3, 1e-6, 1e-9, 1e-11, 1e-12, 0.0, -1e-6, -1.0),
)
def near_parallel(shift_px: float) -> Outcome:
    """depth of a projector plane this many px from parallel; against the closed form on the same float64 inputs in 50
    digits; bound: u (8 kappa + 5 kappa_top + 4), running error analysis; masked where it lies behind or at infinity"""
    focal, centre = PAPER.projector.fx, PAPER.projector.cx
    coordinate = focal * RAYS[0] + centre + shift_px  # depth f b / shift
    size = (np.abs(coordinate) + centre) / focal + np.abs(RAYS[0])
    return closed_form(coordinate, PAPER, 0, 8 * U64 * size * focal > 0.2 * abs(shift_px))


@TRIANGULATION.family("float32 coordinate", "relative", range_m=(0.3, 1.8, 100.0), baseline_mm=BASELINES)
def single_coordinate(baseline_mm: float, range_m: float) -> Outcome:
    """depth from a coordinate rounded to float32; against depth from the float64 coordinate, 50 digits; bound: 2^-24
    kappa, kappa = u_p / (u_p - u_infinity)"""
    rig = scaled_baseline(baseline_mm)
    coordinate, focal, centre = exact_coordinates(range_m, rig)[0], rig.projector.fx, rig.projector.cx
    depth_mm = depth_from_coordinate(RAYS, coordinate.astype(np.float32), rig, "vertical")
    condition = np.abs(coordinate) / np.abs(coordinate - centre - focal * RAYS[0])
    bound = 1.001 * U32 * condition / (1 - U32 * condition)
    error = relative(depth_mm, exact_depth_mm(coordinate, rig))
    return worst(error, bound, np.isnan(depth_mm), condition=float(condition.max()))


@TRIANGULATION.family("impossible coordinates", "mm", expects="either", value=(1e308, -1e308, 1e16, math.inf, math.nan))
def overflowing(value: float) -> Outcome:
    """depth from coordinates that no projector has; against finite and positive, or masked; bound: must be masked where
    there is no depth"""
    u = np.full(40, value)
    depths = np.stack([depth_from_coordinate(RAYS, u, PAPER, "vertical"), depth_from_both(RAYS, u, u, PAPER).depth_mm])
    return worst(np.where(np.isfinite(depths) & (depths > 0), 0.0, np.inf), 0.0, np.isnan(depths))


@RIG.family(
    "intrinsic matrix",
    "px",
    expects=lambda focal_px, centre_px: (
        "number" if max(2 * centre_px**2 / focal_px, focal_px) / 960 < 2.0**24 else "either"
    ),
    centre_px=(479.5, 1e6, 1e16),
    focal_px=(2e3, 1.0, 1e-3, 1e-6, 1e-12, 1e-300, 5e-324, 1e8, 1e12, 1e300),
)
def intrinsics(focal_px: float, centre_px: float) -> Outcome:
    """pixel to ray and back; against the pixel; bound: 3 u (|u - c| + |c|) + u |u|; refused from a condition number of
    2^26 on, half of the digits"""
    camera, u = Pinhole(960, 960, focal_px, focal_px, centre_px, centre_px), np.linspace(-0.5, 959.5, 97)
    if not np.isfinite(camera.rays()).all():
        return wrong("rays that are not finite")
    size = np.abs(u - centre_px) + abs(centre_px)
    back = camera.pixels(*camera.normalised(u, u))[0]
    return worst(back - u, 3 * U64 * size + U64 * np.abs(u), condition=float(np.max(size / 960)))


@RIG.family(
    "rotation off orthonormal",
    "relative",
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
    depth_mm = depth_from_coordinate(RAYS, coordinate, rig, "vertical")
    rounding, condition = conditioning(coordinate, base)
    # Each row of R moves by off at most: the difference a - x_p a_2 by off times the condition number, twice.
    bound = rounding + 2 * off * condition
    return worst(depth_mm / 1800.0 - 1, bound / (1 - bound), np.isnan(depth_mm), condition=float(condition.max()))


@RIG.family(
    "rotation vector",
    "1",
    angle_rad=(0.0, 1e-300, 1e-12, 1e-4, 1.0, math.pi, math.tau, 1e3, 1e8, 1e12, 1e15),
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


@RIG.family("tangential lens inverse", "1", k1=(-0.2,), k2=(0.0,), k3=(0.0,), p1=(0.001, 0.01, 0.05, 0.1, 0.3))
@RIG.family("lens inverse", "1", k1=(-0.1, -0.8, -5.0, 0.6, 100.0), k2=(0.0, 0.9, -1.5), k3=(0.0, -0.3), p1=(0.0,))
def lens_inverse(k1: float, k2: float, k3: float, p1: float) -> Outcome:
    """ideal points of distorted ones; against the ideal points, where the model is one to one from the axis on; bound:
    32 u / least slope of the model, a residual of some roundings; no ideal point for twice the largest image"""
    lens = (k1, k2, p1, -p1, k3)
    fold = math.sqrt(fold_radius_squared(lens))
    radius, turn = np.linspace(0, min(fold, 1.6), 82)[1:-1, None], np.arange(16) * math.tau / 16
    x, y = radius * np.cos(turn), radius * np.sin(turn)
    xd, yd = distortion_polynomial(x, y, lens)
    # The derivatives by complex steps are exact, and their matrix is symmetric.
    (jxx, jxy), (_, jyy) = (
        [part.imag * 1e30 for part in distortion_polynomial(x + dx, y + dy, lens)]
        for dx, dy in ((1e-30j, 0), (0, 1e-30j))
    )
    slope = (jxx + jyy) / 2 - np.hypot((jxx - jyy) / 2, jxy)
    right = np.minimum.accumulate(slope) > 1e-3
    size = np.hypot(xd, yd)
    back = undistort(xd, yd, lens)
    error = np.where(right, np.hypot(back[0] - x, back[1] - y), 0.0)
    nowhere = undistort(2 * size.max() * np.cos(turn), 2 * size.max() * np.sin(turn), lens)[0]
    if fold < 1.6 and not np.isnan(nowhere).all():
        return wrong("an ideal point beyond the fold")
    bound = 32 * U64 * np.maximum(size, 1) / np.where(right, slope, 1.0)
    return worst(error, bound, right & np.isnan(error), condition=float(1 / slope[right].min()))
