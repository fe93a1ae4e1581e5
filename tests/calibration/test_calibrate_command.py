"""``fpp-bench calibrate`` from photographed boards, and the chain that it stands in: patterns,
captures, rig, depth."""

import shutil

import cv2
import numpy as np
import pytest
import yaml

from fpp_ml_bench.cli import main
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.opencv_files import read_opencv_calibration
from fpp_ml_bench.optics.rig_file import load_rig, save_rig

pytestmark = pytest.mark.long

SIZE = 240


def calibrate(*words):
    return main(["calibrate", *map(str, words)])


@pytest.fixture(scope="module")
def virtual(tmp_path_factory):
    """Five poses at 240 px with three steps and their Gray code; the rig found from them."""
    folder = tmp_path_factory.mktemp("virtual")
    data = {
        **paper_rig(SIZE).to_dict(),
        "sequence": {"steps": 3, "bits_horizontal": 7, "bits_vertical": 7},
    }
    (folder / "true.yaml").write_text(yaml.safe_dump(data))
    words = ("--true-rig", folder / "true.yaml", "--poses", 5, "--out", folder / "found.yaml")
    assert (
        calibrate(
            "--virtual",
            folder / "boards",
            *words,
            "--lens",
            "none",
            "--opencv",
            folder / "found.xml",
        )
        == 0
    )
    return folder


def test_the_paper_s_calibration_finds_the_rig_that_photographed(virtual, capsys):
    found, true = load_rig(virtual / "found.yaml"), load_rig(virtual / "true.yaml")
    assert (found.sequence, found.working_range_mm) == (true.sequence, true.working_range_mm)
    assert found.camera.fx == pytest.approx(true.camera.fx, rel=5e-3)
    assert found.baseline_m == pytest.approx(true.baseline_m, rel=5e-3)
    assert read_opencv_calibration(virtual / "found.xml").camera == found.camera
    assert (virtual / "found.png").read_bytes().startswith(b"\x89PNG")


def test_a_second_run_photographs_nothing_and_says_how_far_it_is_from_the_truth(virtual, capsys):
    before = {path: path.stat().st_mtime_ns for path in (virtual / "boards").rglob("*.png")}
    words = (
        "--true-rig",
        virtual / "true.yaml",
        "--poses",
        5,
        "--out",
        virtual / "again.yaml",
        "--lens",
        "none",
    )
    assert calibrate("--virtual", virtual / "boards", *words) == 0
    assert before == {path: path.stat().st_mtime_ns for path in (virtual / "boards").rglob("*.png")}
    printed = capsys.readouterr()
    assert (
        "against truth" in printed.out
        and "warning:" not in printed.err
        and "note:" not in printed.err
    )
    assert "standard uncertainty of the depth by this calibration" in printed.out
    first, again = (load_rig(virtual / f"{name}.yaml") for name in ("found", "again"))
    assert again.baseline_m == pytest.approx(first.baseline_m, rel=1e-9)
    stated = f"as an error of the projector's coordinate: {again.calibration_px:.3f} px"
    assert 0.01 < again.calibration_px < 1 and stated in printed.out


def test_from_captures_a_wrong_spacing_scales_the_rig(virtual, tmp_path):
    board = yaml.safe_load((virtual / "boards" / "board.yaml").read_text())["board"]
    kind, grid, spacing, radius = board.split(":")
    small = f"{kind}:{grid}:{0.95 * float(spacing)}:{0.95 * float(radius)}"
    words = (
        "--sequence",
        virtual / "boards" / "rig.yaml",
        "--lens",
        "none",
        "--out",
        tmp_path / "rig.yaml",
    )
    assert calibrate(virtual / "boards", "--board", small, *words) == 0
    found, right = load_rig(tmp_path / "rig.yaml"), load_rig(virtual / "found.yaml")
    assert found.baseline_m / right.baseline_m == pytest.approx(0.95, abs=2e-3)
    assert found.background_m is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "expected one of CAPTURES"),
        (("BOARDS",), "need --board"),
        (("BOARDS", "--board", "circles:5x9:50:15"), "need --board"),
        (("BOARDS", "--board", "circles:7x9:50:15", "--sequence", "TRUE"), "was not found"),
        (
            ("BOARDS", "--board", "BOARD", "--sequence", "TRUE", "--baseline", "-1"),
            "baseline_mm: expected a positive",
        ),
        (
            ("BOARDS", "--board", "BOARD", "--sequence", "other.yaml"),
            "expected 52 frames, found 22",
        ),
        (("BOARDS", "--board", "BOARD", "--sequence", "ONE"), "codes vertical only"),
        (("NOWHERE", "--board", "BOARD", "--sequence", "TRUE"), "no such folder"),
        (
            ("BOARDS", "--board", "circles:5x9:0.05:0.015", "--sequence", "TRUE"),
            "--board, in mm, gives a baseline of",
        ),
        (("--virtual", "boards", "--size", "20"), "--size 20: expected 64"),
        (
            ("--virtual", "boards", "--size", "240", "--board", "circles:5x9:500:150"),
            "does not fit",
        ),
    ],
)
def test_bad_input_is_a_sentence_and_no_rig_is_written(
    virtual, tmp_path, monkeypatch, capsys, words, said
):
    monkeypatch.chdir(tmp_path)
    vertical = {"scheme": "phase-shift", "pitches_px": [48, 912], "steps": 3}
    one = {"projector": {"width": 912, "height": 1140}, "sequence": {"vertical": vertical}}
    save_rig(paper_rig(SIZE), tmp_path / "other.yaml")
    (tmp_path / "one.yaml").write_text(yaml.safe_dump(one))
    places = {
        "BOARDS": virtual / "boards",
        "TRUE": virtual / "true.yaml",
        "BOARD": "circles:5x9:50:15",
        "NOWHERE": "nowhere",
        "ONE": "one.yaml",
    }
    assert (
        calibrate(*(places.get(word, word) for word in words), "--out", tmp_path / "rig.yaml") == 2
    )
    error = capsys.readouterr().err
    assert said in error and "Traceback" not in error and not (tmp_path / "rig.yaml").exists()


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


@pytest.mark.parametrize("case", CHANGED)
def test_changed_captures_are_refused(virtual, tmp_path, capsys, case):
    """Each image is what a function of all images, the pose and the name gives."""
    change, said = CHANGED[case]

    def photographed(pose, name):
        return cv2.imread(str(virtual / "boards" / f"pose_{pose:02d}" / name), cv2.IMREAD_UNCHANGED)

    for pose in range(3):
        folder = tmp_path / "boards" / f"pose_{pose:02d}"
        folder.mkdir(parents=True)
        for file in (virtual / "boards" / folder.name).glob("*.png"):
            cv2.imwrite(str(folder / file.name), change(photographed, pose, file.name))
    words = (
        "--board",
        "circles:5x9:50:15",
        "--sequence",
        virtual / "true.yaml",
        "--out",
        tmp_path / "rig.yaml",
    )
    assert calibrate(tmp_path / "boards", *words) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "rig.yaml").exists()


def test_two_poses_are_too_few(virtual, tmp_path, capsys):
    for pose in ("pose_00", "pose_01"):
        shutil.copytree(virtual / "boards" / pose, tmp_path / "boards" / pose)
    words = ("--board", "circles:5x9:50:15", "--sequence", virtual / "true.yaml")
    assert calibrate(tmp_path / "boards", *words, "--out", tmp_path / "rig.yaml") == 2
    assert "at least 3 poses of the board, found 2" in capsys.readouterr().err


def test_poses_that_are_refused_calibrate_anyway_and_are_named(virtual, tmp_path, capsys):
    boards = tmp_path / "boards"
    shutil.copytree(virtual / "boards", boards)
    frames = [boards / "pose_03" / f"frame_{index:02d}.png" for index in (1, 2)]
    frames[1].write_bytes(frames[0].read_bytes())
    board = yaml.safe_load((boards / "board.yaml").read_text())["board"]
    words = (
        boards,
        "--board",
        board,
        "--sequence",
        boards / "rig.yaml",
        "--out",
        tmp_path / "r.yaml",
    )
    assert calibrate(*words, "--lens", "none") == 2
    assert "pose_03: equal frames: frame_01.png and frame_02.png" in capsys.readouterr().err
    assert calibrate(*words, "--lens", "none", "--anyway") == 0
    assert "warning: pose_03: equal frames" in capsys.readouterr().err


def test_three_poses_leave_none_out_and_say_so(virtual, tmp_path, capsys):
    for pose in ("pose_00", "pose_01", "pose_02"):
        shutil.copytree(virtual / "boards" / pose, tmp_path / "boards" / pose)
    board = yaml.safe_load((virtual / "boards" / "board.yaml").read_text())["board"]
    words = (
        "--board",
        board,
        "--sequence",
        virtual / "boards" / "rig.yaml",
        "--out",
        tmp_path / "rig.yaml",
    )
    assert calibrate(tmp_path / "boards", *words) == 0
    printed = capsys.readouterr()
    assert (
        "note: 3 poses: none can be left out" in printed.err
        and "the lens is radial-1. Capture four" in printed.err
    )
    assert "nan" not in printed.out + printed.err + (tmp_path / "rig.yaml").read_text()


def test_all_poses_without_a_board_are_named(virtual, tmp_path, capsys):
    boards = tmp_path / "boards"
    shutil.copytree(virtual / "boards", boards)
    for pose in (1, 3):
        for file in (boards / f"pose_{pose:02d}").glob("*.png"):
            image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(file), np.where(np.arange(SIZE) < SIZE // 2, 30, image))
    board = yaml.safe_load((boards / "board.yaml").read_text())["board"]
    words = (
        "--board",
        board,
        "--sequence",
        boards / "rig.yaml",
        "--out",
        tmp_path / "rig.yaml",
        "--anyway",
    )
    assert calibrate(boards, *words) == 2
    error = capsys.readouterr().err
    assert "2 poses can't be used" in error and "dots, in columns" in error
    assert (
        "pose_01: the board" in error and "pose_03: the board" in error and "pose_02" not in error
    )


def test_gray_code_alone_calibrates(tmp_path, capsys):
    """Cells of 2 px in both directions: no sinusoid, and so no response is measured."""
    data = paper_rig(SIZE).to_dict()
    del data["pitch_px"]
    code = {"scheme": "gray", "cell_px": 2}
    codes = {
        "order": ["vertical", "horizontal", "white", "black"],
        "vertical": code,
        "horizontal": dict(code),
    }
    (tmp_path / "true.yaml").write_text(yaml.safe_dump({**data, "sequence": codes}))
    words = (
        "--true-rig",
        tmp_path / "true.yaml",
        "--poses",
        4,
        "--lens",
        "none",
        "--out",
        tmp_path / "rig.yaml",
    )
    assert calibrate("--virtual", tmp_path / "boards", *words) == 0
    said = capsys.readouterr().out
    assert "response" not in said and "against truth" in said
    assert load_rig(tmp_path / "rig.yaml").baseline_m == pytest.approx(
        paper_rig().baseline_m, rel=0.02
    )
