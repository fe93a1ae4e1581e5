"""The page's section of a trade-off: error against run time and frames for every setting, and the two fronts.

The numbers come from a file of `fpp-bench tradeoff`; its texts are shown as plain text.
"""

from fpp_ml_bench.evaluation.report import escaped, millimetres
from fpp_ml_bench.leaderboard.page.labels import Box, Label, Mark, key_list, place_labels
from fpp_ml_bench.leaderboard.page.log_axis import LogAxis
from fpp_ml_bench.leaderboard.short_names import cut_at_word
from fpp_ml_bench.leaderboard.tradeoff import Cost, Point, Tradeoff
from fpp_ml_bench.loaders.storage import benchmark_of

_WIDTH, _HEIGHT = 430, 380
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 10, 12, 46
_RADIUS = 4.0
_AXES: dict[Cost, tuple[str, float]] = {"seconds": ("time per view, ms", 1000.0), "frames": ("frames captured", 1.0)}
_CLASSES = {"classical": "t-classical", "phase": "t-phase", "networks": "t-networks"}


def tradeoff_section(tradeoff: Tradeoff | None) -> str:
    """HTML of the section; nothing without a trade-off, or where no setting has both an error and a time."""
    if tradeoff is None or not tradeoff.comparable():
        return ""
    height, width = tradeoff.image_size
    clock = "processor time" if tradeoff.settings.get("clock") == "processor" else "wall-clock time"
    loads = tradeoff.loads
    load = f", load {loads[0]:g} to {loads[-1]:g}" if loads else ""
    benchmark = benchmark_of(tradeoff.fingerprint)
    data = f"{tradeoff.dataset} ({tradeoff.fingerprint[:8]})" if benchmark is None else benchmark.title
    about = (
        f"{data}, {width} x {height} px, {len(tradeoff.views)} test views, against {tradeoff.target}; {clock}, "
        f"{tradeoff.settings.get('threads')} thread(s) of {tradeoff.hardware.cpu}{load}"
    )
    panels = "".join(_panel(tradeoff, cost) for cost in _AXES)
    return (
        '<section id="tradeoff"><h2>Every setting: error against run time and frames</h2>'
        f'<p class="soft small">{escaped(about, 400)}</p><figure><div class="pair">{panels}</div>'
        "<figcaption>Dashed: the fronts, where no other setting is both cheaper and more exact. "
        '<span class="t-classical">Circles: classical</span>, <span class="t-phase">squares: phase route</span>, '
        '<span class="t-networks">triangles: networks</span>; hollow: told the view\'s own depth range or mask, on no '
        "front. Only a few views: the rankings above use the whole split.</figcaption></figure>"
        f"{_front_table(tradeoff)}{_growth_words(tradeoff)}</section>\n"
    )


def _shown(tradeoff: Tradeoff) -> list[Point]:
    return [point for point in tradeoff.points if point.group in _CLASSES and point.seconds and point.object_mae_mm]


def _panel(tradeoff: Tradeoff, cost: Cost) -> str:
    """The picture of one cost, and the key of its numbers."""
    label, scale = _AXES[cost]
    points, front = _shown(tradeoff), tradeoff.front(cost)
    across = LogAxis.around([scale * getattr(point, cost) for point in points], _LEFT, _WIDTH - _RIGHT)
    up = LogAxis.around([point.object_mae_mm or 1.0 for point in points], _HEIGHT - _BOTTOM, _TOP)

    def place(point: Point) -> tuple[float, float]:
        return across.at(scale * getattr(point, cost)), up.at(point.object_mae_mm or 1.0)

    steps = [place(point) for point in front]
    parts = [_grid(across, up, label), _front_path(steps, across, up)]
    parts += [_marker(point, *place(point)) for point in points]
    labels = _front_labels(front, steps, [place(point) for point in points if point not in front], across)
    parts += [text.svg() for text in labels]
    about = f"Object MAE in mm against {label}, both logarithmic"
    return (
        f'<div><svg class="scatter" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{about}">'
        f"{''.join(parts)}</svg>{key_list(labels)}</div>"
    )


def _front_path(steps: list[tuple[float, float]], across: LogAxis, up: LogAxis) -> str:
    path = f"M{steps[0][0]:.1f} {up.end:.1f}" + "".join(f"H{x:.1f}V{y:.1f}" for x, y in steps)
    return f'<path class="front" d="{path}H{across.end:.1f}"/>'


def _front_labels(
    front: list[Point], steps: list[tuple[float, float]], off_front: list[tuple[float, float]], across: LogAxis
) -> list[Label]:
    """Names of the settings on the front, numbered from the cheapest; ``off_front``: places of the other marks."""
    lines: list[Box] = []
    for (x, y), following in zip(steps, [*steps[1:], None], strict=True):
        end = across.end if following is None else following[0]
        lines.append((x, y - 1, end, y + 1))
        if following is not None:
            lines.append((end - 1, y, end + 1, following[1]))
    marks = [
        Mark(cut_at_word(point.title), number, "", x, y, _RADIUS)
        for number, (point, (x, y)) in enumerate(zip(front, steps, strict=True), start=1)
    ]
    obstacles = [(x - _RADIUS, y - _RADIUS, x + _RADIUS, y + _RADIUS) for x, y in off_front]
    return place_labels(marks, lines, (_LEFT, 0, _WIDTH, _HEIGHT - _BOTTOM), obstacles)


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
    middle_x, middle_y = (_LEFT + _WIDTH - _RIGHT) / 2, (_TOP + _HEIGHT - _BOTTOM) / 2
    parts.append(f'<text x="{middle_x:.1f}" y="{_HEIGHT - 8}" text-anchor="middle">{label}</text>')
    parts.append(
        f'<text x="14" y="{middle_y:.1f}" text-anchor="middle" transform="rotate(-90 14 {middle_y:.1f})">'
        "object MAE, mm</text>"
    )
    return "".join(parts)


def _marker(point: Point, x: float, y: float) -> str:
    r = _RADIUS
    shapes = {
        "classical": f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{r}"/>',
        "phase": f'<path class="mark" d="M{x - r:.1f} {y - r:.1f}h{2 * r}v{2 * r}h{-2 * r}z"/>',
        "networks": f'<path class="mark" d="M{x:.1f} {y - r - 1:.1f}l{r + 1} {2 * r + 1}h{-2 * r - 2}z"/>',
    }
    hollow = " hollow" if point.given else ""
    title = f"{point.title}: {point.object_mae_mm:.3g} mm, {1000 * (point.seconds or 0):.3g} ms, {point.frames} frames"
    return (
        f'<g class="point {_CLASSES[point.group]}{hollow}"><title>{escaped(title, 300)}</title>'
        f"{shapes[point.group]}</g>"
    )


def _front_table(tradeoff: Tradeoff) -> str:
    by_time, by_frames = tradeoff.front("seconds"), tradeoff.front("frames")
    on_a_front = {id(point): point for point in (*by_time, *by_frames)}.values()
    lines = ""
    for point in sorted(on_a_front, key=lambda point: point.object_mae_mm or 0):
        fronts = " and ".join(name for name, front in (("time", by_time), ("frames", by_frames)) if point in front)
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
            f'<tr><th scope="row">{escaped(point.title, 120)}</th><td class="text">{fronts}</td>'
            f"{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>\n"
        )
    titles = ("Object MAE", "of measured px", "Not measured", "ms per view", "5th to 95th", "Frames")
    head = "".join(f'<th scope="col">{title}</th>' for title in titles)
    return (
        '<div class="scroll" tabindex="0" role="region" aria-label="The fronts"><table class="dense">'
        "<caption>On the front of time, of frames, or of both; errors in mm</caption><thead><tr>"
        f'<th scope="col" class="text">Setting</th><th scope="col" class="text">Front of</th>{head}</tr></thead>\n'
        f"<tbody>\n{lines}</tbody></table></div>"
    )


def _growth_words(tradeoff: Tradeoff) -> str:
    """A sentence about the costs that grow."""
    if not tradeoff.growth:
        return ""
    flagged = [f"{growth.stage} over {growth.over}" for growth in tradeoff.growth if growth.flag]
    steepest = max(tradeoff.growth, key=lambda growth: growth.exponent)
    words = (
        f"How costs grow: {len(tradeoff.growth)} stages were timed over pixels, frames, objects or rows; the steepest "
        f"power is {steepest.exponent:.2f} ({steepest.stage} over {steepest.over}). "
        f"Flagged as steep: {'; '.join(flagged) or 'none'}."
    )
    return f"<p>{escaped(words, 1500)}</p>"
