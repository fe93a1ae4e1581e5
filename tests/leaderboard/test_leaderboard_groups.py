"""Rank ranges, groups and their titles, legacy data, short names, and what a method assumes."""

from dataclasses import replace

import pytest
from board_rows import some_rows
from hypothesis import given, settings
from hypothesis import strategies as st
from scored_dataset import make_dataset

from fpp_ml_bench.evaluation.submission import Submission
from fpp_ml_bench.leaderboard.assumptions import assumption, assumption_sentences
from fpp_ml_bench.leaderboard.groups import LEGACY_FINGERPRINTS, LEGACY_NOTE
from fpp_ml_bench.leaderboard.names import LONGEST_NAME, cut_at_word, short_names
from fpp_ml_bench.leaderboard.page import page_files
from fpp_ml_bench.leaderboard.ranking import rank, read_entries, shipped_rows
from fpp_ml_bench.leaderboard.readme import readme_block
from fpp_ml_bench.loaders.storage import Benchmark, benchmark, benchmark_of


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    work = tmp_path_factory.mktemp("rows")
    return some_rows(work / "rows", make_dataset(work / "tiny"))


@pytest.fixture(scope="module")
def shipped():
    return read_entries(shipped_rows())


def test_shipped_rows_stay_sorted_by_rank_and_error(shipped):
    """Of two rows that the tests don't tell apart, the one that fewer others may be ahead of comes first."""
    for group in rank(shipped):
        keys = [(row.best_rank or 0, row.worst_rank or 0, row.value("object_mae_mm")) for row in group.rows]
        assert keys == sorted(keys)
        unranked = [error for best, _, error in keys if not best]
        assert unranked in ([], [error for _, _, error in keys])  # all or none
        told_apart = [(first, second) for first in keys for second in keys if first[0] and first[1] < second[0]]
        assert all(first[2] < second[2] for first, second in told_apart)


def with_fingerprint(entry, fingerprint):
    dataset = entry.result.dataset.model_copy(update={"fingerprint": fingerprint})
    return replace(entry, result=entry.result.model_copy(update={"dataset": dataset}))


def test_groups_are_headed_by_their_benchmark_and_legacy_comes_last(files, monkeypatch):
    named, legacy = "a" * 64, min(LEGACY_FINGERPRINTS)
    monkeypatch.setattr(benchmark, "BENCHMARKS", (Benchmark("fpp-bench-full", 0, "full", 960, named),))
    entry = read_entries(files[:1])[0]
    groups = rank([with_fingerprint(entry, legacy), entry, with_fingerprint(entry, named)])
    titles = [group.title for group in groups]
    rest = "40 x 32 px"
    words = ": few frames, no code, metric track, test split, against decoded depth"
    assert titles == [
        f"fpp-bench-full version 0, {rest}{words}",
        f"{rest}, data {entry.result.dataset.fingerprint[:8]}{words}",
        f"{rest}, data {legacy[:8]}, legacy{words}",
    ]
    block, index = readme_block(groups), page_files(groups, [])["index.html"].decode()
    for text in (block, index):
        assert text.count(LEGACY_NOTE) == 1
        assert text.index("fpp-bench-full version 0") < text.index(f"{legacy[:8]}")
    assert LEGACY_NOTE not in readme_block(groups[:2])


def test_data_of_a_named_benchmark_is_not_legacy(files, monkeypatch):
    fingerprint = min(LEGACY_FINGERPRINTS)
    monkeypatch.setattr(benchmark, "BENCHMARKS", (Benchmark("fpp-bench-full-224", 0, "full", 224, fingerprint),))
    (group,) = rank([with_fingerprint(read_entries(files[:1])[0], fingerprint)])
    assert not group.key.is_legacy and group.title.startswith("fpp-bench-full-224 version 0")


def test_data_of_an_earlier_version_is_named_and_legacy(files):
    entry = read_entries(files[:1])[0]
    for earlier in benchmark.EARLIER:
        (group,) = rank([with_fingerprint(entry, earlier.fingerprint)])
        assert group.key.is_legacy
        assert group.title.startswith(f"{earlier.title}, ") and ", legacy: " in group.title


def test_shipped_rows_are_of_a_benchmark_or_legacy(shipped):
    for group in rank(shipped):
        assert group.key.is_legacy or benchmark_of(group.key.fingerprint) is not None


def test_what_stands_aside(shipped):
    """Lights that nothing is trained in, and small images: on the page in one line, in README not at all."""
    groups = [group for group in rank(shipped) if not group.key.is_legacy]
    aside = {benchmark_of(group.key.fingerprint).name: group.key.aside for group in groups}
    assert aside == {
        "fpp-bench-full": "", "fpp-bench-crossed": "", "fpp-bench-full-224": "224 px",
        "fpp-bench-test-workshop": "workshop", "fpp-bench-test-hard": "hard",
        "fpp-bench-test-crossed-workshop": "crossed, workshop", "fpp-bench-test-crossed-hard": "crossed, hard",
    }  # fmt: skip
    block = readme_block(rank(shipped))
    assert "fpp-bench-crossed version 1" in block and "test-workshop" not in block
    assert "Rows of other data (workshop; hard; crossed, workshop; crossed, hard; 224 px) are on the page." in block


def test_short_names_of_shipped_rows(shipped):
    names = {}
    for group in rank(shipped):
        shown = [row.short_name for row in group.rows]
        assert len(set(shown)) == len(shown)
        assert all(len(name) <= LONGEST_NAME and "…" not in name and "(" not in name for name in shown)
        names |= {row.entry.path.stem: row.short_name for row in group.rows}
    expected = {
        "phase-03-vertical": "Phase, 3 vertical",
        "phase-net-horizontal": "phase-net, 1 horizontal",
        "classical-18-both": "Classical 18+Gray, both",
        "classical-net-03-vertical": "classical-net 3+Gray, vertical",
        "classical-03-both-fewest": "Classical 3, both, no Gray",
        "cpu-unet-individual-rmse-range-mean": "UNet RMSE, mean range",
        "cpu-transunet-individual-hybrid_l1_0.7-range-predicted": "TransUNet hybrid L1 0.7, pred. range",
        "cpu-unet-individual-rmse-all": "UNet RMSE all frames",
        "cpu-long-unet-global-rmse": "UNet global RMSE",
        "cpu-long-pix2pix_unet-individual-gan_0.7": "Pix2Pix GAN 0.7",
        "cpu-long-unet-global-rmse-guided": "UNet global RMSE, guided",
        "cpu-long-unet-global-rmse_physics_0.05": "UNet global RMSE + physics 0.05",
        "cpu-unet-raw-rmse-bgremoved": "UNet raw RMSE, no background",
    }
    assert {stem: names[stem] for stem in expected} == expected


def submission(name, method="mine", **settings):
    return Submission(
        name=name, method=method, units="mm", frames_used=[0], uses_ground_truth_range=False, seconds_per_sample=None,
        settings=settings,
    )  # fmt: skip


UNET = {
    "network": "unet", "normalisation": "global", "loss": "rmse", "trained_frames": "single_shot",
    "background_removed": False,
}  # fmt: skip


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
        ("UNet, global, rmse, batch normalisation", "unet", UNET, "UNet global RMSE, batch norm"),
        ("UNet, global, rmse, input standardised", "unet", UNET, "UNet global RMSE, standardised"),
    ],
)
def test_only_rows_of_the_packages_methods_get_a_name_from_settings(name, method, changes, short):
    given = {"direction": "vertical", "frames": 1, "shading": True, "prior": "none", **changes}
    assert short_names([submission(name, method, **given)]) == [short]


words = st.text("ab ,;", min_size=1, max_size=60).filter(str.strip)


@given(st.lists(words, min_size=1, max_size=12, unique=True))
@settings(max_examples=200, deadline=None)
def test_short_names_of_a_group_differ_whatever_the_names(names):
    chosen = short_names([submission(name) for name in names])
    assert len(set(chosen)) == len(names) and all(len(name) <= LONGEST_NAME for name in chosen)
    assert short_names([submission(name) for name in reversed(names)]) == chosen[::-1]


def test_a_long_name_is_cut_at_a_word():
    assert cut_at_word("A fringe network with attention, trained on everything") == "A fringe network with attention…"
    assert cut_at_word("x" * 50) == "x" * (LONGEST_NAME - 1) + "…"
    assert cut_at_word("short enough") == "short enough"


def test_the_full_name_is_in_the_title_and_on_the_rows_own_page(files):
    entry = read_entries(files[:1])[0]
    name = "A fringe network with attention, trained on everything there is"
    about = entry.result.submission.model_copy(update={"name": name})
    pages = page_files(rank([replace(entry, result=entry.result.model_copy(update={"submission": about}))]), [])
    index = pages["index.html"].decode()
    assert f'title="{name}">A fringe network with attention…</a>' in index
    (own,) = (text.decode() for file, text in pages.items() if file.startswith("submissions/"))
    assert f"<h1>{name}</h1>" in own


def test_metric_phase_rows_say_what_they_assume(shipped):
    for group in rank(shipped):
        for row in group.rows:
            result = row.entry.result
            if result.submission.method in ("phase", "phase-net"):
                one = result.submission.settings["shading"]
                assert assumption(result) == ("one albedo, a lit background" if one else "a lit background")
                assert ("one albedo for all surfaces and a lit background" in assumption_sentences(result)) == one
            else:
                assert assumption(result) == ""
            assert ("Told the test sample's" in assumption_sentences(result)) == (result.track != "metric")
    (group,) = (group for group in rank(shipped) if any(row.entry.path.stem == "phase-vertical" for row in group.rows))
    pages = page_files([group], [])
    own = [text.decode() for file, text in pages.items() if file.startswith("submissions/")]
    assuming = [row for row in group.rows if assumption(row.entry.result)]
    assert assuming and sum("a lit background" in text for text in own) == len(assuming)
    assert {row.entry.result.submission.method for row in group.rows} - {"phase", "phase-net"} == {
        "constant",
        "nearest",
    }
    assert "phase and phase-net assume one albedo, a lit background." in readme_block([group])


def test_the_papers_errors_are_shown_apart(shipped):
    block = readme_block(rank(shipped))
    line = "| UNet | 14.54 | 17.88 | 3.31 | reported by the paper, told the test sample&#39;s depth range |"
    assert block.index("Reported by others on other data") < block.index(line)
