"""The leaderboard as a static page: ``index.html``, ``data.json``, and a page for each submission.

The page works from disk and from any web server and loads no other file. The same rows give the same bytes.
"""

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

from fpp_ml_bench.baselines.tradeoff import COST_KEYS, Ladder, Mark, Rung, Scatter, Tradeoff, pareto_front, scatter
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.report import data_uri, millimetres, page, render, sample_table, score_table
from fpp_ml_bench.evaluation.result import PART_TITLES, result_json
from fpp_ml_bench.files import printable, write_atomically
from fpp_ml_bench.leaderboard import columns, tables
from fpp_ml_bench.leaderboard.assumptions import assumption, assumption_sentences, told
from fpp_ml_bench.leaderboard.data_files import table_json
from fpp_ml_bench.leaderboard.groups import Group, Ranked
from fpp_ml_bench.leaderboard.ranking import DEFAULT_SORT, rank, shipped_rows
from fpp_ml_bench.leaderboard.rows import BY_THE_PAPER, MEANING, Entry, PaperTable, picture_of, read_entry
from fpp_ml_bench.loaders.storage import benchmark_of

INDEX, DATA, SUBMISSIONS = "index.html", "data.json", "submissions"
_HERE, _PACKAGE = Path(__file__).resolve().parent, "fpp_ml_bench.leaderboard.page"
_OWN_PAGES = re.compile(r"[a-z0-9-]+-[0-9a-f]{12}\.html")
_PICTURES = (("wide", 860, 430), ("narrow", 360, 380))
"""Class, width and height of a ranking's picture, for a window and for a phone."""
_TRADEOFF_PICTURE = 430, 380
_MOST_NAMES = 12
"""Marks up to which a picture names them; more get numbers and a key."""
_SHADES = 6
_MARK_COLOURS = {"measured here": "measured", "verified": "verified", "self-reported": "reported"}
_BOARD_ROWS, _QUICK_BOARD_ROWS = (8, 16, 32, 64, 128), (4, 8, 16)
_BOARD_ROW = "classical-18-vertical.json"


def write_page(
    groups: Sequence[Group], papers: Sequence[PaperTable], out: Path, tradeoff: Tradeoff | None = None
) -> list[Path]:
    """Write the page of ``groups`` (ranked by `DEFAULT_SORT`), the paper's tables and a trade-off into folder ``out``;
    returns the files. Removes pages of submissions that are no longer ranked, and nothing else. SubmissionError where a
    file can't be written."""
    files = page_files(groups, papers, tradeoff)
    try:
        (out / SUBMISSIONS).mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            write_atomically(out / name, content)
        for path in (out / SUBMISSIONS).iterdir():
            if _OWN_PAGES.fullmatch(path.name) and f"{SUBMISSIONS}/{path.name}" not in files:
                path.unlink()
    except OSError as error:
        raise SubmissionError(f"{printable(str(out), 500)} can't be written: {error.strerror}") from None
    return [out / name for name in files]


def page_files(groups: Sequence[Group], papers: Sequence[PaperTable], run: Tradeoff | None = None) -> dict[str, bytes]:
    """Relative name -> content of every file of the page."""
    style, script = (_HERE / "page.css").read_text("utf-8"), (_HERE / "page.js").read_text("utf-8")
    slugs = {id(row.entry): slug(row.entry) for group in groups for row in group.rows}
    present = {row.entry.provenance for group in groups for row in group.rows}
    shared = {"meaning": MEANING, "milliseconds": milliseconds}
    body = render(
        _PACKAGE, "index.html", **shared, tables=tables, columns=columns, told=told, assumption=assumption,
        search=_search, slug=lambda entry: slugs[id(entry)], rankings=_rankings(groups), by_the_paper=BY_THE_PAPER,
        sections=[_section(group, slugs) for group in groups], tradeoff=_tradeoff(run),
        provenances=[name for name in MEANING if name in present],
        papers=[(f"{p.title}, mm", list(map(tables.paper_cells, p.rows)), tables.paper_note(p)) for p in papers],
    )  # fmt: skip
    about = "Ranking of single-shot fringe projection profilometry: depth error with intervals, run time and captures."
    index = page("FPP-ML-Bench leaderboard", body, style, script, about)
    files = {INDEX: index, DATA: table_json(groups, papers, DEFAULT_SORT)}
    for group in groups:
        for row in group.rows:
            body = render(_PACKAGE, "submission.html", **shared, **_submission(group, row))
            name = f"{SUBMISSIONS}/{slugs[id(row.entry)]}.html"
            files[name] = page(f"{row.entry.name}: FPP-ML-Bench", body, style)
    return {name: text.encode("utf-8") for name, text in files.items()}


def _submission(group: Group, row: Ranked) -> dict[str, Any]:
    """What the template needs for the page of ``row``."""
    result, picture = row.entry.result, picture_of(row.entry)
    bars = [
        (part.metrics.object_mae_mm, part.spread.get(DEFAULT_SORT), part.object)
        for part in result.per_object
        if part.metrics.object_mae_mm is not None
    ]
    changes = result.reliance.parts if result.reliance else None
    parts = [(words, getattr(changes, key)) for key, words in PART_TITLES.items()] if changes else []
    return {
        "row": row, "group": group, "rows": len(group.rows), "assumption_sentences": assumption_sentences,
        "picture": picture and data_uri(picture), "scores": score_table(result), "samples": sample_table(result),
        "bars": sorted(bars, key=lambda bar: (-bar[0], bar[2])),
        "longest_mm": max((mean + (spread or 0.0) for mean, spread, _ in bars), default=0.0),
        "parts": [(words, f"{value:.2f}") for words, value in parts if value is not None],
    }  # fmt: skip


def milliseconds(value: float | None) -> str:
    """A time in ms to three significant digits, a dash when unknown."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def slug(entry: Entry) -> str:
    """Name of an entry's page: letters and digits of its own name, and the start of its content's SHA-256."""
    plain = re.sub(r"[^a-z0-9]+", "-", entry.name[:60].casefold()).strip("-") or "submission"
    return f"{plain}-{hashlib.sha256(result_json(entry.result)).hexdigest()[:12]}"


def _search(row: Ranked) -> str:
    """What the search field finds a row by."""
    words = row.entry.name, row.short_name, row.entry.result.submission.method, columns.device(row.entry)
    return " ".join(words).casefold()


def _rankings(groups: Sequence[Group]) -> list[tuple[str, list[tuple[int, str, int]]]]:
    """For each dataset its rankings: number, title, rows."""
    rankings = []
    for data, members in groupby(enumerate(groups), key=lambda numbered: numbered[1].key.data_title):
        links, of_data = [], list(members)
        several_targets = len({group.key.against for _, group in of_data}) > 1
        for number, group in of_data:
            target = f", {group.key.against}" if several_targets else ""
            split = f", {group.key.split} split" if group.key.split != "test" else ""
            links.append((number, f"{group.key.track}{target}{split}", len(group.rows)))
        rankings.append((data, links))
    return rankings


def _section(group: Group, slugs: dict[int, str]) -> dict[str, Any]:
    """What the template needs of a group: its rows' intervals, pictures and objects."""
    machines = sorted({columns.device(r.entry) for r in group.rows if r.entry.latency_ms is not None})
    per_object = [{p.object: p.metrics.object_mae_mm for p in row.entry.result.per_object} for row in group.rows]
    objects = sorted({name for errors in per_object for name in errors})
    logs = [math.log(error) for errors in per_object for error in errors.values() if error]
    ends = [(row.entry.value(DEFAULT_SORT), *(row.entry.interval(DEFAULT_SORT) or ())) for row in group.rows]
    picture = group_scatter(group, slugs)
    front = [mark.name for mark in picture.front] if picture else []
    description = (
        "Object MAE in mm against milliseconds per image, both logarithmic. On the front, fastest first: "
        f"{', '.join(front)}. {group.title}"
    )
    drawn = [_drawn(picture, f"{css} scatter", w, h, description) for css, w, h in _PICTURES] if picture else []
    cells = [[(errors.get(name), _shade(errors.get(name), logs)) for name in objects] for errors in per_object]
    return {
        "group": group, "machines": machines, "front": front, "pictures": drawn, "objects": objects,
        "object_cells": cells, "highest": max((end or 0.0 for row_ends in ends for end in row_ends), default=0.0),
    }  # fmt: skip


def group_scatter(group: Group, slugs: dict[int, str]) -> Scatter | None:
    """The picture of the rows that have a place on log axes: a known time and an error above 0; None without any.
    ``slugs``: the name of a row's page by id of its entry."""
    marks = []
    for number, row in enumerate(group.rows, start=1):
        entry, timing = row.entry, row.entry.result.timing
        ms, error, name = entry.latency_ms, entry.value(DEFAULT_SORT), slugs.get(id(entry), "")
        if not ms or not error:
            continue
        frames = "1 frame" if entry.frames == 1 else f"{entry.frames} frames"
        marks.append(Mark(
            ms, error, number, printable(row.short_name), _MARK_COLOURS.get(entry.provenance, "soft"),
            # The area grows with the number of frames, and one frame is still seen.
            radius=max(4.0, 1.7 * math.sqrt(entry.frames)), hollow=not entry.time_measured,
            x_span=None if timing is None else (timing.latency_p5_ms, timing.latency_p95_ms),
            y_span=entry.interval(DEFAULT_SORT),
            title=f"{entry.name}: rank {row.ranks}, {error:.3g} mm, {ms:.3g} ms, {frames}, {entry.provenance}",
            css=f"p-{entry.provenance.replace(' ', '-')}{'' if entry.time_measured else ' hollow'}",
            row=name, url=f"{SUBMISSIONS}/{name}.html",
        ))  # fmt: skip
    front = [marks[index] for index in pareto_front([(mark.x, mark.y) for mark in marks])]
    labelled = [*front, *(mark for mark in marks if mark not in front)]
    across = "median time per image at batch 1, ms"
    return Scatter(marks, front, across, labelled, names=len(marks) <= _MOST_NAMES) if marks else None


def _drawn(picture: Scatter, css: str, width: int, height: int, about: str) -> dict[str, Any]:
    svg, numbered = picture.svg(width, height, css, about)
    return {"svg": svg, "css": css.split()[0], "numbered": sorted((mark.number, mark.name) for mark in numbered)}


def _shade(error: float | None, logs: Sequence[float]) -> int | None:
    """The larger the error among all ``logs`` of a table, the darker its cell."""
    if error is None or not logs:
        return None
    low, high = min(logs), max(logs)
    share = 0.0 if error == 0 or high == low else (math.log(error) - low) / (high - low)
    return min(_SHADES - 1, int(share * _SHADES))


def _tradeoff(run: Tradeoff | None) -> dict[str, Any] | None:
    """The section of a trade-off; None without one, or where no setting has both an error and a time."""
    if run is None or not run.comparable():
        return None
    pictures = []
    for cost in COST_KEYS:
        if picture := scatter(run, cost):
            about = f"Object MAE in mm against {picture.across}, both logarithmic"
            pictures.append(_drawn(picture, "scatter", *_TRADEOFF_PICTURE, about))
    by_time, by_frames = (run.front(cost) for cost in COST_KEYS)
    rows = []
    for point in sorted({p.key: p for p in (*by_time, *by_frames)}.values(), key=lambda p: p.object_mae_mm or 0):
        fronts = " and ".join(name for name, front in (("time", by_time), ("frames", by_frames)) if point in front)
        ms, low, high = point.ms
        missing = "-" if point.missing_share is None else f"{100 * point.missing_share:.2g}%"
        rows.append((
            point.title, fronts, millimetres(point.object_mae_mm), millimetres(point.measured_mae_mm), missing,
            f"{ms:.3g}", f"{low:.3g} to {high:.3g}", str(point.frames),
        ))  # fmt: skip
    return {
        "run": run, "benchmark": benchmark_of(run.fingerprint), "pictures": pictures, "rows": rows,
        "steepest": max(run.growth, key=lambda growth: growth.exponent, default=None),
        "flagged": [f"{growth.stage} over {growth.over}" for growth in run.growth if growth.flag],
    }  # fmt: skip


def board_ladder(quick: bool = False) -> Ladder:
    """For `fpp-bench tradeoff`: what ranking and the page cost over rows."""
    return Ladder("rank and render the leaderboard", "rows", _QUICK_BOARD_ROWS if quick else _BOARD_ROWS, _board_rung)


def _board_rung(rows: int, folder: Path) -> Rung:
    """One shipped row under many names, each with its own error and time, so that marks and names do not coincide."""
    first = read_entry(next(path for path in shipped_rows() if path.name == _BOARD_ROW))
    entries = []
    for number in range(rows):
        result, factor = first.result, 1.03**number
        about = result.submission.model_copy(update={"name": f"Method {number}"})
        if (timing := result.timing) is not None:
            keys = ("latency_median_ms", "latency_p5_ms", "latency_p95_ms")
            changed = timing.model_copy(update={key: getattr(timing, key) * factor for key in keys})
            about = about.model_copy(update={"timing": changed})
        metrics = result.metrics.model_copy(update={DEFAULT_SORT: factor})
        entries.append(replace(first, result=result.model_copy(update={"submission": about, "metrics": metrics})))

    def run() -> None:  # a dictionary that a run returns would be taken for the seconds of its parts
        page_files(rank(entries), [])

    return Rung(rows, run)
