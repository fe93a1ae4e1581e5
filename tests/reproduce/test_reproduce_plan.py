"""What `fpp-bench reproduce` plans to do, on which dataset, and how it judges the paper's
orderings."""

from dataclasses import replace
from statistics import fmean
from types import SimpleNamespace

import pytest
from scored_dataset import HARDWARE, make_dataset, write_predictions

from fpp_ml_bench.baselines.reproduce import plan
from fpp_ml_bench.baselines.reproduce.plan import Folders, default_folder, open_dataset, planned
from fpp_ml_bench.baselines.training.recipe import PRESETS, TABLES, load_recipe, table_rows
from fpp_ml_bench.cli import train as command
from fpp_ml_bench.errors import DatasetError, RecipeError
from fpp_ml_bench.evaluation.report.comparison import compare
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.leaderboard.reproduced import (
    Gap,
    Line,
    Ordering,
    conclusion,
    orderings,
    orderings_sentence,
    table_lines,
    table_markdown,
)
from fpp_ml_bench.leaderboard.row_file import row_of
from fpp_ml_bench.leaderboard.rows import Entry
from fpp_ml_bench.leaderboard.tables import paper_tables


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return make_dataset(tmp_path_factory.mktemp("data") / "tiny", size=(224, 224))


def folders(tmp_path, preset="small"):
    return Folders(preset, tmp_path / "runs" / preset, tmp_path / "rows")


def rows_of(tables):
    return [f"{table}/{row}" for table in tables for row in table_rows(table)]


def test_the_command_knows_the_recipes_tables_and_presets():
    assert command.TABLES == TABLES and command.PRESETS == PRESETS


@pytest.mark.parametrize("preset", PRESETS)
def test_rows_of_one_recipe_are_one_training(preset):
    jobs = planned(rows_of(TABLES), preset)
    first = [job for job in jobs if job.recipe.seed == 42]
    rows = [row for job in first for row in job.rows]
    assert len(rows) == len(set(rows)) == 3 + 3 + 5 + 10 + 6 + 3 and len(first) == 26
    shared = [set(job.rows) for job in first if len(job.rows) > 1]
    assert shared == [
        {"normalization/global", "further/plain"},
        {"normalization/individual", "multi_frame/frame0", "loss/rmse"},
        {"loss/hybrid_l1_0.7", "architecture/unet"},
    ]
    networks = [job.recipe.network for job in first]
    assert first == jobs[:26] and networks[:21] == ["unet"] * 21 and "unet" not in networks[21:]
    further = [(job.recipe.name.rpartition("-")[0], job.recipe.seed) for job in jobs[26:]]
    seeded = [
        "unet-raw-rmse",
        "unet-global-rmse",
        "unet-individual-rmse",
        "unet-individual-hybrid_l1_0.7",
    ]
    assert further == (
        [] if preset == "paper" else [(name, seed) for name in seeded for seed in (1, 2)]
    )
    names = [job.recipe.name for job in jobs]
    assert len(set(names)) == len(names)
    titles = [job.recipe.title for job in jobs]
    assert len(set(titles)) == len(titles)


def test_lines_hold_the_papers_numbers(tmp_path, dataset):
    jobs = planned(rows_of(TABLES), "small")
    for table in TABLES:
        by_row = {line.row: line for line in table_lines(table, jobs, folders(tmp_path), dataset)}
        for row in paper_tables()[table].rows if table in paper_tables() else ():
            assert (by_row[row.row].paper_mm, by_row[row.row].label) == (row.errors_mm, row.label)
        extra = [name for name, line in by_row.items() if line.paper_mm is None]
        not_the_papers = {
            "architecture": ["pix2pixhd", "hformer"],
            "further": ["plain", "guided", "physics"],
        }
        assert extra == not_the_papers.get(table, [])
        assert all(line.found == {} and line.entry is None for line in by_row.values())


def test_two_recipes_under_one_name_are_refused(monkeypatch):
    def other_batch(name, preset):
        recipe = load_recipe(name, preset)
        return recipe.model_copy(update={"batch": 7}) if name == "loss/rmse" else recipe

    monkeypatch.setattr(plan, "load_recipe", other_batch)
    with pytest.raises(
        RecipeError, match=r"normalization/individual and loss/rmse differ in batch \(4 and 7\)"
    ):
        planned(rows_of(["normalization", "loss"]), "small")


def test_default_folders():
    assert str(default_folder("small", 224)) == "data/small224"
    assert str(default_folder("paper", 960)) == "data/full"


def test_a_dataset_of_another_size_is_refused(tmp_path):
    small = make_dataset(tmp_path / "other")
    jobs = planned(rows_of(["normalization"]), "small")
    with pytest.raises(
        DatasetError,
        match=r"expected images of 224 x 224 px, which preset small .* got 40 x 32.*--size",
    ):
        open_dataset(small.path, jobs, folders(tmp_path), print)


def test_a_dataset_without_the_frames_is_refused(tmp_path, dataset):
    with pytest.raises(
        DatasetError,
        match="multi_frame/horizontal needs the frames of horizontal, stored are those of",
    ):
        open_dataset(
            dataset.path, planned(rows_of(["multi_frame"]), "small"), folders(tmp_path), print
        )


def line(
    label: str, paper_mae: float | None, *seeds: dict[str, float], entry: Entry | None = None
) -> Line:
    """A line with these object errors of each seed, sample ``object_view`` to mm."""
    paper = (
        None
        if paper_mae is None
        else {**paper_tables()["loss"].rows[0].errors_mm, "object_mae_mm": paper_mae}
    )
    found = {}
    for seed, errors in enumerate(seeds):
        of_objects: dict[str, list[float]] = {}
        for sample, error in errors.items():
            of_objects.setdefault(sample.rpartition("_")[0], []).append(error)
        parts = [
            SimpleNamespace(object=name, object_mae_mm=fmean(views))
            for name, views in of_objects.items()
        ]
        found[seed] = SimpleNamespace(per_object=parts, metrics=SimpleNamespace(model_dump=dict))
    return Line(label, label, load_recipe("loss/rmse"), found, entry, paper)


def views(base: float, spread: float = 0.1, objects: str = "abcdefghij") -> dict[str, float]:
    return {
        f"{name}_A{view}": base + spread * ((number + view) % 3)
        for number, name in enumerate(objects)
        for view in (0, 60)
    }


def test_orderings_are_judged_by_number():
    noise = views(10.0)
    swapped = {sample: value + (3.0 if sample < "f" else -2.9) for sample, value in noise.items()}
    lines = [
        line("best", 1.0, noise),
        line("worse", 2.0, views(12.0)),
        line("odd", 3.0, swapped),
        line("own", None, noise),
    ]
    judged = orderings(lines[::-1])
    assert [(ordering.better, ordering.worse, ordering.verdict) for ordering in judged] == [
        ("best", "worse", "holds"),
        ("best", "odd", "seen"),
        ("worse", "odd", "seen reversed"),
    ]
    assert [ordering.paper_gap_mm for ordering in judged] == [1.0, 2.0, 1.0]
    assert judged[0].here.mean_mm == pytest.approx(2.0)
    turned = orderings([line("best", 1.0, views(12.0)), line("worse", 2.0, noise)])
    assert [ordering.verdict for ordering in turned] == ["reversed"]
    assert orderings_sentence(judged).endswith(
        "3 among the rows measured here. Decided by 10 objects, with Holm's correction: 1 hold, 0 "
        "reversed. Only seen "
        "in the mean over them: 1 as in the paper, 1 reversed."
    )
    assert orderings([line("a", 1.0, noise), line("b", 1.0, views(12.0))]) == []
    assert "none of its orderings" in orderings_sentence([])


@pytest.mark.parametrize(
    ("count", "verdicts"), [(5, ("seen", "seen reversed")), (6, ("holds", "reversed"))]
)
def test_five_objects_decide_nothing(count, verdicts):
    """However large and equal their differences are, and although the interval leaves 0 out."""
    near, far = (views(base, objects="abcdefghij"[:count]) for base in (1.0, 100.0))
    for first, second, verdict in ((near, far, verdicts[0]), (far, near, verdicts[1])):
        judged = orderings([line("a", 1.0, first), line("b", 2.0, second)])
        assert [ordering.verdict for ordering in judged] == [verdict]
        assert judged[0].here.interval[0] * judged[0].here.interval[1] > 0
        assert judged[0].p_holm == 2 / 2**count
        assert ("Fewer than 6 objects can decide none" in orderings_sentence(judged)) == (
            count == 5
        )


def test_each_further_pair_of_a_table_makes_the_others_harder_to_decide():
    lines = [
        line("a", 1.0, views(1.0, objects="abcdef")),
        line("b", 2.0, views(9.0, objects="abcdef")),
    ]
    assert [ordering.verdict for ordering in orderings(lines)] == ["holds"]
    lines.append(line("c", 3.0, views(20.0, objects="abcdef")))
    judged = orderings(lines)
    assert [ordering.here.p for ordering in judged] == [2 / 2**6] * 3
    assert [ordering.p_holm for ordering in judged] == [3 * 2 / 2**6] * 3
    assert {ordering.verdict for ordering in judged} == {"seen"}


def test_seeds_count_beside_objects():
    """What three seeds don't agree on isn't decided by objects that agree."""
    base, better = views(10.0), [views(8.0), views(8.0), views(10.5)]
    one = orderings([line("a", 1.0, better[0]), line("b", 2.0, base)])[0]
    three = orderings([line("a", 1.0, *better), line("b", 2.0, base, base, base)])[0]
    assert (one.verdict, one.here.seeds, three.here.seeds, three.verdict) == ("holds", 1, 3, "seen")
    assert three.p_holm < 0.05
    assert three.here.mean_mm == pytest.approx((2 + 2 - 0.5) / 3)
    agreed = orderings([line("a", 1.0, *better[:2]), line("b", 2.0, base, base, base)])[0]
    assert (agreed.verdict, agreed.here.seeds) == ("holds", 2)


@pytest.mark.parametrize(
    ("ends", "verdict"),
    [
        ((0.1, 2.0), "holds"),
        ((0.0, 2.0), "seen"),
        ((-1.0, 0.0), "seen reversed"),
        ((-2.0, -0.1), "reversed"),
        (None, "seen"),
    ],
)
def test_an_interval_that_touches_zero_decides_nothing(ends, verdict):
    mean_mm = sum(ends or (1.0, 1.0)) / 2
    assert Ordering("a", "b", 1.0, Gap(mean_mm, ends, 6, 1, 0.01), 0.05, True).verdict == verdict


def two_results(tmp_path, dataset):
    """Timed on two machines."""
    folders = [
        write_predictions(
            tmp_path / cpu,
            dataset,
            offset_mm=offset,
            noise_mm=2.0 * offset,
            hardware={**HARDWARE, "cpu": cpu},
        )
        for cpu, offset in (("first", 1.0), ("second", 3.0))
    ]
    return [evaluate(folder, dataset) for folder in folders]


def test_the_difference_is_that_of_compare(tmp_path, dataset):
    results = two_results(tmp_path, dataset)
    entries = [Entry(tmp_path / "x.json", row_of(result, tmp_path)) for result in results]
    lines = [
        replace(line(str(n), float(n), entry=entry), found={42: entry.row})
        for n, entry in enumerate(entries, 1)
    ]
    ordering, difference = orderings(lines)[0], compare(*results).differences["object_mae_mm"]
    expected = [difference.mean_mm, *difference.interval_mm]
    assert [ordering.here.mean_mm, *ordering.here.interval] == pytest.approx(expected, rel=1e-3)
    assert ordering.same_track
    oracle = entries[1].row.submission.model_copy(update={"uses_ground_truth_range": True})
    row = entries[1].row.model_copy(update={"submission": oracle})
    lines[1] = replace(lines[1], entry=Entry(tmp_path / "x.json", row))
    assert not orderings(lines)[0].same_track
    text = table_markdown("loss", lines, "small", "fpp-bench reproduce loss", {})
    assert "of different tracks" in text


def test_a_table_that_the_paper_does_not_have_is_compared_with_its_first_line(tmp_path, dataset):
    results = two_results(tmp_path, dataset)
    lines = [
        replace(line(name, None, entry=Entry(tmp_path / "x.json", row)), found={42: row})
        for name, row in zip(
            ("the image alone", "guided"), (row_of(r, tmp_path) for r in results), strict=True
        )
    ]
    difference = compare(*results).differences["object_mae_mm"]
    low, high = difference.interval_mm
    said = conclusion("further", lines)
    assert f"against the image alone, sample by sample: guided {difference.mean_mm:+.2f} mm" in said
    assert f"{low:+.2f} to {high:+.2f}" in said and conclusion("further", lines[:1]) == ""
    text = table_markdown("further", lines, "small", "fpp-bench reproduce further", {})
    assert text.startswith("# Further directions") and said in text
    assert "times on first, 2 cores (the image alone)&#59; second, 2 cores (guided)." in text
    assert "reported by the paper" not in text.lower()


def test_rows_that_were_not_measured_stay_empty():
    empty = line("masked | L1", 18.0)
    text = table_markdown(
        "loss",
        [empty],
        "paper",
        "fpp-bench reproduce loss --preset paper",
        {empty.recipe.name: "boom"},
    )
    assert (
        "Not measured here: masked &#124; L1. To fill: `fpp-bench reproduce loss --preset paper`"
        in text
    )
    assert "masked &#124; L1: boom" in text
    cells = next(row for row in text.splitlines() if row.startswith("| masked")).split(" | ")
    assert cells[2] == cells[3] == "-" and "18.00 / 21.19" in cells
