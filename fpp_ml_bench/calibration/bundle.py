"""Joint refinement: intrinsics of both devices, the pose between them, the board's poses and, where wanted, the board's
own points, by least squares over all image and projector coordinates with OpenCV's model and its derivatives.

The parameters are one vector: (fx, fy, cx, cy, coefficients) of the camera, the same of the projector, rotation vector
and translation from camera to projector, the same from the board to the camera for each pose, the board's points.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fpp_ml_bench.calibration.lens import Lens
from fpp_ml_bench.calibration.projector_points import Pose
from fpp_ml_bench.errors import CalibrationError

BOARD_SHARE = 0.01
"""Standard deviation of a printed board's points about their grid, in spacings, assumed where they are estimated. It
also fixes what the images can't: the estimated points fit the nominal ones best in position, turn and scale."""
LEAST_SIGMA_PX = 1e-6
TOLERANCE = 1e-11

Blocks = list[tuple[slice, NDArray]]
"""Non-zero columns of a Jacobian: which, and what is in them."""


class Bundle:
    """The residuals of ``poses`` and their derivatives. ``corners`` and ``targets`` are the coordinates to be met, (n,
    2) for each pose, NaN where there are none."""

    def __init__(self, poses: Sequence[Pose], points_mm: NDArray, lenses: tuple[Lens, Lens], free_board: bool) -> None:
        self.poses, self.points_mm, self.lenses, self.free_board = poses, points_mm, lenses, free_board
        self.targets = [(pose.corners_px, pose.projector.points_px) for pose in poses]
        self.extra_px = (1.0, 1.0)
        ends = np.cumsum([4 + lenses[0].coefficients, 4 + lenses[1].coefficients, 6, 6 * len(poses), points_mm.size])
        starts = [0, *ends[:-1]]
        self.camera, self.projector, self.stereo, self.boards, self.board = map(slice, starts, ends.tolist())
        self.size = int(ends[-1])

    def pose(self, index: int) -> slice:
        return slice(self.boards.start + 6 * index, self.boards.start + 6 * index + 6)

    def free(self, poses: Sequence[int], only_poses: bool = False) -> NDArray[np.float64]:
        """Matrix from the free parameters to the whole vector: the given board poses, and unless ``only_poses`` the
        lenses' free intrinsics, the pose of the projector and the board's points if they are estimated."""
        unit = np.eye(self.size)
        columns = [unit[:, self.pose(i)] for i in poses]
        if not only_poses:
            for part, lens in zip((self.camera, self.projector), self.lenses, strict=True):
                columns.append(unit[:, part] @ lens.free)
            columns.append(unit[:, self.stereo])
            columns.append(unit[:, self.board] if self.free_board else unit[:, :0])
        return np.hstack(columns)

    def project(self, x: NDArray[np.float64], index: int) -> tuple[list[NDArray], list[Blocks]]:
        """Projections (n, 2) of the board's points into camera and projector in pose ``index``, and their derivatives
        (2 n, k) in blocks of columns."""
        points, board, stereo = x[self.board].reshape(-1, 3), x[self.pose(index)], x[self.stereo]
        composed = cv2.composeRT(board[:3], board[3:], stereo[:3], stereo[3:])
        turn, shift = composed[0], composed[1]
        projections, derivatives = [], []
        for part, rotation, translation in (
            (self.camera, board[:3], board[3:]),
            (self.projector, turn, shift),
        ):
            fx, fy, cx, cy = x[part][:4]
            matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
            image, jacobian = cv2.projectPoints(points, rotation, translation, matrix, x[part][4:])[:2]
            projections.append(image.reshape(-1, 2))
            intrinsics = jacobian[:, 6 : 6 + part.stop - part.start]
            of_turn, of_shift = jacobian[:, :3], jacobian[:, 3:6]
            blocks: Blocks = [(part, intrinsics)]
            if part is self.camera:
                blocks.append((self.pose(index), np.hstack([of_turn, of_shift])))
            else:
                chain = [
                    sum(outer @ composed[k] for outer, k in ((of_turn, first), (of_shift, first + 4)))
                    for first in (2, 3, 4, 5)
                ]
                blocks += [(self.pose(index), np.hstack(chain[:2])), (self.stereo, np.hstack(chain[2:]))]
            if self.free_board:
                of_points = of_shift.reshape(-1, 2, 3) @ cv2.Rodrigues(rotation)[0]
                spread = np.zeros((len(points), 2, len(points), 3))
                spread[np.arange(len(points)), :, np.arange(len(points))] = of_points
                blocks.append((self.board, spread.reshape(2 * len(points), -1)))
            derivatives.append(blocks)
        return projections, derivatives

    def sigmas(self, index: int) -> list[NDArray[np.float64]]:
        """Standard deviations (n, 2) px expected of camera and projector coordinates: what all points of the device
        have in common, and the projector coordinate's own."""
        own = self.poses[index].projector.sigma_px
        camera, projector = self.extra_px
        return [np.full_like(own, camera), np.sqrt(projector**2 + np.where(np.isfinite(own), own, 0.0) ** 2)]

    def residuals(self, x: NDArray[np.float64], index: int) -> list[NDArray[np.float64]]:
        """Projected less measured (n, 2) px in camera and projector, NaN where not measured."""
        projections = self.project(x, index)[0]
        return [image - target for image, target in zip(projections, self.targets[index], strict=True)]

    def system(self, x: NDArray, poses: Sequence[int], free: NDArray, prior: bool) -> tuple[NDArray, NDArray]:
        """Weighted residuals (m,) and their derivatives (m, f) with respect to the free parameters."""
        values, rows = [], []
        for index in poses:
            projections, derivatives = self.project(x, index)
            for image, target, sigma, blocks in zip(
                projections, self.targets[index], self.sigmas(index), derivatives, strict=True
            ):
                seen = np.isfinite(target).all(1)
                values.append(((image - target) / sigma)[seen].ravel())
                row = sum(block @ free[columns] for columns, block in blocks)
                rows.append((row.reshape(-1, 2, free.shape[1]) / sigma[:, :, None])[seen].reshape(-1, free.shape[1]))
        if prior:
            sigma_mm = BOARD_SHARE * np.linalg.norm(self.points_mm[1] - self.points_mm[0])
            values.append((x[self.board] - self.points_mm.ravel()) / sigma_mm)
            rows.append(free[self.board] / sigma_mm)
        return np.concatenate(values), np.concatenate(rows)

    def fit(
        self, start: NDArray[np.float64], poses: Sequence[int] | None = None, only_poses: bool = False
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """The parameters of the least squares over ``poses`` (all), their weighted Jacobian (m, f), and the matrix from
        the free parameters to all. Raises `CalibrationError` where the search does not end."""
        poses = range(len(self.poses)) if poses is None else poses
        free = self.free(poses, only_poses)
        prior = self.free_board and not only_poses
        cache: dict[bytes, tuple[NDArray, NDArray]] = {}

        def system(step: NDArray) -> tuple[NDArray, NDArray]:
            key = step.tobytes()
            if key not in cache:
                cache.clear()
                cache[key] = self.system(start + free @ step, poses, free, prior)
            return cache[key]

        unknowns = free.shape[1]
        if len(system(np.zeros(unknowns))[0]) < unknowns:
            raise CalibrationError(f"{len(poses)} poses give too few points for {unknowns} unknowns: capture more")
        try:
            found = least_squares(
                lambda step: system(step)[0],
                np.zeros(unknowns),
                lambda step: system(step)[1],
                method="lm",
                x_scale=1 / np.maximum(np.linalg.norm(system(np.zeros(unknowns))[1], axis=0), 1e-300),
                ftol=TOLERANCE,
                xtol=TOLERANCE,
                gtol=TOLERANCE,
                max_nfev=300,
            )
        except (ValueError, cv2.error) as error:  # coordinates that are not finite any more
            raise CalibrationError(f"the fit of the rig failed ({error}): look at the poses") from error
        return start + free @ found.x, system(found.x)[1], free

    def weigh(self, x: NDArray[np.float64], unknowns: int) -> tuple[float, float]:
        """Set the common standard deviations of camera and projector coordinates from the residuals at ``x``: what is
        left of their mean square after the points' own uncertainty, freed from the fit's ``unknowns``."""
        squares: list[list[NDArray]] = [[], []]
        for index in range(len(self.poses)):
            owns = [np.zeros_like(self.targets[index][0]), self.poses[index].projector.sigma_px]
            for device, residual in enumerate(self.residuals(x, index)):
                seen = np.isfinite(residual)
                squares[device].append(np.stack([residual[seen] ** 2, np.nan_to_num(owns[device][seen]) ** 2]))
        joined = [np.concatenate(parts, axis=1) for parts in squares]
        count = sum(part.shape[1] for part in joined)
        inflation = count / max(count - unknowns, 1)
        camera, projector = (max(inflation * part[0].mean() - part[1].mean(), 0.0) ** 0.5 for part in joined)
        self.extra_px = (float(max(camera, LEAST_SIGMA_PX)), float(max(projector, LEAST_SIGMA_PX)))
        return self.extra_px


def spread(jacobian: NDArray[np.float64], free: NDArray[np.float64]) -> NDArray[np.float64]:
    """A root (p, f) of the covariance of all p parameters, which is its product with its transpose, from `Bundle.fit`'s
    Jacobian (m, f) and matrix of free parameters (p, f); infinite where the data don't determine them."""
    norm = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    try:
        inverse = np.linalg.inv(np.linalg.qr(jacobian / norm, mode="r"))
    except np.linalg.LinAlgError:
        return np.full_like(free, np.inf)
    return free @ (inverse / norm[:, None])
