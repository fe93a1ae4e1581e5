"""Phase as input and as a loss: against fringes of known depth, and closed forms."""

import numpy as np
import pytest
import torch
from tiny_network import one_thread  # noqa: F401

from fpp_ml_bench.baselines.networks.model import build
from fpp_ml_bench.baselines.networks.unet import (
    GUIDED_CHANNELS,
    ORDERS,
    PhaseGuide,
    re_projection_loss,
)
from fpp_ml_bench.baselines.phase.geometry import TAU, CalibrationLayer
from fpp_ml_bench.baselines.stability.cases import U32
from fpp_ml_bench.errors import NetworkError
from fpp_ml_bench.optics.named_rigs import paper_rig

SIZE = 224


def fringe_of(depth_mm, mean=0.4, modulation=0.3):
    layer = CalibrationLayer.of(paper_rig(SIZE), "horizontal")
    phase = layer.absolute_phase(np.broadcast_to(depth_mm, (SIZE, SIZE)))
    return torch.from_numpy(mean + modulation * np.cos(phase)).float()[None, None]


@pytest.mark.parametrize("depth_mm", [1650.0, 1800.0, 1950.0])
def test_a_plane_is_one_of_the_candidates(depth_mm):
    maps = PhaseGuide()(fringe_of(depth_mm))[0]
    inner = slice(16, -16), slice(16, -16)  # beyond the window's reach from the border
    cosine, sine, strength, *candidates = (m[inner].double() for m in maps[1:])
    assert maps.shape == (GUIDED_CHANNELS, SIZE, SIZE) and len(candidates) == len(ORDERS)
    error_mm = 600 * torch.stack([(c - (depth_mm - 1500) / 600).abs() for c in candidates]).amin(0)
    # The window leaves exp(-(2 pi 0.5)^2 / 2) = 0.7% of the mean's carrier: 1% of phase here, 2 mm.
    assert error_mm.max() < 4
    assert strength.mean() == pytest.approx(2 * 0.3, rel=0.02)
    assert torch.allclose(cosine**2 + sine**2, torch.ones_like(sine), atol=64 * U32)


def test_darkness_has_no_phase_and_no_nan():
    maps = PhaseGuide()(torch.zeros(2, 1, SIZE, SIZE))
    assert torch.isfinite(maps).all() and (maps[:, 1:4] == 0).all()


def test_only_square_images():
    with pytest.raises(NetworkError, match="square image of the paper's rig, got 64 x 96"):
        build("unet", width=2, guided=1)(torch.rand(1, 1, 64, 96))


def test_re_projection_sees_the_phase_and_not_the_order():
    layer = CalibrationLayer.of(paper_rig(16), "horizontal")
    tensors = layer.tensors(torch.float64)
    true_mm = torch.full((1, 1, 16, 16), 1800.0, dtype=torch.float64)
    true_mm[..., :8] = 0  # background
    phase = layer.gain / (layer.forward * 1.8 + layer.back_m)

    def loss_of(shift_rad, background_mm=0.0):
        moved = torch.from_numpy(layer.depth_of_residual_mm(phase + shift_rad))[None, None]
        prediction = torch.where(true_mm > 0, moved, background_mm).requires_grad_(True)
        loss = re_projection_loss(tensors, prediction, true_mm, 750.0)
        loss.backward()
        assert torch.isfinite(prediction.grad).all() and not prediction.grad[..., :8].any()
        return loss.item()

    assert (
        loss_of(0.0)
        == loss_of(TAU)
        == loss_of(0.0, background_mm=-300.0)
        == pytest.approx(0, abs=1e-12)
    )
    for shift in (0.1, -0.7, np.pi):
        assert loss_of(shift) == pytest.approx(1 - np.cos(shift), rel=1e-9)
    assert re_projection_loss(tensors, true_mm, torch.zeros_like(true_mm), 750.0) == 0
