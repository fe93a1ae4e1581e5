"""Error against run time as SVG: log axes, intervals as whiskers, frames as marker size, and the Pareto front."""

import math
from dataclasses import dataclass

from fpp_ml_bench.evaluation.report_html import escaped
from fpp_ml_bench.leaderboard.log_axis import LogAxis
from fpp_ml_bench.leaderboard.page_labels import Box, Named, label_texts
from fpp_ml_bench.leaderboard.pareto import pareto_front
from fpp_ml_bench.leaderboard.ranking import Group, Ranked

ERROR = "object_mae_mm"
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 18, 14, 48


@dataclass(frozen=True)
class _Point:
    row: Ranked
    slug: str
    ms: float
    error: float

    @property
    def radius(self) -> float:
        """Px; the area grows with the number of frames, and one frame is still seen."""
        return max(4.0, 1.7 * math.sqrt(self.row.entry.frames))

    @property
    def spread_ms(self) -> tuple[float, float] | None:
        timing = self.row.entry.result.timing
        return None if timing is None else (timing.latency_p5_ms, timing.latency_p95_ms)


def _points(group: Group, slugs: dict[int, str]) -> list[_Point]:
    """Rows that have a place on log axes: a known time and an error above 0."""
    found = ((row, row.entry.latency_ms, row.entry.value(ERROR)) for row in group.rows)
    return [_Point(row, slugs[id(row.entry)], ms, error) for row, ms, error in found if ms and error]


def front_rows(group: Group) -> list[Ranked]:
    """Rows on the front, the fastest first."""
    points = _points(group, {id(row.entry): "" for row in group.rows})
    return [points[index].row for index in pareto_front([(p.ms, p.error) for p in points])]


def scatter_svg(group: Group, slugs: dict[int, str], width: int, height: int, css_class: str) -> str:
    """The group's picture, or a sentence where no row has both figures. ``slugs``: by id of an entry."""
    points = _points(group, slugs)
    if not points:
        return f'<p class="{css_class} soft">No row here has both a run time and an error above 0.</p>'
    spans = [p.row.entry.interval(ERROR) for p in points]
    errors = [p.error for p in points] + [end for span in spans if span for end in span if end > 0]
    times = [p.ms for p in points] + [end for p in points for end in p.spread_ms or ()]
    across = LogAxis.around(times, _LEFT, width - _RIGHT)
    up = LogAxis.around(errors, height - _BOTTOM, _TOP)
    front = pareto_front([(p.ms, p.error) for p in points])
    parts = [_grid(across, up, width, height), _front_line([points[i] for i in front], across, up)]
    for point, span in sorted(zip(points, spans, strict=True), key=lambda pair: -pair[0].radius):
        parts.append(_marker(point, span, across, up))
    parts += _names(points, spans, front, across, up, (_LEFT, 0, width, height - _BOTTOM))
    names = ", ".join(escaped(points[i].row.entry.name, 80) for i in front)
    said = f"Object MAE in mm against milliseconds an image, both logarithmic. On the front, fastest first: {names}"
    return (
        f'<svg class="{css_class} scatter" viewBox="0 0 {width} {height}" role="img" aria-label="{said}">'
        f"{''.join(parts)}</svg>"
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
    parts.append(f'<text x="{middle_x:.1f}" y="{height - 8}" text-anchor="middle">ms an image, at batch 1</text>')
    parts.append(
        f'<text x="14" y="{middle_y:.1f}" text-anchor="middle" transform="rotate(-90 14 {middle_y:.1f})">'
        "object MAE, mm</text>"
    )
    return "".join(parts)


def _names(
    points: list[_Point],
    spans: list[tuple[float, float] | None],
    front: list[int],
    across: LogAxis,
    up: LogAxis,
    inside: Box,
) -> list[str]:
    """The points' names; those on the front find a place first."""
    lines: list[Box] = []
    for point, span in zip(points, spans, strict=True):
        x, y = across.at(point.ms), up.at(point.error)
        if span is not None:
            lines.append((x - 1, up.at(span[1]), x + 1, up.at(max(span[0], up.low))))
        if point.spread_ms is not None:
            lines.append((across.at(point.spread_ms[0]), y - 1, across.at(point.spread_ms[1]), y + 1))
    for one, other in zip(front, [*front[1:], None], strict=True):
        x, y = across.at(points[one].ms), up.at(points[one].error)
        end = across.end if other is None else across.at(points[other].ms)
        lines.append((x, y - 1, end, y + 1))
        if other is not None:
            lines.append((end - 1, y, end + 1, up.at(points[other].error)))
    order = [*front, *(index for index in range(len(points)) if index not in front)]
    named = [
        Named(
            points[i].row.entry.name, points[i].slug, across.at(points[i].ms), up.at(points[i].error), points[i].radius
        )
        for i in order
    ]
    return label_texts(named, lines, inside)


def _front_line(front: list[_Point], across: LogAxis, up: LogAxis) -> str:
    """Steps: between two points of the front nothing better than the slower's time or the faster's error is known."""
    path = f"M{across.at(front[0].ms):.1f} {up.end:.1f}"
    for point in front:
        path += f"H{across.at(point.ms):.1f}V{up.at(point.error):.1f}"
    return f'<path class="front" d="{path}H{across.end:.1f}"/>'


def _marker(point: _Point, span: tuple[float, float] | None, across: LogAxis, up: LogAxis) -> str:
    entry = point.row.entry
    x, y = across.at(point.ms), up.at(point.error)
    whiskers = ""
    if span is not None:
        low = max(span[0], up.low)  # an end at 0 has no place on a log axis: down to the edge
        whiskers += f"M{x:.1f} {up.at(low):.1f}V{up.at(span[1]):.1f}"
    if point.spread_ms is not None:
        whiskers += f"M{across.at(point.spread_ms[0]):.1f} {y:.1f}H{across.at(point.spread_ms[1]):.1f}"
    frames = "1 frame" if entry.frames == 1 else f"{entry.frames} frames"
    said = f"{point.row.rank}. {entry.name}: {point.error:.3g} mm, {point.ms:.3g} ms, {frames}, {entry.provenance}"
    hollow = "" if entry.time_measured else " hollow"
    return (
        f'<g class="point {provenance_class(entry.provenance)}{hollow}" data-row="{point.slug}">'
        f'<title>{escaped(said, 300)}</title><path class="whisker" d="{whiskers}"/>'
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{point.radius:.1f}"/></g>'
    )


def provenance_class(provenance: str) -> str:
    """Class of a provenance; the words are ours, never a submission's."""
    return "p-" + provenance.replace(" ", "-")
