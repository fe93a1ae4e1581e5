"""Ray casting against closed forms and against a second ray caster, Moeller-Trumbore over every ray
and triangle."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from fpp_ml_bench.errors import MeshError
from fpp_ml_bench.loaders.render.raycast import PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import SolidMesh
from fpp_ml_bench.optics.named_rigs import paper_rig

RIG = paper_rig(176)
RAYS = PixelRays.of(RIG.camera)
X, Y = RAYS.x, RAYS.y


def traced(vertices_m, faces):
    vertices_m = np.asarray(vertices_m, dtype=float)
    faces = np.asarray(faces, dtype=np.int32)
    return TracedObject(SolidMesh("thing", vertices_m, faces), vertices_m)


def traced_mesh(mesh, distance_m=1.8):
    return traced(np.add(mesh.vertices, [0, 0, distance_m]), mesh.faces)


def depth_image(hits):
    image = np.zeros(X.shape)
    image.ravel()[hits.pixels] = hits.depth_m
    return image


def brute_force(vertices_m, faces, starts, ways, hair=0.0):
    """How far along its way (n, 3) each ray first meets a triangle, inf where it meets none: by
    Moeller-Trumbore over every ray and triangle in double precision. This form has holes of a
    ``hair`` between neighbours."""
    nearest = np.full(len(ways), np.inf)
    for a, b, c in np.asarray(vertices_m, dtype=float)[faces]:
        p = np.cross(ways, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = 1 / (p @ (b - a))
            u = (p * (starts - a)).sum(axis=1) * share
            q = np.cross(starts - a, b - a)
            v = (ways * q).sum(axis=1) * share
            along = q @ (c - a) * share
            hit = (u >= -hair) & (v >= -hair) & (u + v <= 1 + hair) & (along > 0)
        nearest = np.where(hit & (along < nearest), along, nearest)
    return nearest


def expected_depth(vertices_m, faces, rays=RAYS):
    """Depth image by `brute_force`; 0 = nothing."""
    ways = np.column_stack([rays.x.ravel(), rays.y.ravel(), np.ones(rays.x.size)])
    depth_m = brute_force(vertices_m, faces, np.zeros(3), ways, 1e-13)
    return np.where(np.isfinite(depth_m), depth_m, 0).reshape(rays.x.shape)


SHAPES = {
    "icosphere": trimesh.creation.icosphere(2, 0.15),
    "torus": trimesh.creation.torus(0.1, 0.04, 16, 10),
    "box turned": trimesh.creation.box(
        (0.2, 0.1, 0.25), trimesh.transformations.euler_matrix(0.4, 0.3, 0.2)
    ),
    "two bodies": trimesh.util.concatenate(
        [
            trimesh.creation.box((0.1, 0.1, 0.1)),
            trimesh.creation.icosphere(1, 0.06).apply_translation([0.05, 0.03, -0.1]),
        ]
    ),
}


LENSES = {
    "no lens": (0.0,) * 5,
    "barrel": (-0.3, 0.1, 0.002, -0.001, 0.0),
    "pincushion": (0.4, -0.1, -0.003, 0.002, 0.0),
}


@pytest.mark.long
@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("lens", LENSES)
def test_depth_is_that_of_the_facets(name, lens):
    mesh, rays = SHAPES[name], PixelRays.of(replace(RIG.camera, distortion=LENSES[lens]))
    vertices_m = np.add(mesh.vertices, [0, 0, 1.8] if lens == "no lens" else [0.15, -0.1, 1.8])
    hits = traced(vertices_m, mesh.faces).primary(rays)
    depth_m, expected = depth_image(hits), expected_depth(vertices_m, mesh.faces, rays)
    np.testing.assert_array_equal(depth_m > 0, expected > 0)
    assert (expected > 0).sum() > 500 and (np.diff(hits.pixels) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(hits.normals, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(depth_m, expected, atol=1e-12)


def test_slivers_and_large_triangles():
    """Long thin triangles at every angle: the columns of a row that they cover are computed, and
    none is missed."""
    rng = np.random.default_rng(4)
    start, end = (
        np.column_stack([rng.uniform(-0.3, 0.3, (200, 2)), rng.uniform(1.5, 2.1, 200)])
        for _ in range(2)
    )
    aside = start + rng.normal(0, 1, (200, 3)) * 10.0 ** rng.uniform(-5, -1, (200, 1))
    vertices_m = np.concatenate([start, end, aside])
    faces = np.column_stack([np.arange(200), np.arange(200) + 200, np.arange(200) + 400])
    depth_m = depth_image(traced(vertices_m, faces).primary(RAYS))
    expected = expected_depth(vertices_m, faces)
    np.testing.assert_array_equal(depth_m > 0, expected > 0)
    np.testing.assert_allclose(depth_m, expected, atol=1e-9)


def test_no_ray_passes_between_neighbours():
    """Triangles whose shared edges and corners lie exactly on the rays' grid: no hole."""
    lines = np.arange(-5, 6) * (X[0, 1] - X[0, 0]) * 8 + X[0, 88]
    x, y = np.meshgrid(lines, lines)
    depth_m = 1.8 + 0.05 * np.random.default_rng(5).random(x.shape)
    vertices_m = np.stack([x * depth_m, y * depth_m, depth_m], axis=-1).reshape(-1, 3)
    corner = (np.arange(10)[:, None] * 11 + np.arange(10)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, 12], corner[:, None] + [0, 12, 11]])
    seen = depth_image(traced(vertices_m, faces).primary(RAYS)) > 0
    reach = lines[-1] - X[0, 88] - 1e-9
    inside = (np.abs(X - X[0, 88]) < reach) & (np.abs(Y - X[0, 88]) < reach)
    assert inside.sum() > 70 * 70 and seen[inside].all()


def test_a_tilted_plane():
    square = np.array([[-1, -1, 2], [1, -1, 2], [1, 1, 2], [-1, 1, 2]], dtype=float)
    square[:, 2] += square[:, :2] @ [0.3, -0.2]
    normal = np.array([0.3, -0.2, -1.0])
    hits = traced(square, [[0, 1, 2], [0, 2, 3]]).primary(RAYS)
    np.testing.assert_allclose(
        depth_image(hits), 2.0 / (1 - 0.3 * X + 0.2 * Y), atol=1e-9
    )  # z = 2 + 0.3 x z - 0.2 y z
    np.testing.assert_allclose(hits.normals, [normal / np.linalg.norm(normal)] * X.size, atol=1e-9)


def test_flipped_winding_changes_nothing():
    mesh = SHAPES["torus"]
    vertices_m = np.add(mesh.vertices, [0.0013, 0.0007, 1.8])  # no ray runs exactly along an edge
    plain = traced(vertices_m, mesh.faces).primary(RAYS)
    rng = np.random.default_rng(0)
    flipped = mesh.faces.copy()
    some = rng.random(len(flipped)) < 0.5
    flipped[some] = flipped[some][:, ::-1]
    other = traced(vertices_m, flipped).primary(RAYS)
    np.testing.assert_array_equal(plain.pixels, other.pixels)
    np.testing.assert_allclose(plain.depth_m, other.depth_m, atol=1e-12)
    np.testing.assert_allclose(plain.normals, other.normals, atol=1e-9)


def test_triangles_without_an_area_are_not_there():
    mesh = SHAPES["icosphere"]
    vertices = np.vstack(
        [np.add(mesh.vertices, [0, 0, 1.8]), [[0, 0, 1.55], [0, 0, 1.55], [0, 0, 1.6]]]
    )
    n = len(mesh.vertices)
    degenerate = np.vstack([[[n, n + 1, n + 2], [n, n, n], [0, 0, 1]], mesh.faces])
    plain = traced_mesh(mesh).primary(RAYS)
    other = traced(vertices, degenerate).primary(RAYS)
    np.testing.assert_array_equal(plain.pixels, other.pixels)
    np.testing.assert_allclose(plain.depth_m, other.depth_m, atol=1e-12)
    with pytest.raises(MeshError, match="no triangle with an area"):
        traced(vertices, [[n, n + 1, n + 2]])


def test_a_wall_behind_the_camera_is_not_seen():
    wall = [[-1, -1, -1.8], [1, -1, -1.8], [1, 1, -1.8], [-1, 1, -1.8]]
    assert not traced(wall, [[0, 1, 2], [0, 2, 3]]).primary(RAYS).pixels.size


def test_rays_without_a_direction_see_nothing():
    x = X.copy()
    x[:88] = np.nan
    hits = traced_mesh(trimesh.creation.icosphere(2, 0.2)).primary(PixelRays(x, Y))
    assert hits.pixels.size and hits.pixels.min() >= 88 * 176


@pytest.mark.parametrize("name", SHAPES)
def test_where_a_line_first_meets_the_object(name):
    """`met` against Moeller-Trumbore over every line and triangle."""
    mesh, rng = SHAPES[name], np.random.default_rng(8)
    vertices_m = np.add(mesh.vertices, [0.0, 0.0, 1.8])
    starts, ends = rng.normal([0, 0, 1.8], 0.12, (2, 3000, 3))
    ends[:300, 0] = starts[:300, 0]  # in the plane of the boxes' sides
    ends[300:500, :2] = starts[300:500, :2]
    way = ends - starts
    nearest = np.minimum(brute_force(vertices_m, mesh.faces, starts, way), 1)
    obj = traced(vertices_m, mesh.faces)
    along, triangle = obj.met(starts, ends)
    np.testing.assert_array_equal(triangle >= 0, nearest < 1)
    np.testing.assert_allclose(along, nearest, atol=1e-10)
    assert 0.2 < (triangle >= 0).mean() < 0.95 and (along[triangle < 0] == 1).all()
    # The triangle named is the one that holds the point.
    a, b, c = np.moveaxis(obj.corners[triangle[triangle >= 0]], 1, 0)
    point = (starts + along[:, None] * way)[triangle >= 0]
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    parts = sum(
        np.linalg.norm(np.cross(q - p, point - p), axis=1) for p, q in ((a, b), (b, c), (c, a))
    )
    np.testing.assert_allclose(parts, area, rtol=1e-6)
    # Any hit is a hit of some triangle, where there is one.
    some = obj.met(starts, ends, any_suffices=True)
    np.testing.assert_array_equal(some[1] >= 0, triangle >= 0)
    assert (some[0] >= along).all()


def test_nothing_beyond_the_light_casts_a_shadow():
    behind = traced([[-1, -1, -0.5], [1, -1, -0.5], [0, 1, -0.5]], [[0, 1, 2]])
    assert not behind.shadowed(np.array([[0.0, 0.0, 1.8]]), np.array([0.0, 0.0, 0.0])).any()


def test_a_surface_does_not_shadow_itself():
    mesh = trimesh.creation.icosphere(4, 0.15)
    sphere = traced_mesh(mesh)
    hits = sphere.primary(RAYS)
    rays = np.column_stack([X.ravel(), Y.ravel(), np.ones(X.size)])
    points = rays[hits.pixels] * hits.depth_m[:, None]
    light = np.array([-0.125, 0.1, 0.0])
    toward = light - points
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    cosine = np.einsum("ij,ij->i", hits.normals, toward)
    dark = sphere.shadowed(points, light)
    assert not dark[cosine > 0.05].any()
    assert dark[cosine < -0.05].all()
