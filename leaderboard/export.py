"""The leaderboard as files: Markdown for a README, JSON for a page. The same rows give the same bytes."""

import json
import re
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.columns import NOTE, PAPER_TITLES, columns, device, paper_cells, paper_note
from fpp_ml_bench.leaderboard.groups import LEGACY_NOTE, Group, Ranked, assumption_sentences
from fpp_ml_bench.leaderboard.paper import PAPER_HEADING, PaperTable

_PLAIN = frozenset(" -,+()/%=.")


def markdown_text(text: str) -> str:
    """``text`` as Markdown that shows exactly this text: punctuation that could be markup becomes a character entity.

    Entities are never structure (CommonMark 6.2): no pipe ends a table cell, no tag, link, code or mention begins.
    """
    safe = "".join(c if not c.isascii() or c.isalnum() or c in _PLAIN else f"&#{ord(c)};" for c in printable(text))
    return re.sub(r"(?i)(www)\.", r"\1&#46;", safe)  # GitHub links bare www. names too


def markdown_rows(titles: Sequence[str], right: Sequence[bool], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table; ``right`` says which columns are aligned to the right. Cells are Markdown already."""
    rules = (" ---: " if to_right else " --- " for to_right in right)
    lines = ["| " + " | ".join(titles) + " |", "|" + "|".join(rules) + "|"]
    return lines + ["| " + " | ".join(cells) + " |" for cells in rows]


def markdown(groups: Sequence[Group], papers: Sequence[PaperTable], sort: str) -> str:
    """The whole leaderboard as Markdown, ending in a newline."""
    lines: list[str] = []
    shown = columns(sort)
    for group in groups:
        rows = [[markdown_text(column.text(row)) for column in shown] for row in group.rows]
        titles, right = [column.title for column in shown], [column.right for column in shown]
        lines += [f"### {markdown_text(group.key.title)}", "", *markdown_rows(titles, right, rows), ""]
        lines += [LEGACY_NOTE, ""] if group.key.is_legacy else []
    if groups:
        lines += [NOTE.replace("*", "\\*"), ""]
    if papers:
        lines += [f"### {PAPER_HEADING[0].upper() + PAPER_HEADING[1:]}", ""]
    for paper in papers:
        rows = [[markdown_text(cell) for cell in paper_cells(row)] for row in paper.rows]
        right = [number > 1 for number in range(len(PAPER_TITLES))]
        lines += [
            f"{markdown_text(f'{paper.name}: {paper.title}, mm')}",
            "",
            *markdown_rows(PAPER_TITLES, right, rows),
            "",
            paper_note(paper),
            "",
        ]
    return "\n".join(lines).rstrip("\n") + "\n"


def table_json(groups: Sequence[Group], papers: Sequence[PaperTable], sort: str) -> str:
    """The whole leaderboard as JSON: groups of ranked rows, and the paper's tables apart."""
    content = {
        "sorted_by": sort,
        "groups": [
            {
                **asdict(group.key),
                "title": group.key.title,
                "legacy": group.key.is_legacy,
                "dataset": group.dataset_name,
                "rows": [_row(row) for row in group.rows],
            }
            for group in groups
        ],
        "reported_by_the_paper": [asdict(paper) for paper in papers],
    }
    return json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _row(row: Ranked) -> dict[str, Any]:
    result = row.entry.result
    submission = result.submission
    return {
        "best_rank": row.best_rank,
        "worst_rank": row.worst_rank,
        "name": submission.name,
        "short_name": row.short_name,
        "method": submission.method,
        "provenance": row.entry.provenance,
        "metrics": result.metrics.model_dump(mode="json"),
        "intervals": result.intervals.model_dump(mode="json"),
        "per_object": [part.model_dump(mode="json") for part in result.per_object],
        "seconds_per_sample": row.entry.value("seconds_per_sample"),
        "time_measured_here": row.entry.time_measured,
        "timing": None if result.timing is None else result.timing.model_dump(mode="json"),
        "phase_reliance": None if result.reliance is None else result.reliance.model_dump(mode="json"),
        "timed_on": device(row.entry),
        "assumes": assumption_sentences(result),
        "frames_used": row.entry.frames,
        "samples": result.dataset.samples,
        "created": result.created,
        "source": row.entry.path.name,
    }
