"""Running a method over a split: one prediction a sample, timed, and a submission that says how it was made."""

import json
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.methods import Method, software_of
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.submission import REPORTS_FILE, SUBMISSION_FILE
from fpp_ml_bench.hardware import describe_hardware
from fpp_ml_bench.loaders.store import DatasetFolder
from fpp_ml_bench.pixel_sets import object_mask

PREDICTION_SUFFIX = ".npy"


@dataclass(frozen=True)
class Run:
    """Result of a run: samples written, median seconds a sample."""

    samples: int
    seconds_per_sample: float


def predict_split(
    opened: DatasetFolder, method: Method, split: str, out: Path, progress: Callable[[int], None] = lambda samples: None
) -> Run:
    """Predict every sample of ``split`` into ``out``: ``{sample}.npy`` float32 (H, W) in mm or
    the method's own units, and ``submission.yaml`` last.

    A method that offers ``predict_reported(frames) -> (prediction, report)`` and ``summary(reports)`` gets its reports
    written beside, by sample, as `REPORTS_FILE`, and the summary into the submission's settings.

    A sample's time is that of `Method.predict` on frames that are in memory: neither reading nor writing counts. One
    run that is not counted warms caches and compiled code up. The submission gives the median over the split.

    Raises `PredictionError` for an ``out`` that holds anything but an unfinished run of the same samples, and
    `DatasetError` when the dataset lacks a frame that the method needs.
    """
    samples = opened.samples(split)
    _prepare(out, samples)
    seconds, reports = [], {}
    reported = getattr(method, "predict_reported", None)
    for number, sample in enumerate(samples):
        frames = captured_frames(opened, method, sample)
        if number == 0:
            method.predict(frames)
        started = perf_counter()
        if reported is None:
            depth_mm = method.predict(frames)
        else:
            depth_mm, reports[sample] = reported(frames)
        seconds.append(perf_counter() - started)
        _write_prediction(out / f"{sample}{PREDICTION_SUFFIX}", depth_mm, opened.size)
        progress(1)
    median = statistics.median(seconds)
    summary = _write_reports(out / REPORTS_FILE, method, reports) if reports else {}
    _write_submission(out / SUBMISSION_FILE, method, median, summary)
    return Run(len(samples), median)


def captured_frames(opened: DatasetFolder, method: Method, sample: str) -> list[NDArray[np.uint8] | None]:
    """The sequence with the frames that the method uses, read into memory, and None for every other frame.

    For a method that uses the ground-truth mask they are 0 outside the object (paper Section 5.3.4).
    """
    frames: list[NDArray[np.uint8] | None] = [None] * len(opened.sequence)
    for index in method.frames_used:
        frame = opened.frame(sample, index).copy()
        if getattr(method, "uses_ground_truth_mask", False):
            frame *= object_mask(opened.depth_mm(sample))
        frames[index] = frame
    opened.release(sample)
    return frames


def _prepare(out: Path, samples: list[str]) -> None:
    """Make ``out``, or take over one that a stopped run of the same samples left (it has no submission.yaml)."""
    expected = {f"{sample}{PREDICTION_SUFFIX}" for sample in samples} | {REPORTS_FILE}
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PredictionError(f"{out}: can't be made a folder ({error.strerror})") from error
    file_names = sorted(path.name for path in out.iterdir())
    foreign = [name for name in file_names if name not in expected and not name.endswith(".tmp")]
    if foreign:
        raise PredictionError(
            f"{out}: already holds {foreign[0]}{' and more' if len(foreign) > 1 else ''}; give a new or empty folder"
        )
    for name in file_names:
        (out / name).unlink()


def _write_prediction(path: Path, depth_mm: NDArray[np.float32], size: tuple[int, int]) -> None:
    if depth_mm.shape != size or depth_mm.dtype != np.float32:
        raise PredictionError(f"{path}: the method gave {depth_mm.dtype} {depth_mm.shape}, expected float32 {size}")
    if not np.isfinite(depth_mm).all():
        raise PredictionError(f"{path}: the method gave depths that are not finite: a fault of the method")
    temporary = path.with_suffix(".tmp")
    with temporary.open("wb") as file:
        np.save(file, depth_mm, allow_pickle=False)
    temporary.replace(path)


def _write_reports(path: Path, method: Any, reports: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Write what the method reports of each sample; returns its summary of them."""
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(reports, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    temporary.replace(path)
    summary: dict[str, Any] = method.summary(list(reports.values()))
    return summary


def _write_submission(path: Path, method: Method, seconds_per_sample: float, summary: dict[str, Any]) -> None:
    import yaml

    content: dict[str, Any] = {
        "name": method.title,
        "method": method.name,
        "units": getattr(method, "units", "mm"),
        "frames_used": list(method.frames_used),
        "uses_ground_truth_range": method.uses_ground_truth_range,
        **({"uses_ground_truth_mask": True} if getattr(method, "uses_ground_truth_mask", False) else {}),
        "seconds_per_sample": float(f"{seconds_per_sample:.6g}"),
        "seconds_source": "measured",
        "hardware": describe_hardware().to_dict(),
        "software": software_of(method),
        "settings": {**method.settings, **summary},
        **({"seeds": dict(seeds)} if (seeds := getattr(method, "seeds", {})) else {}),
    }
    temporary = path.with_suffix(".tmp")
    temporary.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8")
    temporary.replace(path)
