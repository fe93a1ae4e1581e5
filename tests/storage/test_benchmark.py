"""A benchmark's name, version and bytes: what `build`, `verify` and `info` say of a dataset."""

import json
from dataclasses import replace
from itertools import product

import pytest
from conftest import fpp_bench, printed, tiny_settings

from fpp_ml_bench.constants import VIEWS
from fpp_ml_bench.loaders.render.builder import assembly_of, build
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.render.scene import preset_settings
from fpp_ml_bench.loaders.storage import benchmark as module
from fpp_ml_bench.loaders.storage.benchmark import (
    BENCHMARKS,
    FACTS,
    benchmark_of,
    benchmark_sentence,
    intended_benchmark,
    known_problem,
)


def test_names_and_contents_are_told_apart():
    assert len({b.title for b in BENCHMARKS}) == len(BENCHMARKS)
    assert BENCHMARKS[0].title == "fpp-bench-full version 2"
    for benchmark in BENCHMARKS:
        assert benchmark_of(benchmark.content).size == benchmark.size
        assert all(len(bytes.fromhex(digest)) == 16 for digest in benchmark.content.values())
        assert (FACTS / f"{benchmark.name}.json").stat().st_size < 50_000
    assert benchmark_of({}) is None and benchmark_of({"test/depth": "0" * 32}) is None


def test_the_facts_are_of_the_presets_objects():
    for benchmark in BENCHMARKS:
        settings = preset_settings(benchmark.preset, benchmark.size, benchmark.light, benchmark.rig)
        splits = {name.partition("/")[0] for name in benchmark.content}
        objects = [
            name for split in splits for name in benchmark.counts(split, "standard", "depth")
        ]
        assert sorted(objects) == sorted(settings.objects), benchmark.name
        for split, mode, target in product(splits, ("standard", "paper"), ("depth", "depth_exact")):
            for counts in benchmark.counts(split, mode, target).values():
                assert counts.samples == len(VIEWS) and counts.object_px > 0
                assert (counts.void_px > 0) == (mode == "standard")
                assert counts.object_px + counts.void_px < len(VIEWS) * benchmark.size**2
        assert benchmark.counts("all", "paper", "depth").keys() == set(objects)


def test_scenes_are_the_same_whatever_is_projected():
    """Exact depth and flags, and so void, follow from scene and light alone: one table for every
    code."""
    named = {benchmark.name: benchmark for benchmark in BENCHMARKS}
    for paper, crossed in (
        ("full", "crossed"),
        ("unseen", "crossed-unseen"),
        ("test-workshop", "test-crossed-workshop"),
        ("test-hard", "test-crossed-hard"),
    ):
        first, second = named[f"fpp-bench-{paper}"], named[f"fpp-bench-{crossed}"]
        truth = {
            key: digest
            for key, digest in first.content.items()
            if key in ("test/depth_exact", "test/flags")
        }
        assert len(truth) == 2 and truth.items() <= second.content.items()
        assert benchmark_of(truth).size == first.size
        assert first.counts("test", "standard", "depth_exact") == second.counts(
            "test", "standard", "depth_exact"
        )
        assert first.content["test/depth"] != second.content["test/depth"], (
            "decoded from other frames"
        )


def test_a_part_of_a_benchmark_is_that_benchmark():
    full = BENCHMARKS[0].content
    part = {
        name: digest
        for name, digest in full.items()
        if name in ("test/frame_00", "test/depth", "test/flags")
    }
    assert benchmark_of(part) is BENCHMARKS[0]
    assert benchmark_of({**part, "test/depth": "0" * 32}) is None


def test_a_result_of_other_objects_or_pixels_is_known_to_be_none():
    content = {
        name: digest
        for name, digest in BENCHMARKS[0].content.items()
        if name.startswith("test/depth")
    }
    counts = BENCHMARKS[0].counts("test", "standard", "depth")
    rules = content, "test", "depth", "standard"
    assert known_problem(*rules, counts) is None
    name, first = next(iter(counts.items()))
    for changed, said in (
        (
            {**counts, name: first._replace(samples=5)},
            f"has 6 samples of '{name}', this file says 5",
        ),
        ({**counts, name: first._replace(void_px=first.void_px + 1)}, "void pixels"),
        ({**counts, name: first._replace(object_px=1)}, "object pixels"),
        ({**counts, "ball": first}, "has no object 'ball'"),
        ({key: counts[key] for key in counts if key != name}, f"has the object '{name}'"),
    ):
        assert said in known_problem(*rules, changed)
    assert known_problem({"test/depth": "0" * 32}, *rules[1:], {}) is None, (
        "nothing is known of other data"
    )


@pytest.mark.parametrize("benchmark", BENCHMARKS, ids=lambda b: b.name)
def test_settings_of_a_benchmark_with_other_bytes_are_a_warning(benchmark):
    manifest = assembly_of(
        preset_settings(benchmark.preset, benchmark.size, benchmark.light, benchmark.rig)
    ).manifest  # no rows yet: other bytes
    assert intended_benchmark(manifest) is benchmark
    assert (
        intended_benchmark(
            replace(manifest, settings={**manifest.settings, "frames": "single_shot"})
        )
        is benchmark
    )
    as_expected, sentence = benchmark_sentence(manifest)
    assert not as_expected and benchmark.title in sentence


def test_settings_of_ones_own_are_no_benchmark():
    settings = preset_settings("mini")
    for other in (
        replace(settings, seed=1),
        replace(settings, light=named_light("workshop")),  # a light of the full set alone
    ):
        manifest = assembly_of(other).manifest
        assert intended_benchmark(manifest) is None
        as_expected, sentence = benchmark_sentence(manifest)
        assert as_expected and sentence.startswith("a dataset of its own")


@pytest.mark.long
def test_what_the_commands_say(tmp_path, capsys, monkeypatch):
    settings, folder = tiny_settings(objects=("cork",)), tmp_path / "data"
    manifest = build(folder, settings, workers=1)
    assert "benchmark: a dataset of its own" in printed(fpp_bench, "verify", folder)
    known = replace(BENCHMARKS[0], name="fpp-bench-tiny")
    monkeypatch.setattr(module, "BENCHMARKS", (known,))
    monkeypatch.setattr(module, "FACTS", tmp_path)
    (tmp_path / "fpp-bench-tiny.json").write_text(
        json.dumps({"content": manifest.content, "counts": {}})
    )
    monkeypatch.setattr(
        "fpp_ml_bench.loaders.render.scene.preset_settings",
        lambda preset, size, light, rig: settings,
    )
    assert "benchmark: this is fpp-bench-tiny version 2" in printed(fpp_bench, "verify", folder)
    content = json.loads(printed(fpp_bench, "info", folder, "--json -"))
    assert content["benchmark"] == {"name": "fpp-bench-tiny", "version": 2}
    monkeypatch.setattr(module, "BENCHMARKS", (replace(known, name="fpp-bench-other"),))
    assert "benchmark" not in printed(fpp_bench, "verify", folder)
    said = "warning: built with the settings of fpp-bench-other version 2, but not its content"
    assert said in capsys.readouterr().err
