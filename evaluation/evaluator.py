"""Scoring a folder of predictions against one split of a dataset: everything checked, every offender named, at once."""

import platform
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from threading import local
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench import __version__
from fpp_ml_bench.errors import DatasetError, PredictionError, SubmissionError
from fpp_ml_bench.evaluation.predictions import buffer_for, list_problems, read_prediction, value_problems
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX, PROTOCOL_VERSION, TARGETS
from fpp_ml_bench.evaluation.result import Environment, Result, result_from_rows
from fpp_ml_bench.evaluation.scores import score_sample
from fpp_ml_bench.evaluation.submission import SUBMISSION_FILE, Submission, read_submission
from fpp_ml_bench.evaluation.text import printable
from fpp_ml_bench.evaluation.timing import HardwareInfo
from fpp_ml_bench.frames import Sequence
from fpp_ml_bench.hardware import describe_hardware, usable_cores
from fpp_ml_bench.pixel_sets import edge_jump_mm

WORKERS = 4


class ScoredDataset(Protocol):
    """What the evaluator needs of a dataset; `fpp_ml_bench.loaders.store.DatasetFolder` has it."""

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
) -> Result:
    """Score ``folder`` (one ``{sample}.npy`` in mm per sample, and ``submission.yaml``) on a split of ``dataset``.

    ``target`` is ``depth`` (decoded, as in the paper) or ``depth_exact`` (from the ray cast). Memory does not grow with
    the number of samples, and the result does not depend on the number of cores.

    Raises SubmissionError for the description, PredictionError (naming every offending file) for the predictions, and
    DatasetError for a target that is no depth map.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise PredictionError(f"expected a folder of predictions, found none at {printable(str(folder), 500)}")
    if target not in TARGETS:
        raise DatasetError(f"expected target {' or '.join(TARGETS)}, got {printable(target)!r}")
    if target == "depth_exact" and not dataset.has_exact:
        raise DatasetError(f"{dataset.path}: has no depth_exact (published data has decoded depth only); use depth")
    samples = dataset.samples(split)
    if not samples:
        raise DatasetError(f"{dataset.path}: split {split} holds no sample; there is nothing to score")
    submission, refused = None, None
    try:
        submission = _described(folder, len(dataset.sequence))
    except SubmissionError as error:
        refused = error
    split_of = {sample: name for name, names in dataset.splits.items() for sample in names}
    problems = list_problems(folder, samples, split, split_of)
    rows = []
    for found, row in _scored(folder, dataset, samples, target, edge_band_px):
        problems += found
        rows += row
    if problems:
        count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
        described = [str(refused)] if refused else []
        raise PredictionError(f"{printable(str(folder), 500)} can't be scored, {count}:", described + problems)
    if refused or submission is None:
        raise refused or SubmissionError(f"{printable(str(folder), 500)} has no description")
    height, width = dataset.size
    return result_from_rows(
        rows,
        protocol_version=PROTOCOL_VERSION,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        submission=submission,
        dataset={
            "name": printable(Path(dataset.path).resolve().name, 100).strip() or "dataset",
            "fingerprint": dataset.fingerprint,
            "split": split,
            "size": [height, width],
            "samples": len(samples),
        },
        target=target,
        edge_band_px=edge_band_px,
        edge_jump_mm=edge_jump_mm(width),
        environment=_environment(),
    )


def _described(folder: Path, frames: int) -> Submission:
    """The folder's description, its frame indices checked against a sequence of ``frames`` frames."""
    submission = read_submission(folder)
    outside = [index for index in submission.frames_used if index >= frames]
    if outside:
        raise SubmissionError(
            f"{printable(str(folder / SUBMISSION_FILE), 500)}: frames_used: expected indices from 0 to {frames - 1} of "
            f"this dataset's sequence, got {printable(str(outside), 100)}"
        )
    return submission


Found = tuple[list[str], list[dict[str, Any]]]


def _scored(
    folder: Path, dataset: ScoredDataset, samples: list[str], target: str, edge_band_px: int
) -> Iterator[Found]:
    """Problems and the row of each sample that is there, in order; a few files at a time, read by a few threads."""
    size = dataset.size
    memory = local()

    def work(path: Path, sample: str, target_mm: NDArray[np.float32]) -> Found:
        if not hasattr(memory, "buffer"):
            memory.buffer = buffer_for(size)
        return _score_file(path, sample, target_mm, edge_band_px, memory.buffer)

    with ThreadPoolExecutor(min(WORKERS, usable_cores())) as pool:
        yield from _in_order(pool, [(folder / f"{s}.npy", s) for s in samples], dataset, target, work)


def _in_order(
    pool: ThreadPoolExecutor,
    files: list[tuple[Path, str]],
    dataset: ScoredDataset,
    target: str,
    work: Callable[[Path, str, NDArray[np.float32]], Found],
) -> Iterator[Found]:
    waiting: deque[Future[Found]] = deque()
    for path, sample in files:
        if not path.is_symlink() and not path.exists():
            continue  # listed as missing already
        waiting.append(pool.submit(work, path, sample, dataset.target_mm(sample, target)))
        if len(waiting) > 2 * WORKERS:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


def _score_file(path: Path, sample: str, target_mm: NDArray[np.float32], band_px: int, buffer: bytearray) -> Found:
    low, high = float(target_mm.min()), float(target_mm.max())
    if not (low >= 0 and np.isfinite(high)):
        raise DatasetError(f"{sample}: the target depth holds NaN, infinite or negative values; run: fpp-bench verify")
    try:
        prediction, digest = read_prediction(path, (target_mm.shape[0], target_mm.shape[1]), buffer)
        problems = value_problems(prediction, high)
        scores = None if problems else score_sample(prediction, target_mm, band_px)
    except PredictionError as error:
        problems, scores = [str(error)], None
    if scores is None:
        return [f"{path.name}: {problem}" for problem in problems], []
    return [], [
        {
            "sample": sample,
            "prediction_sha256": digest,
            "object_pixels": scores.object.pixels,
            "background_pixels": scores.background.pixels,
            **scores.metrics(),
        }
    ]


def _environment() -> Environment:
    import pyarrow

    return Environment(
        python=platform.python_version(),
        packages={"fpp_ml_bench": __version__, "numpy": np.__version__, "pyarrow": pyarrow.__version__},
        hardware=HardwareInfo.model_validate(describe_hardware().to_dict()),
    )
