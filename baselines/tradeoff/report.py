"""A trade-off as files and tables: tradeoff.json, two CSVs, four pictures, and the terminal's tables."""

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from fpp_ml_bench.baselines.tradeoff import points as results
from fpp_ml_bench.baselines.tradeoff.drawing import Mark, Scatter, log_axes
from fpp_ml_bench.baselines.tradeoff.points import COST_KEYS, Cost, ErrorKey, Growth, Point, Tradeoff
from fpp_ml_bench.baselines.tradeoff.settings import Plan
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.result import write_json
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.tables import Table

ERRORS: dict[ErrorKey, str] = {
    "object_mae_mm": "object MAE (mm); a missing pixel costs its whole depth",
    "measured_mae_mm": "MAE over measured object pixels (mm)",
}
FAMILIES = (
    ("classical-vertical", "classical, vertical", "tab:blue", "o"),
    ("classical-horizontal", "classical, horizontal", "tab:cyan", "o"),
    ("classical-both", "classical, both", "tab:green", "o"),
    ("precision", "NumPy, float32 and float64", "tab:gray", "D"),
    ("phase", "phase route, one or few frames", "tab:orange", "s"),
    ("network", "networks", "tab:purple", "^"),
)
"""Start of the keys, name, colour and mark of each family; a point belongs to the first family that fits."""


def scatter(run: Tradeoff, cost: Cost, error: ErrorKey = "object_mae_mm", all_named: bool = False) -> Scatter | None:
    """``error`` against ``cost`` (ms or frames) of every setting on the dataset's own views, hollow where it was told
    something of the view. The settings on the front are labelled; with ``all_named`` those off it too, as far as there
    is room, and none by a number. None where no setting has both figures."""
    front = run.front(cost, error)
    points = [point for point in run.points if point.group != "sizes" and point.seconds and getattr(point, error)]
    points = [*front, *(point for point in points if point not in front)]
    marks, named, named_last = [], [], []
    for number, point in enumerate(points, start=1):
        _, _, colour, shape = _family(point)
        (ms, low, high), y = point.ms, getattr(point, error)
        title = f"{point.title}: {y:.3g} mm, {ms:.3g} ms, {point.frames} frames"
        x, span = (ms, (low, high)) if cost == "seconds" else (float(point.frames), None)
        marks.append(Mark(x, y, number, _short(point), colour, shape, 3.5, bool(point.given), span, None, title))
        if _other_precision(point):
            # A network's other precisions differ from its float32 in time: they are named in that panel, last.
            named_last += [marks[-1]] if cost == "seconds" else []
        elif point.group != "classical" or point.title.startswith(("classical N=3,", "classical N=18,")):
            named.append(marks[-1])
    if not marks:
        return None
    across = f"milliseconds per view ({run.clock})" if cost == "seconds" else "frames captured"
    on_front = marks[: len(front)]
    if not all_named:
        return Scatter(marks, on_front, across, on_front)
    up = ERRORS[error] if cost == "seconds" else ""
    return Scatter(marks, on_front, across, list(dict.fromkeys([*on_front, *named, *named_last])), up, numbers=False)


def _family(point: Point) -> tuple[str, str, str, str]:
    return next((each for each in FAMILIES if point.key.startswith(each[0])), FAMILIES[-1])


def _other_precision(point: Point) -> bool:
    """Whether it is a network in another precision than float32."""
    return point.group == "networks" and ", " in point.title and not point.title.endswith(", fp32")


def _short(point: Point) -> str:
    if _other_precision(point):
        return point.title.rsplit(", ", 1)[-1]
    short = point.title.removeprefix("phase ").removeprefix("classical ")
    return short.replace(", fp32", "").replace("predicted range", "predicted")


def draw_tradeoff(tradeoff: Tradeoff, error: ErrorKey = "object_mae_mm") -> Figure | None:
    """Two panels on log axes with the front of each; None where no point can be drawn."""
    figure = Figure(figsize=(13, 6.2), dpi=110)
    figure.subplots_adjust(0.05, 0.12, 0.99, 0.91, 0.06)
    panels = figure.subplots(1, 2)
    for cost, axes in zip(COST_KEYS, panels, strict=True):
        picture = scatter(tradeoff, cost, error, all_named=True)
        if picture is None:
            return None
        for family in FAMILIES:
            points = [point for point in tradeoff.points if point.group != "sizes" and _family(point) == family]
            places = [(point.ms[0] if cost == "seconds" else point.frames, getattr(point, error)) for point in points]
            places = [place for place in places if all(place)]
            if places:  # a line through the steps of a classical direction; the marks are drawn with the others
                start, name, colour, shape = family
                form = shape + ("-" if start.startswith("classical") else "")
                axes.plot(*zip(*places, strict=True), form, color=colour, lw=0.8, markevery=[], label=name)
        picture.draw(axes)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="lower center", ncols=len(FAMILIES), frameon=False)
    height, width = tradeoff.image_size
    figure.suptitle(
        f"{tradeoff.dataset}, {width}x{height} px, {len(tradeoff.views)} test views, against {tradeoff.target}; "
        f"{tradeoff.settings.get('threads')} thread(s) of {tradeoff.hardware.cpu}\n"
        "dashed: the front. Hollow: told the view's own depth range or mask, on no front"
    )
    return figure


def draw_sizes(tradeoff: Tradeoff) -> Figure | None:
    """Error over image size, and against seconds; None without such points."""
    points = [point for point in tradeoff.points if point.group == "sizes" and point.seconds and point.measured_mae_mm]
    if not points:
        return None
    figure = Figure(figsize=(11, 4.6), dpi=110, layout="constrained")
    by_size, by_time = figure.subplots(1, 2)
    for title in dict.fromkeys(point.title for point in points):
        line = [point for point in points if point.title == title]
        error = [point.measured_mae_mm for point in line]
        by_size.plot([point.image_px for point in line], error, "o-", label=title)
        by_time.plot([point.ms[0] for point in line], error, "o-")
        for point in line:
            place = point.ms[0], point.measured_mae_mm or 0
            by_time.annotate(f"{point.image_px}", place, (4, 4), textcoords="offset points")
    by_size.set(xlabel="image width (px)", ylabel=ERRORS["measured_mae_mm"])
    by_time.set_xlabel(f"milliseconds per view ({tradeoff.clock}); numbers: image width")
    log_axes(by_size)
    log_axes(by_time)
    sizes = sorted({point.image_px for point in points})
    by_size.set_xticks(sizes, list(map(str, sizes)))
    by_size.legend()
    return figure


def draw_growth(growths: Sequence[Growth]) -> Figure | None:
    """Seconds against pixels, frames, rows and objects, with the fitted powers; None where nothing was timed."""
    if not growths:
        return None
    stages = [growth for growth in growths if growth.over == "pixels" and ":" not in growth.stage]
    panels = {
        "pixels: stages": stages,
        "pixels: parts of stages": [growth for growth in growths if growth.over == "pixels" and growth not in stages],
        "frames": [growth for growth in growths if growth.over == "frames"],
        "rows or objects": [growth for growth in growths if growth.over in ("rows", "objects")],
    }
    figure = Figure(figsize=(15, 8.5), dpi=110, layout="constrained")
    for axes, (title, lines) in zip(figure.subplots(2, 2).flat, panels.items(), strict=True):
        for line in sorted(lines, key=lambda line: -line.seconds[-1]):
            over = f" over {line.over}" if title.startswith("rows") else ""
            label = f"{line.exponent:.2f}  {line.stage}{over}" + (" (!)" if line.flag else "")
            ms = [1000 * seconds for seconds in line.seconds]
            axes.plot(line.amounts, ms, "o-", ms=4, lw=2.4 if line.flag else 1.2, label=label)
        axes.set(title=title, xlabel=title.split(":")[0], ylabel="milliseconds")
        log_axes(axes)
        if axes.lines:
            axes.legend(title="fitted power, stage", loc="upper left", bbox_to_anchor=(1, 1))
    figure.suptitle("Least time of each stage as its input grows; (!): steeper than it should be")
    return figure


PICTURES: dict[str, Callable[[Tradeoff], Figure | None]] = {
    "tradeoff.png": draw_tradeoff,
    "tradeoff_measured.png": lambda tradeoff: draw_tradeoff(tradeoff, "measured_mae_mm"),
    "sizes.png": draw_sizes,
    "costs.png": lambda tradeoff: draw_growth(tradeoff.growth),
}
"""Name of each picture and the function that draws it, where there is something to draw."""


def write_report(tradeoff: Tradeoff, out: Path) -> list[Path]:
    """Write everything into folder ``out``; returns the files. SubmissionError where one can't be written."""
    content = tradeoff.model_dump(mode="json")
    content["points"] = [point.model_dump(mode="json", exclude_none=True) for point in tradeoff.points]
    written = [out / results.TRADEOFF_FILE]
    write_json(content, written[0])
    texts = {"tradeoff.csv": points_csv(tradeoff), "costs.csv": growth_csv(tradeoff.growth)}
    try:
        for name, text in texts.items():
            if text.count("\n") > 1:
                written.append(out / name)
                write_atomically(out / name, text.encode("utf-8"))
        with matplotlib.rc_context({"font.size": 8, "figure.titlesize": 9}):
            for name, draw in PICTURES.items():
                if figure := draw(tradeoff):
                    written.append(out / name)
                    figure.savefig(out / name)
    except OSError as error:
        raise SubmissionError(f"{written[-1]} can't be written: {error.strerror}") from None
    return written


def points_csv(tradeoff: Tradeoff) -> str:
    """A line for each setting; ``front_seconds`` and ``front_frames``: on the front of object MAE; ``slowed``: the
    machine was busier at that time than in the run's median."""
    fronts = [tradeoff.front(cost) for cost in COST_KEYS]
    names = [name for name in Point.model_fields if name != "interval_mm"]
    head = [*names, "interval_low_mm", "interval_high_mm", "front_seconds", "front_frames", "slowed"]
    return _csv(
        head,
        (
            [
                *(getattr(point, name) for name in names),
                *(point.interval_mm or (None, None)),
                *(point in front for front in fronts),
                tradeoff.slowed(point),
            ]
            for point in tradeoff.points
        ),
    )


def growth_csv(growths: Iterable[Growth]) -> str:
    """A line for each stage and amount, with the stage's fitted power."""
    return _csv(
        ["stage", "over", "amount", "seconds", "exponent", "low", "high", "tail", "flag"],
        (
            [line.stage, line.over, amount, seconds, line.exponent, line.low, line.high, line.tail, line.flag]
            for line in growths
            for amount, seconds in zip(line.amounts, line.seconds, strict=True)
        ),
    )


def _csv(head: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    cells: dict[type, Callable[..., str | None]] = {
        float: "{:.6g}".format,
        bool: lambda value: str(value).lower(),
        type(None): lambda value: None,
    }
    writer.writerows([cells.get(type(value), str)(value) for value in line] for line in lines)
    return text.getvalue()


def _table(title: str, texts: Sequence[str], numbers: Sequence[str] = ()) -> Table:
    return Table(*texts, numbers=numbers, names=2, title=title)


def plan_table(plan: Plan) -> Table:
    """What would be measured."""
    table = _table(f"{plan.opened.path}: {len(plan.views.names)} views", ("Group", "Setting", "Note"))
    for setting in plan.settings:
        table.add_row(setting.group, setting.title, setting.note or "")
    for ladder in plan.ladders:
        table.add_row("costs", ladder.key, f"{len(ladder.steps)} steps from {ladder.steps[0]} to {ladder.steps[-1]}")
    return table


def front_table(tradeoff: Tradeoff) -> Table:
    """Both fronts of object MAE, the cheapest first."""
    numbers = ("ms per view", "5th-95th", "Frames", "Object MAE mm", "Measured MAE mm", "Not measured")
    title = "Fronts of object MAE: no other setting is both cheaper and more exact"
    table = _table(title, ("Against", "Setting"), numbers)
    for cost in COST_KEYS:
        for point in tradeoff.front(cost):
            ms, low, high = point.ms
            maes = ("-" if mae is None else f"{mae:.3g}" for mae in (point.object_mae_mm, point.measured_mae_mm))
            missing = "-" if point.missing_share is None else f"{100 * point.missing_share:.3g}%"
            table.add_row(cost, point.title, f"{ms:.3g}", f"{low:.3g}-{high:.3g}", str(point.frames), *maes, missing)
        table.add_section()
    return table


def growth_table(growths: Sequence[Growth]) -> Table:
    """The fitted powers with their flags."""
    numbers = ("From", "To", "ms at most", "Power", "95% interval", "At the end")
    table = _table("Costs that grow: seconds = c amount^power", ("Stage", "Over"), numbers)
    table.add_column("Flag", overflow="fold")
    for growth in growths:
        amounts = f"{growth.amounts[0]:,.0f}", f"{growth.amounts[-1]:,.0f}"
        powers = f"{growth.exponent:.2f}", f"{growth.low:.2f} to {growth.high:.2f}", f"{growth.tail:.2f}"
        ms = f"{1000 * growth.seconds[-1]:.3g}"
        table.add_row(growth.stage, growth.over, *amounts, ms, *powers, growth.flag or "")
    return table


def remarks(tradeoff: Tradeoff) -> list[str]:
    """Remarks on how far the numbers can be trusted: load, pace, sittings, settings that could not be measured."""
    lines = []
    paces, loads = tradeoff.pace_ms, tradeoff.loads
    if loads:
        lines.append(
            f"Load of the machine: {loads[0]:g} to {loads[-1]:g} on {tradeoff.hardware.cores} cores; its pace (a fixed "
            f"piece of work): {paces[0]:.3g} to {paces[-1]:.3g} ms, median {paces[len(paces) // 2]:.3g}."
        )
    if slow := sum(map(tradeoff.slowed, tradeoff.points)):
        lines.append(
            f"{slow} of {len(tradeoff.points)} settings ran while the machine was over {results.SLOWED} times slower "
            "than in the median (column slowed of tradeoff.csv): their times are too long."
        )
    if tradeoff.sittings > 1:
        lines.append(f"Measured in {tradeoff.sittings} sittings: compare times of different sittings with care.")
    lines += [f"Not measured: {point.title}: {point.failed}" for point in tradeoff.points if point.failed]
    return lines
