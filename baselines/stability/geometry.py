"""Triangulation with baselines down to 0.01 mm, ranges to 100 m, parallel rays and single
precision; rigs with nearly singular intrinsics, rotations off orthonormal and lenses that fold;
scenes with walls edge-on, needles, one to ten million triangles, and the camera inside the
object."""

import math
from dataclasses import replace

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.baselines.stability.cases import (
    U32,
    U64,
    Floats,
    Outcome,
    difference,
    family,
    high_precision,
    wide,
    worst,
    wrong,
)
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding.triangulation import (
    depth_from_both,
    depth_from_coordinate,
    depth_noise_mm,
)
from fpp_ml_bench.loaders.render.illumination import light_surface, projector_centre_m
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.render.projector import PatternLight
from fpp_ml_bench.loaders.render.raycast import PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import SolidMesh
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.pinhole import (
    Maps,
    Pinhole,
    distortion_polynomial,
    fold_radius_squared,
    undistort,
)
from fpp_ml_bench.optics.rig import Rig, rotation_matrix
from fpp_ml_bench.optics.sequence import AXES, Direction

BASELINES = (160.0, 10.0, 1.0, 0.01)
"""Baselines in mm: from the paper's 160 down to one that hardly tells a depth."""
PAPER = paper_rig(24)
TURN = rotation_matrix((0.05, -0.09, 0.12))
RAYS: Maps = tuple(np.random.default_rng(5).uniform(-0.2, 0.2, (2, 40)))  # type: ignore[assignment]
"""Normalised coordinates of camera rays across the paper's field of view, seeded."""
AHEAD = np.stack([*RAYS, np.ones(40)])
"""The rays as points at z = 1, (3, n)."""


def scaled_baseline(baseline_mm: float, ahead: float = 0.0) -> Rig:
    """The paper's rig with a shorter baseline and the projector ``ahead`` of the camera by that
    share of it, and then turned."""
    t = np.array([*PAPER.translation_m[:2], -ahead * PAPER.baseline_m])
    t *= baseline_mm / MM_PER_M / np.linalg.norm(t)
    return replace(
        PAPER, rotation=(TURN if ahead else np.eye(3)).tolist(), translation_m=tuple(t.tolist())
    )


def exact_coordinates(depth_m: float, rig: Rig, rays: NDArray = AHEAD) -> Floats:
    """Projector px (2, n) of the points at ``depth_m`` on the ``rays`` (3, n), in 50 digits,
    rounded once."""
    a, b, c = wide(rig.R) @ wide(rays) * depth_m + wide(rig.t)[:, None]
    device = rig.projector
    return np.stack([device.fx * a / c + device.cx, device.fy * b / c + device.cy]).astype(float)


def conditioning(coordinate: NDArray, rig: Rig, axis: int = 0) -> tuple[Floats, Floats]:
    """Bound of the closed form's relative error, and its condition number: sum of magnitudes over
    |a - x_p a_2|. Running error analysis: x_p has 2 roundings; a, a_2 have 3 each of sums of
    magnitudes; the difference and the top cancel; 4 more for the last quotient and the change to
    mm."""
    t, terms = rig.t, rig.R[:, :, None] * AHEAD
    ideal = (coordinate - rig.projector.centre[axis]) / rig.projector.focal[axis]
    size, a = np.abs(terms).sum(axis=1), terms.sum(axis=1)
    condition = (size[axis] + np.abs(ideal) * size[2]) / np.abs(a[axis] - ideal * a[2])
    above = (np.abs(ideal) * abs(t[2]) + abs(t[axis])) / np.abs(ideal * t[2] - t[axis])
    return U64 * (8 * condition + 5 * above + 4), condition


def exact_depth_mm(coordinate: NDArray, rig: Rig, axis: int = 0) -> NDArray[np.object_]:
    """Depth of these float64 inputs in 50 digits, by the closed form; infinite where ray and plane
    are parallel."""
    a = wide(rig.R) @ wide(AHEAD)
    ideal = (wide(coordinate) - rig.projector.centre[axis]) / rig.projector.focal[axis]
    bottom = a[axis] - ideal * a[2]
    parallel = bottom == 0
    return np.where(
        parallel, math.inf, 1000 * (ideal * rig.t[2] - rig.t[axis]) / (bottom + parallel)
    )


def relative(depth_mm: NDArray, exact: NDArray[np.object_]) -> Floats:
    return difference(depth_mm, exact) / np.abs(exact.astype(float))


def closed_form(
    coordinate: NDArray, rig: Rig, axis: int = 0, indistinct: NDArray | bool = False
) -> Outcome:
    """The outcome of depths from one coordinate; the ``indistinct`` ones may be masked."""
    exact, depth_mm = (
        exact_depth_mm(coordinate, rig, axis),
        depth_from_coordinate(RAYS, coordinate, rig, AXES[axis]),
    )
    bound, condition = conditioning(coordinate, rig, axis)
    # Where the bound exceeds half of the depth, the number is round-off and must be as behind the
    # camera.
    nothing = ~(bound < 0.5) | ~(exact.astype(float) > 0)
    error, flagged = (
        np.where(nothing, np.inf, relative(depth_mm, exact)),
        np.isnan(depth_mm) & (nothing | indistinct),
    )
    return worst(error, bound, flagged, condition)


@family(
    "triangulation",
    "baseline and range",
    "relative",
    against="the closed form on the same float64 inputs in 50 digits",
    bound=(
        "u (8 kappa + 5 kappa_top + 4), kappa = sum of magnitudes over |a - x_p a_2|: running "
        "error analysis"
    ),
    direction=AXES,
    ahead=(0.0, 0.3),
    range_m=(0.3, 1.8, 100.0),
    baseline_mm=BASELINES,
)
def one_coordinate(
    baseline_mm: float, range_m: float, direction: Direction, ahead: float
) -> Outcome:
    """depth from one coordinate, the projector beside the camera, or ahead of it and turned"""
    rig, axis = scaled_baseline(baseline_mm, ahead), AXES.index(direction)
    return closed_form(exact_coordinates(range_m, rig)[axis], rig, axis)


@family(
    "triangulation",
    "both directions",
    "relative",
    against="the point that they were computed from in 50 digits",
    bound=(
        "8 x the larger bound of the closed form: a weighted mean of both, and the coordinates' "
        "own rounding"
    ),
    ahead=(0.0, 0.3, 1.0),
    baseline_mm=BASELINES,
)
def both_coordinates(baseline_mm: float, ahead: float) -> Outcome:
    """depth by weighted least squares of both coordinates"""
    rig = scaled_baseline(baseline_mm, ahead)
    u, v = coordinates = exact_coordinates(1.8, rig)
    depth_mm = depth_from_both(RAYS, u, v, rig, 0.7, 1.3).depth_mm
    bounds, conditions = zip(
        *(conditioning(px, rig, axis) for axis, px in enumerate(coordinates)), strict=True
    )
    return worst(depth_mm / 1800.0 - 1, 8 * np.maximum(*bounds), condition=conditions)


@family(
    "triangulation",
    "nearly parallel rays",
    "relative",
    against="the closed form on the same float64 inputs in 50 digits",
    bound=(
        "u (8 kappa + 5 kappa_top + 4), running error analysis; masked where it lies behind or at "
        "infinity"
    ),
    expects="either",
    shift_px=(10.0, 1.0, 1e-3, 1e-6, 1e-9, 1e-11, 1e-12, 0.0, -1e-6, -1.0),
)
def near_parallel(shift_px: float) -> Outcome:
    """depth of a projector plane this many px from parallel"""
    focal, centre = PAPER.projector.fx, PAPER.projector.cx
    coordinate = focal * RAYS[0] + centre + shift_px  # depth f b / shift
    size = (np.abs(coordinate) + centre) / focal + np.abs(RAYS[0])
    return closed_form(coordinate, PAPER, 0, 8 * U64 * size * focal > 0.2 * abs(shift_px))


@family(
    "triangulation",
    "noise law",
    "1",
    against="sigma_u Z^2 / (f_p b), the noise of a coordinate propagated to the depth",
    bound="4 standard errors of 20,000 draws, and 8 (sigma_Z / Z)^2 of second order",
    direction=AXES,
    baseline_mm=(160.0, 50.0, 10.0, 1.0),
)
def noise_law(baseline_mm: float, direction: Direction) -> Outcome:
    """rms depth error over the stated one, minus 1"""
    rig, count, modulation, axis = scaled_baseline(baseline_mm), 20_000, 60.0, np.zeros(20_000)
    coordinate = exact_coordinates(1.8, rig, np.array([[0], [0], [1]]))[AXES.index(direction)]
    sigma_px = rig.pitch(direction) * math.sqrt(2 / 18) / modulation / (2 * math.pi)
    noisy = coordinate + sigma_px * np.random.default_rng(8).standard_normal(count)
    errors = depth_from_coordinate((axis, axis), noisy, rig, direction) - 1800.0
    law = float(depth_noise_mm(rig, 1800.0, direction, 18, modulation))
    bound = 4 / math.sqrt(2 * count) + 8 * (law / 1800.0) ** 2
    return worst(np.sqrt(np.mean(errors**2)) / law - 1, bound, condition=1800.0 / law)


@family(
    "triangulation",
    "float32 coordinate",
    "relative",
    against="depth from the float64 coordinate, 50 digits",
    bound="2^-24 kappa, kappa = u_p / (u_p - u_infinity)",
    range_m=(0.3, 1.8, 100.0),
    baseline_mm=BASELINES,
)
def single_coordinate(baseline_mm: float, range_m: float) -> Outcome:
    """depth from a coordinate rounded to float32"""
    rig = scaled_baseline(baseline_mm)
    coordinate, focal, centre = (
        exact_coordinates(range_m, rig)[0],
        rig.projector.fx,
        rig.projector.cx,
    )
    depth_mm = depth_from_coordinate(RAYS, coordinate.astype(np.float32), rig, "vertical")
    condition = np.abs(coordinate) / np.abs(coordinate - centre - focal * RAYS[0])
    bound = 1.001 * U32 * condition / (1 - U32 * condition)
    error = relative(depth_mm, exact_depth_mm(coordinate, rig))
    return worst(error, bound, condition=condition)


@family(
    "triangulation",
    "impossible coordinates",
    "mm",
    against="finite and positive, or masked",
    bound="must be masked where there is no depth",
    expects="either",
    value=(1e308, -1e308, 1e16, math.inf, math.nan),
)
def overflowing(value: float) -> Outcome:
    """depth from coordinates that no projector has"""
    u = np.full(40, value)
    depths = np.stack(
        [
            depth_from_coordinate(RAYS, u, PAPER, "vertical"),
            depth_from_both(RAYS, u, u, PAPER).depth_mm,
        ]
    )
    return worst(np.where(np.isfinite(depths) & (depths > 0), 0.0, np.inf), 0.0, np.isnan(depths))


@family(
    "rig",
    "intrinsic matrix",
    "px",
    against="the pixel",
    bound=(
        "3 u (|u - c| + |c|) + u |u|; refused from a condition number of 2^26 on, half of the "
        "digits"
    ),
    expects=lambda focal_px, centre_px: (
        "number" if max(2 * centre_px**2 / focal_px, focal_px) / 960 < 2.0**24 else "either"
    ),
    centre_px=(479.5, 1e6, 1e16),
    focal_px=(2e3, 1.0, 1e-3, 1e-6, 1e-12, 1e-300, 5e-324, 1e8, 1e12, 1e300),
)
def intrinsics(focal_px: float, centre_px: float) -> Outcome:
    """pixel to ray and back"""
    camera, u = (
        Pinhole(960, 960, focal_px, focal_px, centre_px, centre_px),
        np.linspace(-0.5, 959.5, 97),
    )
    if not np.isfinite(camera.rays()).all():
        return wrong("rays that are not finite")
    size = np.abs(u - centre_px) + abs(centre_px)
    back = camera.pixels(*camera.normalised(u, u))[0]
    return worst(back - u, 3 * U64 * size + U64 * np.abs(u), condition=size / 960)


@family(
    "rig",
    "rotation off orthonormal",
    "relative",
    against="depth through the rotation, 1800 mm",
    bound="2 |R R^T - I| kappa + round-off; over 1e-6 a rig is refused",
    kind=("scaled", "sheared"),
    off=(0.0, 1e-9, 1e-7, 9.9e-7, 1.1e-6, 1e-4, 1e-2),
    expects=lambda kind, off: "number" if off < 1e-6 else "refusal",
)
def off_orthonormal(off: float, kind: str) -> Outcome:
    """depth through this matrix"""
    # R R^T - I is (1 + s)^2 - 1 or off between the first two rows.
    matrix = TURN * (1 + off / 2) if kind == "scaled" else TURN + np.outer([off, 0, 0], TURN[1])
    base, rig = (replace(PAPER, rotation=turn.tolist()) for turn in (TURN, matrix))
    coordinate = exact_coordinates(1.8, base)[0]
    depth_mm = depth_from_coordinate(RAYS, coordinate, rig, "vertical")
    rounding, condition = conditioning(coordinate, base)
    # Each row of R moves by off at most: the difference a - x_p a_2 by off times the condition
    # number, twice.
    bound = rounding + 2 * off * condition
    return worst(depth_mm / 1800.0 - 1, bound / (1 - bound), condition=condition)


@family(
    "rig",
    "rotation vector",
    "1",
    against="the same formula in 50 digits",
    bound="8 u (1 + angle): the angle carries its own rounding; refused where that is over 1e-6",
    angle_rad=(0.0, 1e-300, 1e-12, 1e-4, 1.0, math.pi, math.tau, 1e3, 1e8, 1e12, 1e15),
    expects=lambda angle_rad: "number" if angle_rad <= 1e8 else "either",
)
def rotation_vector(angle_rad: float) -> Outcome:
    """rotation matrix by Rodrigues' formula"""
    vector = np.array([0.48, -0.6, 0.64]) * angle_rad
    matrix = rotation_matrix(tuple(vector.tolist()))
    replace(PAPER, rotation=matrix.tolist())  # which may refuse it
    mp, (x, y, z) = high_precision(), wide(vector)
    angle, cross = mp.sqrt(x * x + y * y + z * z), np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    # sin(angle) / angle and (1 - cos(angle)) / angle^2
    exact = np.eye(3) + mp.sinc(angle) * cross + mp.sinc(angle / 2) ** 2 / 2 * (cross @ cross)
    return worst(difference(matrix, exact), 8 * U64 * (1 + angle_rad), condition=angle_rad)


@family(
    "rig",
    "tangential lens inverse",
    "1",
    against="the ideal points, where the model is one to one from the axis on",
    bound=(
        "32 u / least slope of the model, a residual of some roundings; no ideal point for twice "
        "the largest image"
    ),
    k1=(-0.2,),
    k2=(0.0,),
    k3=(0.0,),
    p1=(0.001, 0.01, 0.05, 0.1, 0.3),
)
@family(
    "rig",
    "lens inverse",
    "1",
    against="the ideal points, where the model is one to one from the axis on",
    bound=(
        "32 u / least slope of the model, a residual of some roundings; no ideal point for twice "
        "the largest image"
    ),
    k1=(-0.1, -0.8, -5.0, 0.6, 100.0),
    k2=(0.0, 0.9, -1.5),
    k3=(0.0, -0.3),
    p1=(0.0,),
)
def lens_inverse(k1: float, k2: float, k3: float, p1: float) -> Outcome:
    """ideal points of distorted ones"""
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
    return worst(error, bound, condition=1 / slope[right])


SCENE_RIG = paper_rig(176)
"""The paper's rig with images of 176 px, on which meshes are traced quickly."""
DISTANCE_M = 1.8
"""Distance of the traced scenes in m: the paper's standoff."""


def seen(vertices_m: ArrayLike, faces: ArrayLike = ((0, 1, 2), (0, 2, 3))) -> tuple[Floats, Floats]:
    """What the camera sees of a mesh, of a quadrilateral without ``faces``: the rays that hit, (n,
    3), at z = 1, and their depth in m, (n,)."""
    vertices = np.asarray(vertices_m, dtype=np.float64)
    mesh = SolidMesh("mesh", vertices, np.asarray(faces, dtype=np.int32))
    hits = TracedObject(mesh, vertices).primary(PixelRays.of(SCENE_RIG.camera))
    x, y = SCENE_RIG.camera.rays()
    return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)[hits.pixels], hits.depth_m


@family(
    "scenes",
    "wall edge-on",
    "m",
    against="ray and plane in 80-bit arithmetic, clipped to the wall's own extent",
    bound="264 u kappa, kappa = sum |n d| over |n . d|; never beyond that extent",
    expects=lambda off_deg: "number" if off_deg >= 1 else "either",
    off_deg=(90.0, 30.0, 5.0, 1.0, 0.3, 0.1, 0.01, 1e-4, 0.0),
)
def edge_on(off_deg: float) -> Outcome:
    """depth of a wall at this angle to the line of sight"""
    # The line of sight of one pixel column; the wall is 0.2 m high and 0.2 m deep.
    middle = np.array([SCENE_RIG.camera.rays()[0][0, 100], 0.0, 1.0]) * DISTANCE_M
    sight = middle / np.linalg.norm(middle)
    turn = math.radians(off_deg)
    along = math.cos(turn) * sight + math.sin(turn) * np.array([sight[2], 0.0, -sight[0]])
    up = np.array([0.0, 0.1, 0.0])
    corners = [middle + s * 0.1 * along + r * up for s, r in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    rays, depth_m = seen(corners)
    if not depth_m.size:  # thinner than the gap between two pixel columns
        return worst(0.0, flagged=True)
    exact_corners = np.asarray(corners, dtype=np.longdouble)
    normal = np.cross(exact_corners[1] - exact_corners[0], exact_corners[2] - exact_corners[0])
    terms, low, high = normal * rays, exact_corners[:, 2].min(), exact_corners[:, 2].max()
    facing = terms.sum(axis=1)
    exact = np.clip(normal @ exact_corners[0] / facing, low, high)
    condition = (np.abs(terms).sum(axis=1) / np.abs(facing)).astype(float)
    # Rounding of normal (12), plane (6) and products (4), times the condition; clipped to the
    # wall's own extent, which also bounds the error of a ray on the wrong side of an edge.
    bound = np.minimum(22 * U64 * condition * 1.9 * 12, float(high - low))
    return worst(np.asarray(depth_m - exact, float), bound, condition=condition)


@family(
    "scenes",
    "needle",
    "px",
    against="the columns that it covers",
    bound="exact, for no edge is within 1e-9 px of a pixel's centre; depth 64 u x 1.8 m",
    centre_px=(0.0, 0.3),
    width_px=(2.5, 1.0, 0.9, 0.5, 0.1, 0.01),
)
def needle(width_px: float, centre_px: float) -> Outcome:
    """pixel columns of an upright strip, and its depth"""
    camera, column = SCENE_RIG.camera, 90.0 + centre_px
    left, right = (
        (column + side * width_px / 2 - camera.cx) / camera.fx * DISTANCE_M for side in (-1, 1)
    )
    rays, depth_m = seen(
        [[x, y, DISTANCE_M] for x, y in ((left, -1), (right, -1), (right, 1), (left, 1))]
    )
    count = (np.abs(np.arange(camera.width) - column) < width_px / 2).sum() * camera.height
    off_px = np.abs(rays[:, 0] * camera.fx + camera.cx - column)
    outside = (off_px > width_px / 2).sum() + abs(count - depth_m.size)
    return worst(
        np.append(depth_m - DISTANCE_M, outside), np.append(0 * depth_m + 64 * U64 * DISTANCE_M, 0)
    )


@family(
    "scenes",
    "number of triangles",
    "m",
    against="the paraboloid, closed form",
    bound="chord error 1.3 step^2 / 2 and 64 u x 1.8 m",
    heavy=lambda count: count > 1e6,
    count=(2.0, 1e2, 1e4, 1e6, 1e7),
)
def triangles(count: float) -> Outcome:
    """depth of a paraboloid of this number of triangles"""
    side = math.isqrt(round(count) // 2)
    y, x = np.meshgrid(*[np.linspace(-0.3, 0.3, side + 1)] * 2)
    number = np.arange((side + 1) ** 2, dtype=np.int32).reshape(x.shape)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = np.concatenate(
        [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]
    )
    rays, depth_m = seen(np.stack([x, y, 1.7 + x**2 + y**2], axis=-1).reshape(-1, 3), faces)
    # Z = 1.7 + Z^2 (x^2 + y^2), the nearer root, without cancellation.
    exact = 2 * 1.7 / (1 + np.sqrt(1 - 4 * 1.7 * (rays[:, :2] ** 2).sum(axis=1)))
    central = (np.abs(rays[:, :2]) < 0.15).all(axis=1)  # 0.28 m at the farthest
    if central.sum() != (np.abs(SCENE_RIG.camera.rays()) < 0.15).all(axis=0).sum():
        return wrong("pixels see nothing")
    # A facet lies between the surface and step^2 / 4 (f'' = 2, both axes) off.
    return worst((depth_m - exact)[central], (0.6 / side) ** 2 / 2 * 1.3 + 64 * U64 * DISTANCE_M)


@family(
    "scenes",
    "camera inside the object",
    "m",
    against="1 / max |d|, closed form",
    bound="64 u",
    turn_deg=(0.0, 45.0, 10.0, 89.9),
)
def camera_inside(turn_deg: float) -> Outcome:
    """depth of the walls of a 2 m box around the camera"""
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    turn = trimesh.transformations.rotation_matrix(math.radians(turn_deg), [0, 1, 0])[:3, :3]
    rays, depth_m = seen(box.vertices @ turn.T, box.faces)
    if depth_m.size != SCENE_RIG.camera.width * SCENE_RIG.camera.height:
        return wrong("rays leave a closed box")
    return worst(depth_m - 1 / np.abs(rays @ turn).max(axis=1), 64 * U64)


@family(
    "scenes",
    "light at distance 0",
    "grey",
    against="finite and not negative",
    bound="must be finite",
    distance_m=(0.0, 1e-200, 1e-6, 1e-2),
)
def light_at_projector(distance_m: float) -> Outcome:
    """light on a point so far ahead of the projector's centre"""
    light, point = (
        named_light("paper"),
        np.add(projector_centre_m(SCENE_RIG), [[0.0, 0.0, distance_m]]),
    )
    gain = light_surface(
        point,
        np.array([[0.0, 0.0, -1.0]]),
        SCENE_RIG,
        light,
        PatternLight.of(SCENE_RIG, light.projector),
    ).gain
    return worst(np.where(np.isfinite(gain) & (gain >= 0), 0.0, math.inf))
