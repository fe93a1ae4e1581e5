"""The leaderboard: ranking, groups, the paper's rows, and what a hostile result file can do
(nothing)."""

import html
import re
from pathlib import Path

import numpy as np
import pytest
from board_rows import write_result_file
from conftest import file_bytes, fpp_bench, fpp_eval, printed, read_json, refusal
from scored_dataset import make_dataset

from fpp_ml_bench.leaderboard import rows
from fpp_ml_bench.leaderboard.ranking import cut_at_word
from fpp_ml_bench.leaderboard.tables import SHOWN_BY_DEFAULT, paper_tables
from fpp_ml_bench.paper import AVERAGE, paper_layers
from fpp_ml_bench.tables import markdown_text


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Run in an empty folder, with no shipped rows."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setattr(rows, "SHIPPED_ROWS", tmp_path / "none")


@pytest.fixture
def make(tmp_path, dataset):
    """Score predictions off by ``offset_mm`` and write the result as ``file``."""

    def act(file, offset_mm, **changes):
        path = tmp_path / "here" / file
        path.parent.mkdir(exist_ok=True)
        return write_result_file(path, dataset, offset_mm, **changes)

    return act


def board(*arguments):
    return printed(fpp_bench, "leaderboard", *arguments)


def ranked(tmp_path, *arguments: object) -> list[dict]:
    board(*arguments, "--json", tmp_path / "board")
    return read_json(tmp_path / "board")["groups"]


def test_ranks_by_object_error_with_time_beside_it(make, tmp_path):
    worse = make("a.json", 4.0, name="Worse", seconds_per_sample=0.001, frames_used=[0, 1])
    better = make(
        "b.json", 1.0, name="Better", frames_used=[0, 1, 2], seconds_source="self-reported"
    )
    out = board(worse, better)
    lines = [line for line in out.splitlines() if "Worse" in line or "Better" in line]
    assert re.search(r"Better.* 1\.000 .* 0\.25\* .* 3 ", lines[0])
    assert re.search(r"Worse.* 4\.000 .* 0\.001 .* 2 ", lines[1])
    assert [row["name"] for row in ranked(tmp_path, worse, better)[0]["rows"]] == [
        "Better",
        "Worse",
    ]
    by_time = ranked(tmp_path, worse, better, "--sort", "seconds_per_sample")[0]["rows"]
    assert [row["name"] for row in by_time] == ["Worse", "Better"]
    by_frames = ranked(tmp_path, better, worse, "--sort", "frames_used")[0]["rows"]
    assert [row["name"] for row in by_frames] == ["Worse", "Better"]


def test_unknown_time_comes_last(make, tmp_path):
    files = [make("a.json", 1.0, name="a", seconds_per_sample=None), make("b.json", 2.0, name="b")]
    rows = ranked(tmp_path, *files, "--sort", "seconds_per_sample")[0]["rows"]
    assert [(row["name"], row["latency_median_ms"]) for row in rows] == [("b", 250.0), ("a", None)]


def test_what_differs_in_data_or_rules_is_never_ranked_together(make, tmp_path):
    larger = make_dataset(tmp_path / "larger", size=(40, 40))
    files = [
        make("metric.json", 1.0),
        make("oracle.json", 1.0, uses_ground_truth_range=True),
        make("exact.json", 1.0, target="depth_exact"),
        make("train.json", 1.0, split="train"),
        write_result_file(tmp_path / "larger.json", larger, 0.0),
    ]
    groups = ranked(tmp_path, *files)
    assert [len(group["rows"]) for group in groups] == [1] * 5
    assert [group["track"] for group in groups] == ["metric"] * 4 + ["oracle range"]
    out = " ".join(board(*files).split())
    for words in (
        "metric track, test split, against exact depth",
        "oracle range track, test split, against decoded depth",
        "metric track, train split",
        "40 x 40 px, data",
    ):
        assert words in out


def test_results_of_the_current_folder_are_read(make):
    make("result.json", 1.0, name="In the folder")
    make("results/first.json", 2.0, name="In results")
    out = board()
    assert out.index("In the folder") < out.index("In results")


def test_new_user_is_told_what_to_do():
    out = board()
    assert "No results here yet" in out and "fpp-eval predictions data/mini --split test" in out
    assert "Reported by others on other data (not measured here)" in out and "TransUNet" in out
    assert "oracle range: given the test sample's depth range." in out


PAPER = {
    ("normalization", "raw"): (35.20, 85.64, 148.07, 214.37, 19.41, 52.38),
    ("normalization", "individual"): (2.30, 6.80, 16.20, 21.19, 0.92, 3.00),
    ("background_removed", "global"): (115.41, 191.63, 598.40, 723.93, 92.26, 151.88),
    ("multi_frame", "vertical"): (1.26, 5.54, 12.36, 16.94, 0.16, 2.29),
    ("loss", "masked_rmse"): (122.38, 673.08, 18.83, 23.02, 135.67, 714.82),
    ("loss", "hybrid_l1_0.7"): (3.31, 9.85, 14.54, 17.88, 2.01, 8.44),
    ("architecture", "pix2pix"): (5.48, 12.20, 27.73, 38.22, 3.16, 5.15),
}


def test_paper_rows_are_the_papers():
    """Spot values retyped from the paper's tables, and what its text derives from them."""
    tables = paper_tables()
    assert {name: len(table.rows) for name, table in tables.items()} == {
        "normalization": 3,
        "background_removed": 3,
        "multi_frame": 5,
        "loss": 10,
        "architecture": 4,
    }
    rows = {(table.name, row.row): row for table in tables.values() for row in table.rows}
    for table_and_row, errors in PAPER.items():
        assert tuple(rows[table_and_row].errors_mm.values()) == errors
    mae = {row.row: row.errors_mm["object_mae_mm"] for row in tables["architecture"].rows}
    # "UNet ... outperforming TransUNet by 29%, ResUNet by 60%"
    assert [
        round(100 * (mae[network] / mae["unet"] - 1)) for network in ("transunet", "resunet")
    ] == [29, 60]
    for (table, name), row in rows.items():
        ranged, masked = name not in ("raw", "global"), table == "background_removed"
        assert row.track == (
            ("oracle range + mask" if masked else "oracle range")
            if ranged
            else "oracle mask"
            if masked
            else "metric"
        )
        for pixels in ("overall", "object", "background"):
            assert 0 < row.errors_mm[f"{pixels}_mae_mm"] < row.errors_mm[f"{pixels}_rmse_mm"]
        # Overall is a mixture of the other two, also after averaging over samples.
        inside, outside = row.errors_mm["object_mae_mm"], row.errors_mm["background_mae_mm"]
        assert min(inside, outside) < row.errors_mm["overall_mae_mm"] < max(inside, outside)
    assert rows["multi_frame", "all"].test_samples == 1560


def test_probes_and_figures_of_the_paper():
    """Averages and ratios of Tables 7 and 8 follow from their layers, up to the printed digits."""
    for probe, above, below, digit in (
        ("linear_probing", "depth_mse", "edges_mse", 1e-6),
        ("grad_cam", "r_edges", "r_fringes", 1e-3),
    ):
        layers = paper_layers(probe)
        average = layers.pop(AVERAGE)
        for key in (above, below):
            assert average[key] == pytest.approx(
                np.mean([row[key] for row in layers.values()]), abs=digit
            )
        assert average["ratio"] == pytest.approx(average[above] / average[below], abs=0.01)
    # "strongest in the final decoder layer", which is our dec1
    assert (
        max(paper_layers("grad_cam"), key=lambda name: paper_layers("grad_cam")[name]["r_edges"])
        == "dec1"
    )
    note = paper_tables()["loss"].note
    assert "power_drill" in note and "hybrid_l1_0.7 12.21" in note
    assert paper_tables()["multi_frame"].figure is None


@pytest.mark.parametrize("choice", ["loss", "all", "none"])
def test_paper_tables_by_choice(choice, tmp_path):
    out = board("--paper", choice, "--markdown", tmp_path / "t.md")
    expected = paper_tables() if choice == "all" else () if choice == "none" else (choice,)
    for name in paper_tables():
        assert (f"{name}: " in out) == (name in expected)
        assert (f"{name}&#58; ".replace("_", "&#95;") in (tmp_path / "t.md").read_text()) == (
            name in expected
        )
    assert SHOWN_BY_DEFAULT == ("architecture", "normalization", "oracle_order")


def test_paper_rows_stay_out_of_the_ranking(make, tmp_path):
    board(make("a.json", 1.0), "--json", tmp_path / "board")
    content = read_json(tmp_path / "board")
    assert [row["name"] for group in content["groups"] for row in group["rows"]] == ["A method"]
    assert [table["name"] for table in content["reported_by_others"]] == list(SHOWN_BY_DEFAULT)


HOSTILE = (
    "| a `b` <script>alert(1)</script> [x](http://e) ![i](y) **z** @me www.e.org &amp; \\| #1 [red]"
)


def test_submitted_text_is_only_text(make, tmp_path):
    board(make("a.json", 1.0, name=HOSTILE), "--markdown", tmp_path / "t.md")
    lines = (tmp_path / "t.md").read_text().splitlines()
    (line,), head = [line for line in lines if "script" in line], lines[2]
    assert line.count("|") == head.count("|")
    short, *_, full = (cell.strip() for cell in line.split("|")[1:-1])
    for cell in (short, full):
        assert not set("`<>[]!*@\\:") & set(cell) and "www." not in cell
    assert html.unescape(full) == HOSTILE[:90] + ("..." if len(HOSTILE) > 90 else "")
    assert html.unescape(short) == cut_at_word(HOSTILE)


@pytest.mark.parametrize("name", ["**z** @me", "[red]x[/red]"])
def test_terminals_show_names_as_they_are(name, make, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    assert name in board(make("a.json", 1.0, name=name))


@pytest.mark.parametrize("text", ["a|b", "*", "Größe 3 µm", "WwW.x.y", "~~s~~", "1. x", "$x$"])
def test_markdown_text_shows_exactly_the_text(text):
    assert html.unescape(markdown_text(text)) == text
    assert not set("|*~$") & set(markdown_text(text)) and "www." not in markdown_text(text).lower()


def test_files_are_the_same_bytes_every_time(make, tmp_path):
    files = [make("a.json", 1.0, name="a"), make("b.json", 2.0, name="b")]
    for run, order in (("1", files), ("2", files[::-1])):
        out = tmp_path / run
        out.mkdir()
        board(*order, "--markdown", out / "board.md", "--json", out / "board.json")
    assert file_bytes(tmp_path / "1") == file_bytes(tmp_path / "2")


def test_unsound_files_are_refused_by_name(make, tmp_path, capsys):
    good, bad = make("good.json", 1.0, name="good"), make("bad.json", 2.0, name="bad")
    bad.write_text(bad.read_text().replace('"object_mae_mm": 2.0', '"object_mae_mm": 1.0', 1))
    assert fpp_bench("leaderboard", good, bad, "--markdown", tmp_path / "t.md") == 2
    captured = capsys.readouterr()
    assert "bad.json" in captured.err and "does not follow" in captured.err
    assert captured.out == "" and not (tmp_path / "t.md").exists()


@pytest.mark.long
def test_the_files_that_this_package_writes_are_told_apart(tiny, make, capsys):
    first, second = make("a.json", 1.0, name="a"), make("b.json", 2.0, name="b")
    board(first, second, "--json", "board.json")
    assert fpp_eval("compare", first, second, "--json", "comparison.json") == 0
    assert fpp_bench("tradeoff", tiny, "--quick", "--method", "constant") == 0
    for path, what in (
        (tiny / "manifest.json", "the manifest of a dataset"),
        ("board.json", "a ranking"),
        ("comparison.json", "a comparison"),
        ("tradeoff/tradeoff.json", "what fpp-bench tradeoff measured"),
    ):
        capsys.readouterr()
        error = refusal(fpp_bench, "leaderboard", first, path)
        assert error.count("\n") == 1 and f"{path} is not a result file but {what}" in error
    for words in (["compare", first, "board.json"], ["verify", "board.json", "p", "data"]):
        assert "board.json is not a result file but a ranking" in refusal(fpp_eval, *words)
    board(first, "--row", "row.json")
    assert fpp_eval("compare", "row.json", second) == 0


def test_named_results_are_shown_without_tables_of_others(make):
    first = make("a.json", 1.0)
    out = board(first)
    assert "Reported by others" not in out and out.count("┡") == 1
    assert out.endswith(
        "Not shown: 3 tables that others reported on other data (--paper all), and the "
        "leaderboard's own 0 rows "
        "(fpp-bench leaderboard without a file).\n"
    )
    assert out.count("Not shown") == 1
    for shown in (board(), board(first, "--paper", "all"), board(first, "--paper", "loss")):
        assert "Reported by others" in shown and "Not shown" not in shown
    assert "Not shown" not in board(first, "--paper", "none")
    board(first, "--markdown", "board.md")
    assert "Reported by others" in Path("board.md").read_text()


def test_what_can_not_be_read_or_written_and_repetition_are_refused(make, tmp_path):
    first, second = make("first.json", 1.0), make("second.json", 2.0)
    message = refusal(fpp_bench, "leaderboard", first, second)
    assert "first.json" in message and "second.json" in message and "another name" in message
    assert "given twice" in refusal(
        fpp_bench, "leaderboard", first, first.parent / ".." / "here" / "first.json"
    )
    (tmp_path / "empty").mkdir()
    assert "found none" in refusal(fpp_bench, "leaderboard", tmp_path / "empty")
    assert "nowhere.json: can't be read: No such file" in refusal(
        fpp_bench, "leaderboard", "nowhere.json"
    )
    out = tmp_path / "no" / "board.json"
    assert "can't be written" in refusal(fpp_bench, "leaderboard", first, "--json", out)


@pytest.mark.parametrize("width", [80, 100, 300])
def test_numbers_stay_whole_in_narrow_terminals(width, make, monkeypatch):
    name = "A rather long name of a method, with both directions and 18 steps"
    path = make("a.json", 1234.5, name=name)
    monkeypatch.setenv("COLUMNS", str(width))
    out = board(path, "--sort", "object_edge_mae_mm", "--paper", "none")
    assert all(len(line) <= width for line in out.splitlines())
    assert f"│ {cut_at_word(name)} │" in out
    assert out.count("1234.500") == {80: 2, 100: 3, 300: 6}[width]
    header = out.split("┡")[0]
    assert "Edge" in header, "the rows are sorted by it"
    assert ("Left out at" in out) == (width < 300)
