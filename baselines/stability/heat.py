"""Colours and order of the heat maps: a row per family, a cell per case, coloured by error / bound."""

import math
from collections.abc import Sequence

from fpp_ml_bench.baselines.stability.case import Verdict
from fpp_ml_bench.baselines.stability.run import Row

LEVELS = (
    ("exact", "error 0", "#dff1ea"),
    ("far", "error under 1/1000 of its bound", "#b5dfcf"),
    ("near", "1/1000 to 1/10 of the bound", "#74bf9f"),
    ("close", "1/10 to 1/2 of the bound", "#2f9470"),
    ("tight", "1/2 to the whole bound", "#0b6b50"),
    ("flagged", "correctly refused or masked", "#b9c0c8"),
    ("fail", "FAIL", "#d1242f"),
)
"""Name, meaning and colour of each level."""


def level(row: Row) -> str:
    """The name of a case's level."""
    if row.verdict is Verdict.FAIL:
        return "fail"
    if row.verdict is Verdict.FLAGGED:
        return "flagged"
    ratio = row.outcome.ratio or 0.0
    if ratio == 0:
        return "exact"
    return "far" if ratio < 1e-3 else "near" if ratio < 0.1 else "close" if ratio < 0.5 else "tight"


def families(rows: Sequence[Row]) -> dict[str, dict[str, list[Row]]]:
    """Rows by group and family, in the order in which they ran."""
    grouped: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        grouped.setdefault(row.case.group, {}).setdefault(row.case.family, []).append(row)
    return grouped


def figure(value: float | None) -> str:
    """A number for a table."""
    if value is None:
        return "-"
    return f"{value:.2g}" if math.isfinite(value) else str(value)
