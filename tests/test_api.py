"""The front door: its examples run as they are written, on a small dataset in the place of ``data/mini``."""

import doctest

import numpy as np
import pytest
from conftest import TINY_SIZE

import fpp_ml_bench
from fpp_ml_bench import api
from fpp_ml_bench.cli import main
from fpp_ml_bench.errors import FppBenchError


@pytest.fixture
def folder(tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "mini").symlink_to(tiny)
    assert main(["predict", "classical", "data/mini", "--out", "predictions"]) == 0
    return tmp_path


def test_the_examples_run(folder):
    done = doctest.testmod(api)
    assert done.failed == 0 and done.attempted >= 15


def test_the_front_door_is_the_whole_front_door():
    assert sorted(api.__all__) == sorted(fpp_ml_bench.__all__)


def test_a_result_file_does_as_well_as_a_result(folder):
    dataset = fpp_ml_bench.open_dataset("data/mini")
    assert dataset.size == (TINY_SIZE, TINY_SIZE)
    result = fpp_ml_bench.evaluate("predictions", dataset)
    (folder / "result.json").write_text(result.model_dump_json())
    assert fpp_ml_bench.compare("result.json", result).differences["object_mae_mm"].mean_mm == 0
    with pytest.raises(FppBenchError, match=r"no\.json"):
        fpp_ml_bench.rank(["no.json"])


@pytest.mark.parametrize("method", ["phase", "crossed", "classical"])
def test_frames_as_datasets_gives_them_are_decoded_alike(method, tiny):
    """``with_format("numpy")`` turns uint8 columns into int64."""
    dataset = fpp_ml_bench.open_dataset(tiny)
    row = fpp_ml_bench.load_dataset(tiny, "all", split="test").with_format("numpy")[0]
    frames = [row[frame.column] for frame in dataset.sequence.frames]
    assert frames[0].dtype == np.int64
    predict = fpp_ml_bench.load_method(method, dataset).predict
    assert np.array_equal(predict(frames), predict(dataset.frames(row["sample"], range(52))))
    with pytest.raises(FppBenchError, match="int64"):
        predict([frame * 300 for frame in frames])


def test_columns_as_datasets_gives_them_are_scored(tiny):
    rows = fpp_ml_bench.load_dataset(tiny, "single_shot", split="test").with_format("numpy")[:2]
    scores = fpp_ml_bench.evaluate(rows["depth"], rows["depth_exact"], flags=rows["flags"])
    assert scores.metrics.void_share > 0
