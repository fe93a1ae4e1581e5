"""The leaderboard as a static page: ``index.html``, the data as JSON and CSV, and a page for each
submission, with samples of the predictions that it was scored from where they are at hand.

The page works from disk and from any web server and loads no other file. The same rows give the
same bytes.
"""

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from string import ascii_lowercase
from types import MappingProxyType
from typing import Any

from fpp_ml_bench.baselines.tradeoff.report import Mark, Scatter
from fpp_ml_bench.errors import (
    CaptureError,
    DatasetError,
    FppBenchError,
    PredictionError,
    SubmissionError,
)
from fpp_ml_bench.evaluation.metrics import METRICS, RANGE_KEY, RANKED, with_column
from fpp_ml_bench.evaluation.protocol import FRAMES_CLASSES
from fpp_ml_bench.evaluation.report.report_page import SampleMaps, chosen_samples, sample_maps
from fpp_ml_bench.evaluation.report.terminal import score_text
from fpp_ml_bench.evaluation.result.model import Result
from fpp_ml_bench.evaluation.score.uncertainty import FEWEST_OBJECTS
from fpp_ml_bench.files import LOCK_FILE, exclusive, printable, write_atomically
from fpp_ml_bench.leaderboard import columns, tables
from fpp_ml_bench.leaderboard.columns import (
    assumption,
    assumption_sentences,
    given_truth,
    learned_from,
)
from fpp_ml_bench.leaderboard.ranking import (
    MOST_PAIRED,
    Group,
    Ranked,
    is_trivial,
    more_than_trivial,
)
from fpp_ml_bench.leaderboard.row_file import Row
from fpp_ml_bench.leaderboard.rows import MEANING, Entry, read_scored
from fpp_ml_bench.leaderboard.tables import ReportedTable, table_csv, table_json
from fpp_ml_bench.loaders.captures.exports import camera_points
from fpp_ml_bench.loaders.cloud import cloud_html
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.style import interval_text, page, signed

INDEX, DATA, TABLE, SUBMISSIONS, CLOUD = (
    "index.html",
    "data.json",
    "data.csv",
    "submissions",
    "-cloud.html",
)
_HERE, _PACKAGE = Path(__file__).resolve().parent, "fpp_ml_bench.leaderboard.page"
_OWN_PAGES = re.compile(r"[a-z0-9-]+-[0-9a-f]{12}(-cloud)?\.html")
NOT_SAID = "not said"
_SPARSE = (*columns.PARTS, columns.RATIO, columns.RANGE, *columns.UNCERTAINTY, columns.LEARNED)
_SHADES = 6
_CLIP, _MARGIN = 10, 1.05
"""An interval is drawn down to this part of its mean, and the scale goes on beyond its ends by this
factor."""
_STEPS = (1,), (1, 3), (1, 2, 5), tuple(range(1, 10))
SIZES = (("wide", 570, 430), ("narrow", 360, 380))
"""Class, width and height of a picture, for a window and for a phone."""
COSTS = {"seconds": "median time per image at batch 1, s", "frames": "captured frames"}
CLASS_COLOURS = dict(zip(FRAMES_CLASSES, ("verified", "reported", "measured"), strict=True))
_TRIVIAL_COLOUR = "soft"
_MOST_NAMES, _MOST_LISTED = 24, 100
"""Marks up to which a picture names them, and up to which the page lists their numbers."""


PLACES = "Median", "Worst"
"""The samples that are shown; where there are too few for that, the only one."""


@dataclass(frozen=True)
class Samples:
    """The samples that are shown, and the page of the first prediction as a point cloud; ``cloud``
    is None where the prediction has no depth, or the dataset no camera of its size."""

    shown: list[SampleMaps]
    cloud: bytes | None


def write_page(
    groups: Sequence[Group],
    papers: Sequence[ReportedTable],
    out: Path,
    samples: Mapping[str, Samples] = MappingProxyType({}),
) -> list[Path]:
    """Write the page of ``groups`` (ranked by the key of each) and the paper's tables into folder
    ``out``; returns the files. ``samples``: `predicted_samples` of the rows. Removes pages of
    submissions that are no longer ranked, and nothing else. SubmissionError where a file can't be
    written."""
    files = page_files(groups, papers, samples)
    try:
        with exclusive(out / LOCK_FILE, out, "writing a page there", SubmissionError):
            (out / SUBMISSIONS).mkdir(exist_ok=True)
            for name, content in files.items():
                write_atomically(out / name, content)
            for path in (out / SUBMISSIONS).iterdir():
                if _OWN_PAGES.fullmatch(path.name) and f"{SUBMISSIONS}/{path.name}" not in files:
                    path.unlink()
    except OSError as error:
        raise SubmissionError(f"{printable(out)} can't be written: {error.strerror}") from None
    return [out / name for name in files]


def page_files(
    groups: Sequence[Group],
    papers: Sequence[ReportedTable],
    samples: Mapping[str, Samples] = MappingProxyType({}),
) -> dict[str, bytes]:
    """Relative name -> content of every file of the page. Tables of trivial rows alone are in the
    data files only."""
    data = {DATA: table_json(groups, papers), TABLE: table_csv(groups)}
    groups = more_than_trivial(groups)
    style = (_HERE / "page.css").read_text("utf-8")
    rows = [(group, row) for group in groups for row in group.rows]
    shared: dict[str, Any] = {"meaning": MEANING, "learned_from": learned_from}
    filters: dict[str, tuple[str, list[str]]] = {
        "class": (
            "Class",
            [name for name in FRAMES_CLASSES if any(group.key.frames == name for group in groups)],
        ),
        "track": ("Track", sorted({group.key.track for group in groups})),
        "learned": (
            "Learned from",
            sorted({learned_from(row.entry.row) or NOT_SAID for _, row in rows}),
        ),
    }
    present = {row.provenance for _, row in rows}
    others = [
        metric for metric in with_column(0) if not metric.role and metric.key != "overall_mae_mm"
    ]
    index = page(
        _PACKAGE,
        "index.html",
        "FPP-ML-Bench leaderboard",
        style,
        (_HERE / "page.js").read_text("utf-8"),
        "Ranking of single-shot fringe projection profilometry: depth error with intervals, run "
        "time and captures.",
        **shared,
        columns=columns,
        range_key=RANGE_KEY,
        errors=[(m.key, f"{m.column}, mm" if m.unit == "mm" else m.column) for m in others],
        given_truth=given_truth,
        assumption=assumption,
        search=_search,
        slug=slug,
        blocks=blocks(groups),
        provenances=[name for name in MEANING if name in present],
        colours=CLASS_COLOURS,
        not_said=NOT_SAID,
        fewest=FEWEST_OBJECTS,
        filters={
            name: (title, values) for name, (title, values) in filters.items() if len(values) > 1
        },
        papers=[(f"{p.title}, mm", tables.paper_table(p), p.note) for p in papers],
    )
    files = {INDEX: index} | {name: text.encode("utf-8") for name, text in data.items()}
    for group, row in rows:
        own, name = samples.get(row.entry.row.result_sha256), slug(row.entry)
        title, values = f"{row.entry.name}: FPP-ML-Bench", shared | _submission(group, row)
        text = page(_PACKAGE, "submission.html", title, style, **values, samples=own, slug=name)
        files[f"{SUBMISSIONS}/{name}.html"] = text
        if own is not None and own.cloud is not None:
            files[f"{SUBMISSIONS}/{name}{CLOUD}"] = own.cloud
    return files


def _submission(group: Group, row: Ranked) -> dict[str, Any]:
    """What the template needs for the page of ``row``."""
    about = row.entry.row
    parts = [about] if row.unseen is None else [about, row.unseen.row]
    bars = [(mean, name) for name, mean in row.object_means(group.sort).items()]
    changes = about.reliance.parts.titled() if about.reliance else {}
    scored = []
    for part in parts:
        benchmark = part.dataset.known
        data = part.dataset.name if benchmark is None else benchmark.title
        scored.append((f"{data}, {part.dataset.split} split", _score_cells(part)))
    return {
        "row": row,
        "group": group,
        "rows": len(group.ranked),
        "assumption_sentences": assumption_sentences,
        "columns": columns,
        "scored": scored,
        "bars": sorted(bars, key=lambda bar: (-bar[0], bar[1])),
        "longest_mm": max(bars, default=(0.0, ""))[0],
        "parts": [(words, f"{value:.2f}") for words, value in changes.items() if value is not None],
    }


def _score_cells(row: Row) -> list[tuple[str, str, str]]:
    """Each mean in words, its value, and its interval."""
    cells = []
    for key in (*RANKED, *(key for key in METRICS if key not in RANKED)):
        if (value := getattr(row.metrics, key)) is not None:
            title = METRICS[key].title
            cells.append((title, score_text(key, value), interval_text(row.intervals.of(key))))
    return cells


def slug(entry: Entry) -> str:
    """Name of an entry's page: letters and digits of its own name, and the start of its content's
    SHA-256."""
    plain = re.sub(r"[^a-z0-9]+", "-", entry.name[:60].casefold()).strip("-") or "submission"
    return f"{plain}-{hashlib.sha256(entry.row.model_dump_json().encode()).hexdigest()[:12]}"


def _search(row: Ranked) -> str:
    """What the search field finds a row by."""
    words = (
        row.entry.name,
        row.short_name,
        row.entry.row.submission.method,
        columns.device(row.entry),
    )
    return " ".join(words).casefold()


def predicted_samples(
    entries: Sequence[Entry], folders: Sequence[tuple[Path, DatasetFolder]]
) -> dict[str, Samples]:
    """The samples of every folder of predictions, each with its dataset, by `Row.result_sha256` of
    the entries that were scored from it. Row files name no samples, so only results have them.
    Raises SubmissionError for a folder that no result was scored from, and says why."""
    results = [entry for entry in entries if folders and not entry.is_row_file]
    scored = {entry.row.result_sha256: read_scored(entry.path) for entry in results}
    samples: dict[str, Samples] = {}
    for folder, dataset in folders:
        why: FppBenchError | str = "row files name no samples; give the result of fpp-eval"
        of_folder = {}
        for digest, result in scored.items():
            try:
                if isinstance(result, Result):
                    of_folder[digest] = _samples(result, folder, dataset)
            except (DatasetError, PredictionError) as error:
                why = error
        if not of_folder:
            raise SubmissionError(
                f"{printable(folder)}: no given result was scored from it ({why})"
            )
        samples |= of_folder
    return samples


def _samples(result: Result, folder: Path, dataset: DatasetFolder) -> Samples:
    chosen = chosen_samples(result.per_sample)
    shown = list(
        sample_maps(result, dataset, folder, [c for c in chosen if c[0] in PLACES] or chosen[:1])
    )
    if (
        not shown or result.mode != "standard"
    ):  # no sample has an object; depths of another mode may lack an offset
        return Samples(shown, None)
    try:
        points_mm, there = camera_points(shown[0].prediction_mm, dataset.rig.camera)
    except CaptureError:
        return Samples(shown, None)
    return Samples(
        shown,
        cloud_html(
            f"{result.submission.name}: {shown[0].row.sample}", points_mm, shown[0].fringe[there]
        ),
    )


def blocks(groups: Sequence[Group]) -> list[dict[str, Any]]:
    """What the template needs of each dataset: its title and a ``short`` one, whether it is
    ``main`` (the first, or not `GroupKey.special_data`), the pictures of all its rows, and its
    tables."""
    datasets: list[dict[str, Any]] = []
    for data, members in groupby(groups, key=lambda group: group.key.data_title):
        of_data = list(members)
        key, drawn_groups = of_data[0].key, of_one_target(of_data)
        rows = [row for group in drawn_groups for row in group.rows]
        name = key.benchmark.name if key.benchmark is not None else data.split(", ")[0]
        numbered = [(n, row.short_name, slug(row.entry)) for n, row in enumerate(rows, start=1)]
        datasets.append(
            {
                "numbered": numbered if len(rows) <= _MOST_LISTED else [],
                "id": f"data-{hashlib.sha256(data.encode()).hexdigest()[:8]}",
                "title": data,
                "short": key.special_data or name,
                "main": not datasets or not key.special_data,
                "figures": overview_figures(drawn_groups),
                "against": drawn_groups[0].key.against,
                "left_out": len({group.key.against for group in of_data}) > 1,
                "sections": [_section(group, _link(group, of_data)) for group in of_data],
            }
        )
    return datasets


def of_one_target(groups: Sequence[Group]) -> list[Group]:
    """The groups whose errors a picture may join: those against exact depth, all where there is
    none."""
    exact = [group for group in groups if group.key.target == "depth_exact"]
    return exact or list(groups)


def anchor(group: Group) -> str:
    """The id of a table on the page, which stays when rows or other tables are added."""
    key = group.key
    words = re.sub(r"[^a-z]+", "-", f"{key.frames} {key.track} {key.target}")
    return f"{words}-{hashlib.sha256(repr(key).encode()).hexdigest()[:8]}"


def _link(group: Group, of_data: Sequence[Group]) -> str:
    """What is said of a table where it is one of those of its dataset: in which it differs from the
    others."""
    parts = [group.key.frames.partition(",")[0]]
    parts += [group.key.track] if len({other.key.track for other in of_data}) > 1 else []
    parts += (
        [group.key.against.split()[0]] if len({other.key.target for other in of_data}) > 1 else []
    )
    return ", ".join(parts)


def _section(group: Group, link: str) -> dict[str, Any]:
    """What the template needs of a group: its heading, its rows' intervals, objects and pairs."""
    key = group.key
    per_object = [row.object_means(group.sort) for row in group.rows[:MOST_PAIRED]]
    objects = sorted({name for errors in per_object for name in errors})
    machines = sorted(
        {columns.device(row.entry) for row in group.rows if row.entry.latency_ms is not None}
    )
    letters = [ascii_lowercase[number % 26] * (1 + number // 26) for number in range(len(machines))]
    scale = LogScale.of(group.rows)
    logs = [math.log(error) for errors in per_object for error in errors.values() if error]
    low, high = min(logs, default=0.0), max(logs, default=0.0)
    object_cells = [
        [(errors.get(name), _shade(errors.get(name), low, high)) for name in objects]
        for errors in per_object
    ]
    return {
        "group": group,
        "id": anchor(group),
        "link": link,
        "machines": dict(zip(machines, letters if len(machines) > 1 else [""], strict=False)),
        "scale": scale,
        "clipped": any(
            (row.interval(group.sort) or (scale.low,))[0] < scale.low for row in group.rows
        ),
        "objects": objects,
        "object_cells": object_cells,
        "title": f"{key.frames[0].upper()}{key.frames[1:]}, {key.track} track, against {key.against}{key.rules}",
        "ranked": len(group.ranked),
        "most_paired": MOST_PAIRED,
        "matrix": _matrix(group) if group.pairs else [],
        "with": [column.title for column in _SPARSE if column.shown_for(group.rows)],
    }


def _matrix(group: Group) -> list[tuple[str, list[tuple[str, str, str] | None]]]:
    """For each ranked row and each of them: this row minus that in mm, interval and p value, and a
    verdict."""
    names = [row.short_name for row in group.ranked]
    cells: dict[tuple[str, str], tuple[str, str, str]] = {}
    for pair in group.pairs:
        low, high = pair.interval or (pair.difference, pair.difference)
        p = f"p {pair.p_holm:.2g}"
        for first, second, sign, ends in (
            (pair.second, pair.first, 1, (low, high)),
            (pair.first, pair.second, -1, (-high, -low)),
        ):
            verdict = "" if not pair.behind else "behind" if sign > 0 else "ahead"
            difference = signed(sign * pair.difference)
            cells[first, second] = difference, f"{interval_text(ends)}; {p}", verdict
    return [(name, [cells.get((name, other)) for other in names]) for name in names]


def _shade(error: float | None, low: float, high: float) -> int | None:
    """The larger the error among those of a table, whose logarithms are ``low`` to ``high``, the
    darker its cell."""
    if error is None:
        return None
    share = 0.0 if error == 0 or high == low else (math.log(error) - low) / (high - low)
    return min(_SHADES - 1, int(share * _SHADES))


def overview(groups: Sequence[Group], cost: str) -> Scatter | None:
    """The rows of ``groups`` that have a place on log axes: a known cost, of `COSTS`, and an error
    above 0; None without any. On the front are rows that were given no ground truth and are not
    trivial."""
    rows = [(group, row) for group in groups for row in group.rows]
    drawn = [_mark(number, group, row, cost) for number, (group, row) in enumerate(rows, start=1)]
    marks = [mark for mark in drawn if mark is not None]
    return (
        Scatter(marks, COSTS[cost], len(marks) <= _MOST_NAMES, ranked_by(groups)) if marks else None
    )


def ranked_by(groups: Sequence[Group]) -> str:
    """What the rows of ``groups`` are ranked by, as the title of an axis."""
    titles = dict.fromkeys(METRICS[group.key.rank_key].title for group in groups)
    return f"{' or '.join(titles)}, mm"


def _mark(number: int, group: Group, row: Ranked, cost: str) -> Mark | None:
    entry, timing, error = row.entry, row.entry.row.timing, row.value(row.rank_key)
    seconds = entry.value("seconds_per_sample")
    x = seconds if cost == "seconds" else float(entry.frames)
    if not x or not error:
        return None
    frames = "1 frame" if entry.frames == 1 else f"{entry.frames} frames"
    time = "unknown time" if seconds is None else f"{1000 * seconds:.3g} ms"
    span = None if timing is None else (timing.latency_p5_ms / 1000, timing.latency_p95_ms / 1000)
    hollow = cost == "seconds" and not entry.time_measured
    return Mark(
        x,
        error,
        number,
        printable(row.short_name),
        _TRIVIAL_COLOUR if is_trivial(row) else CLASS_COLOURS[group.key.frames],
        shape="o" if group.key.track == "metric" else "s",
        hollow=hollow,
        can_lead=group.key.track == "metric" and not is_trivial(row),
        x_span=span if cost == "seconds" else None,
        y_span=row.interval(row.rank_key),
        title=(
            f"{entry.name}: {error:.3g} mm, {time}, {frames}, {group.key.track} track, "
            f"{row.provenance}"
        ),
        css=f"p-{row.provenance.replace(' ', '-')}{' hollow' if hollow else ''}",
        row=slug(entry),
        url=f"{SUBMISSIONS}/{slug(entry)}.html",
    )


def overview_figures(groups: Sequence[Group]) -> list[dict[str, Any]]:
    """For each cost that any row has: its name, the pictures in both `SIZES`, and the front,
    cheapest first."""
    figures = []
    for cost, across in COSTS.items():
        if (picture := overview(groups, cost)) is None:
            continue
        front = [mark.name for mark in picture.front]
        about = (
            f"{picture.up} against {across}, both logarithmic. On the front, cheapest first: "
            f"{', '.join(front)}"
        )
        about += f". {groups[0].key.data_title}"
        sizes = [
            picture.svg(width, height, f"{css} scatter", about) for css, width, height in SIZES
        ]
        figures.append({"cost": cost, "pictures": sizes, "front": front})
    return figures


@dataclass(frozen=True)
class LogScale:
    """From ``low`` to ``high`` mm, logarithmic, the same for all rows of a table."""

    low: float
    high: float

    @classmethod
    def of(cls, rows: Sequence[Ranked]) -> "LogScale":
        """A scale that holds the means of ``rows``, and their intervals as far down as a part of
        the mean."""
        ranked_by = [(row.value(row.rank_key), row.interval(row.rank_key)) for row in rows]
        means = [(mean, ends or (mean, mean)) for mean, ends in ranked_by if mean]
        low = min((max(ends[0], mean / _CLIP) for mean, ends in means), default=1.0)
        return cls(low / _MARGIN, max((ends[1] for _, ends in means), default=1.0) * _MARGIN)

    def share(self, value_mm: float) -> float:
        """Where a value stands, from 0 at ``low`` to 1 at ``high``; beyond them, at the nearer
        end."""
        inside = min(max(value_mm, self.low), self.high)
        return math.log(inside / self.low) / math.log(self.high / self.low)

    @property
    def ticks(self) -> list[tuple[float, str]]:
        """Place and label of the powers of ten on the scale; with multiples of them where it holds
        fewer than two."""
        powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        for steps in _STEPS:
            values = [step * 10.0**power for power in powers for step in steps]
            inside = [
                (self.share(value), f"{value:g}")
                for value in values
                if self.low <= value <= self.high
            ]
            if len(inside) > 1:
                break
        return inside
