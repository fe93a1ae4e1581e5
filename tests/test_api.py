"""The front door: its examples run as they are written, on a small dataset in the place of
``data/mini``."""

import ast
import doctest
import inspect
import operator
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import TINY_SIZE

import fpp_ml_bench
from fpp_ml_bench import api
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.cli import main
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.evaluation.result.file import write_result


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


def _section(function, title):
    """A section of a docstring: its lines, without their common indentation."""
    found = re.search(
        rf"^{title}\n-+\n(.*?)(?=\n\n\S|\Z)",
        inspect.getdoc(function),
        flags=re.DOTALL | re.MULTILINE,
    )
    return found[1]


@pytest.mark.parametrize("name", api.__all__)
def test_the_documented_parameters_are_those_of_the_function(name):
    function = getattr(api, name)
    lines = re.findall(
        r"^(\S[^:\n]*?)(?: : .*)?$", _section(function, "Parameters"), flags=re.MULTILINE
    )
    documented = [word.strip().lstrip("*") for line in lines for word in line.split(",")]
    assert documented == [*inspect.signature(function).parameters]


def test_what_the_docstrings_say_of_the_results_is_there(folder):
    """Names in double quotes of each section Returns: attributes, methods, keys and columns."""
    dataset = fpp_ml_bench.open_dataset("data/mini")
    rows = fpp_ml_bench.load_dataset("data/mini", "all", split="test")
    scored = fpp_ml_bench.evaluate("predictions", dataset)
    write_result(scored, Path("result.json"))
    returned = {
        "load_dataset": SimpleNamespace(**dict.fromkeys(rows.column_names), frame_NN=None),
        "open_dataset": dataset,
        "load_method": fpp_ml_bench.load_method("phase", dataset),
        "decode": fpp_ml_bench.decode(
            dataset.frames(dataset.samples("test")[0], range(52)), dataset.rig
        ),
        "evaluate": scored,
        "compare": fpp_ml_bench.compare("result.json", scored),
        "rank": fpp_ml_bench.rank(["result.json"])[0],
    }
    assert sorted(returned) == sorted(api.__all__)
    for name, value in returned.items():
        said = re.findall(
            r"``([\w.]+)(?:[(\[]\w+(?:, \w+)*[)\]])?``", _section(getattr(api, name), "Returns")
        )
        assert len(said) >= 1
        for path in set(said) - {"result.json"}:
            assert operator.attrgetter(path)(value) is not None or name == "load_dataset", path


def test_the_documented_options_of_methods_exist(tiny):
    """Each ``key=value`` that is named for a method is accepted by it."""
    dataset = fpp_ml_bench.open_dataset(tiny)
    parameters = _section(api.load_method, "Parameters")
    options = re.findall(r"``(\w+)=([^`]*)``", parameters)
    assert len(options) >= 4
    names = {"networks": "unet-individual-rmse"}
    for key, value in options:
        methods = re.search(rf"``{key}={re.escape(value)}`` \(([^;)]*)", parameters)[1]
        methods = {"both": "classical, phase"}.get(methods, methods)
        for method in methods.split(", "):
            source = (
                dataset.rig if method in names else dataset
            )  # a network is for datasets of its own image size
            loaded = load_method(
                names.get(method, method), source, **{key: ast.literal_eval(value)}
            )
            told = len(loaded.frames_used) if key == "frames" else loaded.settings[key]
            assert told == ast.literal_eval(value)


def test_the_front_door_is_the_whole_front_door():
    assert sorted([*api.__all__, "Method"]) == sorted(fpp_ml_bench.__all__)


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


@pytest.mark.parametrize("method", ["classical", "phase", "crossed", "constant", "nearest"])
def test_an_unknown_option_is_refused_by_name(method, tiny):
    with pytest.raises(FppBenchError, match=r"fringe_colour"):
        fpp_ml_bench.load_method(method, fpp_ml_bench.open_dataset(tiny), fringe_colour="green")
