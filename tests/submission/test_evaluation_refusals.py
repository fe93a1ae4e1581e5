"""Predictions and descriptions that must not be scored: through the real command, exit status 2, no
JSON, named."""

import os
import re
import struct
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import fpp_eval, read_json, refusal
from scored_dataset import DESCRIPTION, make_dataset, write_description, write_predictions

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.submission.description import Submission, read_submission

SAMPLE = "power_drill_A60"
FILE = f"{SAMPLE}.npy"


def refused(tmp_path, dataset, predictions):
    """What the command says when it refuses; it prints nothing and leaves an older result alone."""
    result = tmp_path / "result.json"
    result.write_text("older")
    with redirect_stdout(StringIO()) as out:
        error = refusal(fpp_eval, predictions, dataset.path, "--json", result)
    assert out.getvalue() == "" and "Traceback" not in error
    assert result.read_text() == "older"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["predictions", "result.json"]
    return error


def rewrite(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def change_file(folder: Path) -> None:
        np.save(folder / FILE, change(np.load(folder / FILE)))

    return change_file


def with_value(value: float, count: int = 1) -> Callable[[Path], None]:
    def change(depth: np.ndarray) -> np.ndarray:
        depth = depth.copy()
        depth.ravel()[:count] = value
        return depth

    return rewrite(change)


def header(text: bytes, magic: bytes = b"\x93NUMPY\x01\x00") -> Callable[[Path], None]:
    return lambda folder: (
        (folder / FILE).write_bytes(magic + struct.pack("<H", len(text)) + text + b"\0" * 64)
        and None
    )


def cut(folder: Path) -> None:
    (folder / FILE).write_bytes((folder / FILE).read_bytes()[:-4])


def grow(folder: Path) -> None:
    (folder / FILE).write_bytes((folder / FILE).read_bytes() + b"more")


def link(folder: Path) -> None:
    (folder / FILE).rename(folder.parent / "elsewhere.npy")
    (folder / FILE).symlink_to(folder.parent / "elsewhere.npy")


def archive(folder: Path) -> None:
    with (folder / FILE).open("wb") as stream:
        np.savez(stream, depth=np.zeros((32, 40)))


def pickled(folder: Path) -> None:
    np.save(folder / FILE, np.array([[{"a": 1}]], dtype=object), allow_pickle=True)


def replace_by_pipe(folder: Path) -> None:
    (folder / FILE).unlink()
    os.mkfifo(folder / FILE)


ADVICE = r"\b(write|save|use|predict|give|convert|put|copy|remove|replace|check)\b"
FILES = {
    "missing": (lambda f: (f / FILE).unlink(), "is missing"),
    "wrong shape": (
        rewrite(lambda d: d[:-1]),
        r"expected shape \(32, 40\) \(H, W\), got \(31, 40\)",
    ),
    "transposed": (rewrite(lambda d: d.T), r"got \(40, 32\); it looks transposed"),
    "extra axis": (
        rewrite(lambda d: d[None]),
        r"got \(1, 32, 40\); it has an axis too many; write np.squeeze",
    ),
    "channels": (
        rewrite(lambda d: np.stack([d] * 3)),
        r"got \(3, 32, 40\); write the map of depth alone",
    ),
    "a mark": (
        rewrite(lambda d: np.where(d > 0, d, 65504)),
        r"holds a mark .*% of the pixels are exactly 65504",
    ),
    "a negative mark": (
        rewrite(lambda d: np.where(d > 0, d, -1)),
        r"are exactly -1, far .* or give .* nodata",
    ),
    "scalar": (rewrite(lambda d: np.float32(1)), r"got \(\)"),
    "uint16": (rewrite(lambda d: d.astype(np.uint16)), "got uint16"),
    "complex": (rewrite(lambda d: d.astype(np.complex64)), "got complex64"),
    "structured": (
        rewrite(lambda d: d.view([("z", "<f4")])),
        "expected float16, float32 or float64",
    ),
    "objects": (pickled, "pickled Python objects"),
    "one NaN": (with_value(np.nan), "holds 1 NaN of 1280 values"),
    "infinities": (with_value(np.inf, 3), "holds 3 infinite of 1280 values"),
    "absurd": (with_value(3e38), "the limit is 1e\\+30"),
    "normalised": (
        rewrite(lambda d: d / d.max()),
        "looks like metres or normalised depth: its largest value is 1",
    ),
    "truncated": (cut, "is truncated: expected 5248 bytes, got 5244"),
    "grown": (grow, "foreign bytes"),
    "noise": (lambda f: (f / FILE).write_bytes(bytes(range(256)) * 8), "is no .npy file"),
    "zip archive": (archive, "np.savez"),
    "no dictionary": (header(b"import os\n"), "is no .npy file"),
    "nested header": (header(b"(" * 9000), "is no .npy file"),
    "huge shape": (
        header(b"{'descr': '<f4', 'fortran_order': False, 'shape': (99999, 99999), }\n"),
        "expected shape",
    ),
    "unprintable shape": (
        header(
            b"{'descr': '<f4', 'fortran_order': False, 'shape': (0x" + b"f" * 5000 + b", 4), }\n"
        ),
        r"got \(more than 10\^18, 4\)",
    ),
    "format 3.0": (header(b"{}", b"\x93NUMPY\x03\x00"), "format version"),
    "symbolic link": (link, "is a symbolic link"),
    "pipe": (replace_by_pipe, "is not a regular file"),
}


@pytest.mark.parametrize("case", FILES)
def test_bad_prediction_file_is_refused_by_name(case, tmp_path, dataset, predictions):
    change_folder, message = FILES[case]
    change_folder(predictions)
    if case == "symbolic link":
        (tmp_path / "elsewhere.npy").rename(
            predictions.parent.parent / f"{tmp_path.name}-elsewhere.npy"
        )
    error = refused(tmp_path, dataset, predictions)
    line = re.search(rf"^\s*{re.escape(FILE)}: .*{message}.*$", error, flags=re.MULTILINE)
    assert line, error
    assert re.search(ADVICE, line[0]), f"no advice in {line[0]}"


def test_every_offender_is_named_at_once(tmp_path, dataset, predictions):
    (predictions / "wooden_boards_A0.npy").unlink()
    with_value(np.nan, 7)(predictions)
    np.save(predictions / "power_drill_A0.npy", np.zeros((2, 2), np.int8))
    np.save(predictions / "mug_A0.npy", np.zeros((32, 40)))
    (predictions / "notes.txt").write_text("hello")
    (predictions / ".DS_Store").write_text("")
    (predictions / "more").mkdir()
    write_description(predictions, method=..., colour="red")
    error = refused(tmp_path, dataset, predictions)
    for expected in (
        "can't be scored, 7 problems",
        "wooden_boards_A0.npy: is missing",
        f"{FILE}: holds 7 NaN",
        "power_drill_A0.npy: expected float16, float32 or float64, got int8",
        "mug_A0.npy: is extra (a sample of split validation, not of test",
        "notes.txt: is extra",
        ".DS_Store: is extra",
        "more: is extra",
        "method: is missing",
        "colour: is not a key",
    ):
        assert expected in error


def test_several_faults_of_one_file_are_all_named(tmp_path, dataset, predictions):
    rewrite(lambda d: np.where(np.arange(1280).reshape(32, 40) == 0, np.nan, d / 1000 - 1e-3))(
        predictions
    )
    error = refused(tmp_path, dataset, predictions)
    assert f"{FILE}: holds 1 NaN" in error and "looks like metres" in error


def test_negative_values_are_errors_like_any_other(tmp_path, dataset, predictions):
    with_value(-1.0, 3)(predictions)
    written = tmp_path / "result.json"
    assert fpp_eval(predictions, dataset.path, "--json", written) == 0
    assert read_json(written)["metrics"]["overall_mae_mm"] > 0


def test_file_names_cannot_speak_to_the_terminal(tmp_path, dataset, predictions):
    (predictions / "\x1b[31mred\n.npy").write_text("")
    error = refused(tmp_path, dataset, predictions)
    assert "\x1b" not in error
    assert "\\x1b[31mred\\n.npy: is extra" in error


DESCRIPTIONS = {
    "unknown key": ({"speed": 3}, "speed: is not a key"),
    "no name": ({"name": ...}, "name: is missing"),
    "empty name": ({"name": "  "}, "name: expected some text"),
    "number as name": ({"name": 5}, "name: .*string"),
    "long name": ({"name": "x" * 201}, "name: expected at most 200 characters, got 201"),
    "escape in name": ({"name": "a\x1b[2J"}, r"name: .*U\+001B"),
    "reversed text in name": ({"name": "a\u202eb"}, r"name: .*U\+202E"),
    "inches": ({"units": "inch"}, "units: Input should be 'mm', 'm' or 'normalised' .got 'inch'"),
    "range as number": ({"uses_ground_truth_range": 0}, "uses_ground_truth_range: .*boolean"),
    "fraction of a frame": ({"frames_used": [0.5]}, r"frames_used\.0: .*integer"),
    "negative frame": ({"frames_used": [-1]}, r"frames_used\.0: .*greater"),
    "frame twice": ({"frames_used": [1, 1]}, "frames_used names a frame twice"),
    "empty frames": ({"frames_used": []}, "frames_used: .*at least 1 item"),
    "frame outside": (
        {"frames_used": [3, 52]},
        r"frames_used: expected indices from 0 to 51 .*got \[52\]",
    ),
    "no time": ({"seconds_per_sample": 0.0}, "seconds_per_sample: .*greater"),
    "NaN time": ({"seconds_per_sample": float("nan")}, "seconds_per_sample: .*finite"),
    "time without its machine": ({"hardware": ...}, "needs seconds_source and hardware"),
    "unknown source": ({"seconds_source": "guessed"}, "seconds_source: .*measured"),
    "unknown hardware key": ({"hardware": {"cpu": "x", "ghz": 3}}, r"hardware\.ghz: is not a key"),
    "unknown data": (
        {"learned_from": {"data": "everything"}},
        r"learned_from\.data: .*'train-split'",
    ),
    "train split of what": (
        {"learned_from": {"data": "train-split"}},
        "data: train-split needs versions",
    ),
    "versions of nothing": (
        {"learned_from": {"data": "none", "versions": ["x"]}},
        "from no data has no versions",
    ),
    "nested settings": ({"settings": {"a": {"b": 1}}}, r"settings\.a"),
}


@pytest.mark.parametrize("case", DESCRIPTIONS)
def test_bad_description_is_refused_by_key(case, tmp_path, dataset, predictions):
    changes, message = DESCRIPTIONS[case]
    write_description(predictions, **changes)
    error = refused(tmp_path, dataset, predictions)
    assert "submission.yaml" in error
    assert re.search(message, error), error


TEXTS = {
    "not there": (None, "found none"),
    "empty": ("", "expected keys and values"),
    "a list": ("- 1\n- 2\n", "expected keys and values like .*got list"),
    "no YAML": ("name: [", "is no plain YAML"),
    "key twice": ("name: a\nname: b\n", "'name' is given twice"),
    "alias": ("a: &x [1]\nb: *x\n", "uses an alias"),
    "Python object": ("name: !!python/object/apply:os.system [echo]\n", "is no plain YAML"),
    "list as key": ("? [1]\n: 2\n", "expected text as key"),
    "too long": ("name: " + "x" * 70000, "at most 65536 bytes"),
    "nested": ("a: " + "[" * 20000, "is no plain YAML"),
    "a date": ("name: !!timestamp 2026-99-99\n", "name: has the tag"),
    "not UTF-8": (b"name: \xff\xfe", "expected UTF-8"),
}


@pytest.mark.parametrize("case", TEXTS)
def test_description_that_is_no_description(case, tmp_path, dataset, predictions):
    text, message = TEXTS[case]
    path = predictions / "submission.yaml"
    path.unlink()
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    error = refused(tmp_path, dataset, predictions)
    assert "submission.yaml" in error
    assert re.search(message, error), error


def test_description_is_written_as_it_is_read(predictions):
    """Only the keys that were given, and false never for a mask that was not; so `predict` writes
    what it knows."""
    read = read_submission(predictions)
    (predictions / "submission.yaml").write_text(read.to_yaml(), encoding="utf-8")
    assert read_submission(predictions) == read
    assert yaml.safe_load(read.to_yaml()) == DESCRIPTION
    assert "mask" not in Submission(**{**DESCRIPTION, "uses_ground_truth_mask": False}).to_yaml()


def test_description_through_a_link_is_refused(tmp_path, dataset, predictions):
    (predictions / "submission.yaml").unlink()
    (predictions / "submission.yaml").symlink_to("/etc/passwd")
    assert "symbolic link" in refused(tmp_path, dataset, predictions)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["nowhere", "{data}"], "expected a folder of predictions"),
        (["{pred}", "nowhere"], "no such folder"),
        (["{pred}", "{pred}"], "no dataset of fpp-ml-bench"),
        (["{pred}", "{data}", "--json", "{pred}/result.json"], "is inside the predictions folder"),
        (["{pred}", "{data}", "--json", "{pred}"], "found a folder"),
        (["{pred}", "{data}", "--json", "no/such/result.json"], "does not exist"),
        (["{pred}", "{data}", "--split", "train"], "bowl_A0.npy: is missing"),
    ],
)
def test_wrong_arguments(arguments, message, dataset, predictions):
    before = sorted(p.name for p in predictions.iterdir())
    words = [part.format(data=dataset.path, pred=predictions) for part in arguments]
    assert message in refusal(fpp_eval, *words)
    assert sorted(p.name for p in predictions.iterdir()) == before


@pytest.mark.parametrize("band", ["-1", "1.5", "1001"])
def test_edge_band_must_be_whole_pixels(band, dataset, predictions):
    assert "whole pixels" in refusal(fpp_eval, predictions, dataset.path, "--edge-band", band)


def test_dataset_without_exact_depth(tmp_path):
    data = make_dataset(tmp_path / "published", exact=False)
    predictions = write_predictions(tmp_path / "predictions", data)
    assert "no depth_exact" in refusal(fpp_eval, predictions, data.path, "--target", "depth_exact")


def test_a_mark_that_the_description_names_is_no_surface(dataset, predictions):
    plain = evaluate(predictions, dataset)
    for file in predictions.glob("*.npy"):
        depth = np.load(file)
        np.save(file, np.where(depth > 0, depth, np.float32(65535)))
    write_description(predictions, nodata=65535)
    marked = evaluate(predictions, dataset)
    assert marked.metrics == plain.metrics and marked.submission.nodata == 65535
    assert "nodata" not in plain.submission.model_dump()
    write_description(predictions, nodata="sky")
    with pytest.raises(PredictionError, match=r"nodata: .*number"):
        evaluate(predictions, dataset)
