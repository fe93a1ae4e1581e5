"""The ground-truth meshes: closed, repeatable, inside the working range; the 50 are of the paper's
scene statistics."""

import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh

from fpp_ml_bench.constants import (
    OBJECTS,
    STANDOFF_M,
    UNSEEN,
    VIEW_DEGREES,
    WORKING_RANGE_MM,
    split_of,
)
from fpp_ml_bench.errors import MeshError
from fpp_ml_bench.loaders.render.builder import plan_build
from fpp_ml_bench.loaders.render.meshes import MESHES_FILE, solid_mesh, stored_mesh
from fpp_ml_bench.loaders.render.raycast import PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import preset_settings, turned

FOCAL_PX, IMAGE_PX = 2285.77, 960  # the paper's camera
SIZE = 120
ALL = (*OBJECTS, *UNSEEN)
MARGIN_PX = 6  # of the 960: no object may come nearer to the image border


@cache
def mesh_of(name):
    solid = solid_mesh(name)
    return trimesh.Trimesh(solid.vertices_m, solid.faces, process=False, validate=False)


@cache
def views_of(name):
    """Visible depths (n,) in mm of an object's six views, on a coarse grid of the paper's camera,
    which stands 1.8 m before the turning axis."""
    line = (np.arange(SIZE) - (SIZE - 1) / 2) * IMAGE_PX / SIZE / FOCAL_PX
    rays, solid = PixelRays(*np.meshgrid(line, line)), solid_mesh(name)
    placed = (
        np.add(turned(solid.vertices_m, degrees), [0, 0, STANDOFF_M]) for degrees in VIEW_DEGREES
    )
    return [1000.0 * TracedObject(solid, vertices_m).primary(rays).depth_m for vertices_m in placed]


def test_the_file_holds_every_object_and_no_other():
    with np.load(MESHES_FILE) as stored:
        names = {key.rpartition(".")[0] for key in stored}
    assert names == set(ALL)


def test_a_packed_mesh_is_read_as_it_was(monkeypatch, tmp_path):
    steps, faces = stored_mesh("gear")
    file = tmp_path / "objects.npz"
    packed = {"gear.vertices": steps[::-1], "gear.faces": faces[::-1]}
    rows = {name: np.diff(values, axis=0, prepend=0) for name, values in packed.items()}
    np.savez_compressed(file, **rows)
    monkeypatch.setattr("fpp_ml_bench.loaders.render.meshes.MESHES_FILE", file)
    again_steps, again_faces = stored_mesh("gear")
    np.testing.assert_array_equal(again_steps, steps[::-1])
    np.testing.assert_array_equal(again_faces, faces[::-1])


@pytest.mark.processes
def test_the_drawings_give_the_meshes():
    """With the manifold3d that CI pins. One of each module, and one of those that are drawn by a
    formula."""
    names = ("banana", "lighting_candles", "power_drill", "gear", "blob")
    script = Path(__file__).parents[2] / "benchmarks/objects/draw.py"
    done = subprocess.run(
        [sys.executable, script, "--check", *names], capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (0, "5 of 5 drawings are the package's meshes\n"), (
        done.stderr
    )


def test_the_unseen_objects_are_others_and_all_in_the_test_split():
    assert len(UNSEEN) == len(set(UNSEEN)) == 20
    assert not set(UNSEEN) & set(OBJECTS)
    assert {split_of(name) for name in UNSEEN} == {"test"}
    settings = preset_settings("unseen")
    assert settings.objects == UNSEEN and settings.rig.camera.width == 960
    assert {plan.split for plan in plan_build(settings)} == {"test"}


@pytest.mark.parametrize(
    ("most_of_hull", "names"),
    [
        (0.45, ("bowl", "mug")),
        (0.85, ("v_groove", "concave_dish", "hinged_leaves", "honeycomb", "hollow_cube")),
    ],
    ids=["vessels", "concave"],
)
def test_hollow_ones_are_far_from_their_hull(most_of_hull, names):
    """Parts of them see each other: there the light of further bounces counts."""
    for name in names:
        assert mesh_of(name).volume < most_of_hull * mesh_of(name).convex_hull.volume, name


@pytest.mark.parametrize("name", ALL)
def test_mesh_is_a_closed_solid(name):
    mesh = mesh_of(name)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert mesh.body_count == 1
    assert mesh.nondegenerate_faces().all()
    assert np.isfinite(mesh.vertices).all()
    assert len(mesh.faces) < 60_000
    assert len(mesh.faces) > 500 or name in ("step_wedge", "v_groove")  # which have few planes


@pytest.mark.parametrize("name", ALL)
def test_mesh_is_centred_and_within_the_working_range(name):
    vertices = mesh_of(name).vertices
    np.testing.assert_allclose(vertices.min(axis=0) + vertices.max(axis=0), 0, atol=1e-12)
    near, far = (depth / 1000 for depth in WORKING_RANGE_MM)
    assert (
        np.hypot(vertices[:, 0], vertices[:, 1]).max()
        <= min(STANDOFF_M - near, far - STANDOFF_M) - 0.004
    )
    for degrees in VIEW_DEGREES:
        across, down, away = turned(vertices, degrees).T
        depth = away + STANDOFF_M
        reach = FOCAL_PX * np.abs(np.stack([across, down], axis=1)) / depth[:, None]
        assert reach.max() <= IMAGE_PX / 2 - MARGIN_PX


@pytest.mark.long
@pytest.mark.parametrize("name", ALL)
def test_every_view_covers_3_to_40_percent(name):
    cover = [len(depth) / SIZE**2 for depth in views_of(name)]
    assert min(cover) >= 0.03 and max(cover) <= 0.40


@pytest.mark.long
def test_covers_and_depth_ranges_are_the_papers():
    cover = np.array([len(depth) / SIZE**2 for name in OBJECTS for depth in views_of(name)])
    spread = {name: [np.ptp(depth) for depth in views_of(name)] for name in OBJECTS}
    assert 0.09 <= cover.mean() <= 0.11 and cover.max() >= 0.30
    assert 70 <= np.median(list(spread.values())) <= 90
    deepest = max(spread, key=lambda name: max(spread[name]))
    assert deepest == "wooden_boards" and 445 <= max(spread[deepest]) <= 475


@pytest.mark.long
@pytest.mark.parametrize("name", ALL)
def test_no_view_is_flat_and_six_views_of_an_object_differ(name):
    """A view of one single depth would have no range to normalise by; nothing is so round that two
    of its views are the same picture."""
    assert min(np.ptp(depth) for depth in views_of(name)) > 5
    assert len({depth.round(3).tobytes() for depth in views_of(name)}) == len(VIEW_DEGREES)


def test_an_unknown_name_is_refused_with_near_ones():
    with pytest.raises(MeshError, match=r"'wooden_board'.*wooden_boards"):
        solid_mesh("wooden_board")
    with pytest.raises(MeshError, match="there are master_chef_can"):
        solid_mesh("zzzz")
