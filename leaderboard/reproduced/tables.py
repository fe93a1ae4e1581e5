"""The page of a table to reproduce, in Markdown and for a terminal."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.text import Text

from fpp_ml_bench.baselines import reproduce
from fpp_ml_bench.baselines.reproduce import MAIN_KEY
from fpp_ml_bench.evaluation.report import percent
from fpp_ml_bench.evaluation.result import Headline, write_file
from fpp_ml_bench.leaderboard.columns import device
from fpp_ml_bench.leaderboard.reported import PAPER_DEPTHS, paper_tables
from fpp_ml_bench.leaderboard.reproduced.lines import Line, table_lines
from fpp_ml_bench.leaderboard.reproduced.orderings import (
    Ordering,
    between,
    conclusion,
    orderings,
    orderings_sentence,
)
from fpp_ml_bench.leaderboard.rows import BY_THE_PAPER, MEASURED_HERE
from fpp_ml_bench.leaderboard.tables import markdown_rows, markdown_text
from fpp_ml_bench.tables import Table

_TITLES = {"further": "Further directions of the paper (UNet, global normalisation, RMSE loss, frame 0)"}
"""Of the tables that the paper does not have."""
_TRACKS_DIFFER = "*"


def _titles(preset: str) -> list[tuple[str, str | None]]:
    """Title of each column of `_cells` in a file and in a terminal, which leaves those without out; the first two hold
    text."""
    measured, paper = f"{MEASURED_HERE}, {preset} preset", BY_THE_PAPER
    twin = f"object MAE / of its measured pixels / missing pixels, {MEASURED_HERE}"
    return [
        ("Row", "Row"),
        ("Track", None),
        (f"Object MAE / RMSE, {measured}", "Object, here"),
        (f"95% interval of the object MAE, {MEASURED_HERE}", "95% of MAE"),
        (f"Object MAE / RMSE, {paper}", "Object, paper"),
        (f"Overall MAE / RMSE, {measured}", "Overall, here"),
        (f"Overall MAE / RMSE, {paper}", "Overall, paper"),
        (f"Background MAE / RMSE, {measured}", None),
        (f"Background MAE / RMSE, {paper}", None),
        (f"Range predicted: {twin}", "Range predicted"),
        (f"Range of the training mean: {twin}", None),
        ("Parameters", None),
        ("Epochs", "Epochs"),
        ("Training, s", "s"),
        ("Latency, ms", "ms"),
    ]


def _cells(line: Line) -> list[str]:
    """A dash where nothing is known; errors with the paper's two decimals."""
    entry, paper = line.entry, line.paper_mm
    here, interval = (line.scores.metrics, line.scores.intervals.of(MAIN_KEY)) if line.scores else (None, None)
    settings = entry.row.submission.settings if entry else {}
    counts = [settings.get("epochs_trained"), settings.get("training_seconds")]
    timing, latency = (entry.row.timing, entry.latency_ms) if entry else (None, None)
    return [
        line.label,
        entry.row.track if entry else "-",
        _pair(here, "object"),
        " - ".join(map(_mm, interval)) if interval else "-",
        _pair(paper, "object"),
        _pair(here, "overall"),
        _pair(paper, "overall"),
        _pair(here, "background"),
        _pair(paper, "background"),
        _twin(line, "predicted"),
        _twin(line, "mean"),
        f"{timing.parameters:,}" if timing else "-",
        *(f"{count:,.0f}" if isinstance(count, int | float) else "-" for count in counts),
        "-" if latency is None else f"{latency:.3g}",
    ]


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _pair(errors: Headline | Mapping[str, float] | None, pixels: str) -> str:
    """MAE and RMSE."""
    errors_mm = errors.model_dump() if isinstance(errors, Headline) else errors
    return "-" if errors_mm is None else " / ".join(_mm(errors_mm[f"{pixels}_{kind}_mm"]) for kind in ("mae", "rmse"))


def _twin(line: Line, depth_range: str) -> str:
    """Object MAE, the MAE over the pixels that the twin measured, and the share of missing pixels."""
    entry = line.twins.get(depth_range)
    if entry is None:
        return "-"
    errors = [_mm(entry.value(key)) for key in (MAIN_KEY, "object_valid_mae_mm")]
    return " / ".join([*errors, percent(entry.value("object_missing_share"))])


def _title(table: str) -> str:
    return _TITLES[table] if table in _TITLES else paper_tables()[table].title


def _shown(table: str, lines: Sequence[Line]) -> tuple[list[int], list[list[str]]]:
    """The columns to show, and the cells of each line. A table that the paper does not have has no empty columns."""
    rows = [_cells(line) for line in lines]
    columns = enumerate(zip(*rows, strict=True))
    return [number for number, column in columns if table in paper_tables() or set(column) != {"-"}], rows


def write_table(table: str, settings: reproduce.ReproduceSettings, outcome: reproduce.Outcome) -> Path:
    """Write the page of a table from the rows that there are; its path. SubmissionError where it can't be written."""
    folders = settings.folders
    lines = table_lines(table, outcome.jobs, folders, outcome.opened)
    command = settings.command.replace(f"{table}/{settings.row}", table, 1) if settings.row else settings.command
    text = table_markdown(table, lines, folders.preset, command, outcome.failed)
    write_file(text.encode("utf-8"), folders.table(table))
    return folders.table(table)


def table_markdown(table: str, lines: Sequence[Line], preset: str, command: str, failed: dict[str, str]) -> str:
    """The page of a table as Markdown. ``command`` makes it again; ``failed`` maps a recipe's name to its error."""
    titles, (columns, cells) = _titles(preset), _shown(table, lines)
    rows = [[markdown_text(row[number]) for number in columns] for row in cells]
    parts = [
        f"# {markdown_text(_title(table))}",
        "",
        f"Made by `{command}`. Errors in mm, mean over samples.",
        *_about(lines, table in paper_tables()),
        "",
        *markdown_rows([titles[number][0] for number in columns], [number > 1 for number in columns], rows),
        "",
        *_missing(lines, command, failed),
        *_twins_explained(lines),
        *(_orderings(orderings(lines)) if table in paper_tables() else [conclusion(table, lines)]),
    ]
    return "\n".join(parts).rstrip("\n") + "\n"


def table_rich(table: str, lines: Sequence[Line], preset: str) -> Table:
    """The table for a terminal, with the columns that fit."""
    titles, (columns, cells) = _titles(preset), _shown(table, lines)
    shown = [(number, short) for number in columns if (short := titles[number][1]) is not None]
    title = f"{_title(table)}\nMAE / RMSE in mm. here: {MEASURED_HERE}, {preset} preset"
    if table in paper_tables():
        title += f"; paper: {BY_THE_PAPER}. Range predicted: object MAE / of its measured pixels / missing pixels"
    rich_table = Table(title=Text(title), elsewhere="the page below")
    for number, short in shown:
        rich_table.add_column(Text(short), justify="right" if number > 1 else "left")
    for row in cells:
        rich_table.add_row(*(Text(row[number]) for number, _ in shown))
    return rich_table


def _about(lines: Sequence[Line], in_the_paper: bool) -> list[str]:
    entry = next((line.entry for line in lines if line.entry is not None), None)
    if entry is None:
        return []
    data = entry.row.dataset
    height, width = data.size
    objects = len(entry.row.per_object)
    here = (
        f"{MEASURED_HERE.capitalize()}: {data.split} split of {markdown_text(data.name)} ({data.truth[:8]}), "
        f"{data.samples} samples of {objects} objects, {width} x {height} px, against decoded depth; times on "
        f"{markdown_text(_devices(lines))}."
    )
    paper = (
        f" {BY_THE_PAPER.capitalize()}: its own data at 960 x 960 px, its authors' code; the two are shown beside each "
        "other, not ranked together. Rows of the oracle range track were given the test samples' depth range, here as "
        f"in the paper, and score the background in units of that range. {PAPER_DEPTHS}"
    )
    return ["", here + paper if in_the_paper else here]


def _devices(lines: Sequence[Line]) -> str:
    """Where the rows were timed, with their labels where that differs."""
    labels: dict[str, list[str]] = {}
    for line in lines:
        if line.entry is not None:
            labels.setdefault(device(line.entry), []).append(line.label)
    return "; ".join(name if len(labels) == 1 else f"{name} ({', '.join(rows)})" for name, rows in labels.items())


def _missing(lines: Sequence[Line], command: str, failed: dict[str, str]) -> list[str]:
    empty = [line for line in lines if line.scores is None]
    if not empty:
        return []
    why = [(line.label, failed[line.recipe.name]) for line in empty if line.recipe.name in failed]
    reasons = [f"- {markdown_text(label)}: {markdown_text(reason)}" for label, reason in why]
    names = ", ".join(dict.fromkeys(line.row for line in empty))
    return [f"Not measured here: {markdown_text(names)}. To fill: `{command}`", *reasons, ""]


def _twins_explained(lines: Sequence[Line]) -> list[str]:
    twins = (
        "The two columns on the range are metric twins of an oracle-range row: the same network's output, brought to "
        "mm with a range predicted by a small head from the image, or with the mean range of the training samples. The "
        "difference between their object MAE and the row's own is what the oracle gave: the range, and also the mask, "
        "because a twin must find the object itself, and an object pixel that it misses costs its whole depth."
    )
    removed = "With the background removed the input shows the test sample's object mask; no twins there."
    parts = [twins, ""] if any(line.twins for line in lines) else []
    return parts + ([removed, ""] if any(line.recipe.background_removed for line in lines) else [])


def _orderings(judged: Sequence[Ordering]) -> list[str]:
    parts = ["## The paper's orderings", "", orderings_sentence(judged), ""]
    if not judged:
        return parts
    rows = []
    for ordering in judged:
        worse = markdown_text(ordering.worse) + ("" if ordering.same_track else f" \\{_TRACKS_DIFFER}")
        gaps = f"{ordering.paper_gap_mm:+.2f}", f"{ordering.gap_mm:+.2f}"
        interval = "-" if ordering.interval_mm is None else between(ordering.interval_mm)
        rows.append([markdown_text(ordering.better), worse, *gaps, interval, ordering.verdict])
    titles = (
        "Better in the paper",
        "Worse in the paper",
        f"Worse minus better, mm, {BY_THE_PAPER}",
        f"Worse minus better, mm, {MEASURED_HERE}",
        "95% interval",
        "Here",
    )
    parts += [*markdown_rows(titles, (False, False, True, True, True, False), rows), ""]
    parts += ["Differences sample by sample; intervals by bootstrap over objects."]
    if not all(ordering.same_track for ordering in judged):
        told = "one of the two was given the test sample's range, which is part of the difference."
        parts += ["", f"\\{_TRACKS_DIFFER} of different tracks: {told}"]
    return parts
