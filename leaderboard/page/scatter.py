"""Error against run time as SVG: log axes, intervals as whiskers, frames as marker size, and the Pareto front."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from fpp_ml_bench.evaluation.report import escaped
from fpp_ml_bench.leaderboard.groups import Group, Ranked
from fpp_ml_bench.leaderboard.page.labels import Box, Mark, key_list, place_labels
from fpp_ml_bench.leaderboard.page.log_axis import LogAxis
from fpp_ml_bench.leaderboard.pareto import pareto_front

ERROR = "object_mae_mm"
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 18, 14, 48
_MOST_NAMES = 12
"""Points up to which a picture names them; more points get numbers and a key."""


@dataclass(frozen=True)
class _Point:
    """A row with its ``number`` in the ranking, from 1, and the name of its page."""

    row: Ranked
    number: int
    slug: str
    ms: float
    error: float

    @property
    def radius(self) -> float:
        """Px; the area grows with the number of frames, and one frame is still seen."""
        return max(4.0, 1.7 * math.sqrt(self.row.entry.frames))

    @property
    def error_span(self) -> tuple[float, float] | None:
        return self.row.entry.interval(ERROR)

    @property
    def ms_span(self) -> tuple[float, float] | None:
        timing = self.row.entry.result.timing
        return None if timing is None else (timing.latency_p5_ms, timing.latency_p95_ms)


def _points(group: Group, slugs: dict[int, str]) -> list[_Point]:
    """Rows that have a place on log axes: a known time and an error above 0."""
    values = ((row, row.entry.latency_ms, row.entry.value(ERROR)) for row in group.rows)
    return [
        _Point(row, number, slugs.get(id(row.entry), ""), ms, error)
        for number, (row, ms, error) in enumerate(values, start=1)
        if ms and error
    ]


def front_rows(group: Group) -> list[Ranked]:
    """Rows on the front, the fastest first."""
    points = _points(group, {})
    return [points[index].row for index in pareto_front([(p.ms, p.error) for p in points])]


def scatter_html(group: Group, slugs: dict[int, str], width: int, height: int, css_class: str) -> str:
    """The group's picture and the key of its numbers, or a sentence where no row has both figures. ``slugs``: the name
    of a row's page by id of its entry."""
    points = _points(group, slugs)
    if not points:
        return f'<p class="{css_class} soft">No row here has both a run time and an error above 0.</p>'
    errors = [p.error for p in points] + [end for p in points for end in p.error_span or () if end > 0]
    times = [p.ms for p in points] + [end for p in points for end in p.ms_span or ()]
    across = LogAxis.around(times, _LEFT, width - _RIGHT)
    up = LogAxis.around(errors, height - _BOTTOM, _TOP)
    on_front = pareto_front([(p.ms, p.error) for p in points])
    front = [points[index] for index in on_front]
    rest = [point for index, point in enumerate(points) if index not in on_front]
    parts = [_grid(across, up, width, height), _front_line(front, across, up)]
    for point in sorted(points, key=lambda point: -point.radius):
        parts.append(_marker(point, across, up))
    marks = [
        Mark(p.row.short_name, p.number, p.slug, across.at(p.ms), up.at(p.error), p.radius) for p in [*front, *rest]
    ]
    lines = [*_whisker_boxes(points, across, up), *_front_boxes(front, across, up)]
    inside = (_LEFT, 0, width, height - _BOTTOM)
    labels = place_labels(marks, lines, inside, names=len(points) <= _MOST_NAMES)
    parts += [label.svg() for label in labels]
    names = ", ".join(escaped(point.row.short_name) for point in front)
    about = f"Object MAE in mm against milliseconds per image, both logarithmic. On the front, fastest first: {names}"
    return (
        f'<svg class="{css_class} scatter" viewBox="0 0 {width} {height}" role="img" aria-label="{about}">'
        f"{''.join(parts)}</svg>{key_list(labels, css_class)}"
    )


def _grid(across: LogAxis, up: LogAxis, width: int, height: int) -> str:
    parts = []
    for value in across.ticks(max(3, width // 90)):
        x = across.at(value)
        parts.append(f'<path class="axis" d="M{x:.1f} {_TOP}V{height - _BOTTOM}"/>')
        parts.append(f'<text x="{x:.1f}" y="{height - _BOTTOM + 18}" text-anchor="middle">{value:g}</text>')
    for value in up.ticks(6):
        y = up.at(value)
        parts.append(f'<path class="axis" d="M{_LEFT} {y:.1f}H{width - _RIGHT}"/>')
        parts.append(f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>')
    middle_x, middle_y = (_LEFT + width - _RIGHT) / 2, (_TOP + height - _BOTTOM) / 2
    parts.append(
        f'<text x="{middle_x:.1f}" y="{height - 8}" text-anchor="middle">median time per image at batch 1, ms</text>'
    )
    parts.append(
        f'<text x="14" y="{middle_y:.1f}" text-anchor="middle" transform="rotate(-90 14 {middle_y:.1f})">'
        "object MAE, mm</text>"
    )
    return "".join(parts)


def _whisker_boxes(points: Sequence[_Point], across: LogAxis, up: LogAxis) -> list[Box]:
    boxes: list[Box] = []
    for point in points:
        x, y = across.at(point.ms), up.at(point.error)
        if point.error_span is not None:
            low, high = point.error_span
            boxes.append((x - 1, up.at(high), x + 1, up.at(max(low, up.low))))
        if point.ms_span is not None:
            boxes.append((across.at(point.ms_span[0]), y - 1, across.at(point.ms_span[1]), y + 1))
    return boxes


def _front_boxes(front: Sequence[_Point], across: LogAxis, up: LogAxis) -> list[Box]:
    x = across.at(front[0].ms)
    boxes: list[Box] = [(x - 1, up.end, x + 1, up.at(front[0].error))]
    for point, slower in zip(front, [*front[1:], None], strict=True):
        x, y = across.at(point.ms), up.at(point.error)
        end = across.end if slower is None else across.at(slower.ms)
        boxes.append((x, y - 1, end, y + 1))
        if slower is not None:
            boxes.append((end - 1, y, end + 1, up.at(slower.error)))
    return boxes


def _front_line(front: Sequence[_Point], across: LogAxis, up: LogAxis) -> str:
    """Steps: between two points of the front, the error stays that of the faster one."""
    path = f"M{across.at(front[0].ms):.1f} {up.end:.1f}"
    for point in front:
        path += f"H{across.at(point.ms):.1f}V{up.at(point.error):.1f}"
    return f'<path class="front" d="{path}H{across.end:.1f}"/>'


def _marker(point: _Point, across: LogAxis, up: LogAxis) -> str:
    entry = point.row.entry
    x, y = across.at(point.ms), up.at(point.error)
    whiskers = ""
    if point.error_span is not None:
        low = max(point.error_span[0], up.low)  # an end at 0 has no place on a log axis: down to the edge
        whiskers += f"M{x:.1f} {up.at(low):.1f}V{up.at(point.error_span[1]):.1f}"
    if point.ms_span is not None:
        whiskers += f"M{across.at(point.ms_span[0]):.1f} {y:.1f}H{across.at(point.ms_span[1]):.1f}"
    frames = "1 frame" if entry.frames == 1 else f"{entry.frames} frames"
    figures = f"{point.error:.3g} mm, {point.ms:.3g} ms, {frames}, {entry.provenance}"
    title = f"{entry.name}: rank {point.row.ranks}, {figures}"
    hollow = "" if entry.time_measured else " hollow"
    return (
        f'<g class="point {provenance_class(entry.provenance)}{hollow}" data-row="{point.slug}">'
        f'<title>{escaped(title, 300)}</title><path class="whisker" d="{whiskers}"/>'
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{point.radius:.1f}"/></g>'
    )


def provenance_class(provenance: str) -> str:
    """CSS class of a provenance, which is a fixed word of this package, never a submission's text."""
    return "p-" + provenance.replace(" ", "-")
