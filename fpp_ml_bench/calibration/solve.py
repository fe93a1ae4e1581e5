"""From board poses to a calibrated rig: start by OpenCV, joint refinement, circle bias, what each
pose does to it. What makes captures unfit for a calibration is answered with a sentence that names
the pose."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fpp_ml_bench.calibration.boards import Board
from fpp_ml_bench.calibration.bundle import Bundle, same_labels, without_bias
from fpp_ml_bench.calibration.doubts import doubts
from fpp_ml_bench.calibration.projector_points import Pose
from fpp_ml_bench.calibration.result import Calibration, Device, FittedPose, Lens, errors_px
from fpp_ml_bench.errors import CalibrationError, CaptureError
from fpp_ml_bench.optics.pinhole import Pinhole

FEWEST_POSES = 3
"""Poses of a flat board that are needed: two give four equations for focal lengths and centre,
which leaves nothing to judge the fit by."""
FEWEST_POINTS = 6
"""Points of a pose with projector coordinates that are needed: its homography needs four, and more
show errors."""
LEAST_TILT_RAD = np.deg2rad(5.0)
"""Least angle between the boards of two poses, in rad. Parallel boards do not tell the focal
length."""
LARGEST_FOCAL_SIGMA = 0.05
"""Relative standard uncertainty of a focal length."""
MARGIN = 0.1
"""By which projector coordinates may lie outside the projector, in its sizes: the fringes end
there."""
WEIGHT_ROUNDS = 4
"""Most fits that are repeated with the variances that the last one showed."""
CIRCLE_ROUNDS = 10
"""Most fits that are repeated with circles' centroids moved to their centres."""
CIRCLE_TOLERANCE_PX = 1e-7
"""Largest change of these centres, in px, at which the rounds end: far below any measured error."""


def check_poses(
    poses: Sequence[Pose], board: Board, sizes: tuple[tuple[int, int], tuple[int, int]]
) -> None:
    """Raise `CalibrationError` for poses that are too few, and for all poses of another image size,
    with too few points or too far from the projector, or in which camera and projector don't see
    the same side of the board."""
    if len(poses) < FEWEST_POSES:
        raise CalibrationError(
            f"expected at least {FEWEST_POSES} poses of the board, got {len(poses)}: capture more"
        )
    unfit: list[CalibrationError] = []
    for pose in poses:
        try:
            _check_pose(pose, board, *sizes)
        except CalibrationError as error:
            unfit.append(error)
    raise_all(unfit)


def raise_all(unfit: Sequence[CaptureError | CalibrationError]) -> None:
    """Raise what makes poses unfit, if there is any: one error as it is, several as a
    `CalibrationError` that lists them."""
    if len(unfit) == 1:
        raise unfit[0]
    if unfit:
        listed = "\n  ".join(map(str, unfit))
        raise CalibrationError(
            f"{len(unfit)} poses can't be used; capture them again, or remove them:\n  {listed}"
        )


def _check_pose(
    pose: Pose, board: Board, camera: tuple[int, int], projector: tuple[int, int]
) -> None:
    if tuple(pose.size) != camera:
        got, right = (f"{width} x {height} px" for width, height in (pose.size, camera))
        raise CalibrationError(f"pose {pose.name}: the image is {got}, the camera's are {right}")
    corners, points = pose.corners_px, pose.projector.points_px
    if not len(corners) == len(points) == board.columns * board.rows:
        expected = board.columns * board.rows
        raise CalibrationError(f"pose {pose.name}: expected {expected} points, got {len(corners)}")
    both = np.isfinite(corners).all(1) & np.isfinite(points).all(1)
    if both.sum() < FEWEST_POINTS:
        reason = next(iter(pose.projector.reasons.items()), None)
        why = f" (point {reason[0]}: {reason[1]})" if reason else ""
        raise CalibrationError(
            f"pose {pose.name}: only {both.sum()} of {len(points)} points have projector "
            f"coordinates, expected at "
            f"least {FEWEST_POINTS}{why}: light the whole board with the fringes"
        )
    for axis, (size, name) in enumerate(zip(projector, ("columns", "rows"), strict=True)):
        low, high = points[both, axis].min(), points[both, axis].max()
        if low < -MARGIN * size or high > (1 + MARGIN) * size:
            raise CalibrationError(
                f"pose {pose.name}: the board lies at projector {name} {low:.0f} to {high:.0f}, "
                f"but the "
                f"projector has {size}: look at its size, the pitch, and which frames code which "
                f"direction"
            )
    plane = np.column_stack([corners[both], np.ones(both.sum())])
    affine = np.linalg.lstsq(plane, points[both], rcond=None)[0][:2]
    if np.linalg.det(affine) < 0:
        raise CalibrationError(
            f"pose {pose.name}: the camera sees the board mirrored, compared with the projector; "
            f"mirror the "
            "images, or look at the direction in which the projector's columns and rows are counted"
        )


def check_start(poses: Sequence[Pose], turns: Sequence[NDArray]) -> None:
    """Raise `CalibrationError` where all boards are parallel, given their rotation vectors."""
    normals = [cv2.Rodrigues(np.asarray(turn))[0][:, 2] for turn in turns]
    if not np.isfinite(normals).all():
        raise CalibrationError(
            "the poses don't determine the intrinsics: show the board from other directions"
        )
    tilt = max(
        np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b)) for a, b in combinations(normals, 2)
    )
    if tilt < LEAST_TILT_RAD:
        names = ", ".join(pose.name for pose in poses)
        raise CalibrationError(
            f"poses {names}: the board is parallel in all of them, within {np.rad2deg(tilt):.1f} "
            f"degrees, so that "
            "focal length and distance can't be told apart; tilt it by 20 degrees or more, about "
            "both axes"
        )


def check_solution(bundle: Bundle, x: NDArray[np.float64], sigma: NDArray[np.float64]) -> None:
    """Raise `CalibrationError` where a focal length is not determined, given all parameters'
    standard uncertainties."""
    for name, part in (("camera", bundle.camera), ("projector", bundle.projector)):
        focal = x[part][:2]
        if not (focal > 0).all() or (sigma[part][:2] > LARGEST_FOCAL_SIGMA * focal).any():
            raise CalibrationError(
                f"the poses don't determine the {name}'s focal length: {focal[0]:.0f} ± "
                f"{sigma[part][0]:.0f} px; tilt "
                "the board more and in other directions, or choose a lens with fewer terms"
            )


def calibrate(
    poses: Sequence[Pose],
    board: Board,
    camera_size: tuple[int, int],
    projector_size: tuple[int, int],
    lenses: tuple[Lens, Lens] = (Lens(), Lens()),
    *,
    estimate_board: bool = False,
    baseline_mm: float | None = None,
    hold_out: bool = True,
) -> Calibration:
    """Calibrate a rig from at least three poses of a flat board; sizes are (width, height) in px.

    ``lenses``: of camera and projector. No point is rejected. Camera and projector residuals are
    weighted by the inverse of the variances that they show, the projector's with the own
    uncertainty of each point. ``estimate_board``: the board's points are estimated too, about their
    nominal places (Strobl and Hirzinger, More accurate pinhole camera calibration with imperfect
    planar target, ICCV Workshops 2011). ``baseline_mm``: lengths are scaled so that the baseline
    has this length; without it the scale is that of the board's spacing. ``hold_out``: compute the
    held-out errors (a fit for each pose; needs four).

    Raises `CalibrationError` for too few or parallel poses, other image sizes, mirrored images,
    points outside the projector, and where the captures don't determine the rig; it names the
    pose."""
    sizes = (camera_size, projector_size)
    check_poses(poses, board, sizes)
    if baseline_mm is not None and not 0 < baseline_mm < np.inf:
        raise CalibrationError(
            f"baseline_mm: expected a positive number of mm, got {baseline_mm!r}"
        )
    bundle, x, alone = _without_circle_bias(poses, board, sizes, lenses)
    if estimate_board:
        poses = same_labels(board, bundle, x)
        bundle, x, alone = _without_circle_bias(poses, board, sizes, lenses, free_board=True)
    root = bundle.spread(x)
    check_solution(bundle, x, np.linalg.norm(root, axis=1))
    held_out = _held_out(bundle, x) if hold_out and len(poses) > 3 else [float("nan")] * len(poses)
    calibration = _result(bundle, x, root, alone, held_out, board, sizes, baseline_mm)
    return replace(calibration, doubts=tuple(doubts(calibration, bundle, x, root)))


def _without_circle_bias(
    poses: Sequence[Pose],
    board: Board,
    sizes: tuple,
    lenses: tuple[Lens, Lens],
    free_board: bool = False,
) -> tuple[Bundle, NDArray[np.float64], tuple[float, float]]:
    """The fit, with the bias of circles' centroids taken off and fitted again until it stays."""
    start, alone = _start(poses, board, sizes, lenses)
    bundle = Bundle(poses, board.points_mm(), lenses, free_board)
    x = _weighted_fit(bundle, start)
    for _ in range(CIRCLE_ROUNDS if board.radius_mm else 0):
        targets = [without_bias(bundle, x, index, board.radius_mm) for index in range(len(poses))]
        change = max(
            np.nanmax(np.abs(new[0] - old[0]))
            for new, old in zip(targets, bundle.targets, strict=True)
        )
        bundle.targets = targets
        x = _weighted_fit(bundle, x)
        if change < CIRCLE_TOLERANCE_PX:
            break
    return bundle, x, alone


def _start(
    poses: Sequence[Pose], board: Board, sizes: tuple, lenses: tuple[Lens, Lens]
) -> tuple[NDArray[np.float64], tuple[float, float]]:
    """All parameters from OpenCV's calibrations of each device and of the pair, and the RMS of each
    device alone. First with one radial term, from which the full model then starts."""
    points = board.points_mm().astype(np.float32)
    intrinsics, rms, views = [], [], []
    for device, (size, lens) in enumerate(zip(sizes, lenses, strict=True)):
        seen = [[pose.corners_px, pose.projector.points_px][device] for pose in poses]
        kept = [np.isfinite(pixels).all(1) for pixels in seen]
        objects = [points[keep] for keep in kept]
        # OpenCV refuses a start whose principal point is outside the image, where a projector's may
        # well be: the image gets a margin of its own size all round.
        images = [
            (pixels[keep] + size).astype(np.float32)[:, None]
            for pixels, keep in zip(seen, kept, strict=True)
        ]
        with_margin = tuple(3 * length for length in size)
        simple = Lens("radial-1" if lens.model != "none" else "none", True, lens.centred)
        try:
            _, matrix, distortion, turns, _ = cv2.calibrateCamera(
                objects, images, with_margin, None, None, flags=simple.flags
            )
            if device == 0:
                check_start(poses, turns)
            guess = (
                np.asarray(matrix, dtype=np.float64),
                np.resize(np.asarray(distortion, dtype=np.float64), 5),
            )
            flags = lens.flags + cv2.CALIB_USE_INTRINSIC_GUESS
            error, matrix, distortion, turns, shifts = cv2.calibrateCamera(
                objects, images, with_margin, *guess, flags=flags
            )
        except cv2.error as problem:
            raise CalibrationError(
                f"OpenCV can't calibrate the {'projector' if device else 'camera'} from these "
                f"poses ({problem.err}): "
                "the board has to be seen from different directions, and its points labelled alike "
                "in all poses"
            ) from problem
        distortion = np.resize(np.ravel(distortion), lens.coefficients)
        if not (np.isfinite(matrix).all() and np.isfinite(distortion).all()):
            raise CalibrationError(
                "the poses don't determine the intrinsics: show the board from other directions"
            )
        intrinsics.append(np.concatenate([np.diag(matrix)[:2], matrix[:2, 2] - size, distortion]))
        rms.append(float(error))
        views.append((turns, shifts))
    first, second = (Rotation.from_rotvec(np.reshape(vectors, (-1, 3))) for vectors, _ in views)
    shifts = [np.reshape(vectors, (-1, 3)) for _, vectors in views]
    between = second * first.inv()
    stereo = [between.mean().as_rotvec(), np.median(shifts[1] - between.apply(shifts[0]), axis=0)]
    boards = np.hstack([np.reshape(views[0][0], (-1, 3)), shifts[0]]).ravel()
    start = [*intrinsics, *stereo, boards, board.points_mm().ravel(), np.zeros(2)]
    return np.concatenate(start), (rms[0], rms[1])


def _weighted_fit(bundle: Bundle, start: NDArray[np.float64]) -> NDArray[np.float64]:
    """The fit, repeated with the variances of camera and projector that the last one showed."""
    x = bundle.fit(start)
    for _ in range(WEIGHT_ROUNDS):
        before = bundle.extra_px
        bundle.weigh(x)
        x = bundle.fit(x)
        if np.allclose(before, bundle.extra_px, rtol=1e-3):
            break
    return x


def _held_out(bundle: Bundle, x: NDArray[np.float64]) -> list[float]:
    errors = []
    for index in range(len(bundle.poses)):
        others = [i for i in range(len(bundle.poses)) if i != index]
        fitted = bundle.fit(bundle.fit(x, others), [index], only_poses=True)
        errors.append(errors_px(*bundle.residuals(fitted, index)).both)
    return errors


def _result(
    bundle: Bundle,
    x: NDArray,
    root: NDArray,
    alone: tuple[float, float],
    held_out: list[float],
    board: Board,
    sizes: tuple,
    baseline_mm: float | None,
) -> Calibration:
    sigma = np.linalg.norm(root, axis=1)
    devices = []
    for part, lens, size in zip(
        (bundle.camera, bundle.projector), bundle.lenses, sizes, strict=True
    ):
        fx, fy, cx, cy, *terms = x[part].tolist()
        pinhole = Pinhole(size[0], size[1], fx, fy, cx, cy, tuple(terms))
        devices.append(Device(lens, pinhole, tuple(sigma[part].tolist())))
    turn, shift = x[bundle.stereo][:3], x[bundle.stereo][3:]
    of_shift = root[bundle.stereo][3:]
    scale, factor = f"from the board's spacing of {board.spacing_mm:g} mm", 1.0
    if baseline_mm is not None:
        length = float(np.linalg.norm(shift))
        factor, along = baseline_mm / length, shift / length
        spacing = f"{board.spacing_mm * factor:.4f}"
        scale = f"from the baseline of {baseline_mm:g} mm; the board's spacing is then {spacing} mm"
        of_shift = of_shift - np.outer(along, along @ of_shift)
    fitted = []
    for index, pose in enumerate(bundle.poses):
        place = x[bundle.pose(index)]
        turned, moved = tuple(place[:3].tolist()), tuple((factor * place[3:]).tolist())
        residuals = bundle.residuals(x, index)
        fitted.append(
            FittedPose(pose.name, turned, moved, held_out[index], bundle.targets[index], residuals)
        )
    return Calibration(
        devices[0],
        devices[1],
        tuple(map(tuple, cv2.Rodrigues(turn)[0].tolist())),
        tuple((factor * shift).tolist()),
        tuple((factor * np.linalg.norm(of_shift, axis=1)).tolist()),
        scale,
        alone,
        bundle.extra_px,
        _bic(bundle, x),
        np.concatenate(
            [
                *(root[part] for part in (bundle.camera, bundle.projector)),
                root[bundle.stereo][:3],
                factor * of_shift,
            ]
        ),
        factor * x[bundle.board].reshape(-1, 3),
        tuple(fitted),
    )


def _bic(bundle: Bundle, x: NDArray) -> float:
    """Bayesian information criterion: -2 log likelihood + unknowns x log(coordinates)."""
    residuals = np.concatenate(bundle.joined(lambda index: bundle.residuals(x, index)))
    sigmas = np.concatenate(bundle.joined(bundle.sigmas))
    seen = np.isfinite(residuals)
    terms = (residuals[seen] / sigmas[seen]) ** 2 + np.log(2 * np.pi * sigmas[seen] ** 2)
    return float(terms.sum()) + (bundle.free.shape[1] + 2) * float(np.log(terms.size))
