"""Measure a method: latency of one image, throughput of a batch, memory, on a named machine."""

import ctypes
import gc
import resource
import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from fpp_ml_bench.baselines.method import Frames, Method
from fpp_ml_bench.baselines.run import captured_frames, write_submission
from fpp_ml_bench.errors import DatasetError, SubmissionError
from fpp_ml_bench.evaluation.result import HardwareInfo, Timing, read_result, write_result
from fpp_ml_bench.evaluation.submission import SUBMISSION_FILE, Submission, read_submission
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.machine import describe_hardware

WARM_UP = 3
_MIB = 2.0**20
_CLEAR_PEAK = "5"
"""What resets the kernel's high-water mark of the resident set, written to ``/proc/self/clear_refs`` (proc(5))."""


def time_method(
    opened: DatasetFolder,
    method: Method,
    split: str = "test",
    batch: int = 4,
    repeats: int = 20,
    progress: Callable[[int], None] = lambda runs: None,
) -> Timing:
    """Time ``method`` on images of ``split``: see `Timing` for what each figure means.

    Frames are in memory before the clock starts, at most ``batch`` sequences of them: neither reading nor writing
    counts.

    Raises `DatasetError` for an empty split, or when the dataset lacks a frame that the method needs.
    """
    samples = opened.samples(split)
    if not samples:
        raise DatasetError(f"{opened.path}: split {split} holds no sample; there is nothing to time")
    if batch < 1 or repeats < 1:
        raise ValueError(f"expected a batch and repeats of at least 1, got {batch} and {repeats}")
    # A batch larger than the split holds its samples again: views, which cost no memory.
    stacks = [captured_frames(opened, method, sample) for sample in samples[:batch]]
    gpu = _Gpu(method.device)

    def latency_s(number: int) -> float:
        gpu.synchronise()
        started = perf_counter()
        method.predict(stacks[number % len(stacks)])
        gpu.synchronise()
        return perf_counter() - started

    for number in range(WARM_UP):
        latency_s(number)
    working_mib = _added_by(lambda: latency_s(0))
    gpu.reset_peak()
    latencies_ms = []
    for number in range(repeats):
        latencies_ms.append(1000 * latency_s(number))
        progress(1)
    batch_stacks: list[Frames] = [stacks[number % len(stacks)] for number in range(batch)]
    rates = []
    for number in range(1 + max(1, -(-repeats // batch))):
        gpu.synchronise()
        started = perf_counter()
        method.predict_batch(batch_stacks)
        gpu.synchronise()
        if number or not method.batched:  # the first batch warms the batched path up
            rates.append(batch / (perf_counter() - started))
    low, high = (float(np.percentile(latencies_ms, q)) for q in (5, 95))
    return Timing(
        provenance="measured",
        latency_median_ms=_digits(statistics.median(latencies_ms)),
        latency_p5_ms=_digits(low),
        latency_p95_ms=_digits(high),
        repeats=repeats,
        batch=batch,
        batched=method.batched,
        throughput_per_s=_digits(statistics.median(rates)),
        peak_memory_mib=round(_peak_mib(), 1),
        working_memory_mib=None if working_mib is None else round(working_mib, 1),
        gpu_memory_mib=gpu.peak_mib(),
        parameters=method.parameters,
        frames=len(method.frames_used),
        image_size=list(opened.size),
        device=method.device,
        hardware=HardwareInfo.model_validate(describe_hardware().to_dict()),
        software=method.software,
    )


def _digits(value: float) -> float:
    """Four significant digits: more would be noise."""
    return float(f"{value:.4g}")


def _peak_mib() -> float:
    """Largest resident set of this process so far (getrusage(2): kB on Linux, bytes on macOS)."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / _MIB if sys.platform == "darwin" else peak / 1024


def _added_by(run: Callable[[], Any]) -> float | None:
    """By how much ``run`` raises the resident set at its highest, in MiB; None where the kernel does not tell."""
    try:
        _give_back_freed_memory()
        Path("/proc/self/clear_refs").write_text(_CLEAR_PEAK)
        before = _status_mib("VmRSS")
        run()
        return max(0.0, _status_mib("VmHWM") - before)
    except (OSError, KeyError):
        run()
        return None


def _give_back_freed_memory() -> None:
    """Return memory that earlier runs freed to the system (malloc_trim(3)), so that the next run's use shows."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def _status_mib(key: str) -> float:
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return float(fields[key].split()[0]) / 1024


class _Gpu:
    """What is measured on a GPU; nothing for a method that runs on the processor."""

    def __init__(self, device: str) -> None:
        self.device = device
        self.cuda: Any = None
        if device.startswith("cuda"):
            import torch

            self.cuda = torch.cuda

    def synchronise(self) -> None:
        """Wait until the device has finished: calls to a GPU return before their work is done."""
        if self.cuda is not None:
            self.cuda.synchronize(self.device)

    def reset_peak(self) -> None:
        if self.cuda is not None:
            self.cuda.reset_peak_memory_stats(self.device)

    def peak_mib(self) -> float | None:
        return None if self.cuda is None else round(self.cuda.max_memory_allocated(self.device) / _MIB, 1)


def check_target(path: Path, method: Method) -> None:
    """Refuse, before any work, a file that is no submission or result, or that describes another method.

    Raises SubmissionError, which says what differs.
    """
    submission = read_result(path).submission if _is_result(path) else _described(path)
    method_entries = {"method": method.name, "frames_used": list(method.frames_used), "settings": dict(method.settings)}
    file_entries = {
        "method": submission.method,
        "frames_used": sorted(submission.frames_used),
        "settings": dict(submission.settings),
    }
    for key, value in method_entries.items():
        if file_entries[key] != value:
            raise SubmissionError(
                f"{printable(str(path), 500)}: {key} is {printable(file_entries[key])}, but {printable(value)} would "
                "be timed; a time belongs to the method that was scored: give the same options"
            )


def write_timing(path: Path, timing: Timing) -> None:
    """Put ``timing`` into the file, with ``seconds_per_sample`` and ``hardware`` as measured. See `check_target`."""
    measured = {
        "seconds_per_sample": timing.latency_median_ms / 1000,
        "seconds_source": "measured",
        "hardware": timing.hardware.model_dump(mode="json"),
        "timing": timing.model_dump(mode="json"),
    }
    if _is_result(path):
        result = read_result(path)
        submission = Submission.model_validate({**result.submission.model_dump(mode="json"), **measured})
        write_result(result.model_copy(update={"submission": submission}), path)
        return
    submission = Submission.model_validate({**_described(path).model_dump(mode="json"), **measured})
    try:
        write_submission(path, submission)
    except OSError as error:
        raise SubmissionError(f"{printable(str(path), 500)} can't be written: {error.strerror}") from None


def _is_result(path: Path) -> bool:
    return path.suffix == ".json"


def _described(path: Path) -> Submission:
    if path.name != SUBMISSION_FILE:
        raise SubmissionError(f"{printable(str(path), 500)}: expected a {SUBMISSION_FILE} or a result file (*.json)")
    return read_submission(path.parent)
