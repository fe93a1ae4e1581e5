"""The leaderboard in the terminal."""

from collections.abc import Sequence
from typing import Literal

from rich.table import Table
from rich.text import Text

from fpp_ml_bench.leaderboard.columns import NOTE, ONLY_IN_FILES, PAPER_TITLES, columns, paper_cells, paper_note
from fpp_ml_bench.leaderboard.groups import LEGACY_NOTE, Group
from fpp_ml_bench.leaderboard.paper import PAPER_HEADING, PaperTable

NO_RESULTS = """\
No results here yet. Score predictions, and their row appears:
  fpp-bench predict classical data/mini --split test --out predictions
  fpp-eval predictions --dataset data/mini --split test --json result.json
  fpp-bench leaderboard result.json
Without arguments, result*.json and results/*.json of the current folder are read.
"""


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
    if not tables:
        return []
    parts: list[Table | Text] = [Text(PAPER_HEADING[0].upper() + PAPER_HEADING[1:], style="bold")]
    for paper in tables:
        table = Table(title=f"{paper.name}: {paper.title}, mm", title_justify="left")
        for number, title in enumerate(PAPER_TITLES):
            table.add_column(title, justify="right" if number > 1 else "left")
        for row in paper.rows:
            table.add_row(*paper_cells(row))
        parts += [table, Text(f"{paper_note(paper)}\n")]
    return parts
