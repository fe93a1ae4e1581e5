"""README's block of the leaderboard: between two markers, made from the rows, never edited by hand."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from fpp_ml_bench.baselines.phase_route.method import ONE_ALBEDO
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.files import printable, write_atomically
from fpp_ml_bench.leaderboard import columns
from fpp_ml_bench.leaderboard.assumptions import assumption, told
from fpp_ml_bench.leaderboard.columns import NOT_CHECKED, Column, device, error
from fpp_ml_bench.leaderboard.groups import Group
from fpp_ml_bench.leaderboard.reported import PAPER_DEPTHS, REPORTED_HEADING, chosen_tables
from fpp_ml_bench.leaderboard.tables import markdown_columns, markdown_rows, markdown_text
from fpp_ml_bench.leaderboard.trivial import more_than_trivial

BEGIN, END = "<!-- leaderboard:begin -->", "<!-- leaderboard:end -->"
SHOWN = 5
"""Rows of a group that README shows; the page shows them all."""
_MADE_BY = "Made by `fpp-bench leaderboard --readme README.md` from the files in `leaderboard/rows/`."
_NOTE = (
    f"{_MADE_BY} Errors in mm. {columns.RANK_NOTE} {columns.TRUST_NOTE} Intervals: bootstrap over objects. "
    f"{columns.RATIO_NOTE} Time: median latency of one image. Phase reliance: 1 follows the fringe's phase and nothing "
    "else, 0 does not follow it (docs/reliance.md). Disturbed: object MAE over all axes and severities of disturbed "
    "scenes, with 150 mm for a pixel without an answer (docs/robustness.md)."
).replace(NOT_CHECKED, f"\\{NOT_CHECKED}")
_ERRORS = (
    Column("Object MAE, mm", partial(error, "object_mae_mm")),
    Column("Object RMSE", partial(error, "object_rmse_mm")),
    Column("Overall MAE", partial(error, "overall_mae_mm")),
)
_COLUMNS = (
    columns.RANK,
    columns.METHOD,
    columns.CODE,
    _ERRORS[0],
    Column("95% interval", partial(columns.interval, between=" - ")),
    *columns.PARTS,
    columns.RATIO,
    columns.RANGE,
    *_ERRORS[1:],
    Column("Time, ms", columns.milliseconds_text),
    columns.FRAMES,
    columns.RELIANCE,
    columns.ROBUSTNESS,
    columns.PROVENANCE,
)


def readme_block(groups: Sequence[Group]) -> str:
    """What is between README's markers: the best `SHOWN` rows of each group that is not `GroupKey.aside`, and the
    paper's architectures."""
    if not groups:
        return f"No row yet. {_MADE_BY}\n"
    others = list(dict.fromkeys(group.key.aside for group in groups if group.key.aside))
    groups, lines = [group for group in groups if not group.key.aside], []
    for group in more_than_trivial(groups):
        machines = sorted({device(row.entry) for row in group.rows if row.entry.time_measured})
        timed = f"; measured on {', '.join(machines)}" if machines else ""
        lines += [f"**{markdown_text(group.title + timed)}**", ""]
        lines += [*markdown_columns(_COLUMNS, group.rows[:SHOWN]), ""]
        more = len(group.rows) - SHOWN
        lines += [f"… and {more} more on the page", ""] if more > 0 else []
    shown = [row.entry.row for group in groups for row in group.rows]
    assuming = sorted({row.submission.method for row in shown if assumption(row)})
    notes = [_NOTE] + ([f"{' and '.join(assuming)} assume {ONE_ALBEDO.words}."] if assuming else [])
    notes += [f"Rows of other data ({'; '.join(others)}) are on the page."] if others else []
    notes += dict.fromkeys(markdown_text(note) for group in groups for note in (*group.notes, *group.key.notes))
    keys, titles = ("object_mae_mm", "object_rmse_mm", "overall_mae_mm"), [column.title for column in _ERRORS]
    reported = [
        [
            row.label,
            *(f"{row.errors_mm[key]:.2f}" if key in row.errors_mm else "-" for key in keys),
            f"{table.source}, told {told(row.track)}",
        ]
        for table in (*chosen_tables("architecture"), *chosen_tables("oracle_order"))
        for row in table.rows
    ]
    rows = [list(map(markdown_text, cells)) for cells in reported]
    lines += [f"**{REPORTED_HEADING}, not ranked with the rows above**", ""]
    lines += [*markdown_rows(["Method", *titles, "Note"], (False, True, True, True, False), rows), ""]
    return "\n".join([*lines, " ".join([PAPER_DEPTHS, *notes])]) + "\n"


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
