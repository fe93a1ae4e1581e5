"""The page of a submission: scores with intervals, objects, cost, how it was made, and its error panels."""

from fpp_ml_bench.evaluation.report import data_uri, escaped, html_table, millimetres, page, sample_table, score_table
from fpp_ml_bench.evaluation.result import PART_TITLES, Result
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.groups import LEGACY_NOTE, Group, Ranked, assumption_sentences
from fpp_ml_bench.leaderboard.page.scatter import ERROR
from fpp_ml_bench.leaderboard.page.table import badge, milliseconds
from fpp_ml_bench.leaderboard.rows import MEANING, Entry, picture_of

_BAR_HEIGHT, _BAR_WIDTH, _NAMES_WIDTH, _FIGURE_WIDTH = 26, 300, 180, 130
_LONGEST_LABEL = 26


def submission_page(group: Group, row: Ranked, style: str) -> str:
    """The whole page of ``row``."""
    entry, result = row.entry, row.entry.result
    rows = len(group.rows)
    parts = [
        f'<header><p class="small"><a href="../index.html">Leaderboard</a></p>'
        f"<h1>{escaped(entry.name)}</h1><p class='soft'>{escaped(group.key.title, 500)}</p>{_remarks(group, row)}"
        "</header>\n",
        f'<main id="main">\n{_figures(row, rows)}',
        _panels(entry),
        f"<section><h2>Scores</h2>{score_table(result)}</section>\n",
        f"<section><h2>Object by object</h2>{_objects(result)}</section>\n",
        f"<section><h2>What it costs</h2>{_cost(entry)}</section>\n",
        _reading(result),
        f"<section><h2>How it was made</h2>{_making(result)}</section>\n",
        f"<section><details><summary>Every sample</summary>{sample_table(result)}</details></section>\n</main>\n",
    ]
    return page(f"{entry.name}: FPP-ML-Bench", "".join(parts), style=style)


def _remarks(group: Group, row: Ranked) -> str:
    """What the score rests on: assumptions, what the method was told, legacy data."""
    remarks = [assumption_sentences(row.entry.result), LEGACY_NOTE if group.key.is_legacy else ""]
    return "".join(f"<p>{escaped(remark, 500)}</p>" for remark in remarks if remark)


def _figures(row: Ranked, rows: int) -> str:
    """The main figures, and who vouches for them."""
    entry = row.entry
    interval = entry.interval(ERROR)
    span = "no interval: fewer than two objects"
    if interval is not None:
        span = f"95% interval {millimetres(interval[0])} to {millimetres(interval[1])}"
    timed = "unknown" if entry.latency_ms is None else "measured here" if entry.time_measured else "self-reported"
    figures = (
        ("Rank", row.ranks, f"of {rows} on the same data"),
        ("Object MAE", f"{millimetres(entry.value(ERROR))} mm", span),
        ("Object RMSE", f"{millimetres(entry.value('object_rmse_mm'))} mm", "of the object's pixels"),
        ("Overall MAE", f"{millimetres(entry.value('overall_mae_mm'))} mm", "of all pixels"),
        ("Time per image", f"{milliseconds(entry.latency_ms)} ms", timed),
        ("Frames needed", str(entry.frames), f"{entry.result.track} track"),
    )
    cells = "".join(
        f"<div><dt>{escaped(title)}</dt><dd>{escaped(value)}</dd><dd class='soft small'>{escaped(note)}</dd></div>"
        for title, value, note in figures
    )
    return (
        f'<section><dl class="figures">{cells}</dl><p>{badge(entry.provenance)} '
        f"<span class='soft small'>{escaped(MEANING[entry.provenance], 300)}</span></p></section>\n"
    )


def _panels(entry: Entry) -> str:
    picture = picture_of(entry)
    if picture is None:
        return ""
    caption = "Samples from the best to the worst, one per line: fringe, truth, prediction, absolute and signed error"
    heads = "".join(
        f"<span>{title}</span>" for title in ("Fringe", "Truth", "Prediction", "Absolute error", "Signed error")
    )
    return (
        f'<section><h2>Errors</h2><figure><div class="sheet-heads soft small" aria-hidden="true">{heads}</div>'
        f'<img class="sheet" src="{data_uri(picture)}" alt="{caption}">'
        f"<figcaption>{caption}. Absolute error clipped at its 95th percentile over the object; signed error: blue is "
        "too near, red is too far.</figcaption></figure></section>\n"
    )


def _objects(result: Result) -> str:
    """A bar for each object, the standard deviation of its views as a whisker, and the figures beside it."""
    parts = [part for part in result.per_object if getattr(part.metrics, ERROR) is not None]
    if not parts:
        return "<p>No sample has an object.</p>"
    longest_mm = max(getattr(part.metrics, ERROR) + (part.spread.get(ERROR) or 0.0) for part in parts) or 1.0
    ordered = sorted(parts, key=lambda part: (-getattr(part.metrics, ERROR), part.object))
    drawn = []
    for line, part in enumerate(ordered):
        mean, spread = getattr(part.metrics, ERROR), part.spread.get(ERROR)
        y = line * _BAR_HEIGHT
        middle = y + _BAR_HEIGHT / 2
        name = printable(part.object.replace("_", " "), _LONGEST_LABEL)
        drawn.append(f'<text class="name" x="0" y="{middle + 4}" font-size="13">{escaped(name)}</text>')
        wide = _BAR_WIDTH * mean / longest_mm
        drawn.append(
            f'<rect class="bar" x="{_NAMES_WIDTH}" y="{y + 5}" width="{wide:.1f}" height="{_BAR_HEIGHT - 10}"/>'
        )
        text = f"{millimetres(mean)} mm"
        if spread is not None:
            ends = [_NAMES_WIDTH + _BAR_WIDTH * max(0.0, mean + sign * spread) / longest_mm for sign in (-1, 1)]
            drawn.append(f'<path class="whisker" d="M{ends[0]:.1f} {middle}H{ends[1]:.1f}"/>')
            text += f" ± {millimetres(spread)}"
        x = _NAMES_WIDTH + _BAR_WIDTH + 12
        drawn.append(f'<text x="{x}" y="{middle + 4}" font-size="13">{escaped(text)}</text>')
    width, height = _NAMES_WIDTH + _BAR_WIDTH + 12 + _FIGURE_WIDTH, len(ordered) * _BAR_HEIGHT
    values = "; ".join(f"{part.object}: {millimetres(getattr(part.metrics, ERROR))} mm" for part in ordered)
    return (
        f'<figure><svg class="objects" viewBox="0 0 {width} {height}" role="img" '
        f'aria-label="{escaped(f"Object MAE of each object. {values}", 5000)}">{"".join(drawn)}</svg>'
        "<figcaption>Object MAE, mean over an object's views; the line is ± one standard deviation of the views."
        "</figcaption></figure>"
    )


def _cost(entry: Entry) -> str:
    timing = entry.result.timing
    if timing is None:
        source = "measured here" if entry.time_measured else "self-reported"
        time = "unknown" if entry.latency_ms is None else f"{milliseconds(entry.latency_ms)} ms per image ({source})"
        return f"<p>{escaped(entry.frames)} frames per depth map; run time {escaped(time)}.</p>"
    machine = timing.hardware
    height, width = timing.image_size

    def mib(value: float | None) -> str:
        return "unknown" if value is None else f"{value:,.0f} MiB"

    rows = [
        ["Source of the time", "measured here" if entry.time_measured else "self-reported"],
        ["Latency at batch 1, median", f"{milliseconds(timing.latency_median_ms)} ms"],
        ["5th to 95th percentile", f"{milliseconds(timing.latency_p5_ms)} to {milliseconds(timing.latency_p95_ms)} ms"],
        ["Runs, image", f"{timing.repeats}, {width} x {height} px"],
        [
            f"Throughput at batch {timing.batch}",
            f"{timing.throughput_per_s:.4g} images/s, {'together' if timing.batched else 'one after another'}",
        ],
        ["Frames per depth map", str(timing.frames)],
        ["Parameters", f"{timing.parameters:,}"],
        ["Memory that an image adds", mib(timing.working_memory_mib)],
        ["Peak memory of the process", mib(timing.peak_memory_mib)],
        *([["Peak GPU memory", mib(timing.gpu_memory_mib)]] if timing.gpu_memory_mib is not None else []),
        ["Device", timing.device],
        ["CPU", f"{machine.cpu}, {machine.cores} cores, {machine.memory_gib} GiB"],
        ["GPU", machine.gpu or "none"],
        ["Platform", machine.platform],
    ]
    return html_table("Run time and what it takes", ("Quantity", "Value"), rows, text_columns=2)


def _reading(result: Result) -> str:
    """Phase reliance, from the counterfactual scenes; nothing where it was not measured."""
    measured = result.reliance
    if measured is None:
        return ""
    low, high = measured.interval
    span = "" if low is None or high is None else f", 95% interval {low:.2f} to {high:.2f}"
    free = "" if measured.order_free_score is None else f"; whole periods ignored {measured.order_free_score:.2f}"
    rows = [
        [words, f"{value:.2f}"]
        for key, words in PART_TITLES.items()
        if (value := getattr(measured.parts, key)) is not None
    ]
    table = html_table("Counterfactual scenes", ("Part", "Value"), rows, text_columns=1)
    return (
        f"<section><h2>What it reads</h2><p>Phase reliance {measured.score:.2f}{span}{free}: {measured.samples} "
        f"samples of {measured.objects} objects, answers in {escaped(measured.units)}, data "
        f"{escaped(measured.dataset_fingerprint[:8])}. 1 follows the fringe's phase and nothing else, 0 does not "
        f"follow it. Changes are given in units of the change that the moved phase demands.</p>{table}</section>\n"
    )


def _making(result: Result) -> str:
    submission, data = result.submission, result.dataset
    rows = [
        ["Method", submission.method],
        ["Frames used", ", ".join(map(str, submission.frames_used)) or "none"],
        ["Track", result.track],
        ["Scored against", f"{result.target}, mode {result.mode}, edge band {result.edge_band_px} px"],
        ["Dataset", f"{data.name}, {data.split} split, {data.samples} samples"],
        ["Fingerprint", data.fingerprint],
        ["Protocol", result.protocol_version],
        ["Scored", result.created],
        *([f"Setting: {key}", str(value)] for key, value in submission.settings.items()),
        *([f"Software: {key}", value] for key, value in submission.software.items()),
    ]
    return html_table("Submission and scoring", ("Quantity", "Value"), rows, text_columns=2)
