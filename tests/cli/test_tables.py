"""Tables of the terminal at several widths: what names a row is never cut, and what is left out is
said."""

import io
import re

import pytest
from conftest import fpp_bench
from rich.console import Console
from rich.text import Text

from fpp_ml_bench.evaluation.report.comparison import compare as compare_results
from fpp_ml_bench.evaluation.report.terminal import comparison_table, result_table
from fpp_ml_bench.evaluation.score.evaluator import evaluate as evaluate_folder
from fpp_ml_bench.leaderboard.ranking import rank as rank_files
from fpp_ml_bench.leaderboard.ranking import read_entries, shipped_rows
from fpp_ml_bench.leaderboard.tables import chosen_tables, group_tables, paper_rich_tables
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.tables import Table

WIDTHS = (80, 120, 200)


@pytest.fixture(scope="module")
def result(tiny, tmp_path_factory):
    """Of a method that states its uncertainty."""
    folder = tmp_path_factory.mktemp("scored") / "predictions"
    assert fpp_bench("predict classical", tiny, "--out", folder) == 0

    scored = evaluate_folder(folder, DatasetFolder(tiny), "test")
    assert scored.uncertainty is not None
    return scored


def printed(parts, width):
    console = Console(width=width, file=io.StringIO(), markup=False, emoji=False, highlight=False)
    for part in parts:
        console.print(part)
    text = console.file.getvalue()
    assert max(map(len, text.splitlines())) <= width
    return text


def tables_in(text, name_column):
    """Of each table the cells of its columns by title, and the titles that the line below it says
    are left out."""
    tables = []
    for block, below in re.findall(r"┏(.*?)└[^\n]*\n([^┏]*)", text, flags=re.DOTALL):
        head, body = block.split("┡")
        lines = [line.split("┃")[1:-1] for line in head.splitlines() if "┃" in line]
        titles = [" ".join(" ".join(cells).split()) for cells in zip(*lines, strict=True)]
        rows = []
        for line in (line.split("│")[1:-1] for line in body.splitlines() if "│" in line):
            cells = [cell.strip() for cell in line]
            if cells[name_column]:
                rows.append(cells)
            else:  # the second line of a text that is wrapped between words
                rows[-1] = [
                    f"{above} {cell}".strip() for above, cell in zip(rows[-1], cells, strict=True)
                ]
        left_out = re.search(
            r"Left out at \d+ columns: (.*?)\. A wider terminal", " ".join(below.split())
        )
        columns = dict(zip(titles, zip(*rows, strict=True), strict=True))
        tables.append((columns, left_out[1].split("; ") if left_out else []))
    return tables


def check(parts, width, name_column=0):
    """Every column is shown as it is in a terminal without end, or named as left out."""
    narrow, whole = (tables_in(printed(parts, columns), name_column) for columns in (width, 2000))
    assert len(narrow) == len(whole) > 0
    for (columns, left_out), (every, _) in zip(narrow, whole, strict=True):
        assert columns == {title: every[title] for title in columns}
        assert sorted([*columns, *left_out]) == sorted(every)
        assert list(columns)[: name_column + 1] == list(every)[: name_column + 1]
        assert len(columns) > name_column + 1
    return narrow


@pytest.mark.parametrize("width", WIDTHS)
def test_a_result_keeps_its_pixel_sets_objects_and_samples(result, width):
    scores, uncertainty, worst = check([result_table(result)], width)
    names = ("overall", "object", "background", "object, 1 px or more from edges", "object, nearer")
    assert scores[0]["Pixel set"][:3] == names[:3] and scores[0]["Pixel set"][4] == names[4]
    assert uncertainty[0]["Stated uncertainty"] == ("all", "power_drill")
    assert set(worst[0]["Sample"]) <= {row.sample for row in result.per_sample}
    assert {"MAE mean", "RMSE mean"} <= set(scores[0])
    assert width < 120 or not scores[1]


@pytest.mark.parametrize("width", WIDTHS)
def test_a_comparison_keeps_its_errors(result, width):
    ((columns, _),) = check([comparison_table(compare_results(result, result))], width)
    errors = (
        f"{pixels} {error}"
        for pixels in ("overall", "object", "background")
        for error in ("MAE", "RMSE")
    )
    assert columns["Error"] == (*errors, "two-sided MAE")


@pytest.fixture(scope="module")
def groups():
    return rank_files(read_entries(shipped_rows()))


@pytest.mark.long
@pytest.mark.parametrize("width", WIDTHS)
def test_the_shipped_rows_keep_their_names_and_their_errors(groups, width):
    for group in groups:
        ranked = any(row.best_rank is not None for row in group.rows)
        ((columns, left_out),) = check(group_tables([group]), width, int(ranked))
        assert columns["Method"] == tuple(row.short_name for row in group.rows)
        assert {"Two-sided MAE", "Object MAE"} & set(columns) and {"Object MAE", "s/sample"} <= {
            *columns,
            *left_out,
        }
        assert left_out or width == 200


@pytest.mark.parametrize("width", WIDTHS)
def test_tables_of_others_keep_their_rows(width):
    tables = chosen_tables("all")
    for (columns, _), table in zip(check(paper_rich_tables(tables), width), tables, strict=True):
        assert columns["Row"] == tuple(row.label for row in table.rows) and "Object MAE" in columns


@pytest.mark.parametrize(
    ("sort", "title"),
    [
        ("object_edge_mae_mm", "Edge MAE"),
        ("object_p95_mm", "object p95"),
        ("seconds_per_sample", "s/sample"),
    ],
)
def test_what_rows_are_sorted_by_is_never_left_out(groups, sort, title):
    text = printed(group_tables(rank_files([row.entry for row in groups[0].rows], sort)), 80)
    assert title in tables_in(text, 1 if " Rank " in text.split("┡")[0] else 0)[0][0]


def test_columns_are_left_out_in_the_declared_order():
    def titles(width):
        table = Table(
            "name", numbers=("a", "b", "c", "d"), first_out=("b", "a"), elsewhere="--json FILE"
        )
        table.add_row("a name of 21 letters.", *["1234567"] * 4)
        text = printed([table], width)
        assert "a name of 21 letters." in text
        assert ("and so does --json FILE." in " ".join(text.split())) == (width < 65)
        return "".join(tables_in(text, 0)[0][0]).removeprefix("name")

    assert [titles(width) for width in (65, 64, 55, 54, 45, 44, 35)] == [
        "abcd",
        "acd",
        "acd",
        "cd",
        "cd",
        "c",
        "c",
    ]


def test_a_name_wider_than_the_terminal_is_wrapped_and_not_cut():
    table = Table("name", numbers=("value", "other"))
    table.add_row(Text("a name that is longer than the whole terminal is, [red]"), "1.234", "5.678")
    text = printed([table], 30)
    assert tables_in(text, 1)[0][1] == ["other"]
    assert " ".join(line.split("│")[1].strip() for line in text.splitlines() if "│" in line) == (
        "a name that is longer than the whole terminal is, [red]"
    )
