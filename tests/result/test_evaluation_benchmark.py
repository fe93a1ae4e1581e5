"""The benchmark's name and version in results: written, read, refused where they contradict the
data, compared."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from board_rows import write_result_file
from conftest import fpp_eval, read_json, refusal, tiny_settings
from scored_dataset import make_dataset, name_benchmarks, write_predictions

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.result import model
from fpp_ml_bench.evaluation.result.file import read_result, result_json, write_result
from fpp_ml_bench.evaluation.result.model import Result, derived
from fpp_ml_bench.evaluation.result.parts import SampleResult
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.score.sample_scores import ErrorStats, combine
from fpp_ml_bench.loaders.render.builder import build
from fpp_ml_bench.loaders.sample import column_hash, image_hash
from fpp_ml_bench.loaders.storage import benchmark as benchmarks
from fpp_ml_bench.loaders.storage.benchmark import Benchmark
from fpp_ml_bench.loaders.storage.store import DatasetFolder

OTHER = {"test/depth": "e" * 32, "test/flags": "e" * 32}


@pytest.fixture
def named(dataset, tmp_path, monkeypatch):
    """The dataset as ``tiny-bench`` version 4, beside a benchmark of other content."""
    other = make_dataset(tmp_path / "other", size=(40, 32))
    known = (
        (Benchmark("tiny-bench", 4, "mini", 32), dataset),
        (Benchmark("other-bench", 1, "full", 64), other),
    )
    name_benchmarks(monkeypatch, tmp_path / "facts", *known)
    return dataset


def scored_file(dataset, folder, name="p"):
    """A result of predictions with noise."""
    return write_result_file(folder / f"{name}.json", dataset, 0.0, 2.0)


def change_dataset(path, **changes):
    """Change keys of the file's dataset block; ``None`` removes a key."""
    content = read_json(path)
    for key, value in changes.items():
        content["dataset"][key] = value
        if value is None:
            del content["dataset"][key]
    path.write_text(json.dumps(content))


@pytest.mark.long
def test_a_result_on_a_benchmark_says_its_name_and_version(named, tmp_path, capsys):
    path = scored_file(named, tmp_path)
    assert read_json(path)["dataset"]["benchmark"] == {"name": "tiny-bench", "version": 4}
    assert result_json(read_result(path)) == path.read_bytes()
    command = [
        str(tmp_path / "p-predictions"),
        str(named.path),
        "--report",
        str(tmp_path / "report"),
    ]
    assert fpp_eval(*command) == 0
    printed = capsys.readouterr()
    truth = read_result(path).dataset.truth
    assert f"(tiny-bench version 4, content {truth[:8]})" in printed.out and printed.err == ""
    assert "tiny-bench version 4" in (tmp_path / "report" / "index.html").read_text()
    assert fpp_eval("verify", path, tmp_path / "p-predictions", named.path) == 0


def test_a_result_on_any_other_dataset_has_no_such_key(dataset, tmp_path, capsys):
    path = scored_file(dataset, tmp_path)
    assert "benchmark" not in read_json(path)["dataset"]
    assert fpp_eval(tmp_path / "p-predictions", dataset.path) == 0
    printed = capsys.readouterr()
    truth = read_result(path).dataset.truth
    assert f"(no named benchmark, content {truth[:8]})" in printed.out and printed.err == ""


def test_settings_of_a_benchmark_with_other_bytes_are_warned_of(
    dataset, tmp_path, monkeypatch, capsys
):
    intended = Benchmark("tiny-bench", 4, "mini", 32)
    monkeypatch.setattr(benchmarks, "intended_benchmark", lambda manifest: intended)
    folder = write_predictions(tmp_path / "predictions", dataset)
    assert fpp_eval(folder, dataset.path, "--json", tmp_path / "r.json") == 0
    printed = capsys.readouterr()
    assert printed.err.startswith(
        f"fpp-eval: warning: {dataset.path}: built with the settings of tiny-bench version 4"
    )
    assert (
        "warning" not in printed.out and read_result(tmp_path / "r.json").dataset.benchmark is None
    )


@pytest.mark.parametrize(
    "changes, message",
    [
        (
            {"benchmark": {"name": "other-bench", "version": 1}},
            "benchmark says other-bench version 1, but content is that of tiny-bench version 4",
        ),
        (
            {"benchmark": {"name": "tiny-bench", "version": 3}},
            "but content is that of tiny-bench version 4",
        ),
        ({"content": OTHER}, "tiny-bench version 4, but content is not that benchmark's"),
        (
            {"content": OTHER, "benchmark": {"name": "nobody-knows", "version": 1}},
            "content is not that benchmark's",
        ),
        ({"content": {}}, "content: .*at least 1"),
        ({"content": {"test/depth": "e" * 32}, "benchmark": None}, None),
        (
            {"content": {**OTHER, "test/frame_00": "e" * 32}, "benchmark": None},
            "expected hashes of test/depth",
        ),
        ({"benchmark": {"name": "tiny-bench"}}, "benchmark.version: is missing"),
        ({"benchmark": {"name": "tiny-bench", "version": 4, "size": 32}}, "size: is not a key"),
    ],
)
def test_a_claim_that_contradicts_the_content_is_refused(changes, message, named, tmp_path):
    path = scored_file(named, tmp_path)
    change_dataset(path, **changes)
    if message is None:
        assert read_result(path).dataset.benchmark is None
        return
    with pytest.raises(SubmissionError, match=message):
        read_result(path)


def test_compare_and_verify_name_both(named, dataset, tmp_path, capsys):
    path, other = scored_file(named, tmp_path), scored_file(named, tmp_path, "else")
    change_dataset(other, content=OTHER, benchmark=None)
    assert fpp_eval("compare", path, other) == 2
    first, second = (read_result(file).dataset.identity for file in (path, other))
    assert f"dataset: {first} against {second}" in capsys.readouterr().err and first.startswith(
        "tiny-bench version 4"
    )
    assert fpp_eval("verify", other, tmp_path / "p-predictions", named.path) == 1
    printed = capsys.readouterr().out
    assert (
        "dataset.content.test/depth: " + "e" * 32 in printed
        and named.content["test/depth"] in printed
    )


def test_other_counts_of_a_named_benchmark_are_refused(named, tmp_path, monkeypatch):
    """Pixels moved from the object to void, an object left out, one counted twice, an invented one:
    all averages are made again, so the file agrees with itself."""
    path = scored_file(named, tmp_path)
    scored = read_result(path)
    rows = [row.model_dump() for row in scored.per_sample]
    fields = {
        key: getattr(scored, key) for key in set(Result.model_fields) - {"per_sample", *derived([])}
    }

    def refused(changed, message):
        with monkeypatch.context() as forging:
            forging.setattr(model, "known_problem", lambda *claimed: None)
            data = scored.dataset.model_copy(update={"samples": len(changed)})
            samples = [SampleResult(**row) for row in changed]
            write_result(
                Result(per_sample=samples, **derived(samples), **{**fields, "dataset": data}), path
            )
        with pytest.raises(SubmissionError, match=message) as refusal:
            read_result(path)
        assert str(path) in str(refusal.value)

    def with_void(row):
        inside = ErrorStats(row["object_pixels"] - 9, row["object_mae_mm"], row["object_rmse_mm"])
        behind = ErrorStats(
            row["background_pixels"], row["background_mae_mm"], row["background_rmse_mm"]
        )
        whole = combine(inside, behind)
        changed = {"object_pixels": inside.pixels, "void_pixels": 9, "void_share": 9 / 1280}
        return row | changed | {"overall_mae_mm": whole.mae_mm, "overall_rmse_mm": whole.rmse_mm}

    refused(list(map(with_void, rows)), "object pixels of 'power_drill', this file says")
    refused(rows[:2], "has the object 'wooden_boards'")
    refused(
        [row | {"object": f"ball{number}"} for number, row in enumerate(rows)],
        "has no object 'ball0'",
    )


def test_a_dataset_that_was_changed_is_not_scored(named, tmp_path):
    """Its depth overwritten by the predictions: an error of 0 under the benchmark's name, if it
    were believed."""
    copy = shutil.copytree(named.path, tmp_path / "copy")
    predictions = write_predictions(tmp_path / "p", named, offset_mm=100.0)
    opened = DatasetFolder(copy)
    shard = next(shard for shard in opened.manifest.shards if shard.split == "test")
    bytes_before = (copy / shard.path).read_bytes()
    sample = opened.samples("test")[0]
    depth = opened.depth_mm(sample).tobytes()
    changed = bytes_before.replace(depth, np.load(predictions / f"{sample}.npy").tobytes())
    assert changed != bytes_before and len(changed) == len(bytes_before)
    (copy / shard.path).write_bytes(changed)
    command = [str(predictions), str(copy), "--json", str(tmp_path / "r.json")]
    error = refusal(fpp_eval, *command)
    assert str(copy) in error and "depth of split test is not what manifest.json says" in error
    # A manifest that was made to fit: a dataset of its own, without the benchmark's name.
    hashes = {
        name: image_hash(DatasetFolder(copy).depth_mm(name)) for name in opened.samples("test")
    }
    content = {**opened.content, "test/depth": column_hash(hashes)}
    replace(opened.manifest, content=content).write(copy)
    assert fpp_eval(*command) == 0
    assert read_result(tmp_path / "r.json").dataset.benchmark is None


@pytest.mark.long
def test_a_build_that_lacks_columns_is_still_the_benchmark(tmp_path, monkeypatch):
    settings = tiny_settings(objects=("power_drill",))
    whole, part = tmp_path / "all", tmp_path / "part"
    build(whole, replace(settings, stored="all"), workers=1)
    build(part, replace(settings, stored="single_shot"), workers=1)
    name_benchmarks(
        monkeypatch,
        tmp_path / "facts",
        (Benchmark("tiny-bench", 1, "test", 96), DatasetFolder(whole)),
    )
    results = []
    for number, folder in enumerate((whole, part)):
        opened = DatasetFolder(folder)
        results.append(
            evaluate(write_predictions(tmp_path / str(number), opened, offset_mm=1.0), opened)
        )
    assert (
        results[0].dataset.benchmark == results[1].dataset.benchmark
        and results[1].dataset.benchmark is not None
    )
    assert (
        results[0].dataset.truth == results[1].dataset.truth
        and results[0].metrics == results[1].metrics
    )
