"""Objectives as the engine drives them: every module gets its own gradient, the discriminator
really learns."""

import math

import pytest
import torch
from torch import nn
from torch.nn import functional

from fpp_ml_bench.baselines.training.losses import (
    Adversarial,
    AdversarialSettings,
    Regression,
    loss_function,
    sample_losses,
)
from fpp_ml_bench.errors import RecipeError
from fpp_ml_bench.loaders.training import FringeDepth

SIZE = 32


class Generator(nn.Module):
    """[0, 1] to [0, 1] by way of a Tanh, and a count of its calls."""

    def __init__(self):
        super().__init__()
        self.calls = 0
        self.layers = nn.Sequential(
            nn.Conv2d(1, 8, 3, padding=1), nn.ReLU(), nn.Conv2d(8, 1, 3, padding=1), nn.Tanh()
        )

    def forward(self, fringe):
        self.calls += 1
        return (self.layers(fringe * 2 - 1) + 1) / 2


class Discriminator(nn.Module):
    """Two scales, two layers and a patch score each: the interface of the real one."""

    def __init__(self):
        super().__init__()
        self.inputs = []
        self.scales = nn.ModuleList(
            nn.ModuleList(
                [nn.Conv2d(2, 8, 4, 2, 1), nn.Conv2d(8, 8, 4, 2, 1), nn.Conv2d(8, 1, 4, 1, 1)]
            )
            for _ in range(2)
        )

    def forward(self, pair):
        self.inputs.append(pair.detach())
        answers = []
        for layers in self.scales:
            features = [pair]
            for layer in layers:
                features.append(
                    functional.leaky_relu(
                        layer(features[-1]), 0.2 if layer is not layers[-1] else 1.0
                    )
                )
            answers.append(features[1:])
            pair = functional.avg_pool2d(pair, 2)
        return answers


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


def batch(count=2, seed=0, empty=False):
    """Fringes across a square object whose depth follows them, so that there is something to
    learn."""
    generator = torch.Generator().manual_seed(seed)
    phase = torch.rand(count, 1, 1, 1, generator=generator) * 2 * math.pi
    columns = torch.arange(SIZE, dtype=torch.float32).expand(count, 1, SIZE, SIZE)
    fringe = 0.5 + 0.4 * torch.cos(columns * 2 * math.pi / 8 + phase)
    depth = torch.zeros_like(fringe)
    if not empty:
        depth[:, :, 8:24, 8:24] = fringe[:, :, 8:24, 8:24]
    rows = torch.arange(count)
    return FringeDepth(
        fringe, depth, torch.tensor([[1500.0, 1700.0]] * count), rows, torch.zeros_like(rows)
    )


def adversarial():
    return Adversarial(Generator(), Discriminator())


def optimisers(objective, rate=1e-3):
    return {
        name: torch.optim.RMSprop(module.parameters(), rate)
        for name, module in objective.modules.items()
    }


def take(objective, optimiser, one_batch):
    """The engine's part: one update for every step; returns what was logged."""
    logged = {}
    for name, loss, values in objective.steps(one_batch):
        optimiser[name].zero_grad(set_to_none=True)
        loss.backward()
        optimiser[name].step()
        assert not values.keys() & logged.keys()
        assert all(not value.requires_grad and value.shape == () for value in values.values())
        logged |= values
    return logged


def weights(module):
    return torch.cat([parameter.detach().flatten().clone() for parameter in module.parameters()])


# Regression


def test_regression_is_its_loss_on_its_network():
    network, sample_batch = Generator(), batch()
    objective = Regression(network, "hybrid_l1", 0.7)
    assert list(objective.modules) == ["network"]
    [(name, loss, logged)] = objective.steps(sample_batch)
    expected = loss_function("hybrid_l1", 0.7)(network(sample_batch.fringe), sample_batch.depth)
    assert name == "network"
    assert loss == expected and loss.requires_grad
    assert logged == {"loss": expected.detach()}
    prediction = network(sample_batch.fringe).detach()
    values = objective.validation_losses(prediction, sample_batch)
    assert torch.equal(
        values, sample_losses("hybrid_l1", 0.7, prediction, sample_batch.depth)
    ) and values.shape == (2,)


def test_unknown_losses_are_refused_before_training():
    with pytest.raises(RecipeError, match="unknown loss 'gan'"):
        Regression(Generator(), "gan")


@pytest.mark.parametrize("kind", ["regression", "adversarial"])
def test_calls_go_through_the_modules_that_the_engine_put_in(kind):
    objective = Regression(Generator(), "l1") if kind == "regression" else adversarial()
    inner = dict(objective.modules)
    wrapped = {name: nn.Sequential(module) for name, module in inner.items()}
    called = []
    for name, module in wrapped.items():
        module.register_forward_pre_hook(lambda *_, name=name: called.append(name))
    objective.modules.update(wrapped)
    take(objective, optimisers(objective), batch())
    assert set(called) == set(inner)


# The adversarial pair


def test_a_step_of_each_with_one_generator_forward():
    objective = adversarial()
    assert list(objective.modules) == ["network", "discriminator"]
    before = {name: weights(module) for name, module in objective.modules.items()}
    names = [name for name, *_ in objective.steps(batch())]
    assert names == ["discriminator", "network"]
    assert objective.modules["network"].calls == 1
    take(objective, optimisers(objective), batch())
    for name, module in objective.modules.items():
        assert not torch.equal(weights(module), before[name])


def test_gradients_stay_with_the_module_whose_step_it_is():
    objective = adversarial()
    generator, discriminator = objective.modules["network"], objective.modules["discriminator"]
    steps = objective.steps(batch())
    next(steps)[1].backward()
    assert all(parameter.grad is None for parameter in generator.parameters())
    learnt = [parameter.grad.clone() for parameter in discriminator.parameters()]
    assert all(gradient.any() for gradient in learnt)
    next(steps)[1].backward()
    assert all(parameter.grad.any() for parameter in generator.parameters())
    # Untouched by the generator's backward: the next discriminator step starts clean.
    for parameter, gradient in zip(discriminator.parameters(), learnt, strict=True):
        assert torch.equal(parameter.grad, gradient)
        assert parameter.requires_grad


def test_frozen_parameters_stay_frozen_and_free_ones_are_freed_after_an_error():
    discriminator = Discriminator()
    first = next(discriminator.parameters())
    first.requires_grad_(False)
    objective = Adversarial(Generator(), discriminator)
    steps = objective.steps(batch())
    next(steps)
    discriminator.forward = None
    with pytest.raises(TypeError):
        next(steps)
    assert [parameter.requires_grad for parameter in discriminator.parameters()] == [False] + [
        True
    ] * 11


@pytest.mark.long
def test_the_discriminator_learns_on_two_fixed_distributions():
    """A generator that stands still: the loss must fall from guessing (0.5 with two scales) to
    telling them apart."""
    objective = adversarial()
    optimiser = optimisers(objective)
    optimiser["network"] = torch.optim.SGD(objective.modules["network"].parameters(), lr=0.0)
    before = weights(objective.modules["discriminator"])
    losses = [
        take(objective, optimiser, batch(seed=step))["discriminator"].item() for step in range(80)
    ]
    assert losses[0] > 0.4
    assert max(losses[-10:]) < 0.1
    assert not torch.equal(weights(objective.modules["discriminator"]), before)
    with torch.no_grad():
        unseen = batch(seed=1000)
        predicted = objective.modules["network"](unseen.fringe)
        for depth, expected in ((predicted, 0.0), (unseen.depth, 1.0)):
            pair = torch.cat([unseen.fringe, depth], 1) * 2 - 1
            for scale in objective.modules["discriminator"](pair):
                assert scale[-1].mean().item() == pytest.approx(expected, abs=0.3)


@pytest.mark.long
def test_the_generator_learns_from_the_discriminator_alone():
    """Without depth terms, the only way to fool the discriminator is a depth that looks like the
    batch's."""
    settings = AdversarialSettings(l1=0, gradient_l1=0, scale_invariant_log=0)
    objective = Adversarial(Generator(), Discriminator(), settings)
    optimiser = optimisers(objective)
    first = take(objective, optimiser, batch())["l1"].item()
    for step in range(100):
        last = take(objective, optimiser, batch(seed=step))["l1"].item()
    assert last < 0.8 * first


def test_the_discriminator_sees_fringe_and_depth_in_minus_one_to_one():
    sample_batch, discriminator = batch(), Discriminator()
    objective = Adversarial(Generator(), discriminator)
    predicted = objective.modules["network"](sample_batch.fringe).detach()
    list(objective.steps(sample_batch))
    pairs, generated, real = discriminator.inputs
    assert torch.equal(pairs, torch.cat([generated, real]))
    assert torch.equal(
        real, torch.cat([sample_batch.fringe * 2 - 1, sample_batch.depth * 2 - 1], dim=1)
    )
    assert torch.equal(
        generated, torch.cat([sample_batch.fringe * 2 - 1, predicted * 2 - 1], dim=1)
    )


def test_the_generators_loss_is_the_weighted_sum():
    objective = adversarial()
    (_, discriminator_loss, parts), (_, loss, terms) = objective.steps(batch())
    halves = parts["discriminator_generated"] + parts["discriminator_real"]
    assert discriminator_loss.item() == pytest.approx(halves.item() / 2)
    expected = {
        "adversarial": 1,
        "feature_matching": 10,
        "l1": 10,
        "gradient_l1": 5,
        "scale_invariant_log": 2,
    }
    expected |= {"hybrid_l1": 0}  # logged, of no weight for pix2pixHD
    assert set(terms) == {"loss", *expected}
    assert loss.item() == pytest.approx(
        sum(weight * terms[name].item() for name, weight in expected.items())
    )
    assert terms["loss"] == loss.detach()


def test_with_alpha_the_hybrid_l1_takes_the_place_of_the_depth_terms():
    objective = Adversarial(Generator(), Discriminator(), AdversarialSettings.of(0.7))
    _, (_, loss, terms) = objective.steps(batch())
    expected = {"adversarial": 1, "feature_matching": 10, "hybrid_l1": 200}
    assert loss.item() == pytest.approx(
        sum(weight * terms[name].item() for name, weight in expected.items())
    )
    assert AdversarialSettings.of(None) == AdversarialSettings()


def test_validation_looks_at_depth_alone():
    sample_batch, objective = batch(), adversarial()
    prediction = torch.rand_like(sample_batch.depth)
    expected = (prediction - sample_batch.depth).abs().mean((1, 2, 3))
    assert torch.allclose(objective.validation_losses(prediction, sample_batch), expected)


def test_gradients_are_finite_without_an_object():
    dtype = torch.bfloat16
    objective = Adversarial(Generator().to(dtype), Discriminator().to(dtype))
    sample_batch = batch(empty=True)
    for constant in (0.0, 1.0):
        fringe = torch.full_like(sample_batch.fringe, constant).to(dtype)
        for name, loss, _ in objective.steps(
            sample_batch._replace(fringe=fringe, depth=sample_batch.depth.to(dtype))
        ):
            assert loss.dtype == torch.float32 and loss.isfinite()
            objective.modules[name].zero_grad()
            loss.backward()
            assert all(
                parameter.grad.isfinite().all()
                for parameter in objective.modules[name].parameters()
            )


@pytest.mark.parametrize("place", [(0, 0), (15, 15)], ids=["background", "object"])
def test_nan_reaches_the_loss(place):
    objective = adversarial()
    for field in ("fringe", "depth"):
        sample_batch = batch()
        getattr(sample_batch, field)[0, 0][place] = math.nan
        for _, loss, _ in objective.steps(sample_batch):
            assert loss.isnan()


def test_spread_over_processes_it_is_the_same_training(tmp_path):
    """DistributedDataParallel stops where a forward has no backward, or a parameter gets no
    gradient."""

    def losses(wrap):
        torch.manual_seed(3)
        objective = adversarial()
        for name, module in objective.modules.items():
            objective.modules[name] = wrap(module)
        optimiser = optimisers(objective)
        return [take(objective, optimiser, batch(seed=step)) for step in range(3)]

    alone = losses(lambda module: module)
    torch.distributed.init_process_group(
        "gloo", init_method=f"file://{tmp_path}/rendezvous", rank=0, world_size=1
    )
    try:
        assert losses(nn.parallel.DistributedDataParallel) == alone
    finally:
        torch.distributed.destroy_process_group()


def test_one_autocast_around_both_steps_uses_the_updated_discriminator():
    """autocast keeps bfloat16 copies of weights until it ends: the generator must not be judged by
    outdated ones."""

    def losses(around_all):
        torch.manual_seed(3)
        objective = adversarial()
        optimiser = optimisers(objective, 0.01)
        logged = []
        with torch.autocast("cpu", torch.bfloat16, enabled=around_all):
            steps = objective.steps(batch())
            while True:
                with torch.autocast("cpu", torch.bfloat16):
                    name, loss, values = next(steps, (None, None, None))
                if name is None:
                    return logged
                optimiser[name].zero_grad(set_to_none=True)
                loss.backward()
                optimiser[name].step()
                logged.append({key: value.item() for key, value in values.items()})

    assert losses(around_all=True) == losses(around_all=False)
