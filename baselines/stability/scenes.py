"""Scenes with walls edge-on, needles, one to ten million triangles, and the camera inside the object; crossed fringes
that are dim, clipped, or whose second direction is lost; rivals on the truth."""

import math
from dataclasses import replace

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from fpp_ml_bench.baselines.phase.depth import CrossedRoute, Reason
from fpp_ml_bench.baselines.stability.cases import U64, Floats, Group, Outcome, worst, wrong
from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.decoding.blocks import projected
from fpp_ml_bench.loaders.render.illumination import light_surface, projector_centre_m
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.render.projector import PatternLight
from fpp_ml_bench.loaders.render.raycast import PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import SolidMesh
from fpp_ml_bench.optics.named_rigs import crossed_rig, paper_rig
from fpp_ml_bench.optics.rig import Rig

SCENES, CROSSED = Group("scenes"), Group("crossed")
RIG = paper_rig(176)
DISTANCE_M = 1.8


def seen(vertices_m: ArrayLike, faces: ArrayLike = ((0, 1, 2), (0, 2, 3))) -> tuple[Floats, Floats]:
    """What the camera sees of a mesh, of a quadrilateral without ``faces``: the rays that hit, (n, 3), at z = 1, and
    their depth in m, (n,)."""
    vertices = np.asarray(vertices_m, dtype=np.float64)
    mesh = SolidMesh("mesh", vertices, np.asarray(faces, dtype=np.int32))
    hits = TracedObject(mesh, vertices).primary(PixelRays.of(RIG.camera))
    x, y = RIG.camera.rays()
    return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)[hits.pixels], hits.depth_m


@SCENES.family(
    "wall edge-on",
    "m",
    expects=lambda off_deg: "number" if off_deg >= 1 else "either",
    off_deg=(90.0, 30.0, 5.0, 1.0, 0.3, 0.1, 0.01, 1e-4, 0.0),
)
def edge_on(off_deg: float) -> Outcome:
    """depth of a wall at this angle to the line of sight; against ray and plane in 80-bit arithmetic, clipped to the
    wall's own extent; bound: 264 u kappa, kappa = sum |n d| over |n . d|; never beyond that extent"""
    # The line of sight of one pixel column; the wall is 0.2 m high and 0.2 m deep.
    middle = np.array([RIG.camera.rays()[0][0, 100], 0.0, 1.0]) * DISTANCE_M
    sight = middle / np.linalg.norm(middle)
    turn = math.radians(off_deg)
    along = math.cos(turn) * sight + math.sin(turn) * np.array([sight[2], 0.0, -sight[0]])
    up = np.array([0.0, 0.1, 0.0])
    corners = [middle + s * 0.1 * along + r * up for s, r in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    rays, depth_m = seen(corners)
    if not depth_m.size:  # thinner than the gap between two pixel columns
        return worst(0.0, flagged=True)
    wide = np.asarray(corners, dtype=np.longdouble)
    normal = np.cross(wide[1] - wide[0], wide[2] - wide[0])
    terms, low, high = normal * rays, wide[:, 2].min(), wide[:, 2].max()
    facing = terms.sum(axis=1)
    exact = np.clip(normal @ wide[0] / facing, low, high)
    condition = (np.abs(terms).sum(axis=1) / np.abs(facing)).astype(float)
    # Rounding of normal (12), plane (6) and products (4), times the condition; clipped to the wall's own extent, which
    # also bounds the error of a ray on the wrong side of an edge.
    bound = np.minimum(22 * U64 * condition * 1.9 * 12, float(high - low))
    return worst(np.asarray(depth_m - exact, float), bound, condition=float(condition.max()))


@SCENES.family("needle", "px", centre_px=(0.0, 0.3), width_px=(2.5, 1.0, 0.9, 0.5, 0.1, 0.01))
def needle(width_px: float, centre_px: float) -> Outcome:
    """pixel columns of an upright strip, and its depth; against the columns that it covers; bound: exact, for no edge
    is within 1e-9 px of a pixel's centre; depth 64 u x 1.8 m"""
    camera, column = RIG.camera, 90.0 + centre_px
    left, right = ((column + side * width_px / 2 - camera.cx) / camera.fx * DISTANCE_M for side in (-1, 1))
    rays, depth_m = seen([[x, y, DISTANCE_M] for x, y in ((left, -1), (right, -1), (right, 1), (left, 1))])
    count = (np.abs(np.arange(camera.width) - column) < width_px / 2).sum() * camera.height
    off_px = np.abs(rays[:, 0] * camera.fx + camera.cx - column)
    outside = (off_px > width_px / 2).sum() + abs(count - depth_m.size)
    return worst(np.append(depth_m - DISTANCE_M, outside), np.append(0 * depth_m + 64 * U64 * DISTANCE_M, 0))


@SCENES.family("number of triangles", "m", heavy=lambda count: count > 1e6, count=(2.0, 1e2, 1e4, 1e6, 1e7))
def triangles(count: float) -> Outcome:
    """depth of a paraboloid of this number of triangles; against the paraboloid, closed form; bound: chord error 1.3
    step^2 / 2 and 64 u x 1.8 m"""
    side = math.isqrt(round(count) // 2)
    y, x = np.meshgrid(*[np.linspace(-0.3, 0.3, side + 1)] * 2)
    number = np.arange((side + 1) ** 2, dtype=np.int32).reshape(x.shape)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = np.concatenate([np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))])
    rays, depth_m = seen(np.stack([x, y, 1.7 + x**2 + y**2], axis=-1).reshape(-1, 3), faces)
    # Z = 1.7 + Z^2 (x^2 + y^2), the nearer root, without cancellation.
    exact = 2 * 1.7 / (1 + np.sqrt(1 - 4 * 1.7 * (rays[:, :2] ** 2).sum(axis=1)))
    central = (np.abs(rays[:, :2]) < 0.15).all(axis=1)  # 0.28 m at the farthest
    if central.sum() != (np.abs(RIG.camera.rays()) < 0.15).all(axis=0).sum():
        return wrong("pixels see nothing")
    # A facet lies between the surface and step^2 / 4 (f'' = 2, both axes) off.
    return worst((depth_m - exact)[central], (0.6 / side) ** 2 / 2 * 1.3 + 64 * U64 * DISTANCE_M)


@SCENES.family("camera inside the object", "m", turn_deg=(0.0, 45.0, 10.0, 89.9))
def camera_inside(turn_deg: float) -> Outcome:
    """depth of the walls of a 2 m box around the camera; against 1 / max |d|, closed form; bound: 64 u"""
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    turn = trimesh.transformations.rotation_matrix(math.radians(turn_deg), [0, 1, 0])[:3, :3]
    rays, depth_m = seen(box.vertices @ turn.T, box.faces)
    if depth_m.size != RIG.camera.width * RIG.camera.height:
        return wrong("rays leave a closed box")
    return worst(depth_m - 1 / np.abs(rays @ turn).max(axis=1), 64 * U64)


@SCENES.family("light at distance 0", "grey", distance_m=(0.0, 1e-200, 1e-6, 1e-2))
def light_at_projector(distance_m: float) -> Outcome:
    """light on a point so far ahead of the projector's centre; against finite and not negative; bound: must be
    finite"""
    light, point = named_light("paper"), np.add(projector_centre_m(RIG), [[0.0, 0.0, distance_m]])
    gain = light_surface(point, np.array([[0.0, 0.0, -1.0]]), RIG, light, PatternLight.of(RIG, light.projector)).gain
    return worst(np.where(np.isfinite(gain) & (gain >= 0), 0.0, math.inf))


CROSSED_RIG = replace(crossed_rig(320), background_m=None)
CARRIERS: Crossed = CROSSED_RIG.crossed  # type: ignore[assignment]
DEPTH_M, AMBIENT, NOISE = 1.78, 6.0, 0.7
MIDDLE = slice(120, 200), slice(120, 200)
"""Pixels that are judged: no window of theirs leaves the mask."""


def plane_outcome(
    family: Crossed, white: float = 160.0, rig: Rig = CROSSED_RIG, measured_as: Crossed | None = None
) -> Outcome:
    """The worst pixel of a plane that ``family`` lights, flagged where the route gives a reason or no depth.
    ``measured_as``: the family that the route takes it for."""
    u, v = projected(rig.camera.rays(), DEPTH_M, rig)
    pairs = zip(family.weights, family.cycles_per_px, strict=True)
    waves = sum(weight * np.cos(2 * np.pi * (a * u + b * v)) for weight, (a, b) in pairs)
    noise = np.random.default_rng(4).normal(0, NOISE, u.shape)
    grey = np.clip(np.rint(AMBIENT + white * (0.5 + 0.5 * waves) + noise), 0, 255).astype(np.uint8)
    mask = np.zeros(u.shape, bool)
    mask[60:260, 60:260] = True
    route = CrossedRoute(rig, family=measured_as or family)
    measured = route.measure(grey, mask)
    depth_mm, exact_mm = measured.depth_mm[MIDDLE], DEPTH_M * 1000
    flagged = (depth_mm == 0) | (measured.reason[MIDDLE] != Reason.MEASURED)
    bound_mm = float(np.median(route.carriers.mm_per_rad(np.full(u.shape, exact_mm)))) * math.pi / 2
    return worst(depth_mm - exact_mm, bound_mm, flagged)


@CROSSED.family(
    "dim or saturated",
    "mm",
    expects=lambda white: "number" if 40 <= white <= 220 else "either",
    white=(2000.0, 600.0, 400.0, 300.0, 260.0, 220.0, 160.0, 80.0, 40.0, 20.0, 10.0, 5.0, 2.0, 0.0),
)
def exposed(white: float) -> Outcome:
    """depth of a plane at this grey level of white, noise 0.7, its crests clipped at 255; against the plane's depth,
    closed form; bound: pi / 2 of the joint phase: a rival order is further off, and a pixel that may be one must say
    so"""
    return plane_outcome(CARRIERS, white)


@CROSSED.family(
    "one direction lost",
    "mm",
    expects=lambda weight: "number" if weight >= 0.3 else "either",
    weight=(0.5, 0.3, 0.1, 0.05, 0.02, 1e-9),
)
def lost(weight: float) -> Outcome:
    """depth of a plane whose second carrier has this weight, and not the 0.5 that the route knows of; against the
    plane's depth, closed form; bound: pi / 2 of the joint phase"""
    return plane_outcome(replace(CARRIERS, weights=(0.5, weight)), measured_as=CARRIERS)


@CROSSED.family("a rival on the truth", "mm", expects="either", ratio=(0.5, 1 / 3, 0.25, 0.2))
def rival(ratio: float) -> Outcome:
    """depth of a plane by periods of 12 px whose gains have this ratio, over four and more periods: with 1 / 2 and 1 /
    3 another order fits exactly; against the plane's depth, closed form; bound: pi / 2 of the joint phase"""
    turn_deg = math.degrees(math.atan(ratio))
    along_deg = 128.66  # of the paper's epipolar lines
    return plane_outcome(Crossed((12.0, 12.0), (along_deg + turn_deg, along_deg - 90 + turn_deg)))


@CROSSED.family("baseline along one axis", "mm", expects="either", angle_deg=(0.0, 20.0, 45.0))
def along_one_axis(angle_deg: float) -> Outcome:
    """depth of a plane where the projector is above the camera and the carriers are turned by this angle: at 0 the
    second carrier tells no depth; against the plane's depth, closed form; bound: pi / 2 of the joint phase"""
    rig = replace(CROSSED_RIG, translation_m=(0.0, -0.16, 0.0))
    return plane_outcome(Crossed((18.0, 18.0), (angle_deg, angle_deg + 90)), rig=rig)
