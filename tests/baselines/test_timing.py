"""Timing a method: the arithmetic against a clock of our own, memory against a known array, and
where it is written."""

from dataclasses import dataclass, field

import numpy as np
import pytest
import yaml
from conftest import fpp_bench, printed, read_json, refusal
from scored_dataset import write_predictions

from fpp_ml_bench.baselines import timing
from fpp_ml_bench.baselines.method import Answer, Method
from fpp_ml_bench.errors import DatasetError, PredictionError, SubmissionError
from fpp_ml_bench.evaluation.result.file import read_result, write_result
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.submission.description import read_submission


@dataclass
class Clock:
    """A clock that only a method moves, so that every figure is known."""

    now: float = 0.0

    def __call__(self) -> float:
        return self.now


@dataclass
class Scripted(Method):
    """A method whose runs take the seconds it is told, in turn; after those, one second each."""

    clock: Clock
    takes: list[float]
    stacks: list = field(default_factory=list)
    name = title = "scripted"
    frames_used = (0,)
    settings: dict = field(default_factory=dict)
    parameters = 1234

    def predict(self, frames):
        self.stacks.append(frames)
        self.clock.now += self.takes.pop(0) if self.takes else 1.0
        return np.zeros(frames[0].shape, np.float32)


def test_latency_is_that_of_the_runs_after_warm_up(dataset, monkeypatch):
    clock = Clock()
    monkeypatch.setattr(timing, "perf_counter", clock)
    runs = [0.001 * n for n in range(1, 12)]
    # Warm-up and the memory run are slow and must not show; then eleven runs; then three batches of
    # four.
    method = Scripted(clock, [100.0] * (timing.WARM_UP + 1) + runs[::-1] + [0.25] * 16)
    steps = []
    measured = timing.time_method(dataset, method, batch=4, repeats=11, progress=steps.append)
    assert measured.latency_median_ms == 6.0 and measured.repeats == 11 == len(steps)
    assert (measured.latency_p5_ms, measured.latency_p95_ms) == (
        1.5,
        10.5,
    )  # numpy's linear interpolation of 1..11
    assert measured.throughput_per_s == 4.0 and measured.batch == 4 and measured.batched is False
    assert measured.parameters == 1234 and measured.frames == 1 and measured.image_size == [32, 40]
    assert (
        measured.provenance == "measured"
        and measured.device == "cpu"
        and measured.gpu_memory_mib is None
    )
    assert measured.hardware.cores >= 1 and "numpy" in measured.software
    for frames in method.stacks:
        assert frames[0] is not None and all(frame is None for frame in frames[1:])


def test_a_method_that_takes_batches_gets_them_at_once(dataset, monkeypatch):
    clock = Clock()
    monkeypatch.setattr(timing, "perf_counter", clock)
    sizes = []

    class Batched(Scripted):
        batched = True

        def predict_batch(self, stacks):
            sizes.append(len(stacks))
            clock.now += 50.0 if len(sizes) == 1 else 0.5  # the first batch warms up
            return [np.zeros(frames[0].shape, np.float32) for frames in stacks]

    measured = timing.time_method(
        dataset, Batched(clock, []), batch=6, repeats=12
    )  # the split has four
    assert measured.batched is True and set(sizes) == {6} and len(sizes) == 3
    assert measured.throughput_per_s == 12.0


def test_what_is_timed_is_what_is_scored(dataset, monkeypatch):
    """`answer`, of a class that has two faces; and a batch that gives other depths is refused."""
    clock = Clock()
    monkeypatch.setattr(timing, "perf_counter", clock)

    class TwoFaces(Scripted):
        def answer(self, frames):
            clock.now += 2.0
            return Answer(np.full(frames[0].shape, 900, np.float32))

    measured = timing.time_method(dataset, TwoFaces(clock, [0.001] * 99), batch=2, repeats=3)
    assert measured.latency_median_ms == 2000 and measured.throughput_per_s == 0.5

    class OtherBatch(TwoFaces):
        def predict_batch(self, stacks):
            return [np.zeros(frames[0].shape, np.float32) for frames in stacks]

    with pytest.raises(PredictionError, match="predict_batch gives other depths"):
        timing.time_method(dataset, OtherBatch(clock, []), repeats=1)


def test_working_memory_is_what_one_prediction_takes(dataset):
    class Hungry(Scripted):
        def predict(self, frames):
            self.clock.now += 1.0
            return (
                np.ones(64 * 2**20 // 4, np.float32)[: frames[0].size]
                .reshape(frames[0].shape)
                .copy()
            )

    measured = timing.time_method(dataset, Hungry(Clock(), []), repeats=1, batch=1)
    if measured.working_memory_mib is None:  # a kernel without /proc/self/clear_refs
        pytest.skip("this kernel does not tell a process's memory peak")
    assert 60 <= measured.working_memory_mib <= 90
    assert measured.peak_memory_mib >= 64


def test_nothing_to_time_and_frames_that_are_not_there(dataset):
    class Everything(Scripted):
        frames_used = (0, 1)

    with pytest.raises(DatasetError, match="frame 1 is not stored"):
        timing.time_method(dataset, Everything(Clock(), []))
    with pytest.raises(DatasetError, match="no split"):
        timing.time_method(dataset, Scripted(Clock(), []), split="nowhere")


@pytest.fixture(scope="module")
def predicted(tiny, opened, tmp_path_factory):
    """Predictions of the classical method and their result."""
    work = tmp_path_factory.mktemp("timed")
    arguments = ["classical", str(tiny), "--steps", "3", "--direction", "vertical"]
    assert fpp_bench("predict", *arguments, "--out", work / "predictions") == 0
    write_result(evaluate(work / "predictions", opened), work / "result.json")
    return arguments, work


def test_command_writes_its_block_everywhere(predicted):
    arguments, work = predicted
    before = read_result(work / "result.json")
    files = [work / "predictions" / "submission.yaml", work / "result.json"]
    options = ["--batch", "2", "--repeats", "3", "--json", str(work / "timing.json")]
    out = printed(fpp_bench, "time", *arguments, *options, *(f"--into={path}" for path in files))
    assert "measured here" in out and "frames needed" in out and "cores" in out
    written = read_json(work / "timing.json")
    assert written["timing"]["frames"] == 3 + 7 and written["timing"]["parameters"] == 0
    assert written["settings"] == {"direction": "vertical", "steps": 3, "threads": 1}
    about, after = read_submission(work / "predictions"), read_result(work / "result.json")
    assert about.timing == after.timing == after.submission.timing is not None
    assert about.timing.model_dump(mode="json") == written["timing"]
    assert about.seconds_source == "measured" and about.hardware == about.timing.hardware
    assert about.seconds_per_sample == pytest.approx(about.timing.latency_median_ms / 1000)
    assert after.metrics == before.metrics and after.per_sample == before.per_sample


def test_a_time_is_not_written_into_another_methods_file(predicted, dataset, tmp_path):
    arguments, work = predicted
    result_bytes = (work / "result.json").read_bytes()
    other_arguments = [*arguments[:3], "4", *arguments[4:]]
    assert "frames_used is" in refusal(
        fpp_bench, "time", *other_arguments, "--into", work / "result.json"
    )
    assert (work / "result.json").read_bytes() == result_bytes
    folder = write_predictions(tmp_path / "p", dataset)
    assert "method is test, but classical" in refusal(
        fpp_bench, "time", *arguments, "--into", folder / "submission.yaml"
    )
    assert "expected a submission.yaml or a result file" in refusal(
        fpp_bench, "time", *arguments, "--into", tmp_path / "notes.txt"
    )
    assert "does not exist" in refusal(
        fpp_bench, "time", *arguments, "--json", tmp_path / "no" / "t.json"
    )


@pytest.mark.parametrize("value", ["0", "1e9"])
def test_counts_are_counts(value, predicted):
    assert f"--batch {value}: expected a whole number from 1 to 100000" in refusal(
        fpp_bench, "time", *predicted[0], "--batch", value
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"latency_p5_ms": 9.0}, "latency_p5_ms <= latency_median_ms"),
        ({"frames": 2}, "timing.frames is not the number of frames_used"),
        ({"provenance": "verified"}, "provenance"),
        ({"latency_median_ms": float("nan")}, "latency_median_ms"),
        ({"device": "\x1b[31mgpu"}, "control character"),
    ],
)
def test_an_unsound_block_is_refused(change, message, dataset, tmp_path):
    block = timing.time_method(dataset, Scripted(Clock(), [0.5] * 99), repeats=2).model_dump(
        mode="json"
    )
    folder = write_predictions(tmp_path / "p", dataset, timing=block)
    assert read_submission(folder).timing is not None
    content = yaml.safe_load((folder / "submission.yaml").read_text())
    content["timing"].update(change)
    (folder / "submission.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(SubmissionError, match=message):
        read_submission(folder)
