"""Grad-CAM against gradients by hand, and the correlations that are made of it."""

from itertools import pairwise, product

import numpy as np
import pytest
import torch
from known_networks import oracle, subject_with
from torch import nn
from torch.nn import functional

from fpp_ml_bench.baselines.diagnostics.flat_plane import rectangle
from fpp_ml_bench.baselines.diagnostics.grad_cam import (
    EDGES,
    FRINGES,
    OBJECT,
    OWN,
    PLANES,
    RANDOM,
    GradCam,
    cam_layers,
    correlation,
    heatmaps,
    means_of,
    measure,
    shown,
)
from fpp_ml_bench.baselines.diagnostics.probe import silent
from fpp_ml_bench.baselines.diagnostics.scenes import edge_map
from fpp_ml_bench.baselines.diagnostics.subjects import randomised
from fpp_ml_bench.baselines.stability.cases import U32
from fpp_ml_bench.errors import DiagnosisError


def convolutions(*channels, kernel=1):
    layers = (nn.Conv2d(a, b, kernel, padding=kernel // 2) for a, b in pairwise(channels))
    return nn.Sequential(*layers)


@pytest.mark.parametrize("sign", [1, -1])  # each shows what the ReLU hides of the other
def test_a_linear_network_has_the_heatmap_that_pen_and_paper_give(sign):
    """Output mean = sum_c v_c mean(A_c) + const, so each channel weighs v_c / (H W), whatever the
    image."""
    torch.manual_seed(0)
    network = convolutions(1, 3, 1)
    v = sign * torch.tensor([2.0, -1.0, 0.5])
    network[1].weight.data[:] = v.view(1, 3, 1, 1)
    network.requires_grad_(False)
    fringe = torch.rand(2, 1, 6, 8)
    heatmap = torch.from_numpy(heatmaps(network, {"first": network[0]}, fringe)["first"])
    weighted = v.view(3, 1, 1) * network[0](fringe) / (6 * 8)
    # A channel's weight is a sum over 6 x 8 pixels; fewer than 64 roundings of the magnitudes in
    # all.
    tolerance = 64 * U32 * float(weighted.abs().sum(1).max())
    assert torch.allclose(heatmap, weighted.sum(1).clamp(min=0), rtol=0, atol=tolerance)


def test_a_bent_network_at_half_the_size_has_that_of_its_own_gradients():
    torch.manual_seed(1)
    first, second = nn.Conv2d(1, 4, 3, stride=2, padding=1), nn.ConvTranspose2d(4, 1, 2, stride=2)
    network = nn.Sequential(first, nn.ReLU(), second, nn.Sigmoid()).requires_grad_(False)
    fringe = torch.rand(3, 1, 8, 12)
    for sample in range(3):
        activations = first(fringe[sample : sample + 1]).requires_grad_(True)
        (gradient,) = torch.autograd.grad(second(activations.relu()).sigmoid().mean(), activations)
        heat = (gradient.mean((2, 3), keepdim=True) * activations).sum(1, keepdim=True)
        magnitudes = (gradient.abs().mean((2, 3), keepdim=True) * activations.abs()).sum(1).detach()
        expected = functional.interpolate(heat, size=(8, 12), mode="bilinear")[0, 0].detach()
        assert (expected > 0).any()
        heatmap = torch.from_numpy(heatmaps(network, {"first": first}, fringe)["first"][sample])
        # Sums over 24 gradients, 9 products, 4 channels and 4 neighbours: fewer than 64 roundings
        # of the magnitudes.
        assert torch.allclose(
            heatmap, expected.clamp(min=0), rtol=0, atol=64 * U32 * float(magnitudes.max())
        )


def test_layers_that_have_no_heatmap_are_refused():
    flat = nn.Sequential(nn.Flatten(), nn.Linear(16, 16), nn.Unflatten(1, (1, 4, 4)))
    with pytest.raises(DiagnosisError, match="layer '1'"):
        heatmaps(flat, {"1": flat[1]}, torch.rand(2, 1, 4, 4))
    network = convolutions(1, 2, 1)
    with pytest.raises(DiagnosisError, match="leave it out"):
        heatmaps(network, {"other": nn.Conv2d(1, 1, 1)}, torch.rand(2, 1, 4, 4))


def test_correlation_is_pearsons():
    a, b = np.random.default_rng(0).normal(size=(2, 9, 7))
    assert correlation(a, b) == pytest.approx(np.corrcoef(a.ravel(), b.ravel())[0, 1], abs=1e-12)
    assert correlation(a * 1e-9, 5 - 3e6 * a) == pytest.approx(-1)
    assert correlation(a, np.full((9, 7), 0.3)) is None and correlation(np.zeros((9, 7)), b) is None


def test_means_leave_out_maps_that_are_constant_and_average_layers_as_the_paper_does():
    correlations = {
        (target, layer): {0: [0.1] * 3} for layer in "ab" for target in (EDGES, FRINGES, OBJECT)
    }
    correlations[EDGES, "a"] = {0: [0.4, 0.2, None]}
    for layer, target in product("ab", (EDGES, FRINGES, OBJECT, OWN)):
        by_network = {
            number: [r if target == OWN else None] * 3 for number, r in ((1, 0.2), (2, 0.4))
        }
        correlations[RANDOM + target, layer] = by_network
    means = means_of(correlations, ("a", "b"), ["x", "x", "y"])
    first = means["layers"]["a"]
    assert first[EDGES]["r"] == pytest.approx(0.3) and first[EDGES]["samples"] == 2
    assert first[RANDOM + OWN]["r"] == pytest.approx(0.3) and first[RANDOM + EDGES]["r"] is None
    assert (
        means["average"][EDGES]["r"] == pytest.approx(0.2)
        and means["average"][EDGES]["samples"] == 3
    )
    assert means["average"]["ratio"] == pytest.approx(2)
    for missing in (0.0, None):
        correlations[FRINGES, "a"] = {0: [missing] * 3}
        assert means_of(correlations, ("a", "b"), ["x", "x", "y"])["layers"]["a"]["ratio"] is None


@pytest.mark.parametrize(("fields", "wins"), [(("edges",), EDGES), (("object",), FRINGES)])
def test_a_reader_of_edges_looks_at_edges_and_one_of_the_lit_object_at_fringes(
    opened, fields, wins
):
    """A network that outputs the Sobel map correlates with it by 1, at the layer where it is."""
    subject = oracle(opened, fields)
    correlations = measure(subject, opened, opened.samples("test")[:3], 1, silent)
    layer = correlations["layers"]["out"]
    edges, fringes = layer[EDGES]["r"], layer[FRINGES]["r"]
    assert (edges > fringes) == (wins == EDGES)
    if wins == EDGES:
        assert edges == pytest.approx(1, abs=1e-6)
        assert layer["ratio"] > 1.5
    # The stand-in for random weights is the network itself: the sanity check must say that nothing
    # changed.
    assert layer[RANDOM + OWN]["r"] == pytest.approx(1, abs=1e-6)
    if wins == EDGES:
        assert correlations["edges_with_fringes"]["r"] == pytest.approx(fringes)


class Painted(nn.Module):
    """A network that outputs the same image, whatever it is shown."""

    def __init__(self, image) -> None:
        super().__init__()
        self.out, self.image = nn.Identity(), torch.from_numpy(image.astype(np.float32))

    def forward(self, fringe: torch.Tensor) -> torch.Tensor:
        return self.out(self.image + 0 * fringe)


@pytest.mark.parametrize(("plane", "side"), PLANES.items())
def test_heatmaps_of_a_plane_are_compared_with_the_plane(opened, plane, side):
    """Heat on the plane, on its edges, everywhere: the last has no correlation, which is unknown
    and not NaN."""
    on_it = rectangle(opened.size, side)
    edges = edge_map(np.where(on_it, 1800.0, 0.0))
    for painted, target in ((on_it, OBJECT), (edges, EDGES), (np.ones(opened.size), None)):
        subject = subject_with(Painted(painted), opened.size)
        fringe, maps = shown(subject, opened, plane)
        (heat,) = heatmaps(subject.network, {"out": subject.network.out}, fringe)["out"]
        assert (
            fringe.shape == (1, 1, *opened.size)
            and heat.shape == opened.size
            and np.isfinite(heat).all()
        )
        assert (maps[OBJECT] == on_it).all()
        measured = measure(subject, opened, [plane], 1, silent)["layers"]["out"]
        for column in (
            EDGES,
            FRINGES,
            OBJECT,
        ):  # the stand-in for random weights is the network itself
            assert measured[RANDOM + column] == measured[column]
        assert target is None or measured[target]["r"] == pytest.approx(1, abs=1e-6)
        assert target is not None or {
            measured[column]["r"] for column in (EDGES, FRINGES, OBJECT)
        } == {None}


def test_random_weights_come_from_the_seed_alone():
    torch.manual_seed(5)
    state = torch.get_rng_state()
    random_networks = [randomised(convolutions(1, 3, 1, kernel=3), seed) for seed in (1, 1, 2)]
    weights = [network[0].weight for network in random_networks]
    assert torch.equal(weights[0], weights[1]) and not torch.equal(weights[0], weights[2])
    assert not torch.equal(torch.get_rng_state(), state)  # making the networks drew from it ...
    torch.set_rng_state(state)
    randomised(random_networks[0], 1)
    assert torch.equal(torch.get_rng_state(), state)  # ... randomising them did not

    class Bare(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.weight = nn.Parameter(torch.arange(30.0))

    shuffled = randomised(Bare(), 0).weight
    assert torch.equal(shuffled.sort().values, torch.arange(30.0)) and not torch.equal(
        shuffled, torch.arange(30.0)
    )


def test_the_papers_six_layers_are_taken_where_there_are_nine(opened):
    subject = oracle(opened, ("edges",))
    assert cam_layers(subject) == ("out",)
    names = ("enc1", "enc2", "enc3", "enc4", "bottleneck", "dec4", "dec3", "dec2", "dec1")
    object.__setattr__(subject, "layer_names", names)
    assert cam_layers(subject) == ("enc3", "enc4", "bottleneck", "dec4", "dec2", "dec1")
    object.__setattr__(subject, "network", None)
    assert "no gradient" in GradCam().applies_to(subject)
