"""The scores of one sample against closed forms, and the edge band against OpenCV."""

import math

import numpy as np
import pytest
from scored_dataset import disk_depth

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.score import sample_scores
from fpp_ml_bench.evaluation.score.sample_scores import EMPTY, ErrorStats, combine, score_sample


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
