"""`predict_split` continues a stopped run behind its last finished sample, and refuses to continue
another one."""

import sys

import numpy as np
import pytest
import yaml
from conftest import fpp_bench, read_json

from fpp_ml_bench.baselines import registry
from fpp_ml_bench.baselines.method import Answer, Method
from fpp_ml_bench.baselines.run import predict_split
from fpp_ml_bench.errors import DatasetError, PredictionError, SubmissionError
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.machine import THREAD_COUNTS

SPLIT = "test"


class Counting(Method):
    """Answers the number of its answer, states a sigma, reports, and is stopped after so many
    answers: the first warms it up."""

    name, title, frames_used, settings = "counting", "Counting", (0,), {"level": 1}
    reports = True

    def __init__(self, stop_after=None):
        self.answers, self.stop_after = 0, stop_after

    def answer(self, frames):
        if self.answers == self.stop_after:
            raise KeyboardInterrupt
        self.answers += 1
        maps = (np.full((32, 40), value, np.float32) for value in (1800 + self.answers, 1))
        return Answer(*maps, {"number": self.answers})

    def summary(self, reports):
        return {"mean_number": float(np.mean([report["number"] for report in reports]))}


@pytest.fixture
def stopped(dataset, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        predict_split(dataset, Counting(3), SPLIT, tmp_path / "out")
    return tmp_path / "out"


def test_it_goes_on_behind_the_last_finished_sample(dataset, stopped):
    names = [
        f"{sample}{suffix}"
        for sample in dataset.samples(SPLIT)[:2]
        for suffix in (".npy", ".sigma.npy")
    ]
    assert sorted(path.name for path in stopped.iterdir()) == sorted([*names, "unfinished.jsonl"])
    written = {name: (stopped / name).stat().st_mtime_ns for name in names}
    (stopped / "wooden_boards_A0.tmp").write_bytes(b"half")
    method, advanced = Counting(), []
    predict_split(dataset, method, SPLIT, stopped, advanced.append)
    assert method.answers == 3 and advanced == [1] * 4
    assert {name: (stopped / name).stat().st_mtime_ns for name in names} == written
    assert {path.name for path in stopped.iterdir()} >= {"submission.yaml", "per_sample.json"}
    assert not list(stopped.glob("*.jsonl")) + list(stopped.glob("*.tmp"))
    reports = read_json(stopped / "per_sample.json")
    assert list(reports) == dataset.samples(SPLIT)
    assert [report["number"] for report in reports.values()] == [2, 3, 2, 3]
    submission = yaml.safe_load((stopped / "submission.yaml").read_text())
    assert (
        submission["settings"] == {"level": 1, "mean_number": 2.5}
        and "learned_from" not in submission
    )
    assert evaluate(stopped, dataset).uncertainty is not None


@pytest.mark.parametrize(
    "damage", [lambda path: path.unlink(), lambda path: path.write_bytes(path.read_bytes()[:200])]
)
def test_a_finished_sample_whose_file_is_gone_or_cut_is_predicted_again(damage, dataset, stopped):
    damage(stopped / f"{dataset.samples(SPLIT)[0]}.npy")
    method = Counting()
    predict_split(dataset, method, SPLIT, stopped)
    assert method.answers == 4


def test_a_line_that_was_cut_off_does_not_count(dataset, stopped):
    journal = stopped / "unfinished.jsonl"
    journal.write_text(journal.read_text()[:-10])
    with pytest.raises(KeyboardInterrupt):
        predict_split(dataset, Counting(2), SPLIT, stopped)
    method = Counting()
    predict_split(dataset, method, SPLIT, stopped)
    assert method.answers == 3


def test_another_run_is_refused_and_keeps_its_files(dataset, stopped):
    before = {path.name: path.read_bytes() for path in stopped.iterdir()}
    other = Counting()
    other.settings = {"level": 2}
    with pytest.raises(
        PredictionError, match=r"differs in settings level \(settings level: 1 there, 2 now\)"
    ):
        predict_split(dataset, other, SPLIT, stopped)
    with pytest.raises(PredictionError, match="differs in split"):
        predict_split(dataset, Counting(), "validation", stopped)
    (stopped / "notes.txt").write_text("mine")
    with pytest.raises(PredictionError, match=r"already holds notes\.txt"):
        predict_split(dataset, Counting(), SPLIT, stopped)
    (stopped / "notes.txt").unlink()
    assert {path.name: path.read_bytes() for path in stopped.iterdir()} == before


def test_other_code_is_refused_by_the_name_of_its_file(dataset, tmp_path):
    method = Counting(3)
    method.code = {"mine.py": "1", "util.py": "1"}
    with pytest.raises(KeyboardInterrupt):
        predict_split(dataset, method, SPLIT, tmp_path / "out")
    changed = Counting()
    changed.code = {"mine.py": "1", "util.py": "2"}
    with pytest.raises(
        PredictionError, match=r'differs in code util\.py \(code util\.py: "1" there, "2" now\)'
    ):
        predict_split(dataset, changed, SPLIT, tmp_path / "out")
    same = Counting()
    same.code = method.code
    predict_split(dataset, same, SPLIT, tmp_path / "out")


def test_other_threads_are_refused(dataset, stopped, monkeypatch):
    monkeypatch.setenv(THREAD_COUNTS[0], "7")
    with pytest.raises(PredictionError, match="differs in threads"):
        predict_split(dataset, Counting(), SPLIT, stopped)


def test_a_method_that_describes_itself_wrongly_is_refused_before_its_first_sample(
    dataset, tmp_path
):
    method = Counting()
    method.learned_from = {"data": "mine"}
    with pytest.raises(SubmissionError, match="learned_from"):
        predict_split(dataset, method, SPLIT, tmp_path / "out")
    assert method.answers == 0


class Looking(Method):
    """Looks for truth in what it is given, and in all that its callers hold."""

    name, title, frames_used = "looking", "Looking", (0,)

    @classmethod
    def for_dataset(cls, dataset, **options):
        method = cls(dataset.rig)
        method.given = dataset
        return method

    def answer(self, frames):
        frame, held = sys._getframe(1), [self.given]
        while frame is not None and frame.f_code.co_name != "run_it":
            held += frame.f_locals.values()
            frame = frame.f_back
        assert frame is not None
        opened = [one for one in held if isinstance(one, DatasetFolder)]
        assert len(opened) >= 2  # of `predict_split`, and its own
        for one in opened:
            for sample in one.samples(SPLIT):
                assert set(one.measured(sample)) == {"sample", "object", "view"}
                with pytest.raises(DatasetError, match="is truth of the test split"):
                    one.depth_mm(sample)
        return Answer(np.zeros(frames[0].shape, np.float32))


def test_a_method_reaches_no_truth_by_what_it_is_given_or_by_its_caller(
    dataset, tmp_path, monkeypatch
):
    monkeypatch.setattr(registry, "_built_in", {"looking": Looking}.get)
    monkeypatch.setattr(registry, "BUILT_IN", ("looking",))
    monkeypatch.setattr(registry, "NETWORKS", "looking")

    def run_it():
        return fpp_bench("predict", "looking", dataset.path, "--out", tmp_path / "out")

    assert run_it() == 0


def test_stopped_between_the_description_and_the_end(dataset, stopped):
    journal = (stopped / "unfinished.jsonl").read_text()
    predict_split(dataset, Counting(), SPLIT, stopped)
    (stopped / "unfinished.jsonl").write_text(journal)
    predict_split(dataset, Counting(), SPLIT, stopped)
    assert not (stopped / "unfinished.jsonl").exists()
