"""Running a method over a split: one prediction a sample, timed, and a submission that says how it
was made."""

import json
import os
import statistics
from collections.abc import Callable, Mapping
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.method import Answer, Frames, Method, checked
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DecodeError, PredictionError
from fpp_ml_bench.evaluation.submission.description import check_submission
from fpp_ml_bench.evaluation.submission.prediction_files import (
    REPORTS_FILE,
    SIGMA,
    SUBMISSION_FILE,
    UNFINISHED_FILE,
)
from fpp_ml_bench.files import (
    LOCK_FILE,
    exclusive,
    file_content,
    naming,
    printable,
    strict_json,
    write_atomically,
)
from fpp_ml_bench.loaders.sample import row_columns
from fpp_ml_bench.loaders.storage.store import ALL_SPLITS, DatasetFolder
from fpp_ml_bench.machine import THREAD_COUNTS, describe_hardware
from fpp_ml_bench.skipping import Explanation, LeftOut, explained, skipping

PREDICTION_SUFFIX = ".npy"
LARGEST_JOURNAL_BYTES = 1 << 28


def predict_split(
    opened: DatasetFolder,
    method: Method,
    split: str,
    out: Path,
    progress: Callable[[int], None] = lambda samples: None,
) -> float:
    """Predict every sample of ``split`` into ``out`` by `Method.answer`: ``{sample}.npy`` float32
    (H, W) in mm or the method's own units, ``{sample}.sigma.npy`` of a method that states its
    uncertainty, and ``submission.yaml`` last. The reports of a method that ``reports`` are written
    beside, by sample, as `REPORTS_FILE`, and its summary of them into the submission's settings.
    Median seconds a sample.

    A sample's time is that of the method on frames in memory, after one run that is not counted;
    the submission gives the median over the split. A run that was stopped continues behind its last
    finished sample. ``opened`` should be `without_truth`: the method can see it.

    Raises `PredictionError` for an ``out`` that another process predicts into, or that holds
    anything but an unfinished run of the same method, code, settings, data and machine,
    `SubmissionError` for a method that describes itself wrongly, and `DatasetError` when the
    dataset lacks a frame that the method needs."""
    samples = opened.samples(split)  # before a folder is made
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PredictionError(f"{out}: can't be made a folder ({error.strerror})") from error
    with exclusive(out / LOCK_FILE, out, "predicting into this folder", PredictionError):
        run = _prepare(out, opened, method, split)
        warm = False
        for sample in samples:
            path = out / f"{sample}{PREDICTION_SUFFIX}"
            if not run.holds(sample, path, opened.size):
                frames = captured_frames(opened, method, sample)
                if not warm:
                    _answer(method, frames, sample)
                    warm = True
                started = perf_counter()
                answer = _answer(method, frames, sample)
                seconds = perf_counter() - started
                checked(answer, opened.size, path)
                run.begin()
                _write_prediction(path, answer.depth)
                if answer.sigma_mm is not None:
                    _write_prediction(out / f"{sample}{SIGMA}", answer.sigma_mm)
                run.add(sample, seconds, dict(answer.report) if method.reports else {})
            progress(1)
        finished = {sample: run.finished[sample] for sample in samples}
        median = statistics.median(seconds for seconds, _ in finished.values())
        summary: dict[str, Any] = {}
        if method.reports:
            reports = {sample: report for sample, (_, report) in finished.items()}
            write_atomically(
                out / REPORTS_FILE,
                (json.dumps(reports, indent=1, allow_nan=False) + "\n").encode("utf-8"),
            )
            summary = method.summary(list(reports.values()))
        timed = {"seconds_per_sample": float(f"{median:.6g}"), "seconds_source": "measured"}
        described = {**_described(method), **_predicted(opened, method, split)}
        described["settings"] |= summary
        submission = check_submission(out, {**described, **timed})
        write_atomically(out / SUBMISSION_FILE, submission.to_yaml().encode("utf-8"))
        run.path.unlink(missing_ok=True)
        return median


class UnfinishedRun:
    """What a stopped run in ``folder`` left, and whether it is the run that ``run`` describes in
    plain values. ``finished``: seconds and report by sample, of all calls so far.

    ``unfinished.jsonl`` stands beside the predictions until all are there. Its first line says what
    run it is, each further one is a finished sample, written when its files are. A last line that
    was cut off does not count."""

    def __init__(self, folder: Path, run: Mapping[str, Any]) -> None:
        """Raises PredictionError for a file that belongs to another run."""
        self.path = folder / UNFINISHED_FILE
        self.run = json.loads(json.dumps(run))
        self.finished: dict[str, tuple[float, dict[str, Any]]] = {}
        if not self.path.exists():
            return
        cure = "remove the folder, or give another one"
        text = file_content(self.path, LARGEST_JOURNAL_BYTES, PredictionError, cure).decode(
            "utf-8", "replace"
        )
        lines = [entry for line in text.splitlines() if isinstance(entry := _parsed(line), dict)]
        if not text.startswith("{") or not lines:
            self.path.unlink()  # stopped before the first line was whole
            return
        earlier, now = _flat(lines[0]), _flat(self.run)
        if differing := [key for key in {**earlier, **now} if earlier.get(key) != now.get(key)]:
            key = differing[0]
            values = [printable(json.dumps(run.get(key)), 150) for run in (earlier, now)]
            raise PredictionError(
                f"{folder}: holds an unfinished run that differs in {', '.join(differing)} ({key}: "
                f"{values[0]} there, "
                f"{values[1]} now); finish it with its own options, code and data, remove the "
                f"folder, or give another "
                "one"
            )
        for entry in lines[1:]:
            with suppress(
                KeyError, TypeError, ValueError
            ):  # a damaged line: its sample is predicted again
                self.finished[str(entry["sample"])] = float(entry["seconds"]), dict(entry["report"])
        if not text.endswith("\n"):
            with self.path.open("a", encoding="utf-8") as file:
                file.write("\n")  # what follows is a line of its own

    def holds(self, sample: str, path: Path, size: tuple[int, int]) -> bool:
        """Whether ``sample`` is finished and its file ``path`` is a whole map of ``size``."""
        if sample not in self.finished:
            return False
        try:
            return np.load(path, mmap_mode="r", allow_pickle=False).shape == size
        except (OSError, ValueError, EOFError):
            return False

    def add(self, sample: str, seconds: float, report: dict[str, Any]) -> None:
        """Note that the files of ``sample`` are there."""
        self.finished[sample] = seconds, report
        self._append({"sample": sample, "seconds": seconds, "report": report})

    def begin(self) -> None:
        """Note what run it is, before its first file: a folder with a prediction and no note is not
        taken over."""
        if not self.path.exists():
            self._append(self.run)

    def _append(self, entry: dict[str, Any]) -> None:
        with naming(self.path), self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")
            file.flush()
            os.fsync(file.fileno())


def _answer(method: Method, frames: Frames, sample: str) -> Answer:
    try:
        return method.answer(frames)
    except DecodeError as error:
        raise PredictionError(f"{sample}: {error}") from error


def _flat(run: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of ``run``, and in the place of a mapping its own entries."""
    flat = dict(run)
    for name, part in run.items():
        if isinstance(part, Mapping):
            flat |= {f"{name} {key}": value for key, value in flat.pop(name).items()}
    return flat


def _parsed(line: str) -> Any:
    """The line's JSON; None for one that was cut off."""
    try:
        return strict_json(line)
    except ValueError:
        return None


def captured_frames(
    opened: DatasetFolder, method: Method, sample: str
) -> list[NDArray[np.uint8] | None]:
    """The sequence with the frames that the method uses, read into memory, and None for every other
    frame; 0 outside the object for a method that uses the ground-truth mask (paper Section
    5.3.4)."""
    frames: list[NDArray[np.uint8] | None] = [None] * len(opened.sequence)
    mask = None
    if method.uses_ground_truth_mask:  # of a folder that is closed before the method runs
        mask = object_mask(DatasetFolder(opened.path, check=False).depth_mm(sample))
    for index in method.frames_used:
        frame = opened.frame(sample, index).copy()
        if mask is not None:
            frame *= mask
        frames[index] = frame
    opened.release(sample)
    return frames


def _prepare(out: Path, opened: DatasetFolder, method: Method, split: str) -> UnfinishedRun:
    """Take over what a stopped run left in ``out``; what of it is finished."""
    samples = opened.samples(split)
    file_names = sorted(path.name for path in out.iterdir())
    expected = {LOCK_FILE}
    if UNFINISHED_FILE in file_names:
        expected |= {
            f"{sample}{suffix}" for sample in samples for suffix in (PREDICTION_SUFFIX, SIGMA)
        }
        expected |= {UNFINISHED_FILE, REPORTS_FILE, SUBMISSION_FILE}
    foreign = [name for name in file_names if name not in expected and not name.endswith(".tmp")]
    foreign.sort(
        key=lambda name: name != SUBMISSION_FILE
    )  # of a finished run: its first name to say
    described = _described(method)
    check_submission(
        out, {**described, "seconds_per_sample": None}
    )  # before the first sample, not behind the last
    data = {
        "split": split,
        "fingerprint": opened.fingerprint,
        "threads": os.environ.get(THREAD_COUNTS[0]),
    }
    run = UnfinishedRun(out, {"code": dict(method.code), **described, **data})
    if foreign:
        raise PredictionError(
            f"{out}: already holds {foreign[0]}{' and more' if len(foreign) > 1 else ''}; give a "
            f"new or empty folder, "
            "or remove this one"
        )
    for name in file_names:
        if name.endswith(".tmp"):
            (out / name).unlink()
    return run


def _write_prediction(path: Path, depth_mm: NDArray[np.float32]) -> None:
    content = BytesIO()
    np.save(content, depth_mm, allow_pickle=False)
    write_atomically(path, content.getvalue(), sync=False)  # a later run sees what is not whole


def _described(method: Method) -> dict[str, Any]:
    """What the submission says of ``method`` and the machine, beside the time."""
    return {
        "name": method.title,
        "method": method.name,
        "units": method.units,
        "frames_used": list(method.frames_used),
        "uses_ground_truth_range": method.uses_ground_truth_range,
        **({"range_rule": method.range_rule} if method.range_rule != "object" else {}),
        **({"uses_ground_truth_mask": True} if method.uses_ground_truth_mask else {}),
        **({} if method.learned_from is None else {"learned_from": method.learned_from}),
        "hardware": describe_hardware().to_dict(),
        "software": method.software,
        "settings": {**method.settings},
        **({"seeds": dict(method.seeds)} if method.seeds else {}),
    }


def _predicted(opened: DatasetFolder, method: Method, split: str) -> dict[str, Any]:
    """What the submission says of the data; nothing of a dataset whose manifest has no hashes of
    its content."""
    columns = row_columns(opened.sequence, method.frames_used, opened.has_exact)
    splits = opened.splits if split == ALL_SPLITS else (split,)
    names = [f"{part}/{column}" for part in splits for column in columns]
    content = {name: opened.content[name] for name in names if name in opened.content}
    return (
        {"predicted": {"dataset": str(opened.path.resolve()), "split": split, "content": content}}
        if content
        else {}
    )


COUNTED_SAMPLES = 6
"""Pixels are counted on this many samples, spread evenly over the split; frames follow from the
method alone."""


def explain_predict(opened: DatasetFolder, method: Method, split: str) -> Explanation:
    """The account of a run of ``method`` over ``split``. Looks at `COUNTED_SAMPLES` of the samples
    again."""
    samples = opened.samples(split)
    height, width = opened.size
    unused = [i for i in opened.manifest.stored_frames if i not in method.frames_used]
    lines = [
        LeftOut(
            "frames that the method does not use",
            "frames",
            len(method.frames_used) * len(samples),
            len(unused) * len(samples),
            len(unused) * len(samples) * height * width,
        )
    ]
    count = min(COUNTED_SAMPLES, len(samples))
    stacks = (
        captured_frames(opened, method, samples[i * len(samples) // count]) for i in range(count)
    )
    scale, done = len(samples) / count, 0
    what, bytes_a_pixel = "local fits and orders far from the object", 0
    for frames in stacks:
        if isinstance(method, ClassicalMethod) and method.direction == "both":
            what, bytes_a_pixel = (
                "second direction where the first shows no object",
                len(method.frames_used) // 2,
            )
            with skipping(True):
                done += method.decode(frames).second_px
        elif (crop := method.crop(frames)) is not None:
            done += (crop[0].stop - crop[0].start) * (crop[1].stop - crop[1].start)
        else:
            done += height * width
    left_out = round((count * height * width - done) * scale)
    saved = left_out * bytes_a_pixel or None
    lines.append(
        LeftOut(
            what,
            "pixels",
            round(done * scale),
            left_out,
            saved,
            f"{count} of {len(samples)} samples",
        )
    )
    return explained(
        "predict", f"{method.title}; {len(samples)} samples of {width}x{height} px", lines
    )
