"""Rank ranges, groups and their titles, short names, and what a method assumes."""

import re
from html import unescape

import pytest
from board_rows import changed, named_benchmarks
from hypothesis import given, settings
from hypothesis import strategies as st
from upkeep import readme_block

from fpp_ml_bench.evaluation.submission.description import Submission
from fpp_ml_bench.leaderboard.columns import CODE, assumption, assumption_sentences
from fpp_ml_bench.leaderboard.page.page import page_files
from fpp_ml_bench.leaderboard.ranking import (
    LONGEST_NAME,
    cut_at_word,
    rank,
    read_entries,
    shipped_rows,
    short_names,
)
from fpp_ml_bench.leaderboard.rows import SHIPPED_ROWS, read_entry


@pytest.fixture(scope="module")
def shipped():
    return read_entries(shipped_rows())


def test_shipped_rows_are_shown_and_stay_sorted_by_rank_and_error(shipped):
    """Of two rows that the tests don't tell apart, the one that fewer others may be ahead of comes
    first."""
    shown = 0
    for group in rank(shipped):
        shown += sum(1 + (row.unseen is not None) for row in group.rows)
        shown += sum("same predictions" in note for note in group.notes)
        keys = [
            (row.best_rank or 0, row.worst_rank or 0, row.value(row.rank_key)) for row in group.rows
        ]
        assert keys == sorted(keys)
        unranked = [error for best, _, error in keys if not best]
        assert unranked in ([], [error for _, _, error in keys])  # all or none
        told_apart = [
            (first, second)
            for first in keys
            for second in keys
            if first[0] and first[1] < second[0]
        ]
        assert all(first[2] < second[2] for first, second in told_apart)
    assert shown == len(shipped)


def with_content(entry, digit):
    """The same row on other data."""
    return changed(entry, dataset={"content": dict.fromkeys(entry.row.dataset.content, digit * 32)})


def test_groups_are_headed_by_their_benchmark_and_other_data_come_last(files, monkeypatch):
    entry = changed(
        read_entries(files[:1])[0], submission={"frames_used": [0]}, frames_class="one frame"
    )
    named = with_content(entry, "a")
    named_benchmarks(monkeypatch, full=named.row.dataset.content, unseen={})
    groups = rank([entry, named])
    rest, truth = "40 x 32 px", entry.row.dataset.truth[:8]
    words = ": one frame, metric track, test split, against decoded depth"
    assert [group.title for group in groups] == [
        f"fpp-bench-full version 2, {rest}{words}",
        f"{rest}, data {truth}{words}",
    ]
    block, index = readme_block(groups), page_files(groups, [])["index.html"].decode()
    assert index.index("fpp-bench-full version 2") < index.index(truth)
    assert (
        "fpp-bench-full version 2" in block and truth not in block
    )  # README shows the first dataset


def test_a_table_is_of_scenes_whatever_was_projected(files):
    """A method on another code stands in the same table, and the code is a column."""
    first = read_entries(files[:1])[0]
    another = {"dataset": {"code": "crossed"}, "submission": {"name": "Another code"}}
    (group,) = rank([first, changed(first, predictions_sha256="0" * 64, **another)])
    assert [CODE.text(row) for row in group.rows] == ["crossed", "phase shift"]
    index = page_files([group], [])["index.html"].decode()
    assert '<td class="text more" data-v="crossed">crossed</td>' in index
    assert "code: crossed" in index and "code: phase shift" in index


def test_the_data_that_is_not_shown_first(shipped):
    """Lights that nothing is trained in, and small images: on the page in one line, in README not
    at all."""
    special = {
        group.key.benchmark.name if group.key.benchmark else group.key.real: group.key.special_data
        for group in rank(shipped)
    }
    for name in ("slmaster", "slstudio-boards", "slstudio-skull"):
        assert special.pop(name) == name
    assert special == {
        "fpp-bench-full": "",
        "fpp-bench-full-224": "224 px",
        "fpp-bench-workshop": "workshop",
        "fpp-bench-hard": "hard",
    }
    block = readme_block(rank(shipped))
    assert "fpp-bench-full version 2" in block and not re.search("workshop|hard|224", block)


def test_short_names_of_shipped_rows(shipped):
    names = {}
    for group in rank(shipped):
        shown = [row.short_name for row in group.rows]
        assert len(set(shown)) == len(shown)
        assert all(
            len(name) <= LONGEST_NAME and "…" not in name and "(" not in name for name in shown
        )
        names |= {row.entry.path.stem: row.short_name for row in group.rows}
    expected = {
        "phase-03-vertical": "Phase, 3 vertical",
        "fringe-net-crossed": "fringe-net, 1 crossed",
        "classical-03-both-fewest": "Classical 3, both, no Gray",
        "small-unet-individual-rmse-seed_1": "UNet RMSE s1",
        "small-unet-individual-rmse-horizontal": "UNet RMSE horizontal",
        "small-unet-global-rmse-guided": "UNet global RMSE, guided",
        "small-unet-global-rmse_physics_0.05": "UNet global RMSE + physics 0.05",
        "small-transunet-individual-hybrid_l1_0.7": "TransUNet hybrid L1 0.7",
        "small-pix2pix_unet-individual-gan_0.7": "Pix2Pix GAN 0.7",
    }
    assert {stem: names[stem] for stem in expected} == expected


def submission(name, method="mine", **settings):
    return Submission(
        name=name,
        method=method,
        units="mm",
        frames_used=[0],
        uses_ground_truth_range=False,
        seconds_per_sample=None,
        settings=settings,
    )


UNET = {
    "network": "unet",
    "normalisation": "global",
    "loss": "rmse",
    "trained_frames": "single_shot",
    "background_removed": False,
}


@pytest.mark.parametrize(
    ("name", "method", "changes", "short"),
    [
        ("Phase route, mine", "phase", {}, "Phase, 1 vertical"),
        ("Phase route, mine", "phase", {"shading": False}, "Phase, 1 vertical, no shading"),
        ("Phase route, mine", "phase", {"prior": "standoff"}, "Phase, 1 vertical, standoff"),
        ("Phase route, mine", "phase", {"error_mm": 3.0}, "Phase, fewest vertical, 3 mm"),
        ("Phase route, mine", "phase", {"direction": "<b>"}, "Phase route, mine"),
        ("Phase route, mine", "phase", {"frames": "9"}, "Phase route, mine"),
        ("A better phase route", "phase", {}, "A better phase route"),
        ("UNet, mine", "unet", {"network": "unet", "loss": "hybrid_l1_x"}, "UNet, mine"),
        ("UNet, global, rmse", "unet", UNET, "UNet global RMSE"),
        (
            "UNet, global, rmse",
            "unet",
            UNET | {"trained_frames": "all"},
            "UNet global RMSE all frames",
        ),
        (
            "UNet, global, rmse",
            "unet",
            UNET | {"background_removed": True},
            "UNet global RMSE, no background",
        ),
        ("UNet, global, rmse, input standardised", "unet", UNET, "UNet global RMSE, standardised"),
    ],
)
def test_only_rows_of_the_packages_methods_get_a_name_from_settings(name, method, changes, short):
    given = {"direction": "vertical", "frames": 1, "shading": True, "prior": "none", **changes}
    assert short_names([submission(name, method, **given)]) == [short]


def test_a_stranger_does_not_get_the_name_of_a_built_in_method():
    """Who only claims to be one keeps the own name, behind those who are; names that look the same
    get a number."""
    settings = {"direction": "vertical", "frames": 1, "shading": True, "prior": "none"}
    measured = submission("Phase route, one frame", "phase", **settings)
    claims = submission("Phase route, mine and better", "phase", **settings)
    alike = submission("PHASE,  1 vertical")
    everyone = [claims, alike, measured]
    names = short_names(everyone, {claims.name, alike.name})
    assert names == ["Phase route, mine and better", "PHASE,  1 vertical (2)", "Phase, 1 vertical"]
    assert short_names([claims]) == ["Phase, 1 vertical"]


words = st.text("ab ,;", min_size=1, max_size=60).filter(str.strip)


@given(st.lists(words, min_size=1, max_size=12, unique=True))
@settings(max_examples=200, deadline=None)
def test_short_names_of_a_group_differ_whatever_the_names(names):
    chosen = short_names([submission(name) for name in names])
    assert len(set(chosen)) == len(names) and all(len(name) <= LONGEST_NAME for name in chosen)
    assert short_names([submission(name) for name in reversed(names)]) == chosen[::-1]


def test_a_long_name_is_cut_at_a_word():
    assert (
        cut_at_word("A fringe network with attention, trained on everything")
        == "A fringe network with attention…"
    )
    assert cut_at_word("x" * 50) == "x" * (LONGEST_NAME - 1) + "…"
    assert cut_at_word("short enough") == "short enough"


ASSUMED = {
    "classical-18-both": ("", ""),
    "constant-range-middle-224": ("", "Given the test sample's depth range."),
    "crossed-03": ("known range and wall", "the wall behind it, whose distance the rig states"),
    "phase-horizontal-36px": ("known range", "the fringe has one period at most"),
    "phase-vertical": (
        "one albedo, a lit background",
        "one albedo for all surfaces and a lit background",
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("stem", ASSUMED)
def test_rows_say_what_they_assume(stem):
    """In a few words in tables, in a sentence on a row's own page."""
    words, sentence = ASSUMED[stem]
    entry = read_entry(SHIPPED_ROWS / f"{stem}.json")
    assert assumption(entry.row) == words and sentence in assumption_sentences(entry.row)
    assert bool(assumption_sentences(entry.row)) == bool(sentence)
    pages = page_files(rank([entry]), [])
    assert words in pages["index.html"].decode()
    assert all(
        sentence in unescape(own.decode()) for name, own in pages.items() if "submissions" in name
    )
