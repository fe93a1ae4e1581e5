"""A reproduced table for people: measured here beside reported by the paper, and which of its orderings hold."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from fpp_ml_bench.evaluation.report import percent
from fpp_ml_bench.leaderboard.paper import paper_tables
from fpp_ml_bench.leaderboard.reproduce.lines import MAIN_KEY, Line
from fpp_ml_bench.leaderboard.reproduce.paper_order import Ordering
from fpp_ml_bench.leaderboard.reproduce.plan import MEAN, PREDICTED, Variant
from fpp_ml_bench.leaderboard.rows import BY_THE_PAPER, PROVENANCES
from fpp_ml_bench.leaderboard.tables import device, markdown_rows, markdown_text

if TYPE_CHECKING:
    from rich.table import Table

MEASURED_HERE = PROVENANCES[0]
_TRACKS_DIFFER = "*"


@dataclass(frozen=True)
class Column:
    """``text`` makes the cell of a line; ``short`` is the title in a terminal, None where the column is left out."""

    title: str
    short: str | None
    text: Callable[[Line], str]
    right: bool = True


def columns(preset: str) -> tuple[Column, ...]:
    """The table's columns."""
    measured, paper = f"{MEASURED_HERE}, {preset} preset", BY_THE_PAPER
    twin = f"object MAE / of its measured pixels / missing pixels, {MEASURED_HERE}"
    return (
        Column("Row", "Row", lambda line: line.label, right=False),
        Column("Track", None, lambda line: "-" if line.entry is None else line.entry.result.track, right=False),
        Column(f"Object MAE / RMSE, {measured}", "Object, here", lambda line: _pair(_errors_mm(line), "object")),
        Column(f"95% interval of the object MAE, {MEASURED_HERE}", "95% of MAE", _interval),
        Column(f"Object MAE / RMSE, {paper}", "Object, paper", lambda line: _pair(line.paper_mm, "object")),
        Column(f"Overall MAE / RMSE, {measured}", "Overall, here", lambda line: _pair(_errors_mm(line), "overall")),
        Column(f"Overall MAE / RMSE, {paper}", "Overall, paper", lambda line: _pair(line.paper_mm, "overall")),
        Column(f"Background MAE / RMSE, {measured}", None, lambda line: _pair(_errors_mm(line), "background")),
        Column(f"Background MAE / RMSE, {paper}", None, lambda line: _pair(line.paper_mm, "background")),
        Column(f"Range predicted: {twin}", "Range predicted", lambda line: _twin(line, PREDICTED)),
        Column(f"Range of the training mean: {twin}", None, lambda line: _twin(line, MEAN)),
        Column("Parameters", None, _parameters),
        Column("Epochs", "Epochs", lambda line: _setting(line, "epochs_trained")),
        Column("Training, s", "s", lambda line: _setting(line, "training_seconds")),
        Column("Latency, ms", "ms", _latency),
    )


def table_markdown(
    table: str, lines: Sequence[Line], judged: Sequence[Ordering], preset: str, command: str, failed: dict[str, str]
) -> str:
    """The page of a table as Markdown. ``command`` makes it again; ``failed`` maps a recipe's name to its error."""
    table_columns = columns(preset)
    rows = [[markdown_text(column.text(line)) for column in table_columns] for line in lines]
    parts = [
        f"# {markdown_text(paper_tables()[table].title)}",
        "",
        f"Made by `{command}`. Errors in mm, mean over samples.",
        *_about(lines),
        "",
        *markdown_rows([column.title for column in table_columns], [column.right for column in table_columns], rows),
        "",
        *_missing(lines, command, failed),
        *_twins_explained(lines),
        *_orderings(judged, lines),
    ]
    return "\n".join(parts).rstrip("\n") + "\n"


def table_rich(table: str, lines: Sequence[Line], preset: str) -> "Table":
    """The table for a terminal, with the columns that fit."""
    from rich.table import Table
    from rich.text import Text

    terminal_columns = [column for column in columns(preset) if column.short is not None]
    rich_table = Table(
        title=Text(
            f"{paper_tables()[table].title}\nMAE / RMSE in mm. here: {MEASURED_HERE}, {preset} preset; "
            f"paper: {BY_THE_PAPER}. Range predicted: object MAE / of its measured pixels / missing pixels"
        ),
        title_justify="left",
    )
    for column in terminal_columns:
        rich_table.add_column(Text(column.short or ""), justify="right" if column.right else "left", overflow="fold")
    for line in lines:
        rich_table.add_row(*(Text(column.text(line)) for column in terminal_columns))
    return rich_table


def orderings_sentence(judged: Sequence[Ordering]) -> str:
    """How many of the paper's orderings hold, in a sentence."""
    if not judged:
        return "No two rows of the paper's have been measured here yet, so none of its orderings can be judged."
    count = {
        word: sum(ordering.verdict == word for ordering in judged) for word in ("holds", "within noise", "reversed")
    }
    return (
        f"The paper's pairwise orderings by object MAE, {len(judged)} among the rows measured here: {count['holds']} "
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
        f"{MEASURED_HERE.capitalize()}: {data.split} split of {markdown_text(data.name)} ({data.fingerprint[:8]}), "
        f"{data.samples} samples of {objects} objects, {width} x {height} px, against decoded depth; times on "
        f"{markdown_text(device(entry))}. {BY_THE_PAPER.capitalize()}: its own data at 960 x 960 px, its authors' "
        "code; the two are shown beside each other, not ranked together. Rows of the oracle range track were given the "
        "test samples' depth range, here as in the paper, and score the background in units of that range.",
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


def _twins_explained(lines: Sequence[Line]) -> list[str]:
    without = [line.label for line in lines if line.recipe.background_removed]
    paragraphs = []
    if any(line.twins for line in lines):
        paragraphs += [
            "The two columns on the range are metric twins of an oracle-range row: the same network's output, brought "
            "to mm with a range predicted by a small head from the image, or with the mean range of the training "
            "samples. The difference between their object MAE and the row's own is what the oracle gave: the range, "
            "and also the mask, because a twin must find the object itself, and an object pixel that it misses costs "
            "its whole depth.",
            "",
        ]
    if without:
        paragraphs += [
            "With the background removed the input shows the test sample's object mask; no twins there.",
            "",
        ]
    return paragraphs


def _orderings(judged: Sequence[Ordering], lines: Sequence[Line]) -> list[str]:
    parts = ["## The paper's orderings", "", orderings_sentence(judged), ""]
    if not judged:
        return parts
    rows = [
        [
            markdown_text(ordering.better),
            markdown_text(ordering.worse) + ("" if ordering.same_track else f" \\{_TRACKS_DIFFER}"),
            f"{ordering.paper_gap_mm:+.2f}",
            f"{ordering.gap_mm:+.2f}",
            "-"
            if ordering.interval_mm is None
            else f"{ordering.interval_mm[0]:+.2f} to {ordering.interval_mm[1]:+.2f}",
            ordering.verdict,
        ]
        for ordering in judged
    ]
    titles = (
        "Better in the paper", "Worse in the paper", f"Worse minus better, mm, {BY_THE_PAPER}",
        f"Worse minus better, mm, {MEASURED_HERE}", "95% interval", "Here",
    )  # fmt: skip
    parts += [*markdown_rows(titles, (False, False, True, True, True, False), rows), ""]
    parts += ["Differences sample by sample; intervals by bootstrap over objects."]
    if not all(ordering.same_track for ordering in judged):
        parts += [
            "",
            f"\\{_TRACKS_DIFFER} of different tracks: one of the two was given the test sample's range, which is part "
            "of the difference.",
        ]
    return parts


def _errors_mm(line: Line) -> dict[str, Any] | None:
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
    """Object MAE, the MAE over the pixels that the twin measured, and the share of missing pixels."""
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
