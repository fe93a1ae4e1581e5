"""The leaderboard as tables from one description of the columns: in the terminal, as Markdown, as JSON, and as the
block of README.md between two markers, which is not edited by hand. The same rows give the same bytes."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from rich.table import Table
from rich.text import Text

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import HEADLINE
from fpp_ml_bench.evaluation.report import millimetres, percent, seconds
from fpp_ml_bench.files import printable, write_atomically
from fpp_ml_bench.leaderboard.groups import ASSUMED, LEGACY_NOTE, TOLD, Group, Ranked, assumption, assumption_sentences
from fpp_ml_bench.leaderboard.rows import PAPER_HEADING, Entry, PaperRow, PaperTable, paper_tables

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
BEGIN, END = "<!-- leaderboard:begin -->", "<!-- leaderboard:end -->"
SHOWN = 5
"""Rows of a group that README shows; the page shows them all."""
_MADE_BY = "Made by `fpp-bench leaderboard --readme README.md` from the files in `leaderboard/rows/`."
_README_NOTE = (
    f"{_MADE_BY} Errors in mm. {RANK_NOTE} Intervals: bootstrap over objects. Time: median latency of one image. "
    f"\\{SELF_REPORTED} self-reported. Phase reliance: 1 follows the fringe's phase and nothing else, 0 does not "
    "follow it (docs/reliance.md). Disturbed: object MAE over all axes and severities of disturbed scenes, with 150 mm "
    "for a pixel without an answer (docs/robustness.md)."
)
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
    """Columns of a ranking by ``sort``; a key without a column gets its own, and that of the errors its interval."""
    named = {*_ERRORS, "seconds_per_sample", "frames_used"}
    own = {} if sort in named else {sort: (sort.removesuffix("_mm").replace("_", " "), 0)}
    errors = []
    for key, (title, from_width) in {**own, **_ERRORS}.items():
        errors.append(Column(title, partial(_error, key), from_width=0 if key == sort else from_width))
        if key == sort in HEADLINE:
            interval = partial(_interval, between="-", key=sort)
            errors.append(Column("95% interval", interval, from_width=MIDDLE))
    return [
        _RANK, _METHOD, *errors, Column("s/sample", _seconds), _FRAMES, replace(_RELIANCE, from_width=WIDE),
        replace(_ROBUSTNESS, from_width=WIDEST),
        replace(_PROVENANCE, from_width=MIDDLE),
        Column("Assumes", lambda row: assumption(row.entry.result) or "-", right=False, from_width=WIDEST),
        Column("Timed on", lambda row: device(row.entry), right=False, from_width=WIDEST),
        Column("Full name", lambda row: printable(row.entry.name, _LONGEST_NAME), False, ONLY_IN_FILES),
    ]  # fmt: skip


def _error(key: str, row: Ranked) -> str:
    return (percent if key.endswith("_share") else millimetres)(row.entry.value(key))


def _interval(row: Ranked, between: str, key: str = "object_mae_mm") -> str:
    return between.join(map(millimetres, row.entry.interval(key) or ())) or "-"


def _seconds(row: Ranked) -> str:
    value = row.entry.value("seconds_per_sample")
    return seconds(value) + (SELF_REPORTED if value is not None and not row.entry.time_measured else "")


def _milliseconds(row: Ranked) -> str:
    ms = row.entry.latency_ms
    return "-" if ms is None else f"{ms:.3g}{'' if row.entry.time_measured else SELF_REPORTED}"


def reliance(entry: Entry) -> str:
    """The phase-reliance score with two decimals."""
    measured = entry.result.reliance
    return NOT_MEASURED if measured is None else f"{measured.score:.2f}"


def reliance_interval(entry: Entry) -> str:
    """The ends of its interval; empty without any."""
    low, high = entry.result.reliance.interval if entry.result.reliance else (None, None)
    return "" if low is None or high is None else f"{low:.2f} - {high:.2f}"


def robustness(entry: Entry) -> str:
    """Mean error over the disturbed scenes of the test set, mm with one decimal."""
    measured = (entry.result.robustness or {}).get("test")
    return NOT_MEASURED if measured is None else f"{measured.mae_mm:.1f}"


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
    """A table for each group, for a terminal of ``width`` characters; without groups, how to begin. Submitted text goes
    in as `Text`: it is never markup."""
    if not groups:
        return [Text(NO_RESULTS)]
    parts: list[Table | Text] = []
    shown = [column for column in columns(sort) if column.from_width <= width]
    for group in groups:
        table = Table(title=Text(group.key.title), title_justify="left")
        for column in shown:
            # Titles in two lines leave more width for the names.
            justify: Literal["right", "left"] = "right" if column.right else "left"
            table.add_column(column.title.replace(" ", "\n", 1), justify=justify, overflow="fold", no_wrap=column.right)
        for row in group.rows:
            table.add_row(*(Text(column.text(row)) for column in shown))
        parts += [table, Text(f"{LEGACY_NOTE}\n" if group.key.is_legacy else "")]
    left_out = [column.title for column in columns(sort) if width < column.from_width < ONLY_IN_FILES]
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
    Entities are never structure (CommonMark 6.2): no pipe ends a table cell, no tag, link, code or mention begins."""
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
        rows = [list(map(markdown_text, paper_cells(row))) for row in paper.rows]
        lines += [markdown_text(f"{paper.name}: {paper.title}, mm"), "", *markdown_rows(PAPER_TITLES, right, rows), ""]
        lines += [paper_note(paper), ""]
    return "\n".join(lines).rstrip("\n") + "\n"


def table_json(groups: Sequence[Group], papers: Sequence[PaperTable], sort: str) -> str:
    """The whole leaderboard as JSON: groups of ranked rows, and the paper's tables apart."""
    of_groups = [
        {
            **asdict(group.key), "title": group.key.title, "legacy": group.key.is_legacy,
            "dataset": group.dataset_name, "rows": list(map(_json_row, group.rows)),
        }
        for group in groups
    ]  # fmt: skip
    content = {"sorted_by": sort, "groups": of_groups, "reported_by_the_paper": list(map(asdict, papers))}
    return json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _json_row(row: Ranked) -> dict[str, Any]:
    entry, result = row.entry, row.entry.result
    timing, reliance = (part and part.model_dump(mode="json") for part in (result.timing, result.reliance))
    disturbed = {name: block.model_dump(mode="json") for name, block in (result.robustness or {}).items()}
    return {
        "best_rank": row.best_rank, "worst_rank": row.worst_rank, "name": entry.name, "short_name": row.short_name,
        "method": result.submission.method, "provenance": entry.provenance,
        "metrics": result.metrics.model_dump(mode="json"), "intervals": result.intervals.model_dump(mode="json"),
        "per_object": [part.model_dump(mode="json") for part in result.per_object],
        "seconds_per_sample": entry.value("seconds_per_sample"), "time_measured_here": entry.time_measured,
        "timing": timing, "phase_reliance": reliance, "robustness": disturbed, "timed_on": device(entry),
        "assumes": assumption_sentences(result), "frames_used": entry.frames, "samples": result.dataset.samples,
        "created": result.created, "source": entry.path.name,
    }  # fmt: skip


def readme_block(groups: Sequence[Group]) -> str:
    """What is between README's markers: the best `SHOWN` rows of each group, and the paper's architectures."""
    if not groups:
        return f"No row yet. {_MADE_BY}\n"
    lines: list[str] = []
    for group in groups:
        machines = sorted({device(row.entry) for row in group.rows if row.entry.time_measured})
        timed = f"; measured on {', '.join(machines)}" if machines else ""
        lines += [f"**{markdown_text(group.key.title + timed)}**", ""]
        lines += [*markdown_columns(_README_COLUMNS, group.rows[:SHOWN]), ""]
        more = len(group.rows) - SHOWN
        lines += [f"… and {more} more on the page", ""] if more > 0 else []
    results = [row.entry.result for group in groups for row in group.rows]
    assuming = sorted({result.submission.method for result in results if assumption(result)})
    notes = [_README_NOTE] + ([f"{' and '.join(assuming)} assume {ASSUMED}."] if assuming else [])
    notes += [LEGACY_NOTE] if any(group.key.is_legacy for group in groups) else []
    keys, titles = ("object_mae_mm", "object_rmse_mm", "overall_mae_mm"), [column.title for column in _README_ERRORS]
    paper = [
        [row.label, *(f"{row.errors_mm[key]:.2f}" for key in keys), f"told {TOLD[row.track]}"]
        for row in paper_tables()["architecture"].rows
    ]
    rows = [list(map(markdown_text, cells)) for cells in paper]
    lines += ["**Reported by the paper on other data, not measured here and not ranked with the rows above**", ""]
    lines += [*markdown_rows(["Method", *titles, "Note"], (False, True, True, True, False), rows), ""]
    return "\n".join([*lines, " ".join(notes)]) + "\n"


_RANK = Column("Rank", lambda row: row.ranks)
_METHOD = Column("Method", lambda row: printable(row.short_name), right=False)
_FRAMES = Column("Frames", lambda row: str(row.entry.frames))
_RELIANCE = Column("Phase reliance", lambda row: reliance(row.entry))
_ROBUSTNESS = Column("Disturbed, mm", lambda row: robustness(row.entry))
_PROVENANCE = Column("Provenance", lambda row: row.entry.provenance, right=False)
_README_ERRORS = (
    Column("Object MAE, mm", partial(_error, "object_mae_mm")),
    Column("Object RMSE", partial(_error, "object_rmse_mm")),
    Column("Overall MAE", partial(_error, "overall_mae_mm")),
)  # fmt: skip
_README_COLUMNS = (
    _RANK, _METHOD, _README_ERRORS[0], Column("95% interval", partial(_interval, between=" - ")), *_README_ERRORS[1:],
    Column("Time, ms", _milliseconds), _FRAMES, _RELIANCE, _ROBUSTNESS, _PROVENANCE,
)  # fmt: skip


def update_readme(path: Path, groups: Sequence[Group], check: bool) -> bool:
    """Whether ``path`` holds the block of ``groups`` already; if not, write it, except with ``check``."""
    try:
        text = path.read_bytes().decode("utf-8")
        begin, end = text.find(BEGIN), text.find(END)
        if text.count(BEGIN) != 1 or text.count(END) != 1 or end < begin:
            raise SubmissionError(
                f"{printable(str(path), 500)}: expected {BEGIN} and below it {END}, each once; put them where the "
                "ranking belongs"
            )
        updated = f"{text[: begin + len(BEGIN)]}\n\n{readme_block(groups)}\n{text[end:]}"
        if updated == text:
            return True
        if not check:
            write_atomically(path, updated.encode("utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        reason = "is no UTF-8 text" if isinstance(error, UnicodeDecodeError) else f"failed: {error.strerror}"
        raise SubmissionError(f"{printable(str(path), 500)} {reason}") from None
    return False
