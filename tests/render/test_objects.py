"""The ground-truth meshes: closed, repeatable, inside the working range; the 50 are of the paper's scene statistics."""

import hashlib
import subprocess
import sys

import numpy as np
import pytest

from fpp_ml_bench.constants import OBJECTS, STANDOFF_M, UNSEEN, VIEW_DEGREES, WORKING_RANGE_MM, split_of
from fpp_ml_bench.errors import MeshError
from fpp_ml_bench.loaders.render.builder import plan_build
from fpp_ml_bench.loaders.render.objects import object_mesh
from fpp_ml_bench.loaders.render.objects.solids import DRAWINGS
from fpp_ml_bench.loaders.render.raycast import PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import SolidMesh, preset_settings, turned

FOCAL_PX, IMAGE_PX = 2285.77, 960  # the paper's camera
SIZE = 120
ALL = (*OBJECTS, *UNSEEN)
MARGIN_PX = 6  # of the 960: no object may come nearer to the image border


@pytest.fixture(scope="module")
def meshes():
    return {name: object_mesh(name) for name in ALL}


@pytest.fixture(scope="module")
def views(meshes):
    """Visible depths in mm of each object's six views, on a coarse grid of the paper's camera."""
    return {name: _visible_depths_mm(mesh) for name, mesh in meshes.items()}


def _visible_depths_mm(mesh):
    """For each view, depth (n,) of the pixels that hit; the camera stands 1.8 m before the turning axis."""
    line = (np.arange(SIZE) - (SIZE - 1) / 2) * IMAGE_PX / SIZE / FOCAL_PX
    rays = PixelRays(*np.meshgrid(line, line))
    solid = SolidMesh("object", np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int32))
    placed = (np.add(turned(solid.vertices_m, degrees), [0, 0, STANDOFF_M]) for degrees in VIEW_DEGREES)
    return [1000.0 * TracedObject(solid, vertices_m).primary(rays).depth_m for vertices_m in placed]


def _digest(mesh):
    return hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes()).hexdigest()


def test_every_object_of_the_benchmark_has_one_builder():
    assert sorted(DRAWINGS) == sorted(ALL)


def test_the_unseen_objects_are_others_and_all_in_the_test_split():
    assert len(UNSEEN) == len(set(UNSEEN)) == 20
    assert not set(UNSEEN) & set(OBJECTS)
    assert {split_of(name) for name in UNSEEN} == {"test"}
    settings = preset_settings("unseen")
    assert settings.objects == UNSEEN and settings.rig.camera.width == 960
    assert {plan.split for plan in plan_build(settings)} == {"test"}


@pytest.mark.parametrize("name", ("v_groove", "concave_dish", "hinged_leaves", "honeycomb", "hollow_cube"))
def test_concave_ones_are_far_from_their_hull(meshes, name):
    """Parts of them see each other: there the light of further bounces counts."""
    assert meshes[name].volume < 0.85 * meshes[name].convex_hull.volume


@pytest.mark.parametrize("name", ALL)
def test_mesh_is_a_closed_solid(meshes, name):
    mesh = meshes[name]
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert mesh.body_count == 1
    assert mesh.nondegenerate_faces().all()
    assert np.isfinite(mesh.vertices).all()
    assert len(mesh.faces) < 60_000
    assert len(mesh.faces) > 500 or name in ("step_wedge", "v_groove")  # which have few planes


@pytest.mark.parametrize("name", ALL)
def test_mesh_is_centred_and_within_the_working_range(meshes, name):
    vertices = meshes[name].vertices
    np.testing.assert_allclose(vertices.min(axis=0) + vertices.max(axis=0), 0, atol=1e-12)
    near, far = (depth / 1000 for depth in WORKING_RANGE_MM)
    assert np.hypot(vertices[:, 0], vertices[:, 1]).max() <= min(STANDOFF_M - near, far - STANDOFF_M) - 0.004
    for degrees in VIEW_DEGREES:
        across, down, away = turned(vertices, degrees).T
        depth = away + STANDOFF_M
        reach = FOCAL_PX * np.abs(np.stack([across, down], axis=1)) / depth[:, None]
        assert reach.max() <= IMAGE_PX / 2 - MARGIN_PX


@pytest.mark.parametrize("name", ALL)
def test_every_view_covers_3_to_40_percent(views, name):
    cover = np.array([len(depth) / SIZE**2 for depth in views[name]])
    assert cover.min() >= 0.03
    assert cover.max() <= 0.40


def test_covers_and_depth_ranges_are_the_papers(views):
    views = {name: views[name] for name in OBJECTS}
    cover = np.array([len(depth) / SIZE**2 for sample in views.values() for depth in sample])
    spread = {name: [np.ptp(depth) for depth in sample] for name, sample in views.items()}
    assert 0.09 <= cover.mean() <= 0.11
    assert cover.max() >= 0.30
    assert 70 <= np.median([value for sample in spread.values() for value in sample]) <= 90
    deepest = max(spread, key=lambda name: max(spread[name]))
    assert deepest == "wooden_boards"
    assert 445 <= max(spread[deepest]) <= 475


def test_no_view_is_flat(views):
    """A view of one single depth would have no range to normalise by."""
    assert min(np.ptp(depth) for sample in views.values() for depth in sample) > 5


@pytest.mark.parametrize("name", ("bowl", "mug"))
def test_vessels_are_hollow(views, meshes, name):
    """The first view looks into them: far less material than their convex hull."""
    assert meshes[name].volume < 0.45 * meshes[name].convex_hull.volume


def test_six_views_of_an_object_differ(views):
    """Nothing is so round that two of its views are the same picture."""
    for name, sample in views.items():
        prints = {depth.round(3).tobytes() for depth in sample}
        assert len(prints) == len(VIEW_DEGREES), name


def test_the_same_name_gives_the_same_bytes(meshes):
    for name in ALL[::3]:
        assert _digest(object_mesh(name)) == _digest(meshes[name]), name


def test_another_process_gives_the_same_bytes(meshes):
    names = ("banana", "lighting_candles", "power_drill", "wooden_boards", "blob", "gear")
    code = (
        "import hashlib, sys; from fpp_ml_bench.loaders.render.objects import object_mesh\n"
        "for name in sys.argv[1:]:\n"
        "    m = object_mesh(name); print(hashlib.sha256(m.vertices.tobytes() + m.faces.tobytes()).hexdigest())"
    )
    out = subprocess.run([sys.executable, "-c", code, *names], capture_output=True, text=True, check=True).stdout
    assert out.split() == [_digest(meshes[name]) for name in names]


def test_an_unknown_name_is_refused_with_near_ones():
    with pytest.raises(MeshError, match=r"'wooden_board'.*wooden_boards"):
        object_mesh("wooden_board")
    with pytest.raises(MeshError, match="there are master_chef_can"):
        object_mesh("zzzz")
