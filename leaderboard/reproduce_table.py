"""A reproduced table for people: measured here beside reported by the paper, and which of its orderings hold."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from fpp_ml_bench.evaluation.numbers import percent
from fpp_ml_bench.leaderboard.columns import device
from fpp_ml_bench.leaderboard.export import markdown_rows, markdown_text
from fpp_ml_bench.leaderboard.paper import paper_tables
from fpp_ml_bench.leaderboard.reproduce_lines import MAIN_KEY, Line
from fpp_ml_bench.leaderboard.reproduce_order import Ordering
from fpp_ml_bench.leaderboard.reproduce_plan import MEAN, PREDICTED, Variant
from fpp_ml_bench.leaderboard.rows import BY_THE_PAPER, PROVENANCES

if TYPE_CHECKING:
    from rich.table import Table

HERE = PROVENANCES[0]
_OTHER_TRACK = "*"


@dataclass(frozen=True)
class Column:
    """``text`` makes the cell of a line; ``short`` is the title in a terminal, None for what there is no room for."""

    title: str
    short: str | None
    text: Callable[[Line], str]
    right: bool = True


def columns(preset: str) -> tuple[Column, ...]:
    """The table's columns."""
    here, paper = f"{HERE}, {preset} preset", BY_THE_PAPER
    twin = f"object MAE / of its measured pixels / missing pixels, {HERE}"
    return (
        Column("Row", "Row", lambda line: line.label, right=False),
        Column("Track", None, lambda line: "-" if line.entry is None else line.entry.result.track, right=False),
        Column(f"Object MAE / RMSE, {here}", "Object, here", lambda line: _pair(_ours(line), "object")),
        Column(f"95% interval of the object MAE, {HERE}", "95% of MAE", _interval),
        Column(f"Object MAE / RMSE, {paper}", "Object, paper", lambda line: _pair(line.paper_mm, "object")),
        Column(f"Overall MAE / RMSE, {here}", "Overall, here", lambda line: _pair(_ours(line), "overall")),
        Column(f"Overall MAE / RMSE, {paper}", "Overall, paper", lambda line: _pair(line.paper_mm, "overall")),
        Column(f"Background MAE / RMSE, {here}", None, lambda line: _pair(_ours(line), "background")),
        Column(f"Background MAE / RMSE, {paper}", None, lambda line: _pair(line.paper_mm, "background")),
        Column(f"Range predicted: {twin}", "Range predicted", lambda line: _twin(line, PREDICTED)),
        Column(f"Range of the training mean: {twin}", None, lambda line: _twin(line, MEAN)),
        Column("Parameters", None, _parameters),
        Column("Epochs", "Epochs", lambda line: _setting(line, "epochs_trained")),
        Column("Training, s", "s", lambda line: _setting(line, "training_seconds")),
        Column("Latency, ms", "ms", _latency),
    )


def table_markdown(
    table: str, lines: Sequence[Line], found: Sequence[Ordering], preset: str, command: str, failed: dict[str, str]
) -> str:
    """The whole page of a table. ``command`` makes it again; ``failed`` maps a recipe's name to why it failed."""
    shown = columns(preset)
    rows = [[markdown_text(column.text(line)) for column in shown] for line in lines]
    parts = [
        f"# {markdown_text(paper_tables()[table].title)}",
        "",
        f"Made by `{command}`. Errors in mm, mean over samples.",
        *_about(lines),
        "",
        *markdown_rows([column.title for column in shown], [column.right for column in shown], rows),
        "",
        *_missing(lines, command, failed),
        *_twins_said(lines),
        *_orderings(found, lines),
    ]
    return "\n".join(parts).rstrip("\n") + "\n"


def table_rich(table: str, lines: Sequence[Line], preset: str) -> "Table":
    """The same for a terminal, without the columns that there is no room for."""
    from rich.table import Table
    from rich.text import Text

    shown = [column for column in columns(preset) if column.short is not None]
    made = Table(
        title=Text(
            f"{paper_tables()[table].title}\nMAE / RMSE in mm. here: {HERE}, {preset} preset; paper: {BY_THE_PAPER}. "
            "Range predicted: object MAE / of its measured pixels / missing pixels"
        ),
        title_justify="left",
    )
    for column in shown:
        made.add_column(Text(column.short or ""), justify="right" if column.right else "left", overflow="fold")
    for line in lines:
        made.add_row(*(Text(column.text(line)) for column in shown))
    return made


def orderings_said(found: Sequence[Ordering]) -> str:
    """How many of the paper's orderings hold, in a sentence."""
    if not found:
        return "No two rows of the paper's have been measured here yet, so none of its orderings can be judged."
    count = {word: sum(item.verdict == word for item in found) for word in ("holds", "within noise", "reversed")}
    return (
        f"The paper's pairwise orderings by object MAE, {len(found)} among the rows measured here: {count['holds']} "
        f"hold, {count['within noise']} within noise (the 95% interval of the paired difference holds 0), "
        f"{count['reversed']} reversed."
    )


def _about(lines: Sequence[Line]) -> list[str]:
    entry = next((line.entry for line in lines if line.entry is not None), None)
    if entry is None:
        return []
    data = entry.result.dataset
    height, width = data.size
    objects = len({row.object for row in entry.result.per_sample})
    return [
        "",
        f"{HERE.capitalize()}: {data.split} split of {markdown_text(data.name)} ({data.fingerprint[:8]}), "
        f"{data.samples} samples of {objects} objects, {width} x {height} px, against decoded depth; times on "
        f"{markdown_text(device(entry))}. {BY_THE_PAPER.capitalize()}: its own data at 960 x 960 px, its authors' "
        "code; the two are set side by side, not ranked together. Rows of the oracle range track were given the test "
        "samples' depth range, here as in the paper, and score the background in units of that range.",
    ]


def _missing(lines: Sequence[Line], command: str, failed: dict[str, str]) -> list[str]:
    empty = list(dict.fromkeys(line.place.row for line in lines if line.scored is None))
    if not empty:
        return []
    reasons = [
        f"- {markdown_text(line.label)}: {markdown_text(failed[line.recipe.name])}"
        for line in lines
        if line.scored is None and line.recipe.name in failed
    ]
    return [f"Not measured here: {markdown_text(', '.join(empty))}. To fill: `{command}`", *reasons, ""]


def _twins_said(lines: Sequence[Line]) -> list[str]:
    without = [line.label for line in lines if line.recipe.background_removed]
    said = []
    if any(line.twins for line in lines):
        said += [
            "The two columns on the range are metric twins of an oracle-range row: the same network's output, brought "
            "to mm with a range predicted by a small head from the image, or with the mean range of the training "
            "samples. What their object MAE exceeds the row's own by is what the oracle was worth: range and mask, for "
            "a twin must also say where the object is, and an object pixel that it misses costs its whole depth.",
            "",
        ]
    if without:
        said += [
            "With the background removed the input shows the test sample's object mask; no twins there.",
            "",
        ]
    return said


def _orderings(found: Sequence[Ordering], lines: Sequence[Line]) -> list[str]:
    parts = ["## The paper's orderings", "", orderings_said(found), ""]
    if not found:
        return parts
    rows = [
        [
            markdown_text(item.better),
            markdown_text(item.worse) + ("" if item.same_track else f" \\{_OTHER_TRACK}"),
            f"{item.paper_gap_mm:+.2f}",
            f"{item.gap_mm:+.2f}",
            "-" if item.interval_mm is None else f"{item.interval_mm[0]:+.2f} to {item.interval_mm[1]:+.2f}",
            item.verdict,
        ]
        for item in found
    ]
    titles = (
        "Better in the paper", "Worse in the paper", f"Worse minus better, mm, {BY_THE_PAPER}",
        f"Worse minus better, mm, {HERE}", "95% interval", "Here",
    )  # fmt: skip
    parts += [*markdown_rows(titles, (False, False, True, True, True, False), rows), ""]
    parts += ["Differences sample by sample; intervals by bootstrap over objects."]
    if not all(item.same_track for item in found):
        parts += [
            "",
            f"\\{_OTHER_TRACK} of different tracks: one of the two was given the test sample's range, and that is part "
            "of the difference.",
        ]
    return parts


def _ours(line: Line) -> dict[str, Any] | None:
    return None if line.scored is None else line.scored.errors_mm


def _pair(errors_mm: Any, pixels: str) -> str:
    """MAE and RMSE with the paper's two decimals."""
    if errors_mm is None:
        return "-"
    values = (errors_mm[f"{pixels}_{error}_mm"] for error in ("mae", "rmse"))
    return " / ".join("-" if value is None else f"{value:.2f}" for value in values)


def _interval(line: Line) -> str:
    if line.scored is None or line.scored.interval_mm is None:
        return "-"
    return " - ".join(f"{end:.2f}" for end in line.scored.interval_mm)


def _twin(line: Line, variant: Variant) -> str:
    """Object MAE, that of the pixels the twin measured, and the share that it did not."""
    entry = line.twins.get(variant.suffix)
    if entry is None:
        return "-"
    errors = (entry.value(key) for key in (MAIN_KEY, "object_valid_mae_mm"))
    cells = ["-" if value is None else f"{value:.2f}" for value in errors]
    return " / ".join([*cells, percent(entry.value("object_missing_share"))])


def _setting(line: Line, key: str) -> str:
    value = None if line.entry is None else line.entry.result.submission.settings.get(key)
    return f"{value:,.0f}" if isinstance(value, int | float) else "-"


def _parameters(line: Line) -> str:
    timing = None if line.entry is None else line.entry.result.timing
    return "-" if timing is None else f"{timing.parameters:,}"


def _latency(line: Line) -> str:
    latency = None if line.entry is None else line.entry.latency_ms
    return "-" if latency is None else f"{latency:.3g}"
