"""The report of a result as an HTML page: a figure of the errors and of a stated uncertainty, the
scores, and samples from best to worst."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DatasetError, PredictionError
from fpp_ml_bench.evaluation.metrics import WIDE, with_column
from fpp_ml_bench.evaluation.report.terminal import result_table, score_text
from fpp_ml_bench.evaluation.result.file import write_file
from fpp_ml_bench.evaluation.result.model import Result
from fpp_ml_bench.evaluation.result.parts import SampleResult, Uncertainty
from fpp_ml_bench.evaluation.score.check import Depth, Rules
from fpp_ml_bench.evaluation.submission.prediction_files import list_folder
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.pictures import Panel, panel_figure
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.style import (
    DEPTH_COLOURS,
    ERROR_COLOURS,
    FRAME_COLOURS,
    SIGMA_COLOURS,
    figure,
    figure_png,
    millimetres,
    page,
    styled,
)

REPORT_FILE = "index.html"
_PLACES = (
    ("Best", 0.0),
    ("Worst", 1.0),
    ("Median", 0.5),
    ("Lower quartile", 0.25),
    ("Upper quartile", 0.75),
)
"""The samples that are shown and their place by error, in the order in which they are chosen where
there are few."""
CLIP_PERCENTILE = 95
"""Where the paper clips its error maps (figures of Section 6); here it is the percentile over the
object pixels."""


def write_report(
    result: Result, dataset: DatasetFolder, predictions_folder: str | Path, out: str | Path
) -> Path:
    """Write ``out/index.html`` for a result and the predictions it was made from, and return its
    path. The page is self-contained and loads nothing. Pixels of at most five samples are read, so
    memory does not grow with the number of samples. Raises DatasetError when ``dataset`` is not the
    dataset that was scored, PredictionError for a prediction that can't be read any more, and
    SubmissionError where the page can't be written."""
    errors = [row.object_mae_mm for row in result.per_sample if row.object_mae_mm is not None]
    content = page(
        __package__,
        "report.html",
        f"{result.submission.name}: report",
        result=result,
        samples=sample_maps(
            result, dataset, Path(predictions_folder), chosen_samples(result.per_sample)
        ),
        figure=errors_figure(errors, result.uncertainty) if errors else None,
        scores=result_table(result).renderables[1:],  # without the title, which the page has
        table=_sample_rows(result),
    )
    path = Path(out) / REPORT_FILE
    write_file(content, path, new_folder=True)
    return path


def chosen_samples(rows: Iterable[SampleResult]) -> list[tuple[str, SampleResult]]:
    """Best, median, worst and the quartiles by object MAE, each sample once, with the place it
    holds."""
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
    """A scored sample: its ``place`` by error in words and its scores; the ``fringe`` image, and
    what was scored as truth and as prediction, (H, W) in mm, 0 = background."""

    place: str
    row: SampleResult
    fringe: NDArray[np.uint8]
    target_mm: Depth
    prediction_mm: Depth

    @cached_property
    def picture(self) -> bytes:
        """Its five panels as PNG."""
        return figure_png(
            panel_figure(sample_panels(self.fringe, self.target_mm, self.prediction_mm))
        )


def sample_maps(
    result: Result, dataset: DatasetFolder, folder: Path, chosen: Sequence[tuple[str, SampleResult]]
) -> Iterator[SampleMaps]:
    """The maps of the ``chosen`` samples, each a place and a row; one sample's pixels at a time.
    Raises as `write_report` does."""
    if not result.dataset.content.items() <= dataset.content.items():
        raise DatasetError(
            f"{dataset.path}: is not what was scored; give {printable(result.dataset.identity)}"
        )
    submission = result.submission
    rules = Rules(result.target, submission.units, submission.range_rule, result.mode)
    listing = list_folder(folder, dataset, result.dataset.split)
    read = listing.reader(dataset.size, submission.png_mm_per_level, submission.nodata)
    # The first frame that the method used; frame 0 where it used none or that frame is not stored
    # here.
    used = [index for index in sorted(submission.frames_used) if index < len(dataset.sequence)]
    for place, row in chosen:
        try:
            values, digest = read(row.sample)
        except PredictionError as error:
            raise PredictionError(f"{listing.named(row.sample)}: {error}") from None
        if digest != row.prediction_sha256:
            named = listing.named(row.sample)
            raise PredictionError(
                f"{named}: is not the file that was scored; score the folder again"
            )
        prediction_mm, target = rules.pair(values, dataset, row.sample)
        try:
            fringe = dataset.frame(row.sample, used[0] if used else 0)
        except DatasetError:
            fringe = dataset.frame(row.sample, 0)
        # The reader fills the same memory with the next sample.
        yield SampleMaps(place, row, fringe, target, np.array(prediction_mm))


def _sample_rows(result: Result) -> tuple[list[str], list[list[str]]]:
    """Titles and cells of every sample, the largest object MAE first, with the hash of the
    prediction it comes from."""
    shown = with_column(WIDE)
    ordered = sorted(result.per_sample, key=lambda row: (-(row.object_mae_mm or 0.0), row.sample))
    rows = [
        [r.sample, *(score_text(m.key, getattr(r, m.key)) for m in shown), r.prediction_sha256[:12]]
        for r in ordered
    ]
    return ["Sample", *(metric.title for metric in shown), "Prediction SHA-256"], rows


@styled
def errors_figure(errors_mm: Sequence[float], block: Uncertainty | None) -> bytes:
    """PNG: the object MAE in mm of every sample, ascending, and of a stated uncertainty how much of
    the object lies within the interval that should hold a share of it, and the error of the rest
    when the least sure pixels are left out."""
    plots: list[tuple[str, str, Any, dict[str, list[float]]]] = [
        ("sample", "object MAE, mm", range(1, len(errors_mm) + 1), {"": sorted(errors_mm)})
    ]
    if block is not None and (reliability := block.reliability) is not None:
        lines = {"as stated": reliability.nominal, "observed": reliability.observed}
        plots.append(("nominal coverage", "observed coverage", reliability.nominal, lines))
    if block is not None and (curves := block.sparsification) is not None:
        lines = {"best order": curves.best_mae_mm, "by sigma": curves.mae_mm}
        plots.append(
            ("share of object pixels left out", "MAE of the rest, mm", curves.left_out, lines)
        )
    drawn = figure(4.4 * len(plots), 3.4)
    for axes, (across, up, places, lines) in zip(
        drawn.subplots(1, len(plots), squeeze=False)[0], plots, strict=True
    ):
        for number, (title, values) in enumerate(lines.items()):
            axes.plot(places, values, "--" if number == 0 and title else ".-", label=title)
        axes.set(xlabel=across, ylabel=up)
        if len(lines) > 1:
            axes.legend()
    return figure_png(drawn)


def sample_panels(
    fringe: NDArray[np.uint8], target_mm: NDArray[np.floating], prediction_mm: NDArray[np.floating]
) -> list[Panel]:
    """The five panels of a sample; all maps (H, W), depth in mm with 0 = background, which is not
    drawn (NaN). Object pixels without an answer are infinite."""
    inside, predicted = object_mask(np.asarray(target_mm)), np.asarray(prediction_mm) > 0
    error_mm = np.asarray(prediction_mm, np.float64) - target_mm
    object_depth = target_mm[inside] if inside.any() else np.zeros(1)
    low, high = float(object_depth.min()), float(object_depth.max())
    clip = float(np.percentile(np.abs(error_mm[inside if inside.any() else ...]), CLIP_PERCENTILE))
    drawn_mm = np.where(predicted, error_mm, np.where(inside, np.inf, np.nan))
    return [
        ("Fringe", fringe, FRAME_COLOURS, 0, 255),
        ("Truth, mm", np.where(inside, target_mm, np.nan), DEPTH_COLOURS, low, high),
        ("Prediction, mm", np.where(predicted, prediction_mm, np.nan), DEPTH_COLOURS, low, high),
        (f"Absolute error, to {millimetres(clip)} mm", np.abs(drawn_mm), SIGMA_COLOURS, 0.0, clip),
        (f"Signed error, to {millimetres(clip)} mm", drawn_mm, ERROR_COLOURS, -clip, clip),
    ]
