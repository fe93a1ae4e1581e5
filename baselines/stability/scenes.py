"""Scenes: walls edge-on, needles, broken meshes, one to ten million triangles, the camera inside the object."""

import itertools
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.baselines.stability.cases import U64, Floats, Group, Outcome, worst, wrong
from fpp_ml_bench.errors import MeshError
from fpp_ml_bench.loaders import render
from fpp_ml_bench.optics import paper_rig

SCENES = Group("scenes")
RIG = paper_rig(176)
AHEAD_M = np.array([0.0, 0.0, 1.8])
EDGE_PX = 1e-9
"""Within this of a triangle's edge, a ray may be decided either way: 2^-53 of coordinates up to 2 m, a thousand times
over, at 419 px focal length."""


def seen(vertices_m: ArrayLike, faces: ArrayLike = ((0, 1, 2), (0, 2, 3))) -> render.Hits:
    """What the camera sees of a mesh, of a quadrilateral without ``faces``."""
    vertices = np.asarray(vertices_m, dtype=np.float64)
    mesh = render.SolidMesh("mesh", vertices, np.asarray(faces, dtype=np.int32))
    return render.TracedObject(mesh, vertices).primary(render.PixelRays.of(RIG.camera))


def rays_of(hits: render.Hits) -> tuple[Floats, ...]:
    """x and y of the rays that hit, at z = 1."""
    return tuple(axis.ravel()[hits.pixels] for axis in RIG.camera.rays())


def image(hits: render.Hits) -> Floats:
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
    x, y = rays_of(hits)
    wide = np.asarray(corners, dtype=np.longdouble)
    normal = np.cross(wide[1] - wide[0], wide[2] - wide[0])
    facing = normal[0] * x + normal[1] * y + normal[2]
    exact, low, high = (normal @ wide[0] / facing).astype(float), float(wide[:, 2].min()), float(wide[:, 2].max())
    size = np.abs(normal[0] * x) + np.abs(normal[1] * y) + np.abs(normal[2])
    condition = (size / np.abs(facing)).astype(float)
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
    import trimesh

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
    x, y = rays_of(hits)
    facing = hits.normals[:, 0] * x + hits.normals[:, 1] * y + hits.normals[:, 2]
    condition = float((1.5 / np.abs(facing)).max())
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
        exact = 1.8 / (1 + rays_of(hits)[0] / 3)  # the plane Z = 1.8 - X / 3
        return worst(hits.depth_m - exact, 64 * U64) if len(hits.pixels) else wrong()
    side = math.isqrt(round(count) // 2)
    across = np.linspace(-0.3, 0.3, side + 1)
    x, y = np.tile(across, side + 1), np.repeat(across, side + 1)
    vertices = np.column_stack([x, y, 1.7 + x**2 + y**2])
    cell = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).reshape(-1, 1).astype(np.int32)
    corners = np.array([[0, 1, side + 2], [0, side + 2, side + 1]], np.int32)
    faces = (cell[:, None] + corners).reshape(-1, 3)
    hits = seen(vertices, faces)
    x, y = rays_of(hits)
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
    corners = np.array(list(itertools.product((-1, 1), repeat=3)), float)
    cos, sin = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    faces = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
    hits = seen(corners @ turn.T, faces)
    x, y = (axis.ravel() for axis in RIG.camera.rays())
    if len(hits.pixels) != x.size:
        return wrong(f"{x.size - len(hits.pixels)} rays leave a closed box")
    own = np.column_stack([x, y, np.ones(x.size)]) @ turn  # in the box's own axes
    return worst(hits.depth_m - 1 / np.abs(own).max(axis=1), 64 * U64)


_MISPLACED = {"around the camera": (2.5, 0.0), "too large": (0.8, 0.0), "shifted out": (0.05, 5.0)}
"""Radius and shift to the side, in m."""


@SCENES.family("misplaced object", "m", expects="refusal", refuses=MeshError, name=_MISPLACED)
def misplaced(name: str) -> None:
    """placing an object that does not fit range and image; against there is no such sample; bound: must be refused"""
    radius_m, aside_m = _MISPLACED[name]
    vertices, faces = _ball(1, radius_m)
    mesh = render.SolidMesh("mesh", vertices - AHEAD_M + np.array([aside_m, 0.0, 0.0]), faces)
    render.place(mesh, "A0", RIG, "fixed", 0)


@SCENES.family("behind the camera", "m", expects="refusal")
def behind_camera() -> Outcome:
    """pixels of a wall behind the camera; against none; bound: must see nothing"""
    return worst(0, flagged=not seen([[-1, -1, -1.8], [1, -1, -1.8], [1, 1, -1.8], [-1, 1, -1.8]]).pixels.size)


@SCENES.family("light at distance 0", "grey")
def light_at_projector() -> Outcome:
    """light on a point in the projector's centre; against finite and not negative; bound: must be finite"""
    centre = render.projector_centre_m(RIG)
    points = np.array([centre, centre + 1e-200 * AHEAD_M, centre + 1e-6 * AHEAD_M, 0.0 * AHEAD_M, AHEAD_M])
    light = render.named_light("paper")
    pattern = render.PatternLight.of(RIG, light.projector)
    gain = render.light_surface(points, np.array([[0.0, 0.0, -1.0]] * len(points)), RIG, light, pattern).gain
    return worst(np.where(np.isfinite(gain) & (gain >= 0), 0.0, math.inf))
