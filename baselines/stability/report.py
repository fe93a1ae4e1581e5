"""The output of a run: JSON with every case, an HTML page, and a picture of the heat maps."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fpp_ml_bench.baselines.stability.case import Verdict
from fpp_ml_bench.baselines.stability.report_html import report_page
from fpp_ml_bench.baselines.stability.run import Row
from fpp_ml_bench.evaluation.result import environment
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.machine import numba_enabled

PAGE, DATA, PICTURE = "index.html", "stability.json", "stability.png"
SCHEMA_VERSION = "1.0.0"


def summary(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """By group, and under "all": cases per verdict, the largest error / bound, and processor time."""
    groups: dict[str, dict[str, Any]] = {}
    for group in [*dict.fromkeys(row.case.group for row in rows), "all"]:
        part = [row for row in rows if group in (row.case.group, "all")]
        ratios = [row.outcome.ratio for row in part if row.outcome.ratio is not None]
        groups[group] = {
            "cases": len(part),
            **{verdict.value: sum(row.verdict is verdict for row in part) for verdict in Verdict},
            "largest_ratio": number(max(ratios, default=None)),
            "cpu_seconds": round(sum(row.cpu_seconds for row in part), 2),
        }
    return groups


def number(value: float | None) -> float | str | None:
    """A number for JSON; NaN and infinity by name."""
    return value if value is None or math.isfinite(value) else str(value)


def row_dict(row: Row) -> dict[str, Any]:
    """A case as JSON values."""
    case, outcome = row.case, row.outcome
    return {
        "group": case.group,
        "family": case.family,
        "parameters": {
            key: number(value) if isinstance(value, float) else value for key, value in case.parameters.items()
        },
        "computes": case.computes,
        "reference": case.reference,
        "predicts": case.predicts,
        "unit": case.unit,
        "expects": case.expects,
        "verdict": row.verdict.value,
        "error": number(outcome.error),
        "bound": number(outcome.bound),
        "ratio": number(outcome.ratio),
        "flagged_share": outcome.flagged,
        "condition": number(outcome.condition),
        "note": outcome.note,
        "against": row.against,
        "cpu_seconds": round(row.cpu_seconds, 3),
    }  # fmt: skip


def document(rows: Sequence[Row]) -> dict[str, Any]:
    """The whole run as JSON values."""
    return {
        "schema_version": SCHEMA_VERSION,
        "summary": summary(rows),
        "compiled_decoder": numba_enabled(),
        "environment": environment().model_dump(mode="json"),
        "cases": [row_dict(row) for row in rows],
    }


def write_report(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write `PAGE`, `DATA` and `PICTURE` into ``folder``, which is made; their paths. Raises OSError."""
    from fpp_ml_bench.baselines.stability.picture import write_picture

    folder.mkdir(parents=True, exist_ok=True)
    content = document(rows)
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    write_atomically(folder / DATA, text.encode("utf-8"))
    write_atomically(folder / PAGE, report_page(rows, content).encode("utf-8"))
    write_picture(rows, folder / PICTURE)
    return [folder / PAGE, folder / DATA, folder / PICTURE]
