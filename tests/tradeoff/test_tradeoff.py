"""Error against run time: points against the evaluator, fronts against brute force, resuming, refusals, the page."""

import csv
import json
import re
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scored_dataset import make_dataset, write_predictions

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.baselines.tradeoff import report as tradeoff_report
from fpp_ml_bench.baselines.tradeoff.measure import Rules, measured, tradeoff
from fpp_ml_bench.baselines.tradeoff.points import JOURNAL, Point, Tradeoff, read_tradeoff
from fpp_ml_bench.baselines.tradeoff.report import remarks, write_report
from fpp_ml_bench.baselines.tradeoff.settings import (
    DecodeInType,
    Plan,
    Setting,
    TradeoffSettings,
    choose_views,
    planned,
)
from fpp_ml_bench.cli import main
from fpp_ml_bench.errors import BuildError, DatasetError, SubmissionError
from fpp_ml_bench.evaluation.score import evaluate
from fpp_ml_bench.files import exclusive
from fpp_ml_bench.leaderboard.page import page_files
from fpp_ml_bench.leaderboard.ranking import shipped_rows

QUICK = Rules(runs=3, limit_s=0.05)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Two test objects with two views each; the exact depth is 0.5 mm more than the depth."""
    return make_dataset(tmp_path_factory.mktemp("data") / "small")


@dataclass
class Answer(Method):
    """A method that knows the answers, off by ``offset_mm``; ``rows`` rows of each image it leaves out."""

    dataset: object
    offset_mm: float = 0.0
    rows: int = 0
    frames_used: tuple = (0,)
    uses_ground_truth_range: bool = False
    name = title = "answer"
    settings: dict = field(default_factory=dict)

    def predict(self, frames):
        # The dataset's frames hold one grey level each: the sample's number among those of its split.
        depth = self.dataset.depth_mm(self.dataset.samples("test")[int(frames[0][0, 0])]).copy()
        depth[depth > 0] += np.float32(self.offset_mm)
        depth[: self.rows] = 0
        return depth


def setting(dataset, key="a", calls=(), **changes):
    method = Answer(dataset, **changes)

    def make():
        if isinstance(calls, list):
            calls.append(key)
        return method

    return Setting(key, "classical", f"Setting {key}", make, choose_views(dataset, 2))


def test_a_point_is_what_the_evaluator_says(small, tmp_path):
    folder = write_predictions(tmp_path / "predictions", small, offset_mm=0.0)
    for sample in small.samples("test"):
        depth = small.depth_mm(sample).copy()
        depth[depth > 0] += 3
        depth[:16] = 0
        np.save(folder / f"{sample}.npy", depth)
    expected = evaluate(folder, small, target="depth_exact")
    point = measured(setting(small, offset_mm=3.0, rows=16), QUICK)
    assert point.failed is None and point.frames == 1 and point.image_px == 40 and point.runs >= 4
    assert point.object_mae_mm == pytest.approx(expected.metrics.object_mae_mm)
    assert point.interval_mm == pytest.approx(list(expected.intervals.of("object_mae_mm")))
    assert point.measured_mae_mm == pytest.approx(2.5)
    assert 0 < point.missing_share < 1
    assert point.seconds_p5 <= point.seconds <= point.seconds_p95 and point.pace_ms > 0


def test_what_cant_be_measured_says_why_and_has_no_numbers(small):
    point = measured(setting(small, frames_used=(7,)), QUICK)
    assert "frame 7 is not stored" in point.failed and point.seconds is None and point.object_mae_mm is None


def test_untrained_is_timed_and_never_scored(small):
    base = setting(small)
    point = measured(
        Setting("width", "networks", "UNet", base.make, base.views, scored=False, note="not trained"), QUICK
    )
    assert point.seconds > 0 and point.object_mae_mm is None and point.note == "not trained"
    assert tradeoff_of(small, [point]).comparable() == []


def test_views_are_spread_and_differ_between_objects(small):
    views = choose_views(small, 1)
    assert views.names == ["power_drill_A0", "wooden_boards_A60"]
    assert list(choose_views(small, 9).names) == small.samples("test")
    with pytest.raises(DatasetError, match="no split"):
        choose_views(small, 1, "nowhere")


def point(key, seconds, frames, error, group="classical", **changes):
    return Point(
        key=key,
        group=group,
        title=f"Setting {key}",
        frames=frames,
        image_px=40,
        runs=3,
        seconds=seconds,
        seconds_p5=seconds,
        seconds_p95=seconds,
        object_mae_mm=error,
        measured_mae_mm=error,
        missing_share=0.0,
        pace_ms=5.0,
        load=0.5,
        **changes,
    )


def tradeoff_of(dataset, points, growth=()):
    return Tradeoff(
        created="2026-01-01T00:00:00+00:00",
        dataset="small",
        fingerprint=dataset.fingerprint,
        image_size=[32, 40],
        target="depth_exact",
        views=["power_drill_A0"],
        settings={"threads": 1, "clock": "wall"},
        hardware={"cpu": "Some CPU", "cores": 2, "memory_gib": 8.0, "gpu": None, "platform": "Linux"},
        software={"numpy": "2"},
        sittings=1,
        points=list(points),
        growth=list(growth),
    )


numbers = st.tuples(st.integers(1, 6), st.integers(1, 6), st.integers(1, 6))


@settings(max_examples=60, deadline=None)
@given(st.lists(numbers, min_size=1, max_size=12), st.sampled_from(["seconds", "frames"]))
def test_the_front_is_what_no_point_beats(triples, cost):
    points = [point(f"k{n:02d}", float(a), b, float(c)) for n, (a, b, c) in enumerate(triples)]
    run = Tradeoff.model_construct(points=points)
    beaten = {
        beaten_point.key
        for beaten_point in points
        for better in points
        if getattr(better, cost) <= getattr(beaten_point, cost)
        and better.object_mae_mm <= beaten_point.object_mae_mm
        and (getattr(better, cost), better.object_mae_mm) != (getattr(beaten_point, cost), beaten_point.object_mae_mm)
    }
    assert {p.key for p in run.front(cost)} == {p.key for p in points} - beaten


def test_only_comparable_points_are_on_a_front(small):
    points = [
        point("a", 1.0, 10, 2.0),
        point("told", 0.1, 1, 0.1, given="depth range"),
        point("other size", 0.1, 1, 0.1, group="sizes"),
        point("arithmetic", 0.1, 1, 0.1, group="precision"),
        Point(key="absent", group="networks", title="Absent", failed="onnxruntime is not installed"),
    ]
    sparse = point("sparse", 0.1, 1, 5.0).model_copy(update={"measured_mae_mm": 0.1, "missing_share": 0.5})
    run = tradeoff_of(small, [*points, sparse])
    assert [p.key for p in run.front("seconds")] == [p.key for p in run.front("frames")] == ["sparse", "a"]
    assert [p.key for p in run.front("seconds", "measured_mae_mm")] == ["a"]
    assert any("onnxruntime is not installed" in line for line in remarks(run))


def test_a_busy_machine_shows(small):
    points = [point(f"k{n}", 1.0, 1, 1.0) for n in range(4)] + [point("busy", 1.0, 1, 1.0)]
    points[-1] = points[-1].model_copy(update={"pace_ms": 6.5, "load": 9.0})
    run = tradeoff_of(small, points)
    assert [run.slowed(p) for p in points] == [False] * 4 + [True]
    assert "0.5 to 9 on 2 cores" in remarks(run)[0] and remarks(run)[1].startswith("1 of 5 settings")


def test_a_stopped_run_goes_on_and_failures_are_tried_again(small, tmp_path):
    calls: list[str] = []
    settings_of_run = TradeoffSettings(small.path, tmp_path / "out", quick=True)
    plan = Plan(small, choose_views(small, 1), [setting(small, key, calls) for key in "ab"], [])
    plan.settings.append(setting(small, "lost", calls, frames_used=(7,)))
    seen: list[str] = []
    first = tradeoff(settings_of_run, plan, seen.append)
    assert seen == calls == ["a", "b", "lost"] and first.sittings == 1
    journal = tmp_path / "out" / JOURNAL
    second = tradeoff(settings_of_run, plan)
    assert calls == ["a", "b", "lost", "lost"] and second.sittings == 2
    assert second.points[:2] == first.points[:2]
    assert list(json.loads(journal.read_text())["points"]) == ["a", "b", "lost"]


def test_runs_of_other_rules_do_not_mix(small, tmp_path):
    plan = Plan(small, choose_views(small, 1), [setting(small)], [])
    tradeoff(TradeoffSettings(small.path, tmp_path, quick=True), plan)
    with pytest.raises(SubmissionError, match=r"another rules .*give another --out"):
        tradeoff(TradeoffSettings(small.path, tmp_path), plan)
    with pytest.raises(SubmissionError, match="another views"):
        tradeoff(TradeoffSettings(small.path, tmp_path, quick=True), Plan(small, choose_views(small, 2), [], []))
    (tmp_path / JOURNAL).write_text("nonsense\n")
    with pytest.raises(SubmissionError, match="expected what a run of fpp-bench tradeoff left"):
        tradeoff(TradeoffSettings(small.path, tmp_path, quick=True), plan)
    with exclusive(tmp_path / ".lock", tmp_path, "measuring"), pytest.raises(BuildError, match="another process"):
        tradeoff(TradeoffSettings(small.path, tmp_path, quick=True), plan)


def test_files_hold_what_was_measured(small, tmp_path):
    growth = [
        {
            "stage": "s",
            "over": "rows",
            "amounts": [1, 2, 4],
            "seconds": [1, 4, 16],
            "exponent": 2.0,
            "low": 2.0,
            "high": 2.0,
            "tail": 2.0,
            "flag": "steeper than linear",
        }
    ]
    points = [
        point("classical-both-03", 0.02, 10, 0.5),
        point("phase-x", 0.2, 1, 9.0),
        point("size-0240", 1, 1, 1, "sizes"),
    ]
    run = tradeoff_of(small, points)
    run = run.model_copy(update={"growth": Tradeoff.model_validate({**run.model_dump(), "growth": growth}).growth})
    written = {path.name for path in write_report(run, tmp_path)}
    pictures = {"tradeoff.png", "tradeoff_measured.png", "sizes.png", "costs.png"}
    assert written == {"tradeoff.json", "tradeoff.csv", "costs.csv", *pictures}
    assert read_tradeoff(tmp_path / "tradeoff.json") == run
    rows = list(csv.DictReader((tmp_path / "tradeoff.csv").open()))
    assert [row["front_seconds"] for row in rows] == ["true", "false", "false"]
    assert [row["front_frames"] for row in rows] == ["true", "true", "false"]
    with pytest.raises(SubmissionError, match=r"points\.0\.group"):
        broken = json.loads((tmp_path / "tradeoff.json").read_text())
        broken["points"][0]["group"] = "magic"
        (tmp_path / "broken.json").write_text(json.dumps(broken))
        read_tradeoff(tmp_path / "broken.json")


def test_the_page_shows_settings_as_text(small):
    hostile = '"><script>hacked=1</script>'
    points = [point("a", 1.0, 10, 2.0), point("b", 0.5, 1, 9.0, group="phase")]
    points[0] = points[0].model_copy(update={"title": hostile})
    index = page_files([], [], tradeoff_of(small, points))["index.html"].decode()
    section = re.search(r'<section id="tradeoff">.*?</section>', index, flags=re.DOTALL)[0]
    assert "<script" not in section and "&lt;script&gt;" in section and section.count("<svg") == 2
    assert 'href="#tradeoff"' in index and "time and frames" in section
    assert "tradeoff" not in page_files([], [])["index.html"].decode()


def test_types_of_the_decoder(opened):
    """In float64 the plain formulas are the package's decoder; in float32 the depth moves, by far less than noise."""
    sample = opened.samples("test")[0]
    frames = opened.frames(sample, range(len(opened.sequence)))
    for direction in ("vertical", "horizontal"):
        packaged = ClassicalMethod(opened.rig, direction=direction, steps=18).predict(frames)
        double = DecodeInType(opened.rig, direction, 18, dtype="float64").predict(frames)
        single = DecodeInType(opened.rig, direction, 18, dtype="float32").predict(frames)
        both = (packaged > 0) & (double > 0) & (single > 0)
        assert both.sum() > 0.99 * (packaged > 0).sum()
        assert (
            np.abs(packaged - double)[both].max() < 2e-4
        )  # one unit in the last place of the float32 that they end in
        assert 0 < np.abs(single - double)[both].mean() < 0.01


def test_the_command_measures_and_feeds_the_page(tiny, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(tradeoff_report, "PICTURES", {})
    out = tmp_path / "out"
    command = ["tradeoff", str(tiny), "--out", str(out), "--quick", "--only", "precision", "--only", "classical"]
    assert main([*command, "--list"]) == 0 and not out.exists()
    assert "11 settings and 0 ladders" in capsys.readouterr().out
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "Fronts of object MAE" in printed and "Load of the machine" in printed
    run = read_tradeoff(out / "tradeoff.json")
    by_key = {point.key: point for point in run.points}
    assert len(by_key) == 11 and not any(point.failed for point in run.points)
    many, few = by_key["classical-both-18"], by_key["classical-vertical-03"]
    assert (many.frames, few.frames) == (50, 10) and many.measured_mae_mm < few.measured_mae_mm < 2
    assert many.key in {point.key for point in run.front("frames")}
    page = ["leaderboard", str(shipped_rows()[0]), "--page", str(tmp_path / "page")]
    page += ["--tradeoff", str(out / "tradeoff.json")]
    assert main(page) == 0 and 'id="tradeoff"' in (tmp_path / "page" / "index.html").read_text()


def test_sizes_are_photographed_and_scored(tiny):
    plan = planned(TradeoffSettings(tiny, tiny, only=("sizes",), quick=True))
    first, second, third = (
        size_setting for size_setting in plan.settings if size_setting.views.rig.camera.width == 240
    )
    assert first.title == second.title.replace("vertical", "both").replace("=3", "=18") and third.key.endswith("phase")
    scored_point = measured(first, QUICK)
    # 0.76 mm with pixels that mix surfaces and bounced light; 0.18 mm in direct light, one ray a pixel.
    assert scored_point.image_px == 240 and scored_point.frames == 50 and 0.5 < scored_point.measured_mae_mm < 1.2


def test_refusals(small, tiny, tmp_path, capsys):
    assert main(["tradeoff", str(tmp_path / "absent")]) == 2
    assert main(["tradeoff", str(tiny), "--only", "networks", "--runs", str(tmp_path / "none"), "--list"]) == 2
    assert "expected a folder of trainings" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert main(["tradeoff", str(small.path), "--out", str(tmp_path / "file"), "--only", "precision"]) == 2
    assert main(["leaderboard", "--tradeoff", str(tmp_path / "file")]) == 2
    assert "--page" in capsys.readouterr().err
    for words in (["--threads", "0"], ["--only", "everything"]):
        assert main(["tradeoff", str(tiny), *words]) == 2


def test_settings_without_their_frames_do_not_stop_the_others(small, tmp_path):
    """A dataset of single shots: classical steps are refused one by one, and the run ends well."""
    settings_of_run = TradeoffSettings(small.path, tmp_path / "out", only=("precision",), quick=True)
    run = tradeoff(settings_of_run, planned(settings_of_run))
    assert [("frame" in point.failed) for point in run.points] == [True, True] and run.front() == []
    assert {path.name for path in write_report(run, settings_of_run.out)} == {"tradeoff.json", "tradeoff.csv"}
    assert partial(page_files, [], [])(run) == page_files([], [])
