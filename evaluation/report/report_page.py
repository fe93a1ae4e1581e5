"""The report of a result: a histogram of the errors, the scores, and samples from best to worst on an HTML page."""

import statistics
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from threading import local
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import DatasetError, PredictionError, SubmissionError
from fpp_ml_bench.evaluation.report.figures import Panel, histogram_svg, panels_html, sample_panels
from fpp_ml_bench.evaluation.report.html import escaped, page
from fpp_ml_bench.evaluation.report.numbers import millimetres, seconds
from fpp_ml_bench.evaluation.report.score_tables import sample_table, score_table
from fpp_ml_bench.evaluation.result import Result, SampleResult
from fpp_ml_bench.evaluation.score import scored_pair
from fpp_ml_bench.evaluation.submission import list_folder, reader_for
from fpp_ml_bench.files import printable, write_atomically
from fpp_ml_bench.optics import Sequence

Pair = tuple[NDArray[np.floating], NDArray[np.floating]]
REPORT_FILE = "index.html"
_PLACES = (("Best", 0.0), ("Worst", 1.0), ("Median", 0.5), ("Lower quartile", 0.25), ("Upper quartile", 0.75))
"""The samples that are shown and their place by error, in the order in which they are chosen where there are few."""


class ReportedDataset(Protocol):
    """What a report needs of a dataset; `fpp_ml_bench.loaders.storage.store.DatasetFolder` has it."""

    path: Path

    @property
    def fingerprint(self) -> str: ...
    @property
    def size(self) -> tuple[int, int]: ...
    @property
    def sequence(self) -> Sequence: ...
    def frame(self, sample: str, index: int) -> NDArray[np.uint8]: ...
    def target_mm(self, sample: str, column: str = ...) -> NDArray[np.float32]: ...


def write_report(result: Result, dataset: ReportedDataset, predictions_folder: str | Path, out: str | Path) -> Path:
    """Write ``out/index.html`` for a result and the predictions it was made from, and return its path.

    The page is self-contained and loads nothing. Pixels of at most five samples are read, so memory does not grow with
    the number of samples.

    Raises DatasetError when ``dataset`` is not the dataset that was scored, PredictionError for a prediction that can't
    be read any more, and SubmissionError where the page can't be written.
    """
    panels = chosen_panels(result, dataset, Path(predictions_folder))
    body = report_body(result, [_sample_html(*sample) for sample in panels])
    path = Path(out) / REPORT_FILE
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, page(f"{result.submission.name}: report", body).encode("utf-8"))
    except OSError as error:
        raise SubmissionError(f"{printable(str(path), 500)} can't be written: {error.strerror}") from None
    return path


def chosen_samples(rows: Iterable[SampleResult]) -> list[tuple[str, SampleResult]]:
    """Best, median, worst and the quartiles by object MAE, each sample once, with the place it holds."""
    scored = sorted((row for row in rows if row.object_mae_mm is not None), key=_by_object_error)
    chosen: dict[str, tuple[str, SampleResult]] = {}
    for title, share in _PLACES:
        if scored:
            row = scored[round(share * (len(scored) - 1))]
            chosen.setdefault(row.sample, (title, row))
    return sorted(chosen.values(), key=lambda place_and_row: _by_object_error(place_and_row[1]))


def _by_object_error(row: SampleResult) -> tuple[float, str]:
    return row.object_mae_mm or 0.0, row.sample


def chosen_panels(
    result: Result, dataset: ReportedDataset, folder: Path
) -> Iterator[tuple[str, SampleResult, list[Panel]]]:
    """The place, the row and the panels of each chosen sample, the best first; one sample's pixels at a time.

    Raises DatasetError when ``dataset`` is not the dataset that was scored.
    """
    if dataset.fingerprint != result.dataset.fingerprint:
        raise DatasetError(
            f"{dataset.path}: fingerprint {dataset.fingerprint[:8]} is not {result.dataset.fingerprint[:8]}, which was "
            "scored; give the dataset that the result names"
        )
    read = prediction_reader(result, dataset, folder)
    for title, row in chosen_samples(result.per_sample):
        prediction_mm, target_mm = read(row)
        yield title, row, sample_panels(_fringe(result, dataset, row.sample), target_mm, prediction_mm, row.sample)


def _sample_html(title: str, row: SampleResult, panels: list[Panel]) -> str:
    return (
        f"<div><h3>{escaped(title)}: {escaped(row.sample)}</h3>"
        f'<p class="soft small">Object MAE {millimetres(row.object_mae_mm)} mm, RMSE '
        f"{millimetres(row.object_rmse_mm)} mm; background MAE {millimetres(row.background_mae_mm)} mm</p>"
        f"{panels_html(panels)}</div>"
    )


def prediction_reader(result: Result, dataset: ReportedDataset, folder: Path) -> Callable[[SampleResult], Pair]:
    """A function from a sample's row to its prediction and target as they were scored, (H, W) each, in mm."""
    samples = [row.sample for row in result.per_sample]
    listing = list_folder(folder, samples, result.dataset.split, {})
    submission = result.submission
    read = reader_for(listing.form, folder, samples, dataset.size, submission.png_mm_per_level)
    memory = local()

    def pair(row: SampleResult) -> Pair:
        try:
            values, digest = read(row.sample, memory)
        except PredictionError as error:
            raise PredictionError(f"{read.named(row.sample)}: {error}") from None
        if digest != row.prediction_sha256:
            raise PredictionError(f"{read.named(row.sample)}: is not the file that was scored; score the folder again")
        target_mm = dataset.target_mm(row.sample, result.target)
        prediction_mm, target_mm = scored_pair(values, target_mm, submission.units, result.mode, row.sample)
        return np.asarray(prediction_mm), np.asarray(target_mm)

    return pair


def _fringe(result: Result, dataset: ReportedDataset, sample: str) -> NDArray[np.uint8]:
    """The first frame that the method used; frame 0 where it used none or that frame is not stored here."""
    used = [index for index in sorted(result.submission.frames_used) if index < len(dataset.sequence)]
    try:
        return dataset.frame(sample, used[0] if used else 0)
    except DatasetError:
        return dataset.frame(sample, 0)


def report_body(result: Result, panels: list[str]) -> str:
    """The page below ``<body>``."""
    info, submission = result.dataset, result.submission
    sample_seconds = submission.seconds_per_sample
    time = (
        "unknown time"
        if sample_seconds is None
        else f"{seconds(sample_seconds)} s per sample ({submission.seconds_source})"
    )
    lines = [
        f"{info.split} split of {printable(info.name)} ({printable(info.identity)}), {info.samples} samples of "
        f"{info.size[1]} x {info.size[0]} px, against {result.target}, {result.track} track",
        f"{len(submission.frames_used)} frames per sample; {time}; protocol {result.protocol_version}, scored "
        f"{result.created}",
    ]
    errors = [row.object_mae_mm for row in result.per_sample if row.object_mae_mm is not None]
    histogram = (
        histogram_svg(errors, statistics.fmean(errors), "object MAE of a sample")
        if errors
        else "<p>No sample has an object, so none has an object error.</p>"
    )
    intro = "".join(f'<p class="soft">{escaped(line, 500)}</p>' for line in lines)
    return (
        f"<header><h1>{escaped(submission.name)}</h1>{intro}"
        '</header>\n<main id="main">\n'
        f"<section><h2>Errors of the samples</h2>{_missing(result)}<figure>{histogram}</figure></section>\n"
        f"<section><h2>Scores</h2>{score_table(result)}</section>\n"
        '<section><h2>From the best sample to the worst</h2><p class="soft small">By object MAE. Absolute error '
        "clipped at its 95th percentile over the object; signed error: blue is too near, red is too far.</p>"
        f'<div class="samples">{"".join(panels)}</div></section>\n'
        f"<section><h2>Every sample</h2>{sample_table(result)}</section>\n</main>\n"
    )


def _missing(result: Result) -> str:
    parts = []
    for pixels in ("object", "background"):
        count = getattr(result, f"samples_without_{pixels}")
        if count:
            parts.append(f"<p>{count} of {result.dataset.samples} samples have no {pixels} and no score of it.</p>")
    return "".join(parts)
