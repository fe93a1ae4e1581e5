"""The terms of the image-translation baseline against NumPy and closed forms."""

import math

import numpy as np
import pytest
import torch

from fpp_ml_bench.baselines.training.losses import (
    LOG_FLOOR,
    feature_matching,
    gradient_l1,
    l1,
    scale_invariant_log,
    scores_against,
)


def test_scores_and_features_against_numpy():
    rng = np.random.default_rng(0)

    def answers():
        return [
            [torch.from_numpy(rng.normal(size=(2, channels, 4, 4))) for channels in (3, 5, 1)]
            for _ in range(2)
        ]

    generated, real = answers(), answers()
    expected = sum(((scale[-1].numpy() - 1) ** 2).mean() for scale in generated)
    assert scores_against(generated, real=True).item() == pytest.approx(expected)
    expected = sum((scale[-1].numpy() ** 2).mean() for scale in generated)
    assert scores_against(generated, real=False).item() == pytest.approx(expected)
    expected = np.mean(
        [
            sum(abs(g[layer] - r[layer]).mean() for layer in (0, 1))
            for g, r in zip(generated, real, strict=True)
        ]
    )
    assert feature_matching(generated, real).item() == pytest.approx(expected)
    assert feature_matching(real, real) == 0
    generated[0][0].requires_grad_()
    real[0][0].requires_grad_()
    feature_matching(generated, real).backward()
    assert generated[0][0].grad.any() and real[0][0].grad is None


def test_gradient_l1_of_a_ramp_and_of_an_offset():
    rows, columns = torch.meshgrid(torch.arange(5.0), torch.arange(7.0), indexing="ij")
    ramp = (0.25 * rows - 0.5 * columns)[None, None]
    flat = torch.zeros_like(ramp)
    assert gradient_l1(ramp, flat).item() == pytest.approx(0.25 + 0.5)
    assert gradient_l1(ramp + 3, ramp) == 0
    assert l1(ramp + 3, ramp) == 3


def test_scale_invariant_log_of_a_wrong_scale_is_half_its_squared_logarithm():
    """With lambda 1/2, log p = log t + c everywhere on the object costs c^2 / 2; the background
    costs nothing."""
    floor = LOG_FLOOR
    target = torch.rand(2, 1, 6, 6, dtype=torch.float64) * 0.4 + 0.1
    target[:, :, :2] = 0
    factor = torch.tensor([1.5, 0.8], dtype=torch.float64)[:, None, None, None]
    prediction = (target + floor) * factor - floor
    prediction[:, :, :2] = 0.7
    expected = (np.log(1.5) ** 2 + np.log(0.8) ** 2) / 2 / 2
    assert scale_invariant_log(prediction, target).item() == pytest.approx(expected)
    assert scale_invariant_log(target, target) == 0


def test_scale_invariant_log_at_its_ends():
    target = torch.rand(2, 1, 6, 6, dtype=torch.float64) * 0.9 + 0.05
    target[1] = 0
    prediction = torch.rand_like(target).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: scale_invariant_log(p, target), prediction)
    for level in (-0.5, 0.0, 1.0):
        flat = torch.full_like(target, level).requires_grad_()
        for depth in (target, torch.zeros_like(target), torch.ones_like(target)):
            value = scale_invariant_log(flat, depth)
            value.backward()
            assert value.isfinite() and value >= 0
            assert flat.grad.isfinite().all()
    assert scale_invariant_log(prediction, torch.zeros_like(target)) == 0
    for place in (0, 1):
        pair = [prediction.detach().clone(), target.clone()]
        pair[place][1, 0, 2, 2] = math.nan
        assert scale_invariant_log(*pair).isnan()
