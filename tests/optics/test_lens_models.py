"""The lens models beyond five coefficients: against OpenCV, closed forms of their folds, torch, and
rig files."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fpp_ml_bench.errors import RigError
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.pinhole import (
    Pinhole,
    distort,
    distortion_polynomial,
    fold_radius_squared,
    undistort,
)
from fpp_ml_bench.optics.rig_file import load_rig, save_rig

SPREAD = np.array(
    [0.2, 0.06, 0.003, 0.003, 0.02, 0.1, 0.05, 0.02, 0.003, 0.003, 0.003, 0.003, 0.1, 0.1]
)
COUNTS = (4, 5, 8, 12, 14)
TILTED = tuple((SPREAD * np.resize([-1.0, 0.9, 0.4, -0.7], 14)).tolist())


def _lens(rng, count):
    """A random lens, and points (x, y) that it images."""
    terms = tuple(rng.normal(size=count) * SPREAD[:count])
    lens = Pinhole(100, 100, 90.0, 90.0, 50.0, 50.0, terms).distortion
    radius = rng.uniform(0, min(0.6, 0.9 * np.sqrt(fold_radius_squared(lens))), 200)
    angle = rng.uniform(0, 2 * np.pi, 200)
    return lens, radius * np.cos(angle), radius * np.sin(angle)


@pytest.mark.parametrize("count", COUNTS)
def test_projection_is_opencvs_and_undistortion_inverts_it_up_to_the_fold(count):
    rng = np.random.default_rng(count)
    for _ in range(50):
        lens, x, y = _lens(rng, count)
        points = np.stack([x, y, np.ones_like(x)], axis=-1)
        expected, _ = cv2.projectPoints(
            points, np.zeros(3), np.zeros(3), np.eye(3), np.array(lens[:count])
        )
        distorted = distort(x, y, lens)
        np.testing.assert_allclose(np.stack(distorted, axis=-1), expected[:, 0], atol=1e-14)
        np.testing.assert_allclose(undistort(*distorted, lens), (x, y), atol=1e-12)


def _rational(k1=0.0, k2=0.0, k4=0.0, k5=0.0, k6=0.0):
    return (k1, k2, 0.0, 0.0, 0.0, k4, k5, k6)


@pytest.mark.parametrize(
    ("lens", "fold"),
    [
        (_rational(k4=4.0), 1 / 4),  # r / (1 + 4 r^2) is largest at r = 1/2
        (_rational(k4=-4.0), 1 / 4),  # r / (1 - 4 r^2) is infinite there
        (_rational(k5=1.0), 1 / np.sqrt(3.0)),  # r / (1 + r^4): 1 = 3 r^4
        (_rational(k1=0.5, k4=0.25), np.inf),
        (_rational(k1=1.0, k2=0.25, k4=1.0, k5=0.25), np.inf),  # r itself
        (_rational(k1=-0.5), 2 / 3),  # as with five coefficients
        ((-0.5, 0.0, 0.0, 0.0, 0.0), 2 / 3),
    ],
)
def test_folds_in_closed_form(lens, fold):
    assert fold_radius_squared(lens) == pytest.approx(fold, rel=1e-10)
    if np.isfinite(fold):
        radius = np.sqrt(fold) * np.array([0.999, 1.001])
        assert np.isnan(distort(radius, np.zeros(2), lens)[0]).tolist() == [False, True]


def test_what_a_folding_rational_lens_images_and_what_not():
    lens = _rational(k4=4.0)
    distorted = np.array([0.0, 0.1, 0.2, 0.249, 0.251, 1.0])
    ideal, _ = undistort(distorted, np.zeros(6), lens)
    expected = (1 - np.sqrt(1 - 16 * distorted[1:4] ** 2)) / (8 * distorted[1:4])
    np.testing.assert_allclose(ideal[:4], [0.0, *expected], rtol=1e-12)
    assert np.isnan(ideal[4:]).all()


def test_a_lens_with_a_pole_images_everything_before_it():
    lens = _rational(k4=-4.0)
    distorted = np.array([0.1, 1.0, 10.0])
    ideal, _ = undistort(distorted, np.zeros(3), lens)
    np.testing.assert_allclose(
        ideal, (np.sqrt(1 + 16 * distorted**2) - 1) / (8 * distorted), rtol=1e-12
    )


def test_rays_that_miss_a_tilted_sensor_have_no_image():
    lens = (*[0.0] * 12, 0.0, 1.2)  # rays at x < -cot(1.2) run away from it
    x, _ = distort(np.array([-0.39, -0.388, 0.0, 1.0]), np.zeros(4), lens)
    assert np.isnan(x).tolist() == [True, False, False, False]


def test_torch_tensors_pass_through_the_model():
    torch = pytest.importorskip("torch")
    x, y = np.random.default_rng(2).uniform(-0.4, 0.4, (2, 50))
    tensors = [torch.tensor(values, requires_grad=True) for values in (x, y)]
    moved = distortion_polynomial(*tensors, TILTED)
    np.testing.assert_allclose(
        [m.detach().numpy() for m in moved], distort(x, y, TILTED), atol=1e-15
    )
    moved[0].sum().backward()
    assert all(torch.isfinite(t.grad).all() for t in tensors)


@pytest.mark.parametrize("count", COUNTS[1:])
def test_rig_files_round_trip(tmp_path, count):
    rig = paper_rig(240)
    rig = replace(rig, projector=replace(rig.projector, distortion=TILTED[:count]))
    save_rig(rig, tmp_path / "rig.yaml")
    assert load_rig(tmp_path / "rig.yaml") == rig


def test_four_coefficients_become_five_and_other_numbers_are_refused():
    four = (0.1, 0.2, 0.3, 0.4)
    assert Pinhole(10, 10, 9.0, 9.0, 5.0, 5.0, four).distortion == (*four, 0.0)
    with pytest.raises(
        RigError, match="distortion: expected 4 or 5 or 8 or 12 or 14 numbers, got 6"
    ):
        Pinhole(10, 10, 9.0, 9.0, 5.0, 5.0, (0.1,) * 6)
