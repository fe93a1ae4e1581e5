"""The bias of circle boards: the centroid of a circle's image is not the image of its centre.

Perspective shifts an ellipse's centre, and lens distortion shifts it further (Heikkila, Geometric camera calibration
using circular control points, IEEE TPAMI 2000). The shift is computed from a polygon of the outline, projected with the
rig as known so far.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.calibration.bundle import Bundle
from fpp_ml_bench.calibration.projector_points import Pose

OUTLINE_POINTS = 180


def without_bias(
    pose: Pose, bundle: Bundle, x: NDArray[np.float64], index: int, radius_mm: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Image and projector coordinates (n, 2) px of the circles' centres, from those measured at their centroids."""
    points = x[bundle.board].reshape(-1, 3)
    board, (fx, fy, cx, cy), distortion = x[bundle.pose(index)], x[bundle.camera][:4], x[bundle.camera][4:]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    angle = np.linspace(0, 2 * np.pi, OUTLINE_POINTS, endpoint=False)
    circle = radius_mm * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    outlines = (points[:, None] + circle).reshape(-1, 3)
    image = cv2.projectPoints(outlines, board[:3], board[3:], matrix, distortion)[0].reshape(len(points), -1, 2)
    centres = cv2.projectPoints(points, board[:3], board[3:], matrix, distortion)[0].reshape(-1, 2)
    offset = polygon_centroids(image - centres[:, None])
    moved = np.einsum("nij,nj->ni", pose.projector.jacobian, offset)
    return pose.corners_px - offset, pose.projector.points_px - moved


def polygon_centroids(polygons: NDArray) -> NDArray[np.float64]:
    """Centroids of area (n, 2) of polygons (n, k, 2)."""
    following = np.roll(polygons, -1, axis=1)
    cross = polygons[..., 0] * following[..., 1] - polygons[..., 1] * following[..., 0]
    return ((polygons + following) * cross[..., None]).sum(1) / (3 * cross.sum(1))[:, None]
