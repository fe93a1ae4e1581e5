"""The page's section of a trade-off: error against run time and frames for every setting, and who is on a front.

The numbers come from a file of `fpp-bench tradeoff`; its texts are shown as text and nothing else.
"""

from fpp_ml_bench.evaluation.numbers import millimetres
from fpp_ml_bench.evaluation.report_html import escaped
from fpp_ml_bench.leaderboard.log_axis import LogAxis
from fpp_ml_bench.leaderboard.page_labels import Box, Named, label_texts
from fpp_ml_bench.leaderboard.tradeoff_points import Cost, Point, Tradeoff

_WIDTH, _HEIGHT = 430, 380
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 10, 12, 46
_RADIUS = 4.0
_AXES: dict[Cost, tuple[str, float]] = {"seconds": ("ms a view", 1000.0), "frames": ("frames captured", 1.0)}
_CLASSES = {"classical": "t-classical", "phase": "t-phase", "networks": "t-networks"}


def tradeoff_section(found: Tradeoff | None) -> str:
    """HTML of the section; nothing without a trade-off, or where no setting has both an error and a time."""
    if found is None or not found.comparable():
        return ""
    height, width = found.image_size
    clock = "processor time" if found.settings.get("clock") == "processor" else "wall-clock time"
    loads = found.loads
    busy = f", load {loads[0]:g} to {loads[-1]:g}" if loads else ""
    about = (
        f"{found.dataset} ({found.fingerprint[:8]}), {width} x {height} px, {len(found.views)} test views, against "
        f"{found.target}; {clock}, {found.settings.get('threads')} thread(s) of {found.hardware.cpu}{busy}"
    )
    against = "".join(_svg(found, cost) for cost in _AXES)
    return (
        '<section id="tradeoff"><h2>Every setting: error against run time and frames</h2>'
        f'<p class="soft small">{escaped(about, 400)}</p><figure><div class="pair">{against}</div>'
        "<figcaption>Object MAE on the vertical axes. Dashed: the fronts, where nobody is both cheaper and more exact. "
        '<span class="t-classical">Circles: classical</span>, <span class="t-phase">squares: phase route</span>, '
        '<span class="t-networks">triangles: networks</span>; hollow: told the view\'s own depth range or mask, on no '
        "front. Few views: see the rankings above for the whole split.</figcaption></figure>"
        f"{_front_table(found)}{_growth_words(found)}</section>\n"
    )


def _shown(found: Tradeoff) -> list[Point]:
    return [point for point in found.points if point.group in _CLASSES and point.seconds and point.object_mae_mm]


def _svg(found: Tradeoff, cost: Cost) -> str:
    """One panel."""
    label, scale = _AXES[cost]
    points, front = _shown(found), found.front(cost)
    across = LogAxis.around([scale * getattr(point, cost) for point in points], _LEFT, _WIDTH - _RIGHT)
    up = LogAxis.around([point.object_mae_mm or 1.0 for point in points], _HEIGHT - _BOTTOM, _TOP)

    def place(point: Point) -> tuple[float, float]:
        return across.at(scale * getattr(point, cost)), up.at(point.object_mae_mm or 1.0)

    parts = [_grid(across, up, label)]
    start, *_ = front
    path = f"M{place(start)[0]:.1f} {up.end:.1f}"
    lines: list[Box] = []
    for point, following in zip(front, [*front[1:], None], strict=True):
        x, y = place(point)
        path += f"H{x:.1f}V{y:.1f}"
        lines.append((x, y - 1, across.end if following is None else place(following)[0], y + 1))
    parts.append(f'<path class="front" d="{path}H{across.end:.1f}"/>')
    parts += [_marker(point, *place(point)) for point in points]
    named = [Named(p.title, "", *place(p), _RADIUS) for p in front]
    others = [p for p in points if p not in front]
    taken = [(x - _RADIUS, y - _RADIUS, x + _RADIUS, y + _RADIUS) for x, y in map(place, others)]
    parts += label_texts(named, lines, (_LEFT, 0, _WIDTH, _HEIGHT - _BOTTOM), taken)
    said = f"Object MAE in mm against {label}, both logarithmic"
    return (
        f'<svg class="scatter" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{said}">{"".join(parts)}</svg>'
    )


def _grid(across: LogAxis, up: LogAxis, label: str) -> str:
    parts = []
    for value in across.ticks(5):
        x = across.at(value)
        parts.append(f'<path class="axis" d="M{x:.1f} {_TOP}V{_HEIGHT - _BOTTOM}"/>')
        parts.append(f'<text x="{x:.1f}" y="{_HEIGHT - _BOTTOM + 18}" text-anchor="middle">{value:g}</text>')
    for value in up.ticks(6):
        y = up.at(value)
        parts.append(f'<path class="axis" d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}"/>')
        parts.append(f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>')
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    parts.append(f'<text x="{middle:.1f}" y="{_HEIGHT - 8}" text-anchor="middle">{label}</text>')
    return "".join(parts)


def _marker(point: Point, x: float, y: float) -> str:
    r = _RADIUS
    shapes = {
        "classical": f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{r}"/>',
        "phase": f'<path class="mark" d="M{x - r:.1f} {y - r:.1f}h{2 * r}v{2 * r}h{-2 * r}z"/>',
        "networks": f'<path class="mark" d="M{x:.1f} {y - r - 1:.1f}l{r + 1} {2 * r + 1}h{-2 * r - 2}z"/>',
    }
    hollow = " hollow" if point.given else ""
    said = f"{point.title}: {point.object_mae_mm:.3g} mm, {1000 * (point.seconds or 0):.3g} ms, {point.frames} frames"
    return (
        f'<g class="point {_CLASSES[point.group]}{hollow}"><title>{escaped(said, 300)}</title>{shapes[point.group]}</g>'
    )


def _front_table(found: Tradeoff) -> str:
    by = {cost: found.front(cost) for cost in _AXES}
    union = sorted({id(p): p for points in by.values() for p in points}.values(), key=lambda p: p.object_mae_mm or 0)
    lines = ""
    for point in union:
        on = " and ".join(name for name, cost in (("time", "seconds"), ("frames", "frames")) if point in by[cost])  # type: ignore[index]
        low, high = (1000 * (end or 0) for end in (point.seconds_p5, point.seconds_p95))
        cells = (
            millimetres(point.object_mae_mm),
            millimetres(point.measured_mae_mm),
            "-" if point.missing_share is None else f"{100 * point.missing_share:.2g}%",
            f"{1000 * (point.seconds or 0):.3g}",
            f"{low:.3g} to {high:.3g}",
            str(point.frames),
        )
        lines += (
            f'<tr><th scope="row">{escaped(point.title, 120)}</th><td class="text">{on}</td>'
            f"{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>\n"
        )
    titles = ("Object MAE", "of measured px", "Not measured", "ms a view", "5th to 95th", "Frames")
    head = "".join(f'<th scope="col">{title}</th>' for title in titles)
    return (
        '<div class="scroll" tabindex="0" role="region" aria-label="The fronts"><table class="dense">'
        "<caption>On the front of time, of frames, or of both; errors in mm</caption><thead><tr>"
        f'<th scope="col" class="text">Setting</th><th scope="col" class="text">Front of</th>{head}</tr></thead>\n'
        f"<tbody>\n{lines}</tbody></table></div>"
    )


def _growth_words(found: Tradeoff) -> str:
    """One sentence about the costs that grow."""
    if not found.growth:
        return ""
    flagged = [one for one in found.growth if one.flag]
    steepest = max(found.growth, key=lambda one: one.exponent)
    said = (
        f"Costs that grow: {len(found.growth)} stages were timed over pixels, frames, objects or rows; the steepest "
        f"power is {steepest.exponent:.2f} ({steepest.stage} over {steepest.over}). "
    )
    said += (
        f"Flagged: {'; '.join(f'{one.stage} over {one.over}' for one in flagged)}." if flagged else "None is flagged."
    )
    return f"<p>{escaped(said, 1500)}</p>"
