"""A trade-off as tables and pictures, and the one drawing of error against a cost: log axes,
intervals as whiskers, the front as steps, and at the marks their names, or numbers that a key
explains; into matplotlib axes, or as SVG for pages.
"""

import io
import math
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator
from matplotlib.transforms import Bbox

from fpp_ml_bench.baselines.tradeoff.measure import (
    COST_KEYS,
    TRADEOFF_FILE,
    Cost,
    Point,
    Tradeoff,
    pareto_front,
    power,
)
from fpp_ml_bench.evaluation.result.file import write_file
from fpp_ml_bench.files import printable
from fpp_ml_bench.style import (
    GRID,
    INK,
    LINE_COLOURS,
    SOFT,
    escaped,
    figure,
    figure_png,
    millimetres,
    own_settings,
    percent,
    styled,
    three_digits,
)
from fpp_ml_bench.tables import Table

COSTS: dict[Cost, tuple[str, float, str]] = {
    "seconds": ("time", 1000.0, "milliseconds per view"),
    "frames": ("frames", 1.0, "frames captured"),
    "working_memory_mib": ("memory", 1.0, "working memory, MiB"),
}
"""Each cost in a word, the factor to what is shown, and the title of its axis."""
_KEY_COLUMNS = 5

COLOURS = {
    "ink": INK,
    "soft": SOFT,
    "line": GRID,
    "panel": "#ffffff",
    "front": "#b84a00",
    "measured": "#0b6b50",
    "verified": "#1b5bb8",
    "reported": "#8a4b00",
}
"""Colours of a page in light by the names of its style; in SVG they follow the page into its dark
scheme."""
_IN_PAGE = {colour: f"var(--{name})" for name, colour in COLOURS.items()}

_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 18, 14, 48
_RADIUS = 4.0
_CHARACTER, _LINE, _PADDING = 0.56, 1.25, 0.17
"""Width of a character, height of a line and room beside a label, in font sizes; wider than most
fonts, so that a name that fits here fits everywhere."""
_NAME_GAP, _NUMBER_GAPS = 5.0, (3.0, 12.0, 22.0, 34.0, 48.0)
"""From the mark to its name and its number, in points; from the second number's on a thin line
joins them."""
_DIRECTIONS = 16
_MOST_LABELLED = 100
"""Marks up to which a picture has labels: finding room for them takes quadratic time."""
Place = tuple[float, float]


@dataclass(frozen=True)
class Mark:
    """A mark at a cost ``x`` and an error ``y``, both above 0, with the intervals of both.
    ``colour``: of `COLOURS` or of matplotlib. ``number``: unique in a drawing, ``name`` explains it
    in the key. ``can_lead``: whether it may be on the front. For a page: ``title`` under the mouse,
    ``css`` classes, ``row``: id of the row that it belongs to, ``url``: its page."""

    x: float
    y: float
    number: int
    name: str
    colour: str
    shape: str = "o"
    hollow: bool = False
    can_lead: bool = True
    x_span: tuple[float, float] | None = None
    y_span: tuple[float, float] | None = None
    title: str = ""
    css: str = ""
    row: str = ""
    url: str | None = None


@dataclass(frozen=True)
class Scatter:
    """``marks`` of errors titled ``up`` over a cost whose axis is titled ``across``. They get
    labels as far as there is room, those of the front first: their ``names``, or else their
    numbers."""

    marks: Sequence[Mark]
    across: str
    names: bool = True
    up: str = "object MAE, mm"

    @property
    def front(self) -> list[Mark]:
        """The marks that no other beats, the cheapest first."""
        leading = [mark for mark in self.marks if mark.can_lead]
        return [leading[index] for index in pareto_front([(mark.x, mark.y) for mark in leading])]

    def draw(self, axes: Axes) -> None:
        """Draw into ``axes``, whose place in the figure is fixed."""
        axes.set(xlabel=self.across, ylabel=self.up, xscale="log", yscale="log")
        left, right = axes.set_xlim(
            _ends([end for m in self.marks for end in (m.x, *(m.x_span or ()))])
        )
        bottom, top = axes.set_ylim(
            _ends([end for m in self.marks for end in (m.y, *(m.y_span or ()))])
        )
        _round_numbers(axes)
        steps: list[Place] = []
        for (
            mark
        ) in self.front:  # between two points of the front, the error stays that of the cheaper one
            steps += [(mark.x, steps[-1][1] if steps else top), (mark.x, mark.y)]
        steps += [(right, steps[-1][1])] if steps else []
        axes.plot(
            *zip(*steps, strict=True) if steps else ([], []),
            "--",
            color=COLOURS["front"],
            lw=1.5,
            zorder=1,
        )
        lines = _boxes(axes, steps)
        for mark in self.marks:
            colour = COLOURS.get(mark.colour, mark.colour)
            across = [
                (max(x, left), mark.y) for x in mark.x_span or ()
            ]  # an end at 0 is off the axis: up to its edge
            up = [(mark.x, max(y, bottom)) for y in mark.y_span or ()]
            lines += _boxes(axes, across) + _boxes(axes, up)
            pen_up = (math.nan, math.nan)
            axes.plot(
                *zip((mark.x, mark.y), pen_up, *across, pen_up, *up, strict=True),
                mark.shape + "-",
                markevery=[0],
                ms=2 * _RADIUS,
                mew=1.5,
                lw=1.25,
                color=to_rgba(colour, 0.55),
                mec=colour,
                mfc=to_rgba(COLOURS["panel"], 0.8) if mark.hollow else to_rgba(colour, 0.55),
                clip_on=False,
                gid=f"mark-{mark.number}",
                url=mark.url,
                zorder=2,
            )
        if len(self.marks) <= _MOST_LABELLED:
            self._label(axes, lines)

    def _label(self, axes: Axes, lines: Sequence[Bbox]) -> None:
        """No label covers a mark or another label or leaves the axes. A name does not cover
        ``lines`` either, a number where possible."""
        px = axes.figure.dpi / 72
        size = matplotlib.rcParams["font.size"] * px
        at = axes.transData.transform([(mark.x, mark.y) for mark in self.marks])
        taken = [Bbox([xy - _RADIUS * px, xy + _RADIUS * px]) for xy in at]
        places = {mark.number: place for mark, place in zip(self.marks, at, strict=True)}
        front = self.front
        for mark in [*front, *(mark for mark in self.marks if mark not in front)]:
            tries = [(mark.name, _NAME_GAP, lines)] if self.names else []
            tries += [(str(mark.number), gap, more) for more in (lines, ()) for gap in _NUMBER_GAPS]
            for text, gap, more in tries:
                half = ((_CHARACTER * len(text) / 2 + _PADDING) * size, _LINE * size / 2)
                box = free_box(
                    places[mark.number], half, (_RADIUS + gap) * px, [*taken, *more], axes.bbox
                )
                if box is None:
                    continue
                offset = (box.get_points().mean(axis=0) - places[mark.number]) / px
                line = {
                    "arrowstyle": "-",
                    "lw": 0.75,
                    "color": COLOURS["soft"],
                    "shrinkA": 0,
                    "shrinkB": _RADIUS,
                }
                axes.annotate(
                    text,
                    (mark.x, mark.y),
                    tuple(offset),
                    textcoords="offset points",
                    ha="center",
                    va="center",
                    color=COLOURS["ink"],
                    gid=f"label-{mark.number}",
                    arrowprops=line | {"gid": f"label-{mark.number}"}
                    if gap >= _NUMBER_GAPS[1]
                    else None,
                )
                taken.append(box)
                break

    def svg(self, width: int, height: int, css: str, about: str) -> str:
        """An ``svg`` element of ``width`` by ``height`` px in the page's colours. It is styled by
        attributes and by the page, which forbids style of its own. ``css``, its classes, and
        ``about``, its description, tell it from other pictures of the page."""
        text = io.StringIO()
        with own_settings({"svg.fonttype": "none", "svg.hashsalt": css + about, "font.size": 12}):
            figure = Figure(figsize=(width / 72, height / 72), dpi=72)
            inner = width - _LEFT - _RIGHT, height - _TOP - _BOTTOM
            axes = figure.add_axes(
                (_LEFT / width, _BOTTOM / height, inner[0] / width, inner[1] / height)
            )
            axes.yaxis.set_label_coords(17 / width, 0.5, figure.transFigure)
            axes.patch.set_visible(False)
            figure.patch.set_visible(False)
            self.draw(axes)
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "Glyph .* missing")  # the browser's fonts have it
                figure.savefig(text, format="svg", metadata={"Date": None})
        groups = {}
        for mark in self.marks:
            row = f' data-row="{escaped(mark.row)}"' if mark.row else ""
            title = f"<title>{escaped(mark.title, 300)}</title>" if mark.title else ""
            groups[f"mark-{mark.number}"] = (
                f'<g class="{escaped(f"point {mark.css}".strip())}"{row}>{title}'
            )
            groups[f"label-{mark.number}"] = f'<g class="name"{row}>'
        content = text.getvalue()
        content = content[content.index("<g ") : content.rindex("</g>") + len("</g>")]
        content = re.sub(r"<[^>]*>", lambda match: _for_page(match[0], groups), content)
        content = re.sub(r"\s*\n\s*", " ", content)
        head = f'<svg class="{css}" viewBox="0 0 {width} {height}" role="img" aria-label="{escaped(about, 5000)}">'
        return f"{head}{content}</svg>"


def _round_numbers(axes: Axes) -> None:
    """A grid and round numbers on log axes, more of them on a short axis."""
    axes.grid(True, color=COLOURS["line"], lw=0.8)
    axes.set_axisbelow(True)
    for axis in (axes.xaxis, axes.yaxis):
        axis.label.set_color(COLOURS["soft"])
        low, high = axis.get_view_interval()
        factors = (
            (1, 1.5, 2, 3, 4, 5, 7) if high < 10 * low else (1, 2, 5) if high < 300 * low else (1,)
        )
        axis.set_major_locator(LogLocator(subs=factors))
        axis.set_major_formatter("{x:g}")
    axes.minorticks_off()  # ticks of no length take half of the time
    axes.tick_params(length=0, labelcolor=COLOURS["soft"])
    for spine in axes.spines.values():
        spine.set_color(COLOURS["line"])


def free_box(
    at: Place, half: Place, gap: float, avoided: Sequence[Bbox], inside: Bbox
) -> Bbox | None:
    """The first box of half the size ``half``, by ``gap`` away from ``at``, that covers nothing of
    ``avoided`` and is ``inside``, to the right of ``at`` first. All in px."""
    for turn in np.arange(_DIRECTIONS) * math.tau / _DIRECTIONS:
        middle = at + (gap + np.array(half)) * np.clip(
            (1.45 * math.cos(turn), 1.45 * math.sin(turn)), -1, 1
        )
        box = Bbox([middle - half, middle + half])
        within = np.all(box.min >= inside.min) and np.all(box.max <= inside.max)
        if within and not (avoided and box.count_overlaps(avoided)):
            return box
    return None


def _ends(values: Sequence[float]) -> tuple[float, float]:
    """Of an axis over all positive ``values`` with a margin, over at least a factor of 2."""
    positive = [value for value in values if value > 0]
    span = math.log(max(positive) / min(positive))
    margin = max(0.08 * span, 0.5 * (math.log(2) - span), 0.05)
    return min(positive) * math.exp(-margin), max(positive) * math.exp(margin)


def _boxes(axes: Axes, line: Sequence[Place]) -> list[Bbox]:
    """Boxes around the straight parts of ``line``, in px."""
    places = np.asarray(axes.transData.transform(line) if line else [])
    return [Bbox(np.sort(ends, axis=0)).padded(1) for ends in pairwise(places)]


def _for_page(tag: str, groups: dict[str, str]) -> str:
    """A tag of matplotlib's SVG for a page: groups as ``groups`` has them, style as attributes,
    fonts left to the page, links for the mouse alone (the page's table has them for everyone)."""
    if tag.startswith("<g"):
        return groups.get(re.sub(r'.* id="([^"]*)".*', r"\1", tag, flags=re.DOTALL), "<g>")
    shared = ' id="' in tag  # the shape of a mark, which takes its style where it is used
    style = re.search(r' style="([^"]*)"', tag)
    parts = (part.partition(": ") for part in style[1].split("; ")) if style and not shared else ()
    attributes = "".join(
        f' {name}="{_IN_PAGE.get(value, value)}"' for name, _, value in parts if "font" not in name
    )
    tag = tag.replace(style[0], attributes) if style else tag
    tag = tag.replace(' target="_blank"', ' tabindex="-1" aria-hidden="true"')
    tag = re.sub(r' (clip-path|transform)="(url|rotate\(-0)[^"]*"', "", tag)
    return re.sub(r"(\.\d\d)\d+", r"\1", tag)


def point_table(run: Tradeoff) -> Table:
    """Every point, and the fronts that it is on."""
    height, width = run.image_size
    clock = "processor" if run.settings.get("clock") == "processor" else "wall-clock"
    about = (
        f"{run.dataset}, {width} x {height} px, {len(run.views)} test views, against {run.target}; "
        f"{clock} time, "
        f"{run.settings.get('threads')} thread(s) of {run.hardware.cpu}"
    )
    fronts = {COSTS[cost][0]: run.front(cost) for cost in COST_KEYS}
    rows = [
        {
            "Method": printable(point.label),
            "Front of": ", ".join(word for word, front in fronts.items() if point in front)
            or point.off_front_reason
            or "",
            "Object MAE, mm": millimetres(point.object_mae_mm),
            "Not measured": percent(point.missing_share),
            "ms per view": _ms(point.seconds),
            "Frames": str(point.frames or "-"),
            "Memory, MiB": three_digits(point.working_memory_mib),
        }
        for point in run.points
    ]
    return Table.of(about, rows, elsewhere="tradeoff.md")


def growth_table(run: Tradeoff) -> Table:
    """How the time of every point that was measured grows. The power of frames is over the points
    of its method that have the same options with other values, such as numbers of steps."""

    def alike(point: Point) -> Iterator[tuple[int, float]]:
        for other in run.points:
            if other.method == point.method and other.options.keys() == point.options.keys():
                yield other.frames, other.seconds or 0

    title = (
        f"How time grows: powers p of seconds = c amount^p; timed at "
        f"{', '.join(f'{n:,}' for n in run.pixels)} px"
    )
    rows = [
        {
            "Method": printable(point.label),
            "ms at each size": ", ".join(map(_ms, point.pixel_seconds or ())) or "-",
            "Power of pixels": three_digits(
                power(zip(run.pixels, point.pixel_seconds or (), strict=False))
            ),
            "Power of frames": three_digits(power(alike(point))),
            "ms per view in a batch": _ms(point.batch_seconds),
        }
        for point in run.points
        if point.seconds
    ]
    return Table.of(title, rows, elsewhere="tradeoff.md")


def _ms(seconds: float | None) -> str:
    return three_digits(None if seconds is None else 1000 * seconds)


def scatter(run: Tradeoff, cost: Cost) -> Scatter | None:
    """Object MAE against ``cost`` of every point that has both, a colour for each method, hollow
    where it is on no front by rule. Numbered in the order of the points as far as there is room.
    None where no point has both."""
    methods = list(dict.fromkeys(point.method for point in run.points))
    marks = [
        Mark(
            COSTS[cost][1] * x,
            point.object_mae_mm,
            number,
            printable(point.label),
            LINE_COLOURS[methods.index(point.method) % len(LINE_COLOURS)],
            hollow=bool(point.off_front_reason),
            can_lead=not point.off_front_reason,
        )
        for number, point in enumerate(run.points, start=1)
        if (x := getattr(point, cost)) and point.object_mae_mm
    ]
    return Scatter(marks, COSTS[cost][2], names=False) if marks else None


@styled
def draw_tradeoff(run: Tradeoff) -> Figure | None:
    """A panel for each cost on log axes, with its front, and a key of the numbers; None where no
    point can be drawn."""
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
    drawn.suptitle(
        f"{point_table(run).title}\ndashed: the front; hollow: given ground truth of the view, or "
        f"trivial"
    )
    return drawn


def write_report(run: Tradeoff, out: Path) -> list[Path]:
    """Write the tables and the picture beside ``out/tradeoff.json``; returns all files.
    SubmissionError where one can't be written."""
    written = [out / TRADEOFF_FILE, out / "tradeoff.md"]
    lines = []
    for table in (point_table(run), growth_table(run)):
        lines += [str(table.title), "", *table.markdown(), ""]
    write_file("\n".join(lines).encode("utf-8"), written[1])
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
