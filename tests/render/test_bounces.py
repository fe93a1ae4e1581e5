"""Further bounces against theory: integrating sphere, a groove, light from the plane.

Rays are a fixed sequence, so every deviation below is a constant of this code. Form factors by
Lambert's formula.
"""

from functools import cache

import numpy as np
import pytest
import trimesh
from rendering import CENTRE, PAPER, RIG, sheet, solid

from fpp_ml_bench.loaders.render.bounces import PlaneLight, at_points, between_surfels
from fpp_ml_bench.loaders.render.pixels import mixed_pixels
from fpp_ml_bench.loaders.render.projector import PatternLight
from fpp_ml_bench.loaders.render.raycast import Hits, PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import SolidMesh, turned
from fpp_ml_bench.loaders.render.surfels import RAYS, Surfels, place_surfels
from fpp_ml_bench.optics.named_rigs import paper_rig

WHITE = RIG.sequence.white


@cache
def hollow_sphere():
    """A shell of 5 cm radius with a cavity of 4 cm: surfels, and which are of the cavity."""
    outer, inner = trimesh.creation.icosphere(4, 0.05), trimesh.creation.icosphere(4, 0.04)
    vertices = np.concatenate([outer.vertices, inner.vertices])
    faces = np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)]).astype(
        np.int32
    )
    surfels = Surfels.of(SolidMesh("shell", vertices, faces))
    cavity = np.linalg.norm(surfels.grid.position_m, axis=1) < 0.0449
    return surfels, cavity


def bounced(surfels, direct, rho):
    """Irradiance by bounces (K,) of one pattern, without other light."""
    return between_surfels(
        surfels, direct[:, None], np.zeros((len(direct), 1)), np.full(len(direct), rho)
    )[:, 0]


@pytest.mark.parametrize("rho", [0.2, 0.8, 0.95])
def test_integrating_sphere_in_uniform_light(rho):
    """Inside a closed sphere E = rho (1 + E), by theory exact: rho / (1 - rho)."""
    surfels, cavity = hollow_sphere()
    assert 1000 < cavity.sum() < 4000
    total = bounced(surfels, cavity.astype(float), rho)
    # Every ray of the cavity meets the cavity; 64 bounces leave rho^64 of it.
    np.testing.assert_allclose(total[cavity], rho / (1 - rho) * (1 - rho**64), rtol=1e-3)
    np.testing.assert_array_equal(total[~cavity], 0)


def right_angle():
    """A floor and a wall of 10 cm with a common edge."""
    edge = [0.1, 0, 0]
    return sheet(([0, 0, 0], edge, [0, 0.1, 0]), ([0, 0, 0], edge, [0, 0, 0.1]))


def contour(points, normals, corners):
    """Form factor from points (n, 3) to a polygon (m, 3) that lies above their horizons: Lambert
    1760, exact."""
    total = np.zeros(len(points))
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        to_a, to_b = a - points, b - points
        to_a, to_b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (to_a, to_b))
        cross = np.cross(to_a, to_b)
        length = np.linalg.norm(cross, axis=1)
        angle = np.arctan2(length, (to_a * to_b).sum(axis=1))
        total += (cross * normals).sum(axis=1) * angle / np.maximum(length, 1e-30)
    return np.abs(total) / (2 * np.pi)


def groove(side=0.1, n=12):
    """Radiosity of a right-angled groove, floor y and wall z, by n x n patches a side and Lambert's
    formula: patch centres (n n, 2) along the edge and away from it, and the form factors (n n, n n)
    of either side to the other."""
    across, away = np.meshgrid(
        (np.arange(n) + 0.5) / n * side, (np.arange(n) + 0.5) / n * side, indexing="ij"
    )
    centres = np.column_stack([across.ravel(), away.ravel(), np.zeros(n * n)])
    up = np.tile([0.0, 0.0, 1.0], (n * n, 1))
    factors = np.empty((n * n, n * n))
    half = side / n / 2
    for k, (x, z) in enumerate(zip(across.ravel(), away.ravel(), strict=True)):
        patch = [
            [x - half, 0, z - half],
            [x + half, 0, z - half],
            [x + half, 0, z + half],
            [x - half, 0, z + half],
        ]
        factors[:, k] = contour(centres, up, np.array(patch))
    return centres[:, :2], factors


def test_groove_of_two_squares():
    """All bounces between two sides at a right angle in uniform light, place by place."""
    rho, (centres, factors) = 0.8, groove()
    assert factors.sum(axis=1).mean() == pytest.approx(0.20004, rel=0.01)  # Howell's C-14
    # Both sides are alike: E = F rho (1 + E).
    n = len(centres)
    expected = np.linalg.solve(np.eye(n) - rho * factors, rho * factors.sum(axis=1))
    surfels = Surfels.of(right_angle())
    normal = surfels.grid.normal
    inner = (normal[:, 2] > 0.5) | (normal[:, 1] > 0.5)
    values = bounced(surfels, inner.astype(float), rho)[:, None]
    floor = np.column_stack([centres, np.zeros(n)])
    wall = np.column_stack([centres[:, 0], np.zeros(n), centres[:, 1]])
    for points, facing in ((floor, [0, 0, 1.0]), (wall, [0, 1.0, 0])):
        found = at_points(surfels.grid, values, points, np.tile(facing, (n, 1)))[0]
        assert found.mean() == pytest.approx(expected.mean(), rel=0.02)
        # A place's own error: noise of 128 rays and the width of a surfel, as a share of the
        # groove's largest value.
        assert np.sqrt(np.mean((found - expected) ** 2)) < 0.03 * expected.max()
        outside = at_points(surfels.grid, values, points, np.tile(np.negative(facing), (n, 1)))[0]
        np.testing.assert_array_equal(outside, 0)


SHAPES = {
    "torus": solid(trimesh.creation.torus(0.08, 0.03, 48, 24)),
    "box": solid(trimesh.creation.box((0.1, 0.2, 0.15))),
    "two boxes": solid(
        trimesh.util.concatenate(
            [
                trimesh.creation.box((0.1, 0.1, 0.1)).apply_translation([x, 0, z])
                for x, z in ((0, 0), (0.14, 0.03))
            ]
        )
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("name", ["shell", "torus", "box", "two boxes"])
def test_rows_and_reciprocity(name):
    surfels = hollow_sphere()[0] if name == "shell" else Surfels.of(SHAPES[name])
    factors, area = surfels.form_factors.toarray(), surfels.grid.area_m2
    np.testing.assert_allclose(factors.sum(axis=1) + surfels.open_share, 1, atol=1e-12)
    assert 2500 < len(area) < 9000
    # A_i F_ij = A_j F_ji: single pairs are noise, so by halves of the object, along each axis,
    # within three standard errors of the rays that go across. Each carries the area of a surfel, by
    # the number of rays.
    crossing = []
    for axis in range(3):
        place = surfels.grid.position_m[:, axis]
        upper = place > np.median(place)
        there, back = (
            (area[one] @ factors[np.ix_(one, other)]).sum()
            for one, other in ((upper, ~upper), (~upper, upper))
        )
        error = np.sqrt((there + back) * area.mean() / RAYS)
        assert abs(there - back) <= 3 * error
        crossing.append(there / error if there else 0)
    assert max(crossing) == 0 if name == "box" else max(crossing) > 20


def test_a_convex_object_gets_nothing_from_itself():
    surfels = Surfels.of(solid(trimesh.creation.icosphere(4, 0.08)))
    assert surfels.open_share.min() == 1 and surfels.form_factors.nnz == 0
    outside = np.random.default_rng(0).random((len(surfels.grid.area_m2), 2))
    np.testing.assert_array_equal(
        between_surfels(surfels, outside, outside, np.full(len(outside), 0.9)), outside
    )


def test_surfels_share_out_the_surface():
    surfels = hollow_sphere()[0]
    grid, points = surfels.grid, surfels.points
    assert grid.area_m2.sum() == pytest.approx(4 * np.pi * (0.05**2 + 0.04**2), rel=3e-3)
    assert surfels.open_directions.shape == (surfels.open_starts[-1], 3)
    np.testing.assert_allclose(np.linalg.norm(surfels.open_directions, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(points.mean(points.position_m), grid.position_m)
    # Open rays lie about their normal like the cosine: the mean of their cosine is 2/3.
    cosine = (
        surfels.open_directions * np.repeat(grid.normal, np.diff(surfels.open_starts), axis=0)
    ).sum(axis=1)
    assert cosine.mean() == pytest.approx(2 / 3, rel=2e-3)


def test_both_sides_of_a_sheet_that_encloses_nothing():
    """Half a spherical shell: its inside sees itself with half of its hemisphere (A_opening /
    A_inside), its outside nothing, whichever way its triangles are turned."""
    ball = trimesh.creation.icosphere(4, 0.06)
    half = ball.faces[(ball.triangles_center[:, 2] < 0)]
    for faces in (half, half[:, ::-1]):
        surfels = Surfels.of(
            SolidMesh(
                "bowl", np.asarray(ball.vertices), np.ascontiguousarray(faces, dtype=np.int32)
            )
        )
        grid = surfels.grid
        inside = (grid.normal * grid.position_m).sum(axis=1) < 0
        assert grid.area_m2[inside].sum() == pytest.approx(grid.area_m2[~inside].sum(), rel=0.02)
        assert np.average(
            surfels.open_share[inside], weights=grid.area_m2[inside]
        ) == pytest.approx(0.5, abs=0.01)
        assert surfels.open_share[~inside].min() == 1


def test_interpolation_reproduces_a_constant_and_a_ramp():
    mesh = trimesh.creation.icosphere(4, 0.08)
    grid = Surfels.of(solid(mesh)).grid
    points, triangle = trimesh.sample.sample_surface(mesh, 3000, seed=1)
    values = np.column_stack([np.full(len(grid.area_m2), 0.37), grid.position_m[:, 0]])
    constant, x = at_points(grid, values, np.asarray(points), mesh.face_normals[triangle])
    np.testing.assert_allclose(constant, 0.37, rtol=1e-6)
    assert np.abs(x - points[:, 0]).max() < 0.5 * grid.cell_m
    far = at_points(
        grid, values, np.array([[0.5, 0.5, 0.5], [np.nan] * 3]), np.array([[0.0, 0, 1], [0, 0, 1]])
    )
    assert (far == 0).all()


@pytest.mark.long
def test_light_from_the_background_plane_against_an_integral():
    """Irradiance of a ball's back from the lit part of the plane, by the midpoint rule with the
    inverse square and the cosines written out."""
    light = PAPER
    plane = PlaneLight.of(RIG, light, PatternLight.of(RIG, light.projector))
    surfels = Surfels.of(solid(trimesh.creation.icosphere(4, 0.08)))
    offset = np.array([0.05, -0.02, 1.9])
    degrees = 120
    found = plane.upon(surfels, degrees, offset)[:, WHITE]
    position, normal = (
        turned(surfels.grid.position_m, degrees) + offset,
        turned(surfels.grid.normal, degrees),
    )
    # The pattern's outer pixel edges, sent from the projector to 3.2 m.
    x = CENTRE[0] + 3.2 * (np.array([-0.5, 911.5]) - 455.5) / 1824
    y = CENTRE[1] + 3.2 * (np.array([-0.5, 1139.5]) - 569.5) / 1824
    n = 80
    gx, gy = np.meshgrid(
        x[0] + (np.arange(n) + 0.5) / n * np.ptp(x), y[0] + (np.arange(n) + 0.5) / n * np.ptp(y)
    )
    gx, gy = gx.ravel(), gy.ravel()
    from_light = np.sqrt((gx - CENTRE[0]) ** 2 + (gy - CENTRE[1]) ** 2 + 3.2**2)
    leaving = 0.8 * 1.5**2 / from_light**2 * 3.2 / from_light
    expected = np.zeros(len(found))
    for k in range(len(found)):
        to = np.stack(
            [gx - position[k, 0], gy - position[k, 1], np.full(gx.size, 3.2 - position[k, 2])]
        )
        squared = (to**2).sum(axis=0)
        cosines = np.clip(normal[k] @ to, 0, None) * to[2] / squared
        expected[k] = (leaving * cosines / squared).sum() / np.pi * np.ptp(x) * np.ptp(y) / n**2
    assert expected.max() > 0.05 and (found[normal[:, 2] < -0.9] == 0).all()
    assert np.average(found, weights=surfels.grid.area_m2) == pytest.approx(
        np.average(expected, weights=surfels.grid.area_m2), rel=0.01
    )
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.05 * expected.max()


# ---- places of surfels, and borders of light

SQUARE = np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.4, 0.4, 0.0], [0.0, 0.4, 0.0]])
UP = np.array([[0, 1, 2], [0, 2, 3]])


def test_surfels_of_a_step_keep_its_two_levels_apart():
    low = SQUARE[UP]
    _, alone = place_surfels(low)
    step_m = alone.cell_m / 2
    high = low * [0.5, 1, 1] + [0.4, 0, step_m]
    points, grid = place_surfels(np.concatenate([low, high]))
    assert np.isclose(grid.area_m2.sum(), 0.16 + 0.08)
    np.testing.assert_allclose(points.mean(points.position_m), grid.position_m)
    level = (grid.position_m[:, 2:] > step_m / 2).astype(np.float64)
    across = np.linspace(0.35, 0.45, 21)
    places = np.column_stack([across, np.full(21, 0.2), np.where(across > 0.4, step_m, 0.0)])
    seen = at_points(grid, level, places, np.tile([0.0, 0.0, 1.0], (21, 1)))
    np.testing.assert_allclose(seen[0], across > 0.4, atol=1e-6)


def test_pixels_on_both_sides_of_a_border_of_light_get_more_rays():
    rig = paper_rig(48)
    corners = (SQUARE - [0.2, 0.2, 0.0]) * [1, -1, 1] + [0.0, 0.0, 1.8]
    traced = TracedObject(SolidMesh("plate", corners, UP.astype(np.int32)), corners)
    hits: Hits = traced.primary(PixelRays.of(rig.camera))
    column = hits.pixels % 48
    plain = mixed_pixels(traced, hits, rig, 2)
    border = mixed_pixels(traced, hits, rig, 2, column < 24)
    added = np.setdiff1d(border.pixels, plain.pixels)
    assert set(added % 48) == {23, 24}
    assert set(np.unique(hits.pixels // 48)) - set(added // 48) <= set(plain.pixels // 48)
    assert not border.void[np.isin(border.pixels, added)].any()  # one surface, whatever its light
