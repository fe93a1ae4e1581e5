"""Users' own meshes: the four formats with scale and pose, and every way a file or a list of them
can be wrong."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from fpp_ml_bench.constants import OBJECTS
from fpp_ml_bench.errors import MeshError
from fpp_ml_bench.loaders.render.mesh_files import read_mesh
from fpp_ml_bench.loaders.render.meshes import (
    load_user_mesh,
    read_mesh_list,
    single_mesh,
    solid_mesh,
    write_ply,
)
from fpp_ml_bench.loaders.render.scene import UserMesh

SUFFIXES = ("obj", "ply", "stl", "glb")


@pytest.fixture(scope="module")
def wedge():
    """A closed mesh without any symmetry: the hull of seven points, in millimetres."""
    points = np.add(np.random.default_rng(8).uniform(-60, 60, (7, 3)), [5, -9, 30])
    return trimesh.convex.convex_hull(points)


def corner_distance(points, expected):
    """Largest distance from a vertex of either set to the nearest of the other (STL repeats
    vertices)."""
    apart = np.linalg.norm(points[:, None] - expected[None], axis=2)
    return max(apart.min(axis=0).max(), apart.min(axis=1).max())


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("centre", [True, False])
def test_scale_turns_and_shift(tmp_path, wedge, suffix, centre):
    path = tmp_path / f"part.{suffix}"
    wedge.export(path)
    angles, offset = (20.0, -35.0, 100.0), (0.01, -0.02, 0.03)
    mesh = load_user_mesh(UserMesh("part", str(path), 0.001, angles, offset, centre))
    expected = Rotation.from_euler("xyz", angles, degrees=True).apply(
        wedge.vertices * 0.001
    )  # about the fixed axes
    if centre:
        expected -= (expected.max(axis=0) + expected.min(axis=0)) / 2
    assert corner_distance(mesh.vertices_m, expected + offset) < 1e-7
    assert len(mesh.faces) == len(wedge.faces)
    assert (
        mesh.name == "part" and mesh.vertices_m.dtype == np.float64 and mesh.faces.dtype == np.int32
    )
    again = trimesh.Trimesh(mesh.vertices_m, mesh.faces)  # merges what STL repeats
    assert again.is_watertight and again.volume == pytest.approx(wedge.volume * 1e-9, rel=1e-5)


def test_several_parts_in_one_file_are_one_mesh(tmp_path):
    box, scene = trimesh.creation.box((1, 1, 1)), trimesh.Scene()
    scene.add_geometry(box)
    scene.add_geometry(box, transform=trimesh.transformations.translation_matrix([4, 0, 0]))
    path = tmp_path / "two.glb"
    scene.export(path)
    mesh = load_user_mesh(UserMesh("two", str(path)))
    assert len(mesh.faces) == 24
    np.testing.assert_allclose(np.ptp(mesh.vertices_m, axis=0), [5, 1, 1])


def test_obj_with_a_latin1_comment_and_a_missing_material_file(tmp_path, wedge):
    text = trimesh.exchange.obj.export_obj(wedge)
    path = tmp_path / "part.obj"
    path.write_bytes("# Gehäuse für Müller\nmtllib nothing.mtl\n".encode("latin-1") + text.encode())
    mesh = load_user_mesh(UserMesh("part", str(path), centre=False))
    assert corner_distance(mesh.vertices_m, wedge.vertices) < 1e-6


def test_ply_of_a_mesh_reads_back(tmp_path):
    mesh, path = solid_mesh("cork"), tmp_path / "meshes" / "a.ply"
    write_ply(mesh, path)
    back = trimesh.load(path, process=False)
    np.testing.assert_allclose(back.vertices, mesh.vertices_m, atol=1e-7)
    np.testing.assert_array_equal(back.faces, mesh.faces)


@pytest.mark.parametrize(
    ("suffix", "damage"),
    [
        (suffix, damage)
        for suffix in SUFFIXES
        for damage in ("empty", "noise", "almost whole")
        if not (suffix == "obj" and damage == "almost whole")  # a shorter OBJ is an OBJ
    ],
)
def test_damaged_files_are_refused_by_name(tmp_path, wedge, capfd, suffix, damage):
    path = tmp_path / f"part.{suffix}"
    wedge.export(path)
    whole = path.read_bytes()
    content = {
        "empty": b"",
        "noise": np.random.default_rng(3).bytes(900),
        "almost whole": whole[:-7],
    }[damage]
    path.write_bytes(content)
    with pytest.raises(MeshError, match=f"part.{suffix}"):
        load_user_mesh(UserMesh("part", str(path)))
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "not there|can't be read"),
        ("v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "not finite"),
        ("v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "triangles|can't be read"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles"),
    ],
)
def test_meshes_that_are_none(tmp_path, content, says):
    path = tmp_path / "part.obj"
    path.write_text(content)
    with pytest.raises(MeshError, match=says):
        load_user_mesh(UserMesh("part", str(path)))


def test_a_file_that_went_away(tmp_path):
    with pytest.raises(MeshError, match="can't be read"):
        load_user_mesh(UserMesh("part", str(tmp_path / "gone.stl")))


@pytest.fixture
def part(tmp_path, wedge):
    path = tmp_path / "Part 1.stl"
    wedge.export(path)
    return path


def write_list(folder, text):
    path = folder / "list.yaml"
    path.write_text(text)
    return path


def test_list_reads_every_key(part):
    entry = (
        f"- {{name: my_part, path: {part.name}, scale: 0.001, rotation_deg: [90, 0, 0.5], "
        "offset_m: [0, 0, 0.1], centre: false, split: train}"
    )
    (mesh,) = read_mesh_list(write_list(part.parent, entry))
    assert mesh == UserMesh(
        "my_part", str(part), 0.001, (90.0, 0.0, 0.5), (0.0, 0.0, 0.1), False, "train", mesh.content
    )
    assert len(mesh.content) == 32
    part.write_bytes(part.read_bytes()[:-1] + b"x")
    (changed,) = read_mesh_list(part.parent / "list.yaml")
    assert changed.content != mesh.content


def test_single_mesh_is_named_after_its_file(part):
    mesh = single_mesh(part)
    assert (mesh.name, mesh.scale, mesh.split) == ("part_1", 1.0, "test")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "expected a list"),
        ("[1, 2]", "entry 1:\n  the file as a whole: Input should be a valid dictionary"),
        ("- {name: x}", "path: is missing"),
        ("- {name: x, path: PART, sclae: 2}", "sclae: is not a key"),
        ("- {name: X y, path: PART}", "name: String should match"),
        ("- {name: mug, path: PART}", "one of the benchmark's own"),
        ("- {name: gear, path: PART}", "one of the benchmark's own"),
        ("- {name: x, path: nothing.stl}", "no mesh file"),
        ("- {name: x, path: PART, split: val}", r"split: Input should be .* \(got 'val'\)"),
        ("- {name: x, path: PART, scale: 0}", "scale: Input should be greater than 0"),
        ("- {name: x, path: PART, scale: true}", "scale: Input should be a valid number"),
        ("- {name: x, path: PART, rotation_deg: [0, 0]}", "rotation_deg.2: is missing"),
        (
            "- {name: x, path: PART, offset_m: [0, 0, null]}",
            "offset_m.2: Input should be a valid number",
        ),
        ("- {name: x, path: PART, centre: 'yes'}", "centre: Input should be a valid boolean"),
        ("- {name: x, path: PART}\n- {name: x, path: PART}", "given twice"),
        ("- {name: ok, path: PART}\n- {name: x, path: PART, scale: 0}", "entry 2"),
    ],
)
def test_bad_lists_are_refused(part, text, says):
    path = write_list(part.parent, text.replace("PART", part.name))
    with pytest.raises(MeshError, match=says) as caught:
        read_mesh_list(path)
    assert str(path) in str(caught.value)


def test_a_list_that_is_not_there(tmp_path):
    with pytest.raises(MeshError, match="can't be read"):
        read_mesh_list(tmp_path / "none.yaml")


def test_own_names_can_never_meet_the_benchmarks(part):
    path = part.with_name(f"{OBJECTS[0]}.stl")
    part.rename(path)
    with pytest.raises(MeshError, match="own objects"):
        single_mesh(path)


def test_a_mesh_is_read_from_the_present_folder_by_a_process_that_started_in_another(
    tmp_path, monkeypatch
):
    """The process that read an earlier mesh waits for the next one, also when the folder it started
    in is gone."""
    texts = [
        "mtllib paint.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        "newmtl a\nKd {} 0 0\n",
    ]
    hashes = []
    for name, red in (("first", 0.2), ("second", 0.9)):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "mesh.obj").write_text(texts[0])
        (folder / "paint.mtl").write_text(texts[1].format(red))
        monkeypatch.chdir(folder)
        hashes += read_mesh(Path("mesh.obj"))[3]
        monkeypatch.chdir(tmp_path)
        shutil.rmtree(folder)
    assert len(set(hashes)) == 2
