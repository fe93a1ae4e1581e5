"""What `fpp-eval` prints: the three pixel sets, edges and missing pixels, the samples of largest error."""

from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from fpp_ml_bench.evaluation.protocol import PIXEL_SETS, WIDE_BAND_PX, WITHIN_MM
from fpp_ml_bench.evaluation.report.numbers import interval_text, millimetres, percent, seconds, signed
from fpp_ml_bench.evaluation.result import Result, SampleResult
from fpp_ml_bench.evaluation.score import caution
from fpp_ml_bench.files import printable

WORST = 5


def result_table(result: Result) -> Group:
    """The result as rich tables; every text from the submission is shown as plain text, never as markup."""
    return Group(*(part for part in (_title(result), _scores(result), _notes(result), _worst(result)) if part))


def _title(result: Result) -> Text:
    info = result.dataset
    return Text(
        f"\n{printable(result.submission.name)}\n"
        f"{info.split} split of {printable(info.name)} ({printable(info.identity)}),\n{info.samples} samples of "
        f"{info.size[1]}x{info.size[0]} px, against {result.target}, {result.track} track"
        f"{'' if result.mode == 'standard' else f', mode {result.mode}'}\n"
    )


def _scores(result: Result) -> Table:
    objects = len(result.per_object)
    table = Table(
        caption="mm; mean and median over samples, pooled over all pixels; 95% intervals of the means from a bootstrap "
        f"over {objects} {'object' if objects == 1 else 'objects'}",
        caption_justify="left",
    )
    table.add_column("Pixel set")
    for error in ("MAE", "RMSE"):
        for title in ("mean", "95% interval", "median", "pooled"):
            table.add_column(f"{error}\n{title}", justify="right", no_wrap=True)
    for pixels in PIXEL_SETS:
        cells = []
        for error in ("mae", "rmse"):
            key = f"{pixels}_{error}_mm"
            mean, median, pooled = (
                millimetres(getattr(part, key)) for part in (result.metrics, result.median, result.pooled)
            )
            cells += [mean, interval_text(result.intervals.of(key)), median, pooled]
        table.add_row(pixels, *cells, style="bold" if pixels == "object" else None)
    for pixels, title in (
        ("interior", f"object, {result.edge_band_px} px or more from edges"),
        ("edge", "object, nearer"),
    ):
        cells = [
            cell
            for error in ("mae", "rmse")
            for cell in (
                millimetres(getattr(result.metrics, f"object_{pixels}_{error}_mm")),
                "",
                millimetres(getattr(result.median, f"object_{pixels}_{error}_mm")),
                "",
            )
        ]
        table.add_row(title, *cells)
    return table


def _notes(result: Result) -> Text:
    scores = result.metrics
    shares = ((limit, getattr(scores, f"object_within_{limit}mm_share")) for limit in WITHIN_MM)
    within = ", ".join(f"{limit} mm {percent(share)}" for limit, share in shares)
    lines = [
        f"Object: |error| median {millimetres(scores.object_median_mm)}, 95th percentile "
        f"{millimetres(scores.object_p95_mm)}, maximum {millimetres(scores.object_max_mm)} mm; pixels within {within}.",
        f"Bias {signed(scores.object_bias_mm)} mm ({signed(scores.object_valid_bias_mm)} mm where measured); MAE "
        f"{millimetres(scores.object_shift_free_mae_mm)} mm once each sample's best single offset is removed.",
        f"MAE {millimetres(scores.object_wide_band_mae_mm)} mm within {WIDE_BAND_PX} px of depth edges, "
        f"{millimetres(scores.object_wide_interior_mae_mm)} mm inside.",
        f"Object pixels near a depth edge: {percent(scores.object_edge_share)}.",
        f"Object pixels not measured: {percent(scores.object_missing_share)} "
        f"({percent(scores.object_interior_missing_share)} of those away from edges), scored with their whole depth. "
        f"MAE where measured: {millimetres(scores.object_valid_mae_mm)} mm, away from edges "
        f"{millimetres(scores.object_interior_valid_mae_mm)} mm.",
    ]
    if result.samples_without_object:
        lines.append(f"{result.samples_without_object} samples without an object: left out of the object scores.")
    if result.samples_without_background:
        lines.append(f"{result.samples_without_background} samples without background: left out of its scores.")
    if result.submission.uses_ground_truth_range:
        lines.append("Oracle range: the method was given depth_min and depth_max of the scored samples.")
    if result.submission.uses_ground_truth_mask:
        lines.append("Oracle mask: the method was given which pixels of the scored samples are object.")
    few_objects = caution(len(result.per_object))
    if few_objects:
        lines.append(few_objects)
    sample_seconds = result.submission.seconds_per_sample
    frames = len(result.submission.frames_used)
    time = (
        "unknown time"
        if sample_seconds is None
        else f"{seconds(sample_seconds)} s ({result.submission.seconds_source})"
    )
    lines.append(f"Frames used: {frames}; {time} per sample.")
    return Text("\n".join(lines) + "\n")


def _worst(result: Result) -> Table | None:
    rows = [row for row in result.per_sample if row.object_mae_mm is not None]
    if not rows:
        return None
    table = Table(title=f"Largest object MAE, {min(WORST, len(rows))} of {len(rows)} samples", title_justify="left")
    table.add_column("Sample")
    for title in ("Object MAE", "Object RMSE", "Background MAE", "Near edges", "Not measured"):
        table.add_column(title.replace(" ", "\n"), justify="right", no_wrap=True)
    for row in sorted(rows, key=_largest_error_first)[:WORST]:
        cells: list[Any] = [millimetres(row.object_mae_mm), millimetres(row.object_rmse_mm)]
        cells += [millimetres(row.background_mae_mm), percent(row.object_edge_share), percent(row.object_missing_share)]
        table.add_row(Text(printable(row.sample)), *cells)
    return table


def _largest_error_first(row: SampleResult) -> tuple[float, str]:
    return -(row.object_mae_mm or 0.0), row.sample
