"""The report of a result: a histogram of the errors, the scores, and samples from best to worst on an HTML page."""

import statistics
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

from markupsafe import Markup

from fpp_ml_bench.errors import DatasetError, PredictionError
from fpp_ml_bench.evaluation.protocol import COVERED, HEADLINE, SINCE_2
from fpp_ml_bench.evaluation.report.curves import uncertainty_plots
from fpp_ml_bench.evaluation.report.figures import Panel, histogram, sample_panels
from fpp_ml_bench.evaluation.report.html import interval_text, millimetres, page, percent, render, signed
from fpp_ml_bench.evaluation.result import Result, SampleResult, Uncertainty, write_file
from fpp_ml_bench.evaluation.score import scored_pair
from fpp_ml_bench.evaluation.submission import list_folder, reader_for
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.storage import DatasetFolder

REPORT_FILE = "index.html"
_PLACES = (("Best", 0.0), ("Worst", 1.0), ("Median", 0.5), ("Lower quartile", 0.25), ("Upper quartile", 0.75))
"""The samples that are shown and their place by error, in the order in which they are chosen where there are few."""
_TITLES = {
    "object_mae_mm": "Object MAE",
    "object_mae_range_share": "Object MAE, share of its depth range",
    "object_rmse_mm": "Object RMSE",
    "overall_mae_mm": "Overall MAE",
    "overall_rmse_mm": "Overall RMSE",
    "background_mae_mm": "Background MAE",
    "background_rmse_mm": "Background RMSE",
    "object_median_mm": "Object, median error",
    "object_p95_mm": "Object, 95th percentile",
    "object_max_mm": "Object, largest error",
    "object_within_1mm_share": "Object within 1 mm",
    "object_within_2mm_share": "Object within 2 mm",
    "object_within_5mm_share": "Object within 5 mm",
    "object_within_10mm_share": "Object within 10 mm",
    "object_bias_mm": "Object, signed bias",
    "object_valid_bias_mm": "Object where predicted, signed bias",
    "object_shift_free_mae_mm": "Object MAE without one offset",
    "object_interior_mae_mm": "Object away from edges, MAE",
    "object_interior_rmse_mm": "Object away from edges, RMSE",
    "object_edge_mae_mm": "Object along edges, MAE",
    "object_edge_rmse_mm": "Object along edges, RMSE",
    "object_valid_mae_mm": "Object where predicted, MAE",
    "object_interior_valid_mae_mm": "Object where predicted, away from edges, MAE",
    "object_missing_share": "Object not predicted",
    "object_interior_missing_share": "Object away from edges, not predicted",
    "object_edge_share": "Object along edges, share of pixels",
    "object_wide_band_mae_mm": "Object within 8 px of edges, MAE",
    "object_wide_interior_mae_mm": "Object 8 px or more from edges, MAE",
    "object_wide_band_share": "Object within 8 px of edges, share of pixels",
    "void_share": "Void, share of the image",
    "unlit_mae_mm": "Unlit, MAE",
    "unlit_rmse_mm": "Unlit, RMSE",
    "unlit_valid_mae_mm": "Unlit where predicted, MAE",
    "unlit_missing_share": "Unlit, not predicted",
}
"""Every key of `METRICS` in the order of the page."""


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
        samples=_panels(result, dataset, Path(predictions_folder)),
        bars=histogram(errors, statistics.fmean(errors), "object MAE of a sample") if errors else None,
        score_table=Markup(score_table(result)),
        plots=uncertainty_plots(result.uncertainty),
        uncertainty_table=Markup(uncertainty_table(result.uncertainty)) if result.uncertainty else "",
        sample_table=Markup(sample_table(result)),
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


def _panels(result: Result, dataset: DatasetFolder, folder: Path) -> Iterator[tuple[str, SampleResult, list[Panel]]]:
    """The place, the row and the panels of each chosen sample, the best first; one sample's pixels at a time."""
    if not result.dataset.content.items() <= dataset.content.items():
        raise DatasetError(f"{dataset.path}: is not what was scored; give {printable(result.dataset.identity)}")
    submission, samples = result.submission, [row.sample for row in result.per_sample]
    form = list_folder(folder, samples, result.dataset.split, {}).form
    reader = reader_for(form, folder, samples, dataset.size, submission.png_mm_per_level)
    # The first frame that the method used; frame 0 where it used none or that frame is not stored here.
    used = [index for index in sorted(submission.frames_used) if index < len(dataset.sequence)]
    for place, row in chosen_samples(result.per_sample):
        try:
            values, digest = reader.read(row.sample)
        except PredictionError as error:
            raise PredictionError(f"{reader.named(row.sample)}: {error}") from None
        if digest != row.prediction_sha256:
            named = reader.named(row.sample)
            raise PredictionError(f"{named}: is not the file that was scored; score the folder again")
        target_mm = dataset.target_mm(row.sample, result.target)
        left_out = dataset.left_out(row.sample, submission.range_rule, result.target)
        prediction_mm, target = scored_pair(values, target_mm, submission.units, result.mode, row.sample, left_out)
        try:
            fringe = dataset.frame(row.sample, used[0] if used else 0)
        except DatasetError:
            fringe = dataset.frame(row.sample, 0)
        yield place, row, sample_panels(fringe, target, prediction_mm, row.sample)


def score_text(key: str, value: float | None) -> str:
    """A value of ``key`` as it is written: mm, or per cent for a share."""
    return percent(value) if key.endswith("_share") else signed(value) if "bias" in key else millimetres(value)


def html_table(caption: str, titles: Sequence[str], rows: Sequence[Sequence[str]], text_columns: int = 1) -> str:
    """A table with column and row headers; every cell is text. The first ``text_columns`` are aligned left."""
    return render(__package__, "dense_table.html", caption=caption, titles=titles, rows=rows, text_columns=text_columns)


def score_table(result: Result) -> str:
    """Every score of a result: mean over samples with its interval, median over samples, pooled over pixels."""
    rows = []
    for key, title in _TITLES.items():
        if key in SINCE_2 and getattr(result.metrics, key) is None:
            continue
        mean, median = (score_text(key, getattr(scores, key)) for scores in (result.metrics, result.median))
        interval = interval_text(result.intervals.of(key)) if key in HEADLINE else ""
        pooled = getattr(result.pooled, key, None)
        rows.append([title, mean, interval, median, "" if pooled is None else score_text(key, pooled)])
    caption = "Scores in mm. Mean, its 95% interval over objects, and median over samples; pooled over all pixels"
    return html_table(caption, ("Score", "Mean", "95% interval", "Median", "Pooled"), rows)


_UNCERTAINTY_TITLES = {
    "unstated_share": "Object without a sigma",
    **{f"coverage_{level}": f"Pixels with a sigma in their {level}% interval" for level in COVERED},
    "sigma_mean_mm": "Mean sigma",
    "sigma_median_mm": "Median sigma",
    "nll": "Negative log-likelihood, nats",
    "ause_mae_mm": "AUSE, MAE",
    "ause_rmse_mm": "AUSE, RMSE",
    "sure_mae_mm": "MAE of the surest 95%",
    "sure_rmse_mm": "RMSE of the surest 95%",
}
"""Every key of `UNCERTAINTY` in the order of the page."""


def uncertainty_table(block: Uncertainty) -> str:
    """Every score of a stated uncertainty: mean over samples, and over the views of each object."""
    columns = [block.metrics, *block.per_object.values()]
    rows = []
    for key, title in _UNCERTAINTY_TITLES.items():
        write = (
            percent
            if "coverage" in key or "share" in key
            else partial(signed, plus="")
            if key == "nll"
            else millimetres
        )
        rows.append([title, *(write(getattr(scores, key)) for scores in columns)])
    return html_table("Stated uncertainty; mm", ("Score", "All", *block.per_object), rows)


def sample_table(result: Result) -> str:
    """Scores of every sample, the largest object MAE first, with the hash of the prediction it comes from."""
    keys = ("object_mae_mm", "object_rmse_mm", "overall_mae_mm", "background_mae_mm", "object_missing_share")
    ordered = sorted(result.per_sample, key=lambda row: (-(row.object_mae_mm or 0.0), row.sample))
    rows = [[r.sample, *(score_text(key, getattr(r, key)) for key in keys), r.prediction_sha256[:12]] for r in ordered]
    titles = ["Sample", *(_TITLES[key] for key in keys), "Prediction SHA-256"]
    return html_table("Every sample, the largest object MAE first; mm", titles, rows)
