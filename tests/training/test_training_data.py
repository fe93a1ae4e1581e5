"""Weights say which benchmark they were trained on, and a mismatch with the dataset at hand is one
sentence."""

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
from conftest import fpp_bench
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from scored_dataset import name_benchmarks
from tiny_network import config_of, tiny_network

from fpp_ml_bench.baselines.learned.network import FringeNet, load_net
from fpp_ml_bench.baselines.training import weights as training_data
from fpp_ml_bench.baselines.training.depth_training import model_config
from fpp_ml_bench.baselines.training.recipe import load_recipe
from fpp_ml_bench.baselines.training.weights import (
    FRINGE_NETWORKS,
    SHIPPED,
    NetConfig,
    TrainingBenchmark,
    open_weights,
    save_weights,
    shipped_names,
    training_benchmark,
    training_data_warning,
)
from fpp_ml_bench.loaders.storage import benchmark
from fpp_ml_bench.loaders.storage.benchmark import Benchmark

OLD = "a" * 64
NET_OPTIONS = {"widths": [8, 12], "fine": 8}


@pytest.fixture
def benchmarks(monkeypatch, opened, tmp_path):
    """The tiny dataset as version 1 of a benchmark ``tiny``, and a second benchmark."""
    name_benchmarks(monkeypatch, tmp_path / "facts", (Benchmark("tiny", 1, "mini", 176), opened))
    named = (*benchmark.BENCHMARKS, Benchmark("large", 0, "full", 960))
    monkeypatch.setattr(benchmark, "BENCHMARKS", named)
    return named


def save_fringe_net(path, **changes):
    content = {
        "name": "mine",
        "title": "Small",
        "options": NET_OPTIONS,
        "dataset_fingerprint": "0" * 64,
        "recipe": {},
    }
    config = NetConfig(**{**content, **changes})
    save_weights(path, FringeNet(**NET_OPTIONS), config, family=FRINGE_NETWORKS)


def test_a_new_weights_file_names_its_benchmark(benchmarks, opened, tmp_path):
    recipe = load_recipe("loss/l1", "small")
    network = tiny_network()
    other = SimpleNamespace(fingerprint=OLD, content={**opened.content, "test/depth": "0" * 32})
    for data, expected in ((opened, TrainingBenchmark("tiny", 1)), (other, None)):
        config = replace(model_config(recipe, network, data, 1, {}), image_size=(32, 48))
        assert config.benchmark == expected
        path = tmp_path / "net.safetensors"
        save_weights(path, network, config)
        assert open_weights(path).config.benchmark == expected
        save_fringe_net(path, benchmark=training_benchmark(data.content))
        assert load_net(path).config.benchmark == expected


def test_a_file_without_the_entry_is_read(tmp_path):
    """A shipped network names the version that it was trained on; an older file says nothing."""
    named = {
        open_weights(SHIPPED / f"{name}.safetensors").config.benchmark for name in shipped_names()
    }
    assert named == {TrainingBenchmark("fpp-bench-full-224", 2)}
    assert load_net("fringe-net-42").config.benchmark == TrainingBenchmark("fringe-net views", 1)
    path = tmp_path / "net.safetensors"
    save_fringe_net(path, benchmark=TrainingBenchmark("tiny", 1))
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    config = json.loads(metadata["config"])
    del config["benchmark"]
    save_file(load_file(path), path, metadata | {"config": json.dumps(config)})
    assert load_net(path).config.benchmark is None


@pytest.mark.parametrize(
    "fingerprint, trained_on, words",
    [
        ("same", TrainingBenchmark("tiny", 0), None),
        (
            OLD,
            None,
            "trained on dataset aaaaaaaa, which is no benchmark of this version; predicting on "
            "tiny version 1",
        ),
        (
            OLD,
            TrainingBenchmark("tiny", 0),
            "trained on tiny version 0; predicting on tiny version 1",
        ),
        (OLD, TrainingBenchmark("large", 7), None),
    ],
)
def test_what_is_said_on_a_named_benchmark(benchmarks, opened, fingerprint, trained_on, words):
    fingerprint = opened.fingerprint if fingerprint == "same" else fingerprint
    config = config_of(tiny_network(), dataset_fingerprint=fingerprint, benchmark=trained_on)
    assert training_data_warning(config, opened.manifest) == words


def test_other_bytes_of_a_benchmarks_settings_are_said(benchmarks, opened, monkeypatch):
    """A dataset that was built with a benchmark's settings, and differs from it: on another
    processor, say."""
    manifest = replace(opened.manifest, content={**opened.content, "test/depth": "0" * 32})
    monkeypatch.setattr(training_data, "intended_benchmark", lambda manifest: benchmarks[0])
    config = config_of(
        tiny_network(), dataset_fingerprint="d" * 64, benchmark=TrainingBenchmark("tiny", 1)
    )
    dataset = (
        f"dataset {manifest.fingerprint[:8]}, which has the settings of tiny version 1 but other "
        f"content"
    )
    assert (
        training_data_warning(config, manifest)
        == f"trained on tiny version 1; predicting on {dataset}"
    )


def test_nothing_is_said_on_data_of_the_users_own(opened):
    config = config_of(tiny_network(), dataset_fingerprint=OLD)
    assert training_data_warning(config, replace(opened.manifest, origin="imported")) is None


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "method"),
    [("predict", "network"), ("time", "fringe-net"), ("predict", "classical")],
)
def test_the_commands_warn_once_and_go_on(
    benchmarks, opened, tiny, tmp_path, capsys, command, method
):
    options = (
        ["--out", tmp_path / "predictions"]
        if command == "predict"
        else ["--repeats", 1, "--batch", 1]
    )
    if method == "network":
        config = config_of(
            tiny_network(),
            normalisation="global",
            image_size=opened.size,
            dataset_fingerprint=OLD,
            name="mine",
        )
        save_weights(tmp_path / "mine.safetensors", tiny_network(), config)
        method = tmp_path / "mine.safetensors"
    if method == "fringe-net":
        save_fringe_net(tmp_path / "net.safetensors", dataset_fingerprint=OLD)
        options += ["--weights", tmp_path / "net.safetensors"]
    assert fpp_bench(*[str(argument) for argument in (command, method, tiny, *options)]) == 0
    warnings = [
        line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")
    ]
    name = None if method == "classical" else "mine"
    expected = (
        "was trained on dataset aaaaaaaa, which is no benchmark of this version; predicting on "
        "tiny version 1"
    )
    assert warnings == ([] if name is None else [f"warning: {name} {expected}"])
