"""Phase reliance: what its parts are for answers that are known, and the score of readers that are
known."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import pytest

from fpp_ml_bench.baselines.diagnostics.counterfactual import (
    Change,
    follows,
    measure,
    order_free,
    order_free_follows,
    relative_change,
    rms_expected,
    sample_score,
)
from fpp_ml_bench.baselines.diagnostics.scenes import chosen_samples
from fpp_ml_bench.baselines.method import Answer
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.errors import DiagnosisError, PredictionError
from fpp_ml_bench.evaluation.score.uncertainty import object_interval


def change(expected, actual, answered=True):
    expected, actual = np.asarray(expected, dtype=float), np.asarray(actual, dtype=float)
    return Change(expected, actual, np.broadcast_to(answered, expected.shape))


RAMP = np.linspace(-1, 1, 101)
ACROSS = np.cos(np.linspace(0, 8 * np.pi, 101, endpoint=False))
ACROSS -= RAMP * (ACROSS @ RAMP) / (RAMP @ RAMP)


@pytest.mark.parametrize(
    "actual, expected",
    [
        (RAMP, 1.0),
        (0 * RAMP, 0.0),
        (-RAMP, 0.0),
        (0.5 * RAMP, 0.5),
        (2 * RAMP, 0.5),
        (ACROSS, 0.0),
        # Gain 1; purity is the cosine of the angle between what was made and what was asked.
        (RAMP + ACROSS, np.sqrt(RAMP @ RAMP / (RAMP @ RAMP + ACROSS @ ACROSS))),
    ],
)
def test_follows_is_purity_times_gain(actual, expected):
    assert follows([change(RAMP, actual)]) == pytest.approx(expected, abs=1e-12)
    parts = [change(RAMP[::2], actual[::2]), change(RAMP[1::2], actual[1::2])]
    assert follows(parts) == pytest.approx(expected, abs=1e-12)


def test_nothing_asked_is_no_score():
    assert follows([]) is None and follows([change(0 * RAMP, RAMP)]) is None
    assert sample_score(None, 0.0) is None
    assert relative_change([change(RAMP, RAMP)], 0.0) is None and relative_change([], 1.0) is None
    assert (
        sample_score(0.5, None) == 0.5
        and sample_score(0.5, 0.5) == 0.25
        and sample_score(1.0, 3.0) == 0.0
    )


def test_a_change_with_the_outline_counts_in_units_of_what_the_phase_asks():
    unit = rms_expected([change(RAMP, RAMP)])
    assert unit == pytest.approx(np.sqrt(np.mean(RAMP**2)))
    assert relative_change([change(0 * RAMP, 0.25 * RAMP)], unit) == pytest.approx(0.25)
    # Moving with the range of a normalised answer and standing still are both no change.
    assert relative_change([change(RAMP, RAMP)], unit) == 0.0
    assert relative_change([change(RAMP, 0 * RAMP)], unit) == 0.0
    assert relative_change([change(0 * RAMP, 0 * RAMP, False)], unit) == pytest.approx(1.0)


def test_an_answer_of_zero_mm_is_none():
    before, after, expected = np.array([0.0, 5.0, 5.0]), np.array([7.0, 0.0, 7.0]), np.full(3, 2.0)
    zero_change = Change.of(before, after, expected, (before != 0) & (after != 0))
    assert zero_change.actual.tolist() == [0, 0, 2] and zero_change.answered.tolist() == [
        False,
        False,
        True,
    ]
    assert Change.of(before, after, expected, np.ones(3, dtype=bool)).actual.tolist() == [7, -5, 2]


def test_order_free_forgives_periods_and_credits_no_chance():
    periods = 2 * np.pi * np.random.default_rng(1).integers(-2, 3, RAMP.size)
    assert order_free_follows([change(RAMP, RAMP + periods)]) == pytest.approx(1.0)
    assert order_free_follows([change(RAMP, 0 * RAMP)]) == 0.0
    chance = np.random.default_rng(2).uniform(-np.pi, np.pi, 20_000)
    assert order_free_follows([change(np.resize(RAMP, chance.size), chance)]) == 0.0
    assert relative_change(order_free([change(0 * RAMP, periods)]), 1.0) == pytest.approx(
        0.0, abs=1e-12
    )


@dataclass
class Reader:
    """A known answer to frames."""

    known: Any
    frames_used: tuple[int, ...] = (0,)
    units: str = "mm"
    uses_ground_truth_mask: bool = False
    weights_sha256: str | None = None
    title: str = "Reader"

    def answer(self, frames):
        return Answer(np.asarray(self.known(frames), dtype=np.float32))


def sobel(image):
    grey = np.asarray(image, dtype=np.float32)
    return np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))


def silhouette(frames):
    return (frames[51] > 75).astype(
        np.uint8
    )  # white light: the background is too far to be that bright


def template(frames):
    mask = silhouette(frames)
    return np.where(mask, 1700 + 5 * cv2.distanceTransform(mask, cv2.DIST_L2, 5), 0)


def normalised(depth_mm):
    inside = depth_mm > 0
    return (
        (np.where(inside, depth_mm, depth_mm[inside].min()) - depth_mm[inside].min())
        / np.ptp(depth_mm[inside])
        if (inside.any())
        else depth_mm
    )


@pytest.fixture(scope="module")
def scene_set(opened):
    return opened, chosen_samples(opened, "train", 1)


@pytest.fixture(scope="module")
def exact(opened):
    return load_method("classical", opened.rig)


@pytest.mark.long
@pytest.mark.parametrize("units", ["mm", "normalised"])
def test_the_exact_decoder_is_a_pure_phase_reader(units, scene_set, exact):
    def answer(frames):
        depth_mm = exact.predict(frames)
        return depth_mm if units == "mm" else normalised(depth_mm)

    reliance, samples = measure(Reader(answer, exact.frames_used, units), *scene_set)
    assert reliance.score >= 0.98
    assert reliance.parts.follows_light is not None and reliance.parts.follows_light <= 0.02
    assert reliance.parts.change_outline <= 0.02 and reliance.parts.change_no_fringe_outside <= 0.02
    assert (
        reliance.units == units
        and reliance.objects == 2
        and reliance.dataset_fingerprint == scene_set[0].fingerprint
    )
    scores = [sample["score"] for sample in samples.values()]
    interval = object_interval(scores, [split_sample_name(name)[0] for name in samples])
    assert reliance.interval == pytest.approx(list(np.clip(interval, 0, 1)))
    if units == "mm":
        assert reliance.order_free_score >= 0.98 and reliance.parts.follows_constant >= 0.98
        assert reliance.parts.answered_no_fringe_inside <= 0.02
        assert (
            reliance.parts.change_other_direction is None
            or reliance.parts.change_other_direction > 1
        )
    else:
        assert reliance.order_free_score is None and reliance.parts.follows_constant is None


def test_an_answer_of_another_form_is_named(scene_set):
    reader = Reader(lambda frames: np.zeros((3, 3)))
    with pytest.raises(
        PredictionError, match=r"Reader: the method gave float32 \(3, 3\), expected float32 \("
    ):
        measure(reader, *scene_set)


@pytest.mark.long
@pytest.mark.parametrize(
    "reader",
    [
        Reader(lambda frames: sobel(frames[0]) / 255, units="normalised"),
        Reader(lambda frames: 1500 + 300 * sobel(silhouette(frames)), (51,)),
        Reader(template, (51,)),
        Reader(lambda frames: np.full(frames[0].shape, 1800)),
        Reader(lambda frames: 1500 + 2 * cv2.GaussianBlur(frames[0], (0, 0), 6).astype(float)),
        Reader(lambda frames: np.zeros(frames[0].shape)),
    ],
    ids=[
        "edges of the fringe",
        "edges of the mask",
        "template",
        "constant",
        "brightness",
        "no answer",
    ],
)
def test_readers_of_shape_have_no_phase_reliance(reader, scene_set):
    reliance, _ = measure(reader, *scene_set)
    assert 0 <= reliance.score <= 0.02
    assert reliance.order_free_score is None or reliance.order_free_score <= 0.02


def test_half_a_phase_reader_has_half_the_score(scene_set, exact):
    def answer(frames):
        return 900 + 0.5 * exact.predict(frames)

    reliance, _ = measure(Reader(answer, exact.frames_used), *scene_set)
    assert reliance.score == pytest.approx(0.5, abs=0.02)


def test_a_shape_reader_changes_with_the_outline_alone(scene_set):
    reliance, _ = measure(Reader(template, (51,)), *scene_set)
    assert reliance.parts.change_outline > 0.1
    assert reliance.parts.follows_phase == 0 and reliance.parts.change_other_pitch == 0


def test_units_that_have_no_truth_are_refused(scene_set):
    with pytest.raises(DiagnosisError, match="'m'"):
        measure(Reader(lambda frames: frames[0], units="m"), *scene_set)
