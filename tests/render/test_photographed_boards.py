"""Photographed boards: where the print's edges are, poses that fit, and captures on disk that can
be continued."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from captures import opencv_matrix
from conftest import file_bytes
from rendering import PAPER

from fpp_ml_bench.calibration.boards import Board, parse_board
from fpp_ml_bench.errors import BuildError, CalibrationError, CaptureError
from fpp_ml_bench.files import strict_yaml
from fpp_ml_bench.loaders.captures.images import read_frames
from fpp_ml_bench.loaders.render.boards.captures import board_frames, board_studio, photograph_board
from fpp_ml_bench.loaders.render.boards.poses import (
    PAPER_BOARD,
    BoardPose,
    board_poses,
    fitting_board,
    sheet_corners_mm,
)
from fpp_ml_bench.loaders.render.boards.sheet import DARK, board_view
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig_file import load_rig
from fpp_ml_bench.optics.sequence import Sequence

RIG = replace(paper_rig(240), sequence=Sequence(steps=3))
BENT = replace(RIG, camera=replace(RIG.camera, distortion=(-0.3, 0.1, 0.004, -0.003, 0.0)))
BOARD = fitting_board(RIG)
TILTED = BoardPose(
    tuple(map(tuple, cv2.Rodrigues(np.array([0.3, -0.35, 0.2]))[0])), (-0.08, -0.16, 1.7)
)


def radiance(rig, board, pose):
    """Grey levels of the white frame before the sensor, (H, W), 0 where only the plane is seen."""
    studio = board_studio(rig, board, PAPER)
    view = board_view(studio, board, pose, ("noise",))
    image = np.zeros(rig.camera.width * rig.camera.height, dtype=np.float32)
    for pixels, lit in ((view.hits.pixels, view.lit), (view.mixed.pixels, view.mixed_lit)):
        values = np.empty((1, pixels.size), dtype=np.float32)
        image[pixels] = studio.exposure.radiance((rig.sequence.white,), lit, ("noise",), values)[0]
    return image.reshape(rig.camera.height, -1).astype(np.float64)


def by_opencv(rig, pose, points_mm):
    turn = cv2.Rodrigues(np.array(pose.rotation))[0]
    shift = 1000 * np.array(pose.translation_m)
    lens = np.array(rig.camera.distortion)
    return cv2.projectPoints(points_mm, turn, shift, opencv_matrix(rig.camera), lens)[0][:, 0]


@pytest.mark.parametrize("rig", [RIG, BENT], ids=["straight", "bent"])
@pytest.mark.parametrize("kind", ["circles", "circles-asymmetric"])
def test_circles_have_their_centroid_where_opencv_projects_their_outline(rig, kind):
    board = (
        Board("circles", 5, 9, 50.0, 15.0) if kind == "circles" else Board(kind, 3, 9, 40.0, 15.0)
    )
    image = radiance(rig, board, TILTED)
    errors = []
    y, x = np.mgrid[: rig.camera.height, : rig.camera.width]
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    for centre in board.points_mm():
        outline = centre + board.radius_mm * np.stack(
            [np.cos(angle), np.sin(angle), 0 * angle], axis=-1
        )
        outline = by_opencv(rig, TILTED, outline)
        moments = cv2.moments((256 * (outline - outline[0])).astype(np.float32))
        expected = np.array([moments["m10"], moments["m01"]]) / moments["m00"] / 256 + outline[0]
        away = np.hypot(x - expected[0], y - expected[1])
        near, ring = away < 7.0, (away > 6.0) & (away < 7.5)
        design = np.stack([x, y, np.ones_like(x)], axis=-1).astype(float)
        white = (
            design @ np.linalg.lstsq(design[ring], image[ring], rcond=None)[0]
        )  # the light varies over the board
        dark = np.where(near, 1 - image / white, 0.0)
        errors.append(
            [
                (dark * x).sum() / dark.sum() - expected[0],
                (dark * y).sum() / dark.sum() - expected[1],
            ]
        )
        area = cv2.contourArea(outline.astype(np.float32))
        assert dark.sum() / (1 - DARK) == pytest.approx(
            area, rel=0.04
        )  # ambient light is dark on the print too
    assert np.sqrt(np.mean(np.square(errors))) < 0.003 and np.abs(errors).max() < 0.01


def test_the_corners_of_a_checker_are_where_opencv_projects_them():
    rig, board = replace(paper_rig(480), sequence=Sequence(steps=3)), Board("checker", 7, 9, 40.0)
    frame = board_frames(board_studio(rig, board, PAPER), board, TILTED, "pose")[rig.sequence.white]
    found = board.find(frame)
    expected = by_opencv(rig, TILTED, board.points_mm())
    nearest = np.abs(found[:, None] - expected).sum(-1).argmin(axis=1)
    assert len(set(nearest)) == 63
    error = (
        found - expected[nearest]
    )  # on a picture supersampled 16 times the finder itself has 0.047 px RMS
    assert np.sqrt(np.mean(error**2)) < 0.06 and np.abs(error.mean(axis=0)).max() < 0.02


def test_the_boards_of_the_papers_rig():
    assert len(board_poses(paper_rig(), PAPER_BOARD)) == 18
    assert (BOARD.kind, BOARD.columns, BOARD.rows, BOARD.spacing_mm, BOARD.radius_mm) == (
        "circles",
        5,
        9,
        50.0,
        15.0,
    )
    assert fitting_board(paper_rig(), "checker", 7, 9).radius_mm == 0


@pytest.mark.parametrize("rig", [paper_rig(), BENT], ids=["paper", "bent"])
def test_poses_fit_and_are_spread(rig):
    poses = board_poses(rig, BOARD)
    (left, top), (right, bottom) = sheet_corners_mm(BOARD)
    corners_m = (
        np.array([[left, top, 0], [right, top, 0], [right, bottom, 0], [left, bottom, 0]]) / 1000
    )
    normals, middles = [], []
    for pose in poses:
        rotation = np.array(pose.rotation)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        placed = corners_m @ rotation.T + pose.translation_m
        assert placed[:, 2].min() >= 1.5 - 1e-9 and placed[:, 2].max() <= 2.1 + 1e-9
        for device, places in (
            (rig.camera, rig.camera.project(placed)),
            (rig.projector, rig.project(placed)),
        ):
            largest = np.max(places, axis=1)
            assert np.min(places) > 0
            assert (largest < [device.width - 1, device.height - 1]).all()
        normals.append(rotation[:, 2])
        u, v = rig.camera.project(placed.mean(axis=0))
        middles.append((u / rig.camera.width, v / rig.camera.height, placed[:, 2].mean()))
    assert (
        len(poses) == 18 and min(normal[2] for normal in normals) >= np.cos(np.radians(30)) - 1e-9
    )
    tilted = np.array(normals)[:, :2]
    assert (np.ptp(tilted, axis=0) > 0.6).all()  # both ways about both axes
    assert (np.ptp(middles, axis=0) > [0.3, 0.3, 0.3]).all()
    assert poses == board_poses(rig, BOARD)


def test_a_board_that_does_not_fit_or_can_not_be_printed():
    with pytest.raises(CalibrationError, match=r"does not fit .* circles:5x9:50 would suit"):
        board_poses(RIG, Board("circles", 5, 9, 90.0, 20.0))
    for board in (
        Board("circles", 5, 9, 50.0),
        Board("circles", 5, 9, 50.0, 30.0),
        Board("charuco", 5, 7, 40.0, 30.0),
    ):
        with pytest.raises(CalibrationError, match=r"radius below half|charuco"):
            board_studio(RIG, board)


def test_captures_on_disk_and_continued(tmp_path):
    poses, counted = board_poses(RIG, BOARD, 3), []
    folders = photograph_board(tmp_path / "out", RIG, BOARD, poses, progress=counted.append)
    assert [folder.name for folder in folders] == ["pose_00", "pose_01", "pose_02"]
    assert counted == [len(RIG.sequence)] * 3
    content = file_bytes(tmp_path / "out")
    assert len(content) == 3 * len(RIG.sequence) + 2
    stated = strict_yaml(content["board.yaml"].decode())
    assert parse_board(stated["board"]) == BOARD and len(stated["poses"]) == 3
    assert json.loads(json.dumps(stated))["light"]["name"] == "paper"
    assert load_rig(tmp_path / "out/rig.yaml") == RIG
    captured = read_frames(folders[1])
    made = board_frames(board_studio(RIG, BOARD), BOARD, poses[1], "pose_01")
    np.testing.assert_array_equal(captured.frames, made)

    for frame in folders[1].iterdir():  # as a killed run leaves it
        frame.unlink()
    folders[1].rename(folders[1].with_name(".pose_01.tmp"))
    kept = (folders[0] / "frame_00.png").stat().st_mtime_ns
    photograph_board(tmp_path / "out", RIG, BOARD, poses)
    assert file_bytes(tmp_path / "out") == content
    assert (folders[0] / "frame_00.png").stat().st_mtime_ns == kept


def test_folders_that_are_refused(tmp_path):
    poses = board_poses(RIG, BOARD, 1)
    photograph_board(tmp_path / "out", RIG, BOARD, poses)
    others = (
        {"seed": 7},
        {"light": named_light("workshop")},
        {"poses": board_poses(RIG, BOARD, 2)},
        {"board": Board("circles", 5, 9, 40.0, 12.0)},
    )
    for change in others:
        asked = {"rig": RIG, "board": BOARD, "poses": poses, **change}
        with pytest.raises(CaptureError, match="another board, rig, light, seed or poses"):
            photograph_board(tmp_path / "out", **asked)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "rig.yaml").write_text("mine")
    with pytest.raises(CaptureError, match=r"other files \(rig.yaml\)"):
        photograph_board(tmp_path / "mine", RIG, BOARD, poses)
    assert (tmp_path / "mine" / "rig.yaml").read_text() == "mine"
    with pytest.raises(CaptureError, match="is a file"):
        photograph_board(tmp_path / "mine" / "rig.yaml", RIG, BOARD, poses)
    with pytest.raises(BuildError, match="seed -1"):
        photograph_board(tmp_path / "new", RIG, BOARD, poses, seed=-1)
    assert not (tmp_path / "new").exists()
