"""Where a calibration board stands: poses spread over the range, the image, and directions of tilt.

A pose takes points of the board (x to the right, y down, z away from the viewer, the first point at
0) to the camera's frame. Poses are computed with the same bits on every processor.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.calibration.boards import Board
from fpp_ml_bench.constants import GOLDEN, MM_PER_M, PLASTIC
from fpp_ml_bench.errors import CalibrationError
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.portable import cosine_of_turns, matrix_product, sine_of_turns

BOARD_POSES = 18
"""As many as the paper takes (Section 2.3)."""
PAPER_BOARD = Board("circles-asymmetric", 5, 9, 20.0, 5.0)
"""The paper's (Section 2.3): 5 x 9 asymmetric circles of 10 mm, 20 mm apart. Its sheet takes 7% of
the image at the standoff."""
MARGIN = {"checker": 1.5, "circles": 0.75, "circles-asymmetric": 0.75, "charuco": 1.5}
"""From the outer points to the end of the sheet, in spacings."""
COVERED = 0.65
"""Share of the image at the standoff that the longer side of `fitting_board` takes."""
MOST_TILT = 30 / 360
"""Largest tilt of a pose, in turns: 30 degrees."""
LEAST_TILT = 0.4
"""Least tilt of a pose, as a share of the largest: poses that face the camera do not tell the focal
length."""
NICE = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)
"""Spacings of a board in powers of ten of mm: round numbers that are easy to measure."""
_STEPS = 20
"""Steps in which a place in the image, and a distance in the range, is tried: one in twenty is near
enough to the farthest one."""
_MARGIN_PX = 2.0
"""Distance in px that the sheet keeps from the sides of image and pattern."""
_PLACES = ((0, 0), (-1, -1), (1, 1), (1, -1), (-1, 1), (0, -1), (0, 1), (-1, 0), (1, 0))
"""Places of the board, right and down from the middle: the middle, the corners, then the sides."""


@dataclass(frozen=True)
class BoardPose:
    """``rotation`` (three rows) and ``translation_m``: X_camera = rotation X_board +
    translation_m."""

    rotation: tuple[tuple[float, float, float], ...]
    translation_m: tuple[float, float, float]

    def points_m(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (n, 3) of the board in the camera's frame, metres."""
        x, y, z = points_m.T
        rows = zip(self.rotation, self.translation_m, strict=True)
        return np.column_stack(
            [row[0] * x + row[1] * y + row[2] * z + shift for row, shift in rows]
        )


def sheet_corners_mm(board: Board) -> tuple[tuple[float, float], tuple[float, float]]:
    """Upper left and lower right corner (x, y) of a board's sheet, in mm from its first point."""
    points = board.points_mm()
    margin = MARGIN[board.kind] * board.spacing_mm
    right, bottom = (float(points[:, axis].max()) + margin for axis in (0, 1))
    return (-margin, -margin), (right, bottom)


def fitting_board(rig: Rig, kind: str = "circles", columns: int = 5, rows: int = 9) -> Board:
    """A board for a rig: its longer side takes `COVERED` of the image's shorter side at the
    standoff, the spacing a round number of mm. Circles have a radius of 0.3 spacings."""
    unit = Board(kind, columns, rows, 1.0, 0.3 if kind.startswith("circles") else 0.0)
    (left, top), (right, bottom) = sheet_corners_mm(unit)
    camera = rig.camera
    field_mm = min(camera.width / camera.fx, camera.height / camera.fy) * rig.standoff_m * MM_PER_M
    most = COVERED * field_mm / max(right - left, bottom - top)
    power = 10.0 ** np.floor(np.log10(most))
    spacing = max(nice * power for nice in NICE if nice * power <= most * (1 + 1e-9))
    return Board(kind, columns, rows, float(f"{spacing:g}"), float(f"{unit.detail_mm * spacing:g}"))


def board_poses(rig: Rig, board: Board, count: int = BOARD_POSES) -> tuple[BoardPose, ...]:
    """``count`` poses at which the sheet is within the working range, the image and the pattern:
    towards the middle, the corners and the sides of the image in turn, tilted by up to `MOST_TILT`
    in directions all round, upright and turned by a quarter, at distances over the whole range.
    Raises `CalibrationError` for a board that does not fit."""
    (left, top), (right, bottom) = (
        np.array(corner) / MM_PER_M for corner in sheet_corners_mm(board)
    )
    corners = np.array([[x, y, 0.0] for y in (top, bottom) for x in (left, right)])
    centre = np.array([(left + right) / 2, (top + bottom) / 2, 0.0])
    middle, reach = _seen_by_both(rig)
    poses = []
    for index in range(count):
        share = 1.0 if count == 1 else LEAST_TILT + (1 - LEAST_TILT) * (index * PLASTIC % 1.0)
        roll = 0.25 * (index % 2) + 0.03 * (index % 3 - 1)
        tilt, rolled = (
            np.array(rows) for rows in (_tilt(MOST_TILT * share, index * GOLDEN % 1.0), _roll(roll))
        )
        first, second, third = (tuple(row) for row in matrix_product(tilt, rolled).tolist())
        rotation = first, second, third
        place = np.array(_PLACES[index % len(_PLACES)]) * reach
        about = BoardPose(rotation, (0.0, 0.0, 0.0)).points_m(corners - centre)
        pose = _fitting_pose(rig, rotation, about, centre, middle, place, index * GOLDEN % 1.0)
        if pose is None:
            size = f"{MM_PER_M * (right - left):g} x {MM_PER_M * (bottom - top):g} mm"
            raise CalibrationError(
                f"board {board}: its sheet of {size} does not fit the working range, the image and "
                f"the pattern in pose "
                f"{index}; {fitting_board(rig, board.kind, board.columns, board.rows)} would suit "
                f"this rig"
            )
        poses.append(pose)
    return tuple(poses)


def _fitting_pose(
    rig: Rig,
    rotation: tuple,
    about: NDArray,
    centre: NDArray,
    middle: NDArray,
    place: NDArray,
    distance_share: float,
) -> BoardPose | None:
    """The pose farthest towards ``place`` (px from ``middle``) at the distance nearest to the share
    of the range."""
    near_m, far_m = rig.range_m
    near_m, far_m = near_m - float(about[:, 2].min()), far_m - float(about[:, 2].max())
    if near_m > far_m:
        return None
    shares = sorted(
        (step / _STEPS for step in range(_STEPS + 1)), key=lambda share: abs(share - distance_share)
    )
    for depth_m in (near_m + (far_m - near_m) * share for share in (distance_share, *shares)):
        for step in range(_STEPS, -1, -1):
            pixel = middle + place * (step / _STEPS)
            x, y = (float(axis) for axis in rig.camera.normalised(*pixel))
            at = np.array([x, y, 1.0]) * depth_m
            if _visible(rig, about + at):
                first = at - BoardPose(rotation, (0.0, 0.0, 0.0)).points_m(centre[None])[0]
                return BoardPose(rotation, (float(first[0]), float(first[1]), float(first[2])))
    return None


def _visible(rig: Rig, points_m: NDArray[np.float64]) -> bool:
    """Whether the image and the pattern hold all points (n, 3), with a margin."""
    seen = (rig.camera, rig.camera.project(points_m)), (rig.projector, rig.project(points_m))
    return all(device.holds(*pixels, _MARGIN_PX + 0.5).all() for device, pixels in seen)


def _seen_by_both(rig: Rig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Middle of the image's part that the projector lights at the standoff, and half of its size,
    (2,) px each."""
    lit = rig.projector.holds(*rig.seen(rig.camera.rays(), rig.standoff_m), 0.5)
    if not lit.any():
        raise CalibrationError(
            f"the projector lights nothing that the camera sees at the standoff of "
            f"{rig.standoff_m:g} m; check the rig"
        )
    row, column = np.nonzero(lit)
    low, high = (np.array([f(column), f(row)], dtype=float) for f in (np.min, np.max))
    return (low + high) / 2, (high - low) / 2


def _tilt(turns: float, azimuth_turns: float) -> tuple:
    """Rotation about an axis in the plane of the image, by Rodrigues' formula."""
    a, b = float(cosine_of_turns(azimuth_turns)), float(sine_of_turns(azimuth_turns))
    c, s = float(cosine_of_turns(turns)), float(sine_of_turns(turns))
    return (
        (c + a * a * (1 - c), a * b * (1 - c), b * s),
        (a * b * (1 - c), c + b * b * (1 - c), -a * s),
        (-b * s, a * s, c),
    )


def _roll(turns: float) -> tuple:
    c, s = float(cosine_of_turns(turns)), float(sine_of_turns(turns))
    return (c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)
