"""``fpp-bench calibrate`` from photographed boards, and the chain that it stands in: patterns,
captures, rig, depth."""

import cv2
import numpy as np
import pytest
import yaml
from captures import rig_with
from conftest import fpp_bench, printed, read_image, refusal

from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.opencv_files import read_opencv_calibration
from fpp_ml_bench.optics.rig_file import load_rig, save_rig

pytestmark = pytest.mark.long

SIZE = 240
BOARD = "circles:5x9:50:15"


def calibrate(*words):
    return fpp_bench("calibrate", *words)


@pytest.fixture(scope="module")
def virtual(tmp_path_factory):
    """Five poses at 240 px with three steps and their Gray code; the rig found from them."""
    folder = tmp_path_factory.mktemp("virtual")
    rig = rig_with({"steps": 3, "bits_horizontal": 7, "bits_vertical": 7}, SIZE)
    save_rig(rig, folder / "true.yaml")
    files = f"--out {folder}/found.yaml --opencv {folder}/found.xml"
    assert calibrate(photographing(folder), files) == 0
    return folder


def photographing(folder):
    return f"--virtual {folder}/boards --true-rig {folder}/true.yaml --poses 5 --lens none"


def test_the_paper_s_calibration_finds_the_rig_that_photographed(virtual):
    found, true = load_rig(virtual / "found.yaml"), load_rig(virtual / "true.yaml")
    assert (found.sequence, found.working_range_mm) == (true.sequence, true.working_range_mm)
    assert found.camera.fx == pytest.approx(true.camera.fx, rel=5e-3)
    assert found.baseline_m == pytest.approx(true.baseline_m, rel=5e-3)
    assert read_opencv_calibration(virtual / "found.xml").camera == found.camera
    assert (virtual / "found.png").read_bytes().startswith(b"\x89PNG")


def test_a_second_run_photographs_nothing_and_says_how_far_it_is_from_the_truth(virtual, capsys):
    before = {path: path.stat().st_mtime_ns for path in (virtual / "boards").rglob("*.png")}
    assert calibrate(photographing(virtual), "--out", virtual / "again.yaml") == 0
    assert before == {path: path.stat().st_mtime_ns for path in (virtual / "boards").rglob("*.png")}
    said = capsys.readouterr()
    assert "warning:" not in said.err and "note:" not in said.err
    first, again = (load_rig(virtual / f"{name}.yaml") for name in ("found", "again"))
    assert again.baseline_m == pytest.approx(first.baseline_m, rel=1e-9)
    assert 0.01 < again.calibration_px < 1
    for words in (
        "against truth",
        "standard uncertainty of the depth by this calibration",
        f"as an error of the projector's coordinate: {again.calibration_px:.3f} px",
    ):
        assert words in said.out


def test_from_captures_a_wrong_spacing_scales_the_rig(virtual, tmp_path):
    words = f"--board circles:5x9:47.5:14.25 --lens none --out {tmp_path}/rig.yaml"
    assert calibrate(f"{virtual}/boards --sequence {virtual}/boards/rig.yaml", words) == 0
    found, right = load_rig(tmp_path / "rig.yaml"), load_rig(virtual / "found.yaml")
    assert found.baseline_m / right.baseline_m == pytest.approx(0.95, abs=2e-3)
    assert found.background_m is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("", "expected one of CAPTURES"),
        ("BOARDS", "need --board"),
        ("BOARDS --board BOARD", "need --board"),
        ("BOARDS --board circles:7x9:50:15 --sequence TRUE", "was not found"),
        (
            "BOARDS --board BOARD --sequence TRUE --baseline -1",
            "baseline_mm: expected a positive",
        ),
        ("BOARDS --board BOARD --sequence other.yaml", "expected 52 frames, found 22"),
        ("BOARDS --board BOARD --sequence one.yaml", "codes vertical only"),
        ("nowhere --board BOARD --sequence TRUE", "no such folder"),
        (
            "BOARDS --board circles:5x9:0.05:0.015 --sequence TRUE",
            "--board, in mm, gives a baseline of",
        ),
        ("--virtual boards --size 20", "--size 20: expected 64"),
        ("--virtual boards --size 240 --board circles:5x9:500:150", "does not fit"),
    ],
)
def test_bad_input_is_a_sentence_and_no_rig_is_written(virtual, tmp_path, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    vertical = {"scheme": "phase-shift", "pitches_px": [48, 912], "steps": 3}
    one = {"projector": {"width": 912, "height": 1140}, "sequence": {"vertical": vertical}}
    save_rig(paper_rig(SIZE), tmp_path / "other.yaml")
    (tmp_path / "one.yaml").write_text(yaml.safe_dump(one))
    places = {"BOARDS": virtual / "boards", "TRUE": virtual / "true.yaml", "BOARD": BOARD}
    words = (places.get(word, word) for word in words.split())
    assert said in refusal(calibrate, *words, "--out rig.yaml")
    assert not (tmp_path / "rig.yaml").exists()


EXCHANGED = {"frame_20.png": "frame_21.png", "frame_21.png": "frame_20.png"}
"""Black and white."""
VERTICAL = {f"frame_{index:02d}.png" for index in (3, 4, 5, *range(13, 20))}
CHANGED = {
    "flat": (
        lambda of, pose, name: of(pose, EXCHANGED.get(name, name) if pose == 1 else name),
        "pose_01: white and black: white has",
    ),
    "copied": (
        lambda of, pose, name: of(min(pose, 1), name),
        "pose_02: image 0 is that of pose_01 (image 0)",
    ),
    "mixed": (
        lambda of, pose, name: np.roll(
            of(pose, name), 60 if pose == 1 and name in VERTICAL else 0, axis=1
        ),
        "scene moved",
    ),
    "sizes": (
        lambda of, pose, name: of(pose, name)[: 200 if pose == 2 else SIZE],
        "expected 240 x 240 px as in pose_00",
    ),
}


def with_copies(virtual, folder, poses, change=lambda of, pose, name: of(pose, name)):
    """Words that calibrate from copies of poses, of which each image is what ``change`` makes of a
    function of all images, the pose and the name."""

    def photographed(pose, name):
        return read_image(virtual / "boards" / f"pose_{pose:02d}" / name)

    for pose in range(poses):
        (folder / f"boards/pose_{pose:02d}").mkdir(parents=True)
        for file in (virtual / f"boards/pose_{pose:02d}").glob("*.png"):
            image = change(photographed, pose, file.name)
            cv2.imwrite(str(folder / f"boards/pose_{pose:02d}" / file.name), image)
    words = f"--board {BOARD} --sequence {virtual}/boards/rig.yaml --out {folder}/rig.yaml"
    return f"{folder}/boards {words}"


@pytest.mark.parametrize("case", CHANGED)
def test_changed_captures_are_refused(virtual, tmp_path, case):
    change, said = CHANGED[case]
    assert said in refusal(calibrate, with_copies(virtual, tmp_path, 3, change))
    assert not (tmp_path / "rig.yaml").exists()


def test_all_poses_without_a_board_are_named(virtual, tmp_path):
    def half_dark(of, pose, name):
        return np.where((np.arange(SIZE) < SIZE // 2) & (pose != 1), 30, of(pose, name))

    error = refusal(calibrate, with_copies(virtual, tmp_path, 3, half_dark), "--anyway")
    assert "2 poses can't be used" in error and "dots, in columns" in error
    assert "pose_00: the board" in error and "pose_02: the board" in error
    assert "pose_01" not in error


def test_two_poses_are_too_few(virtual, tmp_path):
    said = refusal(calibrate, with_copies(virtual, tmp_path, 2))
    assert "at least 3 poses of the board, found 2" in said


def test_poses_that_are_refused_calibrate_anyway_and_are_named(virtual, tmp_path, capsys):
    words = with_copies(virtual, tmp_path, 5) + " --lens none"
    frames = [tmp_path / f"boards/pose_03/frame_{index:02d}.png" for index in (1, 2)]
    frames[1].write_bytes(frames[0].read_bytes())
    said = refusal(calibrate, words)
    assert "pose_03: equal frames: frame_01.png and frame_02.png" in said
    assert calibrate(words, "--anyway") == 0
    assert "warning: pose_03: equal frames" in capsys.readouterr().err


def test_three_poses_leave_none_out_and_say_so(virtual, tmp_path, capsys):
    assert calibrate(with_copies(virtual, tmp_path, 3)) == 0
    said = capsys.readouterr()
    assert "note: 3 poses: none can be left out" in said.err
    assert "the lens is radial-1. Capture four" in said.err
    assert "nan" not in said.out + said.err + (tmp_path / "rig.yaml").read_text()


def test_gray_code_alone_calibrates(tmp_path):
    """Cells of 2 px in both directions: no sinusoid, and so no response is measured."""
    code = {"scheme": "gray", "cell_px": 2}
    order = ["vertical", "horizontal", "white", "black"]
    rig = rig_with({"order": order, "vertical": code, "horizontal": code}, SIZE)
    save_rig(rig, tmp_path / "true.yaml")
    said = printed(calibrate, photographing(tmp_path), "--out", tmp_path / "rig.yaml")
    assert "response" not in said and "against truth" in said
    assert load_rig(tmp_path / "rig.yaml").baseline_m == pytest.approx(
        paper_rig().baseline_m, rel=0.02
    )
