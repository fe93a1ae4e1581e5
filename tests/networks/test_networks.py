"""The networks: the paper's parameter counts, shapes, refusals, options, probe layers."""

import pytest
import torch
from tiny_network import SMALL, one_thread, rounding_error  # noqa: F401
from torch import nn

from fpp_ml_bench.baselines.networks.model import NETWORKS, build, discriminator
from fpp_ml_bench.errors import NetworkError

SIZE = 64

# The paper's table of architectures and the benchmark's published counts; TransUNet is printed as
# 116.2 M there.
PARAMETERS = {
    "unet": 31_036_481,
    "transunet": 116_162_881,
    "resunet": 88_941_841,
    "hformer": 4_655_993,
    "pix2pix": 182_430_721,
    # Not published. 4x4 convolutions with biases between 1, 64, 128, 256, 512, 512 and 512
    # channels, back from twice as many (from 512 at the bottom), and a 7x7 head of 49 * 64 weights
    # with a bias; instance normalisation has no weights here.
    "pix2pix_unet": 29_367_809,
}
STRIDES = {
    "unet": 16,
    "transunet": 16,
    "resunet": 8,
    "hformer": 32,
    "pix2pix": 16,
    "pix2pix_unet": 8,
}


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def parameter_count(module):
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.long
@pytest.mark.parametrize("name", NETWORKS)
def test_paper_parameter_counts(name):
    with torch.device("meta"):
        assert parameter_count(build(name)) == PARAMETERS[name]


def test_discriminator_parameter_count():
    with torch.device("meta"):
        assert parameter_count(discriminator()) == 5_527_426


@pytest.mark.long
@pytest.mark.parametrize("name", NETWORKS)
def test_full_width_runs_at_960_px_on_the_meta_device(name):
    with torch.device("meta"):
        network = build(name)
        shapes = _probed(network, torch.empty(1, 1, 960, 960))
    assert list(shapes) == list(network.probe_layers)  # forward order
    paper = {"resunet": (960, 120), "hformer": (256, 30), "pix2pix_unet": (512, 15)}
    channels, side = paper.get(name, (1024, 60))
    assert shapes["bottleneck"] == (1, channels, side, side)
    assert [*shapes.values()][-1] == (1, {"resunet": 120, "hformer": 8}.get(name, 64), 960, 960)


@pytest.mark.parametrize("name", NETWORKS)
def test_width_scales_every_layer(name):
    with torch.device("meta"):
        narrow, wide = (
            parameter_count(build(name, **{**SMALL[name], "width": w * int(SMALL[name]["width"])}))
            for w in (4, 8)
        )
    assert 3.5 < wide / narrow < 4.1  # products of two widths make up nearly all parameters


def _probed(network, x) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    hooks = [
        layer.register_forward_hook(
            lambda _m, _i, out, key=key: shapes.__setitem__(key, tuple(out.shape))
        )
        for key, layer in network.probe_layers.items()
    ]
    network(x)
    for hook in hooks:
        hook.remove()
    return shapes


@pytest.mark.parametrize("name", NETWORKS)
def test_sizes_that_the_strides_do_not_allow(name):
    network = build(name, **SMALL[name])
    assert network.stride == STRIDES[name]
    with pytest.raises(NetworkError, match=f"{SIZE}x{SIZE + 4}"):
        network(torch.rand(1, 1, SIZE, SIZE + 4))
    with pytest.raises(NetworkError, match=f"{network.stride}x{network.stride}"):
        network(torch.rand(1, 1, network.stride, network.stride))


def test_a_refused_size_names_the_nearest():
    network = build("unet", width=2)
    with pytest.raises(
        NetworkError,
        match=r"multiples of 16, at least 32 px; it was given 100x17.*\(96 or 112\)x32",
    ):
        network(torch.rand(1, 1, 100, 17))


def test_transunet_names_the_size_it_was_built_for():
    with pytest.raises(NetworkError, match=r"64x64 px.*given 96x96"):
        build("transunet", **SMALL["transunet"])(torch.rand(1, 1, 96, 96))


@pytest.mark.parametrize(
    "fringe",
    [
        torch.zeros(1, 2, SIZE, SIZE),
        torch.zeros(1, SIZE, SIZE),
        torch.zeros(1, 1, SIZE, SIZE, dtype=torch.uint8),
    ],
    ids=["channels", "rank", "integer"],
)
def test_input_that_is_no_fringe_image(fringe):
    with pytest.raises(NetworkError, match="unet"):
        build("unet", width=2)(fringe)


@pytest.mark.parametrize(
    ("name", "options", "match"),
    [
        ("vnet", {}, "unknown network 'vnet'; there are unet, transunet"),
        (
            "unet",
            {"widht": 8},
            "'unet' has no option 'widht'; there are: width .default 64.*dropout",
        ),
        ("unet", {"width": 0}, "width must be a whole number, 1 to 4096; it was 0"),
        ("unet", {"width": 8.5}, "width"),
        ("unet", {"width": True}, "width"),
        ("unet", {"dropout": 1.0}, r"dropout must be a number in \[0, 1\)"),
        ("transunet", {"patch": 7}, "patch must divide map_size"),
        ("transunet", {"map_size": 1}, "map_size"),
        ("hformer", {"width": 6}, "multiple of 4"),
        ("hformer", {"drop_path": -0.1}, "drop_path"),
        ("pix2pix", {"dropout": 0.1}, "no option"),
        ("pix2pix_unet", {"levels": 1}, "levels must be a whole number, 2 to 4096"),
    ],
)
def test_refused_names_and_options(name, options, match):
    with pytest.raises(NetworkError, match=match):
        build(name, **options)


def test_discriminator_features():
    network = discriminator(width=4)
    scales = network(torch.rand(2, 2, SIZE, SIZE))
    assert [len(maps) for maps in scales] == [5, 5]
    assert scales[0][0].shape == (2, 4, 33, 33) and scales[1][0].shape == (2, 4, 17, 17)
    assert scales[0][-1].shape[:2] == (2, 1)
    with pytest.raises(NetworkError, match="no option"):
        discriminator(depth=3)
    with pytest.raises(NetworkError, match="width"):
        discriminator(width=-1)


def test_no_batch_or_sample_leaks_into_another():
    """Networks with instance normalisation treat samples one by one, so a batch equals its
    samples."""
    x = torch.rand(3, 1, SIZE, SIZE)
    for name in ("unet", "transunet", "pix2pix", "pix2pix_unet"):
        network = build(name, **SMALL[name])
        with torch.no_grad():
            together, alone = network(x)[1:2], network(x[1:2])
        torch.testing.assert_close(together, alone, rtol=0, atol=rounding_error(network, alone))


@pytest.mark.parametrize("name", ["pix2pix", "pix2pix_unet"])
def test_pix2pix_stays_between_zero_and_one(name):
    network = build(name, **SMALL[name])
    for parameter in network.parameters():
        nn.init.normal_(parameter)
    depth = network(torch.rand(1, 1, SIZE, SIZE))
    assert depth.min() >= 0.0 and depth.max() <= 1.0 and depth.std() > 0.0
