"""Captures of a calibration board: a folder of frames for each pose, to the points that a calibration needs."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.calibration.boards import Board
from fpp_ml_bench.calibration.projector_points import Pose, measure_pose
from fpp_ml_bench.calibration.response import Levels, Response, fit_response, levels_of
from fpp_ml_bench.calibration.result import Calibration
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.errors import CalibrationError
from fpp_ml_bench.examination.examine import examine
from fpp_ml_bench.examination.findings import Examination, RefusedCapture
from fpp_ml_bench.files import visible
from fpp_ml_bench.loaders.captures.images import read_frames
from fpp_ml_bench.optics.rig import Rig, rotation_matrix
from fpp_ml_bench.optics.rig_file import load_projection
from fpp_ml_bench.optics.sequence import AXES

FEWEST_POSES = 3
RANGE_MARGIN = 0.1
"""A calibrated rig's working range is that of the boards' points, widened by this share of their distance."""


def pose_folders(captures: Path) -> list[Path]:
    """The folders of the poses below ``captures``, by name. Raises `CalibrationError` for fewer than three."""
    if not captures.is_dir():
        raise CalibrationError(f"{captures}: no such folder; expected one that holds a folder of frames for each pose")
    folders = [path for path in visible(captures, CalibrationError) if path.is_dir()]
    if len(folders) < FEWEST_POSES:
        raise CalibrationError(
            f"{captures}: expected folders of at least {FEWEST_POSES} poses of the board, found {len(folders)}"
        )
    return folders


def board_poses(
    captures: Path,
    board: Board,
    sequence: Path,
    bits: int | None = None,
    colour: str | None = None,
    progress: Callable[[int], None] = lambda poses: None,
    anyway: bool = False,
    examined: Callable[[str, Examination], None] = lambda name, examination: None,
) -> tuple[list[Pose], Rig, Response | None]:
    """The board's points in every pose folder of ``captures``, in camera and projector px, a rig with the sequence of
    the rig file ``sequence`` that stands in for the one sought (`optics.load_projection`), and the response of
    projector and camera where the captures tell it. ``bits`` and ``colour`` as in `read_frames`. The
    frames of every pose are examined; ``anyway`` takes those that are refused, too, and ``examined`` is called with a
    pose's name and what was found. Raises FppBenchError naming the
    pose or file."""
    rig = load_projection(sequence)
    if len(rig.directions) < 2:
        coded = " and ".join(rig.directions) or "crossed fringes"
        raise CalibrationError(
            f"{sequence}: codes {coded} only; a calibration needs the projector's columns and rows, so "
            "project both directions on the board"
        )
    poses: list[Pose] = []
    levels: list[Levels] = []
    seen: dict[int, tuple[Path, int]] = {}
    for folder in pose_folders(captures):
        capture = read_frames(folder, count=len(rig.sequence), bits=bits, colour=colour)
        frames = capture.frames
        height, width = frames.shape[1:]
        if not poses:
            rig = load_projection(sequence, (width, height))
        elif poses[0].size != (width, height):
            expected = f"{poses[0].size[0]} x {poses[0].size[1]} px as in {poses[0].name}"
            raise CalibrationError(f"{folder}: images of {width} x {height} px, expected {expected}")
        _check_copies(folder, frames, seen)
        examination = examine(frames, rig, capture.names, calibrated=False)
        if examination.refused and not anyway:
            raise RefusedCapture(str(folder), examination)
        examined(folder.name, examination)
        details = decode_stack(frames, rig, details=True).details
        white = rig.sequence.white
        lit = frames.mean(axis=0, dtype=np.float64) if white is None else frames[white]
        u_px, v_px = (details[direction].coordinate_px for direction in AXES)
        poses.append(measure_pose(folder.name, np.clip(np.rint(lit), 0, 255).astype(np.uint8), u_px, v_px, board))
        measured = levels_of(list(frames), (u_px, v_px), poses[-1], rig)
        levels += [] if measured is None else [measured]
        progress(1)
    return poses, rig, fit_response(levels)


def _check_copies(folder: Path, frames: NDArray, seen: dict[int, tuple[Path, int]]) -> None:
    """Raise `CalibrationError` for an image that an earlier pose holds, too, byte for byte; ``seen`` is filled."""
    for index, frame in enumerate(frames):
        if np.ptp(frame) == 0:
            continue
        key = hash(frame.tobytes())
        other, of_other = seen.setdefault(key, (folder, index))
        if other != folder:
            raise CalibrationError(
                f"{folder}: image {index} is that of {other.name} (image {of_other}), byte for byte: two poses "
                "can't share an image; put this pose's own frames there, or remove it"
            )


def calibrated_rig(found: Calibration, stand_in: Rig, range_mm: tuple[float, float] | None = None) -> Rig:
    """The rig of a calibration, with the sequence of ``stand_in``; its working range is ``range_mm``, or that of the
    boards' points and a margin."""
    depths = []
    for pose in found.poses:
        turn = rotation_matrix(pose.rotation_vector)
        depths.append(found.board_mm @ turn[2] + pose.translation_mm[2])
    near, far = range_mm or (float(np.min(depths)) * (1 - RANGE_MARGIN), float(np.max(depths)) * (1 + RANGE_MARGIN))
    return replace(
        stand_in,
        camera=found.camera.pinhole(),
        projector=found.projector.pinhole(),
        rotation=found.rotation,
        translation_m=found.translation_m,
    ).with_range((near, far))
