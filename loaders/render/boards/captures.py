"""Captures of a calibration board on disk, as a camera would leave them, beside the rig that took
them."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from shutil import rmtree

import numpy as np
import yaml
from numpy.typing import NDArray

from fpp_ml_bench.calibration.boards import Board
from fpp_ml_bench.containers import png_bytes
from fpp_ml_bench.errors import CaptureError
from fpp_ml_bench.files import LOCK_FILE, exclusive, write_atomically
from fpp_ml_bench.loaders.render.boards.poses import BoardPose
from fpp_ml_bench.loaders.render.boards.sheet import DARK, board_view, check_print
from fpp_ml_bench.loaders.render.light import Light, named_light
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.rig_file import load_rig, save_rig

BOARD_FILE, RIG_FILE = "board.yaml", "rig.yaml"


def board_studio(rig: Rig, board: Board, light: Light | None = None, seed: int = 42) -> Studio:
    """A studio for `board_frames`, without calibration error (``rig`` itself photographs), motion,
    and further bounces, which a flat board has not. Raises `CalibrationError` for a board that
    can't be printed, and what the builder raises for rig, light and seed."""
    check_print(board)
    light = (light or named_light("paper")).changed(motion_mm=0.0, calibration_px=0.0)
    light = light.changed("bounces", interreflection=False, ambient_occlusion=False)
    return Studio(
        BuildSettings(rig, ("mug",), light=light, seed=seed)
    )  # of no object, but settings name one


def board_frames(
    studio: Studio, board: Board, pose: BoardPose, name: str
) -> list[NDArray[np.uint8]]:
    """All frames of a pose, uint8 (H, W) each, in the order of the rig's sequence; ``name`` names
    the noise. They are views of memory that the next pose overwrites."""
    frames = tuple(range(len(studio.rig.sequence)))
    studio.expose(board_view(studio, board, pose, (studio.settings.seed, "board", name)), frames)
    return [studio.frame(index) for index in frames]


def photograph_board(
    folder: str | Path,
    rig: Rig,
    board: Board,
    poses: Sequence[BoardPose],
    light: Light | None = None,
    seed: int = 42,
    progress: Callable[[int], None] = lambda images: None,
) -> list[Path]:
    """Photograph ``board`` with ``rig`` in ``poses`` under ``light`` (by default `paper`), and return
    the poses' folders::

        FOLDER/pose_00/frame_00.png ...     8-bit grey, in the order of the rig's sequence
        FOLDER/board.yaml                   the board, as `parse_board` takes it; its true poses, light and seed
        FOLDER/rig.yaml                     the rig that took them: the truth for a calibration

    Images have the same grey levels on every processor. An interrupted run is continued: poses that
    are there are left as they are. ``progress`` is called with numbers of finished images. Raises
    `CaptureError` for a folder with other captures or files, one that can't be written, or that is
    in use by another process, `CalibrationError` for a board that does not
    fit, and what the builder raises for rig, light and seed."""
    place = Path(folder)
    studio = board_studio(rig, board, light, seed)
    described = yaml.safe_dump(
        _description(board, poses, studio), sort_keys=False, default_flow_style=None, width=120
    )
    names = [f"pose_{index:02d}" for index in range(len(poses))]
    try:
        with exclusive(place / LOCK_FILE, place, "writing this folder", CaptureError):
            _check_folder(place, described, rig)
            write_atomically(place / BOARD_FILE, described.encode())
            save_rig(rig, place / RIG_FILE)
            for name, pose in zip(names, poses, strict=True):
                if not (place / name).is_dir():
                    _write_pose(place, name, board_frames(studio, board, pose, name))
                progress(len(rig.sequence))
    except OSError as error:
        raise CaptureError(
            f"{place}: writing failed ({error.strerror or error}); remove the cause, then run the "
            f"same command again: "
            "it resumes"
        ) from error
    return [place / name for name in names]


def _description(board: Board, poses: Sequence[BoardPose], studio: Studio) -> dict:
    detail = f":{board.detail_mm!r}" if board.detail_mm else ""
    return {
        "board": f"{board.kind}:{board.columns}x{board.rows}:{board.spacing_mm!r}{detail}",
        "dark_over_white": DARK,
        "light": studio.light.model_dump(mode="json"),
        "seed": studio.settings.seed,
        "poses": [
            {
                "rotation": [list(row) for row in pose.rotation],
                "translation_m": list(pose.translation_m),
            }
            for pose in poses
        ],
    }


def _check_folder(place: Path, described: str, rig: Rig) -> None:
    """Raise `CaptureError` unless the folder is empty or an earlier run of the same captures left
    it."""
    others = sorted(path.name for path in place.iterdir() if path.name != LOCK_FILE)
    board_file, rig_file = place / BOARD_FILE, place / RIG_FILE
    if not board_file.is_file():
        if others:
            raise CaptureError(
                f"{place}: holds other files ({others[0]}), no {BOARD_FILE}; give a new or empty "
                f"folder"
            )
    elif board_file.read_bytes() != described.encode() or (
        rig_file.is_file() and load_rig(rig_file) != rig
    ):
        raise CaptureError(
            f"{place}: holds captures of another board, rig, light, seed or poses; give a new "
            f"folder, or the same "
            "settings to continue there"
        )


def _write_pose(place: Path, name: str, frames: list[NDArray[np.uint8]]) -> None:
    """Write a pose's folder, which gets its name when it is complete."""
    unfinished = place / f".{name}.tmp"
    rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir()
    digits = max(2, len(str(len(frames) - 1)))

    def write(index: int) -> None:
        (unfinished / f"frame_{index:0{digits}d}.png").write_bytes(png_bytes(frames[index]))

    with ThreadPoolExecutor() as pool:
        list(pool.map(write, range(len(frames))))
    unfinished.rename(place / name)
