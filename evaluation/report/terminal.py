"""What `fpp-eval` prints: a result's pixel sets and samples of largest error, and the comparison of two results. Every
text from a submission is shown as plain text, never as markup."""

from __future__ import annotations

from functools import partial

from rich.console import Group
from rich.text import Text

from fpp_ml_bench.evaluation import report
from fpp_ml_bench.evaluation.protocol import COVERED, PIXEL_SETS, WIDE_BAND_PX, WITHIN_MM
from fpp_ml_bench.evaluation.report.html import interval_text, millimetres, percent, seconds, signed
from fpp_ml_bench.evaluation.result import Result
from fpp_ml_bench.evaluation.score import SIGNIFICANT, caution
from fpp_ml_bench.files import printable
from fpp_ml_bench.tables import Table

WORST = 5
_table = partial(Table, elsewhere="--json FILE")


def result_table(result: Result) -> Group:
    """The result as rich tables."""
    info = result.dataset
    title = Text(
        f"\n{printable(result.submission.name)}\n"
        f"{info.split} split of {printable(info.name)} ({printable(info.identity)}),\n{info.samples} samples of "
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
        first_out=[f"{error.upper()}\n{value}" for value in reversed(values) for error in reversed(errors)],
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
            mean, median = (millimetres(getattr(part, key)) for part in (result.metrics, result.median))
            interval = interval_text(result.intervals.of(key), "..") if pixels in PIXEL_SETS else ""
            pooled = millimetres(getattr(result.pooled, key)) if pixels in PIXEL_SETS else ""
            cells += [mean, interval, median, pooled]
        table.add_row(title, *cells, style="bold" if pixels == "object" else None)
    return table


def _notes(result: Result) -> Text:
    scores, submission = result.metrics, result.submission
    shares = ((limit, getattr(scores, f"object_within_{limit}mm_share")) for limit in WITHIN_MM)
    within = ", ".join(f"{limit} mm {percent(share)}" for limit, share in shares)
    lines = [
        f"Object: |error| median {millimetres(scores.object_median_mm)}, 95th percentile "
        f"{millimetres(scores.object_p95_mm)}, maximum {millimetres(scores.object_max_mm)} mm; pixels within {within}. "
        f"MAE {percent(scores.object_mae_range_share)} of each sample's depth range.",
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
    if scores.void_share is not None:
        lines.append(f"Void pixels, in no set: {percent(scores.void_share)} of the image (unlit, or of mixed depths).")
    if scores.unlit_mae_mm is not None:
        lines.append(
            f"Unlit pixels: MAE {millimetres(scores.unlit_mae_mm)}, RMSE {millimetres(scores.unlit_rmse_mm)} mm; "
            f"{percent(scores.unlit_missing_share)} not measured, MAE of the others "
            f"{millimetres(scores.unlit_valid_mae_mm)} mm."
        )
    if result.samples_without_object:
        lines.append(f"{result.samples_without_object} samples without an object: left out of the object scores.")
    if result.samples_without_background:
        lines.append(f"{result.samples_without_background} samples without background: left out of its scores.")
    if submission.uses_ground_truth_range:
        lines.append("Oracle range: the method was given depth_min and depth_max of the scored samples.")
    if submission.uses_ground_truth_mask:
        lines.append("Oracle mask: the method was given which pixels of the scored samples are object.")
    if submission.uses_ground_truth_order:
        lines.append("Oracle order: the method was given the true fringe orders of the scored samples.")
    if few_objects := caution(len(result.per_object)):
        lines.append(few_objects)
    known = submission.seconds_per_sample is not None
    time = f"{seconds(submission.seconds_per_sample)} s ({submission.seconds_source})" if known else "unknown time"
    lines.append(f"Frames used: {len(submission.frames_used)}; {time} per sample.")
    return Text("\n".join(lines) + "\n")


def _uncertainty(result: Result) -> Table | None:
    if (block := result.uncertainty) is None:
        return None
    titles = ["Not\nstated", *(f"In {level}%\ninterval" for level in COVERED), "Sigma\nmean", "Sigma\nmedian", "NLL"]
    table = _table(
        "Stated uncertainty",
        numbers=[*titles, "AUSE\nMAE", "MAE of the\nsurest 95%"],
        first_out=["Sigma\nmedian", "NLL", "In 99%\ninterval", "MAE of the\nsurest 95%"],
        caption="mm; of the pixels that state a sigma, those within its Gaussian intervals, means over samples; AUSE: "
        "area between the sparsification curves by sigma and by error, over all object pixels",
    )
    for name, scores in {"all": block.metrics, **block.per_object}.items():
        cells = [percent(scores.unstated_share), *(percent(getattr(scores, f"coverage_{lv}")) for lv in COVERED)]
        cells += map(millimetres, (scores.sigma_mean_mm, scores.sigma_median_mm))
        cells += [signed(scores.nll, plus=""), millimetres(scores.ause_mae_mm), millimetres(scores.sure_mae_mm)]
        style = "bold" if name == "all" else None
        table.add_row(Text(printable(name)), *cells, style=style)
    return table


def _worst(result: Result) -> Table | None:
    rows = [row for row in result.per_sample if row.object_mae_mm is not None]
    if not rows:
        return None
    titles = ["Object\nMAE", "Object\nRMSE", "Background\nMAE", "Near\nedges", "Not\nmeasured"]
    table = _table(
        "Sample", numbers=titles, title=f"Largest object MAE, {min(WORST, len(rows))} of {len(rows)} samples"
    )
    for row in sorted(rows, key=lambda row: (-(row.object_mae_mm or 0.0), row.sample))[:WORST]:
        errors = (row.object_mae_mm, row.object_rmse_mm, row.background_mae_mm)
        shares = (row.object_edge_share, row.object_missing_share)
        table.add_row(Text(printable(row.sample)), *map(millimetres, errors), *map(percent, shares))
    return table


def comparison_table(compared: report.Comparison) -> Group:
    """The comparison as rich tables."""
    titles = ["Second - first", "95% interval", "p", "Second lower in", "Second higher in", "Samples", "Objects"]
    about = "mm; mean of second - first over samples, 95% interval and p value of a sign-flip test over objects"
    table = _table("Error", numbers=titles, caption=about)
    for key, row in compared.differences.items():
        pixels, error = key.removesuffix("_mm").split("_")
        counts = (row.lower, row.higher, row.samples, row.objects)
        p = "-" if row.sign_flip_p is None else f"{row.sign_flip_p:.3g}"
        table.add_row(
            f"{pixels} {error.upper()}",
            signed(row.mean_mm),
            interval_text(row.interval, ".."),
            p,
            *map(str, counts),
            style="bold" if row.told_apart and (row.sign_flip_p or 1.0) <= SIGNIFICANT else None,
        )
    title = Text(
        f"\nfirst:  {printable(compared.first)}\nsecond: {printable(compared.second)}\n"
        f"{compared.split} split (content {compared.truth[:8]}), against {compared.target}, "
        f"{compared.track} track\n"
    )
    return Group(title, table, Text(f"{compared.sentence}\n"))
