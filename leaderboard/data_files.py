"""The leaderboard as data: JSON with everything, a CSV with a line for each row. The same rows give the same bytes."""

import csv
import io
import json
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from fpp_ml_bench.evaluation.metrics import HEADLINE, WIDE, with_column
from fpp_ml_bench.evaluation.metrics import RANK_KEY as _MAIN
from fpp_ml_bench.leaderboard.columns import device, uncertainty
from fpp_ml_bench.leaderboard.groups import MOST_PAIRED, TEST, UNSEEN, Group, Ranked
from fpp_ml_bench.leaderboard.names import given_truth, learned_from
from fpp_ml_bench.leaderboard.tables import ReportedTable

_FORMULA = re.compile(r"[^\w=+@-]*[=+@-]")
"""A sign that begins a formula, before any letter or digit: behind spaces, quotes, a byte order mark."""


def table_json(groups: Sequence[Group], papers: Sequence[ReportedTable], sort: str) -> str:
    """The whole leaderboard as JSON: groups of rows with the tests of their pairs, and the tables of others apart. A
    table of more than `MOST_PAIRED` ranked rows has no list of pairs."""
    of_groups = [
        {
            **asdict(group.key),
            "title": group.title,
            "rows": [_json_row(group, row) for row in group.rows],
            "pairs": list(map(asdict, group.pairs)) if len(group.ranked) <= MOST_PAIRED else None,
            "notes": group.notes,
        }
        for group in groups
    ]
    content = {"sorted_by": sort, "groups": of_groups, "reported_by_others": list(map(asdict, papers))}
    return json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _json_row(group: Group, row: Ranked) -> dict[str, Any]:
    files = [part for part in (row.entry, row.unseen) if part is not None]
    parts = [{"source": part.path.name, **part.row.model_dump(mode="json")} for part in files]
    return {**_cells(group, row), "parts": parts}


def table_csv(groups: Sequence[Group]) -> str:
    """A line for each row, numbers with all digits, empty where there is none. Text that a spreadsheet would take for a
    formula has an apostrophe before it."""
    lines = [_cells(group, row) for group in groups for row in group.rows]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(lines[0]) if lines else [], lineterminator="\n")
    if lines:
        writer.writeheader()
    writer.writerows({key: _plain(value) for key, value in line.items()} for line in lines)
    return text.getvalue()


def _plain(value: object) -> object:
    """A cell that no spreadsheet runs, whatever stands before a formula, and in whichever width its sign is written."""
    is_formula = isinstance(value, str) and _FORMULA.match(unicodedata.normalize("NFKC", value))
    return f"'{value}" if is_formula else value


def _cells(group: Group, row: Ranked) -> dict[str, object]:
    key, entry, about = group.key, row.entry, row.entry.row
    timing, reliance, disturbed = about.timing, about.reliance, (about.robustness or {}).get("test")
    low, high = row.interval(_MAIN) or (None, None)
    covered, ause_mm = uncertainty(entry)
    parts = {
        f"{_MAIN}_{name}": part and part.value(_MAIN)
        for name, part in zip(("test", "unseen"), map(row.on, (TEST, UNSEEN)), strict=True)
    }
    errors = dict.fromkeys((*HEADLINE, *(metric.key for metric in with_column(WIDE))))
    return {
        "data": key.data_title,
        "samples": group.parts,
        "class": key.frames,
        "code": about.dataset.code,
        "track": key.track,
        "mode": key.mode,
        "target": key.target,
        "protocol": key.protocol_version,
        "best_rank": row.best_rank,
        "worst_rank": row.worst_rank,
        "place": row.place,
        "short_name": row.short_name,
        "name": entry.name,
        "method": about.submission.method,
        "objects": len(row.objects),
        _MAIN: row.value(_MAIN),
        f"{_MAIN}_low": low,
        f"{_MAIN}_high": high,
        **parts,
        "ratio_to_trivial": row.ratio,
        **{name: row.value(name) for name in errors if name != _MAIN},
        "latency_median_ms": entry.latency_ms,
        "latency_p5_ms": timing and timing.latency_p5_ms,
        "latency_p95_ms": timing and timing.latency_p95_ms,
        "time_measured_here": entry.time_measured,
        "timed_on": device(entry),
        "frames_used": entry.frames,
        "phase_reliance": reliance and reliance.score,
        "disturbed_mae_mm": disturbed and disturbed.mae_mm,
        "within_stated_95": covered,
        "ause_mae_mm": ause_mm,
        "learned_from": learned_from(about),
        "given_truth": given_truth(key.track),
        "provenance": row.provenance,
        "source": entry.path.name,
    }
