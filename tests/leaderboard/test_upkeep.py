"""What keeps the repository's own rows and the tables of its pages: `benchmarks/upkeep.py`."""

import json
import re
from hashlib import sha256
from types import SimpleNamespace

import pytest
import shown_rows
import upkeep
from board_rows import changed, timing, write_result_file
from conftest import read_json
from scored_dataset import make_dataset
from upkeep import SHOWN, readme_block

from fpp_ml_bench.baselines.timing import check_same_method
from fpp_ml_bench.cli import BENCH, EVAL
from fpp_ml_bench.cli.diagnose import Scenes
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.result.parts import Robustness, SeverityScores
from fpp_ml_bench.leaderboard.ranking import rank, read_entries
from fpp_ml_bench.leaderboard.rows import SHIPPED_ROWS, read_entry
from fpp_ml_bench.loaders.render.scene import preset_settings

pytestmark = pytest.mark.long

BEGIN, END = "<!-- leaderboard:begin -->", "<!-- leaderboard:end -->"


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Results of one frame, one of which was told the range, two of a full sequence, and one of few
    frames."""
    work = tmp_path_factory.mktemp("rows")
    dataset = make_dataset(work / "tiny")
    rows = (
        ("Fast and rough", 4.0, {"frames_used": [0], "timing": timing(2.0)}),
        ("Slow and fine", 0.5, {"frames_used": [0], "timing": timing(50.0)}),
        (
            "Beaten",
            8.0,
            {"frames_used": [0], "seconds_per_sample": 0.08, "seconds_source": "self-reported"},
        ),
        ("Was told", 0.1, {"frames_used": [0], "uses_ground_truth_range": True}),
        ("Classical, best", 0.2, {"frames_used": [*range(50)], "method": "classical"}),
        ("Classical, worse", 0.3, {"frames_used": [*range(50)], "method": "classical"}),
        ("Few", 0.1, {"frames_used": [0, 1]}),
    )
    return [
        write_result_file(work / f"{name}.json", dataset, offset_mm, 0.1, name=name, **about)
        for name, offset_mm, about in rows
    ]


@pytest.fixture
def readme(tmp_path):
    path = tmp_path / "README.md"
    path.write_text(f"# Title\n\n{BEGIN}\n{END}\n\nMore.\n")
    return path


def block(path, files, check=False):
    return upkeep.write_readme(path, rank(read_entries(files)), check)


def test_readme_block_is_made_and_stays(readme, files, capsys):
    assert block(readme, files) == 0
    text = readme.read_text()
    assert text.startswith(f"# Title\n\n{BEGIN}\n\n") and text.endswith(f"\n{END}\n\nMore.\n")
    names = [line.split(" | ")[0][2:] for line in text.splitlines() if line.startswith("| ")][2:]
    assert names == ["Slow and fine", "Fast and rough", "Beaten", "Classical, best"]
    assert block(readme, files[::-1]) == 0 and readme.read_text() == text
    assert block(readme, files, check=True) == 0
    assert "is up to date with the rows" in capsys.readouterr().out


def test_readme_shows_the_best_of_a_group(files):
    count, entry = SHOWN + 4, read_entry(files[0])
    named = [
        changed(
            entry, submission={"name": f"Method {number:02}"}, predictions_sha256=f"{number:064}"
        )
        for number in range(count)
    ]
    text = readme_block(rank([*named, *map(read_entry, files[3:])]))
    # All share one error, so names decide.
    assert [n for n in range(count) if f"Method {n:02}" in text] == list(range(SHOWN))
    assert "Classical, best" in text and not re.search("Was told|Classical, worse|Few", text)


def test_readme_of_the_shipped_rows_is_one_short_table():
    groups = rank(read_entries(sorted(SHIPPED_ROWS.glob("*.json"))))
    text = readme_block(groups)
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]
    assert rows[0] == [
        "Method",
        "Assumes",
        "Two-sided MAE, mm (95% interval)",
        "Object MAE, mm",
        "Overall MAE, mm",
        "Time, ms",
        "Frames",
        "Phase reliance",
        "Without whole periods",
        "Disturbed, mm",
    ]
    frames, errors = (
        [int(row[6]) for row in rows[2:]],
        [float(row[2].split()[0]) for row in rows[2:]],
    )
    assert frames[:-1] == [1] * SHOWN and frames[-1] > 36 and errors[:-1] == sorted(errors[:-1])
    assert rows[2][2] == "1.885 (1.404 to 2.452)" and rows[2][3] == "2.751"
    assert "150 samples of 25 objects" in text and len(text.encode()) < 2048
    assert readme_block([]).startswith("No row yet.")


def test_a_hand_edited_block_fails_the_check_and_is_left_alone(readme, files, capsys):
    assert block(readme, files) == 0
    made = readme.read_text()
    for edited in (
        made.replace("| Slow", "| Slowest"),
        made.replace(END, f"A line too many.\n{END}"),
    ):
        readme.write_text(edited)
        assert block(readme, files, check=True) == 1
        assert (
            "don't edit it by hand, run: python benchmarks/upkeep.py readme"
            in capsys.readouterr().err
        )
        assert readme.read_text() == edited
    readme.write_text(made.replace("More.", "Text outside of the markers."))
    assert block(readme, files, check=True) == 0


@pytest.mark.parametrize(
    "text",
    [
        b"no markers",
        f"{END}\n{BEGIN}\n".encode(),
        f"{BEGIN}\n".encode(),
        b"\xff",
    ],
)
def test_markers_must_be_there(text, readme, capsys):
    readme.write_bytes(text)
    for more in ([], ["--check"]):
        assert upkeep.main(["readme", str(readme), *more]) == 2
        assert re.search("each once|is no UTF-8 text", capsys.readouterr().err)
    assert readme.read_bytes() == text
    assert upkeep.main(["readme", str(readme.with_name("none.md"))]) == 2


@pytest.mark.parametrize("row", ["classical-18-both", "phase-vertical"])
def test_a_rows_command_is_of_the_method_that_was_scored(row):
    name, *options = upkeep.METHODS[row].split()
    words = [name, "data", *options, "--out", "predictions"]
    command = BENCH.command("predict")
    chosen = command.values(command.make_context("fpp-bench predict", words))["chosen"]
    method = chosen.load(Scenes.of(preset_settings("test")), warn=False)
    path = SHIPPED_ROWS / f"{row}.json"
    check_same_method(path, read_entry(path).row.submission, method)


def test_a_row_stays_vouched_for_when_more_of_it_is_measured(files, tmp_path, monkeypatch):
    folder = tmp_path / "rows"
    folder.mkdir()
    row = folder / "mine.json"
    row.write_bytes(files[0].read_bytes())
    before = sha256(row.read_bytes()).hexdigest()
    (tmp_path / "vouched.txt").write_text(f"{before} | measured\n")
    ran = []

    def measure(words):
        ran.append(words)
        row.write_text(json.dumps(read_json(row)))
        return 0

    monkeypatch.setattr(upkeep, "fpp_bench", measure)
    words = ["reliance", "phase", "data/full", "--direction", "vertical"]
    assert upkeep.main(["measured", str(row), *words]) == 0
    assert ran == [[*words, "--into", str(row)]]
    after = sha256(row.read_bytes()).hexdigest()
    assert after != before and (tmp_path / "vouched.txt").read_text() == f"{after} | measured\n"


def test_the_page_of_commands_is_made_of_them(tmp_path, capsys):
    assert upkeep.main(["commands", "--check"]) == 0, "run: python benchmarks/upkeep.py commands"
    page = tmp_path / "commands.md"
    assert upkeep.main(["commands", str(page), "--check"]) == 1 and not page.exists()
    assert "run: python benchmarks/upkeep.py commands" in capsys.readouterr().err
    assert upkeep.main(["commands", str(page)]) == 0
    text = page.read_text()
    for program in (BENCH, EVAL):
        assert all(f"**`{program.name} {name} " in text for name in program.commands)
    assert (
        "fpp-eval predictions --json result.json\n" in text and "# plain load_dataset opens" in text
    )


def test_the_tables_of_robustness_stand_between_their_markers(tmp_path):
    assert all(
        f"<!-- {name}:{end} -->" in upkeep.ROBUSTNESS.read_text()
        for name in upkeep.SETS
        for end in ("begin", "end")
    )
    page = tmp_path / "page.md"
    page.write_text("a page without them")
    with pytest.raises(SubmissionError, match="expected <!-- test:begin -->"):
        upkeep.filled(page, {"test": ""})
    scores = SeverityScores(
        mae_mm=3.0,
        wrong_share=0.1,
        unanswered_share=0.0,
        invented_share=0.02,
        answered_mae_mm=3.0,
        **dict.fromkeys(("confident_share", "coverage", "sure_mae_mm", "sure_rmse_mm")),
    )
    block = Robustness(
        version=4,
        set="test",
        mae_mm=3.0,
        interval=[2.0, 4.0],
        clean=scores,
        axes={"motion": [scores] * 5, "camera-blur": [scores] * 5},
        beside={"dark-paint": [scores] * 5},
        drawn=["camera-blur"],
        samples=2,
        objects=2,
        size_px=960,
        weights_sha256=None,
    )
    results = [
        SimpleNamespace(
            submission=SimpleNamespace(name="A | method", method="mine", settings={}),
            robustness={"test": block},
        )
    ]
    assert upkeep.of_set("unseen", results) == []
    table = upkeep.robustness_tables(upkeep.of_set("test", results))
    assert "| A &#124; method | 3.0 | 2.0 to 4.0 | 3.0 | 1.0 | 3.0* | 3.0 |" in table.replace(
        "&#42;", "*"
    )
    assert "Not in the mean: dark-paint, dark-wall." in table


def test_nothing_that_the_documentation_shows_is_older_than_its_row(capsys):
    status = shown_rows.main(["--check"])
    assert status == 0, capsys.readouterr().out


def test_what_is_older_than_its_row_is_found(monkeypatch):
    figure = '[{}](../leaderboard/rows/crossed.json "object_mae_mm / two_sided_mae_mm")'
    metrics = read_entry(SHIPPED_ROWS / "crossed.json").row.metrics
    right = f"{metrics.object_mae_mm:.2f} / {metrics.two_sided_mae_mm:.1f}"
    assert shown_rows.wrong_figures(figure.format(right)) == []
    assert shown_rows.wrong_figures(figure.format("3.31 / 4.4")) == [
        f"3.31 / 4.4 of crossed: the row has {right}"
    ]
    page = "<!-- rows: crossed; frames object_mae_mm -->\nold\n<!-- end of rows -->"
    assert "| Crossed, 1 frame | 1 | 2.42 |" in shown_rows.with_tables(page)
    monkeypatch.setattr(shown_rows, "rows_hash", lambda: "of other rows")
    assert len(shown_rows.older_pictures()) == 2
