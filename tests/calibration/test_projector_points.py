"""Projector coordinates at board points: exact homographies with noise, holes and wrong orders."""

import numpy as np
import pytest

from fpp_ml_bench.calibration.boards import parse_board
from fpp_ml_bench.calibration.projector_points import measure_pose, projector_points
from fpp_ml_bench.errors import CalibrationError

TO_PROJECTOR = np.array([[1.3, 0.1, 40.0], [-0.05, 1.2, 60.0], [4e-4, -3e-4, 1.0]])
CORNERS = np.stack(np.meshgrid(30.3 + 21 * np.arange(6), 25.7 + 20 * np.arange(5)), -1).reshape(
    -1, 2
)
SHAPE = (130, 160)


def _seen(x, y):
    image = TO_PROJECTOR @ np.stack([np.ravel(x), np.ravel(y), np.ones(np.size(x))])
    return (image[:2] / image[2]).reshape(2, *np.shape(x))


def _maps(noise_px=0.0, seed=0):
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(float)
    return _seen(x, y) + np.random.default_rng(seed).normal(0, noise_px, (2, *SHAPE))


def _squares():
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    return (np.floor((x - 30.3) / 21) + np.floor((y - 25.7) / 20)) % 2 == 0


def test_an_exact_homography_is_reproduced():
    points = projector_points(CORNERS, *_maps())
    np.testing.assert_allclose(points.points_px, _seen(*CORNERS.T).T, atol=1e-9)
    step = 1e-5
    for axis in range(2):
        moved = CORNERS + step * np.eye(2)[axis]
        slope = (_seen(*moved.T) - _seen(*CORNERS.T)).T / step
        np.testing.assert_allclose(points.jacobian[:, :, axis], slope, atol=1e-4)
    assert points.reasons == {}


@pytest.mark.parametrize("dark", [False, True])
def test_noise_holes_and_wrong_orders_leave_the_stated_uncertainty(dark):
    rng = np.random.default_rng(2)
    u, v = _maps(0.2)
    wrong = rng.random(SHAPE) < 0.1
    u = np.where(wrong, u + 114 * rng.integers(-1, 2, SHAPE), u)
    if dark:
        u = np.where(_squares(), np.nan, u)
    points = projector_points(CORNERS, u, v)
    scores = (points.points_px - _seen(*CORNERS.T).T) / points.sigma_px
    assert 0.6 < np.sqrt(np.mean(scores**2)) < 1.4
    assert points.sigma_px.max() < 0.08


def test_points_without_enough_pixels_say_why():
    u, v = _maps()
    u[:66] = np.nan
    v[:, 150:] = np.nan
    corners = np.concatenate([CORNERS, [[np.nan, np.nan]]])
    points = projector_points(corners, u, v)
    missing = np.isnan(points.points_px).any(1)
    assert sorted(points.reasons) == np.flatnonzero(missing).tolist()
    assert "only 0 of" in points.reasons[0] and "one side" in points.reasons[12]
    assert points.reasons[30] == "not seen by the camera"
    assert not missing[24:30].any()


def test_other_sizes_are_refused():
    with pytest.raises(
        CalibrationError,
        match=r"pose a: the image is 160 x 130 px, but the map of projector rows 160",
    ):
        board = parse_board("checker:6x5:10")
        measure_pose("a", np.zeros(SHAPE, np.uint8), np.zeros(SHAPE), np.zeros((131, 160)), board)
