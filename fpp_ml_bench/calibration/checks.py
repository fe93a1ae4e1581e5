"""What makes captures unfit for a calibration: each answered with a sentence that names the pose."""

from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.calibration.boards import Board
from fpp_ml_bench.calibration.bundle import Bundle
from fpp_ml_bench.calibration.projector_points import Pose
from fpp_ml_bench.errors import CalibrationError

FEWEST_POSES = 3
FEWEST_POINTS = 6
LEAST_TILT_RAD = np.deg2rad(5.0)
LARGEST_FOCAL_SIGMA = 0.05
"""Relative standard uncertainty of a focal length."""
MARGIN = 0.1
"""By which projector coordinates may lie outside the projector, in its sizes: the fringes end there."""


def check_poses(poses: Sequence[Pose], board: Board, sizes: tuple[tuple[int, int], tuple[int, int]]) -> None:
    """Raise `CalibrationError` for poses that are too few, of another image size, with too few points or too far from
    the projector, or in which camera and projector don't see the same side of the board."""
    if len(poses) < FEWEST_POSES:
        raise CalibrationError(f"expected at least {FEWEST_POSES} poses of the board, got {len(poses)}: capture more")
    (width, height), projector = sizes
    for pose in poses:
        if tuple(pose.size) != (width, height):
            got = f"{pose.size[0]} x {pose.size[1]}"
            raise CalibrationError(f"pose {pose.name}: the image is {got} px, the camera's are {width} x {height} px")
        corners, points = pose.corners_px, pose.projector.points_px
        if not len(corners) == len(points) == board.columns * board.rows:
            expected = board.columns * board.rows
            raise CalibrationError(f"pose {pose.name}: expected {expected} points, got {len(corners)}")
        both = np.isfinite(corners).all(1) & np.isfinite(points).all(1)
        if both.sum() < FEWEST_POINTS:
            reason = next(iter(pose.projector.reasons.items()), None)
            why = f" (point {reason[0]}: {reason[1]})" if reason else ""
            raise CalibrationError(
                f"pose {pose.name}: only {both.sum()} of {len(points)} points have projector coordinates, expected at "
                f"least {FEWEST_POINTS}{why}: light the whole board with the fringes"
            )
        for axis, (size, name) in enumerate(zip(projector, ("columns", "rows"), strict=True)):
            low, high = points[both, axis].min(), points[both, axis].max()
            if low < -MARGIN * size or high > (1 + MARGIN) * size:
                raise CalibrationError(
                    f"pose {pose.name}: the board lies at projector {name} {low:.0f} to {high:.0f}, but the "
                    f"projector has {size}: look at its size, the pitch, and which frames code which direction"
                )
        plane = np.column_stack([corners[both], np.ones(both.sum())])
        affine = np.linalg.lstsq(plane, points[both], rcond=None)[0][:2]
        if np.linalg.det(affine) < 0:
            raise CalibrationError(
                f"pose {pose.name}: the camera sees the board mirrored, compared with the projector; mirror the "
                "images, or look at the direction in which the projector's columns and rows are counted"
            )


def check_start(poses: Sequence[Pose], turns: Sequence[NDArray]) -> None:
    """Raise `CalibrationError` where all boards are parallel, given their rotation vectors."""
    normals = [cv2.Rodrigues(np.asarray(turn))[0][:, 2] for turn in turns]
    if not np.isfinite(normals).all():
        raise CalibrationError("the poses don't determine the intrinsics: show the board from other directions")
    tilt = max(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b)) for a, b in combinations(normals, 2))
    if tilt < LEAST_TILT_RAD:
        names = ", ".join(pose.name for pose in poses)
        raise CalibrationError(
            f"poses {names}: the board is parallel in all of them, within {np.rad2deg(tilt):.1f} degrees, so that "
            "focal length and distance can't be told apart; tilt it by 20 degrees or more, about both axes"
        )


def check_solution(bundle: Bundle, x: NDArray[np.float64], sigma: NDArray[np.float64]) -> None:
    """Raise `CalibrationError` where a focal length is not determined, given all parameters' standard uncertainties."""
    for name, part in (("camera", bundle.camera), ("projector", bundle.projector)):
        focal = x[part][:2]
        if not (focal > 0).all() or (sigma[part][:2] > LARGEST_FOCAL_SIGMA * focal).any():
            raise CalibrationError(
                f"the poses don't determine the {name}'s focal length: {focal[0]:.0f} ± {sigma[part][0]:.0f} px; tilt "
                "the board more and in other directions, or choose a lens with fewer terms"
            )
