"""A trained network in use: what goes in, what comes out, and what is refused."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_network import SMALL, config_of, rounding_error, tiny_network

from fpp_ml_bench import baselines
from fpp_ml_bench.baselines.networks.model import NETWORKS, load
from fpp_ml_bench.baselines.training.weights import save_weights
from fpp_ml_bench.errors import PredictionError, WeightsError

SIZE = (32, 48)
HALF_PRECISION = 0.02
"""Change of this network's output, which goes up to 6, for an input rounded to float16: 0.016 was
measured. The float32 rounding of another processor adds less than 0.001."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One weights file for each normalisation, all of one network."""
    path, network = tmp_path_factory.mktemp("weights"), tiny_network()
    for normalisation in ("raw", "global", "individual"):
        config = config_of(network, name=f"unet-{normalisation}", normalisation=normalisation)
        save_weights(path / f"{normalisation}.safetensors", network, config)
    return path


@pytest.fixture
def fringe():
    return np.random.default_rng(0).integers(0, 256, SIZE, dtype=np.uint8)


def test_prediction_is_the_network_on_grey_levels_over_255(folder, fringe):
    network = tiny_network()
    with torch.no_grad():
        expected = network(torch.from_numpy(fringe / np.float32(255))[None, None])[0, 0].numpy()
    tolerance = rounding_error(network, expected)
    for normalisation, unit in (("raw", 1.0), ("global", 1000.0)):
        depth = load(folder / f"{normalisation}.safetensors").predict(fringe)
        assert depth.dtype == np.float32 and depth.shape == SIZE
        np.testing.assert_allclose(depth, unit * expected, rtol=0, atol=unit * tolerance)
    values = load(folder / "individual.safetensors").predict(fringe)
    assert values.dtype == np.float32 and values.shape == SIZE
    np.testing.assert_allclose(values, expected, rtol=0, atol=tolerance)
    assert expected.std() > 100 * tolerance  # else the above compares nothing


def test_a_fringe_in_any_form_is_the_same_fringe(folder, fringe):
    model = load(folder / "raw.safetensors")
    depth = model.predict(fringe)
    rounding = rounding_error(model.network, depth)
    for dtype, tolerance in (
        (np.float32, rounding),
        (np.float64, rounding),
        (np.float16, HALF_PRECISION),
    ):
        np.testing.assert_allclose(
            model.predict((fringe / 255).astype(dtype)), depth, rtol=0, atol=tolerance
        )
    wide = np.zeros((SIZE[0], 2 * SIZE[1]), np.uint8)
    wide[:, ::2] = fringe
    wide.flags.writeable = False
    np.testing.assert_array_equal(model.predict(wide[:, ::2]), depth)
    together = model.predict_batch([fringe, fringe[::-1], fringe])
    np.testing.assert_allclose(
        together, [depth, model.predict(fringe[::-1]), depth], rtol=0, atol=rounding
    )


def test_what_is_no_fringe_of_this_model(folder, fringe):
    model = load(folder / "raw.safetensors")
    nan = (fringe / 255).astype(np.float32)
    nan[3, 5] = np.nan
    for wrong, words in (
        (
            fringe[:16],
            r"of 32x48 px \(H x W\), the size unet-raw was trained at, got 16x48.*fringe period",
        ),
        (fringe.T, "got 48x32"),
        (fringe[..., None], r"one fringe image \(H, W\), got shape \(32, 48, 1\)"),
        (fringe.astype(np.uint16), "got uint16"),
        (fringe > 7, "got bool"),
        (fringe.astype(np.float32), r"within \[0, 1\], got values from 0 to 255"),
        (fringe / 255 - 0.1, "got values from -0.1"),
        (nan, "got values from nan"),
    ):
        with pytest.raises(PredictionError, match=words):
            model.predict(wrong)
    with pytest.raises(PredictionError, match="got none"):
        model.predict_batch([])


def test_an_output_that_is_no_number(tmp_path, fringe):
    network = tiny_network()
    with torch.no_grad():
        network.head.weight.fill_(3e38)
    path = tmp_path / "sick.safetensors"
    save_weights(path, network, config_of(network, normalisation="raw"))  # every weight is finite
    with pytest.raises(
        PredictionError, match=r"unet-individual.*gave .* of 1536 values that are NaN or infinite"
    ):
        load(path).predict(fringe)


@pytest.mark.long
@pytest.mark.parametrize("name", NETWORKS)
def test_every_network_comes_back_as_it_was(tmp_path, name):
    network, size = tiny_network(name, **SMALL[name]), (64, 64)
    config = config_of(network, image_size=size, normalisation="raw")
    save_weights(tmp_path / "net.safetensors", network, config)
    model = load(tmp_path / "net.safetensors", "cpu")
    image = np.random.default_rng(1).random(size, dtype=np.float32)
    with torch.no_grad():
        expected = network.to(memory_format=torch.channels_last)(
            torch.from_numpy(image)[None, None]
        )[0, 0].numpy()
    np.testing.assert_array_equal(model.predict(image), expected)
    assert model.parameters == sum(p.numel() for p in network.parameters())
    assert not model.network.training and not any(
        p.requires_grad for p in model.network.parameters()
    )


def test_what_can_not_be_loaded(folder):
    assert baselines.load is load and baselines.build("unet", width=1).options["width"] == 1
    with pytest.raises(WeightsError, match="come with this package; there are hformer"):
        baselines.load("vit")
    with pytest.raises(WeightsError, match="device 'abacus' can't be used here"):
        baselines.load(folder / "raw.safetensors", device="abacus")
    with pytest.raises(AttributeError, match="attribute 'train'"):
        baselines.train  # noqa: B018


@pytest.mark.processes
@pytest.mark.parametrize("module", ["baselines.method", "baselines.networks"])
def test_importing_does_not_import_torch(module):
    code = f"import sys, fpp_ml_bench.{module}; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
