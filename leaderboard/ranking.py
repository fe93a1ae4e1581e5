"""Row files into ranked groups. Rows on different data or by different rules are never ranked together, and only rows
that the maintainers vouch for are ranked; in a table without any, those that are not on the leaderboard."""

import math
import operator
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.metrics import HEADLINE, METRICS, RANK_KEY, sort_keys
from fpp_ml_bench.evaluation.score.uncertainty import FEWEST_OBJECTS
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard import rows
from fpp_ml_bench.leaderboard.groups import UNSEEN, Group, GroupKey, Ranked, is_unseen, rank_ranges, with_ratios
from fpp_ml_bench.leaderboard.names import short_names
from fpp_ml_bench.leaderboard.row_file import name_key
from fpp_ml_bench.leaderboard.rows import LOCAL, MEANING, SELF_REPORTED, Entry, read_entry

DEFAULT_SORT = RANK_KEY


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
    seen: set[Path] = set()
    for path in files:
        if (whole := path.resolve()) in seen:
            raise SubmissionError(f"{printable(str(path), 500)} is given twice; name each result once")
        seen.add(whole)
    return files


def read_entries(files: Sequence[Path]) -> list[Entry]:
    """Read every file strictly; SubmissionError names the first that is no sound result."""
    return [read_entry(path) for path in files]


def rank(entries: Iterable[Entry], sort: str = DEFAULT_SORT) -> list[Group]:
    """Groups in the order of `GroupKey.order`, their rows by rank in ``sort``, then the best value first, unknown
    values last. Equal values are ordered by name, so the order of the files changes nothing. Raises SubmissionError
    where rows of a group contradict each other: a name twice, other objects of the same data, a vouched part of a row
    with one that nobody vouches for."""
    if sort in METRICS and METRICS[sort].helped_by_missing:
        raise SubmissionError(f"{sort}: a method could lead by answering few pixels; sort by {DEFAULT_SORT}")
    if sort not in sort_keys():
        raise SubmissionError(f"expected a sort key out of {', '.join(sort_keys())}, got {printable(sort)!r}")
    members: dict[GroupKey, list[Entry]] = {}
    for entry in entries:
        members.setdefault(GroupKey.of(entry.row), []).append(entry)
    return with_ratios([_group(key, members[key], sort) for key in sorted(members, key=lambda key: key.order)])


def _group(key: GroupKey, entries: list[Entry], sort: str) -> Group:
    # Vouched rows first: of two copies they stay, and what others contradict is theirs.
    entries = sorted(entries, key=lambda e: (list(MEANING).index(e.provenance), is_unseen(e.row), e.name, e.path.name))
    entries, notes = _without_copies(entries)
    methods = _methods(entries)
    claims = [first.name for first, _ in methods if first.provenance == SELF_REPORTED]
    names = short_names([first.row.submission for first, _ in methods], claims)
    shown = [Ranked(first, name, unseen) for (first, unseen), name in zip(methods, names, strict=True)]
    # Smaller is better: a tolerance share with its sign turned.
    turned = operator.neg if sort in METRICS and METRICS[sort].better == "higher" else operator.pos

    def by_rank(row: Ranked) -> tuple[object, ...]:
        value = row.value(sort)
        ranks = (row.best_rank, row.worst_rank) if row.best_rank is not None else (math.inf, 0)
        return value is None, *ranks, 0.0 if value is None else turned(value), row.entry.name

    shown.sort(key=by_rank)
    complete = [row for row in shown if (row.unseen or not key.takes_unseen) and row.value(sort) is not None]
    family = [row for row in complete if row.entry.vouched] or [row for row in complete if row.provenance == LOCAL]
    if why := _no_ranks(key, shown, complete, family, sort):
        return Group(key, tuple(shown), sort, (why, *notes))
    objects = sorted(family[0].object_means(sort))
    errors = np.array([[row.object_means(sort)[name] for name in objects] for row in family])
    ranges = dict(zip(map(id, family), rank_ranges(errors), strict=True))
    values = sorted(row.value(sort) or 0.0 for row in family)
    places = {id(row): 1 + bisect_left(values, row.value(sort) or 0.0) for row in complete}
    for number, row in enumerate(shown):
        best, worst = ranges.get(id(row), (None, None))
        shown[number] = replace(row, best_rank=best, worst_rank=worst, place=places.get(id(row)))
    if len(complete) < len(shown):
        notes.insert(0, "Rows without a result on the unseen objects have no rank.")
    return Group(key, tuple(sorted(shown, key=by_rank)), sort, tuple(notes))


def _without_copies(entries: Sequence[Entry]) -> tuple[list[Entry], list[str]]:
    """The first of those with the same predictions of the same samples, and a note of each that is left out."""
    kept: dict[tuple[bool, str], Entry] = {}
    notes = []
    for entry in entries:
        first = kept.setdefault((is_unseen(entry.row), entry.row.predictions_sha256), entry)
        if first is not entry:
            copy, of = (f"{printable(e.name, 80)} ({printable(e.path.name, 80)})" for e in (entry, first))
            notes.append(f"Not shown, the same predictions as {of}: {copy}.")
    return list(kept.values()), notes


def _methods(entries: Sequence[Entry]) -> list[tuple[Entry, Entry | None]]:
    """The two parts of each method, that on the test objects first, if there is one. SubmissionError where two rows
    contradict each other."""
    by_name: dict[str, tuple[Entry, Entry | None]] = {}
    by_data: dict[bool, Entry] = {}
    for entry in sorted(entries, key=lambda entry: is_unseen(entry.row)):
        key = name_key(entry.name)
        if key in by_name:
            test, unseen = by_name[key]
            _check_one_method(unseen or test, entry)
        by_name[key] = (by_name[key][0], entry) if key in by_name else (entry, None)
        first = by_data.setdefault(is_unseen(entry.row), entry)
        if _counts(first) != _counts(entry):
            files = [printable(str(e.path), 500) for e in (entry, first)]
            raise SubmissionError(
                f"{files[0]}: its objects, samples or pixels are not those of {files[1]} on the same data; score the "
                "predictions again, or leave it out"
            )
    return list(by_name.values())


def _counts(entry: Entry) -> set[tuple[str, int, int, int]]:
    return {(part.object, part.samples, part.object_pixels, part.void_pixels) for part in entry.row.per_object}


def _check_one_method(first: Entry, second: Entry) -> None:
    """Refuse (SubmissionError) two rows of one name that are not a method's on the two test sets."""
    files = [printable(str(entry.path), 500) for entry in (first, second)]
    both = f"{files[0]} and {files[1]} both hold {printable(first.name)!r}"
    if first.name != second.name:
        both += f" or what looks like it, {printable(second.name)!r},"
    if is_unseen(first.row) == is_unseen(second.row):
        raise SubmissionError(f"{both} on the same data; leave one out, or give one another name")
    about_first, about_second = first.row.submission, second.row.submission
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
    if first.vouched != second.vouched:
        raise SubmissionError(
            f"{both}, and the maintainers vouch for one of them only ({first.provenance} and {second.provenance}); a "
            "row is joined of two parts that are vouched for, or of two that are not: give one another name"
        )


def _no_ranks(
    key: GroupKey, shown: Sequence[Ranked], complete: Sequence[Ranked], family: Sequence[Ranked], sort: str
) -> str:
    """Why a table has no ranks; empty where it has."""
    if sort not in HEADLINE:
        return f"No ranks by {sort}: the order is that of the values."
    objects = max(len(row.objects) for row in complete or shown)
    smallest = f"With {objects} object{'s' * (objects != 1)} the smallest p value of a test is {2.0 ** (1 - objects):g}"
    too_few = f" {smallest}, above 5%." if objects < FEWEST_OBJECTS else ""
    if key.takes_unseen and len(complete) < 2:
        how_many = "no row here has both" if not complete else "only one row here has both"
        return f"No ranks: they need the test objects and those of {UNSEEN}, and {how_many}.{too_few}"
    if too_few:
        return f"No ranks.{too_few} Each row's interval is its own."
    if len(complete) > 1 and not family:
        return "No ranks: nobody vouches for a row here."
    return "" if len(family) > 1 else "No ranks: there are not two rows to compare."
