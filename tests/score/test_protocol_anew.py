"""A whole evaluation against one in extended precision that shares no code with it, and the perfect
prediction."""

import numpy as np
import pytest
from extended_precision import sample_scores, sigma_scores
from scored_dataset import make_dataset, write_description

from fpp_ml_bench.evaluation.metrics import METRICS, UNCERTAINTY
from fpp_ml_bench.evaluation.score.evaluator import evaluate

SIZE = (48, 56)


def flagged(depth):
    """Every seventh row of the object unlit, every ninth column mixed, every 11th saturated, every
    8th row weakly lit, and a flag that is not void."""
    flags = np.full(depth.shape, 8, np.uint8)
    flags[::7][depth[::7] > 0] |= 1
    flags[:, ::9] |= 2
    flags[:, ::11] |= 4
    flags[::8][depth[::8] > 0] |= 16
    return flags


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return make_dataset(tmp_path_factory.mktemp("data") / "tiny", SIZE, flagged=flagged)


def maps_of(dataset, sample, target):
    """Target, void pixels and the depth of those lit too weakly (0 elsewhere, or without an exact
    target)."""
    depth, flags = dataset.depth_mm(sample), dataset.flags(sample)
    exact = dataset.depth_mm(sample, "depth_exact")
    if target == "depth":
        return depth, (flags & 3) > 0, np.zeros_like(exact)
    return exact, (flags & (1 | 2 | 4 | 16)) > 0, np.where((flags & (1 | 16)) > 0, exact, 0)


def write(folder, dataset):
    folder.mkdir()
    for number, sample in enumerate(dataset.samples("test")):
        rng, exact = np.random.default_rng(number), dataset.depth_mm(sample, "depth_exact")
        sigma = rng.choice([0.0, 0.5, 1.0, 3.0], SIZE)
        predicted = (exact + sigma * rng.normal(size=SIZE) + 300 * (rng.random(SIZE) < 0.02)) * (
            rng.random(SIZE) < 0.95
        )
        np.save(folder / f"{sample}.npy", predicted.astype(np.float32))
        np.save(folder / f"{sample}.sigma.npy", sigma.astype(np.float32))
    write_description(folder)
    return folder


def assert_close(computed, expected, keys):
    """Of signed means, which are small differences, fewer digits are left."""
    for key in keys:
        value, rounding = expected.get(key), 1e-9 if "bias" in key else 0
        close = value if value is None else pytest.approx(float(value), rel=1e-9, abs=rounding)
        assert getattr(computed, key) == close, key


def averages(rows, average):
    """The average over those of some rows that have a score."""
    scores = {
        key: [row[key] for row in rows if row.get(key) is not None] for key in METRICS | UNCERTAINTY
    }
    return {key: average(values) for key, values in scores.items() if values}


@pytest.mark.long
@pytest.mark.parametrize("target", ["depth", "depth_exact"])
def test_every_score_of_an_evaluation(target, dataset, tmp_path):
    folder = write(tmp_path / "p", dataset)
    result = evaluate(folder, dataset, target=target)
    rows, stated, errors = {}, {}, []
    for row in result.per_sample:
        predicted, sigma = (
            np.load(folder / f"{row.sample}{suffix}") for suffix in (".npy", ".sigma.npy")
        )
        true, void, unlit = maps_of(dataset, row.sample, target)
        rows[row.sample] = sample_scores(predicted, true, 3, void, unlit, 300)
        stated[row.sample] = sigma_scores(predicted, true, sigma, void, 300)
        errors += np.abs(predicted.astype(np.longdouble) - true)[(true > 0) & ~void].tolist()
        assert_close(row, rows[row.sample], METRICS)
        assert_close(result.uncertainty.per_sample[row.sample], stated[row.sample], UNCERTAINTY)
    assert_close(result.metrics, averages(rows.values(), np.mean), METRICS)
    assert_close(result.median, averages(rows.values(), np.median), METRICS)
    assert_close(result.pooled, {"object_mae_mm": np.mean(errors)}, ["object_mae_mm"])
    assert_close(result.uncertainty.metrics, averages(stated.values(), np.mean), UNCERTAINTY)
    for part in result.per_object:
        views = [sample for sample in rows if sample.startswith(part.object)]
        assert_close(part.metrics, averages([rows[view] for view in views], np.mean), METRICS)
        of_object = averages([stated[view] for view in views], np.mean)
        assert_close(result.uncertainty.per_object[part.object], of_object, UNCERTAINTY)


@pytest.mark.parametrize("target", ["depth", "depth_exact"])
@pytest.mark.parametrize("mode", ["standard", "paper"])
def test_the_perfect_prediction_scores_0(mode, target, dataset, tmp_path):
    folder = tmp_path / "p"
    folder.mkdir()
    for sample in dataset.samples("test"):
        true, _, _ = maps_of(dataset, sample, target)
        np.save(folder / f"{sample}.npy", true)
        np.save(folder / f"{sample}.sigma.npy", np.ones(SIZE))
    write_description(folder)
    result = evaluate(folder, dataset, target=target, mode=mode)
    if mode == "paper":  # which knows unlit pixels as background only
        assert result.metrics.object_rmse_mm == 0
        return
    for scores in (result.metrics, result.median, result.pooled, *result.per_sample):
        errors = {
            value
            for key, value in scores.model_dump().items()
            if key.endswith(("_mm", "invented_share"))
        }
        assert errors - {None} == {0.0}
    uncertainty = result.uncertainty.metrics.model_dump()
    assert {uncertainty[key] for key in UNCERTAINTY if key.startswith(("ause", "sure"))} == {0.0}
    assert uncertainty["coverage_68"] == 1.0
