"""The front door: its examples run as they are written, on a small dataset in the place of ``data/mini``."""

import doctest

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
