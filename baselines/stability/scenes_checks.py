"""Checks of the scenes: surfaces edge-on, thin, with broken meshes, of many triangles, or around the camera."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.baselines.stability.case import Outcome, refusal, worst
from fpp_ml_bench.baselines.stability.roundoff import U64
from fpp_ml_bench.errors import MeshError
from fpp_ml_bench.loaders.render import (
    Hits,
    Lighting,
    PixelRays,
    SolidMesh,
    TracedObject,
    light_surface,
    place,
    projector_centre_m,
)
from fpp_ml_bench.optics import paper_rig

RIG = paper_rig(176)
AHEAD_M = np.array([0.0, 0.0, 1.8])
EDGE_PX = 1e-9
"""Within this of a triangle's edge, a ray may be decided either way: 2^-53 of coordinates up to 2 m, a thousand times
over, at 419 px focal length."""


def traced(vertices_m: ArrayLike, faces: ArrayLike) -> TracedObject:
    vertices = np.asarray(vertices_m, dtype=np.float64)
    return TracedObject(SolidMesh("mesh", vertices, np.asarray(faces, dtype=np.int32)), vertices)


def image(hits: Hits) -> NDArray[np.float64]:
    """Depth (H, W) in metres, 0 = nothing."""
    depth = np.zeros(RIG.camera.width * RIG.camera.height)
    depth[hits.pixels] = hits.depth_m
    return depth.reshape(RIG.camera.height, RIG.camera.width)


def _quad(corners: ArrayLike) -> TracedObject:
    return traced(corners, [[0, 1, 2], [0, 2, 3]])


def edge_on(off_deg: float) -> Outcome:
    """A wall that makes this angle with the line of sight of one pixel column, 0.2 m high and 0.2 m deep."""
    middle = np.array([RIG.camera.rays()[0][0, 100] * 1.8, 0.0, 1.8])
    sight = middle / np.linalg.norm(middle)
    turn = math.radians(off_deg)
    along = math.cos(turn) * sight + math.sin(turn) * np.array([sight[2], 0.0, -sight[0]])
    up = np.array([0.0, 0.1, 0.0])
    corners = [middle + s * 0.1 * along + r * up for s, r in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    hits = _quad(corners).primary(PixelRays.of(RIG.camera))
    x, y = (axis.ravel()[hits.pixels] for axis in RIG.camera.rays())
    wide = np.asarray(corners, dtype=np.longdouble)
    normal = np.cross(wide[1] - wide[0], wide[2] - wide[0])
    facing = normal[0] * x + normal[1] * y + normal[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        exact = np.asarray((normal @ wide[0]) / facing, float)
    low, high = float(wide[:, 2].min()), float(wide[:, 2].max())
    if not len(hits.pixels):
        # The whole wall is then thinner than the gap between two pixel columns.
        width_px = float(abs(corners[0][0] / corners[0][2] - corners[1][0] / corners[1][2]) * RIG.camera.fx)
        if width_px < 1:
            return Outcome(None, flagged=1.0, note=f"no pixel sees it: it is {width_px:.2g} px wide")
        return Outcome(math.inf, 0.0, note="a wall of a pixel's width is not seen")
    size = np.abs(normal[0] * x) + np.abs(normal[1] * y) + np.abs(normal[2])
    condition = np.asarray(size / np.abs(facing), float)
    # Rounding of normal (12), plane (6) and products (4), times the condition; clipped to the wall's own extent, which
    # also bounds the error of a ray on the wrong side of an edge.
    bound = np.minimum(22 * U64 * condition * 1.9 * 12, high - low)
    outside = (exact < low) | (exact > high)
    bound = np.minimum(np.where(outside, EDGE_PX / RIG.camera.fx * condition * 1.9 + bound, bound), high - low)
    error = np.where(outside, np.minimum(np.abs(hits.depth_m - low), np.abs(hits.depth_m - high)), hits.depth_m - exact)
    return worst(error, bound, condition=float(condition.max()))


def needle(width_px: float, centre_px: float) -> Outcome:
    """A vertical strip at 1.8 m of this width in pixels: it covers exactly the columns whose centres lie in it."""
    camera = RIG.camera
    column = 90.0 + centre_px
    left, right = ((column + side * width_px / 2 - camera.cx) / camera.fx * 1.8 for side in (-1, 1))
    half = 0.1
    hits = _quad([[left, -half, 1.8], [right, -half, 1.8], [right, half, 1.8], [left, half, 1.8]]).primary(
        PixelRays.of(camera)
    )
    depth_m = image(hits)
    columns = np.arange(camera.width)
    inside = np.abs(columns - column) < width_px / 2 - EDGE_PX
    may = np.abs(columns - column) < width_px / 2 + EDGE_PX
    rows = np.abs(camera.rays()[1][:, 0]) * 1.8 < half - 2e-4
    missing = (depth_m[rows][:, inside] == 0).sum()
    extra = (depth_m[:, ~may] > 0).sum()
    depth_error = np.abs(hits.depth_m - 1.8).max(initial=0.0)
    return worst([missing + extra, depth_error], [0.0, 64 * U64])


def _ball(subdivisions: int = 3, radius_m: float = 0.12) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions, radius_m)
    return np.asarray(mesh.vertices) + AHEAD_M, np.asarray(mesh.faces, np.int32)


def broken(kind: str) -> Outcome:
    """A ball with a defect that must not change what the camera sees."""
    vertices, faces = _ball()
    reference = traced(vertices, faces).primary(PixelRays.of(RIG.camera))
    rng = np.random.default_rng(2)
    if kind == "degenerate triangles":
        some = rng.integers(0, len(vertices), (500, 2))
        points = np.concatenate([some[:, [0, 0, 1]], some[:, [0, 1, 1]], np.repeat(some[:, :1], 3, axis=1)])
        faces = rng.permutation(np.concatenate([faces, points.astype(np.int32)]))
    elif kind == "collinear triangles":
        along = np.linspace(0, 1, 50)[:, None] * [0.0, 0.0, 0.05] + [0.0, 0.0, 1.8]  # inside the ball
        first = len(vertices)
        vertices = np.concatenate([vertices, along])
        faces = np.concatenate(
            [faces, np.array([[first + i, first + i + 1, first + i + 2] for i in range(48)], np.int32)]
        )
    elif kind == "flipped triangles":
        turn = rng.random(len(faces)) < 0.5
        faces = np.where(turn[:, None], faces[:, ::-1], faces)
    elif kind == "every triangle twice":
        faces = np.concatenate([faces, faces[:, ::-1]])
    elif kind == "non-manifold fin":  # three faces at an edge, the third pointing into the ball
        edge = faces[0, :2]
        vertices = np.concatenate([vertices, [[0.0, 0.0, 1.8]]])
        faces = np.concatenate([faces, np.array([[edge[0], edge[1], len(vertices) - 1]], np.int32)])
    elif kind == "loose vertices":
        vertices = np.concatenate([vertices, rng.uniform(-0.1, 0.1, (200, 3)) + AHEAD_M])
    elif kind == "open back":
        centre = vertices[faces].mean(axis=1)
        faces = faces[centre[:, 2] < 1.8 + 0.05]
    hits = traced(vertices, faces).primary(PixelRays.of(RIG.camera))
    a, b = image(reference), image(hits)
    lit = hits.normals[:, 2] if len(hits.pixels) else np.zeros(0)
    if ((a > 0) != (b > 0)).any() or not np.isfinite(hits.normals).all() or (lit > 1e-9).any():
        return Outcome(math.inf, 0.0, note="the outline or the normals changed")
    # At an edge between facets either may be the nearer; both planes agree there to rounding, times the condition of
    # the facet that is seen most obliquely.
    x, y = (axis.ravel()[hits.pixels] for axis in RIG.camera.rays())
    facing = hits.normals[:, 0] * x + hits.normals[:, 1] * y + hits.normals[:, 2]
    condition = float((1.5 / np.abs(facing)).max())
    return worst(a - b, 64 * U64 * 1.8 * condition, condition=condition)


def nothing_solid() -> Outcome:
    return refusal(lambda: traced([[0, 0, 1.8], [0, 0.1, 1.8], [0, 0.2, 1.8]], [[0, 1, 2], [0, 0, 1]]), MeshError)


def triangles(count: float) -> Outcome:
    """A mesh of ``count`` triangles: one triangle, or a paraboloid as a grid of facets with known chord error."""
    camera = RIG.camera
    if count == 1:
        hits = traced([[-0.3, -0.3, 1.9], [0.3, -0.3, 1.7], [0.0, 0.4, 1.8]], [[0, 1, 2]]).primary(PixelRays.of(camera))
        x, y = (axis.ravel()[hits.pixels] for axis in camera.rays())
        exact = 1.8 / (1 + x / 3)  # the plane Z = 1.8 - X / 3
        return worst(hits.depth_m - exact, 64 * U64) if len(hits.pixels) else Outcome(math.inf, 0.0)
    side = math.isqrt(round(count) // 2)
    across = np.linspace(-0.3, 0.3, side + 1)
    vertices = np.empty(((side + 1) ** 2, 3))
    vertices[:, 0], vertices[:, 1] = np.tile(across, side + 1), np.repeat(across, side + 1)
    vertices[:, 2] = 1.7 + vertices[:, 0] ** 2 + vertices[:, 1] ** 2
    cell = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel().astype(np.int32)
    faces = np.empty((2 * side * side, 3), np.int32)
    for half, corners in enumerate(((0, 1, side + 2), (0, side + 2, side + 1))):
        for place_, corner in enumerate(corners):
            faces[half::2, place_] = cell + corner
    hits = traced(vertices, faces).primary(PixelRays.of(camera))
    x, y = (axis.ravel()[hits.pixels] for axis in camera.rays())
    # Z = 1.7 + Z^2 (x^2 + y^2), the nearer root, without cancellation.
    square = x * x + y * y
    exact = 2 * 1.7 / (1 + np.sqrt(1 - 4 * 1.7 * square))
    inside = (np.abs(x * exact) < 0.299) & (np.abs(y * exact) < 0.299)
    step = 0.6 / side
    # A facet lies between the surface and step^2 / 4 (f'' = 2, both axes) off.
    bound = step**2 / 2 * 1.3 + 64 * U64 * 1.8
    central = (np.abs(camera.rays()[0]) < 0.15) & (np.abs(camera.rays()[1]) < 0.15)  # 0.28 m at the farthest
    missing = int(central.sum() - (image(hits)[central] > 0).sum())
    if missing > 0 or len(faces) < 0.9 * count:
        return Outcome(math.inf, 0.0, note=f"{missing} pixels see nothing; {len(faces)} triangles")
    return worst((hits.depth_m - exact)[inside], bound)


def camera_inside(turn_deg: float) -> Outcome:
    """The camera in a box of 2 m: every ray sees a wall, at a depth known in closed form."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    angle = math.radians(turn_deg)
    turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6],
             [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip
    hits = traced(corners @ turn.T, faces).primary(PixelRays.of(RIG.camera))
    x, y = (axis.ravel() for axis in RIG.camera.rays())
    if len(hits.pixels) != x.size:
        return Outcome(math.inf, 0.0, note=f"{x.size - len(hits.pixels)} rays leave a closed box")
    own = np.column_stack([x, y, np.ones(x.size)]) @ turn  # in the box's own axes
    exact = 1 / np.abs(own).max(axis=1)
    return worst(hits.depth_m - exact, 64 * U64)


def placed_around(name: str) -> Outcome:
    """The builder's placement refuses an object around the camera, too large, or out of the image."""
    vertices, faces = _ball(1, {"around the camera": 2.5, "too large": 0.8, "shifted out": 0.05}[name])
    vertices = vertices - AHEAD_M
    if name == "shifted out":
        vertices = vertices + np.array([5.0, 0.0, 0.0])
    return refusal(lambda: place(SolidMesh("mesh", vertices, faces), "A0", RIG, "fixed", 0), MeshError)


def behind_camera() -> Outcome:
    hits = _quad([[-1, -1, -1.8], [1, -1, -1.8], [1, 1, -1.8], [-1, 1, -1.8]]).primary(PixelRays.of(RIG.camera))
    return worst(np.zeros(4), 0.0, np.full(4, len(hits.pixels) == 0))


def light_at_projector() -> Outcome:
    """Light on a surface point in the projector's centre, at distance 0."""
    centre = projector_centre_m(RIG)
    points = np.array([centre, centre + 1e-200 * AHEAD_M, centre + 1e-6 * AHEAD_M, 0.0 * AHEAD_M, AHEAD_M])
    lit = light_surface(points, np.array([[0.0, 0.0, -1.0]] * len(points)), RIG, Lighting())
    bad = ~np.isfinite(lit.gain) | (lit.gain < 0)
    return worst(np.where(bad, math.inf, 0.0), 0.0)
