"""The optional uncertainty of a submission: accepted whole, refused with a sentence otherwise, and
no score moves."""

import re

import numpy as np
import pytest
from scored_dataset import write_predictions

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.score.evaluator import evaluate

FIRST = "power_drill_A0.sigma.npy"


@pytest.fixture
def predictions(tmp_path, dataset):
    return write_predictions(tmp_path / "predictions", dataset, offset_mm=2.0)


def state(folder, dataset):
    for sample in dataset.samples("test"):
        np.save(folder / f"{sample}.sigma.npy", np.full((32, 40), 1.5, np.float32))


def test_a_stated_sigma_moves_no_score(dataset, predictions):
    before = evaluate(predictions, dataset)
    state(predictions, dataset)
    assert evaluate(predictions, dataset).metrics == before.metrics


def test_one_of_another_sample_is_extra(dataset, predictions):
    state(predictions, dataset)
    np.save(predictions / "mug_A0.sigma.npy", np.zeros((32, 40), dtype=np.float32))
    with pytest.raises(PredictionError, match=r"mug_A0\.sigma\.npy: is extra"):
        evaluate(predictions, dataset)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda file: file.unlink(), "is missing; write one for each sample, or none"),
        (
            lambda file: np.save(file, np.full((32, 40), np.nan, np.float32)),
            "expected finite mm of 0 and more",
        ),
        (
            lambda file: np.save(file, np.full((32, 40), -1, np.float32)),
            "expected finite mm of 0 and more",
        ),
        (lambda file: file.write_bytes(file.read_bytes()[:-4]), "is truncated"),
    ],
)
def test_a_bad_sigma_is_refused_and_named(dataset, predictions, change, said):
    state(predictions, dataset)
    change(predictions / FIRST)
    with pytest.raises(PredictionError, match=f"{re.escape(FIRST)}: .*{said}"):
        evaluate(predictions, dataset)
