"""Error against run time, frames and memory: points against the evaluator, fronts against brute
force, powers against SciPy, resuming, refusals, the page."""

import json
import subprocess
import sys
from dataclasses import make_dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import fpp_bench, printed, read_json, refusal
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scored_dataset import HARDWARE, make_dataset, write_predictions

from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.baselines.registry import code_in, load_from_file
from fpp_ml_bench.baselines.tradeoff import measure
from fpp_ml_bench.baselines.tradeoff.measure import (
    COST_KEYS,
    TRADEOFF_FILE,
    Point,
    Tradeoff,
    choose_views,
    planned,
    power,
    read_tradeoff,
)
from fpp_ml_bench.baselines.tradeoff.report import growth_table, point_table, remarks, write_report
from fpp_ml_bench.baselines.training.weights import shipped_names
from fpp_ml_bench.errors import BuildError, DatasetError, PredictionError, SubmissionError
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.files import exclusive
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig import Rig

pytestmark = pytest.mark.long

OWN_METHOD = """
import numpy as np
from fpp_ml_bench.baselines.method import Method

class Flat(Method):
    name, title, frames_used, settings = "flat", "Everything lit is 1.5 m away", (0,), {}

    def __init__(self, rig, **options):
        self.rig = rig

    @classmethod
    def variants(cls, rig):
        return [{}]

    def predict(self, frames):
        return np.where(frames[0] > 60, np.float32(1500), np.float32(0))
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Two test objects with two views each; the exact depth is 0.5 mm more than the depth."""
    return make_dataset(tmp_path_factory.mktemp("data") / "small")


class Answer(Method):
    """A method that knows the answers, off by ``offset_mm``; ``rows`` rows of each image it leaves
    out."""

    name, title, settings = "answer", "Answer", {}

    def __init__(self, dataset, offset_mm=0.0, rows=0, frame=0, threads=1):
        self.dataset, self.offset_mm, self.rows = dataset, offset_mm, rows
        self.frames_used, self.threads = (frame,), threads

    def predict(self, frames):
        # The dataset's frames hold one grey level each: the sample's number among those of its
        # split.
        depth = self.dataset.depth_mm(self.dataset.samples("test")[int(frames[0][0, 0])]).copy()
        depth[depth > 0] += np.float32(self.offset_mm)
        depth[: self.rows] = 0
        return depth


@pytest.fixture
def answers(small, monkeypatch):
    """A registry of `Answer` under any name. Returns, by name, the variants (to be changed), and
    the calls."""
    known = SimpleNamespace(
        variants={"good": [{}], "bad": [{"offset_mm": 9.0}]}, made=[], trivial=False
    )

    def find(name):
        options = make_dataclass("Options", ("offset_mm", "threads"))
        if name not in known.variants:
            raise PredictionError(f"unknown method {name}")
        kind = SimpleNamespace(
            Options=options, trivial=known.trivial, variants=lambda rig: known.variants[name]
        )
        kind.__module__, kind.__qualname__ = Method.__module__, name
        return SimpleNamespace(method=kind)

    def load_method(name, source, **options):
        if isinstance(source, Rig):
            raise PredictionError("works at one size only")
        known.made.append((name, options))
        return Answer(small, **options)

    monkeypatch.setattr(measure, "find", find)
    monkeypatch.setattr(measure, "load_method", load_method)
    monkeypatch.setattr(measure, "methods", lambda: dict.fromkeys(known.variants))
    return known


def plan_of(dataset, out, *names, **changes):
    """A plan whose only scene is empty: nothing is rendered."""
    plan = planned(dataset.path, out, names, **{"views": 1, **changes})
    plan.rigs, plan.scenes = [paper_rig(240)], [[]]
    return plan


def measured(*words, **changes):
    return measure.tradeoff(plan_of(*words, **changes))


def test_a_point_is_what_the_evaluator_says(small, tmp_path, answers):
    folder = write_predictions(tmp_path / "predictions", small, offset_mm=0.0)
    for sample in small.samples("test"):
        depth = small.depth_mm(sample).copy()
        depth[depth > 0] += 3
        depth[:16] = 0
        np.save(folder / f"{sample}.npy", depth)
    expected = evaluate(folder, small, target="depth_exact")
    answers.variants["good"] = [{"offset_mm": 3.0, "rows": 16}]
    (point,) = measured(small, tmp_path / "out", "good", views=2).points
    assert (
        point.frames == 1
        and point.seconds > 0
        and point.batch_seconds > 0
        and point.title == "Answer"
    )
    assert point.object_mae_mm == pytest.approx(expected.metrics.object_mae_mm)
    assert 0 < point.missing_share < 1 and point.working_memory_mib in (
        None,
        pytest.approx(0, abs=5),
    )
    assert point.label == "good offset_mm=3.0 rows=16" and point.software["numpy"] == np.__version__


def test_a_long_reason_and_a_failure_in_ones_own_file_are_reasons(
    small, tmp_path, answers, monkeypatch
):
    """Both are in the file of the run, which can be read again."""
    (tmp_path / "mine.py").write_text("def fail():\n    return 1 / 0\n")
    failing = load_from_file(f"{tmp_path / 'mine.py'}:fail")
    for number, (fail, says) in enumerate(
        [(None, "because"), (failing, "line 2, in fail: ZeroDivisionError")]
    ):

        def load_method(name, source, fail=fail, **options):
            if fail is not None:
                fail()
            raise PredictionError("because " * 60)

        monkeypatch.setattr(measure, "load_method", load_method)
        out = tmp_path / str(number)
        measured(small, out, "good")
        (point,) = measure.read_tradeoff(out / measure.TRADEOFF_FILE).points
        assert says in point.failed and point.seconds is None


def test_what_cant_be_measured_says_why_and_has_no_numbers(small, tmp_path, answers, monkeypatch):
    answers.variants["good"] = [{"frame": 7}]
    run = measured(small, tmp_path / "out", "good", "bad")
    failed, one_size = run.points
    assert (
        "frame 7 is not stored" in failed.failed
        and failed.seconds is None
        and failed.object_mae_mm is None
    )
    assert one_size.object_mae_mm == 8.5 and one_size.pixel_seconds is None
    assert remarks(run)[0].startswith("Not measured: good frame=7: ")
    assert (
        remarks(run)[1] == "Not measured at other sizes: bad offset_mm=9.0: works at one size only"
    )
    assert (
        point_table(run).texts[0][1:] == ("", "-", "-", "-", "-", "-")
        and len(growth_table(run).texts) == 1
    )
    for wrong in (np.float32([[1]]), np.full(small.size, np.nan, np.float32)):
        monkeypatch.setattr(Answer, "predict", lambda self, frames, wrong=wrong: wrong)
        (point,) = measured(small, tmp_path / "wrong", "bad").points
        assert "power_drill_A0: the method gave" in point.failed and point.object_mae_mm is None


def test_told_and_trivial_methods_are_on_no_front(small, tmp_path, answers, monkeypatch):
    monkeypatch.setattr(Answer, "uses_ground_truth_mask", True)
    run = measured(small, tmp_path / "told", "bad")
    assert (
        run.points[0].off_front_reason
        == "given the view's object mask"
        == point_table(run).texts[0][1]
    )
    monkeypatch.setattr(Answer, "uses_ground_truth_mask", False)
    answers.trivial = True
    run = measured(small, tmp_path / "trivial", "bad")
    assert run.points[0].off_front_reason == "trivial" and all(
        run.front(cost) == [] for cost in COST_KEYS
    )


def test_views_are_spread_and_differ_between_objects(small):
    assert choose_views(small, 1) == ["power_drill_A0", "wooden_boards_A60"]
    assert choose_views(small, 2) == choose_views(small, 9) == small.samples("test")
    with pytest.raises(DatasetError, match="no split"):
        choose_views(small, 1, "nowhere")


def test_threads_go_to_the_methods_that_take_them(small, tmp_path, answers):
    measured(small, tmp_path / "out", "bad", threads=2)
    assert answers.made == [("bad", {"offset_mm": 9.0, "threads": 2})]


def test_all_methods_and_networks_of_the_size_are_measured(small, tmp_path, answers):
    answers.variants |= {name: [{}] for name in shipped_names()} | {"other rigs": []}
    assert [point.method for point in planned(small.path, tmp_path).points][:2] == ["good", "bad"]
    assert [point.method for point in planned(small.path, tmp_path, ["other rigs"]).points] == [
        "other rigs"
    ]
    networks = measure._networks((224, 224))
    assert "unet-individual-rmse" in networks and not measure._networks(small.size)


def point(method, seconds, frames, error, **changes):
    return Point(
        method=method,
        options={},
        title=f"Method {method}",
        frames=frames,
        seconds=seconds,
        batch_seconds=seconds,
        working_memory_mib=2.0,
        object_mae_mm=error,
        missing_share=0.0,
        **changes,
    )


def tradeoff_of(dataset, points):
    return Tradeoff(
        dataset="small",
        fingerprint=dataset.fingerprint,
        image_size=[32, 40],
        target="depth_exact",
        views=["power_drill_A0"],
        settings={"package": "1", "threads": 1, "clock": "wall"},
        hardware=HARDWARE,
        pixels=[100, 200, 400],
        points=list(points),
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
        and (getattr(better, cost), better.object_mae_mm)
        != (getattr(beaten_point, cost), beaten_point.object_mae_mm)
    }
    front = [(getattr(member, cost), member.object_mae_mm) for member in run.front(cost)]
    assert {p.key for p in run.front(cost)} == {p.key for p in points} - beaten
    assert front == sorted(front)


def test_a_power_is_that_of_least_squares():
    for pairs in ([(5, 1.0), (5, 2.0)], [], [(0, 1.0), (5, 2.0)]):
        assert power(pairs) is None
    amounts = [10, 20, 40, 80, 160]
    seconds = (
        2e-3 * np.array(amounts) ** 1.4 * np.exp(0.1 * np.random.default_rng(1).standard_normal(5))
    )
    assert power(zip(amounts, seconds, strict=True)) == pytest.approx(
        stats.linregress(np.log(amounts), np.log(seconds)).slope
    )


def test_growth_over_pixels_and_frames(small):
    first = point("a", 1.0, 10, 2.0, pixel_seconds=[0.001, 0.002, 0.004]).model_copy(
        update={"options": {"steps": 4}}
    )
    second = point("a", 4.0, 20, 1.0).model_copy(update={"options": {"steps": 9}})
    other = point("a", 4.0, 5, 1.0).model_copy(update={"options": {"steps": 9, "fewest": True}})
    run = tradeoff_of(small, [first, second, other, point("b", 1.0, 1, 9.0)])
    assert growth_table(run).texts == [
        ("a steps=4", "1, 2, 4", "1", "2", "1,000"),
        ("a steps=9", "-", "-", "2", "4,000"),
        ("a steps=9 fewest", "-", "-", "-", "4,000"),
        ("b", "-", "-", "-", "1,000"),
    ]


def test_a_stopped_run_goes_on_and_failures_are_tried_again(small, tmp_path, answers):
    answers.variants = {"a": [{}, {"offset_mm": 2.0}], "lost": [{"frame": 7}]}
    seen: list[str] = []
    first = measure.tradeoff(plan_of(small, tmp_path, "a", "lost"), seen.append)
    assert seen == ["a", "a offset_mm=2.0", "lost frame=7"] and len(answers.made) == 3
    assert read_tradeoff(tmp_path / TRADEOFF_FILE) == first
    second = measured(small, tmp_path, "a", "lost")
    assert len(answers.made) == 4 and answers.made[-1][0] == "lost" and second == first
    answers.variants["more"] = [{}]
    third = measured(small, tmp_path, "more")  # what the folder holds of others stays
    assert [p.label for p in third.points] == ["a", "a offset_mm=2.0", "lost frame=7", "more"]


def test_a_changed_file_is_measured_again(small, tmp_path, answers, monkeypatch):
    monkeypatch.chdir(tmp_path)
    answers.variants = {"mine.py:Mine": [{}]}
    # In a process of its own, which reads the file once.
    monkeypatch.setattr(
        measure, "source_sha256", lambda method: str(code_in.__wrapped__(tmp_path / "mine.py"))
    )
    for content, times in (("1", 1), ("1", 1), ("2", 2)):
        (tmp_path / "mine.py").write_text(content)
        measured(small, tmp_path / "out", "mine.py:Mine")
        assert len(answers.made) == times


def test_runs_of_other_data_settings_or_machines_do_not_mix(small, tmp_path, answers, monkeypatch):
    measured(small, tmp_path, "bad")
    with pytest.raises(SubmissionError, match=r"another settings .*give another --out"):
        measured(small, tmp_path, "bad", clock="processor")
    with pytest.raises(SubmissionError, match="another views"):
        measured(small, tmp_path, "bad", views=2)
    machine = measure.describe_hardware().to_dict() | {"cpu": "Another"}
    with (
        monkeypatch.context() as patched,
        pytest.raises(SubmissionError, match=r"another hardware .*cpu='Another' .* now"),
    ):
        patched.setattr(
            measure, "describe_hardware", lambda: SimpleNamespace(to_dict=lambda: machine)
        )
        measured(small, tmp_path, "bad")
    other = make_dataset(tmp_path / "other", size=(40, 32))
    with pytest.raises(SubmissionError, match="another fingerprint"):
        measured(other, tmp_path, "bad")
    with (
        exclusive(tmp_path / ".lock", tmp_path, "measuring"),
        pytest.raises(BuildError, match="another process"),
    ):
        measured(small, tmp_path, "bad")
    for content in ("nonsense\n", '{"tradeoff_schema_version": "1.0.0"}'):
        (tmp_path / TRADEOFF_FILE).write_text(content)
        with pytest.raises(SubmissionError, match="into another --out"):
            measured(small, tmp_path, "bad")


def test_the_clock_is_the_wall_or_the_processor_and_long_runs_are_not_repeated(
    small, tmp_path, monkeypatch
):
    monkeypatch.setattr(measure, "perf_counter", iter([1.0, 3.0]).__next__)
    ticks = [0.0, 0.5, 1.0, 1.3, 2.0, 2.4]  # three runs, until a second is used up
    monkeypatch.setattr(measure, "process_time", iter(ticks).__next__)
    assert planned(small.path, tmp_path, ["constant"]).timed(len, "four") == (2.0, 4)
    assert planned(small.path, tmp_path, ["constant"], clock="processor").timed(len, "four") == (
        pytest.approx(0.4),
        4,
    )


def test_files_hold_what_was_measured(small, tmp_path):
    run = tradeoff_of(small, [point("exact", 0.02, 10, 0.5), point("few|frames", 0.2, 1, 9.0)])
    measure.write_json(run.model_dump(mode="json"), tmp_path / TRADEOFF_FILE)
    assert [path.name for path in write_report(run, tmp_path)] == [
        "tradeoff.json",
        "tradeoff.md",
        "tradeoff.png",
    ]
    lines = (tmp_path / "tradeoff.md").read_text().splitlines()
    assert lines[0].startswith(
        "small, 40 x 32 px, 1 test views, against depth_exact; wall-clock time, 1 thread(s)"
    )
    assert lines[4] == "| exact | time, frames, memory | 0.500 | 0.0% | 20 | 10 | 2 |"
    assert lines[5] == "| few&#124;frames | frames | 9.000 | 0.0% | 200 | 1 | 2 |"
    assert read_tradeoff(tmp_path / TRADEOFF_FILE) == run
    broken = read_json(tmp_path / TRADEOFF_FILE)
    broken["points"][0]["frames"] = "ten"
    (tmp_path / "broken.json").write_text(json.dumps(broken))
    with pytest.raises(SubmissionError, match=r"points\.0\.frames"):
        read_tradeoff(tmp_path / "broken.json")
    (tmp_path / "broken.json").write_text(
        json.dumps(run.model_dump(mode="json") | {"image_size": [32]})
    )
    with pytest.raises(SubmissionError, match="image_size"):
        read_tradeoff(tmp_path / "broken.json")


def test_the_command_measures(tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(OWN_METHOD)
    command = ["tradeoff", tiny, "--quick", "--method", "classical", "--method", "mine.py:Flat"]
    listed = printed(fpp_bench, *command, "--list")
    assert not (tmp_path / "tradeoff").exists()
    assert "classical steps=3 fewest\n" in listed and listed.endswith("8 points on 1 views.\n")
    said = printed(fpp_bench, *command)
    assert "Front of" in said and "How time grows" in said
    assert "Written: tradeoff/tradeoff.png" in said
    run = read_tradeoff(tmp_path / "tradeoff" / TRADEOFF_FILE)
    assert len(run.points) == 8 and not any(p.failed for p in run.points) and len(run.pixels) == 3
    by_label = {p.label: p for p in run.points}
    many, few, own = (
        by_label["classical steps=18"],
        by_label["classical steps=3"],
        by_label["mine.py:Flat"],
    )
    assert (many.frames, few.frames, own.frames) == (
        50,
        20,
        1,
    ) and many.object_mae_mm < few.object_mae_mm < 2
    assert (
        many in run.front("frames") and own in run.front("frames") and len(own.pixel_seconds) == 3
    )


def test_sizes_are_smaller_where_the_fringes_allow_it(tiny, tmp_path):
    plan = planned(tiny, tmp_path, ["constant"])
    assert [rig.camera.width for rig in plan.rigs] == [176, 249, 352]
    plan = planned(tiny, tmp_path, ["constant"])
    plan.opened.__dict__["rig"] = paper_rig(480)
    assert [rig.camera.width for rig in plan.rigs] == [240, 339, 480]
    assert [len(frames) for frames in plan.scenes[:1]] == [52]


def test_refusals(small, tiny, tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    for words, said in (
        (["tradeoff", tmp_path / "absent"], "absent"),
        (["tradeoff", tiny, "--method", "nothing-known", "--list"], "nothing-known"),
        (["tradeoff", small.path, "--out", file, "--method", "constant"], "file"),
        (["leaderboard", "--tradeoff", file], "--page"),
        (["tradeoff", tiny, "--threads", "0"], "--threads"),
        (["tradeoff", tiny, "--views", "0"], "--views"),
        (["tradeoff", tiny, "--clock", "sun"], "--clock"),
    ):
        assert said in refusal(fpp_bench, *words)


@pytest.mark.processes
def test_torch_is_left_alone_unless_a_method_needs_it(tiny):
    command = ["tradeoff", str(tiny), "--list", "--method", "classical", "--method", "phase"]
    code = (
        f"import sys; from fpp_ml_bench.cli import main; assert main({command!r}) == 0; "
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
