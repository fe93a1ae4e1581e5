"""The leaderboard as tables in the terminal and as Markdown. The same rows give the same bytes."""

import re
from collections.abc import Iterable, Sequence
from functools import partial

from rich.text import Text

from fpp_ml_bench.evaluation.report.html import interval_text, millimetres
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.columns import METHOD, NOTE, ONLY_IN_FILES, Column, columns
from fpp_ml_bench.leaderboard.groups import MOST_PAIRED, Group, Pair, Ranked
from fpp_ml_bench.leaderboard.reported import REPORTED_HEADING, ReportedRow, ReportedTable
from fpp_ml_bench.tables import Table

NO_RESULTS = """\
No results here yet. Score predictions, and their row appears:
  fpp-bench predict classical data/mini --split test --out predictions
  fpp-eval predictions data/mini --split test --json result.json
  fpp-bench leaderboard result.json
Without arguments, result*.json and results/*.json of the current folder are read.
"""
PAPER_TITLES = (
    "Row",
    "Track",
    "Test samples",
    "Object MAE",
    "Object RMSE",
    "Overall MAE",
    "Overall RMSE",
    "Backgr. MAE",
    "Backgr. RMSE",
)
PAPER_TEXT_COLUMNS = 2
PAIR_TITLES = ("First", "Second", "Second - first", "95% interval", "p", "p, Holm", "Objects", "Verdict")
PAIR_TEXT_COLUMNS = 2
PAIRS_FIRST_OUT = ("Objects", "p", "95% interval", "p, Holm")
LAST_OUT = ("Frames", "s/sample", "x trivial", "Object MAE")
"""In a narrow terminal, the columns of a ranking that are left out after all others of their width, in this order."""
_PLAIN = frozenset(" -,+()/%=.")


def paper_cells(row: ReportedRow) -> list[str]:
    """Cells under `PAPER_TITLES`, errors with the two decimals of their tables."""
    keys = (f"{pixels}_{error}_mm" for pixels in ("object", "overall", "background") for error in ("mae", "rmse"))
    errors = [f"{row.errors_mm[key]:.2f}" if key in row.errors_mm else "-" for key in keys]
    return [row.label, row.track, "-" if row.test_samples is None else str(row.test_samples), *errors]


def pair_cells(pair: Pair) -> list[str]:
    """Cells under `PAIR_TITLES`."""
    verdict = "second is behind" if pair.behind else "not told apart"
    return [
        pair.first,
        pair.second,
        millimetres(pair.difference),
        interval_text(pair.interval, " to "),
        f"{pair.p:.2g}",
        f"{pair.p_holm:.2g}",
        str(pair.objects),
        verdict,
    ]


def group_tables(groups: Sequence[Group], sort: str, with_pairs: bool = False) -> list[Table | Text]:
    """A table for each group, ``with_pairs`` a second one of its pairs; without groups, how to begin. Submitted text
    goes in as `Text`: it is never markup."""
    if not groups:
        return [Text(NO_RESULTS)]
    parts: list[Table | Text] = []
    for group in groups:
        shown = [c for c in columns(sort) if c.from_width < ONLY_IN_FILES and c.shown_for(group.rows)]
        titles = [(_two_lines(column.title), column.right) for column in shown]
        table = _rich_table(group.title, titles, [[column.text(row) for column in shown] for row in group.rows])
        table.names = 1 + shown.index(METHOD)
        shown.reverse()  # of equal importance, the rightmost is left out first
        table.first_out = [_two_lines(column.title) for column in sorted(shown, key=partial(_importance, sort))]
        parts += [table, Text("".join(f"{note}\n" for note in group.notes))]
        if with_pairs and len(group.ranked) > MOST_PAIRED:
            parts.append(Text(f"The pairs of more than {MOST_PAIRED} ranked rows are not listed.\n"))
        elif with_pairs and group.pairs:
            titles = [(title, number >= PAIR_TEXT_COLUMNS) for number, title in enumerate(PAIR_TITLES)]
            table = _rich_table("Pairs of these rows", titles, map(pair_cells, group.pairs))
            table.names, table.first_out, table.elsewhere = PAIR_TEXT_COLUMNS, PAIRS_FIRST_OUT, "--json FILE"
            parts.append(table)
    return [*parts, Text(f"{NOTE}\n")]


def _two_lines(title: str) -> str:
    return title.replace(" ", "\n", 1)  # leaves more width for the names


def _importance(sort: str, column: Column) -> tuple[bool, int, int]:
    """Sort key of the columns: those of a low importance are left out first. What rows are sorted by stays longest."""
    is_sorted_by = getattr(column.text, "args", None) == (sort,)
    return is_sorted_by, -column.from_width, LAST_OUT.index(column.title) if column.title in LAST_OUT else -1


def _rich_table(title: str, titles: Iterable[tuple[str, bool]], rows: Iterable[Sequence[str]]) -> Table:
    """``titles`` of columns, and whether they are numbers."""
    table = Table(title=Text(title), elsewhere="--markdown FILE")
    for name, right in titles:
        table.add_column(name, justify="right" if right else "left")
    for cells in rows:
        table.add_row(*map(Text, cells))
    return table


def paper_rich_tables(tables: Sequence[ReportedTable]) -> list[Table | Text]:
    """The tables of others under their heading."""
    parts: list[Table | Text] = [Text(REPORTED_HEADING, style="bold")] if tables else []
    titles = [(title, number >= PAPER_TEXT_COLUMNS) for number, title in enumerate(PAPER_TITLES)]
    for paper in tables:
        table = _rich_table(f"{paper.name}: {paper.title}, mm", titles, map(paper_cells, paper.rows))
        parts += [table, Text(f"{paper.note}\n")]
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
    shown = [column for column in shown if column.shown_for(rows)]
    cells = [[markdown_text(column.text(row)) for column in shown] for row in rows]
    return markdown_rows([column.title for column in shown], [column.right for column in shown], cells)


def markdown(groups: Sequence[Group], papers: Sequence[ReportedTable], sort: str) -> str:
    """The whole leaderboard as Markdown, ending in a newline."""
    lines: list[str] = []
    for group in groups:
        lines += [f"### {markdown_text(group.title)}", "", *markdown_columns(columns(sort), group.rows), ""]
        for note in group.notes:
            lines += [markdown_text(note), ""]
    lines += [NOTE.replace("*", "\\*"), ""] if groups else []
    lines += [f"### {REPORTED_HEADING}", ""] if papers else []
    right = [number >= PAPER_TEXT_COLUMNS for number in range(len(PAPER_TITLES))]
    for paper in papers:
        rows = [list(map(markdown_text, paper_cells(row))) for row in paper.rows]
        lines += [markdown_text(f"{paper.name}: {paper.title}, mm"), "", *markdown_rows(PAPER_TITLES, right, rows), ""]
        lines += [paper.note, ""]
    return "\n".join(lines).rstrip("\n") + "\n"
