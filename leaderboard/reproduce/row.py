"""Making a row: predictions, their time, their scores, a row file and its picture; and whether a row is up to date."""

import shutil
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

from fpp_ml_bench.baselines.run import predict_split
from fpp_ml_bench.baselines.timing import time_method, write_timing
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import PROTOCOL_VERSION
from fpp_ml_bench.evaluation.report import write_sheet
from fpp_ml_bench.evaluation.result import write_result
from fpp_ml_bench.evaluation.score import evaluate
from fpp_ml_bench.evaluation.submission import SUBMISSION_FILE
from fpp_ml_bench.leaderboard.reproduce.plan import Folders
from fpp_ml_bench.leaderboard.rows import Entry, read_entry, write_row
from fpp_ml_bench.loaders.storage import DatasetFolder

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.networks import NetworkMethod

SPLIT, TARGET = "test", "depth"
REPEATS = 20
PROVENANCE = "measured here"


def make_row(opened: DatasetFolder, method: "NetworkMethod", name: str, folders: Folders) -> Entry:
    """Predict the test split, time the method, score against the decoded depth (as in the paper), write the row.

    Files of an earlier run under this name are replaced at the end; an interrupted run leaves nothing that is taken for
    finished. Raises what predicting, timing and scoring raise, and SubmissionError where the rows
    folder holds a row of this name on other data.
    """
    path = folders.rows / f"{name}.json"
    _check_row_is_of(path, opened)
    predictions = folders.predictions(name)
    making = predictions.with_name(f"{name}.making")
    shutil.rmtree(making, ignore_errors=True)
    predict_split(opened, method, SPLIT, making)
    write_timing(making / SUBMISSION_FILE, time_method(opened, method, SPLIT, repeats=REPEATS))
    result = evaluate(making, opened, SPLIT, TARGET, mode=method.mode)
    for folder in (folders.rows, folders.result(name).parent):
        folder.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(predictions, ignore_errors=True)
    making.rename(predictions)
    write_result(result, folders.result(name))
    write_sheet(result, opened, predictions, path.with_suffix(".png"))
    write_row(Entry(path, result), PROVENANCE, path)
    return read_entry(path)


def row_that_holds(path: Path, opened: DatasetFolder, weights_sha256: str) -> Entry | None:
    """The row in ``path`` if it is sound, of this dataset, these weights and today's protocol; else None."""
    if not path.is_file():
        return None
    try:
        entry = read_entry(path)
    except SubmissionError:
        return None
    result = entry.result
    same = (
        result.dataset.fingerprint == opened.fingerprint
        and result.submission.settings.get("weights_sha256") == weights_sha256
        and result.protocol_version == PROTOCOL_VERSION
    )
    return entry if same else None


def _check_row_is_of(path: Path, opened: DatasetFolder) -> None:
    if not path.is_file():
        return
    try:
        fingerprint = read_entry(path).result.dataset.fingerprint
    except SubmissionError:
        return  # unreadable: nothing is lost by replacing it
    if fingerprint != opened.fingerprint:
        raise SubmissionError(
            f"{path}: is a row on dataset {fingerprint[:8]}, and {opened.path} is {opened.fingerprint[:8]}; give "
            "another --rows, or move the row away if it is out of date"
        )


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, 64 hex digits."""
    return sha256(path.read_bytes()).hexdigest()
