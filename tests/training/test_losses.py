"""The losses against the paper's equations in NumPy float64, their gradients, and what they must
never hide."""

import math

import numpy as np
import pytest
import torch

from fpp_ml_bench.baselines.training.losses import loss_function, sample_losses
from fpp_ml_bench.baselines.training.recipe import LOSSES
from fpp_ml_bench.errors import RecipeError

ALL = [(name, 0.7 if name.startswith("hybrid") else None) for name in LOSSES]
every_loss = pytest.mark.parametrize(("name", "alpha"), ALL)


def paper(name, alpha, prediction, target):
    """Section 5.5 in float64, on the pixels of whatever it is given."""
    p, t = (np.asarray(values, dtype=np.float64).ravel() for values in (prediction, target))
    inside = t > 0

    def measure(error):
        return math.sqrt((error**2).mean() + 1e-8) if name.endswith("rmse") else abs(error).mean()

    if name.startswith("masked"):
        return measure((p - t)[inside])
    if name.startswith("hybrid"):
        return alpha * measure((p - t)[inside]) + (1 - alpha) * measure(p - t)
    return measure(p - t)


def images(count=3, height=11, width=14, seed=0, scale=1.0, dtype=torch.float64):
    """Predictions and targets whose objects differ in size, (count, 1, height, width)."""
    generator = torch.Generator().manual_seed(seed)
    shape = (count, 1, height, width)
    prediction = torch.rand(shape, generator=generator, dtype=torch.float64) * 1.4 - 0.2
    target = torch.rand(shape, generator=generator, dtype=torch.float64) * 0.9 + 0.1
    for sample in range(count):
        target[sample, :, : 2 + 3 * sample] = 0
    return (prediction * scale).to(dtype), (target * scale).to(dtype)


@every_loss
def test_values_are_the_papers(name, alpha):
    prediction, target = images()
    value = loss_function(name, alpha)(prediction, target)
    assert value.dtype == torch.float64 and value.shape == ()
    assert value.item() == pytest.approx(paper(name, alpha, prediction, target), rel=1e-13)


@every_loss
def test_a_sample_is_a_batch_of_its_own_and_not_a_share_of_the_pool(name, alpha):
    prediction, target = images()
    values = sample_losses(name, alpha, prediction, target)
    assert values.shape == (3,)
    assert values.tolist() == pytest.approx(
        [paper(name, alpha, *pair) for pair in zip(prediction, target, strict=True)]
    )
    if name != "l1":
        assert abs(values.mean() - loss_function(name, alpha)(prediction, target)) > 1e-5


@every_loss
def test_gradcheck(name, alpha):
    prediction, target = images(2, 5, 6)
    prediction.requires_grad_()
    assert torch.autograd.gradcheck(lambda p: loss_function(name, alpha)(p, target), prediction)
    assert torch.autograd.gradcheck(lambda p: sample_losses(name, alpha, p, target), prediction)


@every_loss
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_overflows_nowhere(name, alpha, dtype):
    prediction, target = images(scale=2100.0, dtype=dtype)
    prediction.requires_grad_()
    value = loss_function(name, alpha)(prediction, target)
    value.backward()
    assert value.dtype == torch.float32
    # Sums of 462 float32 terms, in whatever order: 84 eps, where 462 is the most that any order can
    # lose.
    assert value.item() == pytest.approx(
        paper(name, alpha, prediction.detach().float(), target.float()), rel=1e-5
    )
    assert prediction.grad.dtype == dtype
    assert prediction.grad.isfinite().all() and prediction.grad.any()


@pytest.mark.parametrize(("name", "alpha"), [pair for pair in ALL if pair[0] not in ("rmse", "l1")])
def test_samples_with_an_object_decide_for_those_without(name, alpha):
    prediction, target = images()
    target[1] = 0
    prediction.requires_grad_()
    value = loss_function(name, alpha)(prediction, target)
    value.backward()
    assert value.item() == pytest.approx(paper(name, alpha, prediction.detach(), target), rel=1e-13)
    values = sample_losses(name, alpha, prediction, target)
    assert values[0].item() == pytest.approx(paper(name, alpha, prediction[0].detach(), target[0]))
    if name.startswith("masked"):
        assert values[1] == 0 and (prediction.grad[1] == 0).all()


@every_loss
@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("row", [0, 10], ids=["background", "object"])
def test_what_is_not_finite_is_never_masked_away(name, alpha, bad, row):
    for place in (0, 1):
        pair = images()
        pair[place][0, 0, row, 3] = bad
        assert not loss_function(name, alpha)(*pair).isfinite()
        values = sample_losses(name, alpha, *pair)
        assert not values[0].isfinite()
        assert values[1:].isfinite().all()


def test_wrong_names_and_alphas_are_refused():
    with pytest.raises(RecipeError, match=r"unknown loss 'mse'; there are rmse, l1, masked_rmse"):
        loss_function("mse")
    for name in ("hybrid_rmse", "hybrid_l1"):
        for alpha in (None, -0.1, 1.01, math.nan, "0.7", True):
            with pytest.raises(RecipeError, match=f"{name} needs alpha.*from 0 to 1, got"):
                loss_function(name, alpha)
    with pytest.raises(RecipeError, match=r"masked_l1 takes no alpha, got 0\.5"):
        loss_function("masked_l1", 0.5)
    with pytest.raises(RecipeError, match="hybrid_l1 needs alpha"):
        sample_losses("hybrid_l1", None, *images())


def test_wrong_tensors_are_refused():
    loss = loss_function("rmse")
    prediction, target = images()
    for wrong_shape in (target[:, 0], target[:1], target[..., :-1], target.expand(3, 2, 11, 14)):
        with pytest.raises(ValueError, match=r"of one shape \(B, 1, H, W\)"):
            loss(prediction, wrong_shape)
    with pytest.raises(ValueError, match="not empty"):
        loss(prediction[:0], prediction[:0])
    both = prediction.expand(3, 2, 11, 14)
    with pytest.raises(ValueError, match="of one shape"):
        loss(both, both)
    with pytest.raises(ValueError, match=r"as floats, got torch.float64 and torch.int64"):
        loss(prediction, target.long())
