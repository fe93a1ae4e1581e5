"""Range heads on a network whose every answer is known, and their parts against other solvers."""

import numpy as np
import pytest
import torch
from scipy import optimize
from scored_dataset import make_dataset
from tiny_network import config_of, tiny_network
from torch import nn

from fpp_ml_bench.baselines.networks import range_heads
from fpp_ml_bench.baselines.networks.base import FringeNetwork
from fpp_ml_bench.baselines.networks.model import Model, heads_from_tensors
from fpp_ml_bench.baselines.networks.range_heads import fit_heads
from fpp_ml_bench.errors import PredictionError, WeightsError

SIZE = (32, 48)
LOW_MM, STEPS, DARK = 1600, 200, 50


def scene(seed):
    """A tilted disk whose frame tells all: grey is 50 + 200 v on it, D_min - 1600 and the span stand in two rows."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    inside = (rows - 16) ** 2 + (columns - rng.integers(14, 34)) ** 2 < rng.integers(5, 11) ** 2
    low, span = int(rng.integers(0, 200)), int(rng.integers(40, 250))
    slope = columns + 0.5 * rows
    v = (slope - slope[inside].min()) / np.ptp(slope[inside])
    frame = np.where(inside, DARK + STEPS * v, 0).round().astype(np.uint8)
    frame[0], frame[1] = low, span
    return frame, np.where(inside, LOW_MM + low + span * v, 0).astype(np.float32)


class Rows(nn.Module):
    """The two rows that tell the range, as channels."""

    def forward(self, x):
        return torch.cat([x[:, :, 0:1], x[:, :, 1:2]], dim=1)


class Picture(nn.Module):
    """The rest of the frame, as one of two channels."""

    def forward(self, x):
        picture = x.clone()
        picture[:, :, :2] = 0
        return torch.cat([picture, torch.ones_like(picture)], dim=1)


class KnownNetwork(FringeNetwork):
    """Reads v off the frame; 0 outside the object."""

    name, stride, last_layer = "told", 1, "dec1"

    def __init__(self):
        super().__init__()
        self.rows, self.picture, self.gain = Rows(), Picture(), nn.Parameter(torch.tensor(255.0))

    @property
    def probe_layers(self):
        return {"bottleneck": self.rows, "dec1": self.picture}

    def represent(self, fringe):
        self.rows(fringe)
        return ((self.picture(fringe)[:, :1] * self.gain - DARK) / STEPS).clamp(min=0)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    views = [f"A{number}" for number in range(12)]
    return make_dataset(tmp_path_factory.mktemp("told") / "data", SIZE, exact=False, views=views, scene=scene)


@pytest.fixture(scope="module")
def config(dataset):
    return config_of(KnownNetwork(), image_size=SIZE, dataset_fingerprint=dataset.fingerprint)


@pytest.fixture(scope="module")
def fitted(dataset, config):
    return fit_heads(KnownNetwork(), config, dataset.path)


def known_range(dataset, split):
    rows = [dataset.measured(sample) for sample in dataset.samples(split)]
    return np.array([[row["depth_min_mm"], row["depth_max_mm"]] for row in rows])


def test_what_the_frame_tells_is_found(dataset, config, fitted):
    heads = heads_from_tensors(fitted, "told")
    model = Model(KnownNetwork().eval(), config, heads, torch.device("cpu"), "0" * 64)
    train = known_range(dataset, "train")
    np.testing.assert_allclose(heads.mean_range_mm.numpy(), train.mean(axis=0), rtol=1e-12)
    width = train[:, 1].max() - train[:, 0].min()
    limits = [train[:, 0].min() - width / 4, train[:, 1].max() + width / 4]
    np.testing.assert_allclose(heads.limits_mm.numpy(), limits)
    for sample in dataset.samples("validation"):
        frame, depth = dataset.frame(sample, 0), dataset.depth_mm(sample)
        v = np.where(depth > 0, frame - 50.0, 0) / STEPS
        by_mean = model.predict(frame, "mean")
        low, high = train.mean(axis=0)
        expected = np.where(depth > 0, np.clip(low + v * (high - low), *limits), 0)
        # Three roundings of float32 a pixel (product, sum, the value itself), no sum over pixels: 8 eps.
        np.testing.assert_allclose(by_mean, expected, rtol=1e-6)
        predicted = model.predict(frame)
        assert predicted.dtype == np.float32 and not predicted[depth == 0].any()
        assert np.abs(predicted - depth).max() < 250 / STEPS  # half a grey level, and what little the ridge shrinks


def test_fitting_is_deterministic_and_changes_nothing(dataset, config, fitted):
    network = KnownNetwork().train()
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    again = fit_heads(network, config, dataset.path)
    assert all(torch.equal(again[key], fitted[key]) and again[key].dtype == torch.float64 for key in fitted)
    assert network.training and not network.rows._forward_hooks and not network.picture._forward_hooks
    assert all(torch.equal(tensor, before[name]) for name, tensor in network.state_dict().items())


def test_depth_is_held_within_limits(config, fitted):
    heads = heads_from_tensors(fitted, "told")
    values = torch.tensor([-100.0, 0.5, 100.0]).reshape(1, 1, 1, 3)
    depth_mm = heads.unmasked_mm(values, torch.tensor([[1700.0, 100.0]]))
    assert depth_mm.flatten().tolist() == pytest.approx([float(heads.limits_mm[0]), 1750.0, float(heads.limits_mm[1])])


@pytest.mark.parametrize("network", ["unet", "resunet"])
def test_a_real_network_has_what_the_heads_need(dataset, network):
    net = tiny_network(network, width=2)
    about = config_of(net, image_size=SIZE, dataset_fingerprint=dataset.fingerprint)
    heads = heads_from_tensors(fit_heads(net, about, dataset.path), network)
    frames = [dataset.frame(sample, 0) for sample in dataset.samples("test")[:3]]
    model = Model(net, about, heads, torch.device("cpu"), "0" * 64)
    for twin in ("mean", "predicted"):
        together = model.predict_batch(frames, twin)
        assert np.isfinite(together).all() and together.shape == (3, *SIZE)
        inside = together[together != 0]
        assert (inside >= float(heads.limits_mm[0])).all() and (inside <= float(heads.limits_mm[1])).all()


def test_what_can_not_be_fitted(dataset, config):
    with pytest.raises(WeightsError, match="output is metric"):
        fit_heads(KnownNetwork(), config_of(KnownNetwork(), normalisation="raw"), dataset.path)
    with pytest.raises(WeightsError, match="was trained on dataset 000000"):
        fit_heads(KnownNetwork(), config_of(KnownNetwork(), image_size=SIZE), dataset.path)
    diverged = KnownNetwork()
    diverged.gain.data.fill_(float("inf"))
    with pytest.raises(PredictionError, match="NaN or infinite"):
        fit_heads(diverged, config, dataset.path)
    assert diverged.training


def test_tensors_that_are_no_heads(fitted):
    assert heads_from_tensors({}, "w") is None
    for change, words in (
        ({"mask_bias": torch.zeros(1, dtype=torch.float64)}, r"mask_bias: expected float64 \(\), got"),
        ({"range_bias": torch.zeros(2)}, "range_bias: expected float64"),
        ({"range_weight": torch.zeros(3, dtype=torch.float64)}, "range_weight: expected"),
        ({"more": torch.zeros(3)}, "differs in more"),
    ):
        with pytest.raises(WeightsError, match=words):
            heads_from_tensors({**fitted, **change}, "w")
    with pytest.raises(WeightsError, match="differs in mask_weight"):
        heads_from_tensors({key: value for key, value in fitted.items() if key != "mask_weight"}, "w")


def test_ridge_solves_the_normal_equations():
    rng = np.random.default_rng(0)
    train_features, validation_features = rng.normal(3, [1, 5, 0.1], (20, 3)), rng.normal(3, [1, 5, 0.1], (9, 3))
    train_ranges, validation_ranges = (
        x @ rng.normal(size=(3, 2)) + [1700, 150] + rng.normal(0, 0.3, (len(x), 2))
        for x in (train_features, validation_features)
    )
    weight, bias = range_heads._ridge(train_features, train_ranges, validation_features, validation_ranges)
    scaled = (train_features - train_features.mean(0)) / train_features.std(0)
    of_strength = []
    for strength in range_heads.RIDGE_STRENGTHS:
        solved = np.linalg.solve(
            scaled.T @ scaled + strength * 20 * np.eye(3), scaled.T @ (train_ranges - train_ranges.mean(0))
        )
        offset = (validation_features - train_features.mean(0)) / train_features.std(0)
        expected = offset @ solved + train_ranges.mean(0)
        edges = [validation_ranges[:, 0], validation_ranges.sum(1)]
        of_strength.append((np.abs(np.stack([expected[:, 0], expected.sum(1)]) - edges).mean(), expected))
    _, best = min(of_strength, key=lambda candidate: candidate[0])
    np.testing.assert_allclose(validation_features @ weight + bias, best, rtol=1e-10)


def test_the_mask_is_the_weighted_logistic_regression():
    rng = np.random.default_rng(1)
    x = rng.normal(0, [1, 20], (400, 2))
    y = x[:, 0] + 0.05 * x[:, 1] + rng.normal(0, 0.7, 400) > 0.5
    costs = rng.uniform(1, 3, 400)
    weight, bias = range_heads._logistic(torch.from_numpy(x), torch.from_numpy(y), torch.from_numpy(costs))

    def loss(p):
        decay = range_heads.MASK_DECAY * np.sum((p[:2] * x.std(0)) ** 2)
        return np.average(np.logaddexp(0, -np.where(y, 1, -1) * (x @ p[:2] + p[2])), weights=costs) + decay

    best = optimize.minimize(loss, np.zeros(3), tol=1e-12)
    np.testing.assert_allclose([*weight.tolist(), float(bias)], best.x, rtol=1e-3)


def test_the_threshold_is_the_best_one():
    rng = np.random.default_rng(2)
    target = np.where(rng.random((4, 9, 9)) < 0.4, rng.uniform(1600, 1900, (4, 9, 9)), 0)
    logits = np.where(target > 0, 1.0, -1.0) + rng.normal(0, 1.5, target.shape)
    depth = rng.uniform(1600, 1900, target.shape)
    parts = slice(0, 1), slice(1, 4)
    threshold = range_heads._best_threshold(
        sum(range_heads._gains(logits[part], depth[part], target[part]) for part in parts)
    )

    def mae_at(limit):
        return np.abs(np.where(logits >= limit, depth, 0) - target).mean()

    best = min(mae_at(limit) for limit in np.arange(-20, 20, range_heads.LOGIT_STEP))
    assert mae_at(threshold) == pytest.approx(best)


def test_no_mask_where_every_depth_is_worse_than_none():
    wrong, true = np.array([[[9000.0, 9000.0]]]), np.array([[[1800.0, 0.0]]])
    gains = range_heads._gains(np.array([[[1.0, -1.0]]]), wrong, true)
    assert range_heads._best_threshold(gains) > 1.0
