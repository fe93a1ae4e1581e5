"""The optional uncertainty of a submission: accepted whole, refused with a sentence otherwise, and no score moves."""

import numpy as np
import pytest
from scored_dataset import make_dataset, write_predictions

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.score.evaluator import evaluate

FIRST = "power_drill_A0.sigma.npy"


@pytest.fixture
def dataset(tmp_path):
    return make_dataset(tmp_path / "data")


@pytest.fixture
def predictions(tmp_path, dataset):
    return write_predictions(tmp_path / "predictions", dataset, offset_mm=2.0)


def state(folder, dataset, value=1.5, dtype=np.float32, size=(32, 40)):
    for sample in dataset.samples("test"):
        np.save(folder / f"{sample}.sigma.npy", np.full(size, value, dtype=dtype))


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
        (lambda file: np.save(file, np.full((32, 40), np.nan, np.float32)), "expected finite mm of 0 and more"),
        (lambda file: np.save(file, np.full((32, 40), -1, np.float32)), "expected finite mm of 0 and more"),
        (lambda file: np.save(file, np.full((32, 40), np.inf)), "expected finite mm of 0 and more"),
        (lambda file: np.save(file, np.ones((40, 32), np.float32)), "expected shape"),
        (lambda file: np.save(file, np.ones((32, 40), np.int16)), "expected float16, float32 or float64"),
        (lambda file: file.write_bytes(file.read_bytes()[:-4]), "is truncated"),
        (lambda file: file.write_bytes(b"no array"), "is no .npy file"),
    ],
)
def test_a_bad_sigma_is_refused_and_named(dataset, predictions, change, said):
    state(predictions, dataset)
    change(predictions / FIRST)
    with pytest.raises(PredictionError) as caught:
        evaluate(predictions, dataset)
    text = "\n".join(
        [str(caught.value), *caught.value.__notes__] if hasattr(caught.value, "__notes__") else [str(caught.value)]
    )
    assert FIRST in text and said in text
