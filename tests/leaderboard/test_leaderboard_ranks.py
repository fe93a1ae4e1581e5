"""Ranks by paired tests, the rows that join two test sets, classes, and how far a row is from a
trivial one."""

import csv
import io
import json
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from board_rows import changed, entry_with_errors, named_benchmarks
from conftest import fpp_bench, printed, read_json
from scored_dataset import write_predictions

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import FRAMES_CLASSES, Track
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.score.uncertainty import (
    behind,
    holm,
    pairs,
    sign_flip_bounds,
    sign_flip_p,
)
from fpp_ml_bench.evaluation.submission.description import LearnedFrom, Submission
from fpp_ml_bench.leaderboard.columns import columns, given_truth, learned_from, surest, uncertainty
from fpp_ml_bench.leaderboard.ranking import rank
from fpp_ml_bench.leaderboard.row_file import RowUncertainty, row_of, write_row
from fpp_ml_bench.leaderboard.tables import table_json

EIGHT = [f"object {n}" for n in range(8)]
FULL, UNSEEN = ({"test/depth": letter * 32} for letter in "fe")


@pytest.fixture
def benchmarks(monkeypatch):
    """`FULL` and `UNSEEN` are the content of the benchmarks of these names."""
    named_benchmarks(monkeypatch, full=FULL, unseen=UNSEEN)


def entries_of(base, errors, objects=EIGHT):
    return [
        entry_with_errors(base, dict(zip(objects, values, strict=True)), name)
        for name, values in errors.items()
    ]


TEN = [f"object {n}" for n in range(10)]


def random_errors(seed, rows=5):
    rng = np.random.default_rng(seed)
    hard = rng.exponential(1.0, 10)
    return {f"row {n}": (hard * (1 + n / 2) + rng.uniform(0, 1.5, 10)) for n in range(rows)}


def test_ranks_follow_from_the_pairs_that_are_told_apart(base):
    """The p values of pairs and Holm's procedure have tests against SciPy of their own."""
    errors = random_errors(0)
    (group,) = rank(entries_of(base, errors, TEN))
    behind = {
        (pair.second, pair.first) for pair in group.pairs if pair.behind
    }  # (the worse, the better)
    assert 0 < len(behind) < len(group.pairs) == 10  # or the test says nothing
    for row in group.rows:
        assert row.best_rank == 1 + sum(row.entry.name == worse for worse, _ in behind)
        assert row.worst_rank == len(errors) - sum(row.entry.name == better for _, better in behind)
    adjusted = holm([pair.p for pair in group.pairs])
    for pair, p_holm in zip(group.pairs, adjusted, strict=True):
        differences = errors[pair.second] - errors[pair.first]
        assert pair.p == sign_flip_p(differences) and pair.p_holm == p_holm
        assert pair.difference == pytest.approx(differences.mean()) and pair.objects == 10
        assert (
            pair.behind == (p_holm <= 0.05)
            and pair.interval[0] <= pair.difference <= pair.interval[1]
        )


def test_equal_rows_share_ranks_and_the_perfect_one_is_first(base):
    some = random_errors(1, rows=1)["row 0"]
    errors = {"zero": [0.0] * 10, "b": some, "a": some, "worst": [50.0 + n for n in range(10)]}
    for order in (errors, dict(reversed(errors.items()))):
        (group,) = rank(entries_of(base, order, TEN))
        assert [(row.ranks, row.entry.name) for row in group.rows] == [
            ("1", "zero"),
            ("2-3", "a"),
            ("2-3", "b"),
            ("4", "worst"),
        ]
    twins = next(pair for pair in group.pairs if {pair.first, pair.second} == {"a", "b"})
    assert twins.p == twins.p_holm == 1.0 and not twins.behind


def test_five_objects_have_no_ranks_and_say_why(base):
    objects = EIGHT[:5]
    (group,) = rank(entries_of(base, {"a": [1.0] * 5, "b": [9.0] * 5}, objects))
    assert [row.ranks for row in group.rows] == ["-", "-"] and group.pairs == ()
    assert "With 5 objects the smallest p value of a test is 0.0625" in group.notes[0]
    (group,) = rank(entries_of(base, {"a": [1.0] * 6, "b": [9.0] * 6}, EIGHT[:6]))
    assert [row.ranks for row in group.rows] == ["1", "2"] and group.notes == ()


def test_ranks_by_other_scores_and_none_by_cost(base):
    entries = entries_of(base, {"a": [4.0] * 8, "b": [1.0] * 8})
    for key in ("object_rmse_mm", "overall_mae_mm"):
        assert [(row.ranks, row.entry.name) for row in rank(entries, key)[0].rows] == [
            ("1", "b"),
            ("2", "a"),
        ]
    for key in ("frames_used", "object_median_mm"):  # a row has no means of objects for them
        (group,) = rank(entries, key)
        assert {row.ranks for row in group.rows} == {"-"} and f"No ranks by {key}" in group.notes[0]
    assert [row.entry.name for row in group.rows] == ["b", "a"]


def two_sets(base, name, error, unseen_error):
    test = {f"test {n}": error * (1 + n) for n in range(5)}
    unseen = {f"unseen {n}": unseen_error * (1 + n) for n in range(20)}
    entries = (
        entry_with_errors(base, test, name, FULL),
        entry_with_errors(base, unseen, name, UNSEEN),
    )
    return [entries[0], replace(entries[1], path=base.path.with_name(f"{name}-unseen.json"))]


def test_test_and_unseen_objects_make_one_ranked_row(base, benchmarks):
    first, second = two_sets(base, "first", 1.0, 1.0), two_sets(base, "second", 2.0, 1.5)
    (group,) = rank([*second, *first])
    assert group.title.endswith(
        "one frame, metric track, test split + unseen, against decoded depth"
    )
    assert [(row.ranks, row.entry.name, len(row.objects)) for row in group.rows] == [
        ("1", "first", 25),
        ("2", "second", 25),
    ]
    row = group.rows[1]
    assert (row.on("fpp-bench-full").name, row.on("fpp-bench-unseen").name) == ("second", "second")
    assert row.on("fpp-bench-full").value("object_mae_mm") == pytest.approx(2.0 * 3)
    assert row.on("fpp-bench-unseen").value("object_mae_mm") == pytest.approx(1.5 * 10.5)
    assert row.value("object_mae_mm") == pytest.approx((5 * 6.0 + 20 * 15.75) / 25)
    assert (
        row.interval("object_mae_mm")[0]
        < row.value("object_mae_mm")
        < row.interval("object_mae_mm")[1]
    )
    assert row.value("object_bias_mm") == pytest.approx(row.value("object_mae_mm"))
    assert group.pairs[0].objects == 25 and group.pairs[0].p == 2.0**-24


def test_a_row_without_the_unseen_objects_has_no_rank(base, benchmarks):
    first, second, third, fourth = (
        two_sets(base, name, 1.0 + n, 1.0 + n) for n, name in enumerate("abcd")
    )
    (group,) = rank([*first, *second, third[0], fourth[1]])
    assert [(row.entry.name, row.ranks) for row in group.rows] == [
        ("a", "1"),
        ("b", "2"),
        ("c", "-"),
        ("d", "-"),
    ]
    assert "Rows without a result on the unseen objects have no rank" in group.notes[0]
    (group,) = rank([first[0], second[0]])
    assert (
        "no row here has both. With 5 objects the smallest" in group.notes[0]
        and group.title.count("unseen") == 0
    )
    (group,) = rank([*first, second[0]])
    assert "only one row here has both." in group.notes[0] and {
        row.ranks for row in group.rows
    } == {"-"}
    (group,) = rank([first[1], second[1]])
    assert {row.ranks for row in group.rows} == {"-"} and "unseen, against" in group.title


def test_two_methods_of_one_name_are_not_joined(base, benchmarks):
    test, unseen = two_sets(base, "same", 1.0, 1.0)
    other = changed(unseen, submission={"settings": {"weights_sha256": "1" * 64}})
    with pytest.raises(
        SubmissionError,
        match=r"same-unseen.json both hold 'same'.* settings.weights_sha256 is None",
    ):
        rank([test, other])
    with pytest.raises(SubmissionError, match="on the same data"):
        rank([test, replace(changed(test, predictions_sha256="0" * 64), path=base.path)])


def test_classes_and_what_was_told_are_tables_of_their_own(base):
    errors = dict.fromkeys(EIGHT, 1.0)
    entries = [
        entry_with_errors(base, errors, str(n), frames_used=list(range(n))) for n in (1, 3, 50)
    ]
    entries.append(entry_with_errors(base, errors, "told", uses_ground_truth_order=True))
    groups = rank(entries)
    assert [(group.key.frames, group.key.track) for group in groups] == [
        (FRAMES_CLASSES[0], "metric"),
        (FRAMES_CLASSES[0], "oracle order"),
        (FRAMES_CLASSES[1], "metric"),
        (FRAMES_CLASSES[2], "metric"),
    ]


def test_every_class_is_compared_with_the_best_trivial_row(base):
    errors = dict.fromkeys(EIGHT, 10.0)
    trivial = [
        entry_with_errors(base, errors | {EIGHT[0]: e}, f"constant {e}", method="constant")
        for e in (2.0, 90.0)
    ]
    liar = replace(
        entry_with_errors(base, dict.fromkeys(EIGHT, 0.1), "liar", method="constant"),
        provenance="verified",
    )
    rows = [
        entry_with_errors(base, dict.fromkeys(EIGHT, 0.9), str(n), frames_used=list(range(n)))
        for n in (1, 50)
    ]
    ratios = {
        row.entry.name: row.ratio for group in rank([*trivial, liar, *rows]) for row in group.rows
    }
    assert ratios["1"] == ratios["50"] == pytest.approx(0.1)
    assert ratios["constant 2.0"] == 1.0 and ratios["liar"] == pytest.approx(0.1 / 9)
    assert {row.ratio for group in rank(rows) for row in group.rows} == {None}


def test_a_track_is_compared_with_trivial_rows_that_are_told_no_more(base):
    def row(name, error, **given):
        return entry_with_errors(base, dict.fromkeys(EIGHT, error), name, **given)

    told_range, told_both = (
        {f"uses_ground_truth_{key}": True for key in keys}
        for keys in (["range"], ["range", "mask"])
    )
    trivial = [
        row("c", 40.0, method="constant"),
        row("c, range", 20.0, method="constant", **told_range),
    ]
    rows = [row("a", 10.0), row("b", 10.0, **told_range), row("d", 10.0, **told_both)]
    rows.append(row("e", 10.0, uses_ground_truth_order=True))
    ratios = {r.entry.name: r.ratio for group in rank([*trivial, *rows]) for r in group.rows}
    assert [ratios[name] for name in "abde"] == [0.25, 0.5, 0.5, 0.25]


def test_files_have_the_pairs_and_the_rows(base, tmp_path, monkeypatch):
    entries = entries_of(base, {"=HYPERLINK(a)": [1.0] * 8, "b, c": [2.0] * 8})
    paths = [tmp_path / f"{n}.json" for n in range(2)]
    for entry, path in zip(entries, paths, strict=True):
        write_row(entry.row, path)
    monkeypatch.setenv("COLUMNS", "160")
    files = ["--csv", tmp_path / "t.csv", "--json", tmp_path / "t.json"]
    output = printed(fpp_bench, "leaderboard", *paths, *files, "--paper", "none", "--pairs")
    assert "Pairs of these rows" in output and "second is behind" in output
    (group,) = read_json(tmp_path / "t.json")["groups"]
    assert [(row["best_rank"], row["object_mae_mm"]) for row in group["rows"]] == [
        (1, 1.0),
        (2, 2.0),
    ]
    assert (
        group["pairs"][0]["p"] == 2.0**-7 and group["pairs"][0]["behind"] and group["notes"] == []
    )
    lines = list(csv.DictReader(io.StringIO((tmp_path / "t.csv").read_text())))
    assert [line["name"] for line in lines] == ["'=HYPERLINK(a)", "b, c"]
    assert [float(line["object_mae_mm"]) for line in lines] == [1.0, 2.0]
    assert (
        lines[0]["ratio_to_trivial"] == ""
        and lines[0]["class"] == "one frame"
        and lines[1]["best_rank"] == "2"
    )


def tables():
    """Tables of errors (rows, objects) in decimals: close together, spread, with ties, and with
    hard objects."""
    rng = np.random.default_rng(5)
    for objects in (6, 8, 25, 32, 40):
        for rows in (2, 5) if objects == 40 else (2, 5, 12):  # 12 of 40 take ten seconds
            for spread, noise in ((0.5, 0.3), (0.1, 0.5), (1.0, 0.1), (0.0, 0.2)):
                hard, quality = (
                    rng.exponential(1.0, objects) + 0.2,
                    np.exp(rng.normal(0, spread, rows)),
                )
                yield np.round(
                    hard * quality[:, None] * np.exp(rng.normal(0, noise, (rows, objects))), 2
                )
    yield np.round(rng.uniform(1, 2, (10, 7)), 1)


@pytest.mark.long
def test_who_is_behind_whom_is_what_the_listed_pairs_say():
    """Bounds of p values leave out most tests, and change no verdict."""
    told_apart = 0
    for errors in tables():
        listed = pairs(
            {str(number): dict(enumerate(row)) for number, row in enumerate(errors.tolist())}
        )
        expected = {(int(pair.first), int(pair.second)) for pair in listed if pair.behind}
        assert (
            set(zip(*(part.tolist() for part in np.nonzero(behind(errors))), strict=True))
            == expected
        )
        told_apart += len(expected)
        differences = errors[1:] - errors[:-1]
        for row, low, high in zip(differences, *sign_flip_bounds(differences), strict=True):
            assert low <= sign_flip_p(row) <= high
    assert told_apart > 200


@pytest.mark.long
def test_a_table_of_hundreds_of_rows_is_ranked_and_lists_no_pairs(base):
    rng = np.random.default_rng(2)
    errors = rng.lognormal(0, 1, (300, 1)) * rng.uniform(1, 1.3, (300, 25))
    names = [f"object {n}" for n in range(25)]
    (group,) = rank(entries_of(base, {f"row {n}": row for n, row in enumerate(errors)}, names))
    assert len(group.ranked) == 300 and group.pairs == () and group.rows[-1].best_rank > 250
    content = json.loads(table_json([group], []))
    assert content["groups"][0]["pairs"] is None and len(content["groups"][0]["rows"]) == 300


def test_rows_of_one_data_hold_the_same_objects(base):
    entries = entries_of(base, {"a": [1.0] * 8}) + entries_of(base, {"b": [1.0] * 8}, TEN[2:])
    with pytest.raises(
        SubmissionError, match=r"b\.json: its objects, samples or pixels are not those of .*a\.json"
    ):
        rank(entries)


def test_what_a_row_keeps_of_a_stated_uncertainty(tmp_path, dataset):
    """Of pixels without a sigma none is in its interval. One view states all, one half, two
    nothing."""
    predictions = write_predictions(tmp_path / "p", dataset, offset_mm=1.0)
    for number, sample in enumerate(dataset.samples("test")):
        inside = np.cumsum(dataset.depth_mm(sample) > 0).reshape(32, 40)
        stated = np.where(
            inside <= (1, 0.5, 0, 0)[number] * inside.max(), np.float32(10), np.float32(0)
        )
        np.save(predictions / f"{sample}.sigma.npy", stated)
    result = evaluate(predictions, dataset)
    kept = row_of(result, tmp_path / "r.json").uncertainty
    assert kept.within_95_share == pytest.approx(1.5 / 4, abs=0.01)
    for key in ("ause_mae_mm", "sure_mae_mm", "sure_rmse_mm"):
        assert getattr(kept, key) == pytest.approx(
            getattr(result.uncertainty.metrics, key), rel=1e-4
        )


def test_what_a_result_says_beyond_its_scores(base):
    """Blocks that a result may have: what the method learned from, and its scored uncertainty."""

    def titles(row):
        return {column.title for column in columns("object_mae_mm") if column.shown_for([row])}

    (row,) = rank([base])[0].rows
    assert learned_from(base.row) == "" and uncertainty(base) == RowUncertainty()
    assert not {
        "In 95%",
        "AUSE",
        "Surest 95%",
        "Learned from",
        "Rank",
        "x trivial",
        "On unseen",
    } & titles(row)
    stated = RowUncertainty(within_95_share=0.9, ause_mae_mm=1.5, sure_mae_mm=0.7, sure_rmse_mm=2.1)
    learned = {"learned_from": LearnedFrom(data="generated")}
    (row,) = rank([changed(base, uncertainty=stated, submission=learned)])[0].rows
    assert learned_from(row.entry.row) == "generated"
    assert {"In 95%", "AUSE", "Surest 95%", "Learned from"} < titles(row)
    assert surest(row.entry) == "0.700 / 2.100" and surest(base) == "-"


def test_a_submission_may_say_that_it_was_given_the_order(base):
    about = base.row.submission.model_dump(mode="json")
    assert "uses_ground_truth_order" not in about
    for track in get_args(Track):
        given = {f"uses_ground_truth_{name}": name in track for name in ("range", "mask", "order")}
        assert Submission.model_validate({**about, **given}).track == track
    assert len(get_args(Track)) == 8 and given_truth("metric") == ""
    every = "the test sample's depth range, object mask and fringe order"
    assert given_truth("oracle range + mask + order") == every


def test_rows_of_others_say_where_they_are_from(tmp_path, monkeypatch):
    monkeypatch.setattr("fpp_ml_bench.leaderboard.rows.SHIPPED_ROWS", tmp_path)
    monkeypatch.chdir(tmp_path)
    output = " ".join(printed(fpp_bench, "leaderboard", "--paper", "oracle_order").split())
    assert "PhiCalNet, 1 frame" in output and "4.46" in output and "1.16" in output
    assert "Reported by its authors (arXiv 2607.11928)" in output
    assert "oracle order: given the test sample's fringe order." in output
