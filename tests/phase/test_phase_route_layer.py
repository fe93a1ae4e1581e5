"""The calibration layer against triangulation, against 50-digit arithmetic, and against itself in
torch."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from flat_planes import turned

from fpp_ml_bench.baselines.phase.geometry import TAU, CalibrationLayer
from fpp_ml_bench.decoding.triangulation import depth_from_coordinate
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig import Rig

SIZE = 96


PAPER = paper_rig(SIZE)
STRAIGHT = replace(
    turned(PAPER, 4.0, (0.2, -0.13, 0.05)),
    pitch_horizontal_px=24.0,
    pitch_vertical_px=30.0,
    working_range_mm=(1000.0, 1600.0),
    standoff_m=1.3,
    background_m=2.4,
)
"""Another baseline, pitch and range; the projector turned by four degrees, ahead of the camera."""
LENS = replace(PAPER.projector, distortion=(-0.12, 0.05, 0.001, -0.0007, 0.0))
RIGS = {"paper": PAPER, "straight": STRAIGHT, "lens": replace(STRAIGHT, projector=LENS)}


@pytest.fixture(params=RIGS)
def rig(request: pytest.FixtureRequest) -> Rig:
    return RIGS[request.param]


def depths(rig: Rig) -> np.ndarray:
    return np.random.default_rng(3).uniform(*rig.working_range_mm, (SIZE, SIZE))


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
def test_layer_is_triangulation(rig: Rig, direction: str) -> None:
    layer, z = CalibrationLayer.of(rig, direction), depths(rig)
    x, y = rig.camera.rays()
    coordinate = rig.project(np.stack([x, y, np.ones_like(x)], -1) * (z / 1000)[..., None])[
        direction == "horizontal"
    ]
    absolute = TAU * coordinate / rig.pitch(direction)
    assert np.abs(layer.absolute_phase(z) - absolute).max() < 1e-9
    order = np.floor(absolute / TAU + 0.5)
    depth_mm = layer.depth_mm(absolute - TAU * order, order)
    assert np.abs(depth_mm - z).max() < 1e-6
    assert np.abs(depth_mm - depth_from_coordinate((x, y), coordinate, rig, direction)).max() < 1e-6


def test_torch_equals_numpy_and_has_gradients(rig: Rig) -> None:
    layer = CalibrationLayer.of(rig, "horizontal")
    tensors = layer.tensors(torch.float64)
    absolute = layer.absolute_phase(depths(rig))
    order = np.floor(absolute / TAU)
    phase = torch.tensor(absolute - TAU * order)
    depth_mm = tensors.depth_mm(phase, torch.tensor(order)).numpy()
    assert np.abs(depth_mm - layer.depth_mm(phase.numpy(), order)).max() < 1e-6
    checked = torch.zeros_like(phase, dtype=torch.bool)
    checked[::40, ::40] = True

    def depth_m(part: torch.Tensor) -> torch.Tensor:
        return (
            tensors.depth_mm(phase.masked_scatter(checked, part), torch.tensor(order))[checked]
            / 1000
        )

    assert torch.autograd.gradcheck(
        depth_m, phase[checked].clone().requires_grad_(), eps=1e-6, atol=1e-6
    )


def test_float32_keeps_a_hundredth_of_a_millimetre() -> None:
    layer = CalibrationLayer.of(PAPER, "vertical")
    z = depths(PAPER)
    absolute = layer.absolute_phase(z)
    order = np.floor(absolute / TAU)
    depth_mm = layer.tensors().depth_mm(
        torch.tensor(absolute - TAU * order).float(), torch.tensor(order).float()
    )
    assert depth_mm.dtype == torch.float32
    assert np.abs(depth_mm.numpy() - z).max() < 2e-3
    # The same from the absolute phase in float32 loses most of that: why the residual form exists.
    naive = depth_from_coordinate(
        PAPER.camera.rays(), absolute.astype(np.float32) * np.float32(18 / TAU), PAPER, "vertical"
    )
    assert np.abs(naive - z).max() > 2 * np.abs(depth_mm.numpy() - z).max()


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
def test_candidates_are_the_orders_whose_depth_is_in_range(rig: Rig, direction: str) -> None:
    layer = CalibrationLayer.of(rig, direction)
    phase = np.random.default_rng(1).uniform(-np.pi, np.pi, (SIZE, SIZE))
    candidates = layer.orders_in_range(phase, rig.working_range_mm)
    near, far = rig.working_range_mm
    middle = np.rint((layer.absolute_phase((near + far) / 2) - phase) / TAU)
    counted = np.zeros((SIZE, SIZE), int)
    for step in range(-8, 9):
        z = layer.depth_mm(phase, middle + step)
        inside = (z >= near) & (z <= far)
        counted += inside
        listed = (middle + step >= candidates.first) & (
            middle + step < candidates.first + candidates.count
        )
        assert np.array_equal(inside, listed)
    assert np.array_equal(counted, candidates.count)
    assert abs(candidates.count.mean() - rig.periods_in_range(direction)) < 0.25


def test_a_range_of_less_than_a_period_leaves_none_or_one() -> None:
    layer = CalibrationLayer.of(PAPER, "vertical")
    phase = np.linspace(-np.pi, np.pi, SIZE * SIZE).reshape(SIZE, SIZE)
    candidates = layer.orders_in_range(phase, (1750.0, 1850.0))
    assert set(np.unique(candidates.count)) == {0, 1}
    nearest = layer.depth_mm(phase, candidates.first)
    assert np.abs(nearest - 1800).max() < 200
    unknown = layer.orders_in_range(np.full((SIZE, SIZE), np.nan), (1500.0, 2100.0))
    assert not unknown.count.any()


def test_unknown_direction_is_refused() -> None:
    with pytest.raises(DecodeError, match="horizontal or vertical"):
        CalibrationLayer.of(PAPER, "diagonal")  # type: ignore[arg-type]
