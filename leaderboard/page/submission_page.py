"""The page of a submission: scores with intervals, objects, cost, how it was made, and its error panels."""

from collections.abc import Iterator
from typing import Any

from fpp_ml_bench.evaluation.report import data_uri, millimetres, page, render, sample_table, score_table
from fpp_ml_bench.evaluation.result import PART_TITLES, Result
from fpp_ml_bench.leaderboard.groups import LEGACY_NOTE, Group, Ranked, assumption_sentences
from fpp_ml_bench.leaderboard.ranking import DEFAULT_SORT
from fpp_ml_bench.leaderboard.rows import MEANING, Entry, picture_of

_BARS_START, _BARS_WIDTH = 180, 300


def milliseconds(value: float | None) -> str:
    """A time in ms to three significant digits, a dash when unknown."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def submission_page(group: Group, row: Ranked, style: str) -> str:
    """The whole page of ``row``."""
    entry, result, picture = row.entry, row.entry.result, picture_of(row.entry)
    measured, source = result.reliance, "measured here" if entry.time_measured else "self-reported"
    parts = [(words, getattr(measured.parts, key)) for key, words in PART_TITLES.items()] if measured else []
    body = render(
        "fpp_ml_bench.leaderboard.page", "submission.html",
        row=row, title=group.key.title, figures=_figures(row, len(group.rows)), meaning=MEANING[entry.provenance],
        remarks=(assumption_sentences(result), LEGACY_NOTE if group.key.is_legacy else ""),
        picture=picture and data_uri(picture), scores=score_table(result), samples=sample_table(result),
        bars=list(_bars(result)), cost=_cost(entry, source),
        time="unknown" if entry.latency_ms is None else f"{milliseconds(entry.latency_ms)} ms per image ({source})",
        reading=_reading(result), parts=[(words, f"{value:.2f}") for words, value in parts if value is not None],
        making=_making(result),
    )  # fmt: skip
    return page(f"{entry.name}: FPP-ML-Bench", body, style=style)


def _figures(row: Ranked, rows: int) -> list[tuple[str, str, str]]:
    """The main figures: title, value, remark."""
    entry, interval = row.entry, row.entry.interval(DEFAULT_SORT)
    span = "no interval: fewer than two objects"
    if interval is not None:
        span = f"95% interval {' to '.join(map(millimetres, interval))}"
    timed = "unknown" if entry.latency_ms is None else "measured here" if entry.time_measured else "self-reported"
    return [
        ("Rank", row.ranks, f"of {rows} on the same data"),
        ("Object MAE", f"{millimetres(entry.value(DEFAULT_SORT))} mm", span),
        ("Object RMSE", f"{millimetres(entry.value('object_rmse_mm'))} mm", "of the object's pixels"),
        ("Overall MAE", f"{millimetres(entry.value('overall_mae_mm'))} mm", "of all pixels"),
        ("Time per image", f"{milliseconds(entry.latency_ms)} ms", timed),
        ("Frames needed", str(entry.frames), f"{entry.result.track} track"),
    ]


def _bars(result: Result) -> Iterator[dict[str, Any]]:
    """A bar for each object, the largest error first, with the standard deviation of its views around its end."""
    parts = [
        (part.metrics.object_mae_mm, part.spread.get(DEFAULT_SORT), part.object)
        for part in result.per_object
        if part.metrics.object_mae_mm is not None
    ]
    longest_mm = max((mean + (spread or 0.0) for mean, spread, _ in parts), default=0.0) or 1.0
    for mean, spread, name in sorted(parts, key=lambda part: (-part[0], part[2])):
        ends = () if spread is None else (max(0.0, mean - spread), max(0.0, mean + spread))
        yield {
            "name": name, "mean": mean, "spread": spread, "width": f"{_BARS_WIDTH * mean / longest_mm:.1f}",
            "ends": [f"{_BARS_START + _BARS_WIDTH * end / longest_mm:.1f}" for end in ends],
        }  # fmt: skip


def _cost(entry: Entry, source: str) -> list[tuple[str, str]]:
    """Run time and what it takes; empty where only a time is known."""
    timing = entry.result.timing
    if timing is None:
        return []
    machine, (height, width) = timing.hardware, timing.image_size
    gpu_memory = [("Peak GPU memory", _mib(timing.gpu_memory_mib))] if timing.gpu_memory_mib is not None else []
    return [
        ("Source of the time", source),
        ("Latency at batch 1, median", f"{milliseconds(timing.latency_median_ms)} ms"),
        ("5th to 95th percentile", f"{milliseconds(timing.latency_p5_ms)} to {milliseconds(timing.latency_p95_ms)} ms"),
        ("Runs, image", f"{timing.repeats}, {width} x {height} px"),
        (
            f"Throughput at batch {timing.batch}",
            f"{timing.throughput_per_s:.4g} images/s, {'together' if timing.batched else 'one after another'}",
        ),
        ("Frames per depth map", str(timing.frames)),
        ("Parameters", f"{timing.parameters:,}"),
        ("Memory that an image adds", _mib(timing.working_memory_mib)),
        ("Peak memory of the process", _mib(timing.peak_memory_mib)),
        *gpu_memory,
        ("Device", timing.device),
        ("CPU", f"{machine.cpu}, {machine.cores} cores, {machine.memory_gib} GiB"),
        ("GPU", machine.gpu or "none"),
        ("Platform", machine.platform),
    ]


def _mib(value: float | None) -> str:
    return "unknown" if value is None else f"{value:,.0f} MiB"


def _reading(result: Result) -> str:
    """Phase reliance, from the counterfactual scenes; nothing where it was not measured."""
    measured = result.reliance
    if measured is None:
        return ""
    low, high = measured.interval
    span = "" if low is None or high is None else f", 95% interval {low:.2f} to {high:.2f}"
    free = "" if measured.order_free_score is None else f"; whole periods ignored {measured.order_free_score:.2f}"
    return (
        f"Phase reliance {measured.score:.2f}{span}{free}: {measured.samples} samples of {measured.objects} objects, "
        f"answers in {measured.units}, data {measured.dataset_fingerprint[:8]}."
    )


def _making(result: Result) -> list[tuple[str, str]]:
    submission, data = result.submission, result.dataset
    return [
        ("Method", submission.method),
        ("Frames used", ", ".join(map(str, submission.frames_used)) or "none"),
        ("Track", result.track),
        ("Scored against", f"{result.target}, mode {result.mode}, edge band {result.edge_band_px} px"),
        ("Dataset", f"{data.name}, {data.split} split, {data.samples} samples"),
        ("Fingerprint", data.fingerprint),
        ("Protocol", result.protocol_version),
        ("Scored", result.created),
        *((f"Setting: {key}", str(value)) for key, value in submission.settings.items()),
        *((f"Software: {key}", value) for key, value in submission.software.items()),
    ]
