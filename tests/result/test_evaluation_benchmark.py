"""The benchmark's name and version in results: written, read, refused where they contradict the data, compared."""

import json

import numpy as np
import pytest
from scored_dataset import make_dataset, write_predictions

from fpp_ml_bench.cli.evaluate import main
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.result import read_result, result_json, write_result
from fpp_ml_bench.evaluation.score import evaluate
from fpp_ml_bench.loaders.storage import Benchmark
from fpp_ml_bench.loaders.storage import benchmark as benchmarks


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return make_dataset(tmp_path_factory.mktemp("data") / "tiny")


@pytest.fixture
def named(dataset, monkeypatch):
    """The dataset as ``tiny-bench`` version 4, beside a benchmark of other bytes."""
    listed = (
        Benchmark("tiny-bench", 4, "mini", 32, dataset.fingerprint),
        Benchmark("other-bench", 1, "full", 64, "f" * 64),
    )
    monkeypatch.setattr(benchmarks, "BENCHMARKS", listed)
    return dataset


def result_file(dataset, folder):
    """A result of predictions with noise, written to a file in ``folder``."""
    folder.mkdir(exist_ok=True)
    predictions = write_predictions(folder / "predictions", dataset, noise_mm=2.0)
    path = folder / "result.json"
    write_result(evaluate(predictions, dataset), path)
    return path


def change_dataset(path, **changes):
    """Change keys of the file's dataset block; ``None`` removes a key."""
    content = json.loads(path.read_text())
    for key, value in changes.items():
        content["dataset"][key] = value
        if value is None:
            del content["dataset"][key]
    path.write_text(json.dumps(content))


def test_a_result_on_a_benchmark_says_its_name_and_version(named, tmp_path, capsys):
    path = result_file(named, tmp_path)
    assert json.loads(path.read_text())["dataset"]["benchmark"] == {"name": "tiny-bench", "version": 4}
    assert result_json(read_result(path)) == path.read_bytes()
    command = [str(tmp_path / "predictions"), "--dataset", str(named.path), "--report", str(tmp_path / "report")]
    assert main(command) == 0
    printed = capsys.readouterr()
    assert f"(tiny-bench version 4, fingerprint {named.fingerprint[:8]})" in printed.out and printed.err == ""
    assert "tiny-bench version 4" in (tmp_path / "report" / "index.html").read_text()
    assert main(["verify", str(path), str(tmp_path / "predictions"), "--dataset", str(named.path)]) == 0


def test_a_result_on_any_other_dataset_has_no_such_key(dataset, tmp_path, capsys):
    path = result_file(dataset, tmp_path)
    assert "benchmark" not in json.loads(path.read_text())["dataset"]
    assert main([str(tmp_path / "predictions"), "--dataset", str(dataset.path)]) == 0
    printed = capsys.readouterr()
    assert f"(no named benchmark, fingerprint {dataset.fingerprint[:8]})" in printed.out and printed.err == ""


def test_settings_of_a_benchmark_with_other_bytes_are_warned_of(dataset, tmp_path, monkeypatch, capsys):
    intended = Benchmark("tiny-bench", 4, "mini", 32, "f" * 64)
    monkeypatch.setattr(benchmarks, "intended_benchmark", lambda manifest: intended)
    folder = write_predictions(tmp_path / "predictions", dataset)
    assert main([str(folder), "--dataset", str(dataset.path), "--json", str(tmp_path / "r.json")]) == 0
    printed = capsys.readouterr()
    assert printed.err.startswith(f"fpp-eval: warning: {dataset.path}: built with the settings of tiny-bench version 4")
    assert "warning" not in printed.out and read_result(tmp_path / "r.json").dataset.benchmark is None


def test_a_file_of_schema_2_0_0_is_read_and_stays_as_it_is(named, tmp_path):
    path = result_file(named, tmp_path)
    change_dataset(path, benchmark=None)
    old = path.read_bytes().replace(b'"schema_version": "2.4.0"', b'"schema_version": "2.0.0"')
    assert old != path.read_bytes()
    path.write_bytes(old)
    result = read_result(path)
    assert result.schema_version == "2.0.0" and result.dataset.benchmark is None
    assert json.loads(result_json(result)) == json.loads(old)
    assert result.dataset.identity.startswith("tiny-bench version 4")  # the fingerprint is enough
    assert main(["verify", str(path), str(tmp_path / "predictions"), "--dataset", str(named.path)]) == 0
    new = result_file(named, tmp_path / "new")
    assert main(["compare", str(path), str(new)]) == 0


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"benchmark": {"name": "other-bench", "version": 1}},
         "benchmark says other-bench version 1, but fingerprint .* is tiny-bench version 4; other-bench .* has fff"),
        ({"benchmark": {"name": "tiny-bench", "version": 3}}, "but fingerprint .* is tiny-bench version 4"),
        ({"fingerprint": "e" * 64}, "but fingerprint eeeeeeeeeeeeeeee is not that benchmark; tiny-bench version 4 has"),
        ({"benchmark": {"name": "tiny-bench", "version": "4"}}, "benchmark.version: .*integer"),
        ({"benchmark": {"name": "tiny-bench"}}, "benchmark.version: is missing"),
        ({"benchmark": {"name": "x\x1b[2J", "version": 4}}, r"U\+001B"),
        ({"benchmark": {"name": "tiny-bench", "version": 4, "size": 32}}, "size: is not a key"),
    ],
)  # fmt: skip
def test_a_claim_that_contradicts_the_fingerprint_is_refused(changes, message, named, tmp_path):
    path = result_file(named, tmp_path)
    change_dataset(path, **changes)
    with pytest.raises(SubmissionError, match=message):
        read_result(path)


def test_a_benchmark_that_this_package_does_not_know_is_taken_as_it_is(named, tmp_path):
    path = result_file(named, tmp_path)
    change_dataset(path, fingerprint="e" * 64, benchmark={"name": "tiny-bench", "version": 5})
    assert read_result(path).dataset.identity == "tiny-bench version 5, fingerprint eeeeeeee"


def test_compare_and_verify_name_both_versions(named, tmp_path, capsys):
    path, newer = result_file(named, tmp_path), result_file(named, tmp_path / "newer")
    change_dataset(newer, fingerprint="e" * 64, benchmark={"name": "tiny-bench", "version": 5})
    assert main(["compare", str(path), str(newer)]) == 2
    expected = f"tiny-bench version 4, fingerprint {named.fingerprint[:8]}"
    assert f"dataset: {expected} against tiny-bench version 5, fingerprint eeeeeeee" in capsys.readouterr().err
    assert main(["verify", str(newer), str(tmp_path / "predictions"), "--dataset", str(named.path)]) == 1
    printed = capsys.readouterr().out
    assert "tiny-bench version 5, fingerprint eeeeeeee in the result" in printed and f"{expected} is what" in printed


def test_two_versions_of_one_fingerprint_are_not_compared(named, tmp_path, capsys):
    """Neither is known to this package, so each file is read; only one of them can be true."""
    files = []
    for version in (5, 6):
        files.append(result_file(named, tmp_path / str(version)))
        change_dataset(files[-1], fingerprint="e" * 64, benchmark={"name": "tiny-bench", "version": version})
    assert main(["compare", *map(str, files)]) == 2
    assert "tiny-bench version 5, fingerprint eeeeeeee against tiny-bench version 6" in capsys.readouterr().err


def test_the_schema_describes_the_key(named, tmp_path, capsys):
    import jsonschema

    assert main(["schema"]) == 0
    schema = json.loads(capsys.readouterr().out)
    assert "2.4.0" in schema["title"] and set(schema["$defs"]["BenchmarkInfo"]["required"]) == {"name", "version"}
    content = json.loads(result_file(named, tmp_path).read_text())
    jsonschema.validate(content, schema)
    del content["dataset"]["benchmark"]
    jsonschema.validate({**content, "schema_version": "2.0.0"}, schema)
    with pytest.raises(jsonschema.ValidationError):
        content["dataset"]["benchmark"] = "tiny-bench"
        jsonschema.validate(content, schema)


def test_the_scores_do_not_depend_on_the_name(dataset, tmp_path, monkeypatch):
    folder = write_predictions(tmp_path / "predictions", dataset, noise_mm=2.0)
    unnamed = evaluate(folder, dataset)
    monkeypatch.setattr(benchmarks, "BENCHMARKS", (Benchmark("tiny-bench", 4, "mini", 32, dataset.fingerprint),))
    assert evaluate(folder, dataset).metrics == unnamed.metrics
    assert np.isfinite(unnamed.metrics.object_mae_mm)
