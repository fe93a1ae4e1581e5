"""Result files into ranked groups. Results on different data or by different rules are never ranked together."""

import operator
from collections.abc import Iterable, Sequence
from pathlib import Path

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import HIGHER_IS_BETTER, METRICS, SIGNED
from fpp_ml_bench.evaluation.score import Interval, ranks_with_ties
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard import rows
from fpp_ml_bench.leaderboard.groups import Group, GroupKey, Ranked, short_names
from fpp_ml_bench.leaderboard.rows import Entry, read_entry

DEFAULT_SORT = "object_mae_mm"
SORT_KEYS = (*METRICS, "seconds_per_sample", "frames_used")


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
    """Groups in the order of `GroupKey.order`, their rows by ``sort``, the best value first, unknown values last. Equal
    values are ordered by name, so the order of the files changes nothing. Raises SubmissionError where a group holds a
    name twice."""
    if sort not in SORT_KEYS:
        raise SubmissionError(f"expected a sort key out of {', '.join(SORT_KEYS)}, got {printable(sort)!r}")
    members: dict[GroupKey, list[Entry]] = {}
    for entry in entries:
        members.setdefault(GroupKey.of(entry.result), []).append(entry)
    return [_group(key, members[key], sort) for key in sorted(members, key=lambda key: key.order)]


def rank_ranges(values: Sequence[float | None], intervals: Sequence[Interval | None]) -> list[tuple[int, int]]:
    """Best and worst rank of each entry that the 95% intervals allow; smaller values are better.

    Best: 1 and the number of entries whose whole interval is better. Worst: the number of all entries without those
    whose whole interval is worse. An entry without interval counts as its bare value; entries without value (None)
    share the last ranks.

    >>> rank_ranges([1.0, 1.2, 3.0, None], [(0.8, 1.3), (1.1, 1.4), (2.5, 3.5), None])
    [(1, 2), (1, 2), (3, 3), (4, 4)]
    """
    with_value = sum(value is not None for value in values)
    best = ranks_with_ties(values, intervals)
    # Worst ranks are best ranks counted from the other end.
    from_end = ranks_with_ties(
        [None if value is None else -value for value in values],
        [None if interval is None else (-interval[1], -interval[0]) for interval in intervals],
    )
    return [
        (with_value + 1, len(values)) if first is None or last is None else (first, with_value + 1 - last)
        for first, last in zip(best, from_end, strict=True)
    ]


def _group(key: GroupKey, entries: list[Entry], sort: str) -> Group:
    named: dict[str, Entry] = {}
    for entry in entries:
        if entry.name in named:
            raise SubmissionError(
                f"{printable(str(named[entry.name].path), 500)} and {printable(str(entry.path), 500)} both hold "
                f"{printable(entry.name)!r} on the same data; leave one out, or give one another name"
            )
        named[entry.name] = entry
    # Smaller is better: a tolerance share with its sign turned, a bias without its sign.
    turned = operator.neg if sort in HIGHER_IS_BETTER else abs
    values = [entry.value(sort) for entry in entries]
    valued = [(None if v is None else turned(v), entry) for v, entry in zip(values, entries, strict=True)]
    valued.sort(key=lambda pair: (pair[0] is None, pair[0] or 0.0, pair[1].name))
    ordered = [entry for _, entry in valued]
    without_interval = sort in HIGHER_IS_BETTER or sort in SIGNED
    intervals = [None if without_interval else entry.interval(sort) for entry in ordered]
    ranges = rank_ranges([value for value, _ in valued], intervals)
    names = short_names([entry.result.submission for entry in ordered])
    ranked = tuple(Ranked(*ends, entry, name) for ends, entry, name in zip(ranges, ordered, names, strict=True))
    return Group(key, min(entry.result.dataset.name for entry in entries), ranked)
