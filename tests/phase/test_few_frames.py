"""Two and more frames of one direction, and the choice of how many a scene needs."""

from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from flat_planes import RIG, USERS_WORD, plane_depth_m, plane_frames

from fpp_ml_bench.baselines.method import Answer
from fpp_ml_bench.baselines.phase.method import FewestFrames, PhaseMethod, levels_of
from fpp_ml_bench.baselines.phase.settings import steps_of
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.decoding.triangulation import depth_noise_mm
from fpp_ml_bench.errors import DecodeError, PredictionError

SIZE = RIG.camera.width
HALF = SIZE // 2
OBJECT = (slice(110, 370), slice(130, 350))


@cache
def made(frames: int, direction: str = "horizontal", **options: object) -> PhaseMethod:
    return PhaseMethod(RIG, direction=direction, frames=frames, **options)


@cache
def plane(distance_m: float, direction: str = "horizontal") -> list[np.ndarray | None]:
    """All fringes and Gray frames of one direction on a plane that fills the frame."""
    indices = [*RIG.sequence.sinusoids(direction), *RIG.sequence.gray(direction)]  # type: ignore[arg-type]
    return plane_frames(RIG, indices, plane_depth_m(RIG, distance_m))


def scene(left_m: float, right_m: float) -> list[np.ndarray | None]:
    """A block before the calibrated plane, its left and right half at two distances."""
    frames: list[np.ndarray | None] = []
    for back, left, right in zip(
        plane(RIG.background_m), plane(left_m), plane(right_m), strict=True
    ):
        if back is None or left is None or right is None:
            frames.append(None)
            continue
        image, both = back.copy(), np.where(np.arange(SIZE) < HALF, left, right)
        image[OBJECT] = both[OBJECT]
        frames.append(image)
    return frames


def exact_mm(left_m: float, right_m: float) -> np.ndarray:
    depth = np.zeros((SIZE, SIZE))
    depth[OBJECT] = np.broadcast_to(
        np.where(np.arange(SIZE) < HALF, left_m, right_m) * 1000, depth.shape
    )[OBJECT]
    return depth


def looks_of(answer: Answer) -> list[dict[str, Any]]:
    """The expected error at each number of frames."""
    return answer.report["looks"]  # type: ignore[no-any-return]


def test_steps_are_spread_and_complete_each_other() -> None:
    assert [steps_of(18, n) for n in (1, 2, 3, 4, 6)] == [
        (0,),
        (0, 6),
        (0, 6, 12),
        (0, 5, 9, 14),
        (0, 3, 6, 9, 12, 15),
    ]
    assert steps_of(18, 18) == tuple(range(18))
    for steps, expected in (
        (18, (1, 2, 3, 6, 18)),
        (12, (1, 2, 3, 6, 12)),
        (9, (1, 2, 3, 6, 9)),
        (4, (1, 4)),
    ):
        levels = levels_of(steps)
        assert levels == expected
        for few, more in pairwise(levels):
            assert set(steps_of(steps, few)) <= set(steps_of(steps, more))
    for wrong in (0, 19, 2.5, True, "3"):
        with pytest.raises(PredictionError, match="1 to the 18"):
            steps_of(18, wrong)  # type: ignore[arg-type]


@pytest.mark.long
@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
@pytest.mark.parametrize("frames", [3, 4, 18])
def test_noise_of_a_plane_is_the_closed_form(frames: int, direction: str) -> None:
    measurement = made(frames, direction, **USERS_WORD).measure(plane(1.8, direction))
    middle = (slice(150, 330), slice(150, 330))
    error = (measurement.depth_mm - 1800)[middle].astype(np.float64)
    expected = depth_noise_mm(
        RIG, 1800.0, direction, frames, float(measurement.modulation_grey[middle].mean()), 1.0
    )
    # Rounding adds a twelfth of a squared level to the noise; unequal steps weigh noise a little
    # unevenly.
    assert 0.9 < error.std() / expected < 1.15
    assert abs(error.mean()) < 3 * expected / 180 + 0.05
    assert (measurement.expected_error_mm - measurement.order_doubt_mm)[
        middle
    ].mean() == pytest.approx(np.abs(error).mean(), rel=0.25)


@pytest.mark.long
@pytest.mark.parametrize("distance_m", [1.55, 1.8, 2.05])
@pytest.mark.parametrize("frames", [2, 3])
def test_a_plane_is_at_its_distance_without_gray_code(frames: int, distance_m: float) -> None:
    measurement = made(frames, **USERS_WORD).measure(plane(distance_m))
    lit = measurement.modulation_grey > 5
    assert lit.mean() > 0.7
    assert np.abs(measurement.depth_mm - distance_m * 1000)[lit].mean() < 1.5


def test_a_depth_edge_blurs_one_frame_and_no_more() -> None:
    left_m, right_m = 1.80, 1.72
    frames, truth = scene(left_m, right_m), exact_mm(left_m, right_m)
    band = (slice(120, 360), slice(HALF - 4, HALF + 4))
    off = {}
    for count in (1, 2, 3):
        measurement = made(count).measure(frames)
        off[count] = np.abs(measurement.depth_mm - truth)[band].mean()
        on_object = measurement.depth_mm > 0
        assert (on_object != (truth > 0)).mean() < 0.004
    assert off[3] < 1.5
    assert off[2] < 0.5 * off[1]
    assert off[1] > 5 * off[3]


@pytest.mark.long
def test_frames_are_added_until_the_stated_error_is_expected() -> None:
    frames, truth = scene(1.8, 1.72), exact_mm(1.8, 1.72)
    looks = looks_of(FewestFrames(RIG, 1e-3).answer(frames))
    assert [(look["frames"], look["gray_code"]) for look in looks] == [
        (1, False),
        (2, False),
        (3, False),
        (6, False),
        (18, False),
        (25, True),
    ]
    expected_mm = [look["expected_error_mm"] for look in looks]
    # Two frames still average over a small window, which a plane rewards; from three on noise falls
    # as the root.
    assert expected_mm[0] > 2 * expected_mm[1]
    assert expected_mm[2] == pytest.approx(expected_mm[4] * 6**0.5, rel=0.2)
    for place in (0, 1):
        error_mm = 1.001 * expected_mm[place]
        chosen = FewestFrames(RIG, error_mm).answer(frames)
        assert looks_of(chosen) == looks[: len(looks_of(chosen))]
        *before, last = looks_of(chosen)
        assert last["expected_error_mm"] <= error_mm
        assert all(look["expected_error_mm"] > error_mm for look in before)
        assert len(chosen.report["frames_used"]) == last["frames"] == chosen.report["frames"]
        assert np.abs(chosen.depth - truth)[truth > 0].mean() < 2.0


def test_doubt_about_the_order_asks_for_the_gray_code() -> None:
    frames, truth = scene(1.8, 1.8), exact_mm(1.8, 1.8)
    chosen = FewestFrames(RIG, 2.0, shading=False).answer(
        frames
    )  # nothing but the range: two orders are as good
    *before, last = looks_of(chosen)
    assert last["gray_code"] and last["frames"] == 3 + RIG.sequence.bits("horizontal")
    assert not any(look["gray_code"] for look in before)
    assert before[-1]["by_order_mm"] > 2.0
    assert np.abs(chosen.depth - truth)[truth > 0].mean() < 2.0


def test_frames_not_asked_for_are_never_looked_at() -> None:
    frames = scene(1.8, 1.8)
    chosen = FewestFrames(RIG, 1.2).answer(frames)
    used = chosen.report["frames_used"]
    only = [frame if index in used else None for index, frame in enumerate(frames)]
    assert np.array_equal(FewestFrames(RIG, 1.2).predict(only), chosen.depth)
    missing = list(only)
    missing[used[-1]] = None
    with pytest.raises(DecodeError, match=f"frame {used[-1]} is missing"):
        FewestFrames(RIG, 1.2).predict(missing)


def test_an_empty_scene_needs_one_frame() -> None:
    chosen = FewestFrames(RIG, 0.1).answer(plane(RIG.background_m))
    assert chosen.report["frames"] == 1
    assert not chosen.depth.any()


def test_methods_say_what_they_need_and_refuse_what_they_cannot() -> None:
    assert load_method("phase", RIG, frames=3, direction="vertical").frames_used == (18, 24, 30)
    few = load_method("phase", RIG, error_mm=3.0)
    assert few.frames_used == (*range(18), *range(36, 43)) and "3 mm" in few.title
    assert few.settings["error_mm"] == 3.0 and "frames" not in few.settings
    for wrong in (0, -1.0, float("nan"), float("inf"), True, "3"):
        with pytest.raises(PredictionError, match="error_mm"):
            load_method("phase", RIG, error_mm=wrong)
    with pytest.raises(PredictionError, match="give one"):
        load_method("phase", RIG, error_mm=3.0, frames=2)
    with pytest.raises(PredictionError, match="frames 19"):
        load_method("phase", RIG, frames=19)
    with pytest.raises(DecodeError, match="frame 6 is missing"):
        made(3).measure([image if i != 6 else None for i, image in enumerate(plane(1.8))])
    with pytest.raises(DecodeError, match="expected 3 fringes"):
        made(3).route.measure(plane(1.8)[0])
