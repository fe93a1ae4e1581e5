"""Result files into ranked groups. What was not scored on the same data by the same rules is never ranked together."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import HIGHER_IS_BETTER, METRICS, SIGNED
from fpp_ml_bench.evaluation.result import Result
from fpp_ml_bench.evaluation.text import printable
from fpp_ml_bench.evaluation.uncertainty import ranks_with_ties
from fpp_ml_bench.leaderboard import rows
from fpp_ml_bench.leaderboard.rows import Entry, read_entry

DEFAULT_SORT = "object_mae_mm"
SORT_KEYS = (*METRICS, "seconds_per_sample", "frames_used")


@dataclass(frozen=True, order=True)
class GroupKey:
    """What two results must share to be compared. ``fingerprint`` stands for the dataset, not its folder's name."""

    track: str
    mode: str
    split: str
    target: str
    fingerprint: str
    size: tuple[int, int]
    edge_band_px: int
    protocol_version: str


@dataclass(frozen=True)
class Ranked:
    """An entry and its rank in its group: 1 and the number of entries that are surely better, so that ties share one.

    Where both have an interval, surely better means that the other's ends before this one's begins; see
    `fpp_ml_bench.evaluation.uncertainty.ranks_with_ties`.
    """

    rank: int
    entry: Entry


@dataclass(frozen=True)
class Group:
    """Entries that may be compared, best first; ``dataset_name`` is what the folder was called, for people only."""

    key: GroupKey
    dataset_name: str
    rows: tuple[Ranked, ...]

    @property
    def title(self) -> str:
        height, width = self.key.size
        key, name = self.key, printable(self.dataset_name)
        data = f"{key.split} split of {name} ({key.fingerprint[:8]}), {width}x{height} px"
        mode = "" if key.mode == "standard" else f", mode {key.mode}"
        return f"{data}, against {key.target}, {key.track} track{mode}"


def discover(here: Path) -> list[Path]:
    """Result files where nobody named any: the rows shipped with the package, then ``result*.json`` and
    ``results/*.json`` of the folder ``here``."""
    return [
        *shipped_rows(),
        *sorted(here.glob("result*.json")),
        *sorted(here.glob("results/*.json")),
    ]


def shipped_rows() -> list[Path]:
    """The row files that ship with the package."""
    return sorted(rows.SHIPPED_ROWS.glob("*.json"))


def expand(paths: Iterable[Path]) -> list[Path]:
    """Files as given, folders as the ``*.json`` in them. SubmissionError for an empty folder or a file given twice."""
    files: list[Path] = []
    for path in paths:
        found = sorted(path.glob("*.json")) if path.is_dir() else [path]
        if not found:
            raise SubmissionError(
                f"{printable(str(path), 500)}: expected result files (*.json) in this folder, found none"
            )
        files += found
    seen: set[Path] = set()
    for path in files:
        if path.resolve() in seen:
            raise SubmissionError(f"{printable(str(path), 500)} is given twice; name each result once")
        seen.add(path.resolve())
    return files


def read_entries(files: Sequence[Path]) -> list[Entry]:
    """Read every file strictly; SubmissionError names the first that is no sound result."""
    return [read_entry(path) for path in files]


def rank(entries: Iterable[Entry], sort: str = DEFAULT_SORT) -> list[Group]:
    """Groups in a fixed order (metric track first), each ranked by ``sort``, the best value first, unknown last.

    The order of the files changes nothing. Raises SubmissionError where one group holds one name twice.
    """
    if sort not in SORT_KEYS:
        raise SubmissionError(f"expected a sort key out of {', '.join(SORT_KEYS)}, got {printable(sort)!r}")
    members: dict[GroupKey, list[Entry]] = {}
    for entry in entries:
        members.setdefault(_key(entry.result), []).append(entry)
    return [_group(key, members[key], sort) for key in sorted(members)]


def _key(result: Result) -> GroupKey:
    data = result.dataset
    return GroupKey(
        track=result.track,
        mode=result.mode,
        split=data.split,
        target=result.target,
        fingerprint=data.fingerprint,
        size=(data.size[0], data.size[1]),
        edge_band_px=result.edge_band_px,
        protocol_version=result.protocol_version,
    )


def _group(key: GroupKey, entries: list[Entry], sort: str) -> Group:
    named: dict[str, Entry] = {}
    for entry in entries:
        if entry.name in named:
            raise SubmissionError(
                f"{printable(str(named[entry.name].path), 500)} and {printable(str(entry.path), 500)} both hold "
                f"{printable(entry.name)!r} on the same data; leave one out, or give one another name"
            )
        named[entry.name] = entry
    ordered = sorted(entries, key=lambda entry: (*_sortable(entry.value(sort), sort), entry.name))
    places = ranks_with_ties(
        [_badness(entry.value(sort), sort) for entry in ordered],
        [None if sort in HIGHER_IS_BETTER or sort in SIGNED else entry.interval(sort) for entry in ordered],
    )
    ranked = tuple(
        Ranked(len(ordered) if place is None else place, entry) for place, entry in zip(places, ordered, strict=True)
    )
    return Group(key, min(entry.result.dataset.name for entry in entries), ranked)


def _badness(value: float | None, sort: str) -> float | None:
    """``value`` such that smaller is better: a tolerance share turned round, a bias without its sign."""
    if value is None:
        return None
    return -value if sort in HIGHER_IS_BETTER else abs(value)


def _sortable(value: float | None, sort: str) -> tuple[bool, float]:
    found = _badness(value, sort)
    return found is None, 0.0 if found is None else found
