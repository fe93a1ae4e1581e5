"""Result files into ranked groups. Results on different data or by different rules are never ranked together."""

import math
import operator
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import HELPED_BY_MISSING, HIGHER_IS_BETTER, METRICS
from fpp_ml_bench.evaluation.score import FEWEST_OBJECTS
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard import rows
from fpp_ml_bench.leaderboard.groups import UNSEEN, Group, GroupKey, Ranked, joined
from fpp_ml_bench.leaderboard.names import short_names
from fpp_ml_bench.leaderboard.pairs import pairs, rank_ranges
from fpp_ml_bench.leaderboard.rows import Entry, read_entry
from fpp_ml_bench.leaderboard.trivial import with_ratios

DEFAULT_SORT = "object_mae_mm"
SORT_KEYS = (*(key for key in METRICS if key not in HELPED_BY_MISSING), "seconds_per_sample", "frames_used")


def discover(here: Path) -> list[Path]:
    """Result files where none are named: the rows shipped with the package, then ``result*.json`` and
    ``results/*.json`` of the folder ``here``."""
    return [*shipped_rows(), *sorted(here.glob("result*.json")), *sorted(here.glob("results/*.json"))]


def shipped_rows() -> list[Path]:
    """The row files that ship with the package."""
    return sorted(rows.SHIPPED_ROWS.glob("*.json"))


def expand(paths: Iterable[Path]) -> list[Path]:
    """Files as given, folders as the ``*.json`` in them. SubmissionError for an empty folder or a file given twice."""
    files: list[Path] = []
    for path in paths:
        named = sorted(path.glob("*.json")) if path.is_dir() else [path]
        if not named:
            shown = printable(str(path), 500)
            raise SubmissionError(f"{shown}: expected result files (*.json) in this folder, found none")
        files += named
    for number, path in enumerate(whole := [path.resolve() for path in files]):
        if path in whole[:number]:
            raise SubmissionError(f"{printable(str(files[number]), 500)} is given twice; name each result once")
    return files


def read_entries(files: Sequence[Path]) -> list[Entry]:
    """Read every file strictly; SubmissionError names the first that is no sound result."""
    return [read_entry(path) for path in files]


def rank(entries: Iterable[Entry], sort: str = DEFAULT_SORT) -> list[Group]:
    """Groups in the order of `GroupKey.order`, their rows by rank in ``sort``, then the best value first, unknown
    values last. Equal values are ordered by name, so the order of the files changes nothing. Raises SubmissionError
    where a group holds a name twice."""
    if sort in HELPED_BY_MISSING:
        raise SubmissionError(f"{sort}: a method could lead by answering few pixels; sort by {DEFAULT_SORT}")
    if sort not in SORT_KEYS:
        raise SubmissionError(f"expected a sort key out of {', '.join(SORT_KEYS)}, got {printable(sort)!r}")
    members: dict[GroupKey, list[Entry]] = {}
    for entry in entries:
        members.setdefault(GroupKey.of(entry.result), []).append(entry)
    return with_ratios([_group(key, members[key], sort) for key in sorted(members, key=lambda key: key.order)])


def _group(key: GroupKey, entries: list[Entry], sort: str) -> Group:
    by_name: dict[str, list[Entry]] = {}
    for entry in entries:
        same_name = by_name.setdefault(entry.name, [])
        for other in same_name:
            _check_one_method(other, entry)
        same_name.append(entry)
    methods = [joined(parts) for parts in by_name.values()]
    names = short_names([entry.result.submission for entry, _ in methods])
    rows = [Ranked(entry, name, unseen) for (entry, unseen), name in zip(methods, names, strict=True)]
    # Smaller is better: a tolerance share with its sign turned.
    turned = operator.neg if sort in HIGHER_IS_BETTER else operator.pos

    def by_rank(row: Ranked) -> tuple[object, ...]:
        value = row.value(sort)
        ranks = (row.best_rank, row.worst_rank) if row.best_rank is not None else (math.inf, 0)
        return value is None, *ranks, 0.0 if value is None else turned(value), row.entry.name

    rows.sort(key=by_rank)
    name = min(entry.result.dataset.name for entry in entries)
    ranked = [row for row in rows if _complete(key, row) and row.value(sort) is not None] if sort in METRICS else []
    if why := _no_ranks(key, rows, ranked, sort):
        return Group(key, name, tuple(rows), unranked=why)
    tested = pairs({
        row.short_name: {name: turned(value) for name, value in row.object_means(sort).items()} for row in ranked
    })  # fmt: skip
    ranges = rank_ranges([row.short_name for row in ranked], tested)
    rows = [
        replace(row, best_rank=ranges[row.short_name][0], worst_rank=ranges[row.short_name][1])
        if row.short_name in ranges else row
        for row in rows
    ]  # fmt: skip
    rows.sort(key=by_rank)
    unranked = "" if len(ranked) == len(rows) else "Rows without a result on the unseen objects have no rank."
    return Group(key, name, tuple(rows), tuple(tested), unranked)


def _check_one_method(first: Entry, second: Entry) -> None:
    """Refuse (SubmissionError) two results of one name that are not a method's results on the two test sets."""
    files = [printable(str(entry.path), 500) for entry in (first, second)]
    both = f"{files[0]} and {files[1]} both hold {printable(first.name)!r}"
    if first.result.dataset.fingerprint == second.result.dataset.fingerprint:
        raise SubmissionError(f"{both} on the same data; leave one out, or give one another name")
    about_first, about_second = first.result.submission, second.result.submission
    weights = "weights_sha256"
    for what, of_first, of_second in (
        ("method", about_first.method, about_second.method),
        ("frames_used", sorted(about_first.frames_used), sorted(about_second.frames_used)),
        (f"settings.{weights}", about_first.settings.get(weights), about_second.settings.get(weights)),
    ):
        if of_first != of_second:
            raise SubmissionError(
                f"{both}, on the test and on the unseen objects, but {what} is {printable(str(of_first))} and "
                f"{printable(str(of_second))}; run both with the same method, or give one another name"
            )


def _complete(key: GroupKey, row: Ranked) -> bool:
    return row.unseen is not None or not key.takes_unseen


def _no_ranks(key: GroupKey, rows: Sequence[Ranked], ranked: Sequence[Ranked], sort: str) -> str:
    """Why a table has no ranks; empty where it has."""
    if sort not in METRICS:
        return f"No ranks by {sort}: the order is that of the values."
    objects = max(len(row.objects) for row in ranked or rows)
    smallest = f"With {objects} object{'s' * (objects != 1)} the smallest p value of a test is {2.0 ** (1 - objects):g}"
    too_few = f" {smallest}, above 5%." if objects < FEWEST_OBJECTS else ""
    if key.takes_unseen and len(ranked) < 2:
        how_many = "no row here has both" if not ranked else "only one row here has both"
        return f"No ranks: they need the test objects and those of {UNSEEN}, and {how_many}.{too_few}"
    if too_few:
        return f"No ranks.{too_few} Each row's interval is its own."
    return "" if len(ranked) > 1 else "No ranks: there are not two rows to compare."
