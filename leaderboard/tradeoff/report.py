"""A trade-off as files and tables: tradeoff.json, two CSVs, four pictures, and the terminal's tables."""

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.result import write_json
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.leaderboard.tradeoff.figure import draw_growth, draw_sizes, draw_tradeoff
from fpp_ml_bench.leaderboard.tradeoff.points import SLOWED, TRADEOFF_FILE, Growth, Point, Tradeoff, failures

if TYPE_CHECKING:
    from rich.table import Table

PICTURES: dict[str, Callable[[Tradeoff, Path], bool]] = {
    "tradeoff.png": draw_tradeoff,
    "tradeoff_measured.png": lambda tradeoff, path: draw_tradeoff(tradeoff, path, "measured_mae_mm"),
    "sizes.png": draw_sizes,
    "costs.png": lambda tradeoff, path: draw_growth(tradeoff.growth, path),
}
"""Name of each picture and the function that draws it; the function returns False where there is nothing to draw."""
_POINT_FIELDS = tuple(name for name in Point.model_fields if name != "interval_mm")


def write_report(tradeoff: Tradeoff, out: Path) -> list[Path]:
    """Write everything into folder ``out``; returns the files. SubmissionError where one can't be written."""
    content = tradeoff.model_dump(mode="json")
    content["points"] = [point.model_dump(mode="json", exclude_none=True) for point in tradeoff.points]
    write_json(content, out / TRADEOFF_FILE)
    written = [out / TRADEOFF_FILE]
    if tradeoff.points:
        written.append(_write(out / "tradeoff.csv", points_csv(tradeoff)))
    if tradeoff.growth:
        written.append(_write(out / "costs.csv", growth_csv(tradeoff.growth)))
    return written + [out / name for name, draw in PICTURES.items() if draw(tradeoff, out / name)]


def _write(path: Path, text: str) -> Path:
    try:
        write_atomically(path, text.encode("utf-8"))
    except OSError as error:
        raise SubmissionError(f"{path} can't be written: {error.strerror}") from None
    return path


def points_csv(tradeoff: Tradeoff) -> str:
    """A line for each setting; ``front_seconds`` and ``front_frames``: on the front of object MAE; ``slowed``: the
    machine was busier at that time than in the run's median."""
    fronts = {cost: {point.key for point in tradeoff.front(cost)} for cost in ("seconds", "frames")}  # type: ignore[arg-type]
    head = [*_POINT_FIELDS, "interval_low_mm", "interval_high_mm", "front_seconds", "front_frames", "slowed"]
    lines = []
    for point in tradeoff.points:
        row = [_cell(getattr(point, name)) for name in _POINT_FIELDS]
        row += [_cell(end) for end in point.interval_mm or (None, None)]
        row += [str(point.key in fronts[cost]).lower() for cost in ("seconds", "frames")]
        lines.append([*row, str(tradeoff.slowed(point)).lower()])
    return _csv(head, lines)


def growth_csv(growths: Iterable[Growth]) -> str:
    """A line for each stage and amount, with the stage's fitted power."""
    head = ["stage", "over", "amount", "seconds", "exponent", "low", "high", "tail", "flag"]
    lines = [
        [growth.stage, growth.over, _cell(amount), _cell(seconds),
         *map(_cell, (growth.exponent, growth.low, growth.high, growth.tail)), growth.flag or ""]
        for growth in growths
        for amount, seconds in zip(growth.amounts, growth.seconds, strict=True)
    ]  # fmt: skip
    return _csv(head, lines)


def _csv(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(lines)
    return text.getvalue()


def _cell(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def front_table(tradeoff: Tradeoff) -> "Table":
    """Both fronts of object MAE, the cheapest first."""
    from rich.table import Table

    table = Table(title="Fronts of object MAE: no other setting is both cheaper and more exact", title_justify="left")
    table.add_column("Against")
    table.add_column("Setting", overflow="fold")
    for title in ("ms per view", "5th-95th", "Frames", "Object MAE mm", "Measured MAE mm", "Not measured"):
        table.add_column(title, justify="right")
    for cost in ("seconds", "frames"):
        for point in tradeoff.front(cost):  # type: ignore[arg-type]
            table.add_row(cost, point.title, *_figures(point))
        table.add_section()
    return table


def _figures(point: Point) -> tuple[str, ...]:
    low, high = (1000 * (end or 0) for end in (point.seconds_p5, point.seconds_p95))
    return (
        f"{1000 * (point.seconds or 0):.3g}",
        f"{low:.3g}-{high:.3g}",
        str(point.frames),
        "-" if point.object_mae_mm is None else f"{point.object_mae_mm:.3g}",
        "-" if point.measured_mae_mm is None else f"{point.measured_mae_mm:.3g}",
        "-" if point.missing_share is None else f"{100 * point.missing_share:.3g}%",
    )


def growth_table(growths: Sequence[Growth]) -> "Table":
    """The fitted powers with their flags."""
    from rich.table import Table

    table = Table(title="Costs that grow: seconds = c amount^power", title_justify="left")
    table.add_column("Stage", overflow="fold")
    table.add_column("Over")
    for title in ("From", "To", "ms at most", "Power", "95% interval", "At the end"):
        table.add_column(title, justify="right")
    table.add_column("Flag", overflow="fold")
    for growth in growths:
        table.add_row(
            growth.stage, growth.over, f"{growth.amounts[0]:,.0f}", f"{growth.amounts[-1]:,.0f}",
            f"{1000 * growth.seconds[-1]:.3g}", f"{growth.exponent:.2f}",
            f"{growth.low:.2f} to {growth.high:.2f}", f"{growth.tail:.2f}", growth.flag or "",
        )  # fmt: skip
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
    slow = sum(map(tradeoff.slowed, tradeoff.points))
    if slow:
        lines.append(
            f"{slow} of {len(tradeoff.points)} settings ran while the machine was over {SLOWED} times slower than in "
            "the median (column slowed of tradeoff.csv): their times are too long."
        )
    if tradeoff.sittings > 1:
        lines.append(f"Measured in {tradeoff.sittings} sittings: compare times of different sittings with care.")
    lines += [f"Not measured: {point.title}: {point.failed}" for point in failures(tradeoff.points)]
    return lines
