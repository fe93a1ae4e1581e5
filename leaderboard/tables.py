"""The leaderboard as tables: in the terminal, as Markdown, and as JSON, from one description of the columns. The same
rows give the same bytes."""

import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Literal

from rich.table import Table
from rich.text import Text

from fpp_ml_bench.evaluation.protocol import HEADLINE
from fpp_ml_bench.evaluation.report import millimetres, percent, seconds
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.groups import LEGACY_NOTE, TOLD, Group, Ranked, assumption, assumption_sentences
from fpp_ml_bench.leaderboard.paper import PAPER_HEADING, PaperRow, PaperTable
from fpp_ml_bench.leaderboard.rows import Entry

SELF_REPORTED = "*"
NOT_MEASURED = "not measured"
RANK_NOTE = (
    "Rank: the best and the worst that the 95% intervals allow. Best: 1 + the rows whose whole interval is better; "
    "worst: all rows minus those whose whole interval is worse."
)
NOTE = (
    f"Errors in mm, mean over samples; 95% interval from a bootstrap over objects. {RANK_NOTE} {SELF_REPORTED} time as "
    "reported by its author, not measured here."
)
NO_RESULTS = """\
No results here yet. Score predictions, and their row appears:
  fpp-bench predict classical data/mini --split test --out predictions
  fpp-eval predictions --dataset data/mini --split test --json result.json
  fpp-bench leaderboard result.json
Without arguments, result*.json and results/*.json of the current folder are read.
"""
MIDDLE, WIDE, WIDEST = 100, 140, 170
"""Characters of a terminal from which on more columns fit."""
ONLY_IN_FILES = 1_000_000
_DEVICE_WIDTH, _LONGEST_NAME = 40, 90
_ERRORS = {
    "object_mae_mm": ("Object MAE", 0),
    "object_rmse_mm": ("Object RMSE", 0),
    "overall_mae_mm": ("Overall MAE", 0),
    "background_mae_mm": ("Backgr. MAE", WIDE),
    "object_missing_share": ("Missing", WIDE),
    "object_interior_mae_mm": ("Interior MAE", WIDEST),
    "object_edge_mae_mm": ("Edge MAE", WIDEST),
}
"""Title of each error's column, and the width from which on it is shown."""
PAPER_TITLES = (
    "Row", "Track", "Test samples", "Object MAE", "Object RMSE", "Overall MAE", "Overall RMSE", "Backgr. MAE",
    "Backgr. RMSE",
)  # fmt: skip
PAPER_TEXT_COLUMNS = 2
_PLAIN = frozenset(" -,+()/%=.")


@dataclass(frozen=True)
class Column:
    """``text`` makes the cell; ``right``: aligned to the right, as numbers are. A terminal of fewer than ``from_width``
    characters leaves the column out."""

    title: str
    text: Callable[[Ranked], str]
    right: bool = True
    from_width: int = 0


def columns(sort: str) -> list[Column]:
    """Columns of a ranking by ``sort``; a key without a column gets its own."""
    return [
        Column("Rank", lambda row: row.ranks),
        Column("Method", lambda row: printable(row.short_name), right=False),
        *_error_columns(sort),
        Column("s/sample", _time),
        Column("Frames", lambda row: str(row.entry.frames)),
        Column("Phase reliance", lambda row: reliance(row.entry), from_width=WIDE),
        Column("Provenance", lambda row: row.entry.provenance, right=False, from_width=MIDDLE),
        Column("Assumes", lambda row: assumption(row.entry.result) or "-", right=False, from_width=WIDEST),
        Column("Timed on", lambda row: device(row.entry), right=False, from_width=WIDEST),
        Column("Full name", lambda row: printable(row.entry.name, _LONGEST_NAME), False, ONLY_IN_FILES),
    ]


def _error_columns(sort: str) -> Iterator[Column]:
    """The errors; beside the one that the rows are ranked by, its interval."""
    own = {sort: (sort.removesuffix("_mm").replace("_", " "), 0)}
    own = {} if sort in (*_ERRORS, "seconds_per_sample", "frames_used") else own
    for key, (title, from_width) in {**own, **_ERRORS}.items():
        yield Column(title, partial(_error, key), from_width=0 if key == sort else from_width)
        if key == sort in HEADLINE:
            yield Column("95% interval", partial(_interval, sort), from_width=MIDDLE)


def _error(key: str, row: Ranked) -> str:
    return (percent if key.endswith("_share") else millimetres)(row.entry.value(key))


def _interval(key: str, row: Ranked) -> str:
    ends = row.entry.interval(key)
    return "-" if ends is None else "-".join(map(millimetres, ends))


def _time(row: Ranked) -> str:
    value = row.entry.value("seconds_per_sample")
    return seconds(value) + (SELF_REPORTED if value is not None and not row.entry.time_measured else "")


def reliance(entry: Entry) -> str:
    """The phase-reliance score with two decimals."""
    return NOT_MEASURED if entry.reliance is None else f"{entry.reliance.score:.2f}"


def reliance_interval(entry: Entry) -> str:
    """The ends of its interval; empty without any."""
    low, high = (None, None) if entry.reliance is None else entry.reliance.interval
    return "" if low is None or high is None else f"{low:.2f} - {high:.2f}"


def device(entry: Entry) -> str:
    """What the time was taken on: the GPU where there is one, else the CPU and its cores; a dash when unknown."""
    timing = entry.result.timing
    hardware = timing.hardware if timing is not None else entry.result.submission.hardware
    if hardware is None:
        return "-"
    cores = "1 core" if hardware.cores == 1 else f"{hardware.cores} cores"
    return printable(hardware.gpu or f"{hardware.cpu}, {cores}", _DEVICE_WIDTH)


def paper_cells(row: PaperRow) -> list[str]:
    """Cells under `PAPER_TITLES`, errors with the paper's two decimals."""
    keys = (f"{pixels}_{error}_mm" for pixels in ("object", "overall", "background") for error in ("mae", "rmse"))
    return [row.label, row.track, str(row.test_samples), *(f"{row.errors_mm[key]:.2f}" for key in keys)]


def paper_note(paper: PaperTable) -> str:
    """Below a table of the paper: other data, and what the methods of its tracks were told."""
    tracks = sorted({row.track for row in paper.rows})
    told = [f"{track}: told {TOLD[track]}." for track in tracks if TOLD[track]]
    return " ".join(["Other data, not ranked with the rows above.", *told])


def group_tables(groups: Sequence[Group], sort: str, width: int) -> list[Table | Text]:
    """A table for each group, for a terminal of ``width`` characters; without groups, how to begin.

    Submitted text goes in as `Text`: it is never markup.
    """
    if not groups:
        return [Text(NO_RESULTS)]
    parts: list[Table | Text] = []
    all_columns = columns(sort)
    shown = [column for column in all_columns if column.from_width <= width]
    for group in groups:
        table = Table(title=Text(group.key.title), title_justify="left")
        for column in shown:
            # Titles in two lines leave more width for the names.
            justify: Literal["right", "left"] = "right" if column.right else "left"
            table.add_column(column.title.replace(" ", "\n", 1), justify=justify, overflow="fold", no_wrap=column.right)
        for row in group.rows:
            table.add_row(*(Text(column.text(row)) for column in shown))
        parts += [table, Text(f"{LEGACY_NOTE}\n" if group.key.is_legacy else "")]
    left_out = [column.title for column in all_columns if width < column.from_width < ONLY_IN_FILES]
    hint = f" In a wider terminal, --markdown and --json: {', '.join(left_out)}." if left_out else ""
    return [*parts, Text(NOTE + hint + "\n")]


def paper_rich_tables(tables: Sequence[PaperTable]) -> list[Table | Text]:
    """The paper's tables under their heading."""
    parts: list[Table | Text] = [Text(PAPER_HEADING, style="bold")] if tables else []
    for paper in tables:
        table = Table(title=f"{paper.name}: {paper.title}, mm", title_justify="left")
        for number, title in enumerate(PAPER_TITLES):
            table.add_column(title, justify="left" if number < PAPER_TEXT_COLUMNS else "right")
        for row in paper.rows:
            table.add_row(*paper_cells(row))
        parts += [table, Text(f"{paper_note(paper)}\n")]
    return parts


def markdown_text(text: str) -> str:
    """``text`` as Markdown that shows exactly this text: punctuation that could be markup becomes a character entity.

    Entities are never structure (CommonMark 6.2): no pipe ends a table cell, no tag, link, code or mention begins.
    """
    safe = "".join(c if not c.isascii() or c.isalnum() or c in _PLAIN else f"&#{ord(c)};" for c in printable(text))
    return re.sub(r"(?i)(www)\.", r"\1&#46;", safe)  # GitHub links bare www. names too


def markdown_rows(titles: Sequence[str], right: Sequence[bool], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table; ``right`` says which columns are aligned to the right. Cells are Markdown already."""
    rules = (" ---: " if to_right else " --- " for to_right in right)
    lines = ["| " + " | ".join(titles) + " |", "|" + "|".join(rules) + "|"]
    return lines + ["| " + " | ".join(cells) + " |" for cells in rows]


def markdown_columns(shown: Sequence[Column], rows: Sequence[Ranked]) -> list[str]:
    """Lines of a Markdown table of ``rows``."""
    cells = [[markdown_text(column.text(row)) for column in shown] for row in rows]
    return markdown_rows([column.title for column in shown], [column.right for column in shown], cells)


def markdown(groups: Sequence[Group], papers: Sequence[PaperTable], sort: str) -> str:
    """The whole leaderboard as Markdown, ending in a newline."""
    lines: list[str] = []
    for group in groups:
        lines += [f"### {markdown_text(group.key.title)}", "", *markdown_columns(columns(sort), group.rows), ""]
        lines += [LEGACY_NOTE, ""] if group.key.is_legacy else []
    lines += [NOTE.replace("*", "\\*"), ""] if groups else []
    lines += [f"### {PAPER_HEADING}", ""] if papers else []
    right = [number >= PAPER_TEXT_COLUMNS for number in range(len(PAPER_TITLES))]
    for paper in papers:
        rows = [[markdown_text(cell) for cell in paper_cells(row)] for row in paper.rows]
        lines += [markdown_text(f"{paper.name}: {paper.title}, mm"), ""]
        lines += [*markdown_rows(PAPER_TITLES, right, rows), "", paper_note(paper), ""]
    return "\n".join(lines).rstrip("\n") + "\n"


def table_json(groups: Sequence[Group], papers: Sequence[PaperTable], sort: str) -> str:
    """The whole leaderboard as JSON: groups of ranked rows, and the paper's tables apart."""
    content = {
        "sorted_by": sort,
        "groups": [
            {
                **asdict(group.key),
                "title": group.key.title,
                "legacy": group.key.is_legacy,
                "dataset": group.dataset_name,
                "rows": [_json_row(row) for row in group.rows],
            }
            for group in groups
        ],
        "reported_by_the_paper": [asdict(paper) for paper in papers],
    }
    return json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _json_row(row: Ranked) -> dict[str, Any]:
    result = row.entry.result
    return {
        "best_rank": row.best_rank,
        "worst_rank": row.worst_rank,
        "name": row.entry.name,
        "short_name": row.short_name,
        "method": result.submission.method,
        "provenance": row.entry.provenance,
        "metrics": result.metrics.model_dump(mode="json"),
        "intervals": result.intervals.model_dump(mode="json"),
        "per_object": [part.model_dump(mode="json") for part in result.per_object],
        "seconds_per_sample": row.entry.value("seconds_per_sample"),
        "time_measured_here": row.entry.time_measured,
        "timing": None if result.timing is None else result.timing.model_dump(mode="json"),
        "phase_reliance": None if result.reliance is None else result.reliance.model_dump(mode="json"),
        "timed_on": device(row.entry),
        "assumes": assumption_sentences(result),
        "frames_used": row.entry.frames,
        "samples": result.dataset.samples,
        "created": result.created,
        "source": row.entry.path.name,
    }
