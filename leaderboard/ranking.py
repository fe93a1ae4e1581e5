"""Result files into ranked groups. What was not scored on the same data by the same rules is never ranked together."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import METRICS
from fpp_ml_bench.evaluation.result import Result
from fpp_ml_bench.evaluation.result_io import read_result
from fpp_ml_bench.evaluation.text import printable

SHIPPED_ROWS = Path(__file__).resolve().parent / "rows"
DEFAULT_SORT = "object_mae_mm"
SORT_KEYS = (*METRICS, "seconds_per_sample", "frames_used")


@dataclass(frozen=True)
class Entry:
    """One result file."""

    path: Path
    result: Result

    @property
    def name(self) -> str:
        return self.result.submission.name

    def value(self, key: str) -> float | None:
        """What ``key`` of `SORT_KEYS` sorts by; None for an empty pixel set or an unknown time."""
        if key == "seconds_per_sample":
            return self.result.submission.seconds_per_sample
        if key == "frames_used":
            return float(len(self.result.submission.frames_used))
        value: float | None = getattr(self.result.metrics, key)
        return value


@dataclass(frozen=True, order=True)
class GroupKey:
    """What two results must share to be compared. ``fingerprint`` stands for the dataset, not its folder's name."""

    track: str
    split: str
    target: str
    fingerprint: str
    size: tuple[int, int]
    edge_band_px: int
    protocol_version: str


@dataclass(frozen=True)
class Ranked:
    """An entry and its rank in its group; equal values share a rank, and the next rank counts them all."""

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
        return f"{data}, against {key.target}, {key.track} track"


def discover(here: Path) -> list[Path]:
    """Result files where nobody named any: the rows shipped with the package, then ``result*.json`` and
    ``results/*.json`` of the folder ``here``."""
    return [
        *sorted(SHIPPED_ROWS.glob("*.json")),
        *sorted(here.glob("result*.json")),
        *sorted(here.glob("results/*.json")),
    ]


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
    return [Entry(path, read_result(path)) for path in files]


def rank(entries: Iterable[Entry], sort: str = DEFAULT_SORT) -> list[Group]:
    """Groups in a fixed order (metric track first), each ranked by ``sort``, the smallest value first, unknown last.

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
    ordered = sorted(entries, key=lambda entry: (*_sortable(entry.value(sort)), entry.name))
    rows: list[Ranked] = []
    for place, entry in enumerate(ordered, start=1):
        tied = rows and rows[-1].entry.value(sort) == entry.value(sort)
        rows.append(Ranked(rows[-1].rank if tied else place, entry))
    return Group(key, min(entry.result.dataset.name for entry in entries), tuple(rows))


def _sortable(value: float | None) -> tuple[bool, float]:
    return value is None, 0.0 if value is None else value
