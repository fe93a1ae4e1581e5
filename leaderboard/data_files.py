"""The leaderboard as data: JSON with everything, a CSV with a line for each row. The same rows give the same bytes."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from fpp_ml_bench.evaluation.protocol import HEADLINE
from fpp_ml_bench.leaderboard.assumptions import assumption_sentences, learned_from, told
from fpp_ml_bench.leaderboard.columns import device, uncertainty
from fpp_ml_bench.leaderboard.groups import TEST, UNSEEN, Group, Ranked
from fpp_ml_bench.leaderboard.reported import ReportedTable

_MAIN = "object_mae_mm"
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def table_json(groups: Sequence[Group], papers: Sequence[ReportedTable], sort: str) -> str:
    """The whole leaderboard as JSON: groups of rows with the tests of their pairs, and the tables of others apart."""
    of_groups = [
        {
            **asdict(group.key), "title": group.title, "legacy": group.key.is_legacy,
            "dataset": group.dataset_name, "rows": list(map(_json_row, group.rows)),
            "pairs": list(map(asdict, group.pairs)), "why_no_ranks": group.unranked or None,
        }
        for group in groups
    ]  # fmt: skip
    content = {"sorted_by": sort, "groups": of_groups, "reported_by_others": list(map(asdict, papers))}
    return json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _json_row(row: Ranked) -> dict[str, Any]:
    entry, result = row.entry, row.entry.result
    timing, reliance = (part and part.model_dump(mode="json") for part in (result.timing, result.reliance))
    disturbed = {name: block.model_dump(mode="json") for name, block in (result.robustness or {}).items()}
    return {
        "best_rank": row.best_rank, "worst_rank": row.worst_rank, "name": entry.name, "short_name": row.short_name,
        "method": result.submission.method, "provenance": entry.provenance, "objects": len(row.objects),
        _MAIN: row.value(_MAIN), "interval_mm": row.interval(_MAIN), "ratio_to_trivial": row.ratio,
        "metrics": result.metrics.model_dump(mode="json"), "intervals": result.intervals.model_dump(mode="json"),
        "per_object": [part.model_dump(mode="json") for part in result.per_object],
        "unseen": None if row.unseen is None else {
            "metrics": row.unseen.result.metrics.model_dump(mode="json"),
            "intervals": row.unseen.result.intervals.model_dump(mode="json"),
            "per_object": [part.model_dump(mode="json") for part in row.unseen.result.per_object],
            "source": row.unseen.path.name,
        },
        "seconds_per_sample": entry.value("seconds_per_sample"), "time_measured_here": entry.time_measured,
        "timing": timing, "phase_reliance": reliance, "robustness": disturbed, "timed_on": device(entry),
        "assumes": assumption_sentences(result), "learned_from": learned_from(result) or None,
        "frames_used": entry.frames, "samples": result.dataset.samples,
        "created": result.created, "source": entry.path.name,
    }  # fmt: skip


def table_csv(groups: Sequence[Group]) -> str:
    """A line for each row, numbers with all digits, empty where there is none. Text that a spreadsheet would take for a
    formula has an apostrophe before it."""
    lines = [_csv_row(group, row) for group in groups for row in group.rows]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(lines[0]) if lines else [], lineterminator="\n")
    if lines:
        writer.writeheader()
    writer.writerows({key: _plain(value) for key, value in line.items()} for line in lines)
    return text.getvalue()


def _plain(value: object) -> object:
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value


def _csv_row(group: Group, row: Ranked) -> dict[str, object]:
    key, entry, result = group.key, row.entry, row.entry.result
    timing, reliance, disturbed = result.timing, result.reliance, (result.robustness or {}).get("test")
    low, high = row.interval(_MAIN) or (None, None)
    covered, ause_mm = uncertainty(entry)
    parts = {f"{_MAIN}_{name}": part and part.value(_MAIN) for name, part in zip(
        ("test", "unseen"), map(row.on, (TEST, UNSEEN)), strict=True
    )}  # fmt: skip
    return {
        "data": key.data_title, "fingerprint": key.fingerprint, "samples": group.parts, "class": key.frames,
        "track": key.track, "mode": key.mode, "target": key.target, "protocol": key.protocol_version,
        "best_rank": row.best_rank, "worst_rank": row.worst_rank, "short_name": row.short_name, "name": entry.name,
        "method": result.submission.method, "objects": len(row.objects), _MAIN: row.value(_MAIN),
        f"{_MAIN}_low": low, f"{_MAIN}_high": high, **parts, "ratio_to_trivial": row.ratio,
        **{name: row.value(name) for name in (*HEADLINE, "object_missing_share") if name != _MAIN},
        "latency_median_ms": entry.latency_ms, "latency_p5_ms": timing and timing.latency_p5_ms,
        "latency_p95_ms": timing and timing.latency_p95_ms, "time_measured_here": entry.time_measured,
        "timed_on": device(entry), "frames_used": entry.frames, "phase_reliance": reliance and reliance.score,
        "disturbed_mae_mm": disturbed and disturbed.mae_mm, "within_stated_95": covered, "ause_mae_mm": ause_mm,
        "learned_from": learned_from(result), "told": told(key.track), "provenance": entry.provenance,
        "source": entry.path.name,
    }  # fmt: skip
