"""Row files and their provenance, and ranks by interval."""

import json
import re
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from board_rows import reliance, robustness, timing, write_result_file
from conftest import fpp_bench, fpp_eval, printed, read_json, refusal
from scored_dataset import change_json, disk_depth, make_dataset
from upkeep import readme_block

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.metrics import HEADLINE, METRICS
from fpp_ml_bench.evaluation.result.file import read_result
from fpp_ml_bench.evaluation.result.model import same
from fpp_ml_bench.leaderboard import columns, rows
from fpp_ml_bench.leaderboard.page.page import page_files
from fpp_ml_bench.leaderboard.ranking import rank, read_entries, shipped_rows
from fpp_ml_bench.leaderboard.row_file import (
    LARGEST_ROW_BYTES,
    interval_over,
    mean_over,
    row_json,
    write_row,
)
from fpp_ml_bench.leaderboard.rows import read_entry


@pytest.fixture
def listed(tmp_path, monkeypatch):
    """Have ``vouched.txt`` list rows: called with a row file and a word, or with a whole line."""
    file = tmp_path / "vouched.txt"
    file.write_text("")
    monkeypatch.setattr(rows, "VOUCHED", file)

    def add(line: object, word: str = "") -> None:
        if word:
            line = rows.vouching_line(read_entry(line).row, line.read_bytes(), word, "a command")
        file.write_text(f"{file.read_text()}{line}\n")

    return add


def write_row_of(result: Path, path: Path) -> Path:
    write_row(read_entry(result).row, path)
    return path


def test_one_command_makes_a_row_and_prints_the_line_to_vouch_for_it(files, tmp_path, listed):
    row = tmp_path / "row.json"
    said, line = printed(fpp_bench, "leaderboard", files[0], "--row", row).splitlines()
    assert said.startswith(
        f"{row}: {row.stat().st_size:,} bytes, self-reported until a maintainer adds"
    )
    entry, bare = read_entry(row), read_entry(files[0])
    assert entry.row == bare.row and entry.provenance == bare.provenance == rows.LOCAL
    write_row(entry.row, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == row.read_bytes()
    listed("# a remark")
    listed(line)
    assert (
        read_entry(row).provenance == "measured here"
        and read_entry(tmp_path / "again.json").vouched
    )
    row.write_bytes(row.read_bytes() + b" ")
    assert read_entry(row).provenance == rows.LOCAL


def test_what_a_row_keeps_of_a_result(files):
    result, row = read_result(files[1]), read_entry(files[1]).row
    assert len(row_json(row)) < 4_000 < len(files[1].read_bytes()) / 3
    for key, value in result.metrics:
        kept = getattr(row.metrics, key)
        assert kept is value is None or kept == float(f"{value:.5g}")
    for part, own in zip(result.per_object, row.per_object, strict=True):
        samples = [sample for sample in result.per_sample if sample.object == part.object]
        assert (own.object, own.samples) == (part.object, len(samples))
        assert own.object_pixels == sum(sample.object_pixels for sample in samples)
        assert own.object_mae_mm == float(f"{part.metrics.object_mae_mm:.5g}")
    about = row.submission
    assert (about.seconds_per_sample, about.hardware) == (
        None,
        None,
    ) and about.timing == result.submission.timing
    hashes = "\n".join(sorted(sample.prediction_sha256 for sample in result.per_sample))
    assert row.predictions_sha256 == sha256(hashes.encode()).hexdigest()
    assert row.result_sha256 == sha256(files[1].read_bytes()).hexdigest()


def test_means_weigh_objects_by_the_views_that_have_them(tmp_path):
    """Objects that fill the image in some of their views: what is over objects is what is over
    samples."""

    def scene(number):
        depth = disk_depth((32, 40), number)
        return np.zeros(depth.shape, np.uint8), depth if number % 3 else np.full_like(
            depth, 1800.0 + number
        )

    dataset = make_dataset(tmp_path / "tiny", views=("A0", "A60", "A120"), scene=scene)
    path = write_result_file(tmp_path / "r.json", dataset, 1.0, 3.0)
    row, result = read_entry(path).row, read_result(path)
    assert result.samples_without_background == 2 and [
        p.without_background for p in row.per_object
    ] == [1, 1]
    for key in HEADLINE:
        assert mean_over(row.per_object, key) == pytest.approx(
            getattr(result.metrics, key), rel=1e-4
        )
        assert interval_over(row.per_object, key) == pytest.approx(
            result.intervals.of(key), rel=1e-4
        )
    write_row(row, tmp_path / "row.json")
    assert read_entry(tmp_path / "row.json").row == row


@pytest.mark.parametrize(
    "line",
    [
        "measured",
        "{sha} | measured | {commit} | a machine | ",
        "{sha} | trusted | {commit} | a machine | a command",
        "{sha} | measured | HEAD | a machine | a command",
        "{sha} | measured | {commit} | a machine | a command\r",
    ],
)
def test_a_bad_line_of_the_list_is_named(line, listed, files):
    listed("")
    listed(line.format(sha="a" * 64, commit="b" * 40))
    with pytest.raises(
        SubmissionError, match=r"vouched\.txt, line 2: expected SHA-256 of a row file"
    ):
        read_entry(files[0])


def test_a_row_is_listed_once(listed, files):
    for word in ("measured", "verified"):
        listed(f"{'a' * 64} | {word} | {'b' * 40} | a machine | a command")
    with pytest.raises(SubmissionError, match="line 2: expected a hash that is listed once"):
        read_entry(files[0])


def test_fpp_eval_compares_results_and_rows(files, tmp_path, capsys):
    row, other = (write_row_of(path, tmp_path / path.name) for path in files[:2])
    for first, second in ((files[0], files[1]), (row, files[1]), (row, other)):
        assert fpp_eval("compare", first, second) == 0
    of_results, *of_rows = capsys.readouterr().out.split("first:")[1:]
    assert "samples" in of_results and all("of 2 objects" in text for text in of_rows)
    assert of_rows[0].strip() == of_rows[1].strip() and "sign-flip test" in of_rows[0]
    first, second = (re.search(r"object MAE.*", text)[0] for text in (of_results, of_rows[0]))
    assert first.split("│")[:3] == second.split("│")[:3]


def test_fpp_eval_verifies_a_row_from_its_predictions(files, dataset, tmp_path, capsys):
    row, predictions = (
        write_row_of(files[0], tmp_path / "row.json"),
        files[0].parent / "fast-predictions",
    )
    words = ["verify", str(row), str(predictions), str(dataset.path)]
    assert printed(fpp_eval, *words) == (
        f"verified: {row} is what 4 predictions give\n"
        "not checked: run time and its machine, software, code and environment: predictions don't "
        "tell them\n"
    )
    content = read_json(row)
    content["metrics"]["object_median_mm"] += 2e-4
    content["submission"]["settings"]["steps"] = 3
    content["predictions_sha256"] = "0" * 64
    content["robustness"] = {"test": robustness().model_dump()}
    content["submission"]["timing"]["latency_p95_ms"] = 1e6
    row.write_text(json.dumps(content))
    assert fpp_eval(*words) == 1
    verdict, *lines, last = capsys.readouterr().out.splitlines()
    assert "robustness" in last and "differs from what the predictions give in 3 places" in verdict
    assert [line.split(":")[0].strip() for line in lines] == [
        "submission.settings.steps",
        "predictions_sha256",
        "metrics.object_median_mm",
    ]
    content["protocol_version"] = "2.0.0"
    row.write_text(json.dumps(content))
    for command, arguments in ((fpp_eval, words), (fpp_bench, ["leaderboard", row])):
        assert "was scored by protocol 2.0.0" in refusal(command, *arguments)


@pytest.mark.parametrize(
    ("stored", "computed", "agree"),
    [
        (12.346, 12.3455000001, True),
        (12.346, 12.3454999, False),
        (12.345, 12.3456, False),
        (10.0, 9.99996, True),
        (1e-7, 0.0, False),
        (0.5, -0.5, False),
        (None, 0.0, False),
    ],
)
def test_a_mean_may_differ_by_what_five_digits_leave_open(stored, computed, agree):
    assert same(stored, computed, digits=5) is agree


@pytest.mark.parametrize(
    ("block", "provenance", "measured"),
    [
        (timing(2.0), "measured here", True),
        (timing(2.0), "verified", False),
        (timing(2.0, provenance="self-reported"), "measured here", False),
        (None, "measured here", True),
        (None, "self-reported", False),
    ],
)
def test_what_only_its_author_measured_is_marked(
    block, provenance, measured, dataset, tmp_path, listed, monkeypatch
):
    """Time, phase reliance and robustness of a stranger's row, whatever the row says."""
    monkeypatch.setattr(rows, "SHIPPED_ROWS", tmp_path)
    result = write_result_file(tmp_path / "r.json", dataset, 1.0, timing=block)
    row = read_entry(result).row
    blocks = {"reliance": reliance(), "robustness": {"test": robustness()}}
    write_row(row.model_copy(update=blocks), tmp_path / "row.json")
    if provenance != "self-reported":
        listed(tmp_path / "row.json", provenance.removesuffix(" here"))
    entry = read_entry(tmp_path / "row.json")
    assert entry.provenance == provenance
    assert entry.time_measured is measured
    mark = "" if provenance == "measured here" else "*"
    assert (columns.reliance(entry), columns.robustness(entry)) == (f"0.62{mark}", f"31.0{mark}")
    assert entry.latency_ms == (250.0 if block is None else 2.0)
    board = rank([entry])
    index = page_files(board, [])["index.html"].decode()
    body = index.split("<tbody>")[1].split("</tbody>")[0]
    assert ('class="p-self-reported">self-reported</small>' in body) is not measured
    assert ("point p-" + provenance.replace(" ", "-") + ('"' if measured else " hollow")) in index
    readme = readme_block(board)
    assert readme.startswith("No row yet") or ("&#42; |" in readme) is not measured
    assert readme.startswith("No row yet") == (provenance == "self-reported")
    table = printed(fpp_bench, "leaderboard", tmp_path / "row.json", "--paper", "none")
    assert (("0.25*" if block is None else "0.002*") in table) is not measured


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("row_schema_version", "1.0.0", "row_schema_version 3.0.0"),
        ("provenance", "measured here", "provenance: is not a key"),
        ("metrics", {}, "metrics.overall_mae_mm: is missing"),
        ("per_object", [], "per_object"),
        ("frames_class", "one frame", "frames_class is one frame, of 2 frames_used"),
        ("created", "today", "created"),
        ("predictions_sha256", "0", "predictions_sha256"),
        ("metrics.object_mae_mm", 1.0, "metrics.object_mae_mm does not follow from per_object"),
        ("metrics.object_mae_mm", None, "metrics.object_mae_mm does not follow from per_object"),
        (
            "intervals.object_mae_mm",
            [4.0, 4.1],
            "intervals.object_mae_mm does not follow from per_object",
        ),
        ("intervals.overall_rmse_mm", [None, None], "intervals.overall_rmse_mm does not follow"),
        ("per_object.0.object", "wooden_boards", "names an object twice"),
        ("per_object.0.samples", 1, "do not add up"),
        (
            "per_object.0.void_pixels",
            1,
            "object, background and void pixels do not add up to 2 images",
        ),
        (
            "per_object.0.object_mae_mm",
            None,
            "object scores must be null exactly when the set is empty",
        ),
        ("per_object.0.object_rmse_mm", 0.1, "object RMSE is below its MAE"),
        ("per_object.0.without_object", 2, "or no view has the set"),
        ("dataset.samples", 5, "per_object holds 4 samples, dataset.samples says 5"),
        ("dataset.content", {"test/flags": "a" * 32}, "dataset.content: expected hashes of"),
        ("submission.name", "Fast\u3164and rough", "U+3164, which shows nothing"),
    ],
)
def test_an_edited_row_is_refused_by_name(key, value, message, files, tmp_path):
    path = write_row_of(files[0], tmp_path / "edited.json")
    change_json(path, key, value)
    if key == "per_object.0.samples":
        change_json(path, "dataset.samples", 3)
    with pytest.raises(SubmissionError, match=re.escape(message)) as raised:
        read_entry(path)
    assert "edited.json" in str(raised.value)


def test_a_row_is_of_one_result_and_small(files, dataset, tmp_path):
    assert "a row of one result, 2 were given" in refusal(
        fpp_bench, "leaderboard", *files[:2], "--row", tmp_path / "r.json"
    )
    large = write_result_file(
        tmp_path / "l.json", dataset, 1.0, settings={f"key {n}": "x" * 90 for n in range(150)}
    )
    assert "r.json: the row has" in refusal(
        fpp_bench, "leaderboard", large, "--row", tmp_path / "r.json"
    )
    assert not (tmp_path / "r.json").exists()
    path = write_row_of(files[0], tmp_path / "padded.json")
    path.write_bytes(path.read_bytes() + b" " * 12_000)
    assert "padded.json: the row has" in refusal(fpp_bench, "leaderboard", path)
    assert "can't be written" in refusal(
        fpp_bench, "leaderboard", files[0], "--row", tmp_path / "no" / "r.json"
    )


def test_more_within_a_tolerance_is_better(dataset, tmp_path):
    paths = [
        write_result_file(tmp_path / f"{offset}.json", dataset, offset, name=f"off by {offset}")
        for offset in (0.5, 3.0, 20.0)
    ]
    (group,) = rank(read_entries(paths), "object_within_5mm_share")
    assert group.rows[-1].entry.name == "off by 20.0"


@pytest.mark.parametrize(
    "key", [key for key, metric in METRICS.items() if metric.helped_by_missing]
)
def test_no_rank_by_what_missing_pixels_improve(key, dataset, tmp_path):
    path = write_result_file(tmp_path / "a.json", dataset, 1.0)
    assert "a method could lead by answering few pixels" in refusal(
        fpp_bench, "leaderboard", path, "--sort", key
    )
    with pytest.raises(SubmissionError, match=key):
        rank(read_entries([path]), key)


def test_unnamed_results_do_not_get_into_a_page(files, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(rows, "SHIPPED_ROWS", tmp_path / "none")
    (tmp_path / "result.json").write_bytes(files[0].read_bytes())
    assert fpp_bench("leaderboard", "--page", tmp_path / "page") == 0
    assert "Fast and rough" not in (tmp_path / "page" / "index.html").read_text()


def test_shipped_rows_and_the_list_fit_each_other():
    """Each row is a row file that is listed or self-reported, each line of the list is one of
    theirs."""
    entries = read_entries(shipped_rows())
    hashes = [sha256(entry.path.read_bytes()).hexdigest() for entry in entries]
    assert entries and len(set(hashes)) == len(hashes) and set(rows.vouched()) <= set(hashes)
    for entry, digest in zip(entries, hashes, strict=True):
        assert entry.is_row_file and entry.path.stat().st_size <= LARGEST_ROW_BYTES
        assert entry.provenance == rows.vouched().get(digest, "self-reported")
        interval = entry.row.intervals.of("object_mae_mm")
        assert entry.row.timing is not None and (interval is None) == (
            len(entry.row.per_object) < 2
        )
