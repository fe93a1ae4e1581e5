"""A metric is one entry: a toy metric is in results, schema, reports and leaderboard; PROTOCOL.md
has all."""

import subprocess
import sys
from pathlib import Path

import pytest
from conftest import read_json
from scored_dataset import make_dataset, write_predictions

from fpp_ml_bench import evaluation
from fpp_ml_bench.evaluation.metrics import (
    BOUNDS,
    HEADLINE,
    METRICS,
    UNCERTAINTY,
    protocol_table,
    sort_keys,
)

TOY = """
import json, sys
from pathlib import Path

import numpy as np

from fpp_ml_bench.evaluation.metrics import METRICS, Metric, sort_keys


def median_of_inside(sample):
    errors = np.abs(sample.prediction_mm - sample.target_mm)[sample.inside]
    return float(np.median(errors)) if errors.size else None


METRICS["toy_mm"] = Metric("toy_mm", "A toy", "mm", median_of_inside, "median of |e|", column="Toy")

from fpp_ml_bench.cli import main as bench
from fpp_ml_bench.cli import main_eval as main
from fpp_ml_bench.evaluation.result.file import json_schema, read_result, result_json
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.loaders.storage.store import DatasetFolder

folder, data, out, old = map(Path, sys.argv[1:])
assert sort_keys()[-3:] == ("toy_mm", "seconds_per_sample", "frames_used")
scored = evaluate(folder, DatasetFolder(data))
assert [row.toy_mm for row in scored.per_sample] == [row.object_median_mm for row in scored.per_sample]
assert scored.metrics.toy_mm == scored.metrics.object_median_mm
assert main([str(folder), str(data), "--json", str(out), "--report", str(out.parent / "report")]) == 0
assert "A toy" in (out.parent / "report" / "index.html").read_text()
assert read_result(out).metrics.toy_mm == scored.metrics.toy_mm
assert main(["verify", str(out), str(folder), str(data)]) == 0
assert result_json(read_result(old)) == old.read_bytes()  # of before the toy
assert "toy_mm" in json_schema("result")["$defs"]["Metrics"]["properties"]
print("BOARD")
assert bench(["leaderboard", str(out), str(old), "--sort", "toy_mm", "--markdown", str(out.parent / "table.md")]) == 0
assert bench(["leaderboard", str(out), "--page", str(out.parent / "page"), "--csv", str(out.parent / "rows.csv")]) == 0
assert "Toy, mm" in (out.parent / "page" / "index.html").read_text()
assert "toy_mm" in (out.parent / "rows.csv").read_text().splitlines()[0].split(",")
"""


@pytest.fixture(scope="module")
def scored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("toy")
    dataset = make_dataset(folder / "data")
    predictions = [
        write_predictions(folder / name, dataset, noise_mm=2.0 + n, name=name)
        for n, name in enumerate("ab")
    ]
    return folder, dataset, predictions


@pytest.mark.processes
def test_a_toy_metric_is_one_entry(scored):
    """In a fresh interpreter: results are made of the entries that there are when they are first
    imported."""
    from fpp_ml_bench.evaluation.result.file import write_result
    from fpp_ml_bench.evaluation.score.evaluator import evaluate

    folder, dataset, predictions = scored
    write_result(evaluate(predictions[1], dataset), folder / "old.json")
    paths = map(str, (predictions[0], dataset.path, folder / "new.json", folder / "old.json"))
    done = subprocess.run([sys.executable, "-c", TOY, *paths], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    toy = read_json(folder / "new.json")["metrics"]["toy_mm"]
    heads, _, *rows = (
        line for line in (folder / "table.md").read_text().splitlines() if line.startswith("|")
    )
    column = [cell.strip() for cell in heads.split("|")].index("Toy")
    assert [row.split("|")[column].strip() for row in rows[:2]] == [f"{toy:.3f}", "-"]
    assert "Toy" in done.stdout.partition("BOARD")[2]


@pytest.mark.parametrize("metrics", [METRICS, UNCERTAINTY])
def test_the_protocol_has_the_table_of_the_entries(metrics):
    text = (Path(evaluation.__file__).parent / "PROTOCOL.md").read_text()
    table = "\n".join(protocol_table(metrics.values()))
    assert f"\n{table}\n" in text, f"PROTOCOL.md needs this table:\n{table}"


def test_entries_are_what_files_and_ranks_rest_on():
    """The keys that every result has stay where they are; whatever comes later may be left out."""
    optional = [metric.optional for metric in METRICS.values()]
    assert optional == sorted(optional) and optional.count(False) == 28
    assert list(HEADLINE) == list(METRICS)[:6] and all(
        METRICS[key].unit == "mm" for key in HEADLINE
    )
    assert {key for bound in BOUNDS for key in bound[:2]} <= set(METRICS)
    assert {"object_valid_mae_mm", "object_bias_mm"}.isdisjoint(sort_keys())
