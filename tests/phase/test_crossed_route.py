"""The crossed route on surfaces of known depth: any exposure, albedo and rig, and where it must say
no."""

from dataclasses import replace

import numpy as np
import pytest
from crossed_scenes import FAMILY, NO_PLANE, RIG, frame, route, slab
from flat_planes import turned
from numpy.typing import NDArray
from skimage.filters import gabor_kernel

from fpp_ml_bench.baselines.phase.depth import Reason, reaching
from fpp_ml_bench.baselines.phase.geometry import Carriers, wrapped
from fpp_ml_bench.baselines.phase.local_fit import (
    CURVED,
    DEMODULATION_PERIODS,
    Demodulator,
)
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.coding.crossed import Crossed, crossed_from_pair
from fpp_ml_bench.errors import DecodeError, PredictionError
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig import Rig

TURNED_RIG = turned(NO_PLANE, 5.0, (-0.05, -0.14, 0.03))
BENT_RIG = replace(
    NO_PLANE, projector=replace(NO_PLANE.projector, distortion=(-0.08, 0.05, 0.001, -0.001, 0.0))
)
every_rig = pytest.mark.parametrize(
    "rig", [RIG, NO_PLANE, TURNED_RIG, BENT_RIG], ids=["paper", "no plane", "turned", "lens"]
)


def errors(
    rig: Rig, family: Crossed, image: NDArray[np.uint8], depth_mm: NDArray
) -> tuple[NDArray, NDArray]:
    """Errors in mm where a depth was found on the object, and whether each object pixel has one."""
    found = route(rig, family).measure(image).depth_mm
    inside = depth_mm > 0
    answered = found[inside] > 0
    return np.abs(found[inside] - depth_mm[inside])[answered], answered


@every_rig
def test_nearness_and_depth_are_inverse_and_the_phases_those_of_the_rig(rig: Rig) -> None:
    carriers = Carriers.of(rig, FAMILY)
    x, y = rig.camera.rays()
    for depth_mm in (1500.0, 1750.0, 2100.0):
        z = np.full(x.shape, depth_mm / 1000)
        u, v = rig.project(np.stack([x * z, y * z, z], axis=-1))
        exact = np.stack([2 * np.pi * (a * u + b * v) for a, b in FAMILY.cycles_per_px])
        nearness = carriers.nearness(depth_mm)
        # Single precision of phases in [-pi, pi] with a gain of 100 rad m; the lens bends by
        # hundredths of a px.
        assert np.abs(wrapped(carriers.phases(nearness) - exact)).max() < (
            2e-2 if rig is BENT_RIG else 2e-4
        )
        # A pixel that shows the exact phases gets the exact depth, with a lens too.
        beside = wrapped(exact - carriers.phases(nearness))
        shown = nearness + (beside * carriers.gain).sum(axis=0) / carriers.joint_gain**2
        assert np.abs(carriers.depth_mm(shown) - depth_mm).max() < 0.02


@pytest.mark.long
@pytest.mark.parametrize("middle_mm", [1560.0, 1800.0, 2040.0])
@every_rig
def test_a_slab_at_any_distance(rig: Rig, middle_mm: float) -> None:
    depth_mm = slab(rig, middle_mm)
    image = frame(depth_mm, rig, background_grey=50.0 if rig.background_m else 0.0)
    error, answered = errors(rig, FAMILY, image, depth_mm)
    assert answered.mean() > 0.97
    assert np.median(error) < 1.0
    assert np.percentile(error, 95) < 12


@pytest.mark.parametrize("count", [1, 3])
def test_beyond_the_end_of_the_range_there_is_no_depth(count: int) -> None:
    depth_mm = slab(middle_mm=2100.0, slope=0.1)
    frames = [frame(depth_mm, number=number) for number in range(3)] + [None] * (
        len(RIG.sequence) - 3
    )
    measured = load_method("crossed", RIG, frames=count).measure(frames)  # type: ignore[attr-defined]
    within, beyond = (depth_mm > 0) & (depth_mm < 2095), depth_mm > 2105
    assert measured.depth_mm.max() <= 2100
    assert (np.abs(measured.depth_mm - depth_mm)[within] < 8).mean() > 0.98
    assert (measured.depth_mm[beyond] == 0).mean() > 0.97
    assert (measured.reason[beyond] == Reason.OUT_OF_RANGE).mean() > 0.97
    without = measured.depth_mm == 0
    assert not measured.sigma_mm[without].any() and not measured.confidence[without].any()


@pytest.mark.parametrize("white_grey", [40.0, 110.0, 240.0])
def test_exposure_does_not_matter(white_grey: float) -> None:
    depth_mm = slab()
    image = frame(depth_mm, white_grey=white_grey, background_grey=white_grey / 3)
    error, answered = errors(RIG, FAMILY, image, depth_mm)
    assert answered.mean() > 0.995
    assert np.median(error) < 1.5
    assert (error > 150).mean() < 1e-3


def test_any_albedo() -> None:
    depth_mm = slab()
    y, x = np.indices(depth_mm.shape)
    painted = 60 + 120.0 * ((x // 40 + y // 40) % 2)
    error, _ = errors(RIG, FAMILY, frame(depth_mm, white_grey=painted), depth_mm)
    assert np.median(error) < 3
    assert (error > 150).mean() < 0.01


def test_demodulation_is_the_least_squares_solution_of_the_window() -> None:
    image = frame(slab()).astype(np.float32)
    carriers = Carriers.of(RIG, FAMILY)
    coarse, seen = (Demodulator(carriers, stride)(image) for stride in (3, 1))
    sigma_px = DEMODULATION_PERIODS * carriers.period_px
    half = int(np.ceil(3 * sigma_px))
    dy, dx = np.mgrid[-half : half + 1, -half : half + 1]
    root = np.exp(-0.25 * (dx**2 + dy**2) / sigma_px**2).ravel()
    columns = [(dx.astype(float) ** a * dy.astype(float) ** b).ravel() for a, b in CURVED]
    for across, down in carriers.step_rad:
        columns += [f(across * dx + down * dy).ravel() for f in (np.cos, np.sin)]
    for row, column in ((60, 60), (159, 162), (201, 120)):
        part = (
            image[row - half : row + half + 1, column - half : column + half + 1]
            .ravel()
            .astype(float)
        )
        answer = np.linalg.lstsq(
            root[:, None] * np.stack(columns, axis=1), root * part, rcond=None
        )[0]
        expected = answer[[6, 8]] - 1j * answer[[7, 9]]
        assert (
            np.abs(seen.amplitude[:, row, column] - expected).max() < 1e-3
        )  # grey levels, single precision
        assert abs(seen.mean_grey[row, column] - answer[0]) < 1e-3
        # A grid point a third of a period apart leaves out the filter's weakest frequencies.
        assert (
            np.abs(coarse.amplitude[:, row // 3, column // 3] - expected).max() < 2e-3 * answer[0]
        )


def test_demodulation_agrees_with_gabor_filters_on_even_brightness() -> None:
    # scikit-image's filter has neither the polynomial nor the other carrier in its model: on a
    # plane of one brightness it sees the same phase, up to what its window lets through of both.
    depth_mm = np.full((RIG.camera.height, RIG.camera.width), 1800.0)
    image = frame(depth_mm, noise_grey=0.0)
    carriers = Carriers.of(RIG, FAMILY)
    seen = Demodulator(carriers, stride=3)(image.astype(np.float32))
    sigma_px = 3 * carriers.period_px
    for number, (across, down) in enumerate(carriers.step_rad):
        frequency, theta = np.hypot(across, down) / (2 * np.pi), np.arctan2(down, across)
        kernel = gabor_kernel(frequency, theta=theta, sigma_x=sigma_px, sigma_y=sigma_px)
        height, width = (size // 2 for size in kernel.shape)
        for row in range(150, 171, 3):
            part = image[row - height : row + height + 1, 159 - width : 160 + width]
            angle = np.angle((part * np.conj(kernel)).sum())
            assert abs(wrapped(seen.phase_rad[number, row // 3, 53] - angle)) < 0.02
    assert seen.modulation[:, 50:57, 50:57].min() > 30


def test_a_frame_made_of_two_has_the_depth_of_one() -> None:
    rig = paper_rig(320)
    first, second = (
        frame(
            slab(rig),
            rig,
            Crossed((18.0, 18.0), (angle, angle + 90), (1.0 - 1e-9, 1e-9)),
            noise_grey=0.3,
        )
        for angle in (0.0, 90.0)
    )
    method = load_method("crossed", rig)
    assert method.frames_used == (0, 18)
    frames = [None] * len(rig.sequence)
    frames[0], frames[18] = first, second
    direct = route(rig, Crossed.of_pair(rig)).measure(crossed_from_pair(first, second))
    assert np.array_equal(method.predict(frames), direct.depth_mm)
    error = np.abs(direct.depth_mm - slab(rig))[(slab(rig) > 0) & (direct.depth_mm > 0)]
    assert np.median(error) < 2


def test_one_direction_lost_is_said() -> None:
    depth_mm = slab()
    lost = Crossed(FAMILY.pitches_px, FAMILY.angles_deg, (0.5, 1e-9))
    measured = route().measure(frame(depth_mm, family=lost, background_grey=50.0))
    inside = depth_mm > 0
    said = np.isin(measured.reason[inside], [Reason.ONE_DIRECTION, Reason.AMBIGUOUS])
    assert said.mean() > 0.8
    wrong = np.abs(measured.depth_mm - depth_mm)[inside] > 150
    confident = measured.sigma_mm[inside] < 0.25 * np.abs(measured.depth_mm - depth_mm)[inside]
    assert (wrong & confident & (measured.depth_mm[inside] > 0)).mean() < 0.02


def test_saturated_crests_are_said() -> None:
    depth_mm = slab()
    measured = route().measure(frame(depth_mm, white_grey=420.0, background_grey=90.0))
    inside = depth_mm > 0
    assert (measured.reason[inside] == Reason.SATURATED).mean() > 0.9


def test_nothing_but_background() -> None:
    empty = np.zeros((RIG.camera.height, RIG.camera.width))
    assert not route().measure(frame(empty)).depth_mm.any()


def test_the_stated_uncertainty_is_about_right() -> None:
    depth_mm = slab(slope=0.0)
    measured = route().measure(frame(depth_mm, noise_grey=3.0))
    height, width = depth_mm.shape
    middle = slice(height // 2 - 30, height // 2 + 30), slice(width // 2 - 30, width // 2 + 30)
    error = np.abs(measured.depth_mm - depth_mm)[middle]
    assert 0.4 < (error < measured.sigma_mm[middle]).mean() <= 1


def test_a_rival_widens_the_interval_as_far_as_it_is_likely() -> None:
    apart_rad = np.full(5, 2.0)
    chance = np.array([0.0, 0.009, 0.011, 0.05, 0.9], np.float32)
    sigma = reaching(apart_rad, chance)
    assert np.array_equal(sigma[:2], [0.0, 0.0])
    # 1.1% lies just within the 99% interval, 5% at the end of the 95% interval; beyond a third it
    # is a standard error.
    assert sigma[2] == pytest.approx(2 / 2.54, rel=0.01)
    assert sigma[3] == pytest.approx(2 / 1.96, rel=0.01) and sigma[4] == pytest.approx(
        2.0, rel=0.01
    )


def test_what_is_refused() -> None:
    with pytest.raises(DecodeError, match="float64"):
        route().measure(np.zeros((RIG.camera.height, RIG.camera.width)))
    with pytest.raises(DecodeError, match=r"rig\.scaled"):
        route().measure(np.zeros((10, 10), np.uint8))
    with pytest.raises(PredictionError, match="min_confidence"):
        load_method("crossed", RIG, min_confidence=2)
    with pytest.raises(DecodeError, match="frame 0 is missing"):
        load_method("crossed", RIG).predict([None] * len(RIG.sequence))
    along = replace(NO_PLANE, translation_m=(0.0, 1e-4, 0.0))
    with pytest.raises(PredictionError, match="too little for a depth"):
        Carriers.of(along, Crossed((18.0, 18.0)))
