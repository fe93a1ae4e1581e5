"""Scenes with walls edge-on, needles, broken meshes, one to ten million triangles, and the camera inside the object;
crossed fringes that are dim, clipped, painted, or whose second direction is lost; rivals on the truth."""

import math
from dataclasses import replace

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.baselines.crossed_route.carriers import Carriers
from fpp_ml_bench.baselines.crossed_route.observation import CrossedReason
from fpp_ml_bench.baselines.crossed_route.route import CrossedRoute
from fpp_ml_bench.baselines.stability.cases import U64, Floats, Group, Outcome, worst, wrong
from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.errors import FppBenchError, MeshError
from fpp_ml_bench.loaders.render.illumination import light_surface, projector_centre_m
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.render.projector import PatternLight
from fpp_ml_bench.loaders.render.raycast import Hits, PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import SolidMesh, place
from fpp_ml_bench.optics.named_rigs import crossed_rig, paper_rig
from fpp_ml_bench.optics.rig import Rig

SCENES = Group("scenes")
RIG = paper_rig(176)
AHEAD_M = np.array([0.0, 0.0, 1.8])
EDGE_PX = 1e-9
"""Within this of a triangle's edge, a ray may be decided either way: 2^-53 of coordinates up to 2 m, a thousand times
over, at 419 px focal length."""


def seen(vertices_m: ArrayLike, faces: ArrayLike = ((0, 1, 2), (0, 2, 3))) -> Hits:
    """What the camera sees of a mesh, of a quadrilateral without ``faces``."""
    vertices = np.asarray(vertices_m, dtype=np.float64)
    mesh = SolidMesh("mesh", vertices, np.asarray(faces, dtype=np.int32))
    return TracedObject(mesh, vertices).primary(PixelRays.of(RIG.camera))


def rays_of(hits: Hits) -> Floats:
    """The rays that hit, (n, 3), at z = 1."""
    x, y = RIG.camera.rays()
    return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)[hits.pixels]


def image(hits: Hits) -> Floats:
    """Depth (H, W) in metres, 0 = nothing."""
    depth = np.zeros((RIG.camera.height, RIG.camera.width))
    depth.flat[hits.pixels] = hits.depth_m
    return depth


@SCENES.family(
    "wall edge-on",
    "m",
    expects=lambda off_deg: "number" if off_deg >= 1 else "either",
    off_deg=(90.0, 30.0, 5.0, 1.0, 0.3, 0.1, 0.01, 1e-4, 0.0),
)
def edge_on(off_deg: float) -> Outcome:
    """depth of a wall at this angle to the line of sight; against ray and plane in 80-bit arithmetic; bound: 264 u
    kappa, kappa = sum |n d| over |n . d|; never beyond the wall's own extent"""
    # The line of sight of one pixel column; the wall is 0.2 m high and 0.2 m deep.
    middle = np.array([RIG.camera.rays()[0][0, 100] * 1.8, 0.0, 1.8])
    sight = middle / np.linalg.norm(middle)
    turn = math.radians(off_deg)
    along = math.cos(turn) * sight + math.sin(turn) * np.array([sight[2], 0.0, -sight[0]])
    up = np.array([0.0, 0.1, 0.0])
    corners = [middle + s * 0.1 * along + r * up for s, r in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    hits = seen(corners)
    if not len(hits.pixels):
        # The whole wall is then thinner than the gap between two pixel columns.
        width_px = float(abs(corners[0][0] / corners[0][2] - corners[1][0] / corners[1][2]) * RIG.camera.fx)
        unseen = Outcome(None, flagged=1.0, note=f"no pixel sees it: it is {width_px:.2g} px wide")
        return unseen if width_px < 1 else wrong("a wall of a pixel's width is not seen")
    wide = np.asarray(corners, dtype=np.longdouble)
    normal = np.cross(wide[1] - wide[0], wide[2] - wide[0])
    terms = normal * rays_of(hits)
    facing, low, high = terms.sum(axis=1), float(wide[:, 2].min()), float(wide[:, 2].max())
    exact = (normal @ wide[0] / facing).astype(float)
    condition = (np.abs(terms).sum(axis=1) / np.abs(facing)).astype(float)
    # Rounding of normal (12), plane (6) and products (4), times the condition; clipped to the wall's own extent, which
    # also bounds the error of a ray on the wrong side of an edge.
    bound = np.minimum(22 * U64 * condition * 1.9 * 12, high - low)
    outside = (exact < low) | (exact > high)
    bound = np.minimum(np.where(outside, EDGE_PX / RIG.camera.fx * condition * 1.9 + bound, bound), high - low)
    error = np.where(outside, np.minimum(np.abs(hits.depth_m - low), np.abs(hits.depth_m - high)), hits.depth_m - exact)
    return worst(error, bound, condition=float(condition.max()))


@SCENES.family("needle", "px, m", centre_px=(0.0, 0.3), width_px=(2.5, 1.0, 0.9, 0.5, 0.1, 0.01))
def needle(width_px: float, centre_px: float) -> Outcome:
    """pixels of an upright strip at 1.8 m, and their depth; against the columns that it covers; bound: exact where no
    edge is within 1e-9 px of a centre; depth 64 u"""
    camera, half, column = RIG.camera, 0.1, 90.0 + centre_px
    left, right = ((column + side * width_px / 2 - camera.cx) / camera.fx * 1.8 for side in (-1, 1))
    hits = seen([[left, -half, 1.8], [right, -half, 1.8], [right, half, 1.8], [left, half, 1.8]])
    depth_m = image(hits)
    off_px = np.abs(np.arange(camera.width) - column)
    rows = np.abs(camera.rays()[1][:, 0]) * 1.8 < half - 2e-4
    missing = (depth_m[rows][:, off_px < width_px / 2 - EDGE_PX] == 0).sum()
    extra = (depth_m[:, ~(off_px < width_px / 2 + EDGE_PX)] > 0).sum()
    return worst([missing + extra, np.abs(hits.depth_m - 1.8).max(initial=0.0)], [0.0, 64 * U64])


def _ball(subdivisions: int = 3, radius_m: float = 0.12) -> tuple[Floats, NDArray[np.int32]]:
    mesh = trimesh.creation.icosphere(subdivisions, radius_m)
    return np.asarray(mesh.vertices) + AHEAD_M, np.asarray(mesh.faces, np.int32)


@SCENES.family(
    "broken mesh",
    "m",
    kind=(
        "degenerate triangles",
        "collinear triangles",
        "flipped triangles",
        "every triangle twice",
        "non-manifold fin",
        "loose vertices",
        "open back",
    ),
)
def broken(kind: str) -> Outcome:
    """outline, depth and normals of a ball with this defect; against the ball without it; bound: same outline; depth 64
    u x 1.8 m x condition of the most oblique facet"""
    vertices, faces = _ball()
    whole, rng, first = image(seen(vertices, faces)), np.random.default_rng(2), len(vertices)
    if kind == "degenerate triangles":
        some = rng.integers(0, len(vertices), (500, 2))
        points = np.concatenate([some[:, [0, 0, 1]], some[:, [0, 1, 1]], np.repeat(some[:, :1], 3, axis=1)])
        faces = rng.permutation(np.concatenate([faces, points.astype(np.int32)]))
    elif kind == "collinear triangles":  # inside the ball
        vertices = np.concatenate([vertices, np.linspace(0, 1, 50)[:, None] * [0.0, 0.0, 0.05] + AHEAD_M])
        faces = np.concatenate([faces, first + np.arange(48)[:, None] + np.arange(3)])
    elif kind == "flipped triangles":
        faces = np.where((rng.random(len(faces)) < 0.5)[:, None], faces[:, ::-1], faces)
    elif kind == "every triangle twice":
        faces = np.concatenate([faces, faces[:, ::-1]])
    elif kind == "non-manifold fin":  # three faces at an edge, the third pointing into the ball
        vertices = np.concatenate([vertices, [AHEAD_M]])
        faces = np.concatenate([faces, [[*faces[0, :2], first]]])
    elif kind == "loose vertices":
        vertices = np.concatenate([vertices, rng.uniform(-0.1, 0.1, (200, 3)) + AHEAD_M])
    elif kind == "open back":
        faces = faces[vertices[faces].mean(axis=1)[:, 2] < 1.8 + 0.05]
    hits = seen(vertices, faces)
    depth_m = image(hits)
    away = (hits.normals[:, 2] > 1e-9).any()
    if ((whole > 0) != (depth_m > 0)).any() or not np.isfinite(hits.normals).all() or away:
        return wrong("the outline or the normals changed")
    # At an edge between facets either may be the nearer; both planes agree there to rounding, times the condition of
    # the facet that is seen most obliquely.
    condition = float((1.5 / np.abs((hits.normals * rays_of(hits)).sum(axis=1))).max())
    return worst(whole - depth_m, 64 * U64 * 1.8 * condition, condition=condition)


SCENES.family(
    "no solid triangle",
    "m",
    expects="refusal",
    refuses=MeshError,
    about="a mesh of triangles without area; against there is no surface; bound: must be refused",
)(lambda: seen([[0, 0, 1.8], [0, 0.1, 1.8], [0, 0.2, 1.8]], [[0, 1, 2], [0, 0, 1]]))


@SCENES.family("number of triangles", "m", heavy=lambda count: count > 1e6, count=(1.0, 1e2, 1e4, 1e6, 1e7))
def triangles(count: float) -> Outcome:
    """depth of a paraboloid of this number of triangles; against the paraboloid, closed form; bound: chord error 1.3
    step^2 / 2 and 64 u x 1.8 m; one triangle: 64 u"""
    if count == 1:
        hits = seen([[-0.3, -0.3, 1.9], [0.3, -0.3, 1.7], [0.0, 0.4, 1.8]], [[0, 1, 2]])
        exact = 1.8 / (1 + rays_of(hits)[:, 0] / 3)  # the plane Z = 1.8 - X / 3
        return worst(hits.depth_m - exact, 64 * U64) if len(hits.pixels) else wrong()
    side = math.isqrt(round(count) // 2)
    across = np.linspace(-0.3, 0.3, side + 1)
    x, y = np.tile(across, side + 1), np.repeat(across, side + 1)
    vertices = np.column_stack([x, y, 1.7 + x**2 + y**2])
    cell = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).reshape(-1, 1).astype(np.int32)
    corners = np.array([[0, 1, side + 2], [0, side + 2, side + 1]], np.int32)
    faces = (cell[:, None] + corners).reshape(-1, 3)
    hits = seen(vertices, faces)
    x, y, _ = rays_of(hits).T
    # Z = 1.7 + Z^2 (x^2 + y^2), the nearer root, without cancellation.
    square = x * x + y * y
    exact = 2 * 1.7 / (1 + np.sqrt(1 - 4 * 1.7 * square))
    inside = (np.abs(x * exact) < 0.299) & (np.abs(y * exact) < 0.299)
    # A facet lies between the surface and step^2 / 4 (f'' = 2, both axes) off.
    bound = (0.6 / side) ** 2 / 2 * 1.3 + 64 * U64 * 1.8
    central = (np.abs(RIG.camera.rays()[0]) < 0.15) & (np.abs(RIG.camera.rays()[1]) < 0.15)  # 0.28 m at the farthest
    missing = int(central.sum() - (image(hits)[central] > 0).sum())
    if missing > 0 or len(faces) < 0.9 * count:
        return wrong(f"{missing} pixels see nothing; {len(faces)} triangles")
    return worst((hits.depth_m - exact)[inside], bound)


@SCENES.family("camera inside the object", "m", turn_deg=(0.0, 45.0, 10.0, 89.9))
def camera_inside(turn_deg: float) -> Outcome:
    """depth of the walls of a 2 m box around the camera; against 1 / max |d|, closed form; bound: 64 u"""
    box = np.asarray(trimesh.creation.box((2.0, 2.0, 2.0)).vertices)
    sides = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    cos, sin = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    hits = seen(box @ turn.T, sides[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3))
    missed = RIG.camera.width * RIG.camera.height - len(hits.pixels)
    if missed:
        return wrong(f"{missed} rays leave a closed box")
    own = rays_of(hits) @ turn  # in the box's own axes
    return worst(hits.depth_m - 1 / np.abs(own).max(axis=1), 64 * U64)


_MISPLACED = {"around the camera": (2.5, 0.0), "too large": (0.8, 0.0), "shifted out": (0.05, 5.0)}
"""Radius and shift to the side, in m."""


@SCENES.family("misplaced object", "m", expects="refusal", refuses=MeshError, name=_MISPLACED)
def misplaced(name: str) -> None:
    """placing an object that does not fit range and image; against there is no such sample; bound: must be refused"""
    radius_m, aside_m = _MISPLACED[name]
    vertices, faces = _ball(1, radius_m)
    mesh = SolidMesh("mesh", vertices - AHEAD_M + np.array([aside_m, 0.0, 0.0]), faces)
    place(mesh, "A0", RIG, "fixed", 0)


@SCENES.family("behind the camera", "m", expects="refusal")
def behind_camera() -> Outcome:
    """pixels of a wall behind the camera; against none; bound: must see nothing"""
    return worst(0, flagged=not seen([[-1, -1, -1.8], [1, -1, -1.8], [1, 1, -1.8], [-1, 1, -1.8]]).pixels.size)


@SCENES.family("light at distance 0", "grey")
def light_at_projector() -> Outcome:
    """light on a point in the projector's centre; against finite and not negative; bound: must be finite"""
    centre = projector_centre_m(RIG)
    points = np.array([centre, centre + 1e-200 * AHEAD_M, centre + 1e-6 * AHEAD_M, 0.0 * AHEAD_M, AHEAD_M])
    light = named_light("paper")
    pattern = PatternLight.of(RIG, light.projector)
    gain = light_surface(points, np.array([[0.0, 0.0, -1.0]] * len(points)), RIG, light, pattern).gain
    return worst(np.where(np.isfinite(gain) & (gain >= 0), 0.0, math.inf))


CROSSED = Group(
    "crossed",
    "the plane's depth, closed form",
    "pi / 2 of the joint phase: a rival order is further off, and a pixel that may be one must say so",
)
CROSSED_RIG = replace(crossed_rig(320), background_m=None)
CARRIERS: Crossed = CROSSED_RIG.crossed  # type: ignore[assignment]
DEPTH_MM, WHITE, AMBIENT, NOISE = 1780.0, 160.0, 6.0, 0.7
MIDDLE = slice(120, 200), slice(120, 200)
"""Pixels that are judged: no window of theirs leaves the mask."""


def plane_outcome(
    family: Crossed,
    white: NDArray | float = WHITE,
    rig: Rig = CROSSED_RIG,
    measured_as: Crossed | None = None,
    bound_rad: float = math.pi / 2,
) -> Outcome:
    """The worst pixel of a plane that ``family`` lights, flagged where the route gives a reason or no depth.
    ``measured_as``: the family that the route takes it for."""
    x, y = rig.camera.rays()
    z = np.full(x.shape, DEPTH_MM / 1000)
    u, v = rig.project(np.stack([x * z, y * z, z], axis=-1))
    pairs = zip(family.weights, family.cycles_per_px, strict=True)
    waves = sum(weight * np.cos(2 * np.pi * (a * u + b * v)) for weight, (a, b) in pairs)
    noise = np.random.default_rng(4).normal(0, NOISE, x.shape)
    grey = np.clip(np.rint(AMBIENT + white * (0.5 + 0.5 * waves) + noise), 0, 255).astype(np.uint8)
    mask = np.zeros(x.shape, bool)
    mask[60:260, 60:260] = True
    route = CrossedRoute(rig, family=measured_as or family)
    measured = route.measure(grey, mask)
    depth_mm, reason = measured.depth_mm[MIDDLE], measured.reason[MIDDLE]
    flagged = (depth_mm == 0) | (reason != CrossedReason.MEASURED)
    bound_mm = float(np.median(route.carriers.mm_per_rad(np.full(x.shape, DEPTH_MM)))) * bound_rad
    return worst(depth_mm - DEPTH_MM, bound_mm, flagged)


# Decorators apply from the bottom: the lower family comes first.
@CROSSED.family(
    "saturated half-waves",
    "mm",
    expects="either",
    about="depth of a plane whose crests are clipped at 255, at this grey level of white",
    white=(260.0, 300.0, 400.0, 600.0, 2000.0),
)
@CROSSED.family(
    "dim",
    "mm",
    expects=lambda white: "number" if white >= 40 else "either",
    about="depth of a plane at this grey level of white, noise 0.7",
    white=(220.0, 160.0, 80.0, 40.0, 20.0, 10.0, 5.0, 2.0, 0.0),
)
def exposed(white: float) -> Outcome:
    return plane_outcome(CARRIERS, white)


@CROSSED.family(
    "one direction lost",
    "mm",
    expects=lambda weight: "number" if weight >= 0.3 else "either",
    weight=(0.5, 0.3, 0.1, 0.05, 0.02, 1e-9),
)
def lost(weight: float) -> Outcome:
    """depth of a plane whose second carrier has this weight, and not the 0.5 that the route knows of"""
    return plane_outcome(replace(CARRIERS, weights=(0.5, weight)), measured_as=CARRIERS)


@CROSSED.family("a rival on the truth", "mm", expects="either", ratio=(0.5, 1 / 3, 0.25, 0.2))
def rival(ratio: float) -> Outcome:
    """depth of a plane by periods of 12 px whose gains have this ratio, over four and more periods: with 1 / 2 and
    1 / 3 another order fits exactly"""
    turn_deg = math.degrees(math.atan(ratio))
    along_deg = 128.66  # of the paper's epipolar lines
    return plane_outcome(Crossed((12.0, 12.0), (along_deg + turn_deg, along_deg - 90 + turn_deg)))


@CROSSED.family("baseline along one axis", "mm", expects="either", refuses=FppBenchError, angle_deg=(0.0, 20.0, 45.0))
def along_one_axis(angle_deg: float) -> Outcome:
    """depth of a plane where the projector is above the camera and the carriers are turned by this angle: at 0 the
    second carrier tells no depth"""
    return plane_outcome(
        Crossed((18.0, 18.0), (angle_deg, angle_deg + 90)), rig=replace(CROSSED_RIG, translation_m=(0.0, -0.16, 0.0))
    )


@CROSSED.family("stripes in the paint", "mm", expects="either", period_px=(60.0, 23.0, 7.6, 4.0, 2.0))
def painted(period_px: float) -> Outcome:
    """depth of a plane painted with stripes of this period in the image, along the first carrier's, dark ones with 0.3
    of the albedo; against the plane's depth, closed form; bound: pi of the joint phase, since stripes at a carrier's
    period are a carrier themselves, and nothing in the image tells them apart"""
    carriers = Carriers.of(CROSSED_RIG, CARRIERS)
    across, down = carriers.step_rad[0] / np.linalg.norm(carriers.step_rad[0])
    y, x = np.indices((CROSSED_RIG.camera.height, CROSSED_RIG.camera.width))
    stripes = 0.65 + 0.35 * np.cos(2 * np.pi * (across * x + down * y) / period_px)
    return plane_outcome(CARRIERS, WHITE * stripes, bound_rad=math.pi)
