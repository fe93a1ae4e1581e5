"""Triangulation against projection, OpenCV, and a general-purpose optimiser."""

import cv2
import numpy as np
import pytest
from captures import opencv_matrix, projected
from scipy.optimize import least_squares

from fpp_ml_bench.decoding.triangulation import (
    depth_from_both,
    depth_from_coordinate,
    depth_noise_mm,
)
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import Rig, rotation_matrix
from fpp_ml_bench.optics.sequence import Sequence

CAMERA_LENS, PROJECTOR_LENS = (
    (-0.18, 0.09, 0.001, -0.002, -0.01),
    (0.07, -0.05, -0.001, 0.0015, 0.02),
)


def general_rig(camera_lens=(0.0,) * 5, projector_lens=(0.0,) * 5, size=40):
    """A rotated rig with the projector 5 cm ahead of the camera, so that all elements of R and t
    matter."""
    camera = Pinhole(size, size - 6, 2.3 * size, 2.2 * size, 0.52 * size, 0.45 * size, camera_lens)
    projector = Pinhole(400, 300, 700.0, 690.0, 190.3, 155.2, projector_lens)
    turn = rotation_matrix((0.05, -0.09, 0.12))
    return Rig(camera, projector, turn, (0.14, -0.11, -0.05), 14.0, 16.0, Sequence(6, 6, 6))


RIGS = {
    "paper": paper_rig(40),
    "general": general_rig(),
    "camera lens": general_rig(camera_lens=CAMERA_LENS),
    "both lenses": general_rig(CAMERA_LENS, PROJECTOR_LENS),
}


def scene(rig):
    """Random depths in the working range: rays (x, y), depth in mm, and the exact projector
    coordinates."""
    rays = rig.camera.rays()
    depth_m = np.random.default_rng(0).uniform(1.5, 2.1, rays[0].shape)
    return rays, depth_m * 1000, *projected(rig, depth_m)


@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS.keys())
def test_exact_coordinates_give_exact_depth(rig):
    rays, depth_mm, u, v = scene(rig)
    for coordinate, direction in ((u, "vertical"), (v, "horizontal")):
        found_mm = depth_from_coordinate(rays, coordinate, rig, direction)
        np.testing.assert_allclose(found_mm, depth_mm, atol=1e-6, rtol=0)
    from_both = depth_from_both(rays, u, v, rig, 0.3, 1.7)
    np.testing.assert_allclose(from_both.depth_mm, depth_mm, atol=1e-6, rtol=0)
    assert from_both.disagreement_px.max() < 1e-7


@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS.keys())
def test_opencv_triangulates_the_same_points(rig):
    rays, _, u, v = scene(rig)
    camera = np.hstack([np.eye(3), np.zeros((3, 1))])
    projector = np.hstack([rig.R, rig.t[:, None]])
    camera_points = np.stack([axis.ravel() for axis in rays])
    projector_points = np.stack([axis.ravel() for axis in rig.projector.normalised(u, v)])
    points = cv2.triangulatePoints(camera, projector, camera_points, projector_points)
    expected = (points[2] / points[3]).reshape(u.shape) * 1000
    np.testing.assert_allclose(depth_from_both(rays, u, v, rig).depth_mm, expected, rtol=1e-9)


@pytest.mark.parametrize("name", ["paper", "general", "camera lens"])
def test_least_squares_is_the_optimisers(name):
    rig = RIGS[name]
    rays, _, u, v = scene(rig)
    rng = np.random.default_rng(5)
    u, v = u + rng.normal(0, 0.4, u.shape), v + rng.normal(0, 0.4, v.shape)
    wu, wv = 0.4, 1.9
    from_both = depth_from_both(rays, u, v, rig, wu, wv)
    for row, column in [(0, 0), (5, 31), (20, 11), (33, 39)]:
        ray = np.array([rays[0][row, column], rays[1][row, column], 1.0])
        measured = np.array([u[row, column], v[row, column]])

        def misfit(w, ray=ray, measured=measured):
            pixel = np.array(rig.project(ray / w[0]))
            return (pixel - measured) * np.sqrt([wu, wv])

        best = least_squares(misfit, [1 / 1.8], xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert from_both.depth_mm[row, column] == pytest.approx(1000 / best.x[0], abs=1e-4)


def test_disagreement_is_the_distance_from_opencvs_epipolar_line():
    rig = RIGS["general"]
    rays, _, u, v = scene(rig)
    rng = np.random.default_rng(6)
    u, v = u + rng.normal(0, 0.5, u.shape), v + rng.normal(0, 0.5, v.shape)
    tx, ty, tz = rig.t
    essential = np.array([[0, -tz, ty], [tz, 0, -tx], [-ty, tx, 0]]) @ rig.R
    inverse = np.linalg.inv(opencv_matrix(rig.projector))
    camera_points = np.stack([rays[0].ravel(), rays[1].ravel()], axis=-1).reshape(-1, 1, 2)
    a, b, c = cv2.computeCorrespondEpilines(camera_points, 1, inverse.T @ essential)[
        :, 0
    ].T  # (a, b) has length 1
    expected = np.abs(a * u.ravel() + b * v.ravel() + c).reshape(u.shape)
    for weights in [(1.0, 1.0), (0.2, 3.0)]:
        disagreement_px = depth_from_both(rays, u, v, rig, *weights).disagreement_px
        np.testing.assert_allclose(disagreement_px, expected, rtol=2e-3, atol=1e-6)


def test_pixels_without_depth_are_nan():
    rig = paper_rig(40)
    rays = np.zeros(5), np.zeros(5)
    # Straight ahead: the far point u = cx is parallel, beyond it the intersection lies behind the
    # camera.
    u = np.array(
        [rig.projector.cx, rig.projector.cx - 60, np.nan, np.inf, 455.5 + 1824 * 0.125 / 1.8]
    )
    depth_mm = depth_from_coordinate(rays, u, rig, "vertical")
    assert np.isnan(depth_mm).tolist() == [True, True, True, True, False]
    assert depth_mm[4] == pytest.approx(1800)
    from_both = depth_from_both(rays, u, np.full(5, 569.5 - 1824 * 0.1 / 1.8), rig)
    assert np.isnan(from_both.depth_mm[[2, 3]]).all() and from_both.depth_mm[4] == pytest.approx(
        1800
    )
    missing = np.array([np.nan])
    assert np.isnan(
        depth_from_coordinate((missing, np.zeros(1)), np.array([500.0]), rig, "vertical")
    ).all()


def test_a_point_behind_the_projector_has_no_depth():
    # The projector is 1 m ahead of the camera: a point 0.5 m from the camera lies behind it.
    device = paper_rig().projector
    rig = Rig(paper_rig(40).camera, device, np.eye(3), (0.125, -0.1, -1.0))
    point = np.array([0.0, 0.0, 0.5]) + rig.t
    mirrored = device.fx * point[0] / point[2] + device.cx
    assert np.isnan(
        depth_from_coordinate((np.zeros(1), np.zeros(1)), np.array([mirrored]), rig, "vertical")
    ).all()


def test_a_direction_along_the_baseline_measures_nothing():
    rig = Rig(paper_rig(40).camera, paper_rig().projector, np.eye(3), (0.125, 0.0, 0.0))
    rays, _, u, v = scene(rig)
    assert np.isnan(depth_from_coordinate(rays, v, rig, "horizontal")).all()
    np.testing.assert_allclose(depth_from_both(rays, u, v, rig).depth_mm, scene(rig)[1], atol=1e-6)


def test_projector_distortion_beyond_inversion_is_nan():
    rig = general_rig(projector_lens=(-2.5, 0.0, 0.0, 0.0, 0.0))
    rays, _, u, _ = scene(rig)
    depth_mm = depth_from_coordinate(rays, np.full_like(u, 399.0), rig, "vertical")
    assert np.isnan(depth_mm).any()
    valid = ~np.isnan(depth_mm)  # these depths project back to the measured coordinate
    points = np.stack([rays[0] * depth_mm, rays[1] * depth_mm, depth_mm], axis=-1) / 1000
    assert np.abs(rig.project(points)[0][valid] - 399.0).max(initial=0.0) < 1e-6


def test_depth_noise_of_the_paper_rig_is_the_written_formula():
    expected = 18 / (2 * np.pi) * np.sqrt(2 / 18) / 60 * 1.8**2 / (1824 * 0.125) * 1000
    assert depth_noise_mm(paper_rig(), 1800.0, "vertical", 18, 60.0) == pytest.approx(
        expected, rel=1e-12
    )


def test_unknown_directions_and_steps_are_refused():
    rig = paper_rig(40)
    with pytest.raises(DecodeError, match="horizontal or vertical"):
        depth_from_coordinate((np.zeros(1), np.zeros(1)), np.zeros(1), rig, "both")
    with pytest.raises(DecodeError, match="horizontal, vertical or both"):
        depth_noise_mm(rig, 1800.0, "diagonal", 18, 60.0)
    with pytest.raises(DecodeError, match="at least 3"):
        depth_noise_mm(rig, 1800.0, "both", 2, 60.0)


def test_two_directions_without_weight_have_no_depth():
    rays, _, u, v = scene(RIGS["paper"])
    assert np.isnan(depth_from_both(rays, u, v, RIGS["paper"], 0.0, 0.0).depth_mm).all()
