"""Row files and their provenance, ranks by interval, and README's generated block."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from board_rows import some_rows, timing, write_result_file
from scored_dataset import make_dataset

from fpp_ml_bench.cli import main
from fpp_ml_bench.cli.evaluate import main as fpp_eval
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import HELPED_BY_MISSING
from fpp_ml_bench.evaluation.report import palette_png
from fpp_ml_bench.leaderboard import rows
from fpp_ml_bench.leaderboard.page import page_files
from fpp_ml_bench.leaderboard.ranking import rank, read_entries, shipped_rows
from fpp_ml_bench.leaderboard.readme import BEGIN, END, SHOWN, readme_block
from fpp_ml_bench.leaderboard.rows import picture_of, read_entry, write_row


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return make_dataset(tmp_path_factory.mktemp("data") / "tiny")


@pytest.fixture(scope="module")
def files(tmp_path_factory, dataset):
    return some_rows(tmp_path_factory.mktemp("rows"), dataset)


def test_a_row_holds_the_result_and_its_provenance(files, tmp_path, capsys):
    row = tmp_path / "row.json"
    assert main(["leaderboard", str(files[0]), "--row", str(row), "--provenance", "verified"]) == 0
    assert capsys.readouterr().out == f"{row}: verified\n"
    entry, bare = read_entry(row), read_entry(files[0])
    assert entry.provenance == "verified" and entry.result == bare.result and bare.provenance == rows.LOCAL
    write_row(entry, "verified", tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == row.read_bytes()


def test_fpp_eval_compares_a_result_with_a_row(files, tmp_path, capsys):
    row = tmp_path / "row.json"
    write_row(read_entry(files[0]), "verified", row)
    for first, second in ((files[0], files[1]), (row, files[1])):
        assert fpp_eval(["compare", str(first), str(second)]) == 0
    of_file, of_row = capsys.readouterr().out.split("first:")[1:]
    assert of_file.strip() == of_row.strip() and "sign-flip test" in of_row


def test_a_bare_result_in_the_rows_folder_is_self_reported(files, tmp_path, monkeypatch):
    monkeypatch.setattr(rows, "SHIPPED_ROWS", tmp_path)
    (tmp_path / "mine.json").write_bytes(files[0].read_bytes())
    assert read_entry(tmp_path / "mine.json").provenance == "self-reported"


@pytest.mark.parametrize(
    ("block", "provenance", "measured"),
    [
        (timing(2.0), "measured here", True),
        (timing(2.0), "verified", False),
        (timing(2.0), "self-reported", False),
        (timing(2.0, provenance="self-reported"), "measured here", False),
        (None, "measured here", True),
        (None, "self-reported", False),
    ],
)
def test_a_strangers_time_is_never_measured_here(block, provenance, measured, dataset, tmp_path, capsys):
    result = write_result_file(tmp_path / "r.json", dataset, 1.0, timing=block)
    write_row(read_entry(result), provenance, tmp_path / "row.json")
    entry = read_entry(tmp_path / "row.json")
    assert entry.time_measured is measured
    assert entry.latency_ms == (250.0 if block is None else 2.0)
    board = rank([entry])
    index = page_files(board, [])["index.html"].decode()
    body = index.split("<tbody>")[1].split("</tbody>")[0]
    assert ('class="p-self-reported">self-reported</small>' in body) is not measured
    assert ("point p-" + provenance.replace(" ", "-") + ('"' if measured else " hollow")) in index
    assert ("&#42;" in readme_block(board).split("Made by")[0]) is not measured
    assert main(["leaderboard", str(tmp_path / "row.json"), "--paper", "none"]) == 0
    assert (("0.25*" if block is None else "0.002*") in capsys.readouterr().out) is not measured


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"row_schema_version": "9"}, "row_schema_version 1.0.0"),
        ({"provenance": "measured by me"}, "provenance"),
        ({"provenance": "reported by the paper"}, "provenance"),
        ({"result": {}}, "no schema_version"),
        ({"result": None}, "no schema_version"),
        ({"note": "<b>"}, "note: is not a key"),
    ],
)
def test_unsound_rows_are_refused_by_name(change, message, files, tmp_path, capsys):
    path = tmp_path / "odd.json"
    write_row(read_entry(files[0]), "verified", path)
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    assert main(["leaderboard", str(path)]) == 2
    error = capsys.readouterr().err
    assert "odd.json" in error and message in error


def test_an_edited_row_contradicts_itself(files, tmp_path):
    path = tmp_path / "edited.json"
    write_row(read_entry(files[0]), "verified", path)
    content = json.loads(path.read_text())
    content["result"]["metrics"]["object_mae_mm"] /= 2
    path.write_text(json.dumps(content))
    with pytest.raises(SubmissionError, match=r"metrics\.object_mae_mm does not follow"):
        read_entry(path)


def test_row_needs_one_result_and_a_known_provenance(files, tmp_path, capsys):
    assert main(["leaderboard", *map(str, files[:2]), "--row", str(tmp_path / "r.json")]) == 2
    assert "a row of one result, 2 were given" in capsys.readouterr().err
    with pytest.raises(SubmissionError, match="expected a provenance out of"):
        write_row(read_entry(files[0]), "trust me", tmp_path / "r.json")
    assert main(["leaderboard", str(files[0]), "--row", str(tmp_path / "no" / "r.json")]) == 2
    assert "can't be written" in capsys.readouterr().err


def test_more_within_a_tolerance_is_better(dataset, tmp_path):
    paths = [write_result_file(tmp_path / f"{o}.json", dataset, o, name=f"off by {o}") for o in (0.5, 3.0, 20.0)]
    ranked = rank(read_entries(paths), "object_within_5mm_share")[0].rows
    assert [row.entry.name for row in ranked][-1] == "off by 20.0"


@pytest.mark.parametrize("key", HELPED_BY_MISSING)
def test_no_rank_by_what_missing_pixels_improve(key, dataset, tmp_path, capsys):
    path = write_result_file(tmp_path / "a.json", dataset, 1.0)
    assert main(["leaderboard", str(path), "--sort", key]) == 2
    assert "a method could lead by answering few pixels" in capsys.readouterr().err
    with pytest.raises(SubmissionError, match=key):
        rank(read_entries([path]), key)


def _png(height: int, width: int) -> bytes:
    return palette_png(np.zeros((height, width), np.uint8), np.zeros((256, 3), np.uint8))


def test_the_picture_beside_a_row_is_shown_on_its_page(files, tmp_path):
    import base64

    path = tmp_path / "row.json"
    path.write_bytes(files[0].read_bytes())
    assert picture_of(read_entry(path)) is None
    path.with_suffix(".png").write_bytes(_png(20, 30))
    shown = page_files(rank([read_entry(path)]), [])
    page = next(content.decode() for name, content in shown.items() if name.startswith("submissions/"))
    assert base64.b64encode(_png(20, 30)).decode() in page and 'alt="Samples from' in page


@pytest.mark.parametrize(
    "content",
    [b"<svg onload=alert(1)>", b"", b"GIF89a" + bytes(40), _png(20, 30)[:20], _png(1, 5000), bytes(2_000_001)],
)
def test_a_picture_that_is_no_png_of_sensible_size_is_refused(content, files, tmp_path):
    path = tmp_path / "row.json"
    path.write_bytes(files[0].read_bytes())
    path.with_suffix(".png").write_bytes(content)
    with pytest.raises(SubmissionError, match=r"row\.png"):
        picture_of(read_entry(path))


def test_a_linked_picture_is_not_followed(files, tmp_path):
    path = tmp_path / "row.json"
    path.write_bytes(files[0].read_bytes())
    (tmp_path / "secret").write_bytes(_png(3, 3))
    path.with_suffix(".png").symlink_to(tmp_path / "secret")
    assert picture_of(read_entry(path)) is None


@pytest.fixture
def readme(tmp_path):
    path = tmp_path / "README.md"
    path.write_text(f"# Title\n\n{BEGIN}\n{END}\n\nMore.\n")
    return path


def block(path: Path, *arguments: object) -> int:
    return main(["leaderboard", *map(str, arguments), "--readme", str(path)])


def test_readme_block_is_made_and_stays(readme, files, capsys):
    assert block(readme, *files) == 0
    text = readme.read_text()
    assert text.startswith(f"# Title\n\n{BEGIN}\n\n") and text.endswith(f"\n{END}\n\nMore.\n")
    lines = [line.split(" | ")[0][2:] for line in text.splitlines() if re.search(r"\| \d+ \|.* \| local file", line)]
    assert lines == ["Slow and fine", "Fast and rough", "Beaten", "Was told"]
    assert block(readme, *files[::-1]) == 0 and readme.read_text() == text
    assert block(readme, *files, "--check") == 0
    assert "is up to date with the rows" in capsys.readouterr().out


@pytest.mark.parametrize("extra", [0, 1, 4])
def test_readme_shows_the_best_of_a_group(extra, files):
    count = SHOWN + extra
    entry = read_entry(files[0])
    about = entry.result.submission
    named = [
        replace(entry, result=entry.result.model_copy(update={"submission": about.model_copy(update={"name": name})}))
        for name in (f"Method {number:02}" for number in range(count))
    ]
    text = readme_block(rank([*named, read_entry(files[3])]))
    # All share one error, so names decide.
    assert [n for n in range(count) if f"Method {n:02}" in text] == list(range(5))
    assert [line for line in text.splitlines() if "more on the page" in line] == (
        [f"… and {extra} more on the page"] if extra else []
    )
    assert "Was told" in text


def test_a_hand_edited_block_fails_the_check_and_is_left_alone(readme, files, capsys):
    assert block(readme, *files) == 0
    made = readme.read_text()
    for edited in (made.replace("| Slow", "| Slowest"), made.replace(END, f"A line too many.\n{END}")):
        readme.write_text(edited)
        assert block(readme, *files, "--check") == 1
        assert "don't edit it by hand, run: fpp-bench leaderboard --readme" in capsys.readouterr().err
        assert readme.read_text() == edited
    readme.write_text(made.replace("More.", "Text outside of the markers."))
    assert block(readme, *files, "--check") == 0


@pytest.mark.parametrize("text", ["no markers", f"{END}\n{BEGIN}\n", f"{BEGIN}\n{BEGIN}\n{END}\n", f"{BEGIN}\n"])
def test_markers_must_be_there(text, readme, files, capsys):
    readme.write_text(text)
    for more in ([], ["--check"]):
        assert block(readme, *files, *more) == 2
        assert "each once" in capsys.readouterr().err
    assert readme.read_text() == text


def test_check_needs_a_readme(files, tmp_path, capsys):
    assert main(["leaderboard", str(files[0]), "--check"]) == 2
    assert "--readme" in capsys.readouterr().err
    assert block(tmp_path / "none.md", files[0]) == 2


def test_unnamed_results_get_into_neither_page_nor_readme(readme, files, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(rows, "SHIPPED_ROWS", tmp_path / "none")
    (tmp_path / "result.json").write_bytes(files[0].read_bytes())
    assert main(["leaderboard", "--readme", str(readme)]) == 0 and "Fast and rough" not in readme.read_text()
    assert main(["leaderboard", "--page", str(tmp_path / "page")]) == 0
    assert "Fast and rough" not in (tmp_path / "page" / "index.html").read_text()


def test_shipped_rows_are_timed_and_have_intervals():
    entries = read_entries(shipped_rows())
    assert entries and {entry.provenance for entry in entries} <= set(rows.PROVENANCES)
    for entry in entries:
        assert entry.result.timing is not None and entry.interval("object_mae_mm") is not None
