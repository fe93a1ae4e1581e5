"""The pictures of a trade-off: error against seconds and frames, error over image size, seconds over growing input."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.leaderboard.tradeoff.points import Cost, ErrorKey, Growth, Point, Tradeoff

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ERRORS: dict[ErrorKey, str] = {
    "object_mae_mm": "object MAE (mm); a missing pixel costs its whole depth",
    "measured_mae_mm": "MAE over measured object pixels (mm)",
}
_FAMILIES = (
    ("classical-vertical", "classical, vertical", "tab:blue", "o"),
    ("classical-horizontal", "classical, horizontal", "tab:cyan", "o"),
    ("classical-both", "classical, both", "tab:green", "o"),
    ("precision", "NumPy, float32 and float64", "tab:gray", "D"),
    ("phase", "phase route, one or few frames", "tab:orange", "s"),
    ("network", "networks", "tab:purple", "^"),
)
"""Start of the keys, name, colour and mark of each family; a point belongs to the first family that fits."""
_PLACES = ((5, 4), (5, -9), (-5, 4), (-5, -9), (0, 8), (0, -13), (9, 12), (9, -17), (-9, 12), (-9, -17))
"""Offsets of a label from its mark in points, the best first."""


def draw_tradeoff(tradeoff: Tradeoff, path: Path, error: ErrorKey = "object_mae_mm") -> bool:
    """Two panels on log axes with the front of each; False where no point can be drawn."""
    points = [point for point in tradeoff.points if point.group != "sizes" and point.seconds and getattr(point, error)]
    if not points:
        return False
    figure = _figure(13, 6.2)
    by_time, by_frames = figure.subplots(1, 2, sharey=True)
    panels: tuple[tuple[Axes, Cost, float], ...] = ((by_time, "seconds", 1000), (by_frames, "frames", 1))
    for axes, cost, scale in panels:
        front = tradeoff.front(cost, error)
        _families(axes, points, cost, error, scale)
        x = [scale * getattr(point, cost) for point in front]
        axes.step(x, [getattr(point, error) for point in front], where="post", color="black", lw=1.2, ls="--", zorder=1)
        _log(axes)
    by_time.set_ylabel(ERRORS[error])
    by_time.set_xlabel(f"milliseconds per view ({_clock(tradeoff)})")
    by_frames.set_xlabel("frames captured")
    height, width = tradeoff.image_size
    threads = tradeoff.settings.get("threads")
    figure.suptitle(
        f"{tradeoff.dataset}, {width}x{height} px, {len(tradeoff.views)} test views, against {tradeoff.target}; "
        f"{threads} thread(s) of {tradeoff.hardware.cpu}\n"
        "dashed: the front. Hollow: told the view's own depth range or mask, on no front",
        fontsize=9,
    )
    by_time.legend(fontsize=7.5, loc="best", framealpha=0.85)
    for axes, cost, scale in panels:
        front = tradeoff.front(cost, error)
        off_front = [point for point in points if point not in front and _named_off_front(point)]
        # A network's other precisions differ from its float32 in time: they are named in that panel, last.
        precisions = [point for point in off_front if point.group == "networks" and not _is_float32(point)]
        named = [*front, *(point for point in off_front if point not in precisions)]
        named += precisions if cost == "seconds" else []
        _label(
            axes, [(scale * getattr(p, cost), getattr(p, error), _short(p), p in front) for p in named],
            [(scale * getattr(p, cost), getattr(p, error)) for p in points],
        )  # fmt: skip
    _save(figure, path)
    return True


def draw_sizes(tradeoff: Tradeoff, path: Path) -> bool:
    """Error over image size, and against seconds; False without such points."""
    points = [point for point in tradeoff.points if point.group == "sizes" and point.seconds and point.measured_mae_mm]
    if not points:
        return False
    figure = _figure(11, 4.6)
    by_size, by_time = figure.subplots(1, 2, sharey=True)
    titles = dict.fromkeys(point.title for point in points)
    for title, colour in zip(titles, ("tab:green", "tab:blue", "tab:orange"), strict=False):
        line = [point for point in points if point.title == title]
        error = [point.measured_mae_mm for point in line]
        by_size.plot([point.image_px for point in line], error, "o-", color=colour, label=title)
        by_time.plot([1000 * (point.seconds or 0) for point in line], error, "o-", color=colour)
        for point in line:
            by_time.annotate(
                f"{point.image_px}", (1000 * (point.seconds or 0), point.measured_mae_mm or 0), fontsize=7.5,
                xytext=(4, 4), textcoords="offset points",
            )  # fmt: skip
    for axes in (by_size, by_time):
        axes.margins(x=0.08)
        _log(axes)
    by_size.set_xlabel("image width (px)")
    by_time.set_xlabel(f"milliseconds per view ({_clock(tradeoff)}); numbers: image width")
    sizes = sorted({point.image_px for point in points})
    by_size.set_xticks(sizes, [str(size) for size in sizes], minor=False)
    by_size.set_xticks([], minor=True)
    by_size.set_ylabel(ERRORS["measured_mae_mm"])
    by_size.legend(fontsize=8)
    _save(figure, path)
    return True


def _clock(tradeoff: Tradeoff) -> str:
    return "processor time" if tradeoff.settings.get("clock") == "processor" else "wall-clock time"


def draw_growth(growths: Sequence[Growth], path: Path) -> bool:
    """Seconds against pixels, frames, rows and objects, with the fitted powers; False where nothing was timed."""
    if not growths:
        return False
    panels: list[tuple[str, list[Growth]]] = [
        ("pixels: stages", [g for g in growths if g.over == "pixels" and ":" not in g.stage]),
        ("pixels: parts of stages", [g for g in growths if g.over == "pixels" and ":" in g.stage]),
        ("frames", [g for g in growths if g.over == "frames"]),
        ("rows or objects", [g for g in growths if g.over in ("rows", "objects")]),
    ]
    figure = _figure(15, 8.5)
    for axes, (title, lines) in zip(figure.subplots(2, 2).flat, panels, strict=True):
        for line in sorted(lines, key=lambda line: -line.seconds[-1]):
            over = f" over {line.over}" if title.startswith("rows") else ""
            label = f"{line.exponent:.2f}  {line.stage}{over}" + (" (!)" if line.flag else "")
            wide = 2.4 if line.flag else 1.2
            axes.plot(line.amounts, [1000 * s for s in line.seconds], "o-", ms=4, lw=wide, label=label)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel(title.split(":")[0])
        axes.set_ylabel("milliseconds")
        _log(axes)
        if lines:
            axes.legend(
                fontsize=7.5, title="fitted power, stage", title_fontsize=7.5, loc="upper left", bbox_to_anchor=(1, 1)
            )
    figure.suptitle("Least time of each stage as its input grows; (!): steeper than it should be", fontsize=10)
    _save(figure, path)
    return True


def _figure(width: float, height: float) -> "Figure":
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=110, layout="constrained")


def family(point: Point) -> str:
    """Start of the keys of the point's family."""
    return next((start for start, *_ in _FAMILIES if point.key.startswith(start)), _FAMILIES[-1][0])


def _families(axes: "Axes", points: Iterable[Point], cost: Cost, error: ErrorKey, scale: float) -> None:
    points = list(points)
    for start, name, colour, mark in _FAMILIES:
        mine = [point for point in points if family(point) == start]
        if not mine:
            continue
        label: str | None = name
        for chosen, face in (([p for p in mine if not p.given], colour), ([p for p in mine if p.given], "none")):
            x, y = [scale * getattr(p, cost) for p in chosen], [getattr(p, error) for p in chosen]
            line = "-" if start.startswith("classical") else ""
            axes.plot(
                x, y, mark + line, color=colour, mfc=face, ms=4.5 if line else 6, lw=0.8, alpha=0.85,
                label=label if chosen else None,
            )  # fmt: skip
            label = None if chosen else label
            if cost == "seconds":
                for point, up in zip(chosen, y, strict=True):
                    ends = [scale * (point.seconds_p5 or 0), scale * (point.seconds_p95 or 0)]
                    axes.plot(ends, [up, up], color=colour, lw=0.7, alpha=0.35, zorder=0)


def _named_off_front(point: Point) -> bool:
    """Whether a point off the front gets a name: of the classical settings, only the first and the last step count."""
    if point.group == "classical":
        return point.title.startswith(("classical N=3,", "classical N=18,"))
    return True


def _is_float32(point: Point) -> bool:
    return point.title.endswith(", fp32") or ", " not in point.title


def _short(point: Point) -> str:
    if point.group == "networks" and not _is_float32(point):
        return point.title.rsplit(", ", 1)[-1]
    return (
        point.title.removeprefix("phase ")
        .removeprefix("classical ")
        .replace(", fp32", "")
        .replace("predicted range", "predicted")
    )


def _label(axes: "Axes", named: Sequence[tuple[float, float, str, bool]], marks: Sequence[tuple[float, float]]) -> None:
    """A name beside each of ``named`` (x, y, text, on the front) that has room, in this order."""
    figure = axes.figure
    figure.canvas.draw()  # constrained layout has then placed the axes
    taken = [_box(float(x), float(y), 3) for x, y in map(axes.transData.transform, marks)]
    legend = axes.get_legend()
    if legend is not None:
        taken.append(legend.get_window_extent().extents)
    inside = axes.get_window_extent().extents
    for x, y, text, bold in named:
        for across, up in _PLACES:
            side = "left" if across > 0 else "right" if across < 0 else "center"
            label = axes.annotate(
                text, (x, y), xytext=(across, up), textcoords="offset points", ha=side, fontsize=7,
                fontweight="bold" if bold else "normal",
            )  # fmt: skip
            box = label.get_window_extent().extents
            within = box[0] > inside[0] and box[2] < inside[2] and box[1] > inside[1] and box[3] < inside[3]
            if within and not any(_overlap(box, occupied) for occupied in taken):
                taken.append(box)
                break
            label.remove()


def _box(x: float, y: float, half: float) -> tuple[float, float, float, float]:
    return x - half, y - half, x + half, y + half


def _overlap(first: Sequence[float], second: Sequence[float]) -> bool:
    return bool(first[0] < second[2] and second[0] < first[2] and first[1] < second[3] and second[1] < first[3])


def _log(axes: "Axes") -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.grid(True, which="both", alpha=0.2)
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        within_a_decade_or_two = high < 300 * low
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if within_a_decade_or_two else (1,)))
        axis.set_major_formatter(FuncFormatter(_plain))
        axis.set_minor_formatter(NullFormatter())
    axes.tick_params(which="both", labelsize=8)


_plain: Callable[[float, int], str] = lambda value, place: f"{value:g}" if value < 1e6 else f"{value:.0e}"  # noqa: E731


def _save(figure: "Figure", path: Path) -> None:
    try:
        figure.savefig(path)
    except OSError as error:
        raise SubmissionError(f"{path} can't be written: {error.strerror}") from None
