"""Depth of a capture as files: read back by other programs' readers, and compared with a plane and
a sphere."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io
import trimesh
from conftest import read_image
from PIL import Image

from fpp_ml_bench.errors import CaptureError
from fpp_ml_bench.loaders.captures.exports import (
    check_outputs,
    clear_outputs,
    export_capture,
    pixel_normals,
    triangles,
)
from fpp_ml_bench.optics.pinhole import Pinhole

CAMERA = Pinhole(64, 48, 90.0, 92.0, 30.3, 24.1, (-0.05, 0.01, 0.001, -0.001, 0.0))
X, Y = CAMERA.rays()
RAYS = np.stack([X, Y, np.ones_like(X)], axis=-1)
PLANE = np.array([0.3, -0.4, -np.sqrt(0.75)])  # its unit normal, towards the camera
PLANE_MM = -600.0 * PLANE[2] / -(PLANE[0] * X + PLANE[1] * Y + PLANE[2])  # 600 mm on the axis
CENTRE, RADIUS = np.array([10.0, -5.0, 700.0]), 150.0


def _sphere():
    """Depth float64 of a sphere, 0 beside it, and its normals."""
    square, along = (RAYS * RAYS).sum(-1), RAYS @ CENTRE
    root = along**2 - square * (CENTRE @ CENTRE - RADIUS**2)
    depth = np.where(root > 0, (along - np.sqrt(np.maximum(root, 0))) / square, 0.0)
    return depth, (RAYS * depth[..., None] - CENTRE) / RADIUS


def test_normals_of_a_plane():
    normals = pixel_normals(PLANE_MM, CAMERA)
    np.testing.assert_allclose(normals, np.broadcast_to(PLANE, normals.shape), atol=1e-12)
    rounded = pixel_normals(PLANE_MM.astype(np.float32), CAMERA)
    np.testing.assert_allclose(rounded, normals, atol=1e-4)


def test_normals_of_a_sphere():
    depth, expected = _sphere()
    normals = pixel_normals(depth.astype(np.float32), CAMERA)
    there = depth > 0
    assert np.isfinite(normals).all() and (normals[~there] == 0).all()
    np.testing.assert_allclose((normals[there] ** 2).sum(-1), 1, rtol=1e-12)
    inclined = -(expected * RAYS).sum(-1) / np.sqrt((RAYS * RAYS).sum(-1))
    inside = cv2.erode(there.astype(np.uint8), np.ones((3, 3))) > 0
    off = np.degrees(np.arccos(np.clip((normals * expected).sum(-1), -1, 1)))
    assert off[inside & (inclined > 0.6)].max() < 1.0 and there.sum() > 1000


def test_a_pixel_alone_faces_the_camera_and_steps_are_not_joined():
    depth = np.zeros((48, 64))
    depth[5, 7] = 500.0
    ray = RAYS[5, 7]
    alone = pixel_normals(depth, CAMERA)[5, 7]
    np.testing.assert_allclose(alone, -ray / np.sqrt(ray @ ray), rtol=1e-12)
    depth[:] = 500.0
    depth[:, 32:] = 600.0
    flat = pixel_normals(depth, CAMERA)
    np.testing.assert_allclose(flat, np.broadcast_to([0.0, 0.0, -1.0], flat.shape), atol=1e-12)
    assert len(triangles(depth, CAMERA)) == 2 * 47 * 62


def test_triangles_of_a_plane_are_its_normal_and_cover_it():
    faces = triangles(PLANE_MM, CAMERA)
    assert len(faces) == 2 * 47 * 63 and np.unique(faces).size == 48 * 64
    a, b, c = np.moveaxis((RAYS * PLANE_MM[..., None]).reshape(-1, 3)[faces], 1, 0)
    across = np.cross(b - a, c - a)
    across /= np.sqrt((across**2).sum(-1, keepdims=True))
    np.testing.assert_allclose(across, [PLANE] * len(faces), atol=1e-9)


@pytest.mark.parametrize("missing", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_three_pixels_of_a_square_make_a_triangle(missing):
    camera = Pinhole(2, 2, 90.0, 90.0, 0.5, 0.5)
    depth = np.full((2, 2), 500.0)
    depth[missing] = 0
    (face,) = triangles(depth, camera)
    assert sorted(face) == sorted({0, 1, 2, 3} - {missing[0] * 2 + missing[1]})
    depth[missing] = 500.0
    assert len(triangles(depth, camera)) == 2
    depth[0, 0], depth[0, 1] = 510.0, 0.0
    assert triangles(depth, camera).tolist() == [[0, 2, 3]]


@pytest.fixture
def written(tmp_path):
    depth, _ = _sphere()
    grey = np.add.outer(np.arange(48.0), np.arange(64)) * 2.25
    files = export_capture(tmp_path / "out", depth, CAMERA, grey)
    return depth.astype(np.float32), grey, {file.name: file for file in files}


def test_arrays_come_back_in_other_readers(written):
    depth, _, files = written
    arrays = "depth.mat", "depth.npy", "depth.pfm"
    assert sorted(files) == [*arrays, "depth_0.1mm.png", "mesh.ply", "points.ply"]
    for read in (
        np.load(files["depth.npy"]),
        scipy.io.loadmat(files["depth.mat"])["depthMap"],
        read_image(files["depth.pfm"]),
    ):
        assert read.dtype == np.float32 and np.array_equal(read, depth)
    levels = read_image(files["depth_0.1mm.png"])
    assert levels.dtype == np.uint16 and np.array_equal(levels > 0, depth > 0)
    np.testing.assert_allclose(levels * 0.1, depth, atol=0.05 + 1e-4)
    assert Image.open(files["depth_0.1mm.png"]).text == {"mm_per_level": "0.1"}


def test_points_and_mesh_lie_on_the_sphere(written):
    depth, grey, files = written
    header = files["points.ply"].read_bytes().partition(b"end_header")[0].decode()
    assert "binary_little_endian" in header
    assert re.findall(r"property \w+ (\w+)\n", header)[:10] == (
        ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha"]
    )
    cloud, mesh = trimesh.load(files["points.ply"]), trimesh.load(files["mesh.ply"], process=False)
    there = depth > 0
    for points in (cloud.vertices, mesh.vertices):
        assert len(points) == there.sum()
        np.testing.assert_allclose(np.sqrt(((points - CENTRE) ** 2).sum(-1)), RADIUS, atol=1e-3)
    u, v = CAMERA.project(mesh.vertices)
    row, column = np.nonzero(there)
    np.testing.assert_allclose((u, v), (column, row), atol=1e-4)
    normals = pixel_normals(depth, CAMERA)[there]
    np.testing.assert_allclose(mesh.vertex_normals, normals, atol=1e-6)
    assert (((mesh.vertices - CENTRE) * mesh.vertex_normals).sum(-1) > 0).all()
    assert (np.asarray(mesh.face_normals) @ [0, 0, 1] < 0.3).all()
    assert np.array_equal(mesh.visual.vertex_colors[:, 0], np.rint(grey[there]))


def test_the_grey_image_is_stored_unrounded(written):
    depth, grey, files = written
    content = files["points.ply"].read_bytes()
    fields = np.dtype([("geometry", "<f4", 6), ("colour", "u1", 4), ("intensity", "<f4")])
    start = content.index(b"end_header\n") + len(b"end_header\n")
    values = np.frombuffer(content, fields, int((depth > 0).sum()), start)
    assert np.array_equal(values["intensity"], grey[depth > 0].astype(np.float32))


@pytest.mark.parametrize(
    ("largest_mm", "name"),
    [
        (60.0, "depth_0.001mm.png"),
        (600.0, "depth_0.01mm.png"),
        (65534.0, "depth_1mm.png"),
        (65535.0, "depth_10mm.png"),
    ],
)
def test_the_png_takes_the_finest_unit_that_fits(tmp_path, largest_mm, name):
    depth = np.full((48, 64), largest_mm / 7)
    depth[0, 0], depth[0, 1] = largest_mm, 0
    (file,) = export_capture(tmp_path, depth, CAMERA, forms=["png"])
    assert file.name == name
    levels = read_image(file)
    unit = float(name.removeprefix("depth_").removesuffix("mm.png"))
    np.testing.assert_allclose(levels * unit, depth, atol=unit / 2 * 1.001)


def test_the_same_depth_gives_the_same_bytes(tmp_path):
    first, second = (export_capture(tmp_path / name, PLANE_MM, CAMERA) for name in "ab")
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()


NAN = np.where(np.arange(64) == 3, np.nan, PLANE_MM)


@pytest.mark.parametrize(
    ("depth", "options", "message"),
    [
        (
            PLANE_MM[:-1],
            {},
            r"depth_mm: expected real numbers of shape \(H, W\) = \(48, 64\).*\(47, 64\)",
        ),
        (PLANE_MM * 1j, {}, "depth_mm: expected real numbers.*complex"),
        (NAN, {}, "depth_mm: expected finite numbers from 0, which means none, up, got 48 others"),
        (-PLANE_MM, {}, "depth_mm: expected finite numbers.*got 3072 others"),
        (PLANE_MM * 1e300, {}, "depth_mm: expected finite numbers.*got 3072 others"),
        (PLANE_MM * 0, {}, "depth_mm: no pixel has a depth"),
        (PLANE_MM * 1e4, {}, "do not fit in a 16-bit PNG"),
        (PLANE_MM, {"grey": np.zeros((3, 3))}, "grey: expected real numbers of shape"),
        (
            PLANE_MM,
            {"grey": np.full((48, 64), 256.0)},
            "grey: expected finite numbers from 0 to 255, got 3072",
        ),
        (
            PLANE_MM,
            {"forms": ["obj"]},
            "forms: expected some of npy, mat, png, pfm, ply, mesh, got obj",
        ),
        (PLANE_MM, {"forms": []}, "forms: expected some of .*got none"),
    ],
)
def test_what_can_not_be_written_is_refused_and_nothing_is_left(tmp_path, depth, options, message):
    with pytest.raises(CaptureError, match=message):
        export_capture(tmp_path / "out", depth, CAMERA, **options)
    assert not (tmp_path / "out").exists()


def test_pixels_without_a_ray_have_no_point(tmp_path):
    camera = Pinhole(101, 5, 50.0, 50.0, 50.0, 2.0, (-0.5, 0.0, 0.0, 0.0, 0.0))
    (file,) = export_capture(tmp_path, np.full((5, 101), 500.0), camera, forms=["ply"])
    count = np.isfinite(camera.rays()[0]).sum()
    assert 0 < count < 505 and len(trimesh.load(file).vertices) == count


def _filled(folder, *others):
    """A folder with all that a decoding writes and what a killed one leaves, and ``others``."""
    export_capture(folder, PLANE_MM, CAMERA)
    names = (
        "decode.json",
        "sigma_mm.npy",
        "modulation.npy",
        "reason.npy",
        "picture.png",
        ".0123456789abcdef.tmp",
    )
    for name in (*names, ".fedcba9876543210.tmp", *others):
        (folder / name).write_text("")
    return folder


def test_what_a_decoding_wrote_is_removed_the_report_first(tmp_path, monkeypatch):
    removed, unlink = [], Path.unlink
    monkeypatch.setattr(
        Path,
        "unlink",
        lambda path, **options: (removed.append(path.name), unlink(path, **options))[0],
    )
    folder = _filled(tmp_path / "out")
    removed.clear()
    clear_outputs(folder)
    assert removed[0] == "decode.json" and len(removed) == 13 and not list(folder.iterdir())
    clear_outputs(folder)
    clear_outputs(tmp_path / "absent")
    assert not (tmp_path / "absent").exists()


@pytest.mark.parametrize(
    "name", ["notes.txt", "depth.npy.bak", ".depth.npy", ".depth.npy.7.tmp", "depth_mm.npy"]
)
def test_other_files_are_named_before_anything_is_removed(tmp_path, name):
    folder = _filled(tmp_path / "out", name)
    before = sorted(folder.iterdir())
    for refuse in (check_outputs, clear_outputs):
        expected = f"{folder}: holds files that no decoding writes: {name}; give a new folder"
        with pytest.raises(CaptureError, match=f"^{re.escape(expected)}$"):
            refuse(folder)
    assert sorted(folder.iterdir()) == before


def test_a_file_or_a_folder_in_the_place_of_the_results_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "out" / "depth.npy").mkdir(parents=True)
    for refuse in (check_outputs, clear_outputs):
        with pytest.raises(
            CaptureError, match="file: expected a folder for the results, found a file"
        ):
            refuse(tmp_path / "file")
        with pytest.raises(CaptureError, match=r"no decoding writes: depth\.npy"):
            refuse(tmp_path / "out")
    check_outputs(tmp_path / "absent")
