"""Rows that are consistent with themselves and not with the world: refused by name, or beside the
ranks."""

import csv
import io
import json
import re
import unicodedata
from functools import partial

import pytest
from board_rows import entry_with_errors, flat_scores, named_benchmarks
from upkeep import readme_rows

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.metrics import RANKED
from fpp_ml_bench.leaderboard import rows
from fpp_ml_bench.leaderboard.ranking import rank, read_entries, shipped_rows
from fpp_ml_bench.leaderboard.row_file import (
    ObjectMeans,
    Row,
    interval_over,
    mean_over,
    row_json,
    write_row,
)
from fpp_ml_bench.leaderboard.rows import read_entry
from fpp_ml_bench.leaderboard.tables import table_csv

OBJECTS = [f"object {n}" for n in range(8)]
HONEST = {"first": 1.0, "second": 2.0, "third": 3.0}
MINI, OTHER, FULL, UNSEEN = ({"test/depth": digit * 32} for digit in "abcd")


@pytest.fixture
def board(base, tmp_path, monkeypatch):
    """Three vouched rows of a named benchmark in the leaderboard's folder; gives a function that
    adds a row file of these contents and reads and ranks all."""
    folder = tmp_path / "rows"
    folder.mkdir()
    monkeypatch.setattr(rows, "SHIPPED_ROWS", folder)
    monkeypatch.setattr(rows, "VOUCHED", tmp_path / "vouched.txt")
    (tmp_path / "vouched.txt").write_text("")
    honest = {name: row_with(base, name, error) for name, error in HONEST.items()}
    counts = {
        p.object: [p.samples, p.object_pixels, p.void_pixels] for p in honest["first"].per_object
    }
    named_benchmarks(monkeypatch, counts, mini=MINI, full=FULL, unseen=UNSEEN)
    for name, row in honest.items():
        vouch(row, write_row(row, folder / f"{name}.json"))

    def add(*contents):
        for number, content in enumerate(contents):
            (folder / f"forged-{number}.json").write_text(json.dumps(content))
        return rank(read_entries(shipped_rows()))

    return add


def row_with(base, name, error, content=MINI, objects=OBJECTS, **about):
    """A row whose error on object n is ``error`` (1 + n / 10) mm."""
    errors = {each: error * (1 + n / 10) for n, each in enumerate(objects)}
    return entry_with_errors(base, errors, name, content, **about).row


def vouch(row, data):
    with rows.VOUCHED.open("a") as file:
        file.write(rows.vouching_line(row, data, "measured", "a command") + "\n")


def content_of(row):
    return json.loads(row_json(row))


def consistent(content):
    """``content`` with means, intervals and samples that follow from its objects: a forger can
    compute, too."""
    parts = [ObjectMeans(**part) for part in content["per_object"]]
    height, width = content["dataset"]["size"]
    content["metrics"] |= flat_scores(parts, height * width)
    for key in RANKED:
        content["intervals"][key] = list(interval_over(parts, key) or (None, None))
    content["dataset"]["samples"] = sum(part.samples for part in parts)
    Row.model_validate(
        {**content, "dataset": {**content["dataset"], "content": OTHER}}
    )  # sound but for the world
    return content


def invented_objects(content):
    for part in content["per_object"]:
        part["object"] = f"my {part['object']}"
    return consistent(content)


def one_easy_object(content):
    del content["per_object"][1:]
    return consistent(content)


def void_over_the_object(content):
    part = content["per_object"][0]
    part |= {"void_pixels": 100, "object_pixels": part["object_pixels"] - 100}
    return consistent(content)


def more_views(content):
    for key in ("samples", "object_pixels", "background_pixels"):
        content["per_object"][0][key] *= 2
    return consistent(content)


def no_error(content):
    for part in content["per_object"]:
        part |= dict.fromkeys(RANKED, 0.0)
    return consistent(content)


def a_view_left_out(content):
    part = content["per_object"][0]
    part |= {"without_object": 1, "background_pixels": part["background_pixels"]}
    return consistent(content)


def changed(block, **changes):
    def act(content):
        content[block] |= changes
        return content

    return act


def overall_above_object(content):
    content["per_object"][0] |= {"overall_mae_mm": 9.0, "overall_rmse_mm": 9.0}
    for key in ("overall_mae_mm", "overall_rmse_mm"):
        parts = [ObjectMeans(**part) for part in content["per_object"]]
        content["metrics"][key], content["intervals"][key] = (
            mean_over(parts, key),
            list(interval_over(parts, key)),
        )
    return content


scores = partial(changed, "metrics")
named = partial(changed, "submission")


@pytest.mark.parametrize(
    ("forge", "message"),
    [
        (invented_objects, "has no object 'my object 0'"),
        (one_easy_object, "has the object 'object 1'"),
        (void_over_the_object, "object pixels of 'object 0', this file says"),
        (more_views, "has 2 samples of 'object 0', this file says 4"),
        (no_error, "every error is exactly 0"),
        (
            changed("dataset", content=OTHER, benchmark={"name": "fpp-bench-mini", "version": 2}),
            "benchmark says fpp-bench-mini version 2, but content is not that benchmark's",
        ),
        (
            a_view_left_out,
            "has 0 views without object or background of 'object 0', this file says 1",
        ),
        (scores(object_max_mm=0.0), "out of order"),
        (
            scores(object_median_mm=0.0, object_p95_mm=0.0),
            "MAE is above what median, 95th percentile and maximum",
        ),
        (scores(object_max_mm=900.0, object_p95_mm=800.0), "above what MAE and RMSE leave to it"),
        (
            scores(object_within_1mm_share=1.0, object_within_2mm_share=0.5),
            "a wider tolerance holds fewer pixels",
        ),
        (
            scores(**{f"object_within_{k}mm_share": 0.1 for k in (1, 2, 5, 10)}),
            "contradicts the errors",
        ),
        (
            scores(object_interior_mae_mm=0.0, object_edge_mae_mm=0.0),
            "those of its parts and object_edge_share",
        ),
        (scores(object_interior_rmse_mm=0.01), "object_interior RMSE is below its MAE"),
        (
            scores(object_valid_mae_mm=0.0, object_valid_bias_mm=0.0),
            "its parts and object_missing_share",
        ),
        (scores(object_median_mm=None), "null all together"),
        (changed("dataset", size=[40, 32]), "has images of [32, 40], got"),
        (scores(void_share=0.5), "metrics.void_share does not follow"),
        (scores(object_mae_range_share=1e-6), "no object of the benchmark is deeper than 600 mm"),
        (scores(object_missing_share=1.1), "less than or equal to 1"),
        (
            overall_above_object,
            "object 0: overall MAE does not follow from object, background and their pixels",
        ),
        (scores(object_mae_mm=1e300), "expected a finite one up to 1e+100"),
        (
            lambda content: content | {"uncertainty": {"sure_mae_mm": 9.0}},
            "does not follow from uncertainty.sure_mae_mm",
        ),
        (named(name="first"), "both hold 'first' on the same data"),
        (named(name="f\u0456r\u0455t"), "or what looks like it"),  # Cyrillic
        (named(name="f\u03b9rst"), "or what looks like it"),  # Greek
        (named(name="flrst."), "or what looks like it"),  # a small L, a dot
        (named(name="fi\u0433\u0301st"), "or what looks like it"),  # a mark
        (
            named(name="\u13e1irst"),
            "'\u13e1irst' is 'first', or looks like it",
        ),  # no twin that the table has
        (named(name="first\u2800"), "U+2800"),
        (named(name="\uff26irst  "), "or what looks like it"),  # full-width, and spaces
        (named(name="fir\u017ft"), "or what looks like it"),  # a long s
        (named(name="fir\u200bst"), "U+200B"),
        (named(name="fir\u034fst"), "U+034F"),
        (named(name="firs\u0301\u0301t"), "U+0301 on another mark"),
    ],
)
def test_a_forged_row_is_refused_by_name(forge, message, base, board):
    content = content_of(row_with(base, "forged", 0.5))
    with pytest.raises(SubmissionError, match="forged-0") as raised:
        board(forge(content))
    assert message in str(raised.value)


def test_as_many_samples_as_no_result_has_are_not_counted_out(base, board):
    content = content_of(row_with(base, "forged", 0.5, OTHER))
    content["dataset"] |= {"samples": 10**9, "size": [1, 2]}
    content["per_object"] = [content["per_object"][0] | {"samples": 10**9, "object_pixels": 10**9}]
    content["per_object"][0]["background_pixels"] = 10**9
    with pytest.raises(SubmissionError, match="expected at most 10000, got 1000000000"):
        board(content)


@pytest.mark.parametrize(
    "name",
    [
        "\u03c6-net",
        "\u041c\u0435\u0442\u043e\u0434",
        "\u4f4d\u76f8",
        "C++",
        "first!",
        "furst",
        "x; y - z|w",
    ],
)
def test_other_names_pass(name, base, board):
    """As they are, also in a table that a spreadsheet opens."""
    groups = board(content_of(row_with(base, name, 0.5)))
    assert ranks(groups)[name] == "(1)" and name in table_csv(groups)


def ranks(groups):
    (group,) = groups
    return {row.entry.name: row.ranks for row in group.rows}


@pytest.mark.parametrize(
    "rules", [{"edge_band_px": 0}, {"submission": {"uses_ground_truth_mask": True}}]
)
def test_a_strangers_table_stands_behind_those_that_are_vouched_for(rules, base, board):
    """Also where its key sorts first; README shows nothing of it."""
    content = content_of(row_with(base, "forged", 0.5))
    for key, value in rules.items():
        content[key] = content[key] | value if isinstance(value, dict) else value
    first, second = board(content)
    assert first.vouched and [row.entry.name for row in second.rows] == ["forged"]
    assert first.title != second.title and ("edge band 0 px" in second.title) == (
        "edge_band_px" in rules
    )
    assert {row.entry.name for _, row in readme_rows([first, second])} == set(HONEST)
    assert readme_rows([second]) == []


def test_a_vouched_rows_name_is_taken_in_every_table(base, board):
    """But for the same method, whose results elsewhere have its name."""
    content = content_of(row_with(base, "first", 0.5)) | {"edge_band_px": 0}
    assert len(board(content)) == 2
    content["submission"]["method"] = "another"
    with pytest.raises(
        SubmissionError, match=r"forged-0\.json: the name 'first' is 'first'.*give it another name"
    ):
        board(content)


def test_an_invented_but_consistent_row_stands_beside_the_ranks(base, board):
    """Nothing in such a row tells: it has its error and its place, and ranks nobody."""
    assert ranks(board()) == {"first": "1", "second": "2", "third": "3"}
    (group,) = board(
        content_of(row_with(base, "forged", 0.001)), content_of(row_with(base, "also", 2.5))
    )
    assert ranks([group]) == {
        "first": "1",
        "second": "2",
        "third": "3",
        "forged": "(1)",
        "also": "(3)",
    }
    forged = next(row for row in group.rows if row.entry.name == "forged")
    assert forged.provenance == "self-reported" and forged.interval("object_mae_mm") is not None


def test_strangers_widen_nobodys_rank(base, board):
    """Each row more would ask for smaller p values: of six objects one takes all verdicts, ten make
    1-5 a 1-15."""
    six = OBJECTS[:6]
    vouched = [row_with(base, name, error, OTHER, six) for name, error in HONEST.items()][:2]
    for row in vouched:
        vouch(row, write_row(row, rows.SHIPPED_ROWS / f"{row.submission.name}-six.json"))
    strangers = [
        content_of(row_with(base, f"copy {n}", 1.5 + n / 1e4, OTHER, six)) for n in range(10)
    ]
    for added in ([], strangers[:1], strangers):
        shown = {row.entry.name: row.ranks for row in board(*added)[-1].rows}
        assert (shown.pop("first"), shown.pop("second")) == ("1", "2") and set(shown.values()) <= {
            "(2)"
        }


def test_local_results_are_ranked_where_nobody_vouches(base, board, tmp_path):
    """Beside vouched rows they have a place; without any they are ranked, and strangers' rows are
    not."""
    mine = [row_with(base, name, error) for name, error in (("mine", 1.5), ("mine, again", 2.5))]
    files = [tmp_path / f"{row.submission.name}.json" for row in mine]
    for row, path in zip(mine, files, strict=True):
        write_row(row, path)
    board()
    assert ranks(rank(read_entries([*shipped_rows(), *files]))) == {
        "first": "1",
        "second": "2",
        "third": "3",
        "mine": "(2)",
        "mine, again": "(3)",
    }
    rows.VOUCHED.write_text("")
    assert ranks(rank(read_entries([*shipped_rows(), *files]))) == {
        "mine": "1",
        "mine, again": "2",
        "first": "(1)",
        "second": "(2)",
        "third": "(3)",
    }
    (group,) = rank(read_entries(shipped_rows()))
    assert group.notes == ("No ranks: nobody vouches for a row here.",) and {
        row.ranks for row in group.rows
    } == {"-"}


def test_rows_with_the_same_predictions_are_one(base, board):
    """The vouched one is shown, whatever its file is called, and the others are named in a note."""
    copies = [row_with(base, name, 0.5) for name in ("a copy", "another")]
    copies.append(row_with(base, "of another class", 2.0, frames_used=[0, 1]))
    predictions = read_entry(rows.SHIPPED_ROWS / "second.json").row.predictions_sha256
    same = {"predictions_sha256": predictions}
    (group,) = board(*(content_of(copy) | same for copy in copies))
    assert ranks([group]) == {"first": "1", "second": "2", "third": "3"}
    assert [note.partition(": ")[2] for note in group.notes] == [
        "a copy (forged-0.json).",
        "another (forged-1.json).",
        "of another class (forged-2.json).",
    ]
    wrong = (
        "same predictions as second (second.json) but not the same errors, so one of the two files "
        "is wrong"
    )
    assert [wrong in note for note in group.notes] == [True, True, False]


def test_a_vouched_half_is_not_joined_with_a_strangers(base, board):
    half = row_with(base, "joined", 0.5, FULL)
    vouch(half, write_row(half, rows.SHIPPED_ROWS / "half.json"))
    with pytest.raises(
        SubmissionError, match=r"half\.json and .*forged-0\.json both hold 'joined'.*vouch for one"
    ):
        board(content_of(row_with(base, "joined", 0.1, UNSEEN, [f"unseen {n}" for n in range(8)])))


@pytest.mark.parametrize(
    "start",
    [
        "=",
        "+",
        "-",
        "\uff1d",
        "\uff20",
        " =",
        "\u00a0 =",
        "'=",
        "\u201c\u2019@",
        "` '=",
        "(=",
        "\u3000=",
    ],
)
def test_no_spreadsheet_runs_a_cell(start, base, board):
    name = f"{start}HYPERLINK(1)"
    content = content_of(row_with(base, name, 0.5, method=name))
    content["dataset"]["code"] = name
    lines = list(csv.DictReader(io.StringIO(table_csv(board(content)))))
    cells = next(line for line in lines if line["source"] == "forged-0.json")
    assert [cells[key] for key in ("name", "method", "code")] == [f"'{name}"] * 3
    assert cells["short_name"].startswith("'") and next(
        line for line in lines if line["name"] == "first"
    )


@pytest.mark.parametrize("start", [";=", ",+", "| @", '";"=', ";;=", "\uff1b\uff1d", ';"-'])
def test_no_spreadsheet_runs_a_part_of_a_cell(start, base, board):
    """Cells end where a spreadsheet splits lines, which need not be at the commas."""
    name = f"x{start}1+1"
    (line,) = (
        line
        for line in table_csv(board(content_of(row_with(base, name, 0.5)))).split("\n")
        if "1+1" in line
    )
    cells = re.split("[;,|]", unicodedata.normalize("NFKC", line))
    assert not any(
        re.match(r"[\W_]*[=+@-]", cell.replace("'", "x")) for cell in cells if "1+1" in cell
    )
