"""Calibrations in OpenCV's files: the names of several tools, round trips, and files that must be
refused."""

import math
import random
from dataclasses import replace

import cv2
import numpy as np
import pytest

from fpp_ml_bench.errors import RigError
from fpp_ml_bench.optics.opencv_files import (
    OpenCvCalibration,
    read_opencv_calibration,
    write_opencv_calibration,
)
from fpp_ml_bench.optics.pinhole import Pinhole

CAMERA = Pinhole(640, 480, 800.1, 801.7, 319.3, 241.9, (-0.1, 0.02, 0.001, -0.002, 0.01))
PROJECTOR = Pinhole(
    912, 1140, 1500.5, 1501.25, 455.5, 1100.0, (0.1, 0.0, 0.0, 0.0, 0.0, 0.2, 0.01, -0.01)
)
TURN = cv2.Rodrigues(np.array([0.1, -0.3, 0.05]))[0]
T_MM = np.array([-145.28, -36.498, 67.923])
VALUES = {
    "M1": np.array([[800.1, 0, 319.3], [0, 801.7, 241.9], [0, 0, 1]]),
    "D1": np.array([CAMERA.distortion]),
    "M2": np.array([[1500.5, 0, 455.5], [0, 1501.25, 1100.0], [0, 0, 1]]),
    "D2": np.array([PROJECTOR.distortion]),
    "R": TURN,
    "T": T_MM[:, None],
    "imageSize1": [640, 480],
    "imageSize2": [912, 1140],
}
SLSTUDIO = ("Kc", "kc", "Kp", "kp", "Rp", "Tp")
PROCAMCALIB = ("cam_K", "cam_kc", "proj_K", "proj_kc", "R", "T")
OPENCV = ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2", "R", "T")


def write(path, values):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        if isinstance(value, list):
            storage.startWriteStruct(name, cv2.FileNode_SEQ)
            for number in value:
                storage.write("", number)
            storage.endWriteStruct()
        else:
            storage.write(name, value)
    storage.release()
    return path


def changed(**changes):
    return {name: value for name, value in {**VALUES, **changes}.items() if value is not None}


@pytest.mark.parametrize("suffix", ["xml", "yaml", "json"])
def test_opencvs_names(tmp_path, suffix):
    read = read_opencv_calibration(write(tmp_path / f"calibration.{suffix}", VALUES))
    assert read.camera == CAMERA and read.projector == PROJECTOR
    np.testing.assert_allclose(read.rotation, TURN, atol=1e-15)
    assert read.translation_m == tuple((T_MM / 1000).tolist())
    assert read.errors_px == (None, None, None)


@pytest.mark.parametrize("names", [SLSTUDIO, PROCAMCALIB, OPENCV])
def test_other_names(tmp_path, names):
    matrices = (VALUES[name] for name in ("M1", "D1", "M2", "D2", "R", "T"))
    errors = {"cam_error": 0.28, "proj_error": 0.46, "stereo_error": 0.42}
    values = {**dict(zip(names, matrices, strict=True)), **errors}
    expected = read_opencv_calibration(write(tmp_path / "a.xml", VALUES))
    expected = replace(expected, errors_px=(0.28, 0.46, 0.42))
    bare = write(tmp_path / "b.xml", values)
    given = {"camera_size": (640, 480), "projector_size": (912, 1140)}
    assert read_opencv_calibration(bare, **given) == expected
    sizes = {"frameWidth": 640, "frameHeight": 480, "screenResX": 912, "screenResY": 1140}
    assert read_opencv_calibration(write(tmp_path / "c.yml", {**values, **sizes})) == expected


def test_a_translation_in_metres(tmp_path):
    read = read_opencv_calibration(
        write(tmp_path / "a.yml", changed(T=T_MM[None] / 1000)), unit="m"
    )
    np.testing.assert_allclose(read.translation_m, T_MM / 1000, rtol=1e-15)


def test_a_rotation_in_float32_becomes_an_exact_one(tmp_path):
    rounded = TURN.astype(np.float32)
    read = read_opencv_calibration(write(tmp_path / "a.xml", changed(R=rounded)))
    matrix = np.array(read.rotation)
    assert np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-15
    np.testing.assert_allclose(matrix, TURN, atol=1e-7)


@pytest.mark.parametrize("suffix", ["xml", "yaml", "yml", "json"])
def test_writing_and_reading_gives_equal_numbers(tmp_path, suffix):
    turn = tuple(map(tuple, TURN.tolist()))
    for unit, translation in (
        ("mm", tuple((np.random.default_rng(3).normal(size=3) * 100 / 1000).tolist())),
        ("m", (1 / 3, 1e-17, -0.1)),
    ):
        errors_px = (0.1 + 0.2, None, 5e-324)
        calibration = OpenCvCalibration(CAMERA, PROJECTOR, turn, translation, errors_px)
        path = tmp_path / f"calibration.{suffix}"
        write_opencv_calibration(calibration, path, unit)
        read = read_opencv_calibration(path, unit=unit)
        np.testing.assert_allclose(read.translation_m, translation, rtol=2e-16)
        assert replace(read, translation_m=translation) == calibration
        write_opencv_calibration(read, path, unit)
        assert read_opencv_calibration(path, unit=unit) == read


def test_the_written_file_is_a_stereo_calibration_for_opencv(tmp_path):
    write_opencv_calibration(
        read_opencv_calibration(write(tmp_path / "a.xml", VALUES)), tmp_path / "b.yml"
    )
    storage = cv2.FileStorage(str(tmp_path / "b.yml"), cv2.FILE_STORAGE_READ)
    for name in ("M1", "D1", "M2", "D2", "R", "T"):
        np.testing.assert_allclose(storage.getNode(name).mat(), VALUES[name], rtol=1e-15)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (changed(M1=None), "camera matrix: expected a node M1 or cameraMatrix1.*found D1, M2"),
        (changed(Kc=VALUES["M1"]), "camera matrix.*found M1 and Kc; keep one"),
        (
            changed(R=np.array([[0.1, 0.2, 0.3]])),
            r"R .*expected 3 x 3 numbers, found shape \(1, 3\)",
        ),
        (changed(R="none"), "R .rotation.: expected a matrix, found none"),
        (changed(D1=np.zeros((2, 3))), "D1 .*expected a vector"),
        (
            changed(D1=np.zeros((1, 6))),
            "camera: distortion: expected 4 or 5 or 8 or 12 or 14 numbers, got 6",
        ),
        (changed(M2=VALUES["M2"] * [[1], [np.nan], [1]]), "M2 .*expected finite"),
        (changed(T=np.zeros((3, 1))), "translation is zero"),
        (
            changed(M1=VALUES["M1"] + np.diag([3.0, 0.0], 1)),
            "camera matrix: expected fx 0 cx.*no skew",
        ),
        (changed(R=TURN + 1e-3), "rotation: not orthonormal.*may be 1e-05"),
        (changed(R=TURN * [[1], [1], [-1]]), "rotation: determinant is -1"),
        (
            changed(imageSize1=None),
            r"size of the camera is not stored.*camera_size=\(width, height\)",
        ),
        (changed(imageSize2=[912.5, 1140]), "size of the projector: expected width and height"),
        (changed(cam_error="small"), "cam_error: expected a reprojection error in px"),
        (b"", "empty"),
        (b"\xff\xfe\x00", "expected text"),
        (b"just words", "OpenCV can't read it"),
        (b"[1, 2]", "no named nodes"),
        (b'<?xml version="1.0"?>\n<opencv_storage>', "OpenCV can't read it|expected a node"),
        (
            b'<?xml version="1.0"?>\n<opencv_storage><R type_id="opencv-matrix"><rows>3</rows>'
            b"<cols>3</cols><dt>d</dt><data>\n1 2</data></R></opencv_storage>",
            "node R is incomplete, or its numbers do not fill",
        ),
    ],
)
def test_wrong_calibrations_are_refused(tmp_path, values, message):
    path = tmp_path / "calibration.yml"
    if isinstance(values, bytes):
        path.write_bytes(values)
    else:
        path = write(tmp_path / "calibration.xml", values)
    with pytest.raises(RigError, match=message) as caught:
        read_opencv_calibration(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "keys"),
    [
        (
            "ros.yaml",
            "image_width: 640\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [8, 0, 3, 0, 8, 2, 0, "
            "0, 1]\n",
            "image_width, camera_matrix",
        ),
        (
            "flow.yml",
            "camera: {K: [800, 0, 320, 0, 800, 240, 0, 0, 1], D: [0, 0, 0, 0, 0]}\n",
            "camera",
        ),
        ("alone.json", '{\n\t"camera": {"K": [[800, 0], [0]], "D": null}}', "camera"),
    ],
)
def test_a_sound_file_of_another_layout_is_not_called_damaged(tmp_path, name, content, keys):
    (tmp_path / name).write_text(content)
    with pytest.raises(RigError) as caught:
        read_opencv_calibration(tmp_path / name)
    assert str(caught.value) == (
        f"{tmp_path / name}: is well-formed, but of another layout: expected the nodes M1, D1, M2, "
        f"D2, R, T (OpenCV's "
        f"matrices), found the keys {keys}; give the numbers in the rig file's own entries "
        f"(camera, projector, "
        "rotation, translation_m), or write the file by cv2.FileStorage"
    )


def test_arguments_that_contradict_or_make_no_sense_are_refused(tmp_path):
    path = write(tmp_path / "a.xml", VALUES)
    calibration = read_opencv_calibration(path)
    for call, message in (
        (
            lambda: read_opencv_calibration(path, unit="inch"),
            "unit: expected mm or m, got 'inch'",
        ),
        (
            lambda: read_opencv_calibration(path, camera_size=(320, 240)),
            r"camera_size is given as \(320, 240\), but the file says \(640, 480\)",
        ),
        (lambda: read_opencv_calibration(tmp_path), "not a regular file but a folder"),
        (lambda: read_opencv_calibration(tmp_path / "absent.xml"), "No such file"),
        (lambda: write_opencv_calibration(calibration, tmp_path / "a.txt"), "ending in"),
        (lambda: write_opencv_calibration(calibration, tmp_path / "no/a.xml"), "can't be written"),
    ):
        with pytest.raises(RigError, match=message):
            call()


def test_a_file_that_ends_opencvs_process_is_refused(tmp_path):
    """Random damage: a calibration of finite numbers, or a refusal, whatever OpenCV does."""
    draw = random.Random(5)
    text = write(tmp_path / "a.xml", VALUES).read_text()
    for _ in range(4):
        damaged = list(text)
        for _ in range(4):
            place = draw.randrange(len(damaged))
            damaged[place : place + draw.choice([1, 5, 200])] = draw.choice('<>/"0e.')
        (tmp_path / "b.xml").write_text("".join(damaged))
        try:
            read = read_opencv_calibration(tmp_path / "b.xml")
        except RigError:
            continue
        assert all(map(math.isfinite, (*read.translation_m, *np.ravel(read.rotation))))
