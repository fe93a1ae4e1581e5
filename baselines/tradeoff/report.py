"""A trade-off as tables and pictures: the points with their fronts, and how costs grow."""

from collections.abc import Iterator
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from rich.text import Text

from fpp_ml_bench.baselines.tradeoff.drawing import Mark, Scatter
from fpp_ml_bench.baselines.tradeoff.measure import COST_KEYS, TRADEOFF_FILE, Cost, Point, Tradeoff, power
from fpp_ml_bench.evaluation.result.file import write_file
from fpp_ml_bench.files import printable
from fpp_ml_bench.style import LINE_COLOURS, figure, figure_png, millimetres, percent, styled
from fpp_ml_bench.tables import Table

COSTS: dict[Cost, tuple[str, float, str]] = {
    "seconds": ("time", 1000.0, "milliseconds per view"),
    "frames": ("frames", 1.0, "frames captured"),
    "working_memory_mib": ("memory", 1.0, "working memory, MiB"),
}
"""Each cost in a word, the factor to what is shown, and the title of its axis."""
POINTS = ("Method", "Front of", "Object MAE, mm", "Not measured", "ms per view", "Frames", "Memory, MiB")
GROWTH = ("Method", "ms at each size", "Power of pixels", "Power of frames", "ms per view in a batch")
TEXT_COLUMNS = 2
_KEY_COLUMNS = 5


def point_rows(run: Tradeoff) -> list[list[str]]:
    """Cells of every point under `POINTS`."""
    fronts = {COSTS[cost][0]: run.front(cost) for cost in COST_KEYS}
    return [
        [
            printable(point.label),
            ", ".join(name for name, front in fronts.items() if point in front) or point.off_front_reason or "",
            millimetres(point.object_mae_mm),
            percent(point.missing_share),
            _ms(point.seconds),
            str(point.frames or "-"),
            _number(point.working_memory_mib),
        ]
        for point in run.points
    ]


def growth_rows(run: Tradeoff) -> list[list[str]]:
    """Cells of every point that was measured under `GROWTH`. The power of frames is over the points of its method that
    have the same options with other values, such as numbers of steps."""

    def alike(point: Point) -> Iterator[tuple[int, float]]:
        for other in run.points:
            if other.method == point.method and other.options.keys() == point.options.keys():
                yield other.frames, other.seconds or 0

    return [
        [
            printable(point.label),
            ", ".join(map(_ms, point.pixel_seconds or ())) or "-",
            _number(power(zip(run.pixels, point.pixel_seconds or (), strict=False))),
            _number(power(alike(point))),
            _ms(point.batch_seconds),
        ]
        for point in run.points
        if point.seconds
    ]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"


def _ms(seconds: float | None) -> str:
    return _number(None if seconds is None else 1000 * seconds)


def tables(run: Tradeoff) -> list[tuple[str, tuple[str, ...], list[list[str]]]]:
    """Title, heads and rows of both tables."""
    height, width = run.image_size
    clock = "processor" if run.settings.get("clock") == "processor" else "wall-clock"
    about = (
        f"{run.dataset}, {width} x {height} px, {len(run.views)} test views, against {run.target}; {clock} time, "
        f"{run.settings.get('threads')} thread(s) of {run.hardware.cpu}"
    )
    growth = f"How time grows: powers p of seconds = c amount^p; timed at {', '.join(f'{n:,}' for n in run.pixels)} px"
    return [(about, POINTS, point_rows(run)), (growth, GROWTH, growth_rows(run))]


def rich_tables(run: Tradeoff) -> list[Table]:
    """Both tables for a terminal."""
    shown = []
    for title, heads, rows in tables(run):
        table = Table(*heads[:TEXT_COLUMNS], numbers=heads[TEXT_COLUMNS:], title=Text(title), elsewhere="tradeoff.md")
        for row in rows:
            table.add_row(*map(Text, row))
        shown.append(table)
    return shown


def markdown(run: Tradeoff) -> str:
    """Both tables as Markdown."""
    lines = []
    for title, heads, rows in tables(run):
        rules = ["---" if number < TEXT_COLUMNS else "---:" for number in range(len(heads))]
        cells = [[cell.replace("|", "\\|") for cell in row] for row in rows]
        lines += [title, "", *(f"| {' | '.join(row)} |" for row in (heads, rules, *cells)), ""]
    return "\n".join(lines)


def scatter(run: Tradeoff, cost: Cost) -> Scatter | None:
    """Object MAE against ``cost`` of every point that has both, a colour for each method, hollow where it is on no
    front by rule. Numbered in the order of the points as far as there is room, the front first. None where no point has
    both."""
    front, methods = run.front(cost), list(dict.fromkeys(point.method for point in run.points))
    marks: list[Mark] = []
    for point in [*front, *(point for point in run.points if point not in front)]:
        if (x := getattr(point, cost)) and point.object_mae_mm:
            marks.append(
                Mark(
                    COSTS[cost][1] * x,
                    point.object_mae_mm,
                    run.points.index(point) + 1,
                    printable(point.label),
                    LINE_COLOURS[methods.index(point.method) % len(LINE_COLOURS)],
                    hollow=bool(point.off_front_reason),
                    title=f"{point.title}: {point.object_mae_mm:.3g} mm, {_ms(point.seconds)} ms",
                )
            )
    return Scatter(marks, marks[: len(front)], COSTS[cost][2], marks, names=False) if marks else None


@styled
def draw_tradeoff(run: Tradeoff) -> Figure | None:
    """A panel for each cost on log axes, with its front, and a key of the numbers; None where no point can be drawn."""
    pictures = [picture for cost in COST_KEYS if (picture := scatter(run, cost))]
    if not pictures:
        return None
    lines = -(-len(run.points) // _KEY_COLUMNS)
    height_in = 5.8 + 0.2 * lines
    drawn = figure(14, height_in, layout=None)
    drawn.subplots_adjust(0.045, (0.6 + 0.2 * lines) / height_in, 0.99, 1 - 0.6 / height_in, 0.15)
    for number, picture in enumerate(pictures, start=1):
        picture.draw(drawn.add_subplot(1, len(pictures), number))
    marks = {mark.number: mark for picture in pictures for mark in picture.marks}
    key = [
        Line2D(
            [],
            [],
            marker="o",
            ls="",
            color=mark.colour,
            mfc="white" if mark.hollow else None,
            label=f"{n}  {mark.name}".replace("$", r"\$"),
        )
        for n, mark in sorted(marks.items())
    ]
    drawn.legend(handles=key, ncols=_KEY_COLUMNS, loc="lower center", handletextpad=0.2)
    drawn.suptitle(f"{tables(run)[0][0]}\ndashed: the front; hollow: given ground truth of the view, or trivial")
    return drawn


def write_report(run: Tradeoff, out: Path) -> list[Path]:
    """Write the tables and the picture beside ``out/tradeoff.json``; returns all files. SubmissionError where one
    can't be written."""
    written = [out / TRADEOFF_FILE, out / "tradeoff.md"]
    write_file(markdown(run).encode("utf-8"), written[1])
    if drawn := draw_tradeoff(run):
        written.append(out / "tradeoff.png")
        write_file(figure_png(drawn, reduced=True), written[-1])
    return written


def remarks(run: Tradeoff) -> list[str]:
    """Which points could not be measured, or not at other sizes, and why."""
    return [
        f"Not measured{' at other sizes' if point.seconds else ''}: {point.label}: {point.failed}"
        for point in run.points
        if point.failed
    ]
