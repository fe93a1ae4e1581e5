"""The rows that the paper reports. This package did not measure them, and they are never ranked with measured rows;
``paper_rows.json`` holds them as typed in from the paper's tables."""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from fpp_ml_bench.baselines.training import TABLES
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import HEADLINE
from fpp_ml_bench.files import printable

PAPER_FILE = Path(__file__).resolve().parent / "paper_rows.json"
PAPER_HEADING = "Reported by the paper on other data (not measured here)"
PAPER_TABLES = TABLES
SHOWN_BY_DEFAULT = ("architecture", "normalization")


@dataclass(frozen=True)
class PaperRow:
    """A row of a table: errors in mm by the keys of `HEADLINE`, on ``test_samples`` (view, frame) pairs."""

    row: str
    label: str
    track: str
    test_samples: int
    errors_mm: dict[str, float]


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper, its rows in the paper's order."""

    name: str
    title: str
    rows: tuple[PaperRow, ...]


@cache
def paper_tables() -> dict[str, PaperTable]:
    """Every table by name, in the order of `PAPER_TABLES`."""
    content = json.loads(PAPER_FILE.read_text(encoding="utf-8"))
    if tuple(content["columns"]) != HEADLINE:
        raise SubmissionError(f"{PAPER_FILE}: expected the columns {', '.join(HEADLINE)}; reinstall the package")
    tables = {}
    for table in content["tables"]:
        rows = tuple(
            PaperRow(**{**row, "errors_mm": dict(zip(HEADLINE, row["errors_mm"], strict=True))})
            for row in table["rows"]
        )
        tables[table["name"]] = PaperTable(table["name"], table["title"], rows)
    return {name: tables[name] for name in PAPER_TABLES}


def chosen_tables(choice: str | None) -> list[PaperTable]:
    """Tables for ``--paper``: None for those shown by default, ``all``, ``none``, or one table's name."""
    if choice == "none":
        return []
    if choice is None:
        return [paper_tables()[name] for name in SHOWN_BY_DEFAULT]
    if choice == "all":
        return list(paper_tables().values())
    if choice not in PAPER_TABLES:
        raise SubmissionError(f"expected a table out of {', '.join(PAPER_TABLES)}, got {printable(choice)!r}")
    return [paper_tables()[choice]]
