"""Measure a method: latency of one image, throughput of a batch, memory, on a named machine."""

import ctypes
import gc
import resource
import statistics
import sys
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from fpp_ml_bench.baselines.method import Frames, Method, checked
from fpp_ml_bench.baselines.run import captured_frames
from fpp_ml_bench.errors import DatasetError, PredictionError, SubmissionError
from fpp_ml_bench.evaluation.result.file import read_result, write_file, write_result
from fpp_ml_bench.evaluation.result.model import Result
from fpp_ml_bench.evaluation.result.parts import HardwareInfo, Timing
from fpp_ml_bench.evaluation.submission.description import Submission, read_submission
from fpp_ml_bench.evaluation.submission.prediction_files import SUBMISSION_FILE
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.machine import describe_hardware

WARM_UP = 3
_MIB = 2.0**20
OF_THE_MACHINE = {"threads", "device"}
"""Settings that two runs of the same method may differ in."""
BATCH_SHARE = 0.01
"""Share of an image's pixels, as at the edge of a mask, that rounding may turn by 1% in a batch of
a network."""


def time_method(
    opened: DatasetFolder,
    method: Method,
    split: str = "test",
    batch: int = 4,
    repeats: int = 20,
    progress: Callable[[int], None] = lambda runs: None,
) -> Timing:
    """Time `Method.answer` on images of ``split``: see `Timing` for what each figure means. Frames
    are in memory before the clock starts, at most ``batch`` sequences of them: no reading or
    writing counts. Raises `DatasetError` for an empty split, or when the dataset lacks a frame that
    the method needs, and `PredictionError` as `check_batch`."""
    samples = opened.samples(split)
    if not samples:
        raise DatasetError(
            f"{opened.path}: split {split} holds no sample; there is nothing to time"
        )
    if batch < 1 or repeats < 1:
        raise ValueError(f"expected a batch and repeats of at least 1, got {batch} and {repeats}")
    # A batch larger than the split holds its samples again: views, which cost no memory.
    stacks = [captured_frames(opened, method, sample) for sample in samples[:batch]]
    cuda: Any = import_module("torch").cuda if method.device.startswith("cuda") else None
    # Calls to a GPU return before their work is done.
    finish: Callable[[], object] = (
        partial(cuda.synchronize, method.device) if cuda is not None else lambda: None
    )

    def seconds(run: Callable[[], object]) -> float:
        finish()
        started = perf_counter()
        run()
        finish()
        return perf_counter() - started

    def latency_s(number: int) -> float:
        return seconds(lambda: method.answer(stacks[number % len(stacks)]))

    for number in range(WARM_UP):
        checked(method.answer(stacks[number % len(stacks)]), opened.size, method.name)
    working_mib = added_mib(lambda: latency_s(0))
    if cuda is not None:
        cuda.reset_peak_memory_stats(method.device)
    latencies_ms = []
    for number in range(repeats):
        latencies_ms.append(1000 * latency_s(number))
        progress(1)
    batch_stacks: list[Frames] = [stacks[number % len(stacks)] for number in range(batch)]
    check_batch(method, batch_stacks)
    rates = []
    for _ in range(max(1, -(-repeats // batch))):
        rates.append(batch / seconds(lambda: method.predict_batch(batch_stacks)))
    low, high = (float(np.percentile(latencies_ms, q)) for q in (5, 95))
    # getrusage(2): kB on Linux, bytes on macOS
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (
        _MIB if sys.platform == "darwin" else 1024
    )
    return Timing(
        provenance="measured",
        latency_median_ms=four_digits(statistics.median(latencies_ms)),
        latency_p5_ms=four_digits(low),
        latency_p95_ms=four_digits(high),
        repeats=repeats,
        batch=batch,
        batched=method.batched,
        throughput_per_s=four_digits(statistics.median(rates)),
        peak_memory_mib=round(peak_mib, 1),
        working_memory_mib=working_mib,
        gpu_memory_mib=None
        if cuda is None
        else round(cuda.max_memory_allocated(method.device) / _MIB, 1),
        parameters=method.parameters,
        frames=len(method.frames_used),
        image_size=list(opened.size),
        device=method.device,
        hardware=HardwareInfo.model_validate(describe_hardware().to_dict()),
        software=method.software,
    )


def check_batch(method: Method, stacks: Sequence[Frames]) -> None:
    """Raise `PredictionError` where `predict_batch`, whose time is the throughput, gives other
    depths than `answer`, which is scored, in more than `BATCH_SHARE` of the pixels."""
    if type(method).predict_batch is Method.predict_batch:
        return
    together = method.predict_batch(stacks)
    for number, frames in enumerate(stacks):
        alone = method.answer(frames).depth
        same = len(together) == len(stacks) and np.shape(together[number]) == alone.shape
        if not same or not np.isclose(together[number], alone, rtol=0.01).mean() > 1 - BATCH_SHARE:
            raise PredictionError(
                f"{method.name}: predict_batch gives other depths than one image after another, "
                f"which is what is "
                "scored; make both the same, or leave predict_batch out"
            )


def four_digits(value: float) -> float:
    """Four significant digits: more would be noise."""
    return float(f"{value:.4g}")


def added_mib(run: Callable[[], Any]) -> float | None:
    """By how much ``run`` raises the resident set at its highest, in MiB to a tenth; None where the
    kernel does not tell."""
    try:
        # What earlier runs freed goes back to the system (malloc_trim(3)), so that the next run's
        # use shows.
        gc.collect()
        getattr(ctypes.CDLL(None), "malloc_trim", lambda pad: None)(0)
        Path("/proc/self/clear_refs").write_text(
            "5"
        )  # resets the peak of the resident set, VmHWM (proc(5))
        before = _status_mib("VmRSS")
        run()
        return round(max(0.0, _status_mib("VmHWM") - before), 1)
    except (OSError, KeyError):
        run()
        return None


def _status_mib(key: str) -> float:
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return float(fields[key].split()[0]) / 1024


def check_target(path: Path, method: Method) -> None:
    """Refuse, before any work, a file that is no submission or result, or that describes another
    method. Raises SubmissionError, which says what differs."""
    check_same_method(path, _described(path)[0], method, timed=True)


def check_same_method(path: Path, about: Submission, method: Method, timed: bool = False) -> None:
    """Refuse (SubmissionError) to measure ``method`` for the file ``path``, which is ``about``
    another one: name, frames, units, or a setting that both have; to be ``timed`` also threads,
    device, and a setting that one lacks."""
    keys = about.settings.keys() & method.settings.keys() - OF_THE_MACHINE
    if timed:  # a summary of reports is added to the settings of what was predicted
        keys = method.settings.keys() | (() if method.reports else about.settings.keys())
    pairs: dict[str, tuple[object, object]] = {
        "method": (about.method, method.name),
        "frames_used": (sorted(about.frames_used), sorted(method.frames_used)),
        "units": (about.units, method.units),
        **{
            f"settings.{key}": (about.settings.get(key), method.settings.get(key))
            for key in sorted(keys)
        },
    }
    for key, (in_file, measured) in pairs.items():
        if in_file != measured:
            raise SubmissionError(
                f"{printable(path)}: {key} is {printable(str(in_file))}, but "
                f"{printable(str(measured))} for "
                "the method to measure; what is measured belongs to the very method that was "
                "scored: give the same "
                "options and code, or predict and score again"
            )


def write_timing(path: Path, timing: Timing) -> None:
    """Put ``timing`` into the file, with ``seconds_per_sample`` and ``hardware`` as measured. See
    `check_target`."""
    content = timing.model_dump(mode="json")
    measured = {
        "seconds_per_sample": timing.latency_median_ms / 1000,
        "seconds_source": "measured",
        "hardware": content["hardware"],
        "timing": content,
    }
    submission, result = _described(path)
    submission = Submission.model_validate({**submission.model_dump(mode="json"), **measured})
    if result is not None:
        write_result(result.model_copy(update={"submission": submission}), path)
    else:
        write_file(submission.to_yaml().encode("utf-8"), path)


def _described(path: Path) -> tuple[Submission, Result | None]:
    """The submission of a file, and the result that it is in."""
    if path.suffix == ".json":
        result = read_result(path)
        return result.submission, result
    if path.name != SUBMISSION_FILE:
        raise SubmissionError(
            f"{printable(path)}: expected a {SUBMISSION_FILE} or a result file (*.json)"
        )
    return read_submission(path.parent), None
