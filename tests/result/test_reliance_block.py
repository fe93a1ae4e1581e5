"""Phase reliance in result files and on the leaderboard: written, read back, shown, and refused
where it can't be."""

import json
import re

import pytest
from board_rows import reliance, write_result_file
from conftest import fpp_bench, printed, read_json, refusal
from scored_dataset import change_json
from upkeep import readme_block

from fpp_ml_bench.baselines.timing import check_same_method
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.result.file import read_result, result_json
from fpp_ml_bench.evaluation.result.parts import Reliance, RelianceParts
from fpp_ml_bench.leaderboard.page.page import page_files
from fpp_ml_bench.leaderboard.ranking import rank, read_entries
from fpp_ml_bench.leaderboard.rows import read_entry, write_block

SHA = "a" * 64


def block(**changes):
    return {**reliance().model_dump(), "weights_sha256": SHA, **changes}


@pytest.fixture
def file(tmp_path, dataset):
    return write_result_file(tmp_path / "row.json", dataset, 1.0, settings={"weights_sha256": SHA})


def test_a_result_without_it_stays_as_it_was(file):
    assert "reliance" not in read_json(file)
    assert read_result(file).reliance is None
    assert result_json(read_result(file)) == file.read_bytes()


@pytest.mark.parametrize("row", [False, True], ids=["result", "row"])
def test_it_is_written_read_back_and_replaced(row, file, tmp_path):
    if row:
        made = tmp_path / "made.json"
        assert fpp_bench("leaderboard", file, "--row", made) == 0
        file = made
    entry = read_entry(file)
    write_block(entry, Reliance(**block(score=0.1)))
    write_block(read_entry(file), Reliance(**block()))
    again = read_entry(file)
    assert again.is_row_file == row and again.row.reliance == Reliance(**block())
    changed = {"reliance": None, "result_sha256": entry.row.result_sha256}
    assert again.row.model_copy(update=changed) == entry.row
    if not row:
        assert read_result(file).reliance == Reliance(**block())
    before = file.read_bytes()
    write_block(again, Reliance(**block()))
    assert file.read_bytes() == before


@pytest.mark.parametrize(
    "change, message",
    [
        ({"score": 1.5}, "reliance.score"),
        ({"interval": [0.9, 0.1]}, "expected 0 <= low <= high <= 1"),
        ({"interval": [None, 0.1]}, "two numbers or two nulls"),
        ({"version": "0.9.0"}, "reliance.version"),
        ({"weights_sha256": "c" * 64}, "measured on weights cccc"),
        ({"units": "normalised"}, "an answer in normalised, scored was one in mm"),
        ({"objects": 5}, "objects is above samples"),
        ({"parts": {"follows_phase": 0.5}}, "is missing"),
        ({"surprise": 1}, "is not a key of this file"),
    ],
)
def test_what_contradicts_the_result_is_refused_by_name(change, message, file):
    change_json(file, "reliance", block(**change))
    with pytest.raises(SubmissionError, match=re.escape(message)) as caught:
        read_result(file)
    assert str(file) in str(caught.value)


def test_every_part_has_words():
    parts = RelianceParts.model_construct(**dict.fromkeys(RelianceParts.model_fields))
    assert len(parts.titled()) == len(RelianceParts.model_fields) and all(parts.titled())


def test_it_stands_on_the_leaderboard_beside_error_and_time(file, tmp_path, dataset):
    other = write_result_file(tmp_path / "other.json", dataset, 2.0, name="Not asked")
    write_block(read_entry(file), Reliance(**block()))
    groups = rank(read_entries([file, other]))
    shown = readme_block(groups)
    assert re.search(r"\| A method \|.*\| 0\.62 \|", shown) and re.search(
        r"\| Not asked \|.*\| not measured \|", shown
    )
    pages = page_files(groups, [])
    index = pages["index.html"].decode()
    assert "Phase reliance" in index and "0.50 to 0.75" in index and "not measured" in index
    details = [text.decode() for name, text in pages.items() if name.startswith("submissions/")]
    assert sum("What it reads" in text for text in details) == 1
    rows = json.loads(pages["data.json"])["groups"][0]["rows"]
    assert [row["phase_reliance"] for row in rows] == [0.625, None]
    assert [part.get("reliance", {}).get("score") for row in rows for part in row["parts"]] == [
        0.625,
        None,
    ]


class Method:
    reports = False

    def __init__(self):
        self.name, self.frames_used, self.units = "test", (0,), "mm"
        self.settings = {"weights_sha256": SHA, "threads": 8, "unheard_of": 1}


def test_it_belongs_to_the_very_method_that_was_scored(file):
    about = read_entry(file).row.submission
    check_same_method(file, about, Method())
    for key, value in (("name", "another"), ("frames_used", (1,)), ("units", "normalised")):
        other = Method()
        setattr(other, key, value)
        with pytest.raises(SubmissionError, match="very method that was scored"):
            check_same_method(file, about, other)
    other = Method()
    other.settings = {"weights_sha256": "c" * 64}
    with pytest.raises(SubmissionError, match=r"settings\.weights_sha256"):
        check_same_method(file, about, other)
    with pytest.raises(SubmissionError, match=r"settings\.\w+ is .*, but"):
        check_same_method(file, about, Method(), timed=True)


@pytest.mark.long
def test_the_command_measures_and_writes(tiny, tmp_path, capsys, dataset):
    from fpp_ml_bench.loaders.storage.store import DatasetFolder

    opened = DatasetFolder(tiny)
    used = [*opened.sequence.sinusoids("horizontal")[::6], *opened.sequence.gray("horizontal")]
    settings = {"direction": "horizontal", "steps": 3}
    row = write_result_file(
        tmp_path / "r.json", dataset, 1.0, method="classical", frames_used=used, settings=settings
    )
    options = ["--steps", "3", "--direction", "horizontal", "--views", "1"]
    assert (
        fpp_bench("reliance", "classical", tiny, *options, "--into", row, "--json", tmp_path / "b")
        == 0
    )
    written = read_result(row).reliance
    assert (
        written is not None and written.score > 0.9 and written.interval == [None, None]
    )  # one test object
    assert Reliance(**read_json(tmp_path / "b")) == written
    assert "phase reliance, 0 to 1" in capsys.readouterr().out
    assert "very method that was scored" in refusal(
        fpp_bench, "reliance", "classical", tiny, "--steps", "6", "--into", row
    )
    assert fpp_bench("reliance", "classical", tiny, "--views", "7") == 2
    capsys.readouterr()
    out = printed(fpp_bench, "reliance", "constant", tiny, "--views", "1")
    assert (
        "Constant depth: standoff: gives the same answer whatever phase, light and outline" in out
    )
    assert "follows" not in out and "changes" not in out
