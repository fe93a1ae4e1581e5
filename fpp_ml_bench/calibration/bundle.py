"""Joint refinement: intrinsics of both devices, the pose between them, the board's poses and, where
wanted, the board's own points, by least squares over all image and projector coordinates with
OpenCV's model and its derivatives.

The parameters are one vector: (fx, fy, cx, cy, coefficients) of the camera, the same of the
projector, rotation vector and translation from camera to projector, the same from the board to the
camera for each pose, the board's points, and the skew of the camera's and of the projector's
pixels. No fit frees the skew: it stays 0, and `doubts` asks what it would explain.

Two things are corrected by the rig as known so far. The centroid of a circle's image is not the
image of its centre: perspective shifts an ellipse's centre, and lens distortion shifts it further
(Heikkila, Geometric camera calibration using circular control points, IEEE TPAMI 2000); the shift
is computed from a polygon of the outline (`without_bias`). And a board that looks alike when turned
may be labelled from either end. That makes no difference to a perfect board; where its points are
estimated, a label has to mean the same point in all poses, and the board's irregularities, which
all poses share, tell which (`same_labels`).
"""

from collections.abc import Callable, Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fpp_ml_bench.calibration.boards import Board
from fpp_ml_bench.calibration.projector_points import Pose, ProjectorPoints
from fpp_ml_bench.calibration.result import Lens
from fpp_ml_bench.errors import CalibrationError

BOARD_SHARE = 0.01
"""Standard deviation of a printed board's points about their grid, in spacings, assumed where they
are estimated. It also fixes what the images can't: the estimated points fit the nominal ones best
in position, turn and scale."""
LEAST_SIGMA_PX = 1e-6
"""Least extra standard deviation of points, in px, beside the known one: exact points would be
divided by 0."""
TOLERANCE = 1e-11
"""Relative change of cost, unknowns and gradient at which the fit ends: far below what noise does
to them, and above float64's rounding."""

OUTLINE_POINTS = 180
"""Points of a circle's outline, every 2 degrees, whose image tells where the image's centroid
lies."""
SWEEPS = 5
"""Passes over the poses of a board whose points could be numbered in several ways. In each, a pose
takes the numbering that agrees best with the others."""


class Bundle:
    """The residuals of ``poses`` and their derivatives. ``targets``: the coordinates to be met in
    camera and projector, (n, 2) for each pose, NaN where there are none. ``free``: `free_of` all
    poses."""

    def __init__(
        self, poses: Sequence[Pose], points_mm: NDArray, lenses: tuple[Lens, Lens], free_board: bool
    ) -> None:
        self.poses, self.points_mm, self.lenses, self.free_board = (
            poses,
            points_mm,
            lenses,
            free_board,
        )
        self.targets = [(pose.corners_px, pose.projector.points_px) for pose in poses]
        self.extra_px = (1.0, 1.0)
        ends = np.cumsum(
            [
                4 + lenses[0].coefficients,
                4 + lenses[1].coefficients,
                6,
                6 * len(poses),
                points_mm.size,
                2,
            ]
        )
        starts = [0, *ends[:-1]]
        parts = map(slice, starts, ends.tolist())
        self.camera, self.projector, self.stereo, self.boards, self.board, self.skews = parts
        self.size = int(ends[-1])
        self.free = self.free_of(range(len(poses)))

    def pose(self, index: int) -> slice:
        return slice(self.boards.start + 6 * index, self.boards.start + 6 * index + 6)

    def joined(self, of_pose: Callable[[int], Sequence[NDArray]]) -> list[NDArray]:
        """What ``of_pose`` gives for camera and projector, (n, 2) each, of all poses one after the
        other."""
        return [
            np.concatenate(parts)
            for parts in zip(*map(of_pose, range(len(self.poses))), strict=True)
        ]

    def free_of(self, poses: Sequence[int], only_poses: bool = False) -> NDArray[np.float64]:
        """Matrix from the free parameters to the whole vector: the given board poses, and unless
        ``only_poses`` the lenses' free intrinsics, the pose of the projector and the board's points
        if they are estimated."""
        unit = np.eye(self.size)
        columns = [unit[:, self.pose(i)] for i in poses]
        if not only_poses:
            for part, lens in zip((self.camera, self.projector), self.lenses, strict=True):
                columns.append(unit[:, part] @ lens.free)
            columns.append(unit[:, self.stereo])
            columns.append(unit[:, self.board] if self.free_board else unit[:, :0])
        return np.hstack(columns)

    def project(
        self, x: NDArray[np.float64], index: int
    ) -> tuple[list[NDArray], list[tuple[NDArray, NDArray]]]:
        """Projections (n, 2) of the board's points into camera and projector in pose ``index``, and
        for each of them the parameters (k,) that it depends on, with its derivatives (2 n, k)."""
        points, board, stereo = x[self.board].reshape(-1, 3), x[self.pose(index)], x[self.stereo]
        composed = cv2.composeRT(board[:3], board[3:], stereo[:3], stereo[3:])
        of_board, of_stereo = (
            np.block([[*composed[k : k + 2]], [*composed[k + 4 : k + 6]]]) for k in (2, 4)
        )
        in_camera = self.camera, board[:3], board[3:], [(self.pose(index), np.eye(6))]
        in_projector = (
            self.projector,
            *composed[:2],
            [(self.pose(index), of_board), (self.stereo, of_stereo)],
        )
        projections: list[NDArray] = []
        derivatives: list[tuple[NDArray, NDArray]] = []
        for part, rotation, translation, chain in (in_camera, in_projector):
            image, jacobian = cv2.projectPoints(
                points, rotation, translation, *opencv_lens(x[part])
            )[:2]
            projections.append(image.reshape(-1, 2))
            blocks = [(part, jacobian[:, 6 : 6 + part.stop - part.start])]
            blocks += [(columns, jacobian[:, :6] @ of_place) for columns, of_place in chain]
            fx, fy, _, cy = x[part][:4]
            skew = np.zeros((len(points), 2, 2))
            skew[:, 0, len(derivatives)] = (image[:, 0, 1] - cy) * fx / fy
            blocks.append((self.skews, skew.reshape(-1, 2)))
            if self.free_board:
                of_points = np.zeros((len(points), 2, len(points), 3))
                each = np.arange(len(points))
                of_points[each, :, each] = (
                    jacobian[:, 3:6].reshape(-1, 2, 3) @ cv2.Rodrigues(rotation)[0]
                )
                blocks.append((self.board, of_points.reshape(2 * len(points), -1)))
            columns, values = zip(*blocks, strict=True)
            derivatives.append((np.r_[columns], np.hstack(values)))
        return projections, derivatives

    def sigmas(self, index: int) -> list[NDArray[np.float64]]:
        """Standard deviations (n, 2) px expected of camera and projector coordinates: what all
        points of the device have in common, and the projector coordinate's own."""
        own = self.poses[index].projector.sigma_px
        camera, projector = self.extra_px
        return [
            np.full_like(own, camera),
            np.sqrt(projector**2 + np.where(np.isfinite(own), own, 0.0) ** 2),
        ]

    def residuals(self, x: NDArray[np.float64], index: int) -> list[NDArray[np.float64]]:
        """Projected less measured (n, 2) px in camera and projector, NaN where not measured."""
        projections = self.project(x, index)[0]
        return [
            image - target for image, target in zip(projections, self.targets[index], strict=True)
        ]

    def system(self, x: NDArray, poses: Sequence[int], free: NDArray) -> tuple[NDArray, NDArray]:
        """Weighted residuals (m,) and their derivatives (m, f) with respect to the free
        parameters."""
        values, rows = [], []
        for index in poses:
            projections, derivatives = self.project(x, index)
            for image, target, sigma, (columns, jacobian) in zip(
                projections, self.targets[index], self.sigmas(index), derivatives, strict=True
            ):
                seen = np.isfinite(target).ravel()
                values.append(((image - target) / sigma).ravel()[seen])
                rows.append((jacobian[seen] @ free[columns]) / sigma.ravel()[seen, None])
        if self.free[self.board].any() and free[self.board].any():  # the board's points are sought
            sigma_mm = BOARD_SHARE * np.linalg.norm(self.points_mm[1] - self.points_mm[0])
            values.append((x[self.board] - self.points_mm.ravel()) / sigma_mm)
            rows.append(free[self.board] / sigma_mm)
        return np.concatenate(values), np.concatenate(rows)

    def fit(
        self,
        start: NDArray[np.float64],
        poses: Sequence[int] | None = None,
        only_poses: bool = False,
    ) -> NDArray[np.float64]:
        """The parameters of the least squares over ``poses`` (all). Raises `CalibrationError` where
        the search does not end."""
        poses = range(len(self.poses)) if poses is None else poses
        free = self.free_of(poses, only_poses)

        @lru_cache(maxsize=1)  # asked for the residuals of a step, then for their derivatives
        def system(step: bytes) -> tuple[NDArray, NDArray]:
            return self.system(start + free @ np.frombuffer(step), poses, free)

        none = np.zeros(free.shape[1])
        if len(system(none.tobytes())[0]) < none.size:
            raise CalibrationError(
                f"{len(poses)} poses give too few points for {none.size} unknowns: capture more"
            )
        try:
            solution = least_squares(
                lambda step: system(step.tobytes())[0],
                none,
                lambda step: system(step.tobytes())[1],
                method="lm",
                x_scale="jac",
                ftol=TOLERANCE,
                xtol=TOLERANCE,
                gtol=TOLERANCE,
                max_nfev=300,
            )
        except (ValueError, cv2.error) as error:  # coordinates that are not finite any more
            raise CalibrationError(
                f"the fit of the rig failed ({error}): look at the poses"
            ) from error
        return start + free @ solution.x

    def spread(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """A root (p, f) of the covariance of all p parameters at the solution ``x``: the covariance
        is its product with its transpose. Infinite where the data don't determine the f free
        ones."""
        jacobian = self.system(x, range(len(self.poses)), self.free)[1]
        norm = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
        try:
            inverse = np.linalg.inv(np.linalg.qr(jacobian / norm, mode="r"))
        except np.linalg.LinAlgError:
            return np.full_like(self.free, np.inf)
        return self.free @ (inverse / norm[:, None])

    def weigh(self, x: NDArray[np.float64]) -> None:
        """Set the common standard deviations of camera and projector coordinates from the residuals
        at ``x``: what is left of their mean square after the points' own uncertainty, freed from
        the fit's unknowns."""
        residuals = self.joined(lambda index: self.residuals(x, index))
        own = np.nan_to_num(np.concatenate([pose.projector.sigma_px for pose in self.poses]))
        seen = [np.isfinite(residual) for residual in residuals]
        count = sum(int(part.sum()) for part in seen)
        inflation = count / max(count - self.free.shape[1], 1)
        camera, projector = (
            max(
                inflation * (residual[part] ** 2).mean() - (known[part] ** 2).mean(),
                LEAST_SIGMA_PX**2,
            )
            ** 0.5
            for residual, known, part in zip(
                residuals, (np.zeros_like(own), own), seen, strict=True
            )
        )
        self.extra_px = float(camera), float(projector)


def opencv_lens(intrinsics: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """OpenCV's camera matrix (3, 3) and coefficients, of (fx, fy, cx, cy, coefficients)."""
    fx, fy, cx, cy = intrinsics[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), intrinsics[4:]


def without_bias(
    bundle: Bundle, x: NDArray[np.float64], index: int, radius_mm: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Image and projector coordinates (n, 2) px of the circles' centres, from those measured at
    their centroids."""
    pose = bundle.poses[index]
    points = x[bundle.board].reshape(-1, 3)
    board, lens = x[bundle.pose(index)], opencv_lens(x[bundle.camera])
    angle = np.linspace(0, 2 * np.pi, OUTLINE_POINTS, endpoint=False)
    circle = radius_mm * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    outlines = (points[:, None] + circle).reshape(-1, 3)
    image = cv2.projectPoints(outlines, board[:3], board[3:], *lens)[0].reshape(len(points), -1, 2)
    centres = cv2.projectPoints(points, board[:3], board[3:], *lens)[0].reshape(-1, 2)
    offset = polygon_centroids(image - centres[:, None])
    moved = np.einsum("nij,nj->ni", pose.projector.jacobian, offset)
    return pose.corners_px - offset, pose.projector.points_px - moved


def polygon_centroids(polygons: NDArray) -> NDArray[np.float64]:
    """Centroids of area (n, 2) of polygons (n, k, 2)."""
    following = np.roll(polygons, -1, axis=1)
    cross = polygons[..., 0] * following[..., 1] - polygons[..., 1] * following[..., 0]
    return ((polygons + following) * cross[..., None]).sum(1) / (3 * cross.sum(1))[:, None]


def same_labels(board: Board, bundle: Bundle, x: NDArray[np.float64]) -> list[Pose]:
    """The poses, relabelled by the turns of the grid that make the points' deviations agree best
    between poses."""
    poses = bundle.poses
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
        choices.append(
            [deviations[label] @ turn for label, turn in zip(labels, turns, strict=True)]
        )
    chosen = [0] * len(poses)
    for _ in range(SWEEPS):
        for index, alternatives in enumerate(choices):
            others = sum(choices[i][chosen[i]] for i in range(len(poses)) if i != index)
            chosen[index] = int(
                np.argmax([(alternative * others).sum() for alternative in alternatives])
            )
    return [_relabelled(pose, labels[choice]) for pose, choice in zip(poses, chosen, strict=True)]


def _relabelled(pose: Pose, label: NDArray[np.int64]) -> Pose:
    points = pose.projector
    reasons = {
        new: points.reasons[old] for new, old in enumerate(label.tolist()) if old in points.reasons
    }
    projector = ProjectorPoints(
        points.points_px[label], points.sigma_px[label], points.jacobian[label], reasons
    )
    return pose._replace(corners_px=pose.corners_px[label], projector=projector)


def deviations_mm(bundle: Bundle, x: NDArray[np.float64], index: int) -> NDArray[np.float64]:
    """Where the camera's rays of a pose meet the board's plane, less where the points are thought
    to be, (n, 2) mm."""
    corners = bundle.targets[index][0]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    ideal = cv2.undistortPoints(
        corners[:, None], *opencv_lens(x[bundle.camera]), criteria=criteria
    )[:, 0]
    rays = np.column_stack([ideal, np.ones(len(ideal))])
    board = x[bundle.pose(index)]
    rotation, shift = cv2.Rodrigues(board[:3])[0], board[3:]
    distance = (rotation[:, 2] @ shift) / (rays @ rotation[:, 2])
    met = (rays * distance[:, None] - shift) @ rotation
    return met[:, :2] - x[bundle.board].reshape(-1, 3)[:, :2]
