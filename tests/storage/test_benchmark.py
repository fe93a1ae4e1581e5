"""A benchmark's name, version and bytes: what `build`, `verify` and `info` say of a dataset."""

import json
from dataclasses import replace

import pytest
from conftest import tiny_settings

from fpp_ml_bench.cli import main
from fpp_ml_bench.loaders.render import assembly_of, build, named_light, preset_settings
from fpp_ml_bench.loaders.storage import benchmark as module
from fpp_ml_bench.loaders.storage.benchmark import (
    BENCHMARKS,
    EARLIER,
    benchmark_of,
    benchmark_sentence,
    intended_benchmark,
)


def test_names_and_fingerprints_are_told_apart():
    known = (*BENCHMARKS, *EARLIER)
    assert len({(b.name, b.version) for b in known}) == len({b.fingerprint for b in known}) == len(known)
    assert len({b.name for b in BENCHMARKS}) == len(BENCHMARKS)
    for benchmark in known:
        assert len(bytes.fromhex(benchmark.fingerprint)) == 32
        assert benchmark_of(benchmark.fingerprint) is benchmark
    assert benchmark_of("0" * 64) is None
    assert BENCHMARKS[0].title == "fpp-bench-full version 1"


@pytest.mark.parametrize("benchmark", BENCHMARKS, ids=lambda b: b.name)
def test_settings_of_a_benchmark_with_other_bytes_are_a_warning(benchmark):
    manifest = assembly_of(
        preset_settings(benchmark.preset, benchmark.size, benchmark.light, benchmark.rig)
    ).manifest  # no rows yet: other bytes
    assert intended_benchmark(manifest) is benchmark
    as_expected, sentence = benchmark_sentence(manifest)
    assert not as_expected
    assert benchmark.title in sentence and manifest.fingerprint[:8] in sentence


def test_settings_of_ones_own_are_no_benchmark():
    settings = preset_settings("mini")
    for other in (
        replace(settings, seed=1),
        replace(settings, light=named_light("workshop")),  # a light of the full set alone
        replace(settings, stored="single_shot"),
    ):
        manifest = assembly_of(other).manifest
        assert intended_benchmark(manifest) is None
        as_expected, sentence = benchmark_sentence(manifest)
        assert as_expected and sentence.startswith("a dataset of its own")


def test_what_the_commands_say(tmp_path, capsys, monkeypatch):
    settings = tiny_settings(objects=("cork",))
    manifest = build(tmp_path / "data", settings, workers=1)
    assert main(["verify", str(tmp_path / "data")]) == 0
    assert "benchmark: a dataset of its own" in capsys.readouterr().out
    known = replace(BENCHMARKS[0], name="fpp-bench-tiny", fingerprint=manifest.fingerprint)
    monkeypatch.setattr(module, "BENCHMARKS", (known,))
    monkeypatch.setattr(module.render, "preset_settings", lambda preset, size, light, rig: settings)
    assert main(["verify", str(tmp_path / "data")]) == 0
    assert "benchmark: this is fpp-bench-tiny version 1" in capsys.readouterr().out
    assert main(["info", str(tmp_path / "data"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["benchmark"] == {"name": "fpp-bench-tiny", "version": 1}
    monkeypatch.setattr(module, "BENCHMARKS", (replace(known, fingerprint="ab" * 32),))
    assert main(["verify", str(tmp_path / "data")]) == 0
    output = capsys.readouterr()
    assert "warning: built with the settings of fpp-bench-tiny version 1, but not its bytes" in output.err
    assert "benchmark" not in output.out
