"""Scoring a folder of predictions against one split of a dataset: everything is checked, every problem is named."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock, local
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.depth import edge_jump_mm
from fpp_ml_bench.errors import DatasetError, PredictionError, SubmissionError
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX, MODES, PROTOCOL_VERSION, TARGETS, Mode, Units
from fpp_ml_bench.evaluation.score.scores import score_sample
from fpp_ml_bench.evaluation.score.units import scored_pair, value_problems
from fpp_ml_bench.evaluation.submission import SUBMISSION_FILE, Listing, list_folder, read_plain, reader_for
from fpp_ml_bench.files import printable
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.optics import Sequence

if TYPE_CHECKING:
    from fpp_ml_bench.evaluation.result import Result
    from fpp_ml_bench.evaluation.submission import Submission


class ScoredDataset(Protocol):
    """What the evaluator needs of a dataset; `fpp_ml_bench.loaders.storage.store.DatasetFolder` has it."""

    path: Path

    @property
    def fingerprint(self) -> str: ...
    @property
    def size(self) -> tuple[int, int]: ...
    @property
    def sequence(self) -> Sequence: ...
    @property
    def splits(self) -> dict[str, list[str]]: ...
    @property
    def has_exact(self) -> bool: ...
    def samples(self, split: str) -> list[str]: ...
    def target_mm(self, sample: str, column: str = ...) -> NDArray[np.float32]: ...


def evaluate(
    folder: str | Path,
    dataset: ScoredDataset,
    split: str = "test",
    target: str = "depth",
    edge_band_px: int = EDGE_BAND_PX,
    mode: str = "standard",
    while_scoring: Callable[[], object] = lambda: None,
) -> "Result":
    """Score ``folder`` (predictions in one of the accepted forms, and ``submission.yaml``) on a split of ``dataset``.

    ``target`` is ``depth`` (decoded, as in the paper) or ``depth_exact`` (from the ray cast); ``mode`` is ``standard``
    or ``paper-individual`` (the paper's rule for individually normalised depth). Memory does not grow with the number
    of samples, and the result does not depend on the number of cores. ``while_scoring`` is called once while threads
    score: a command uses it to import what it needs afterwards.

    Raises SubmissionError for the description, PredictionError (naming every file with a problem) for the predictions,
    and DatasetError for a target that is not a depth map.
    """
    folder = Path(folder)
    samples = _samples(folder, dataset, split, target, mode)
    content, description_error = None, None
    try:
        content = read_plain(folder)
    except SubmissionError as error:
        description_error = error
    split_of = {sample: name for name, names in dataset.splits.items() for sample in names}
    listing = list_folder(folder, samples, split, split_of)
    units, mm_per_level = _declared_units(content or {})
    rules = Rules(dataset.size, units, mm_per_level, mode, edge_band_px)  # type: ignore[arg-type]
    problems, rows = list(listing.problems), []
    # The description is checked while the first files are scored: pydantic takes long to import.
    release = getattr(dataset, "release", lambda sample: None)  # only a memory-mapped dataset has pages to release
    outcomes = (
        scored(folder, listing, rules, lambda sample: dataset.target_mm(sample, target), release)
        if units in get_args(Units)
        else ()
    )
    submission: Submission | None = None
    if content is not None:
        try:
            submission = _checked_submission(folder, content, len(dataset.sequence), listing.form, mode)
        except SubmissionError as error:
            description_error = error
        from fpp_ml_bench.evaluation.result import provenance  # noqa: F401  imported while the threads score

        while_scoring()
    for file_problems, file_rows in outcomes:
        problems += file_problems
        rows += file_rows
    if problems:
        count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
        description_problems = [str(description_error)] if description_error else []
        raise PredictionError(
            f"{printable(str(folder), 500)} can't be scored, {count}:", description_problems + problems
        )
    if description_error or submission is None:
        raise description_error or SubmissionError(f"{printable(str(folder), 500)} has no description")
    return _result(rows, dataset, split, target, mode, edge_band_px, submission)


def _samples(folder: Path, dataset: ScoredDataset, split: str, target: str, mode: str) -> list[str]:
    """The split's samples; refuses arguments that name no folder, target, mode or sample."""
    if not folder.is_dir():
        raise PredictionError(f"expected a folder of predictions, found none at {printable(str(folder), 500)}")
    if target not in TARGETS:
        raise DatasetError(f"expected target {' or '.join(TARGETS)}, got {printable(target)!r}")
    if mode not in MODES:
        raise DatasetError(f"expected mode {' or '.join(MODES)}, got {printable(mode)!r}")
    if target == "depth_exact" and not dataset.has_exact:
        raise DatasetError(f"{dataset.path}: has no depth_exact (published data has decoded depth only); use depth")
    samples = dataset.samples(split)
    if not samples:
        raise DatasetError(f"{dataset.path}: split {split} holds no sample; there is nothing to score")
    return samples


def _declared_units(content: dict[Any, Any]) -> tuple[Any, float | None]:
    """Units and PNG scale as declared; `submission` refuses values that are neither."""
    units, scale = content.get("units", "mm"), content.get("png_mm_per_level")
    return units, float(scale) if isinstance(scale, int | float) and not isinstance(scale, bool) else None


def _checked_submission(folder: Path, content: dict[Any, Any], frames: int, form: str, mode: str) -> "Submission":
    """The folder's description, checked against the predictions' form, the mode and a sequence of ``frames``."""
    from fpp_ml_bench.evaluation.submission import check_submission

    submission = check_submission(folder, content)
    file = printable(str(folder / SUBMISSION_FILE), 500)
    outside = [index for index in submission.frames_used if index >= frames]
    if outside:
        raise SubmissionError(
            f"{file}: frames_used: expected indices from 0 to {frames - 1} of "
            f"this dataset's sequence, got {printable(str(outside), 100)}"
        )
    if (form == ".png") != (submission.png_mm_per_level is not None):
        raise SubmissionError(
            f"{file}: png_mm_per_level: expected what one level of the .png files is in mm, like 0.05, got nothing"
            if form == ".png"
            else f"{file}: png_mm_per_level is given, but the predictions are {form}; remove the key"
        )
    if mode == "paper-individual" and submission.units != "normalised":
        raise SubmissionError(
            f"{file}: --mode paper-individual scores normalised depth (units: normalised), these are in "
            f"{submission.units}; score them with --mode standard"
        )
    return submission


def _result(
    rows: list[dict[str, Any]],
    dataset: ScoredDataset,
    split: str,
    target: str,
    mode: str,
    edge_band_px: int,
    submission: "Submission",
) -> "Result":
    from fpp_ml_bench.evaluation.result import environment, result_from_rows
    from fpp_ml_bench.loaders.storage import benchmark_of

    height, width = dataset.size
    benchmark = benchmark_of(dataset.fingerprint)
    return result_from_rows(
        [{**row, "object": split_sample_name(row["sample"])[0]} for row in rows],
        protocol_version=PROTOCOL_VERSION,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        submission=submission,
        dataset={
            "name": printable(Path(dataset.path).resolve().name, 100).strip() or "dataset",
            "fingerprint": dataset.fingerprint,
            "benchmark": {"name": benchmark.name, "version": benchmark.version} if benchmark else None,
            "split": split,
            "size": [height, width],
            "samples": len(rows),
        },
        target=target,
        mode=mode,
        edge_band_px=edge_band_px,
        edge_jump_mm=edge_jump_mm(width),
        environment=environment(),
    )


WORKERS = 4
Outcome = tuple[list[str], list[dict[str, Any]]]
"""Problems and rows of a sample: a line for each problem and no row, or no problem and a row."""


class Rules(NamedTuple):
    """How predictions are read and scored."""

    size: tuple[int, int]
    units: Units
    png_mm_per_level: float | None
    mode: Mode
    edge_band_px: int


def scored(
    folder: Path,
    listing: Listing,
    rules: Rules,
    target_mm: Callable[[str], NDArray[np.float32]],
    release: Callable[[str], None] = lambda sample: None,
) -> Iterator[Outcome]:
    """Problems and row of each sample that has a prediction, in order.

    ``target_mm`` gives a sample's target (H, W); ``release`` is called when it is not needed any more.

    Work begins with this call, in threads, before the first outcome is taken from the iterator.
    """
    read = reader_for(listing.form, folder, listing.present, rules.size, rules.png_mm_per_level)
    memory, dataset_lock = local(), Lock()

    def work(sample: str) -> Outcome:
        with dataset_lock:  # reading the dataset need not be thread-safe
            target = target_mm(sample)
        low, high = float(target.min()), float(target.max())
        if not (low >= 0 and np.isfinite(high)):
            raise DatasetError(
                f"{sample}: the target depth holds NaN, infinite or negative values; run: fpp-bench verify"
            )
        try:
            values, digest = read(sample, memory)
            problems = value_problems(values, target, high, rules.units)
            if not problems:
                pair = scored_pair(values, target, rules.units, rules.mode, sample)
                scores = score_sample(*pair, rules.edge_band_px)
        except PredictionError as error:
            problems = [str(error)]
        with dataset_lock:
            release(sample)
        if problems:
            return [f"{read.named(sample)}: {problem}" for problem in problems], []
        return [], [
            {
                "sample": sample,
                "prediction_sha256": digest,
                "object_pixels": scores.object.pixels,
                "background_pixels": scores.background.pixels,
                **scores.metrics(),
            }
        ]

    pool = ThreadPoolExecutor(min(WORKERS, usable_cores()))
    return _results(pool, [pool.submit(work, sample) for sample in listing.present])


def _results(pool: ThreadPoolExecutor, futures: list[Future[Outcome]]) -> Iterator[Outcome]:
    try:
        for future in futures:
            yield future.result()
    finally:
        pool.shutdown(cancel_futures=True)
