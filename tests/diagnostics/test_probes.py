"""Probes against closed forms: what they are asked for, how they are fitted, and networks whose
answer is known."""

import numpy as np
import pytest
import torch
from known_networks import oracle, subject_with
from scipy import ndimage
from torch import nn
from torch.nn import functional

from fpp_ml_bench.baselines.diagnostics.grad_cam import fringe_variation
from fpp_ml_bench.baselines.diagnostics.linear import (
    CONTROLS,
    INPUT,
    LINEAR,
    MEAN,
    OBJECT_DEPTH,
    SILHOUETTE,
    SPATIAL,
    ConvolutionProbes,
    LinearProbes,
    NormalEquations,
    apply,
    at_pixels,
    at_size,
    grid_of,
    score,
)
from fpp_ml_bench.baselines.diagnostics.scenes import edge_map, truth
from fpp_ml_bench.baselines.diagnostics.subjects import activations_of
from fpp_ml_bench.baselines.stability.cases import U32
from fpp_ml_bench.coding.phase_shift import wrapped_phase
from fpp_ml_bench.decoding.triangulation import depth_from_coordinate
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DiagnosisError

RNG = np.random.default_rng(7)


# ---- what is asked for


def test_edges_are_scipys_sobel():
    depth = ndimage.gaussian_filter(RNG.normal(size=(20, 30)), 2)
    across, down = (ndimage.sobel(depth, axis, mode="mirror") for axis in (1, 0))
    expected = np.hypot(across, down)
    # Sobel's weights have magnitudes that sum to 8; depth, products, sums and root are rounded to
    # float32 8 times.
    tolerance = 8 * 8 * U32 * np.abs(depth).max() / expected.max()
    assert edge_map(depth) == pytest.approx(expected / expected.max(), abs=tolerance)
    assert not edge_map(np.full((5, 5), 1800.0)).any()


@pytest.mark.parametrize(("period", "side"), [(5.26, 7), (5.0, 5), (1.0, 3)])
def test_fringe_variation_is_the_spread_in_a_window_of_a_period(period, side):
    grey = RNG.integers(0, 256, (40, 50)).astype(np.uint8)
    expected = ndimage.generic_filter(grey.astype(float), np.std, size=side, mode="mirror")
    # Sums are in float64; the result is rounded to float32 once.
    assert fringe_variation(grey, period) == pytest.approx(expected, rel=2 * U32)


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
def test_true_phase_is_the_one_that_eighteen_frames_measure(opened, direction):
    sample = opened.samples("test")[0]
    ground_truth = truth(opened.depth_mm(sample), opened.rig, direction)
    measured = wrapped_phase(opened.frames(sample, opened.sequence.sinusoids(direction)))
    sine, outside = ground_truth["sine"], ground_truth["object"] == 0
    inside = ndimage.binary_erosion(~outside & (measured.modulation > 20), iterations=3)
    assert inside.sum() > 200
    error_rad = np.angle(np.exp(1j * (measured.phase - np.arctan2(sine, ground_truth["cosine"]))))[
        inside
    ]
    assert np.median(np.abs(error_rad)) < 0.02
    assert not sine[outside].any() and not ground_truth["order"][outside].any()


def test_phase_and_order_together_are_the_depth(opened):
    depth_mm = opened.depth_mm(opened.samples("test")[0])
    rig, inside = opened.rig, object_mask(depth_mm)
    ground_truth = truth(depth_mm, rig, "horizontal")
    x, y = rig.camera.rays()
    points = np.stack([x, y, np.ones_like(x)], axis=-1) * rig.standoff_m
    reference = np.floor(rig.project(points)[1] / rig.pitch("horizontal"))
    phase = np.arctan2(ground_truth["sine"], ground_truth["cosine"]) % (2 * np.pi)
    row = (reference + ground_truth["order"] + phase / (2 * np.pi)) * rig.pitch("horizontal")
    decoded_mm = depth_from_coordinate(
        rig.camera.rays(), np.where(inside, row, np.nan), rig, "horizontal"
    )
    # Sine and cosine are rounded to float32: 2 u in phase, and 1 rad is less than half of the
    # depth.
    assert decoded_mm[inside] == pytest.approx(depth_mm[inside], rel=2 * U32)
    with pytest.raises(ValueError, match="zero-size array"):
        truth(np.zeros_like(depth_mm), rig, "horizontal")


# ---- how it is fitted


def ridge_by_numpy(x, y, strength):
    """The same estimate by its definition: standardised features, a bias that is free."""
    mean, spread = x.mean(0), x.std(0)
    z = (x - mean) / spread
    inner = z.T @ z / len(x) + strength * np.eye(x.shape[1])
    weight = np.linalg.solve(inner, z.T @ (y - y.mean(0)) / len(x)) / spread[:, None]
    return np.vstack([weight, y.mean(0) - mean @ weight])


@pytest.mark.parametrize("strength", [0.0, 1e-6, 0.3])
def test_streamed_ridge_is_the_closed_form(strength):
    x = RNG.normal(size=(400, 6)) * [1, 2, 30, 0.1, 5, 1] + [0, 4, 500, 0, 1, 0]
    y = x[:, :2] @ RNG.normal(size=(2, 3)) + RNG.normal(size=(400, 3))
    parts = NormalEquations(6, 3)
    for start in range(0, 400, 37):
        parts.add(torch.from_numpy(x[start : start + 37]), torch.from_numpy(y[start : start + 37]))
    weights = parts.solve(strength)
    assert weights.numpy() == pytest.approx(ridge_by_numpy(x, y, strength), rel=1e-7, abs=1e-9)
    assert parts.target_mean.numpy() == pytest.approx(y.mean(0))


def test_constant_and_copied_channels_do_no_harm():
    x = RNG.normal(size=(200, 1))
    both = np.hstack([x, x, np.full_like(x, 3.0)])
    y = 2 * x + 1
    equations = NormalEquations(3, 1)
    equations.add(torch.from_numpy(both), torch.from_numpy(y))
    assert apply(equations.solve(), torch.from_numpy(both)).numpy() == pytest.approx(y, abs=1e-4)


def test_pixels_of_a_coarse_layer_are_those_of_the_upsampled_one():
    features, size = torch.randn(2, 3, 5, 7), (20, 28)
    pixels = torch.arange(size[0] * size[1]).expand(2, -1)
    expected = functional.interpolate(
        features, size=size, mode="bilinear", align_corners=False
    ).flatten(2)
    # A place in the map is rounded to some u of its width, and neighbours differ by twice the
    # largest value at most.
    tolerance = 8 * U32 * 2 * 7 * float(features.abs().max())
    assert torch.allclose(
        at_pixels(features, pixels, size)[:, :, 0], expected, rtol=0, atol=tolerance
    )
    fine = torch.randn(2, 3, *size)
    assert torch.equal(at_pixels(fine, pixels, size)[:, :, 0], fine.flatten(2))
    # Means of 16 values, added in any order.
    tolerance = 16 * U32 * float(fine.abs().max())
    assert torch.allclose(
        at_size(fine, (5, 7)), functional.avg_pool2d(fine, 4), rtol=0, atol=tolerance
    )
    assert at_size(fine, size).data_ptr() != fine.data_ptr()


def test_activations_are_taken_before_a_later_layer_works_in_place_on_them():
    network = nn.Sequential(nn.Conv2d(1, 1, 1), nn.ReLU(inplace=True))
    network[0].weight.data[:] = -1.0
    image = torch.linspace(-2, 3, 16).view(1, 1, 4, 4)
    expected = network[0](image)
    assert (expected < 0).any()
    layers = {"conv": network[0]}
    activations = activations_of(
        network, layers, image, lambda features: at_size(features, (4, 4)), "known"
    )
    assert torch.equal(activations["conv"], expected)
    with pytest.raises(
        DiagnosisError, match="expected activations"
    ):  # an image without its batch axis: (C, h, w)
        activations_of(network, layers, image[0], lambda features: features, "known")
    assert not network[0]._forward_hooks


def test_score_is_share_of_variance_with_an_interval_that_holds_it():
    errors = [[1.0, 2.0, 3.0, 2.0], [1.0, 2.0, 5.0, 2.0]]
    result = score(errors, [4.0, 4.0, 8.0, 4.0], ["a", "a", "b", "c"])
    assert result["mse"] == pytest.approx(2.25) and result["r2"] == pytest.approx(1 - 2.25 / 5)
    assert result["seeds"] == pytest.approx((1 - 2 / 5, 1 - 2.5 / 5))
    low, high = result["r2_interval"]
    assert low < result["r2"] < high
    half_error = score(
        [[2.0, 4.0, 8.0]], [4.0, 8.0, 16.0], ["a", "b", "c"]
    )  # large objects, large errors: half either way
    assert half_error["r2_interval"] == pytest.approx((0.5, 0.5))
    assert score([[0.0, 0.0]], [1.0, 1.0], ["a", "b"])["r2"] == 1
    assert score([[0.0, 0.0]], [1.0, 1.0], ["a", "a"])["r2_interval"] is None
    with pytest.raises(ValueError, match="nothing to explain"):
        score([[0.0]], [0.0], ["a"])


# ---- four convolutions


def test_standard_is_mean_and_spread_of_each_channel():
    batches = [torch.randn(n, 3) * torch.tensor([1.0, 10.0, 0.0]) + 2 for n in (40, 60)]
    equations = NormalEquations(3, 0)
    for batch in batches:
        equations.add(batch, torch.zeros(len(batch), 0))
    mean, factor = equations.standard(1e-6)
    flat = torch.cat(batches).double()
    # Sums are in float64, of squares that cancel by the square of mean over spread at most.
    assert torch.allclose(mean, flat.mean(0), rtol=1e-12, atol=0)
    assert torch.allclose(1 / factor[:2], flat.std(0, correction=0)[:2], rtol=1e-12, atol=0)
    assert factor[2] == 0  # a constant channel says nothing


@pytest.mark.long
def test_a_four_convolution_probe_starts_at_the_mean_and_learns_what_is_there():
    torch.manual_seed(0)

    def batch():
        features = {
            ("trained", 0, "a"): torch.randn(8, 3, 12, 12),
            ("untrained", 0, "b"): torch.randn(8, 3, 12, 12),
        }
        bumps = features["trained", 0, "a"][:, :1].abs()
        edges = functional.avg_pool2d(bumps, 3, 1, 1, count_include_pad=False)
        return features, {
            "image": torch.ones_like(bumps),
            "object": torch.ones_like(bumps),
            "edges": edges,
        }

    features, target = batch()
    probes = ConvolutionProbes(None, None, {"edges": SPATIAL["edges"]}, None, 2, 90)
    probes.observe(features, target)
    probes.start(1)
    here, other = ("trained", 0, "a"), ("untrained", 0, "b")
    assert set(probes.probes) == {(here, "edges", 0), (here, "edges", 1), (other, "edges", 0)}
    reference = (
        (target["edges"].double() - target["edges"].double().mean()).square().mean((1, 2, 3))
    )
    found = probes.errors_of_batch(features, target)
    assert set(found) == {*probes.probes, (MEAN, "edges", 0)}
    for errors in found.values():
        # Each difference is rounded to float32 once, which its square doubles.
        assert errors == pytest.approx(reference.tolist(), rel=4 * U32)
    for _ in range(90):
        probes.step(*batch())
    remaining = {
        key: np.mean(moment) / float(reference.mean())
        for key, moment in probes.errors_of_batch(features, target).items()
    }
    assert remaining[here, "edges", 0] < 0.7 and remaining[here, "edges", 1] < 0.7
    assert remaining[other, "edges", 0] > 0.9


# ---- networks whose answer is known


def errors_of(probes, opened, step):
    train, validation = opened.samples("train")[::step], opened.samples("validation")
    return probes.errors({("trained", 0): probes.subject.network}, train, validation)


def linear_r2(subject, opened):
    errors = errors_of(
        LinearProbes(subject, opened, LINEAR, lambda count, activity: None), opened, 2
    )
    return {
        (layer, target): 1 - np.mean(sample_errors) / np.mean(errors[MEAN, target, 0])
        for ((_, _, layer), target, _), sample_errors in errors.items()
    }


def spatial_errors(subject, opened, epochs):
    probes = ConvolutionProbes(subject, opened, SPATIAL, lambda count, activity: None, 1, epochs)
    return errors_of(probes, opened, 3)


@pytest.mark.parametrize("target", LINEAR)
def test_what_a_layer_holds_is_read_from_it(opened, target):
    """A network that outputs the Sobel map is a pure edge reader, one that holds sine and cosine
    reads the phase."""
    r2 = linear_r2(oracle(opened, LINEAR[target].maps), opened)
    assert r2["out", target] > 0.999
    for other_target in {"edges", "phase"} - {target}:
        assert r2["out", other_target] < 0.5


def test_the_layer_of_an_identity_is_the_raw_input(opened):
    class Same(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.out = nn.Identity()

        def forward(self, fringe):
            return self.out(fringe)

    r2 = linear_r2(subject_with(Same(), opened.size), opened)
    for target in LINEAR:
        assert r2["out", target] == r2[INPUT, target]
    # One grey level holds the cosine, up to brightness, and nothing of the sine: half of the phase
    # at most.
    assert 0.2 < r2[INPUT, "phase"] < 0.5


@pytest.mark.long
def test_spatial_probes_of_an_edge_reader_read_edges(opened):
    subject = oracle(opened, ("edges",))
    errors = spatial_errors(subject, opened, 25)
    remaining = {
        key: np.mean(values) / np.mean(errors[MEAN, key[1], 0]) for key, values in errors.items()
    }
    trained, raw = (
        remaining[("trained", 0, "out"), "edges", 0],
        remaining[(CONTROLS, 0, INPUT), "edges", 0],
    )
    assert trained < 0.25 and trained < raw


@pytest.mark.long
def test_a_layer_that_holds_the_mask_alone_is_the_silhouette_control(opened):
    subject = oracle(opened, ("object",))
    r2 = linear_r2(subject, opened)
    for target in LINEAR:
        assert r2["out", target] == pytest.approx(r2[SILHOUETTE, target], abs=1e-12)
    assert r2[SILHOUETTE, "depth"] > 0.5  # of the whole image's depth: what a silhouette says
    for target in set(LINEAR) - {"edges", "depth"}:
        assert r2[SILHOUETTE, target] == 0  # and of the depth within it nothing
    errors = spatial_errors(subject, opened, 2)
    for name in SPATIAL:
        assert errors[("trained", 0, "out"), name, 0] == pytest.approx(
            errors[(CONTROLS, 0, SILHOUETTE), name, 0]
        )
        assert len(errors[MEAN, name, 0]) == len(opened.samples("validation"))


def test_depth_on_the_object_is_compared_there_and_with_the_mean_there(opened):
    errors = spatial_errors(oracle(opened, ("depth",)), opened, 1)
    side = grid_of(opened.size)

    def within(name):
        depth_mm = opened.depth_mm(name)
        full = (
            at_size(
                torch.from_numpy(object_mask(depth_mm)[None, None].astype(np.float32)), side
            ).numpy()
            == 1
        )
        depth = truth(depth_mm, opened.rig, "horizontal")["depth"]
        return at_size(torch.from_numpy(depth[None, None]), side).numpy()[full].astype(float)

    mean = np.concatenate([within(name) for name in opened.samples("train")[::3]]).mean()
    expected = [np.mean((within(name) - mean) ** 2) for name in opened.samples("validation")]
    assert errors[MEAN, OBJECT_DEPTH, 0] == pytest.approx(expected)
