"""Titles of the scores in the order of a page, and HTML tables of scores."""

from collections.abc import Callable, Sequence

from fpp_ml_bench.evaluation.protocol import HEADLINE, METRICS
from fpp_ml_bench.evaluation.report.html import escaped
from fpp_ml_bench.evaluation.report.numbers import millimetres, percent
from fpp_ml_bench.evaluation.result import Result

_TITLES = {
    "object_mae_mm": "Object MAE",
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
}


def metric_title(key: str) -> str:
    """The title of ``key`` of `METRICS` on a page."""
    return _TITLES.get(key, key.removesuffix("_mm").replace("_", " ").capitalize())


def shown_metrics() -> list[str]:
    """Every key of `METRICS`: those with a title in the page's order, then all others."""
    return [*(key for key in _TITLES if key in METRICS), *(key for key in METRICS if key not in _TITLES)]


def format_of(key: str) -> Callable[[float | None], str]:
    """How values of ``key`` are written: mm, or per cent for a share."""
    return percent if key.endswith("_share") else _signed_millimetres if "bias" in key else millimetres


def _signed_millimetres(value: float | None) -> str:
    if value is None or value == 0:
        return millimetres(value)
    return ("-" if value < 0 else "+") + millimetres(abs(value))


def interval_text(interval: tuple[float, float] | None) -> str:
    """Both ends of an interval in mm, or a dash."""
    return "-" if interval is None else f"{millimetres(interval[0])} to {millimetres(interval[1])}"


def html_table(
    caption: str, titles: Sequence[str], rows: Sequence[Sequence[str]], text_columns: int = 1, small: str = ""
) -> str:
    """A table with column and row headers; every cell is text. The first ``text_columns`` are aligned left."""
    head = "".join(
        f'<th scope="col"{_left(column < text_columns)}>{escaped(title)}</th>' for column, title in enumerate(titles)
    )
    body = "".join(
        "<tr>"
        + f'<th scope="row">{escaped(row[0])}</th>'
        + "".join(f"<td{_left(column < text_columns)}>{escaped(cell)}</td>" for column, cell in enumerate(row[1:], 1))
        + "</tr>\n"
        for row in rows
    )
    note = f"<p class='soft small'>{escaped(small, 500)}</p>" if small else ""
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escaped(caption)}"><table class="dense">'
        f"<caption>{escaped(caption, 400)}</caption><thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table></div>"
        f"{note}"
    )


def _left(left: bool) -> str:
    return ' class="text"' if left else ""


def score_table(result: Result) -> str:
    """Every score of a result: mean over samples with its interval, median over samples, pooled over pixels."""
    rows = []
    for key in shown_metrics():
        value = format_of(key)
        pooled = getattr(result.pooled, key, None)
        rows.append([
            metric_title(key),
            value(getattr(result.metrics, key)),
            interval_text(result.intervals.of(key)) if key in HEADLINE else "",
            value(getattr(result.median, key)),
            value(pooled) if pooled is not None else "",
        ])  # fmt: skip
    return html_table(
        "Scores in mm. Mean, its 95% interval over objects, and median over samples; pooled over all pixels",
        ("Score", "Mean", "95% interval", "Median", "Pooled"),
        rows,
    )


def sample_table(result: Result) -> str:
    """Scores of every sample, the largest object MAE first, with the hash of the prediction it comes from."""
    keys = ("object_mae_mm", "object_rmse_mm", "overall_mae_mm", "background_mae_mm", "object_missing_share")
    ordered = sorted(result.per_sample, key=lambda row: (-(row.object_mae_mm or 0.0), row.sample))
    rows = [
        [row.sample, *(format_of(key)(getattr(row, key)) for key in keys), row.prediction_sha256[:12]]
        for row in ordered
    ]
    titles = ["Sample", *(metric_title(key) for key in keys), "Prediction SHA-256"]
    return html_table("Every sample, the largest object MAE first; mm", titles, rows)
