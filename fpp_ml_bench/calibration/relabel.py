"""The same labels in all poses: a board that looks alike when turned may be labelled from either end.

That makes no difference to a perfect board. Where its points are estimated, a label has to mean the same point in all
poses: its irregularities, which all poses share, tell.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.calibration.boards import Board
from fpp_ml_bench.calibration.bundle import Bundle
from fpp_ml_bench.calibration.projector_points import Pose, ProjectorPoints

SWEEPS = 5


def same_labels(poses: Sequence[Pose], board: Board, bundle: Bundle, x: NDArray[np.float64]) -> list[Pose]:
    """The poses, relabelled by the turns of the grid that make the points' deviations agree best between poses."""
    if board.kind not in ("checker", "circles"):
        return list(poses)
    grid = np.arange(board.columns * board.rows).reshape(board.rows, board.columns)
    quarters = (0, 1, 2, 3) if board.columns == board.rows else (0, 2)
    labels = [np.rot90(grid, quarter).ravel() for quarter in quarters]
    points = board.points_mm()[:, :2] - board.points_mm()[:, :2].mean(0)
    # A turned label's deviation, in the axes of the new labels: row vectors, p[label] @ turn = p.
    turns = [np.linalg.lstsq(points[label], points, rcond=None)[0] for label in labels]
    choices = []
    for index in range(len(poses)):
        deviations = np.nan_to_num(deviations_mm(bundle, x, index))
        choices.append([deviations[label] @ turn for label, turn in zip(labels, turns, strict=True)])
    chosen = [0] * len(poses)
    for _ in range(SWEEPS):
        for index, alternatives in enumerate(choices):
            others = sum(choices[i][chosen[i]] for i in range(len(poses)) if i != index)
            chosen[index] = int(np.argmax([(alternative * others).sum() for alternative in alternatives]))
    return [_relabelled(pose, labels[choice]) for pose, choice in zip(poses, chosen, strict=True)]


def _relabelled(pose: Pose, label: NDArray[np.int64]) -> Pose:
    points = pose.projector
    reasons = {new: points.reasons[old] for new, old in enumerate(label.tolist()) if old in points.reasons}
    projector = ProjectorPoints(points.points_px[label], points.sigma_px[label], points.jacobian[label], reasons)
    return pose._replace(corners_px=pose.corners_px[label], projector=projector)


def deviations_mm(bundle: Bundle, x: NDArray[np.float64], index: int) -> NDArray[np.float64]:
    """Where the camera's rays of a pose meet the board's plane, less where the points are thought to be, (n, 2) mm."""
    (fx, fy, cx, cy), distortion = x[bundle.camera][:4], x[bundle.camera][4:]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    corners = bundle.targets[index][0]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    ideal = cv2.undistortPoints(corners[:, None], matrix, distortion, criteria=criteria)[:, 0]
    rays = np.column_stack([ideal, np.ones(len(ideal))])
    board = x[bundle.pose(index)]
    rotation, shift = cv2.Rodrigues(board[:3])[0], board[3:]
    distance = (rotation[:, 2] @ shift) / (rays @ rotation[:, 2])
    met = (rays * distance[:, None] - shift) @ rotation
    return met[:, :2] - x[bundle.board].reshape(-1, 3)[:, :2]
