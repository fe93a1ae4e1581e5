"""Scores of a stated uncertainty: against an independent computation in extended precision, and on
known predictors."""

import numpy as np
import pytest
from conftest import fpp_eval, printed
from scored_dataset import change_json, make_dataset, write_description

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import NOMINAL
from fpp_ml_bench.evaluation.report.report_page import write_report
from fpp_ml_bench.evaluation.result.file import read_result, write_result
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.score.sample_scores import score_sigma
from fpp_ml_bench.evaluation.score.verification import Verified, differences


def gaussian(stated=1.0, pixels=(300, 400)):
    """A target, and a prediction whose errors are Gaussian with the sigma that it states, times
    ``stated``."""
    rng = np.random.default_rng(5)
    target, sigma = np.full(pixels, 1800.0), rng.uniform(0.5, 4.0, pixels)
    return target + sigma * rng.normal(size=pixels), target, stated * sigma


def test_a_calibrated_predictor_gets_its_nominal_coverage_and_a_lying_one_does_not():
    honest, lying = score_sigma(*gaussian()), score_sigma(*gaussian(0.25))
    assert honest.observed == pytest.approx(NOMINAL, abs=0.005)
    assert lying.scores["coverage_68"] < 0.25 and lying.scores["coverage_95"] < 0.45
    assert lying.scores["nll"] > honest.scores["nll"] + 1
    # Sparsification asks for the order of the sigmas only, and the lie does not change it.
    assert lying.scores["ause_mae_mm"] == pytest.approx(honest.scores["ause_mae_mm"], rel=1e-12)
    assert (
        0
        < honest.scores["ause_mae_mm"]
        < score_sigma(*gaussian()[:2], np.ones((300, 400))).scores["ause_mae_mm"]
    )
    assert honest.scores["sure_rmse_mm"] < honest.curves["rmse_mm"][0]


def test_nothing_stated_and_no_object_have_no_score():
    prediction, target, sigma = gaussian(pixels=(20, 20))
    silent = score_sigma(prediction, target, 0 * sigma)
    assert (
        silent.observed is None
        and silent.scores["coverage_68"] is None
        and silent.scores["unstated_share"] == 1.0
    )
    assert (
        score_sigma(0 * prediction, target, sigma).scores["unstated_share"] == 1.0
    )  # no depth, so nothing is stated
    assert {*score_sigma(prediction, 0 * target, sigma).scores.values()} == {None}


@pytest.fixture(scope="module")
def scored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scored")
    dataset, predictions = make_dataset(folder / "data"), folder / "p"
    predictions.mkdir()
    for number, sample in enumerate(dataset.samples("test")):
        rng, depth = np.random.default_rng(number), dataset.depth_mm(sample)
        sigma = rng.uniform(0.5, 4, depth.shape).astype(np.float32)
        np.save(
            predictions / f"{sample}.npy",
            np.where(depth > 0, depth + sigma * rng.normal(size=depth.shape), 0.0),
        )
        np.save(predictions / f"{sample}.sigma.npy", sigma)
    write_description(predictions)
    return dataset, predictions, evaluate(predictions, dataset)


@pytest.mark.long
def test_the_block_is_written_read_verified_and_shown(scored, tmp_path):
    dataset, predictions, result = scored
    block = result.uncertainty
    views = [block.per_sample[f"power_drill_{view}"].coverage_68 for view in ("A0", "A60")]
    assert block.per_object["power_drill"].coverage_68 == pytest.approx(np.mean(views), rel=1e-12)
    write_result(result, tmp_path / "r.json")
    assert read_result(tmp_path / "r.json") == result
    assert fpp_eval("verify", tmp_path / "r.json", predictions, dataset.path) == 0
    assert "Stated uncertainty" in printed(fpp_eval, predictions, dataset.path)
    page = write_report(result, dataset, predictions, tmp_path / "report").read_text()
    assert "reliability and sparsification" in page and "Stated uncertainty" in page


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("metrics.coverage_68", 0.68, r"metrics\.coverage_68 does not follow"),
        ("per_sample.power_drill_A0.coverage_99", 0.1, "a wider interval holds less"),
        ("reliability.observed.6", 0.68, "reliability at 68% does not follow"),
        (
            "reliability.nominal.6",
            0.69,
            r"reliability\.nominal\.6 does not follow from per_sample: 0\.69, not 0\.68",
        ),
        ("sparsification.mae_mm.0", 0.0, r"sparsification\.mae_mm\.0 does not follow"),
        ("sparsification.rmse_mm.5", 0.0, r"metrics\.ause_rmse_mm does not follow"),
        ("sparsification", None, "sparsification must be there"),
        ("per_object", {}, "other objects than per_sample"),
    ],
)
def test_an_edited_block_contradicts_itself(path, value, message, scored, tmp_path):
    file = tmp_path / "r.json"
    write_result(scored[2], file)
    change_json(file, f"uncertainty.{path}", value)
    with pytest.raises(SubmissionError, match=message):
        read_result(file)


def test_a_result_that_hides_or_improves_its_uncertainty_is_not_verified(scored):
    dataset, predictions, result = scored
    hidden = result.model_copy(update={"uncertainty": None})
    assert differences(hidden, predictions, dataset) == Verified(
        ["uncertainty: there is none in the result, there is one recomputed"], False
    )
    better = {**result.uncertainty.per_sample}
    better["power_drill_A0"] = better["power_drill_A0"].model_copy(update={"nll": 0.0})
    block = result.uncertainty.model_copy(update={"per_sample": better})
    changed = result.model_copy(update={"uncertainty": block})
    found = differences(changed, predictions, dataset)
    assert len(found.lines) == 1 and not found.processors
