"""The report of a result: a figure of the errors, the scores, and samples from best to worst on an HTML page."""

import io
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from fpp_ml_bench.errors import DatasetError, PredictionError
from fpp_ml_bench.evaluation.metrics import WIDE, with_column
from fpp_ml_bench.evaluation.report.figures import errors_figure, figure_uri, sample_panels
from fpp_ml_bench.evaluation.report.html import page, render, score_text
from fpp_ml_bench.evaluation.report.terminal import result_table
from fpp_ml_bench.evaluation.result.file import write_file
from fpp_ml_bench.evaluation.result.model import Result
from fpp_ml_bench.evaluation.result.parts import SampleResult
from fpp_ml_bench.evaluation.score.check import Depth, Rules
from fpp_ml_bench.evaluation.submission.prediction_files import list_folder
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.pictures import panel_figure
from fpp_ml_bench.loaders.storage.store import DatasetFolder

REPORT_FILE = "index.html"
_PLACES = (("Best", 0.0), ("Worst", 1.0), ("Median", 0.5), ("Lower quartile", 0.25), ("Upper quartile", 0.75))
"""The samples that are shown and their place by error, in the order in which they are chosen where there are few."""


def write_report(result: Result, dataset: DatasetFolder, predictions_folder: str | Path, out: str | Path) -> Path:
    """Write ``out/index.html`` for a result and the predictions it was made from, and return its path. The page is
    self-contained and loads nothing. Pixels of at most five samples are read, so memory does not grow with the number
    of samples. Raises DatasetError when ``dataset`` is not the dataset that was scored, PredictionError for a
    prediction that can't be read any more, and SubmissionError where the page can't be written."""
    errors = [row.object_mae_mm for row in result.per_sample if row.object_mae_mm is not None]
    body = render(
        __package__,
        "report.html",
        result=result,
        samples=sample_maps(result, dataset, Path(predictions_folder), chosen_samples(result.per_sample)),
        figure=errors_figure(errors, result.uncertainty) if errors else None,
        scores=_terminal_text(result),
        table=_sample_rows(result),
    )
    path = Path(out) / REPORT_FILE
    write_file(page(f"{result.submission.name}: report", body).encode("utf-8"), path, new_folder=True)
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


@dataclass(frozen=True)
class SampleMaps:
    """A scored sample: its ``place`` by error in words and its scores; the ``fringe`` image, and what was scored as
    truth and as prediction, (H, W) in mm, 0 = background."""

    place: str
    row: SampleResult
    fringe: NDArray[np.uint8]
    target_mm: Depth
    prediction_mm: Depth

    @cached_property
    def picture(self) -> str:
        """Its five panels as a data URI."""
        return figure_uri(panel_figure(sample_panels(self.fringe, self.target_mm, self.prediction_mm)))


def sample_maps(
    result: Result, dataset: DatasetFolder, folder: Path, chosen: Sequence[tuple[str, SampleResult]]
) -> Iterator[SampleMaps]:
    """The maps of the ``chosen`` samples, each a place and a row; one sample's pixels at a time. Raises as
    `write_report` does."""
    if not result.dataset.content.items() <= dataset.content.items():
        raise DatasetError(f"{dataset.path}: is not what was scored; give {printable(result.dataset.identity)}")
    submission = result.submission
    rules = Rules(result.target, submission.units, submission.range_rule, result.mode)
    listing = list_folder(folder, dataset, result.dataset.split)
    read = listing.reader(dataset.size, submission.png_mm_per_level)
    # The first frame that the method used; frame 0 where it used none or that frame is not stored here.
    used = [index for index in sorted(submission.frames_used) if index < len(dataset.sequence)]
    for place, row in chosen:
        try:
            values, digest = read(row.sample)
        except PredictionError as error:
            raise PredictionError(f"{listing.named(row.sample)}: {error}") from None
        if digest != row.prediction_sha256:
            named = listing.named(row.sample)
            raise PredictionError(f"{named}: is not the file that was scored; score the folder again")
        prediction_mm, target = rules.pair(values, dataset, row.sample)
        try:
            fringe = dataset.frame(row.sample, used[0] if used else 0)
        except DatasetError:
            fringe = dataset.frame(row.sample, 0)
        # The reader fills the same memory with the next sample.
        yield SampleMaps(place, row, fringe, target, np.array(prediction_mm))


def _terminal_text(result: Result) -> str:
    """What `fpp-eval` prints of a result, as plain text."""
    stream = io.StringIO()
    Console(file=stream, width=130, color_system=None, highlight=False).print(result_table(result))
    return stream.getvalue()


def _sample_rows(result: Result) -> tuple[list[str], list[list[str]]]:
    """Titles and cells of every sample, the largest object MAE first, with the hash of the prediction it comes from."""
    shown = with_column(WIDE)
    ordered = sorted(result.per_sample, key=lambda row: (-(row.object_mae_mm or 0.0), row.sample))
    rows = [
        [r.sample, *(score_text(m.key, getattr(r, m.key)) for m in shown), r.prediction_sha256[:12]] for r in ordered
    ]
    return ["Sample", *(metric.title for metric in shown), "Prediction SHA-256"], rows
