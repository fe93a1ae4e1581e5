"""The rig: compared with OpenCV's camera model, its files, and values that must be refused."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from captures import opencv_matrix, rig_with

from fpp_ml_bench.errors import RigError
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.opencv_files import OpenCvCalibration, write_opencv_calibration
from fpp_ml_bench.optics.pinhole import Pinhole, distort, fold_radius_squared, undistort
from fpp_ml_bench.optics.rig import Rig, rotation_matrix
from fpp_ml_bench.optics.rig_file import check_lengths, load_rig, rig_from_dict, save_rig
from fpp_ml_bench.optics.sequence import Sequence

DISTORTION = (-0.21, 0.11, 0.0013, -0.0021, -0.02)
CAMERA = Pinhole(60, 45, 80.0, 82.0, 28.3, 23.1, DISTORTION)


def test_paper_rig_has_the_papers_numbers():
    rig = paper_rig()
    assert rig.camera.fx == pytest.approx(2285.77, abs=0.01) == rig.camera.fy
    assert (rig.projector.width, rig.projector.height, rig.projector.fx) == (912, 1140, 1824.0)
    assert rig.baseline_m == pytest.approx(0.160, abs=1e-3)
    # 0.125 m to the camera's left, 0.1 m below (y is down)
    assert (-rig.R.T @ rig.t).tolist() == [-0.125, 0.1, 0.0]
    # Fringe periods in the working range and image px a period, worked out by hand from the
    # geometry.
    for direction, baseline_m in (("vertical", 0.125), ("horizontal", 0.1)):
        expected = 1824 * baseline_m * (1 / 1.5 - 1 / 2.1) / 18
        assert rig.periods_in_range(direction) == pytest.approx(expected, rel=1e-12)
    assert rig.image_px_per_period("vertical") == pytest.approx(18 * rig.camera.fx / 1824, rel=1e-9)


def test_scaling_keeps_the_field_and_the_projector():
    rig = paper_rig(960)
    small = rig.scaled(240)
    assert small == paper_rig(240) and small.projector == rig.projector
    # The image's borders, at -0.5 and W - 0.5, see the same directions at every size.
    for device in (rig.camera, small.camera):
        assert device.normalised(-0.5, device.height - 0.5) == pytest.approx(
            (-0.209995, 0.209995), abs=1e-9
        )


@pytest.mark.parametrize("size, refused", [(160, True), (170, True), (171, False), (960, False)])
def test_sampling_below_four_px_a_period_is_refused_with_a_pitch_that_does(size, refused):
    rig = paper_rig(size)
    if not refused:
        rig.check_sampling()
        return
    with pytest.raises(RigError, match="pitch of at least") as caught:
        rig.check_sampling()
    pitch = float(str(caught.value).split("pitch of at least ")[1].split(" px")[0])
    assert 18 < pitch < 20
    data = rig.to_dict()
    data["pitch_px"] = {"horizontal": pitch, "vertical": pitch}
    rig_from_dict(data).check_sampling()


def test_projection_matches_opencv():
    rng = np.random.default_rng(3)
    points = rng.uniform((-0.4, -0.3, 1.5), (0.4, 0.3, 2.1), (200, 3))
    turn, shift = np.array([0.1, -0.2, 0.05]), np.array([0.12, -0.1, 0.03])
    turned = rotation_matrix(tuple(turn))
    rig = Rig(paper_rig(240).camera, CAMERA, turned, shift, 4.0, 4.0, Sequence(4, 5, 5))
    lens = np.array(DISTORTION)
    expected, _ = cv2.projectPoints(points, turn, shift, opencv_matrix(CAMERA), lens)
    np.testing.assert_allclose(np.stack(rig.project(points), axis=-1), expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(rig.R, cv2.Rodrigues(turn)[0], atol=1e-15)


def test_rays_project_back():
    x, y = CAMERA.rays()
    grid = np.meshgrid(np.arange(60.0), np.arange(45.0))
    np.testing.assert_allclose(CAMERA.pixels(x, y), grid, atol=1e-9)
    assert not x.flags.writeable and CAMERA.rays()[0] is x


def test_points_behind_a_device_have_no_image():
    u, v = paper_rig().project([[0, 0, -1.0], [0, 0, 0.0], [0, 0, 1.8]])
    assert np.isnan(u).tolist() == np.isnan(v).tolist() == [True, True, False]


@pytest.mark.parametrize("suffix", ["yaml", "yml", "json"])
def test_files_round_trip_to_the_last_bit(tmp_path, suffix):
    turn = rotation_matrix((0.1, 1e-9, -0.3))
    rig = Rig(
        CAMERA,
        paper_rig().projector,
        turn,
        (1 / 3, 1e-17, -0.1),
        17.3,
        18.1,
        Sequence(5, 8, 8),
        (1500, 2100.5),
    )
    path = tmp_path / f"rig.{suffix}"
    save_rig(rig, path)
    assert load_rig(path) == rig and hash(load_rig(path)) == hash(rig)
    assert np.array_equal(load_rig(path).R, turn)


def test_a_rotation_vector_is_taken(tmp_path):
    data = paper_rig().to_dict()
    data["rotation"] = [0.0, 0.1, 0.0]
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(data))
    np.testing.assert_allclose(
        load_rig(tmp_path / "rig.yaml").R[0], [np.cos(0.1), 0, np.sin(0.1)], atol=1e-15
    )


def _changed(path: str, value: object) -> dict:
    data = json.loads(json.dumps(paper_rig().to_dict()))
    *parents, last_key = path.split(".")
    entry = data
    for key in parents:
        entry = entry[key]
    entry[last_key] = value
    if value is ...:
        del entry[last_key]
    return data


@pytest.mark.parametrize(
    "path, value, message",
    [
        ("camera.fx", 0.0, "camera.fx.*positive"),
        ("camera.cx", float("nan"), "camera.cx.*finite"),
        ("camera.width", 12.5, "camera.width.*whole number"),
        ("projector.distortion", [0, 0, 0, 0], "projector.distortion.*5 numbers, got 4"),
        ("projector.fy", "1e3 px", "projector.fy.*number, got '1e3 px'"),
        ("camera.focal", 3.0, "camera.focal: unknown key"),
        ("camera.cy", ..., "camera.cy: missing"),
        ("rotation", [[1, 0, 0], [0, 1, 0], [0, 0, 1.01]], "orthonormal.*0.0201"),
        ("rotation", [[1, 0, 0], [0, 1, 0], [0, 0, -1]], "determinant is -1"),
        ("rotation", [[1, 0, 0], [0, 1, 0]], "rotation.*2 rows"),
        ("translation_m", [0, 0, 0], "baseline is zero"),
        ("pitch_px.vertical", 3.0, "pitch_px.vertical.*4 to 912"),
        ("pitch_px.horizontal", 17.0, "bits_horizontal.*8 bits, got 7"),
        ("pitch_px", {"vertical": 18}, "pitch_px.horizontal: missing"),
        ("sequence.steps", 2, "from 3 to 1000, got 2"),
        ("sequence.bits_vertical", 6, "102 Gray cells.*7 bits, got 6"),
        ("working_range_mm", [2100, 1500], "working_range_mm.*near < far"),
        ("standoff_m", 2.5, "standoff_m.*outside"),
        ("background_m", 2.0, "background_m.*beyond"),
    ],
)
def test_an_invalid_rig_is_refused_naming_file_and_key(tmp_path, path, value, message):
    file = tmp_path / "rig.yaml"
    file.write_text(yaml.safe_dump(_changed(path, value)))
    with pytest.raises(RigError, match=message) as caught:
        load_rig(file)
    assert str(caught.value).startswith(str(file))


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("rig.yaml", b"", "empty"),
        ("rig.yaml", b"just text", "expected a mapping"),
        ("rig.txt", b"camera: 1", "ending in .yaml"),
    ],
)
def test_unreadable_files_are_refused(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RigError, match=message) as caught:
        load_rig(tmp_path / name)
    assert name in str(caught.value)


def test_missing_file_and_unwritable_folder_are_rig_errors(tmp_path):
    with pytest.raises(RigError, match=r"absent.yaml: can't be read: No such file or directory$"):
        load_rig(tmp_path / "absent.yaml")
    with pytest.raises(RigError, match="can't be written"):
        save_rig(paper_rig(), tmp_path / "no" / "rig.yaml")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"translation_m": [200, 0, 0]},
            "translation_m gives a baseline of 200 m, which no rig has; as mm it would be 200 mm: "
            "divide by 1000",
        ),
        (
            {"translation_m": [0.0002, 0, 0]},
            "translation_m gives a baseline of 0.2 mm, .*; check its numbers",
        ),
        (
            {"translation_m": [1e6, 0, 0]},
            "translation_m gives a baseline of 1e.06 m, .*; check its numbers",
        ),
        (
            {"working_range_mm": [0.5, 1.5]},
            r"working_range_mm: 0.5 to 1.5 mm, .*like metres: write \[500, 1500\]",
        ),
        (
            {"working_range_mm": [2e6, 3e6]},
            r"working_range_mm: 2e\+06 to 3e\+06 mm, .*; check its unit, mm",
        ),
    ],
)
def test_lengths_in_a_unit_that_no_rig_has_are_refused(tmp_path, changes, message):
    data = {**paper_rig().to_dict(), "background_m": None, **changes}
    near, far = data["working_range_mm"]
    data["standoff_m"] = (near + far) / 2000
    (tmp_path / "rig.json").write_text(json.dumps(data))
    with pytest.raises(RigError, match=rf"rig.json: {message}"):
        load_rig(tmp_path / "rig.json")
    rig_from_dict(data)  # only files are checked


@pytest.mark.parametrize(
    ("stored", "unit", "message"),
    [
        (
            "m",
            "",
            "gives a baseline of 0.2 mm, which no rig has; as metres it would be 200 mm: "
            "write calibration: {file: ..., unit: m}",
        ),
        (
            "mm",
            ", unit: m",
            "gives a baseline of 200 m, which no rig has; as mm it would be 200 mm: "
            "write calibration: {file: ..., unit: mm}",
        ),
    ],
)
def test_a_calibration_read_in_the_wrong_unit_is_refused(tmp_path, stored, unit, message):
    rig = paper_rig()
    calibration = OpenCvCalibration(rig.camera, rig.projector, np.eye(3).tolist(), (0.2, 0.0, 0.0))
    write_opencv_calibration(calibration, tmp_path / "cal.yml", stored)
    rest = {key: rig.to_dict()[key] for key in ("sequence", "pitch_px", "working_range_mm")}
    file = tmp_path / "rig.yaml"
    file.write_text(f"calibration: {{file: cal.yml{unit}}}\n{yaml.safe_dump(rest)}")
    with pytest.raises(RigError) as caught:
        load_rig(file)
    assert str(caught.value) == f"{file}: cal.yml: the translation {message}"
    file.write_text(f"calibration: {{file: cal.yml, unit: {stored}}}\n{yaml.safe_dump(rest)}")
    assert load_rig(file).baseline_m == 0.2


def test_a_calibrated_rig_is_checked_by_what_gave_its_lengths():
    data = {**paper_rig().to_dict(), "translation_m": [0.0002, 0, 0]}
    expected = (
        "^the spacing gives a baseline of 0.2 mm, .* as metres it would be 200 mm: multiply by "
        "1000$"
    )
    with pytest.raises(RigError, match=expected):
        check_lengths(rig_from_dict(data), "the spacing")
    for length in (0.005, 20.0):
        check_lengths(rig_from_dict({**data, "translation_m": [length, 0, 0]}))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            {"translation_m": [0.0, 0.0, 0.005]},
            "translation_m gives a baseline that tells no depth: .*, by 7.8",
        ),
        (
            {"working_range_mm": [2e5, 3e5], "standoff_m": 250.0, "background_m": None},
            "far end, 300000 mm, by 1",
        ),
    ],
    ids=["short, on the axis", "far away"],
)
def test_a_baseline_that_tells_no_depth_is_refused(tmp_path, change, says):
    file = tmp_path / "rig.yaml"
    file.write_text(yaml.safe_dump({**paper_rig().to_dict(), **change}))
    with pytest.raises(RigError, match=f"{file}: .*{says}"):
        load_rig(file)


def test_a_projector_on_the_cameras_axis_is_taken(tmp_path):
    """It tells no depth in the middle of the image, and is no worse than others at the rim."""
    rig = replace(paper_rig(), translation_m=(0.0, 0.0, 0.05))
    save_rig(rig, tmp_path / "rig.yaml")
    assert load_rig(tmp_path / "rig.yaml") == rig


def test_a_code_along_the_baseline_alone_is_refused():
    code = {"scheme": "phase-shift", "pitch_px": 18, "steps": 4}
    rig = rig_with({"horizontal": code}, 960, translation_m=[0.16, 0, 0])
    with pytest.raises(RigError, match="with the horizontal frames an error"):
        check_lengths(rig)


def test_a_projector_that_looks_away_is_refused():
    paper, turn = paper_rig(), rotation_matrix((0.0, np.pi, 0.0))
    away = Rig(paper.camera, paper.projector, turn, (0.1, 0.0, 0.0))
    with pytest.raises(RigError, match="does not look at"):
        away.check_sampling()


@pytest.mark.parametrize("intrinsics", [(5e-324, 479.5), (1e-6, 479.5), (1e12, 479.5), (2e3, 1e12)])
def test_a_nearly_singular_intrinsic_matrix_is_refused(intrinsics):
    focal, centre = intrinsics
    with pytest.raises(RigError, match="nearly singular: condition number"):
        Pinhole(960, 960, focal, focal, centre, centre)


def test_a_lens_that_flattens_out_is_inverted_wherever_it_has_an_inverse():
    # Newton from the distorted point misses some of these.
    coefficients = (0.6, 0.9, 0.0, 0.0, -0.3)
    ideal = np.linspace(0.01, 0.98, 400) * np.sqrt(fold_radius_squared(coefficients))
    distorted = distort(ideal, np.zeros_like(ideal), coefficients)
    np.testing.assert_allclose(undistort(*distorted, coefficients)[0], ideal, rtol=1e-10)
