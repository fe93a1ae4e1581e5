"""Rows that were typed in: the paper's own (`fpp_ml_bench.paper`), and those of other publications on its dataset, in
``reported_rows.json``. This package did not measure them, and they are never ranked with measured rows."""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from fpp_ml_bench.leaderboard.assumptions import told
from fpp_ml_bench.leaderboard.rows import BY_ITS_AUTHORS, BY_THE_PAPER
from fpp_ml_bench.paper import paper_rows

REPORTED_HEADING = "Reported by others on other data (not measured here)"
PAPER_DEPTHS = (
    "The paper gives its objects a depth of 80 mm in general, and 216 and 465 mm to two in its figures; those of the "
    "test split here are 262 mm deep at 224 px and 282 mm at 960 px (medians). A network at 224 px does not reproduce "
    "the paper's."
)
"""What is said beside each comparison with the paper."""
SHOWN_BY_DEFAULT = ("architecture", "normalization", "oracle_order")


@dataclass(frozen=True)
class ReportedRow:
    """A row of a table: errors in mm by the keys of `HEADLINE`, as far as they are reported, on ``test_samples`` (view,
    frame) pairs, None where that is not said."""

    row: str
    label: str
    track: str
    test_samples: int | None
    errors_mm: dict[str, float]


@dataclass(frozen=True)
class ReportedTable:
    """A table of the paper, its rows in the paper's order, or of another ``source``. ``figure``: the ``object`` of the
    figure beside the table, and ``object_mae_mm`` of one sample of it by row."""

    name: str
    title: str
    rows: tuple[ReportedRow, ...]
    source: str = BY_THE_PAPER
    figure: dict[str, Any] | None = None

    @property
    def note(self) -> str:
        """Below the table: who measured, on what, and what the methods of its tracks were told."""
        depths = [PAPER_DEPTHS] if self.source == BY_THE_PAPER else []
        given = [f"{track}: told {told(track)}." for track in sorted({row.track for row in self.rows}) if told(track)]
        source = f"{self.source[0].upper()}{self.source[1:]}"
        said = [f"{source}. Other data, not ranked with the rows above.", *depths, *given]
        if self.figure is not None:
            errors = ", ".join(f"{row} {error:g}" for row, error in self.figure["object_mae_mm"].items())
            said.append(f"Its figure, one sample of {self.figure['object']}, object MAE in mm: {errors}.")
        return " ".join(said)


@cache
def reported_tables() -> dict[str, ReportedTable]:
    """Every table by name: the paper's in its order, then those of other publications."""
    others = json.loads(Path(__file__).with_name("reported_rows.json").read_text(encoding="utf-8"))
    tables = {}
    for content in (paper_rows(), others):
        for table in content["tables"]:
            rows = []
            for row in table["rows"]:
                errors_mm = dict(zip(content["columns"], row["errors_mm"], strict=True))
                rows.append(ReportedRow(**row | {"errors_mm": errors_mm}))
            source = f"{BY_ITS_AUTHORS} ({table['source']})" if "source" in table else BY_THE_PAPER
            name, title = table["name"], table["title"]
            tables[name] = ReportedTable(name, title, tuple(rows), source, table.get("figure"))
    return tables


def paper_tables() -> dict[str, ReportedTable]:
    """The tables of the paper by name."""
    return {name: table for name, table in reported_tables().items() if table.source == BY_THE_PAPER}


def chosen_tables(choice: str | None) -> list[ReportedTable]:
    """Tables for ``--paper``: None for those shown by default, ``all``, ``none``, or one table's name."""
    tables = reported_tables()
    several = {None: SHOWN_BY_DEFAULT, "all": tuple(tables), "none": ()}
    return [tables[name] for name in several.get(choice, (str(choice),))]
