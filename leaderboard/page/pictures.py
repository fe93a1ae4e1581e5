"""The pictures of the page: error against time and against frames, for all rows on the same data."""

from collections.abc import Mapping, Sequence
from typing import Any

from fpp_ml_bench.baselines.tradeoff.drawing import Mark, Scatter
from fpp_ml_bench.baselines.tradeoff.measure import pareto_front
from fpp_ml_bench.evaluation.protocol import FRAMES_CLASSES
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.groups import Group, Ranked
from fpp_ml_bench.leaderboard.ranking import DEFAULT_SORT
from fpp_ml_bench.leaderboard.trivial import is_trivial

SIZES = (("wide", 570, 430), ("narrow", 360, 380))
"""Class, width and height of a picture, for a window and for a phone."""
COSTS = {"seconds": "median time per image at batch 1, s", "frames": "captured frames"}
CLASS_COLOURS = dict(zip(FRAMES_CLASSES, ("verified", "reported", "measured"), strict=True))
_TRIVIAL_COLOUR = "soft"
_MOST_NAMES, MOST_LABELLED = 24, 100
"""Marks up to which a picture names them, and up to which it has labels: finding room for them takes quadratic time."""


def overview(groups: Sequence[Group], cost: str, slugs: Mapping[int, str]) -> Scatter | None:
    """The rows of ``groups`` that have a place on log axes: a known cost, of `COSTS`, and an error above 0; None
    without any. On the front are rows that were told nothing and are not trivial. ``slugs``: the name of a row's page
    by id of its entry."""
    rows = [(group, row) for group in groups for row in group.rows]
    marks, can_lead = [], []
    for number, (group, row) in enumerate(rows, start=1):
        if (mark := _mark(number, group, row, cost, slugs.get(id(row.entry), ""))) is not None:
            marks.append(mark)
            if group.key.track == "metric" and not is_trivial(row):
                can_lead.append(mark)
    front = [can_lead[index] for index in pareto_front([(mark.x, mark.y) for mark in can_lead])]
    leading = set(map(id, front))
    labelled = [*front, *(mark for mark in marks if id(mark) not in leading)] if len(marks) <= MOST_LABELLED else []
    return Scatter(marks, front, COSTS[cost], labelled, names=len(marks) <= _MOST_NAMES) if marks else None


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
