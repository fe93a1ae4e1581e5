"""The ranking in README.md, between two markers: generated from the rows, not edited by hand."""

from collections.abc import Sequence
from pathlib import Path

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.report import millimetres
from fpp_ml_bench.files import printable, write_atomically
from fpp_ml_bench.leaderboard import tables
from fpp_ml_bench.leaderboard.groups import ASSUMED, LEGACY_NOTE, TOLD, Group, assumption
from fpp_ml_bench.leaderboard.paper import paper_tables
from fpp_ml_bench.leaderboard.ranking import DEFAULT_SORT
from fpp_ml_bench.leaderboard.rows import Entry
from fpp_ml_bench.leaderboard.tables import Column, markdown_rows, markdown_text

BEGIN, END = "<!-- leaderboard:begin -->", "<!-- leaderboard:end -->"
_COLUMNS = (
    Column("Rank", lambda row: row.ranks),
    Column("Method", lambda row: printable(row.short_name), right=False),
    Column("Object MAE, mm", lambda row: millimetres(row.entry.value(DEFAULT_SORT))),
    Column("95% interval", lambda row: " - ".join(map(millimetres, row.entry.interval(DEFAULT_SORT) or ())) or "-"),
    Column("Object RMSE", lambda row: millimetres(row.entry.value("object_rmse_mm"))),
    Column("Overall MAE", lambda row: millimetres(row.entry.value("overall_mae_mm"))),
    Column("Time, ms", lambda row: _time(row.entry)),
    Column("Frames", lambda row: str(row.entry.frames)),
    Column("Phase reliance", lambda row: tables.reliance(row.entry)),
    Column("Provenance", lambda row: row.entry.provenance, right=False),
)
_MADE_BY = "Made by `fpp-bench leaderboard --readme README.md` from the files in `leaderboard/rows/`."
_NOTE = (
    f"{_MADE_BY} Errors in mm. {tables.RANK_NOTE} Intervals: bootstrap over objects. Time: median latency of one "
    f"image. \\{tables.SELF_REPORTED} self-reported. Phase reliance: 1 follows the fringe's phase and nothing else, 0 "
    "does not follow it (docs/reliance.md)."
)
SHOWN = 5
"""Rows of a group that README shows; the page shows them all."""
_NO_ROWS = f"No row yet. {_MADE_BY}"
_PAPER_TABLE = "architecture"
_PAPER_KEYS = ("object_mae_mm", "object_rmse_mm", "overall_mae_mm")
_PAPER_TITLES = ("Method", "Object MAE, mm", "Object RMSE", "Overall MAE", "Note")


def readme_block(groups: Sequence[Group]) -> str:
    """What is between the markers: the best `SHOWN` rows of each group; the same rows give the same bytes."""
    if not groups:
        return f"{_NO_ROWS}\n"
    lines: list[str] = []
    for group in groups:
        machines = sorted({tables.device(row.entry) for row in group.rows if row.entry.time_measured})
        timed = f"; measured on {', '.join(machines)}" if machines else ""
        lines += [f"**{markdown_text(group.key.title + timed)}**", ""]
        lines += [*tables.markdown_columns(_COLUMNS, group.rows[:SHOWN]), ""]
        more = len(group.rows) - SHOWN
        lines += [f"… and {more} more on the page", ""] if more > 0 else []
    notes = [_NOTE, *_assumptions(groups), *([LEGACY_NOTE] if any(group.key.is_legacy for group in groups) else [])]
    return "\n".join([*lines, *_paper_lines(), " ".join(notes)]) + "\n"


def _time(entry: Entry) -> str:
    mark = "" if entry.time_measured else tables.SELF_REPORTED
    return "-" if entry.latency_ms is None else f"{entry.latency_ms:.3g}{mark}"


def _assumptions(groups: Sequence[Group]) -> list[str]:
    """A sentence with the methods in ``groups`` that assume something of the scene."""
    results = [row.entry.result for group in groups for row in group.rows]
    methods = sorted({result.submission.method for result in results if assumption(result)})
    return [f"{' and '.join(methods)} assume {ASSUMED}."] if methods else []


def _paper_lines() -> list[str]:
    """The paper's architectures as reported, on other data."""
    cells = [
        [row.label, *(f"{row.errors_mm[key]:.2f}" for key in _PAPER_KEYS), f"told {TOLD[row.track]}"]
        for row in paper_tables()[_PAPER_TABLE].rows
    ]
    rows = [[markdown_text(cell) for cell in row] for row in cells]
    heading = "**Reported by the paper on other data, not measured here and not ranked with the rows above**"
    return [heading, "", *markdown_rows(_PAPER_TITLES, (False, True, True, True, False), rows), ""]


def with_block(text: str, block: str, path: Path) -> str:
    """``text`` of the file ``path`` with ``block`` between the markers. SubmissionError unless it holds each marker
    once, in order."""
    begin, end = text.find(BEGIN), text.find(END)
    if text.count(BEGIN) != 1 or text.count(END) != 1 or end < begin:
        raise SubmissionError(
            f"{printable(str(path), 500)}: expected {BEGIN} and below it {END}, each once; put them where the ranking "
            "belongs"
        )
    return f"{text[: begin + len(BEGIN)]}\n\n{block}\n{text[end:]}"


def update_readme(path: Path, groups: Sequence[Group], check: bool) -> bool:
    """Whether ``path`` holds the block of ``groups`` already; if not, write it, except with ``check``."""
    try:
        text = path.read_bytes().decode("utf-8")
        updated = with_block(text, readme_block(groups), path)
        if updated == text:
            return True
        if not check:
            write_atomically(path, updated.encode("utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        reason = "is no UTF-8 text" if isinstance(error, UnicodeDecodeError) else f"failed: {error.strerror}"
        raise SubmissionError(f"{printable(str(path), 500)} {reason}") from None
    return False
