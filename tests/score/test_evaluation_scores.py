"""The scores of one sample against closed forms, and the edge band against OpenCV."""

import math
import statistics

import numpy as np
import pytest
from edges import edge_distance_px
from hypothesis import given, settings
from hypothesis import strategies as st
from scored_dataset import disk_depth

from fpp_ml_bench.depth import object_near_edge
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.metrics import METRICS
from fpp_ml_bench.evaluation.result.model import over_samples, pooled
from fpp_ml_bench.evaluation.score import sample_scores
from fpp_ml_bench.evaluation.score.sample_scores import EMPTY, ErrorStats, combine, score_sample

WITHIN = [key for key in METRICS if "_within_" in key]


def test_unequal_magnitudes_are_not_lost():
    """A background of tiny errors beside an object of huge ones: float32, or overall minus object,
    would lose it."""
    target = disk_depth((64, 64), 3).astype(np.float64)
    computed = score_sample(np.where(target > 0, target + 1e12, 1e-6), target).metrics()
    assert computed["background_mae_mm"] == pytest.approx(1e-6, rel=1e-14)
    assert computed["object_mae_mm"] == pytest.approx(1e12, rel=1e-14)


def test_block_borders_and_empty_blocks(monkeypatch):
    target = disk_depth((48, 52), 5)
    prediction = target + np.random.default_rng(0).normal(0, 2, target.shape)
    expected = score_sample(prediction, target).metrics()
    for block in (1, 7, 52, 1000):
        monkeypatch.setattr(sample_scores, "BLOCK", block)
        blocked = score_sample(prediction, target).metrics()
        for key, value in expected.items():
            assert blocked[key] == (
                value if value is None else pytest.approx(value, rel=1e-12, abs=1e-13)
            ), key


def test_closed_forms_of_a_shift_and_of_nothing():
    target = disk_depth((120, 140), 2)
    shifted = score_sample(target.astype(np.float64) + 2.5, target).metrics()
    assert shifted.pop("object_shift_free_mae_mm") == 0.0
    assert {value for key, value in shifted.items() if key.endswith("_mm")} == {2.5}
    assert [shifted[key] for key in WITHIN] == [0.0, 0.0, 1.0, 1.0]
    empty = score_sample(np.zeros_like(target), target)
    inside = target[target > 0].astype(np.float64)
    assert empty.object.mae_mm == pytest.approx(inside.mean(), rel=1e-14)
    assert empty.background == ErrorStats(empty.background.pixels, 0.0, 0.0)
    assert empty.missing == inside.size and empty.valid == EMPTY
    assert empty.metrics()["object_missing_share"] == 1.0
    assert empty.metrics()["object_valid_mae_mm"] is None


def test_missing_pixels_are_counted_and_left_out_of_the_valid_score_only():
    target = np.full((4, 5), 1800.0)
    prediction = target + 1.0
    prediction[0] = 0.0
    prediction[1, 0] = -3.0
    s = score_sample(prediction, target)
    assert s.missing == 6
    assert s.metrics()["object_missing_share"] == 0.3
    assert s.valid == ErrorStats(14, 1.0, 1.0)
    assert s.object.mae_mm == pytest.approx((5 * 1800 + 1803 + 14) / 20, rel=1e-15)
    assert s.object.rmse_mm == pytest.approx(
        math.sqrt((5 * 1800**2 + 1803**2 + 14) / 20), rel=1e-15
    )


@given(st.integers(1, 30), st.integers(1, 30), st.integers(0, 40), st.integers(0, 2**32 - 1))
@settings(max_examples=150, deadline=None)
def test_edge_band_is_the_distance_rule(height, width, band, seed):
    """The dilation must give the very pixels of OpenCV's exact Euclidean distance transform."""
    rng = np.random.default_rng(seed)
    depth = np.where(
        rng.random((height, width)) < 0.9, 1800.0 + 300.0 * (rng.random((height, width)) < 0.1), 0.0
    )
    assert np.array_equal(
        object_near_edge(depth, band), (edge_distance_px(depth) < band) & (depth > 0)
    )


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
@pytest.mark.parametrize("inside", [True, False])
def test_errors_that_are_not_finite_never_become_a_score(bad, inside):
    target = disk_depth((20, 20), 0)
    prediction = target.astype(np.float64)
    row, column = np.argwhere((target > 0) == inside)[0]
    prediction[row, column] = bad
    with pytest.raises(PredictionError, match="finite"):
        score_sample(prediction, target)
    with pytest.raises(PredictionError, match="finite"):
        score_sample(
            target, np.where(target > 0, np.inf, target) if math.isinf(bad) else target * np.nan
        )


def test_wrong_arguments_are_named():
    target = np.zeros((4, 5), np.float32)
    with pytest.raises(PredictionError, match=r"\(4, 5\) \(H, W\), got \(5, 4\)"):
        score_sample(target.T, target)
    with pytest.raises(PredictionError, match="got int64"):
        score_sample(target.astype(np.int64), target)
    with pytest.raises(PredictionError, match="complex"):
        score_sample(target.astype(complex), target)


def test_combine_is_the_union():
    rng = np.random.default_rng(4)
    parts = [rng.normal(0, 10.0**k, 50 + k) for k in range(4)]
    stats = [
        ErrorStats(p.size, float(np.abs(p).mean()), float(np.sqrt((p**2).mean()))) for p in parts
    ]
    union = np.concatenate(parts).astype(np.longdouble)
    combined = combine(*stats, EMPTY)
    assert combined.pixels == union.size
    assert combined.mae_mm == pytest.approx(float(np.abs(union).mean()), rel=1e-14)
    assert combined.rmse_mm == pytest.approx(float(np.sqrt((union**2).mean())), rel=1e-14)
    assert combine(EMPTY, EMPTY) == EMPTY


def test_averages_over_samples_and_pixels_differ_as_documented():
    """Two samples of unequal object size: the mean counts samples alike, pooling counts pixels
    alike."""
    small, large = np.zeros((10, 10)), np.zeros((10, 10))
    small[:1] = 1800.0  # 10 px, error 4
    large[:9] = 1800.0  # 90 px, error 1
    samples = [
        score_sample(small + 4 * (small > 0), small),
        score_sample(large + 1 * (large > 0), large),
    ]
    without_object = score_sample(np.ones((10, 10)), np.zeros((10, 10)))
    rows = [s.metrics() for s in (*samples, without_object)]
    inside, outside = (
        combine(*(getattr(s, pixels) for s in samples)) for pixels in ("object", "background")
    )
    pool = pooled(inside, combine(outside, without_object.background))
    assert over_samples(rows)["object_mae_mm"] == 2.5
    assert over_samples(rows, statistics.median)["object_mae_mm"] == 2.5
    assert pool["object_mae_mm"] == pytest.approx((10 * 4 + 90 * 1) / 100, rel=1e-15)
    assert pool["object_rmse_mm"] == pytest.approx(math.sqrt((10 * 16 + 90) / 100), rel=1e-15)
    assert over_samples(rows)["background_mae_mm"] == pytest.approx(1 / 3, rel=1e-15)
    assert over_samples([without_object.metrics()])["object_mae_mm"] is None


@pytest.mark.parametrize("scale", [1e-160, 1e-300, 5e-324])
def test_errors_whose_squares_vanish_have_an_rmse_all_the_same(scale):
    errors = scale * np.arange(1, 101, dtype=np.float64).reshape(10, 10)
    target = np.zeros((10, 10))
    target[:5] = 256 * scale
    scores = score_sample(target + errors, target)
    sets = ((scores.overall, errors), (scores.object, errors[:5]), (scores.background, errors[5:]))
    for stats, part in sets:
        ratio = float(np.sqrt(np.mean((part / part.max()) ** 2)) * part.max())
        assert stats.rmse_mm == pytest.approx(ratio, rel=1e-12, abs=5e-324)
        assert stats.rmse_mm > 0
