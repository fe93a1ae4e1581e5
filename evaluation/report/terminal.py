"""What `fpp-eval` prints: a result's pixel sets and samples of largest error, and the comparison of
two results. Every text from a submission is shown as plain text, never as markup."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from string import Formatter

from rich.console import Group
from rich.text import Text

from fpp_ml_bench.evaluation.metrics import METRICS, NOTES, UNCERTAINTY, Metric
from fpp_ml_bench.evaluation.protocol import PIXEL_SETS
from fpp_ml_bench.evaluation.report.comparison import Comparison
from fpp_ml_bench.evaluation.result.model import Result
from fpp_ml_bench.evaluation.score.uncertainty import SIGNIFICANT, caution
from fpp_ml_bench.files import printable
from fpp_ml_bench.style import interval_text, millimetres, percent, signed, three_digits
from fpp_ml_bench.tables import Table

WORST = 5
_table = partial(Table, elsewhere="--json FILE")
_WRITERS: dict[str, Callable[[float | None], str]] = {
    "mm": millimetres,
    "signed mm": signed,
    "share": percent,
    "ratio": percent,
    "nats": partial(signed, plus=""),
}


def score_text(key: str, value: float | None) -> str:
    """A value of the metric ``key`` as its unit is written: mm, or per cent for a share."""
    return _WRITERS[(METRICS.get(key) or UNCERTAINTY[key]).unit](value)


def result_table(result: Result) -> Group:
    """The result as rich tables."""
    info = result.dataset
    title = Text(
        f"\n{printable(result.submission.name)}\n"
        f"{info.split} split of {printable(info.name)} "
        f"({printable(info.identity)}),\n{info.samples} samples of "
        f"{info.size[1]}x{info.size[0]} px, against {result.target}, {result.track} track"
        f"{'' if result.mode == 'standard' else f', mode {result.mode}'}\n"
    )
    parts = (title, _scores(result), _notes(result), _uncertainty(result), _worst(result))
    return Group(*(part for part in parts if part))


def _scores(result: Result) -> Table:
    objects, errors = len(result.per_object), ("mae", "rmse")
    values = ("mean", "95% interval", "median", "pooled")
    table = _table(
        "Pixel set",
        numbers=[f"{error.upper()}\n{value}" for error in errors for value in values],
        first_out=[
            f"{error.upper()}\n{value}" for value in reversed(values) for error in reversed(errors)
        ],
        caption="mm; mean and median over samples, pooled over all pixels; 95% intervals of the means from a bootstrap "
        f"over {objects} {'object' if objects == 1 else 'objects'}",
    )
    titles = {
        **{pixels: pixels for pixels in PIXEL_SETS},
        "object_interior": f"object, {result.edge_band_px} px or more from edges",
        "object_edge": "object, nearer",
    }
    for pixels, title in titles.items():
        cells = []
        for key in (f"{pixels}_{error}_mm" for error in errors):
            mean, median = (
                millimetres(getattr(part, key)) for part in (result.metrics, result.median)
            )
            interval = interval_text(result.intervals.of(key), "..") if pixels in PIXEL_SETS else ""
            pooled = millimetres(getattr(result.pooled, key)) if pixels in PIXEL_SETS else ""
            cells += [mean, interval, median, pooled]
        table.add_row(title, *cells, style="bold" if pixels == "object" else None)
    return table


def _notes(result: Result) -> Text:
    scores, submission = result.metrics, result.submission
    texts = {key: score_text(key, getattr(scores, key)) for key in METRICS}
    lines = []
    for note in NOTES:
        first = next(name for _, name, _, _ in Formatter().parse(note) if name)
        if not (METRICS[first].optional and getattr(scores, first) is None):
            lines.append(note.format_map(texts))
    if result.samples_without_object:
        lines.append(
            f"{result.samples_without_object} samples without an object: left out of the object "
            f"scores."
        )
    if result.samples_without_background:
        lines.append(
            f"{result.samples_without_background} samples without background: left out of its "
            f"scores."
        )
    if submission.uses_ground_truth_range:
        lines.append(
            "Oracle range: the method was given depth_min and depth_max of the scored samples."
        )
    if submission.uses_ground_truth_mask:
        lines.append(
            "Oracle mask: the method was given which pixels of the scored samples are object."
        )
    if submission.uses_ground_truth_order:
        lines.append(
            "Oracle order: the method was given the true fringe orders of the scored samples."
        )
    if few_objects := caution(len(result.per_object)):
        lines.append(few_objects)
    known = submission.seconds_per_sample is not None
    time = (
        f"{three_digits(submission.seconds_per_sample)} s ({submission.seconds_source})"
        if known
        else "unknown time"
    )
    lines.append(f"Frames used: {len(submission.frames_used)}; {time} per sample.")
    return Text("\n".join(lines) + "\n")


def _uncertainty(result: Result) -> Table | None:
    if (block := result.uncertainty) is None:
        return None
    shown = [metric for metric in UNCERTAINTY.values() if metric.terminal]
    table = _table(
        "Stated uncertainty",
        numbers=[metric.terminal for metric in shown],
        first_out=[
            "Sigma\nmedian",
            "NLL",
            "In 99%\ninterval",
            "RMSE of the\nsurest 95%",
            "MAE of the\nsurest 95%",
        ],
        caption="mm; of the pixels that state a sigma, those within its Gaussian intervals, means over samples; AUSE: "
        "area between the sparsification curves by sigma and by error; missed and invented pixels "
        "are charged",
    )
    for name, scores in {"all": block.metrics, **block.per_object}.items():
        table.add_row(
            Text(printable(name)), *_cells(scores, shown), style="bold" if name == "all" else None
        )
    return table


def _cells(scores: object, shown: Iterable[Metric]) -> list[str]:
    return [score_text(metric.key, getattr(scores, metric.key)) for metric in shown]


def _worst(result: Result) -> Table | None:
    rows = [row for row in result.per_sample if row.object_mae_mm is not None]
    if not rows:
        return None
    shown = [metric for metric in METRICS.values() if metric.terminal]
    table = _table(
        "Sample",
        numbers=[metric.terminal for metric in shown],
        title=f"Largest object MAE, {min(WORST, len(rows))} of {len(rows)} samples",
    )
    for row in sorted(rows, key=lambda row: (-(row.object_mae_mm or 0.0), row.sample))[:WORST]:
        table.add_row(Text(printable(row.sample)), *_cells(row, shown))
    return table


def comparison_table(compared: Comparison) -> Group:
    """The comparison as rich tables."""
    titles = [
        "Second - first",
        "95% interval",
        "p",
        "Second lower in",
        "Second higher in",
        "Samples",
        "Objects",
    ]
    about = (
        "mm; mean of second - first over samples, 95% interval and p value of a sign-flip test "
        "over objects"
    )
    table = _table("Error", numbers=titles, caption=about)
    for key, row in compared.differences.items():
        pixels, error = key.removesuffix("_mm").rsplit("_", 1)
        counts = (row.lower, row.higher, row.samples, row.objects)
        p = "-" if row.sign_flip_p is None else f"{row.sign_flip_p:.3g}"
        table.add_row(
            f"{pixels.replace('_', '-')} {error.upper()}",
            signed(row.mean_mm),
            interval_text(row.interval, ".."),
            p,
            *map(str, counts),
            style="bold"
            if row.distinguishable and (row.sign_flip_p or 1.0) <= SIGNIFICANT
            else None,
        )
    title = Text(
        f"\nfirst:  {printable(compared.first)}\nsecond: {printable(compared.second)}\n"
        f"{compared.split} split (content {compared.truth[:8]}), against {compared.target}, "
        f"{compared.track} track\n"
    )
    return Group(title, table, Text(f"{compared.sentence}\n"))
