"""Every score against an independent float128 reference, and the identity of the three sets."""

import numpy as np
import pytest
from extended_precision import sample_scores
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from fpp_ml_bench.evaluation.metrics import HEADLINE, METRICS
from fpp_ml_bench.evaluation.result.model import over_samples
from fpp_ml_bench.evaluation.result.parts import AGREES, Metrics
from fpp_ml_bench.evaluation.score.sample_scores import score_sample


@st.composite
def cases(draw):
    """A prediction and target of any small shape, cover, scale from 1e-30 to 1e30, dtype and memory
    order; void pixels and the depth of those of them that are unlit."""
    shape = draw(st.tuples(st.integers(1, 36), st.integers(1, 36)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from([np.float16, np.float32, np.float64]))
    largest = 4 if kind is np.float16 else 30
    scale = 10.0 ** draw(st.integers(-largest, largest))
    cover = draw(st.sampled_from([0.0, 0.03, 0.5, 0.97, 1.0]))
    target = (
        np.where(
            ndimage.uniform_filter(rng.random(shape), 3) < cover, rng.uniform(0.5, 1.0, shape), 0.0
        )
        * scale
    )
    few = rng.random(shape) < 0.05
    # An offset of 0.7 is at no power of ten one of the tolerances, where rounding would decide.
    spread = draw(st.sampled_from([rng.normal(0, 1, shape), np.full(shape, 0.7), 0.7 * few]))
    noise = (
        spread * scale * draw(st.sampled_from([0.0, 1e-3, 1.0, 1e3 if kind is np.float64 else 1.0]))
    )
    prediction = (target + noise) * (rng.random(shape) < draw(st.sampled_from([1.0, 0.8])))
    prediction = prediction.astype(kind)
    target = target.astype(draw(st.sampled_from([kind, np.float64])))
    void = rng.random(shape) < draw(st.sampled_from([0.0, 0.2, 1.0]))
    unlit = np.where(void & (rng.random(shape) < 0.5), rng.uniform(0.5, 1.0, shape), 0.0) * scale
    order, band = draw(st.sampled_from("CF")), draw(st.sampled_from([0, 1, 3, 8, 50]))
    return np.asarray(prediction, order=order), target, band, void, unlit


@given(cases())
@settings(max_examples=200, deadline=None)
def test_every_score_agrees_with_float128(case):
    scores = score_sample(*case).metrics()
    expected = sample_scores(*case)
    assert set(scores) == set(expected) and {
        key for key, m in METRICS.items() if not m.optional
    } <= set(scores) <= set(METRICS)
    scale = float(expected["object_mae_mm"] or 0)
    for key, value in expected.items():
        if value is None:
            assert scores[key] is None, key
            continue
        relative = 1e-12 if key in HEADLINE else 1e-10
        # Signed means and the error without an offset are small differences: accurate relative to
        # the object's MAE.
        rounding = 1e-12 * scale if METRICS[key].cancels else 0.0
        assert scores[key] == pytest.approx(float(value), rel=relative, abs=rounding), key


@pytest.mark.long
@given(st.lists(cases(), min_size=1, max_size=4))
@settings(max_examples=150, deadline=None)
def test_scores_of_any_errors_contradict_nothing(views):
    """What refuses scores that no errors have refuses none that some have: of a view, and means
    over views."""
    scores = [score_sample(*view).metrics() for view in views]
    for of_a_view in scores:
        assert Metrics(**of_a_view).problem(1, AGREES) is None
    means = over_samples(scores)
    assert Metrics(**means).problem(len(views), AGREES) is None


def test_closed_forms_of_the_distribution():
    target = np.full((1, 101), 1800.0)
    errors = np.arange(101, dtype=np.float64) - 20.0  # -20 .. 80
    scores = score_sample(target + errors, target).metrics()
    assert scores["object_bias_mm"] == 30.0
    assert scores["object_max_mm"] == 80.0
    assert scores["object_median_mm"] == np.median(np.abs(errors))
    assert scores["object_p95_mm"] == 75.0
    assert scores["object_shift_free_mae_mm"] == pytest.approx(
        np.abs(np.arange(-50, 51)).mean(), rel=1e-15
    )
    assert [scores[f"object_within_{k}mm_share"] for k in (1, 2, 5, 10)] == [
        3 / 101,
        5 / 101,
        11 / 101,
        21 / 101,
    ]


def test_only_the_scores_that_say_so_are_improved_by_missing_pixels():
    """A bad answer everywhere against its best pixel alone: the errors that count every pixel are
    larger then."""
    rng = np.random.default_rng(0)
    target = np.full((40, 40), 0.0)
    target[5:35, 5:35] = 1800 + rng.uniform(0, 5, (30, 30))
    unlit = np.zeros(target.shape)
    unlit[5:10, 5:35], target[5:10, 5:35] = target[5:10, 5:35], 0
    answer = np.where(
        target + unlit > 0, target + unlit + 200 + rng.normal(0, 30, target.shape), 0.0
    )
    single = np.zeros(target.shape)
    for pixels in (target > 0, unlit > 0):
        best = np.unravel_index(
            np.where(pixels, np.abs(answer - target - unlit), np.inf).argmin(), target.shape
        )
        single[best] = answer[best]
    whole, few = (
        score_sample(values, target, void=unlit > 0, unlit_mm=unlit, charge_mm=300.0).metrics()
        for values in (answer, single)
    )
    higher = {key for key, metric in METRICS.items() if metric.better == "higher"}
    better = {
        key
        for key in METRICS
        if (few[key] > whole[key] if key in higher else abs(few[key]) < abs(whole[key]))
    }
    helped = {key for key, metric in METRICS.items() if metric.helped_by_missing}
    assert better <= helped and "object_valid_mae_mm" in better and "unlit_valid_mae_mm" in better
    assert {"object_shift_free_mae_mm", "object_valid_bias_mm"} <= better
    assert few["object_mae_range_share"] == pytest.approx(
        few["object_mae_mm"] / np.ptp(target[target > 0]), rel=1e-12
    )
