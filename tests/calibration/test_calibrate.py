"""Calibration of rigs that OpenCV projected: exact points, noise, circles, irregular boards, and
what is refused."""

import cv2
import numpy as np
import pytest
from calibration import rigs

from fpp_ml_bench.calibration.boards import parse_board
from fpp_ml_bench.calibration.projector_points import ProjectorPoints
from fpp_ml_bench.calibration.result import Lens
from fpp_ml_bench.calibration.solve import calibrate
from fpp_ml_bench.errors import CalibrationError
from fpp_ml_bench.optics.rig import Rig

BOARD = parse_board("checker:9x7:18")
SIZES = (rigs.CAMERA_SIZE, rigs.PROJECTOR_SIZE)


def _truth():
    values = []
    for matrix, terms in ((rigs.CAMERA, rigs.CAMERA_TERMS), (rigs.PROJECTOR, rigs.PROJECTOR_TERMS)):
        values += [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *terms]
    return np.array([*values, *rigs.TURN, *rigs.SHIFT_MM])


def _values(calibration):
    values, sigmas = [], []
    for device in (calibration.camera, calibration.projector):
        pinhole = device.pinhole
        values += [*pinhole.focal, *pinhole.centre, *pinhole.distortion]
        sigmas += device.sigma
    values += cv2.Rodrigues(np.array(calibration.rotation))[0].ravel().tolist()
    values += calibration.translation_mm
    sigmas += [*np.linalg.norm(calibration.root[-6:-3], axis=1), *calibration.translation_sigma_mm]
    return np.array(values), np.array(sigmas)


def test_exact_points_give_the_exact_rig():
    calibration = calibrate(rigs.poses(BOARD.points_mm()), BOARD, *SIZES)
    assert calibration.rms_px.both < 1e-6 and calibration.held_out_rms_px < 1e-6
    np.testing.assert_allclose(_values(calibration)[0], _truth(), rtol=1e-6, atol=1e-7)
    assert calibration.camera.pinhole.fx == pytest.approx(1500, abs=1e-4)
    devices = calibration.camera.pinhole, calibration.projector.pinhole
    rig = Rig(*devices, calibration.rotation, calibration.translation_m)
    assert rig.baseline_m * 1000 == pytest.approx(calibration.baseline_mm)


def test_noise_stays_within_the_stated_uncertainties():
    scores = []
    for seed in range(4):
        poses = rigs.poses(BOARD.points_mm(), noise_px=0.05, seed=seed)
        calibration = calibrate(poses, BOARD, *SIZES, hold_out=False)
        values, sigmas = _values(calibration)
        scores.append((values - _truth()) / sigmas)
        assert calibration.noise_px == pytest.approx((0.05, 0.05), rel=0.12)
        assert calibration.rms_px.both == pytest.approx(0.05 * 2**0.5, rel=0.1)
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.4 and np.abs(scores).max() < 4


def test_noisier_projector_coordinates_weigh_less():
    poses = rigs.poses(BOARD.points_mm(), noise_px=0.05)
    rng = np.random.default_rng(5)
    noisy = []
    for pose in poses:
        points = pose.projector.points_px + rng.normal(0, 0.4, pose.corners_px.shape)
        measured = pose.projector._replace(points_px=points, sigma_px=np.full_like(points, 0.4))
        noisy.append(pose._replace(projector=measured))
    calibration = calibrate(noisy, BOARD, *SIZES, hold_out=False)
    assert calibration.noise_px[0] == pytest.approx(0.05, rel=0.12)
    assert calibration.noise_px[1] < 0.15
    values, sigmas = _values(calibration)
    assert np.abs((values - _truth()) / sigmas).max() < 4


def test_the_start_is_opencvs_calibration_and_its_error_is_reported():
    poses = rigs.poses(BOARD.points_mm(), noise_px=0.3)
    lens = Lens("radial-1", square_pixels=True, centred=True)
    calibration = calibrate(poses, BOARD, *SIZES, (lens, Lens("radial-1")), hold_out=False)
    points = [BOARD.points_mm().astype(np.float32)] * len(poses)
    images = [pose.corners_px.astype(np.float32) for pose in poses]
    rms = cv2.calibrateCamera(points, images, rigs.CAMERA_SIZE, None, None, flags=lens.flags)[0]
    assert calibration.alone_rms_px[0] == pytest.approx(rms, rel=1e-4)
    camera, projector = calibration.camera.pinhole, calibration.projector.pinhole
    assert camera.fx == camera.fy and calibration.camera.sigma[2:4] == (0.0, 0.0)
    assert camera.centre == (639.5, 479.5)
    assert camera.distortion[1:] == (0.0,) * 4 and projector.fx != projector.fy


def test_a_given_baseline_sets_the_scale():
    poses = rigs.poses(BOARD.points_mm(), noise_px=0.05)
    free = calibrate(poses, BOARD, *SIZES, hold_out=False)
    scaled = calibrate(poses, BOARD, *SIZES, baseline_mm=200.0, hold_out=False)
    factor = 200.0 / free.baseline_mm
    assert scaled.baseline_mm == pytest.approx(200.0)
    spacing_mm = np.linalg.norm(scaled.board_mm[1] - scaled.board_mm[0])
    assert (
        spacing_mm == pytest.approx(18 * factor) and "from the baseline of 200 mm" in scaled.scale
    )
    np.testing.assert_allclose(
        scaled.poses[2].translation_mm, factor * np.array(free.poses[2].translation_mm)
    )
    assert scaled.rms_px.both == pytest.approx(free.rms_px.both, rel=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("radius_known", [True, False])
def test_the_bias_of_circles_is_taken_off(radius_known):
    radius_mm = 7.0
    board = parse_board("circles:8x6:22" + f":{radius_mm}" * radius_known)
    points = board.points_mm()
    angle = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    outline = radius_mm * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    poses, bias = [], []
    for index in range(5):
        edges = project_outlines(points, outline, index)
        centres, shown = rigs.project(points, index)
        step = edges - edges.mean(1, keepdims=True)
        following = np.roll(step, -1, axis=1)
        area = (
            step[..., 0] * following[..., 1] - step[..., 1] * following[..., 0]
        ) / 2  # of triangles at the mean
        centroids = (
            edges.mean(1) + ((step + following) / 3 * area[..., None]).sum(1) / area.sum(1)[:, None]
        )
        bias.append(centroids - centres)
        # What a fit round the centroid would read: the projector's coordinate moves along with the
        # image position.
        jacobian = projector_jacobian(points, index)
        shown = shown + np.einsum("nij,nj->ni", jacobian, centroids - centres)
        projector = ProjectorPoints(shown, np.zeros_like(shown), jacobian, {})
        poses.append(rigs.pose(f"pose{index}", centroids, shown)._replace(projector=projector))
    assert np.abs(bias).max() > 0.1
    calibration = calibrate(poses, board, *SIZES, hold_out=False)
    error = np.abs(_values(calibration)[0] - _truth())
    if radius_known:
        assert calibration.rms_px.both < 1e-4
        assert error[:2].max() < 0.01 and error[-3:].max() < 0.002
    else:
        assert error[:2].max() > 0.1  # which the residuals don't show


def project_outlines(points, outline, index):
    edges = (points[:, None] + outline).reshape(-1, 3)
    return rigs.project(edges, index, middle=points)[0].reshape(len(points), -1, 2)


def projector_jacobian(points, index, step_mm=0.01):
    """Change of projector coordinates with the image position, through small steps on the board."""
    slopes = []
    for axis in range(2):
        ends = [
            rigs.project(points + sign * step_mm * np.eye(3)[axis], index, middle=points)
            for sign in (1, -1)
        ]
        slopes.append([(ends[0][device] - ends[1][device]) / (2 * step_mm) for device in range(2)])
    to_image = np.stack([slopes[0][0], slopes[1][0]], axis=-1)
    to_projector = np.stack([slopes[0][1], slopes[1][1]], axis=-1)
    return to_projector @ np.linalg.inv(to_image)


@pytest.mark.long
def test_an_irregular_board_is_estimated_whatever_its_labels():
    board = parse_board("checker:6x5:28")
    irregular = board.points_mm() + np.random.default_rng(3).normal(0, 0.08, (30, 3))
    poses = rigs.poses(irregular, noise_px=0.03)
    for index in (1, 4):
        seen, measured = poses[index].corners_px, poses[index].projector
        turned = (part[::-1] for part in measured[:3])
        poses[index] = poses[index]._replace(
            corners_px=seen[::-1], projector=ProjectorPoints(*turned, {})
        )
    given = calibrate(poses, board, *SIZES, hold_out=False)
    estimated = calibrate(poses, board, *SIZES, estimate_board=True, hold_out=False)
    assert given.rms_px.both > 0.15 and estimated.rms_px.both < 0.045
    errors = [
        min(
            np.sqrt(np.mean((points - irregular)[:, :2] ** 2))
            for points in (found, np.flipud(_turned(found, board)))
        )
        for found in (estimated.board_mm, given.board_mm)
    ]
    assert errors[0] < 0.03 < errors[1]


def _turned(points, board):
    """The points turned by half a turn about the middle of the board."""
    return np.array([1, 1, 0]) * (2 * board.points_mm().mean(0)) + np.array([-1, -1, 1]) * points


@pytest.mark.long
def test_the_lens_that_was_there_predicts_best_and_a_bad_pose_is_named():
    poses = rigs.poses(BOARD.points_mm(), noise_px=0.05)
    found = [
        calibrate(poses, BOARD, *SIZES, (Lens(name), Lens(name)))
        for name in ("radial-1", "radial-3+tangential")
    ]
    found.sort(key=lambda calibration: calibration.held_out_rms_px)
    assert found[0].camera.lens.model == "radial-3+tangential"
    assert found[0].bic == min(calibration.bic for calibration in found) and found[0].spoilers == ()
    corners = poses[3].corners_px + np.random.default_rng(1).normal(
        0, 0.6, poses[3].corners_px.shape
    )
    poses[3] = poses[3]._replace(corners_px=corners)
    assert calibrate(poses, BOARD, *SIZES).spoilers == ("pose3",)


def test_missing_points_are_left_out():
    poses = rigs.poses(BOARD.points_mm())
    for pose in poses:
        pose.corners_px[:5] = np.nan
        pose.projector.points_px[3:9] = np.nan
        pose.projector.sigma_px[3:9] = np.nan
    calibration = calibrate(poses, BOARD, *SIZES, hold_out=False)
    assert calibration.rms_px.both < 1e-6
    np.testing.assert_allclose(_values(calibration)[0], _truth(), rtol=1e-6, atol=1e-7)


@pytest.mark.long
def test_the_rational_lens_has_eight_terms():
    poses, lens = rigs.poses(BOARD.points_mm(), noise_px=0.02), Lens("rational")
    calibration = calibrate(poses, BOARD, *SIZES, (lens, lens), hold_out=False)
    assert len(calibration.camera.pinhole.distortion) == 8 and calibration.rms_px.both < 0.03


def _refused(poses, message, **options):
    with pytest.raises(CalibrationError, match=message):
        calibrate(poses, BOARD, *SIZES, **options)


def test_captures_that_give_no_rig_are_refused_by_name():
    first, second, third, fourth = rigs.poses(BOARD.points_mm(), count=4)
    _refused([first, second], "at least 3 poses of the board, got 2")
    _refused(
        [first._replace(size=(640, 480)), second, third, fourth],
        "pose pose0: the image is 640 x 480 px",
    )
    with pytest.raises(CalibrationError, match="expected one of none"):
        Lens("fisheye")
    _refused([first, second, third, fourth], "baseline_mm", baseline_mm=-1.0)
    mirrored = third._replace(corners_px=third.corners_px * [-1, 1] + [1279, 0])
    _refused([first, second, mirrored], "pose pose2: the camera sees the board mirrored")

    def measured(points_px, **reasons):
        points = second.projector._replace(points_px=points_px, **reasons)
        return second._replace(projector=points)

    swapped = measured(second.projector.points_px[:, ::-1] + [500, 0])
    _refused([first, swapped, third], "pose pose1: the board lies at projector col")
    dark = measured(np.full((63, 2), np.nan), reasons={0: "only 3 of 80 pixels"})
    _refused([first, dark, third], r"pose pose1: only 0 of 63.*point 0: only 3 of")
    all_named = (
        r"(?s)2 poses can't be used.*  pose pose1: only 0 of 63 .*  pose pose2: the camera sees "
        r"the board mirrored"
    )
    _refused([first, dark, mirrored], all_named)


def test_parallel_boards_are_refused():
    poses = []
    points = BOARD.points_mm()
    for index, distance in enumerate((450.0, 520.0, 600.0, 680.0)):
        turn, shift = np.array([0.0, 0.1, 0.0]), np.array([-70.0, -60.0, distance])
        poses.append(rigs.pose(f"flat{index}", *rigs.project_at(points, turn, shift)))
    _refused(poses, "poses flat0, flat1, flat2, flat3: the board is parallel in all of them")
