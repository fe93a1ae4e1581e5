"""`fpp-eval` from a dataset folder to a result file, and which result files are refused when they
are read."""

import json
import subprocess
import sys
from hashlib import sha256

import numpy as np
import pytest
from conftest import fpp_eval, printed, read_json
from scored_dataset import DESCRIPTION, change_json, make_dataset, write_predictions

from fpp_ml_bench import machine as hardware
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.metrics import HEADLINE, METRICS
from fpp_ml_bench.evaluation.result.file import read_result, write_result
from fpp_ml_bench.evaluation.result.model import disagreements
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.loaders.sample import column_hash
from fpp_ml_bench.loaders.storage.store import DatasetFolder


@pytest.fixture
def predictions(tmp_path, dataset):
    return write_predictions(tmp_path / "predictions", dataset, noise_mm=2.0)


def scored(folder, dataset, tmp_path, *arguments):
    path = tmp_path / "result.json"
    assert fpp_eval(folder, dataset.path, "--json", path, *arguments) == 0
    return json.loads(
        path.read_text(), parse_constant=lambda name: pytest.fail(f"{name} in the JSON")
    )


def test_result_says_what_was_scored_on_what(dataset, predictions, tmp_path):
    result = scored(predictions, dataset, tmp_path)
    assert result["dataset"] == {
        "name": "tiny",
        "split": "test",
        "size": [32, 40],
        "samples": 4,
        "code": "phase shift",
        "content": {name: dataset.content[name] for name in ("test/depth", "test/flags")},
    }
    assert result["frames_class"] == "one frame"
    assert result["submission"] == {
        **DESCRIPTION,
        "timing": None,
        "png_mm_per_level": None,
        "seeds": {},
    }
    assert result["target"] == "depth"
    assert result["edge_band_px"] == 3 and result["edge_jump_mm"] == 240.0
    assert set(result["metrics"]) == {key for key in METRICS if not key.startswith("unlit")}
    assert set(result["pooled"]) == set(HEADLINE)
    for row in result["per_sample"]:
        assert (
            row["prediction_sha256"]
            == sha256((predictions / f"{row['sample']}.npy").read_bytes()).hexdigest()
        )
        assert row["object_pixels"] == np.count_nonzero(dataset.depth_mm(row["sample"]))
    assert result["environment"]["packages"]["numpy"] == np.__version__


def test_a_shift_scores_itself_against_either_depth(dataset, tmp_path, capsys):
    folder = write_predictions(tmp_path / "p", dataset, offset_mm=4.0)
    exact = scored(folder, dataset, tmp_path, "--target", "depth_exact")
    assert exact["metrics"]["object_mae_mm"] == 3.5 and exact["metrics"]["background_mae_mm"] == 4.0
    shifted = scored(folder, dataset, tmp_path)
    assert shifted["metrics"]["overall_rmse_mm"] == shifted["pooled"]["background_mae_mm"] == 4.0
    assert "A method" in capsys.readouterr().out


@pytest.mark.parametrize(("kind", "order"), [("<f2", "C"), (">f4", "F"), ("<f8", "C")])
def test_every_real_float_format_is_read(kind, order, dataset, tmp_path):
    folder = write_predictions(tmp_path / "predictions", dataset)
    for path in folder.glob("*.npy"):
        np.save(path, np.asarray(np.load(path) + np.float32(8.0), dtype=kind, order=order))
    metrics = scored(folder, dataset, tmp_path)["metrics"]
    if kind == "<f2":
        assert metrics["object_mae_mm"] == pytest.approx(
            8.0, abs=1.0
        )  # float16 resolves 1 mm at 1.8 m
        assert metrics["background_mae_mm"] == 8.0
    else:
        assert {metrics[key] for key in HEADLINE} == {8.0}


def test_dataset_folder_of_any_name(tmp_path):
    for number, name in enumerate(("x" * 250, "a\x1b[31m", " ")):
        data = make_dataset(tmp_path / name)
        folder = write_predictions(tmp_path / "predictions" / str(number), data)
        dataset_name = scored(folder, data, tmp_path)["dataset"]["name"]
        assert dataset_name == ["x" * 100 + "...", "a\\x1b[31m", "dataset"][number]


@pytest.mark.parametrize(
    "split, samples", [("train", 2), ("validation", 2), ("test", 4), ("all", 8)]
)
def test_every_split(split, samples, dataset, tmp_path):
    folder = write_predictions(tmp_path / "predictions", dataset, split=split)
    assert len(scored(folder, dataset, tmp_path, "--split", split)["per_sample"]) == samples


class Emptied(DatasetFolder):
    """A dataset with a view that shows no object, which our builder never makes."""

    def depth_mm(self, sample, column="depth"):
        return super().depth_mm(sample, column) * np.float32(sample != "power_drill_A60")

    def content_hash(self, split, column, hashes):
        return f"{split}/{column}", column_hash(hashes)  # the images are not those of its files


def test_sample_without_object_has_no_object_score(dataset, tmp_path):
    data = Emptied(dataset.path)
    folder = write_predictions(tmp_path / "predictions", data, offset_mm=3.0)
    written = tmp_path / "result.json"
    write_result(evaluate(folder, data), written)
    result = read_json(written)
    assert read_result(written).samples_without_object == 1
    empty = [row for row in result["per_sample"] if row["object_pixels"] == 0]
    assert len(empty) == result["samples_without_object"] == 1
    assert empty[0]["object_mae_mm"] is None and empty[0]["background_mae_mm"] == 3.0
    assert result["metrics"]["object_mae_mm"] == 3.0 and result["samples_without_background"] == 0


def test_same_result_twice_and_from_one_thread(dataset, predictions, monkeypatch):
    from fpp_ml_bench.evaluation.score import evaluator as scoring

    first = evaluate(predictions, dataset)
    monkeypatch.setattr(scoring, "WORKERS", 1)
    second = evaluate(predictions, dataset)
    assert first.model_copy(update={"created": ""}) == second.model_copy(update={"created": ""})


def test_table_shows_submitted_text_as_text(dataset, tmp_path):
    folder = write_predictions(
        tmp_path / "predictions", dataset, name="[bold red]x[/] :smile: [link=http://e]y[/link]"
    )
    assert "[bold red]x[/] :smile: [link=http://e]y[/link]" in printed(
        fpp_eval, folder, dataset.path
    )


EDITS = {
    "other schema": ("schema_version", "1.0.0", "expected .* 4.0.0, got schema_version 1.0.0"),
    "no schema": ("schema_version", ..., "no schema_version"),
    "unknown key": ("rank", 1, "rank: is not a key"),
    "missing key": ("target", ..., "target: is missing"),
    "negative": ("metrics.object_mae_mm", -1.0, "metrics.object_mae_mm: .*greater"),
    "text": ("metrics.object_mae_mm", "0.1", "metrics.object_mae_mm: .*number"),
    "better headline": (
        "metrics.object_mae_mm",
        0.001,
        "metrics.object_mae_mm does not follow from per_sample",
    ),
    "better median": ("median.overall_rmse_mm", 0.001, "median.overall_rmse_mm does not follow"),
    "better pool": ("pooled.overall_mae_mm", 0.001, "pooled.overall_mae_mm does not follow"),
    "better sample": (
        "per_sample.0.object_mae_mm",
        0.001,
        "bias or shift-free MAE is above the MAE",
    ),
    "interval": ("intervals.object_mae_mm.0", 0.5, r"object_mae_mm\.0 does not follow"),
    "better object": (
        "per_object.0.metrics.object_mae_mm",
        0.5,
        r"per_object\.0\.metrics\.object_mae_mm does not follow",
    ),
    "spread": (
        "per_object.0.spread.object_mae_mm",
        0.5,
        r"per_object\.0\.spread\.object_mae_mm does not follow",
    ),
    "seed": ("seeds.bootstrap", 1, r"seeds\.bootstrap does not follow"),
    "resamples": ("bootstrap.resamples", 10, r"bootstrap\.resamples does not follow"),
    "median of a sample": ("per_sample.0.object_median_mm", 99.0, "out of order"),
    "null quantile": ("per_sample.0.object_p95_mm", None, "null all together"),
    "mode": ("mode", "paper", r"dataset\.content: expected hashes of test/depth, got"),
    "target": (
        "target",
        "depth_exact",
        r"dataset\.content: expected hashes of test/depth_exact, test/flags",
    ),
    "code": ("environment.code_sha256", "x", "code_sha256"),
    "impossible RMSE": ("per_sample.0.object_rmse_mm", 0.001, "RMSE is below its MAE"),
    "null score": ("per_sample.0.object_mae_mm", None, "null exactly when the set is empty"),
    "pixels": ("per_sample.0.object_pixels", 5, "do not add up"),
    "no void": ("per_sample.0.void_pixels", ..., "void_pixels is missing"),
    "void share": ("per_sample.0.void_share", 0.5, "void_share does not follow from void_pixels"),
    "unlit": ("per_sample.0.unlit_pixels", 0, "unlit_pixels is extra by these rules"),
    "sample twice": ("per_sample.0.sample", "power_drill_A60", "names a sample twice"),
    "share": ("per_sample.0.object_missing_share", 1.5, "less than or equal to 1"),
    "hash": ("per_sample.0.prediction_sha256", "0" * 63, "prediction_sha256"),
    "fingerprint": ("dataset.fingerprint", "x" * 64, "fingerprint"),
    "sample count": ("dataset.samples", 5, "holds 4 samples, dataset.samples says 5"),
    "empty samples": ("samples_without_object", 1, "samples_without_object is not the number"),
    "split": ("dataset.split", "tests", "dataset.split"),
    "time": ("created", "yesterday", "created"),
    "name": ("submission.name", "x\x1b[2J", "U\\+001B"),
    "long name": ("submission.name", "x" * 10_000_000, "at most 200 characters"),
}


@pytest.mark.parametrize("case", EDITS)
def test_edited_result_is_refused(case, dataset, predictions, tmp_path):
    path, value, message = EDITS[case]
    write_result(evaluate(predictions, dataset), tmp_path / "r.json")
    change_json(tmp_path / "r.json", path, value)
    with pytest.raises(SubmissionError, match=message) as refusal:
        read_result(tmp_path / "r.json")
    assert str(tmp_path / "r.json") in str(refusal.value)
    assert len(str(refusal.value)) < 2000 and "\x1b" not in str(refusal.value)


@pytest.mark.parametrize(
    "text, message",
    [
        ('{"schema_version": "1.0.0", "schema_version": "1.0.0"}', "is given twice"),
        ('{"schema_version": NaN}', "NaN is no number"),
        ('{"a": ', "is no valid JSON"),
        ("[]", "no schema_version"),
        ("[" * 100_000, "nested too deeply"),
        (b"\xff\xfe", "expected UTF-8"),
        ('{"schema_version": ' + "9" * 5000 + "}", "is no valid JSON"),
    ],
)
def test_file_that_is_no_result(text, message, tmp_path):
    path = tmp_path / "r.json"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(SubmissionError, match=message):
        read_result(path)


def test_number_too_large_for_a_float_is_refused(dataset, predictions, tmp_path):
    path = tmp_path / "r.json"
    write_result(evaluate(predictions, dataset), path)
    for number in ("1e999", "1" + "0" * 400):
        content = read_json(path)
        content["metrics"]["object_mae_mm"] = "HERE"
        (tmp_path / "x.json").write_text(json.dumps(content).replace('"HERE"', number))
        with pytest.raises(SubmissionError, match=r"metrics\.object_mae_mm"):
            read_result(tmp_path / "x.json")


def test_unwritable_result_is_an_error(dataset, predictions, tmp_path, monkeypatch):
    from fpp_ml_bench.evaluation.result import file as result_io

    def full(path, content):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(result_io, "write_atomically", full)
    assert fpp_eval(predictions, dataset.path, "--json", tmp_path / "r.json") == 2
    assert not (tmp_path / "r.json").exists()


@pytest.mark.processes
def test_help_is_light_and_scoring_needs_no_torch(dataset, predictions):
    """In fresh interpreters, since a command starts as fast as its imports."""
    script = "import sys\nfrom fpp_ml_bench.cli import main_eval as main\n"
    script += "main(sys.argv[1:])\n"
    script += "print([m for m in ('numpy', 'pydantic', 'rich', 'yaml', 'cv2', 'numba', 'torch', 'pandas', 'datasets') "
    script += "if m in sys.modules])"

    def loaded(*arguments):
        done = subprocess.run(
            [sys.executable, "-c", script, *arguments], capture_output=True, text=True, check=True
        )
        return json.loads(done.stdout.splitlines()[-1].replace("'", '"'))

    assert loaded("--help") == []
    assert loaded(str(predictions), str(dataset.path)) == ["numpy", "pydantic", "rich", "yaml"]


def test_hardware_is_read_from_the_machine(monkeypatch):
    files = {
        "/proc/cpuinfo": "processor : 0\nmodel name\t: Fast CPU 9000\n",
        "/proc/meminfo": "MemTotal:       16777216 kB\n",
        "/sys/fs/cgroup/cpu.max": "150000 100000\n",
        "/sys/fs/cgroup/memory.max": str(4 * 2**30),
    }
    monkeypatch.setattr(hardware, "_read", lambda path: files.get(path, ""))
    monkeypatch.setattr(hardware.os, "sched_getaffinity", lambda pid: set(range(8)))
    monkeypatch.setattr(hardware.shutil, "which", lambda name: None)
    monkeypatch.setitem(sys.modules, "torch", None)
    machine = hardware.describe_hardware()
    assert (machine.cpu, machine.cores, machine.memory_gib) == ("Fast CPU 9000", 2, 4.0)
    files["/sys/fs/cgroup/cpu.max"], files["/sys/fs/cgroup/memory.max"] = "max 100000\n", "max\n"
    machine = hardware.describe_hardware()
    assert (machine.cores, machine.memory_gib) == (8, 16.0)


def test_gpus_are_named_by_nvidia_smi(monkeypatch):
    class Answer:
        stdout = "NVIDIA H100\nNVIDIA H100\nNVIDIA T4\n"

    monkeypatch.setattr(hardware, "_read", lambda path: "")
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setattr(hardware.shutil, "which", lambda name: "/usr/bin/nvidia-smi")
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: Answer)
    assert hardware.describe_hardware().gpu == "2 x NVIDIA H100, NVIDIA T4"


def test_a_number_and_a_text_are_a_difference():
    stored, computed = {"a": [1.0, 2.0]}, {"a": [1.0, "2.0"]}
    assert list(disagreements(stored, computed)) == [("a.1", 2.0, "2.0")]
    assert list(disagreements({"a": 2.0}, {"a": 2})) == []
