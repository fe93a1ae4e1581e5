"""The two theorems: frames that are the same bytes at two depths, and exponents against closed forms."""

from dataclasses import replace
from math import comb

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from fpp_ml_bench.baselines.diagnostics.probe import ProbeSettings, silent
from fpp_ml_bench.baselines.diagnostics.scene_renderer import SceneRenderer
from fpp_ml_bench.baselines.diagnostics.theory import (
    Theory,
    choice_of,
    depth_error_mm,
    error_curves,
    kappa_per_m,
    twins_of,
)
from fpp_ml_bench.baselines.training.losses import loss_function
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.optics.named_rigs import paper_rig


@pytest.mark.parametrize("direction, other_frame", [("horizontal", 18), ("vertical", 0)])
def test_two_depths_give_the_same_bytes(direction, other_frame, opened):
    twins = twins_of(opened, SceneRenderer.of(opened), direction)
    inside = twins.depths_mm[0] > 0
    distance_mm = np.abs(twins.depths_mm[1] - twins.depths_mm[0])[inside]
    assert distance_mm.min() > 150 and ((twins.depths_mm[1] > 0) == inside).all()
    np.testing.assert_array_equal(twins.frames[0], twins.frames[1])
    np.testing.assert_array_equal(twins.noiseless[0], twins.noiseless[1])
    assert twins.other_frame == other_frame and (twins.other_frames[0] != twins.other_frames[1]).mean() > 0.01
    assert (twins.frames[0] != twins.noiseless[0]).any()  # the noise is there
    assert 0 < twins.paint.min() <= twins.paint.max() <= 1


def test_no_room_for_a_period_is_said(opened):
    renderer = SceneRenderer.of(opened)
    renderer.rig = replace(renderer.rig, working_range_mm=(1700.0, 1900.0))
    with pytest.raises(DiagnosisError, match="no test object fits twice"):
        twins_of(opened, renderer)


@pytest.mark.parametrize("direction, baseline_m", [("horizontal", 0.1), ("vertical", 0.125)])
def test_one_period_against_the_closed_form(direction, baseline_m):
    rig, z = paper_rig(176), np.geomspace(0.3, 9.0, 50)
    kappa = 18 / (1824 * baseline_m)
    assert kappa_per_m(rig, direction) == pytest.approx(kappa, rel=1e-12)
    away, toward = (depth_error_mm(rig, direction, z, periods) for periods in (1.0, -1.0))
    np.testing.assert_allclose(away, 1000 * z**2 * kappa / (1 - z * kappa), rtol=1e-9)
    np.testing.assert_allclose(toward, 1000 * z**2 * kappa / (1 + z * kappa), rtol=1e-9)
    beyond = 1.01 / kappa
    assert np.isinf(depth_error_mm(rig, direction, np.array([beyond]), 1.0)).all()


def test_the_exponent_is_two_where_the_mistake_is_small_and_the_baseline_thin():
    small, away, toward, both, behind = error_curves(paper_rig(176), "horizontal")
    assert small["exponent"] == pytest.approx(2, rel=0.01) and small["quadratic_m"] == pytest.approx([0.3, 10.0])
    assert away["exponent"] > 2.1 and toward["exponent"] < 1.9
    assert both["quadratic_m"] is not None and both["quadratic_m"][1] == pytest.approx(1.0, rel=0.05)
    assert both["exponent"] == pytest.approx(2, rel=0.01)
    # With a projector 0.1 m behind, psi = gain / (Z + 0.1): the local exponent is 2 Z / (Z + 0.1) for a small mistake.
    at = np.searchsorted(behind["distances_m"], 0.5)
    z = behind["distances_m"][at]
    assert behind["local"][at] == pytest.approx(2 * z / (z + 0.1), rel=0.01)


def test_the_probe_needs_no_model(opened):
    finding = Theory().run(None, opened, ProbeSettings(), silent)
    assert Theory().applies_to(None) is None
    assert finding.values["twins"]["differing_pixels"] == 0
    assert all(len(figure.png) > 5000 for figure in finding.figures)
    assert "0 of the image's pixels differ" in finding.summary


def test_what_a_loss_chooses_of_two_depths():
    random = np.random.default_rng(0)
    first = np.zeros((30, 40))
    first[5:25, 8:30] = random.uniform(1600, 1700, (20, 22))
    second = np.where(first > 0, first + 300, 0)
    pair = [first, second]
    for loss, alpha in (("l1", None), ("masked_l1", None), ("hybrid_l1", 0.7)):
        for batch in (1, 4):  # a median, in batches of any size
            assert [choice_of(pair, loss, chance, batch, alpha) for chance in (0.25, 0.5, 0.75)] == [
                (0.0, 0.0),
                (0.0, 1.0),
                (1.0, 1.0),
            ]
    # The root of one image's mean square is its distance, so a batch of one image is a median too.
    assert choice_of(pair, "rmse", 0.25, 1) == (0.0, 0.0)
    # In batches of n: least sum over k of C(n, k) q^k (1 - q)^(n - k) sqrt(k (1 - c)^2 + (n - k) c^2).
    for batch, chance in ((4, 0.25), (4, 0.75), (9, 0.3)):
        places = np.linspace(0, 1, 100_001)
        expected = sum(
            comb(batch, k)
            * chance**k
            * (1 - chance) ** (batch - k)
            * np.sqrt(k * (1 - places) ** 2 + (batch - k) * places**2)
            for k in range(batch + 1)
        )
        low, high = choice_of(pair, "rmse", chance, batch)
        assert low - 0.01 <= places[expected.argmin()] <= high + 0.01 and high - low < 0.05
    low, high = choice_of(pair, "rmse", 0.3, 40)  # large batches: the mean
    assert low - 0.02 <= 0.3 <= high + 0.02


def test_a_free_answer_for_each_pixel_ends_where_one_number_for_all_does():
    """By gradient descent over every pixel, for the batches of two images with one of each scene."""
    random = np.random.default_rng(1)
    first = random.uniform(1.6, 1.7, (1, 1, 6, 7))
    target = torch.from_numpy(np.concatenate([first, first + 0.3]))

    def loss_and_gradient(x):
        answer = torch.from_numpy(x).view(1, 1, 6, 7).requires_grad_(True)
        loss = loss_function("rmse")(answer.expand_as(target), target)
        loss.backward()
        return loss.item(), answer.grad.numpy().ravel()

    found = minimize(loss_and_gradient, np.full(42, 1.5), jac=True, method="BFGS", options={"gtol": 1e-9})
    # The gradient of sqrt(0.15^2 + mean x^2) is x / (0.15 * 42): below 1e-9 where x is below 1e-8.
    np.testing.assert_allclose(found.x, first.ravel() + 0.15, rtol=0, atol=1e-7)
