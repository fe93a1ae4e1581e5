"""The leaderboard as tables in the terminal, as Markdown, and as data: JSON with everything, a CSV
with a line for each row; the same rows give the same bytes. And the tables that were typed in: the
paper's own (`fpp_ml_bench.paper`), and those of other publications on its dataset, in
``reported_rows.json``. This package did not measure their rows, and they are never ranked with
measured ones."""

import csv
import io
import json
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from rich.text import Text

from fpp_ml_bench.evaluation.metrics import HEADLINE, WIDE, with_column
from fpp_ml_bench.evaluation.score.uncertainty import Pair
from fpp_ml_bench.leaderboard.columns import (
    METHOD,
    NOTE,
    ONLY_IN_FILES,
    Column,
    columns,
    device,
    given_truth,
    learned_from,
    uncertainty,
)
from fpp_ml_bench.leaderboard.ranking import MOST_PAIRED, Group, Ranked
from fpp_ml_bench.leaderboard.rows import BY_ITS_AUTHORS, BY_THE_PAPER, TEST, UNSEEN, Entry
from fpp_ml_bench.loaders.render.track import TRACK_LIGHTS
from fpp_ml_bench.paper import paper_rows
from fpp_ml_bench.style import interval_text, millimetres
from fpp_ml_bench.tables import Table, markdown_text

NO_RESULTS = """\
No results here yet. Score predictions, and their row appears:
  fpp-bench predict classical data/mini --split test --out predictions
  fpp-eval predictions data/mini --split test --json result.json
  fpp-bench leaderboard result.json
Without arguments, result*.json and results/*.json of the current folder are read.
"""
PAIRS_FIRST_OUT = ("Objects", "p", "95% interval", "p, Holm")
LAST_OUT = ("Frames", "s/sample", "x trivial", "Object MAE")
"""In a narrow terminal, the columns of a ranking that are left out after all others of their width,
in this order."""
_FORMULA = re.compile(r"(?:^|[,;|\t\r\n])(?=[^\w=+@-]*[=+@-])")
"""Where a cell may begin, at the start of a text or behind what a spreadsheet may split it at, with
a sign that begins a formula before any letter or digit: behind spaces, quotes, a byte order
mark."""


REPORTED_HEADING = "Reported by others on other data (not measured here)"
PAPER_DEPTHS = (
    "The paper gives its objects a depth of 80 mm in general, and 216 and 465 mm to two in its "
    "figures; those of the "
    "test split here are 262 mm deep at 224 px and 282 mm at 960 px (medians). A network at 224 px "
    "does not reproduce "
    "the paper's."
)
"""What is said beside each comparison with the paper."""
SHOWN_BY_DEFAULT = ("architecture", "normalization", "oracle_order")


@dataclass(frozen=True)
class ReportedRow:
    """A row of a table: errors in mm by the keys of `HEADLINE`, as far as they are reported, on
    ``test_samples`` (view, frame) pairs, None where that is not said."""

    row: str
    label: str
    track: str
    test_samples: int | None
    errors_mm: dict[str, float]


@dataclass(frozen=True)
class ReportedTable:
    """A table of the paper, its rows in the paper's order, or of another ``source``. ``figure``:
    the ``object`` of the figure beside the table, and ``object_mae_mm`` of one sample of it by
    row."""

    name: str
    title: str
    rows: tuple[ReportedRow, ...]
    source: str = BY_THE_PAPER
    figure: dict[str, Any] | None = None

    @property
    def note(self) -> str:
        """Below the table: who measured, on what, and what the methods of its tracks were given."""
        depths = [PAPER_DEPTHS] if self.source == BY_THE_PAPER else []
        given = [
            f"{track}: given {given_truth(track)}."
            for track in sorted({row.track for row in self.rows})
            if given_truth(track)
        ]
        source = f"{self.source[0].upper()}{self.source[1:]}"
        said = [f"{source}. Other data, not ranked with the rows above.", *depths, *given]
        if self.figure is not None:
            errors = ", ".join(
                f"{row} {error:g}" for row, error in self.figure["object_mae_mm"].items()
            )
            said.append(
                f"Its figure, one sample of {self.figure['object']}, object MAE in mm: {errors}."
            )
        return " ".join(said)


@cache
def reported_tables() -> dict[str, ReportedTable]:
    """Every table by name: the paper's in its order, then those of other publications."""
    others = json.loads(Path(__file__).with_name("reported_rows.json").read_text(encoding="utf-8"))
    tables = {}
    for content in (paper_rows(), others):
        for table in content["tables"]:
            errors_mm = [
                dict(zip(content["columns"], row["errors_mm"], strict=True))
                for row in table["rows"]
            ]
            rows = [
                ReportedRow(**row | {"errors_mm": mm})
                for row, mm in zip(table["rows"], errors_mm, strict=True)
            ]
            source = f"{BY_ITS_AUTHORS} ({table['source']})" if "source" in table else BY_THE_PAPER
            tables[table["name"]] = ReportedTable(**table | {"rows": tuple(rows), "source": source})
    return tables


def paper_tables() -> dict[str, ReportedTable]:
    """The tables of the paper by name."""
    return {
        name: table for name, table in reported_tables().items() if table.source == BY_THE_PAPER
    }


def chosen_tables(choice: str | None) -> list[ReportedTable]:
    """Tables for ``--paper``: None for those shown by default, ``all``, ``none``, or one table's
    name."""
    tables = reported_tables()
    several = {None: SHOWN_BY_DEFAULT, "all": tuple(tables), "none": ()}
    return [tables[name] for name in several.get(choice, (str(choice),))]


def paper_table(paper: ReportedTable) -> Table:
    """The rows of a table of others, errors with the two decimals of their tables."""
    titles = {
        f"{shown} {error.upper()}": f"{pixels}_{error}_mm"
        for pixels, shown in (
            ("object", "Object"),
            ("overall", "Overall"),
            ("background", "Backgr."),
        )
        for error in ("mae", "rmse")
    }
    rows = [
        {
            "Row": row.label,
            "Track": row.track,
            "Test samples": "-" if row.test_samples is None else str(row.test_samples),
            **{
                title: f"{row.errors_mm[key]:.2f}" if key in row.errors_mm else "-"
                for title, key in titles.items()
            },
        }
        for row in paper.rows
    ]
    return Table.of(f"{paper.name}: {paper.title}, mm", rows, elsewhere="--markdown FILE")


def pair_row(pair: Pair) -> dict[str, str]:
    """A pair's cells by the titles of their columns."""
    return {
        "First": pair.first,
        "Second": pair.second,
        "Second - first": millimetres(pair.difference),
        "95% interval": interval_text(pair.interval, " to "),
        "p": f"{pair.p:.2g}",
        "p, Holm": f"{pair.p_holm:.2g}",
        "Objects": str(pair.objects),
        "Verdict": "second is behind" if pair.behind else "no difference shown",
    }


def ranking_table(
    title: str, shown: Sequence[Column], rows: Sequence[Ranked], **look: Any
) -> Table:
    """``rows`` of a ranking with the columns of ``shown`` that any of them has, whose titles take
    two lines in a terminal, to leave more width for the names; ``look``: further settings of the
    `Table`."""
    shown = [column for column in shown if column.shown_for(rows)]
    words = [number for number, column in enumerate(shown) if not column.right]
    cells = [{_two_lines(column.title): column.text(row) for column in shown} for row in rows]
    return Table.of(title, cells, words, elsewhere="--markdown FILE", **look)


def group_tables(groups: Sequence[Group], with_pairs: bool = False) -> list[Table | Text]:
    """A table for each group, ``with_pairs`` a second one of its pairs; without groups, how to
    begin."""
    if not groups:
        return [Text(NO_RESULTS)]
    parts: list[Table | Text] = []
    for group in groups:
        shown = [column for column in columns(group.sort) if column.from_width < ONLY_IN_FILES]
        names = 1 + [column.title for column in shown if column.shown_for(group.rows)].index(
            METHOD.title
        )
        rightmost = shown[::-1]  # of equal importance, the rightmost is left out first
        first_out = [
            _two_lines(column.title)
            for column in sorted(rightmost, key=partial(_importance, group.sort))
        ]
        parts += [ranking_table(group.title, shown, group.rows, names=names, first_out=first_out)]
        parts += [Text("".join(f"{note}\n" for note in group.notes))]
        if with_pairs and len(group.ranked) > MOST_PAIRED:
            parts.append(
                Text(f"The pairs of more than {MOST_PAIRED} ranked rows are not listed.\n")
            )
        elif with_pairs and group.pairs:
            rows = [*map(pair_row, group.pairs)]
            pairs = Table.of(
                "Pairs of these rows",
                rows,
                names=2,
                first_out=PAIRS_FIRST_OUT,
                elsewhere="--json FILE",
            )
            parts.append(pairs)
    return [*parts, Text(f"{NOTE}\n")]


def _two_lines(title: str) -> str:
    return title.replace(" ", "\n", 1)


def _importance(sort: str, column: Column) -> tuple[bool, int, int]:
    """Sort key of the columns: those of a low importance are left out first. What rows are sorted
    by stays longest."""
    return (
        column.key == sort,
        -column.from_width,
        LAST_OUT.index(column.title) if column.title in LAST_OUT else -1,
    )


def paper_rich_tables(papers: Sequence[ReportedTable]) -> list[Table | Text]:
    """The tables of others under their heading."""
    parts: list[Table | Text] = [Text(REPORTED_HEADING, style="bold")] if papers else []
    for paper in papers:
        parts += [paper_table(paper), Text(f"{paper.note}\n")]
    return parts


def markdown(groups: Sequence[Group], papers: Sequence[ReportedTable]) -> str:
    """The whole leaderboard as Markdown, ending in a newline."""
    lines: list[str] = []
    for group in groups:
        table = ranking_table(group.title, columns(group.sort), group.rows)
        lines += [f"### {markdown_text(str(table.title))}", "", *table.markdown(), ""]
        for note in group.notes:
            lines += [markdown_text(note), ""]
    lines += [NOTE.replace("*", "\\*"), ""] if groups else []
    lines += [f"### {REPORTED_HEADING}", ""] if papers else []
    for paper in papers:
        table = paper_table(paper)
        lines += [markdown_text(str(table.title)), "", *table.markdown(), "", paper.note, ""]
    return "\n".join(lines).rstrip("\n") + "\n"


def table_json(groups: Sequence[Group], papers: Sequence[ReportedTable]) -> str:
    """The whole leaderboard as JSON: groups of rows with the tests of their pairs, and the tables
    of others apart. A table of more than `MOST_PAIRED` ranked rows has no list of pairs."""
    of_groups = [
        {
            **asdict(group.key),
            "title": group.title,
            "sorted_by": group.sort,
            "rows": [
                {**_cells(group, row), "parts": list(map(_part, row.entries))} for row in group.rows
            ],
            "pairs": list(map(asdict, group.pairs)) if len(group.ranked) <= MOST_PAIRED else None,
            "notes": group.notes,
        }
        for group in groups
    ]
    content = {"groups": of_groups, "reported_by_others": list(map(asdict, papers))}
    return json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _part(entry: Entry) -> dict[str, Any]:
    return {"source": entry.path.name, **entry.row.model_dump(mode="json")}


def table_csv(groups: Sequence[Group]) -> str:
    """A line for each row, numbers with all digits, empty where there is none. Text that a
    spreadsheet would take for a formula, also behind a semicolon, has an apostrophe before it."""
    lines = [_cells(group, row) for group in groups for row in group.rows]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(lines[0]) if lines else [], lineterminator="\n")
    if lines:
        writer.writeheader()
    writer.writerows({key: _plain(value) for key, value in line.items()} for line in lines)
    return text.getvalue()


def _plain(value: object) -> object:
    """A cell of which no spreadsheet runs a part, whatever it splits lines at, whatever stands
    before a formula, and in whichever width its sign is written."""
    if not isinstance(value, str):
        return value
    narrow = "".join(unicodedata.normalize("NFKC", letter)[:1] for letter in value)
    ends = [0, *(match.end() for match in _FORMULA.finditer(narrow)), len(value)]
    return "'".join(value[start:end] for start, end in pairwise(ends))


def _cells(group: Group, row: Ranked) -> dict[str, object]:
    key, entry, about = group.key, row.entry, row.entry.row
    timing, reliance, disturbed = about.timing, about.reliance, (about.robustness or {}).get("test")
    low, high = row.interval(key.rank_key) or (None, None)
    stated = uncertainty(entry)
    parts = {
        f"ranked_by_{name}": part and part.value(key.rank_key)
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
        "charge_mm": about.charge_mm,
        "ranked_by": key.rank_key,
        "ranked_by_low": low,
        "ranked_by_high": high,
        **parts,
        "ratio_to_trivial": row.ratio,
        **{name: row.value(name) for name in errors},
        "latency_median_ms": entry.latency_ms,
        "latency_p5_ms": timing and timing.latency_p5_ms,
        "latency_p95_ms": timing and timing.latency_p95_ms,
        "time_measured_here": entry.time_measured,
        "timed_on": device(entry),
        "frames_used": entry.frames,
        "phase_reliance": reliance and reliance.score,
        "phase_reliance_without_whole_periods": reliance and reliance.order_free_score,
        "disturbed_mae_mm": disturbed and disturbed.mae_mm,
        **{
            f"rigs_{light}_per_mille": about.rigs
            and light in about.rigs.mean
            and about.rigs.mean[light].per_mille
            for light in TRACK_LIGHTS
        },
        "within_stated_95": stated.within_95_share,
        "ause_mae_mm": stated.ause_mae_mm,
        "sure_mae_mm": stated.sure_mae_mm,
        "sure_rmse_mm": stated.sure_rmse_mm,
        "learned_from": learned_from(about),
        "given_truth": given_truth(key.track),
        "provenance": row.provenance,
        "source": entry.path.name,
    }
