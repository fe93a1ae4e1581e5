"""A camera-projector rig and board poses, projected by OpenCV."""

import cv2
import numpy as np

from fpp_ml_bench.calibration.projector_points import Pose, ProjectorPoints

CAMERA_SIZE, PROJECTOR_SIZE = (1280, 960), (912, 1140)
CAMERA = np.array([[1500.0, 0, 630.0], [0, 1503.0, 488.0], [0, 0, 1]])
PROJECTOR = np.array([[1400.0, 0, 450.0], [0, 1398.0, 1150.0], [0, 0, 1]])
"""Its axis passes below its image."""
CAMERA_TERMS = np.array([-0.09, 0.12, 0.0006, -0.0009, -0.05])
PROJECTOR_TERMS = np.array([0.03, -0.02, 0.0004, 0.0003, 0.01])
TURN, SHIFT_MM = np.array([-0.03, 0.35, 0.02]), np.array([-160.0, -90.0, 30.0])
TILTS = [
    (0.4, 0.1, 0.0),
    (-0.4, 0.2, 0.1),
    (0.1, 0.5, -0.1),
    (0.05, -0.4, 0.2),
    (0.3, -0.3, 0.5),
    (-0.2, 0.35, -0.4),
]


def board_pose(index, points_mm):
    """Rotation vector and translation of the board's frame in the camera's, with the board in the
    middle."""
    turn = np.array(TILTS[index])
    centre = np.array([20.0 * (index % 3 - 1), 15.0 * (index % 2) - 15.0, 480.0 + 25.0 * index])
    return turn, centre - cv2.Rodrigues(turn)[0] @ points_mm.mean(0)


def project_at(points_mm, turn, shift_mm):
    """Image and projector coordinates (n, 2) of points on a board that is turned and shifted."""
    image = cv2.projectPoints(points_mm, turn, shift_mm, CAMERA, CAMERA_TERMS)[0]
    composed = cv2.composeRT(turn, shift_mm, TURN, SHIFT_MM)[:2]
    shown = cv2.projectPoints(points_mm, *composed, PROJECTOR, PROJECTOR_TERMS)[0]
    return image.reshape(-1, 2), shown.reshape(-1, 2)


def project(points_mm, index, middle=None):
    """The same, of points on the board of pose ``index``."""
    return project_at(points_mm, *board_pose(index, points_mm if middle is None else middle))


def pose(name, corners, shown, sigma_px=0.0):
    points = ProjectorPoints(
        shown, np.full_like(shown, sigma_px), np.zeros((len(corners), 2, 2)), {}
    )
    return Pose(name, CAMERA_SIZE, corners, points)


def poses(points_mm, count=6, noise_px=0.0, seed=0):
    rng = np.random.default_rng(seed)
    found = []
    for index in range(count):
        seen = [
            pixels + rng.normal(0, noise_px, pixels.shape) for pixels in project(points_mm, index)
        ]
        found.append(pose(f"pose{index}", *seen))
    return found
