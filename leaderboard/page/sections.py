"""What the page's template needs of each dataset, its pictures (error against time and against frames) and its tables,
and of a trade-off."""

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from string import ascii_lowercase
from typing import Any

from fpp_ml_bench.baselines.tradeoff.measure import COST_KEYS, Tradeoff
from fpp_ml_bench.baselines.tradeoff.report import Mark, Scatter, growth_table, point_table, scatter
from fpp_ml_bench.evaluation.metrics import RANK_KEY
from fpp_ml_bench.evaluation.protocol import FRAMES_CLASSES
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard import columns
from fpp_ml_bench.leaderboard.ranking import DEFAULT_SORT, MOST_PAIRED, Group, Ranked, is_trivial
from fpp_ml_bench.loaders.storage.benchmark import benchmark_before
from fpp_ml_bench.style import interval_text, signed

_SPARSE = (*columns.PARTS, columns.RATIO, columns.RANGE, *columns.UNCERTAINTY, columns.LEARNED)
_TRADEOFF_PICTURE = 430, 380
_SHADES = 6
_CLIP, _MARGIN = 10, 1.05
"""An interval is drawn down to this part of its mean, and the scale goes on beyond its ends by this factor."""
_STEPS = (1,), (1, 3), (1, 2, 5), tuple(range(1, 10))


def blocks(groups: Sequence[Group], slugs: Mapping[int, str]) -> list[dict[str, Any]]:
    """What the template needs of each dataset: its title and a ``short`` one, whether it is ``main`` (the first, or
    not `GroupKey.special_data`), the pictures of all its rows, and its tables."""
    datasets: list[dict[str, Any]] = []
    for data, members in groupby(groups, key=lambda group: group.key.data_title):
        of_data = list(members)
        key, drawn_groups = of_data[0].key, of_one_target(of_data)
        rows = [row for group in drawn_groups for row in group.rows]
        name = key.benchmark.name if key.benchmark is not None else data.split(", ")[0]
        numbered = [(n, row.short_name, slugs[id(row.entry)]) for n, row in enumerate(rows, start=1)]
        datasets.append(
            {
                "numbered": numbered if len(rows) <= _MOST_LISTED else [],
                "id": f"data-{hashlib.sha256(data.encode()).hexdigest()[:8]}",
                "title": data,
                "short": key.special_data or name,
                "main": not datasets or not key.special_data,
                "figures": overview_figures(drawn_groups, slugs),
                "against": drawn_groups[0].key.against,
                "left_out": len({group.key.against for group in of_data}) > 1,
                "sections": [_section(group, _link(group, of_data)) for group in of_data],
            }
        )
    return datasets


def of_one_target(groups: Sequence[Group]) -> list[Group]:
    """The groups whose errors a picture may join: those against exact depth, all where there is none."""
    exact = [group for group in groups if group.key.target == "depth_exact"]
    return exact or list(groups)


def anchor(group: Group) -> str:
    """The id of a table on the page, which stays when rows or other tables are added."""
    key = group.key
    words = re.sub(r"[^a-z]+", "-", f"{key.frames} {key.track} {key.target}")
    return f"{words}-{hashlib.sha256(repr(key).encode()).hexdigest()[:8]}"


def _link(group: Group, of_data: Sequence[Group]) -> str:
    """What is said of a table where it is one of those of its dataset: in which it differs from the others."""
    parts = [group.key.frames.partition(",")[0]]
    parts += [group.key.track] if len({other.key.track for other in of_data}) > 1 else []
    parts += [group.key.against.split()[0]] if len({other.key.target for other in of_data}) > 1 else []
    return ", ".join(parts)


def _section(group: Group, link: str) -> dict[str, Any]:
    """What the template needs of a group: its heading, its rows' intervals, objects and pairs."""
    key = group.key
    mode = "" if key.mode == "standard" else f", mode {key.mode}"
    per_object = [row.object_means(DEFAULT_SORT) for row in group.rows[:MOST_PAIRED]]
    objects = sorted({name for errors in per_object for name in errors})
    machines = sorted({columns.device(row.entry) for row in group.rows if row.entry.latency_ms is not None})
    letters = [ascii_lowercase[number % 26] * (1 + number // 26) for number in range(len(machines))]
    scale = LogScale.of(group.rows)
    logs = [math.log(error) for errors in per_object for error in errors.values() if error]
    low, high = min(logs, default=0.0), max(logs, default=0.0)
    object_cells = [
        [(errors.get(name), _shade(errors.get(name), low, high)) for name in objects] for errors in per_object
    ]
    return {
        "group": group,
        "id": anchor(group),
        "link": link,
        "machines": dict(zip(machines, letters if len(machines) > 1 else [""], strict=False)),
        "scale": scale,
        "clipped": any((row.interval(DEFAULT_SORT) or (scale.low,))[0] < scale.low for row in group.rows),
        "objects": objects,
        "object_cells": object_cells,
        "title": f"{key.frames[0].upper()}{key.frames[1:]}, {key.track} track, against {key.against}{mode}",
        "ranked": len(group.ranked),
        "most_paired": MOST_PAIRED,
        "matrix": _matrix(group) if group.pairs else [],
        "with": [column.title for column in _SPARSE if column.shown_for(group.rows)],
    }


def _matrix(group: Group) -> list[tuple[str, list[tuple[str, str, str] | None]]]:
    """For each ranked row and each of them: this row minus that in mm, interval and p value, and a verdict."""
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


def tradeoff_section(run: Tradeoff | None) -> dict[str, Any] | None:
    """The section of a trade-off; None without one, or where no point is on a front."""
    if run is None or not run.front("seconds"):
        return None
    pictures = []
    for cost in COST_KEYS:
        if picture := scatter(run, cost):
            about = f"Object MAE in mm against {picture.across}, both logarithmic"
            pictures.append(drawn(picture, "scatter", *_TRADEOFF_PICTURE, about))
    return {
        "benchmark": benchmark_before(run.fingerprint),
        "pictures": pictures,
        "tables": [point_table(run), growth_table(run)],
    }


def _shade(error: float | None, low: float, high: float) -> int | None:
    """The larger the error among those of a table, whose logarithms are ``low`` to ``high``, the darker its cell."""
    if error is None:
        return None
    share = 0.0 if error == 0 or high == low else (math.log(error) - low) / (high - low)
    return min(_SHADES - 1, int(share * _SHADES))


SIZES = (("wide", 570, 430), ("narrow", 360, 380))
"""Class, width and height of a picture, for a window and for a phone."""
COSTS = {"seconds": "median time per image at batch 1, s", "frames": "captured frames"}
CLASS_COLOURS = dict(zip(FRAMES_CLASSES, ("verified", "reported", "measured"), strict=True))
_TRIVIAL_COLOUR = "soft"
_MOST_NAMES, _MOST_LISTED = 24, 100
"""Marks up to which a picture names them, and up to which the page lists their numbers."""


def overview(groups: Sequence[Group], cost: str, slugs: Mapping[int, str]) -> Scatter | None:
    """The rows of ``groups`` that have a place on log axes: a known cost, of `COSTS`, and an error above 0; None
    without any. On the front are rows that were given no ground truth and are not trivial. ``slugs``: the name of a
    row's page by id of its entry."""
    rows = [(group, row) for group in groups for row in group.rows]
    drawn = [
        _mark(number, group, row, cost, slugs.get(id(row.entry), ""))
        for number, (group, row) in enumerate(rows, start=1)
    ]
    marks = [mark for mark in drawn if mark is not None]
    return Scatter(marks, COSTS[cost], names=len(marks) <= _MOST_NAMES) if marks else None


def _mark(number: int, group: Group, row: Ranked, cost: str, page: str) -> Mark | None:
    entry, timing, error = row.entry, row.entry.row.timing, row.value(DEFAULT_SORT)
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
        y_span=row.interval(DEFAULT_SORT),
        title=f"{entry.name}: {error:.3g} mm, {time}, {frames}, {group.key.track} track, {row.provenance}",
        css=f"p-{row.provenance.replace(' ', '-')}{' hollow' if hollow else ''}",
        row=page,
        url=f"submissions/{page}.html",
    )


def drawn(picture: Scatter, css: str, width: int, height: int, about: str) -> dict[str, Any]:
    """What the template needs of a picture: its SVG, its class, and the names of the marks that have a number."""
    svg, numbered = picture.svg(width, height, css, about)
    return {"svg": svg, "css": css.split()[0], "numbered": sorted((mark.number, mark.name) for mark in numbered)}


def overview_figures(groups: Sequence[Group], slugs: Mapping[int, str]) -> list[dict[str, Any]]:
    """For each cost that any row has: its name, the pictures in both `SIZES`, and the front, cheapest first."""
    figures = []
    for cost, across in COSTS.items():
        if (picture := overview(groups, cost, slugs)) is None:
            continue
        front = [mark.name for mark in picture.front]
        about = f"Object MAE in mm against {across}, both logarithmic. On the front, cheapest first: {', '.join(front)}"
        about += f". {groups[0].key.data_title}"
        sizes = [drawn(picture, f"{css} scatter", width, height, about) for css, width, height in SIZES]
        figures.append({"cost": cost, "pictures": sizes, "front": front})
    return figures


@dataclass(frozen=True)
class LogScale:
    """From ``low`` to ``high`` mm, logarithmic, the same for all rows of a table."""

    low: float
    high: float

    @classmethod
    def of(cls, rows: Sequence[Ranked]) -> "LogScale":
        """A scale that holds the means of ``rows``, and their intervals as far down as a part of the mean."""
        means = [(mean, row.interval(RANK_KEY) or (mean, mean)) for row in rows if (mean := row.value(RANK_KEY))]
        low = min((max(ends[0], mean / _CLIP) for mean, ends in means), default=1.0)
        return cls(low / _MARGIN, max((ends[1] for _, ends in means), default=1.0) * _MARGIN)

    def share(self, value_mm: float) -> float:
        """Where a value stands, from 0 at ``low`` to 1 at ``high``; beyond them, at the nearer end."""
        inside = min(max(value_mm, self.low), self.high)
        return math.log(inside / self.low) / math.log(self.high / self.low)

    @property
    def ticks(self) -> list[tuple[float, str]]:
        """Place and label of the powers of ten on the scale; with multiples of them where it holds fewer than two."""
        powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        for steps in _STEPS:
            values = [step * 10.0**power for power in powers for step in steps]
            inside = [(self.share(value), f"{value:g}") for value in values if self.low <= value <= self.high]
            if len(inside) > 1:
                break
        return inside
