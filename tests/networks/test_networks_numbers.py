"""The networks' blocks against closed forms, and gradients where a normalisation has nothing to
divide by."""

import pytest
import torch
from tiny_network import SMALL, one_thread  # noqa: F401
from torch import Tensor, nn

from fpp_ml_bench.baselines.networks.base import (
    Attention,
    DropPath,
    InstanceNorm,
    trains_channels_last,
)
from fpp_ml_bench.baselines.networks.model import NETWORKS, build


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize(("value", "bfloat16"), [(0.5, False), (0.0, True)])
def test_gradients_of_a_constant_image_are_finite(name, value, bfloat16):
    network = build(name, **SMALL[name])
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=bfloat16):
        depth = network(torch.full((1, 1, 64, 64), value))
    assert depth.isfinite().all()
    (depth.float() - 0.3).abs().mean().backward()
    for parameter in network.parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all()


@pytest.mark.long
@pytest.mark.parametrize("name", NETWORKS)
def test_every_parameter_learns(name):
    network = build(name, **SMALL[name])
    network(torch.rand(2, 1, 64, 64)).square().mean().backward()
    still = [key for key, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    assert still == []


@pytest.mark.parametrize("name", NETWORKS)
def test_training_in_channels_last_has_the_gradients_of_float64(name):
    network = build(
        name, **SMALL[name]
    ).eval()  # without DropPath; normalisation over the batch by its first values
    assert trains_channels_last(network) == (name != "resunet")  # 1 x 1 convolutions with a stride
    fringe, target = torch.rand(2, 1, 64, 64), torch.rand(2, 1, 64, 64)

    def gradient(kind: torch.dtype) -> Tensor:
        loss = (network.to(kind)(fringe.to(kind)) - target.to(kind)).square().mean()
        parts = torch.autograd.grad(loss, list(network.parameters()))
        return torch.cat([part.double().flatten() for part in parts])

    exact = gradient(torch.float64)
    if trains_channels_last(network):
        network.to(memory_format=torch.channels_last)
    # A ReLU whose input is a rounding from 0 may fall on the other side: single weights may be off
    # by more.
    assert (gradient(torch.float32) - exact).norm() < 1e-2 * exact.norm()


@pytest.mark.long
@pytest.mark.parametrize(
    ("affine", "layout"), [(False, torch.channels_last), (True, torch.contiguous_format)]
)
def test_instance_norm_is_torchs(affine, layout):
    ours, torchs = (
        InstanceNorm(3, affine=affine).double(),
        nn.InstanceNorm2d(3, affine=affine).double(),
    )
    for parameter in ours.parameters():
        nn.init.normal_(parameter)
    torchs.load_state_dict(ours.state_dict())
    x = (
        (5.0 + torch.randn(2, 3, 6, 4, dtype=torch.float64))
        .to(memory_format=layout)
        .requires_grad_()
    )
    torch.testing.assert_close(ours(x), torchs(x), rtol=1e-12, atol=1e-12)
    weight = torch.randn_like(x)
    our_gradients = torch.autograd.grad((ours(x) * weight).sum(), [x, *ours.parameters()])
    torch_gradients = torch.autograd.grad((torchs(x) * weight).sum(), [x, *torchs.parameters()])
    torch.testing.assert_close(our_gradients, torch_gradients, rtol=1e-10, atol=1e-10)
    assert torch.autograd.gradcheck(ours, (x,))


def test_attention_is_a_plain_softmax():
    attention = Attention(12, heads=3).double()
    tokens = torch.randn(2, 7, 12, dtype=torch.float64)
    q, k, v = attention.qkv(tokens).chunk(3, dim=-1)
    mixed = []
    for head in range(3):
        part = slice(4 * head, 4 * head + 4)
        scores = (
            q[..., part] @ k[..., part].transpose(1, 2) / 2.0
        )  # square root of the head's 4 channels
        mixed.append(torch.softmax(scores, dim=-1) @ v[..., part])
    torch.testing.assert_close(
        attention(tokens), attention.out(torch.cat(mixed, dim=-1)), rtol=1e-10, atol=1e-10
    )


def test_drop_path_keeps_the_mean_and_sleeps_outside_training():
    drop = DropPath(0.4)
    x = torch.ones(20_000, 1, 1)
    dropped = drop(x)
    assert dropped.unique().tolist() == pytest.approx([0.0, 1 / 0.6])
    assert abs(dropped.mean().item() - 1.0) < 0.03
    assert torch.equal(drop.eval()(x), x)


def test_first_weights_have_the_spread_they_should():
    unet = build("unet", width=16)
    weight = unet.encoder[1][0].weight  # 32 x 16 x 3 x 3: fan out 32 x 9
    assert weight.std().item() == pytest.approx((2 / (32 * 9)) ** 0.5, rel=0.05)
    pix2pix = build("pix2pix", width=8)
    assert pix2pix.generator.down[3][0].weight.std().item() == pytest.approx(0.02, rel=0.02)
    assert not pix2pix.generator.stem[0].bias.any()


@pytest.mark.parametrize("name", ["unet", "hformer", "pix2pix"])
def test_under_bfloat16_the_last_layer_is_in_float32(name):
    """bfloat16 has 8 significant bits: at 1.8 m its steps are 8 mm."""
    torch.manual_seed(0)
    network = build(name, width=4).eval()
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
        answer = network(torch.rand(1, 1, 64, 64))
    assert answer.dtype == torch.float32
    assert not torch.equal(answer, answer.bfloat16().float())
