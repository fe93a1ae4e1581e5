"""Three crossed frames: as exact as the noise, sharp at edges, and refused where the frames are
others."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from crossed_scenes import FAMILY, NO_PLANE, RIG, frame, slab
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, median_filter

from fpp_ml_bench.baselines.phase import local_fit
from fpp_ml_bench.baselines.phase.depth import Measurement
from fpp_ml_bench.baselines.phase.object_mask import continued
from fpp_ml_bench.baselines.phase.observe import TwoCarriers
from fpp_ml_bench.baselines.phase.order import local_median
from fpp_ml_bench.baselines.phase.route import CrossedRoute, two_carriers
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.errors import DecodeError, PredictionError
from fpp_ml_bench.optics.named_rigs import crossed_rig, paper_rig
from fpp_ml_bench.optics.rig import Rig

WHOLE = crossed_rig(960, "crossed-18")
CUT = replace(WHOLE, camera=replace(WHOLE.camera, width=320, height=320, cx=159.5, cy=159.5))
"""The middle of the benchmark's images, whose pixels are not resampled."""


@cache
def route(rig: Rig = CUT) -> CrossedRoute:
    return two_carriers(TwoCarriers(rig, moved=0))


def measured(
    depths_mm: list[NDArray], noise_grey: float = 0.7, rig: Rig = CUT, **light: float
) -> Measurement:
    """Of three frames, each of a surface of its own."""
    images = [
        frame(depth_mm, rig, rig.crossed, noise_grey=noise_grey, number=number, **light)  # type: ignore[arg-type]
        for number, depth_mm in enumerate(depths_mm)
    ]
    return route(rig).measure(images)


@pytest.mark.parametrize("middle_mm", [1560.0, 1800.0, 2040.0])
def test_a_slab_is_exact_to_the_noise_up_to_its_edge(middle_mm: float) -> None:
    depth_mm = slab(CUT, middle_mm)
    found = measured([depth_mm] * 3)
    inside = depth_mm > 0
    error, sigma = (found.depth_mm - depth_mm)[inside], found.sigma_mm[inside]
    assert (np.abs(error) > 5).mean() < 1e-4
    assert (found.depth_mm[~inside] > 0).mean() < 2e-3
    assert abs(np.median(error)) < 0.05
    # One pixel's own phase has the noise sqrt(2 / 3) s / B: that of the mean of 25 pixels is five
    # times less.
    carriers = route().model.carriers
    one_mm = carriers.mm_per_rad(depth_mm)[inside] * np.sqrt(2 / 3) * 0.76 / 40
    assert 0.15 < np.median(np.abs(error) / 0.6745) / np.median(one_mm) < 0.35
    assert 0.6 < (np.abs(error) < sigma).mean() < 0.85
    rim = inside & ~binary_erosion(inside)
    assert np.percentile(np.abs(found.depth_mm - depth_mm)[rim], 95) < 3 * np.median(one_mm)


def test_without_a_known_plane_and_on_paint() -> None:
    rig = replace(CUT, background_m=None)
    depth_mm = slab(rig)
    y, x = np.indices(depth_mm.shape)
    painted = 60 + 120.0 * ((x // 20 + y // 20) % 2)
    found = measured([depth_mm] * 3, rig=rig, white_grey=painted, background_grey=0.0)
    inside = depth_mm > 0
    answered = inside & (found.depth_mm > 0)
    assert answered.sum() > 0.97 * inside.sum()
    assert np.median(np.abs(found.depth_mm - depth_mm)[answered]) < 0.5


@pytest.mark.parametrize("indirect_grey", [0.0, 20.0])
def test_a_bar_much_narrower_than_a_window_has_the_right_order(indirect_grey: float) -> None:
    """A window on it shows the slab behind; its order is told by each pixel's own light, that of
    other surfaces off."""
    depth_mm, (y, x) = slab(CUT, 1900.0), np.indices((320, 320))
    bar = (depth_mm > 0) & (np.abs(x - 160 + 0.4 * (y - 160)) < 4)
    depth_mm = np.where(bar, 1650.0, depth_mm)
    ambient = np.where(depth_mm > 0, 6.0 + indirect_grey, 6.0)
    found = measured([depth_mm] * 3, ambient_grey=ambient)  # type: ignore[arg-type]
    assert (np.abs(found.depth_mm - depth_mm) > 20)[bar].mean() < 0.01


def test_a_surface_whose_fringe_noise_hides_is_measured_by_averages(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    depth_mm = slab(CUT)
    inside = depth_mm > 0

    def missed_wrong_invented() -> tuple[float, float, float]:
        found = measured([depth_mm] * 3, noise_grey=2.0, white_grey=12.0).depth_mm
        answered = inside & (found > 0)
        wrong = np.abs(found - depth_mm)[answered] > 20
        return (
            (inside & ~answered).sum() / inside.sum(),
            float(wrong.mean()),
            float((found[~inside] > 0).mean()),
        )

    missed, wrong, invented = missed_wrong_invented()
    assert missed < 1e-3 and wrong < 1e-3 and invented < 1e-3
    monkeypatch.setattr(local_fit, "WEAK_SIGMAS", 0.0)  # every pixel for itself
    missed, wrong, _ = missed_wrong_invented()
    assert missed > 0.5 and wrong > 0.05


def test_the_local_median_is_that_of_the_object_and_of_its_nearest_pixel_beyond() -> None:
    random = np.random.default_rng(4)
    values = random.uniform(-0.5, 0.5, (40, 50)).astype(np.float32)
    whole = np.ones(values.shape, bool)
    found, exact = local_median(values, whole, 9.0), median_filter(values, 9, mode="nearest")
    assert np.abs(found - exact).max() < 0.0026  # half a step
    half = whole.copy()
    half[:, 25:] = False
    beyond = local_median(np.where(half, values, 9.0).astype(np.float32), half, 9.0)
    alone = local_median(np.repeat(values[:, 24:25], 50, axis=1), whole, 9.0)
    assert np.array_equal(beyond[:, 40:], alone[:, 40:])


def test_an_object_that_moves_between_frames_keeps_its_order() -> None:
    depth_mm = slab(CUT)
    inside = depth_mm > 0
    found = measured([np.where(inside, depth_mm + moved_mm, 0) for moved_mm in (-2.0, 0.0, 2.0)])
    assert np.abs(found.depth_mm - depth_mm)[inside].max() < 20


def test_which_pixels_continue_a_surface() -> None:
    inside = np.ones((9, 9), bool)
    inside[4, 4] = inside[2, 6] = inside[6, 2] = False
    phase, different = np.zeros((9, 9), np.float32), inside.copy()
    phase[2, 6] = phase[6, 2] = 1.0
    different[6, 2] = True  # lit by other surfaces, without a fringe of its own
    grown = continued(inside, np.ones_like(inside), different, phase)
    assert grown[4, 4] and grown[6, 2] and not grown[2, 6]
    assert np.array_equal(continued(inside, np.zeros_like(inside), different, phase), inside)


def test_the_method_and_what_it_refuses() -> None:
    method = load_method("crossed", RIG, frames=3)
    assert method.frames_used == (0, 1, 2) and method.settings["frames"] == 3
    frames: list[NDArray | None] = [None] * len(RIG.sequence)
    with pytest.raises(DecodeError, match="frame 0 is missing"):
        method.predict(frames)
    frames[:3] = [frame(slab(), number=number) for number in range(3)]
    answer = method.answer(frames)
    assert np.array_equal(answer.depth, method.predict(frames))
    with pytest.raises(DecodeError, match="3 crossed frames, got 2"):
        route().measure(frames[:2])  # type: ignore[arg-type]
    with pytest.raises(PredictionError, match="1 or 3"):
        load_method("crossed", RIG, frames=2)
    for rig in (paper_rig(320), NO_PLANE):
        with pytest.raises(PredictionError, match=r"three crossed frames .* has none"):
            load_method("crossed", rig, frames=3)
    shifts = (0.0, 0.0), (120.0, 120.0), (240.0, 240.0)
    both = RIG.with_crossed(Crossed(FAMILY.pitches_px, FAMILY.angles_deg, shifts_deg=shifts))
    with pytest.raises(PredictionError, match="keep the other still"):
        load_method("crossed", both, frames=3)
