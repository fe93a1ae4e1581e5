"""Row files into ranked tables. Rows on different data or by different rules are never ranked
together, and only rows that the maintainers vouch for are ranked; in a table without any, those
that are not on the leaderboard. The row of a method on the test objects and that on the unseen ones
are shown as one.

Two rows are compared by their paired differences over the objects: a sign-flip test of each pair,
Holm's correction over all pairs of the table, and the ranks that follow. Rows of this package's
methods get their short names from the method's settings; every other submission keeps its own name,
cut at a word.
"""

import math
import operator
from bisect import bisect_left
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from statistics import fmean

import numpy as np

from fpp_ml_bench.baselines.registry import methods, network_method
from fpp_ml_bench.constants import FULL_SIZE
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.metrics import METRICS, OBJECT_KEY, RANK_KEY, RANKED, sort_keys
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX, FRAMES_CLASSES, FramesClass, Track
from fpp_ml_bench.evaluation.score.uncertainty import (
    FEWEST_OBJECTS,
    Interval,
    Pair,
    pairs,
    rank_ranges,
)
from fpp_ml_bench.evaluation.submission.description import Submission
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard import rows
from fpp_ml_bench.leaderboard.row_file import (
    ObjectMeans,
    interval_over,
    looks_like,
    mean_over,
    name_key,
)
from fpp_ml_bench.leaderboard.rows import (
    LOCAL,
    MEANING,
    SELF_REPORTED,
    TEST,
    UNSEEN,
    Entry,
    copy_note,
    read_entry,
)
from fpp_ml_bench.loaders.storage.benchmark import BENCHMARKS, Benchmark

MOST_PAIRED = 40
"""Ranked rows up to which a table lists its pairs, 780 of them."""


@dataclass(frozen=True, order=True)
class GroupKey:
    """What two rows must share to be compared. ``data`` is the title of the benchmark whose scenes
    were scored, or for other data their `DatasetInfo.truth`, whatever was projected; the unseen
    objects have that of the benchmark whose test split they complete."""

    frames: FramesClass
    track: Track
    mode: str
    split: str
    target: str
    data: str
    size: tuple[int, int]
    edge_band_px: int
    charge_mm: float
    protocol_version: str
    real: str

    @classmethod
    def of(cls, entry: Entry) -> "GroupKey":
        row, info, benchmark = entry.row, entry.row.dataset, entry.row.dataset.known
        data = (
            info.truth
            if benchmark is None
            else _title(TEST)
            if entry.is_unseen
            else benchmark.title
        )
        return cls(
            row.frames_class,
            row.track,
            row.mode,
            info.split,
            row.target,
            data,
            (info.size[0], info.size[1]),
            row.edge_band_px,
            row.charge_mm or 0.0,
            row.protocol_version,
            info.real or "",
        )

    @property
    def rank_key(self) -> str:
        """By what its rows are ranked: as the paper does where nothing is charged."""
        return RANK_KEY if self.charge_mm else OBJECT_KEY

    @property
    def benchmark(self) -> Benchmark | None:
        """Whose scenes these are; None for data without a name."""
        return next((benchmark for benchmark in BENCHMARKS if benchmark.title == self.data), None)

    @property
    def takes_unseen(self) -> bool:
        """Whether a row of this group has a part on the unseen objects beside that on the test
        objects."""
        return self.split == "test" and self.data == _title(TEST)

    @property
    def special_data(self) -> str:
        """What sets data apart from those that are shown first, in words: the set of real
        captures, another light or a small image, as ``workshop``, ``224 px``; empty for the
        others."""
        benchmark = self.benchmark
        if benchmark is None:
            return self.real or ""
        if benchmark.light == "paper" and benchmark.size == FULL_SIZE:
            return ""
        words = [benchmark.light, f"{benchmark.size} px"]
        return ", ".join(
            word
            for word, usual in zip(words, ("paper", f"{FULL_SIZE} px"), strict=True)
            if word != usual
        )

    @property
    def order(self) -> tuple[object, ...]:
        """Sort key of the groups: named benchmarks as they are listed, then other data; the larger
        images first, then the fewer frames, the metric track before the others."""
        place = len(BENCHMARKS) if self.benchmark is None else BENCHMARKS.index(self.benchmark)
        return (
            self.benchmark is None,
            -self.size[0] * self.size[1],
            place,
            self.data,
            FRAMES_CLASSES.index(self.frames),
            self.track != "metric",
            self,
        )

    @property
    def data_title(self) -> str:
        """``fpp-bench-full version 2, 960 x 960 px``; other data by size and the first 8 digits of
        their hash, those of real captures by the name of their set, too."""
        pixels = f"{self.size[1]} x {self.size[0]} px"
        if self.benchmark is not None:
            return f"{self.data}, {pixels}"
        real = f"Real light, {printable(self.real)}, " if self.real else ""
        return f"{real}{pixels}, data {self.data[:8]}"

    @property
    def against(self) -> str:
        """The ground truth in words: exact depth or decoded depth."""
        return "exact depth" if self.target == "depth_exact" else "decoded depth"

    @property
    def rules(self) -> str:
        """What of the rules is not as usual, in words after a comma; empty for the usual ones."""
        mode = "" if self.mode == "standard" else f", mode {self.mode}"
        return mode + (
            "" if self.edge_band_px == EDGE_BAND_PX else f", edge band {self.edge_band_px} px"
        )


@dataclass(eq=False)
class Ranked:
    """A row: a method on the test objects in ``entry`` and on the ``unseen`` ones, or ``entry``
    alone. With the best and the worst rank that the tests allow, None where it is not ranked; a row
    beside the ranks has a ``place``, 1 + the ranked rows with a smaller error. ``ratio``: its
    object MAE over that of the best trivial method on the same objects, None without any."""

    entry: Entry
    short_name: str
    unseen: Entry | None = None
    best_rank: int | None = None
    worst_rank: int | None = None
    place: int | None = None
    ratio: float | None = None

    @property
    def ranks(self) -> str:
        """``1-4``, or the single number where both ranks agree; ``(4)`` beside the ranks; a dash
        without any."""
        if self.best_rank is None:
            return "-" if self.place is None else f"({self.place})"
        return (
            str(self.best_rank)
            if self.best_rank == self.worst_rank
            else f"{self.best_rank}-{self.worst_rank}"
        )

    @property
    def rank_key(self) -> str:
        """By what it is ranked, as all rows of its group."""
        return OBJECT_KEY if self.entry.row.charge_mm is None else RANK_KEY

    @property
    def provenance(self) -> str:
        """The weakest of its parts' (a key of `MEANING`)."""
        return max((part.provenance for part in self.entries), key=list(MEANING).index)

    @property
    def entries(self) -> list[Entry]:
        """Its parts."""
        return [entry for entry in (self.entry, self.unseen) if entry is not None]

    @cached_property
    def objects(self) -> tuple[ObjectMeans, ...]:
        """The objects that it is scored on."""
        return tuple(part for entry in self.entries for part in entry.row.per_object)

    def value(self, key: str) -> float | None:
        """Mean of a sort key over all samples of the row; None for an empty pixel set or an unknown
        time. Of a row with two parts, scores beside `RANKED` are weighted by the samples of
        each."""
        if self.unseen is None or key in ("seconds_per_sample", "frames_used"):
            return self.entry.value(key)
        if key in RANKED:
            return mean_over(self.objects, key)
        known = [
            (value, part.row.dataset.samples)
            for part in self.entries
            if (value := part.value(key)) is not None
        ]
        return (
            sum(value * samples for value, samples in known) / sum(n for _, n in known)
            if known
            else None
        )

    def interval(self, key: str) -> Interval | None:
        """The 95% interval of ``key`` over all objects of the row; None where it has none."""
        return self.entry.row.intervals.of(key) if self.unseen is None else self._joined.get(key)

    @cached_property
    def _joined(self) -> dict[str, Interval | None]:
        return {key: interval_over(self.objects, key) for key in RANKED}

    def object_means(self, key: str) -> dict[str, float]:
        """Mean of a score of `RANKED` over the views of each object that has one."""
        return {
            part.object: value for part in self.objects if (value := getattr(part, key)) is not None
        }

    def on(self, benchmark: str) -> Entry | None:
        """The part of it on the objects of `TEST` or on those of `UNSEEN`, whatever its frames
        are."""
        return next(
            (part for part in self.entries if part.is_unseen == (benchmark == UNSEEN)), None
        )


def _title(name: str) -> str:
    return next(benchmark.title for benchmark in BENCHMARKS if benchmark.name == name)


@dataclass(frozen=True)
class Group:
    """Rows that may be compared: by rank, then the best value first. ``notes`` say why rows have no
    rank, and which are left out."""

    key: GroupKey
    rows: tuple[Ranked, ...]
    sort: str
    notes: tuple[str, ...] = ()

    @property
    def ranked(self) -> tuple[Ranked, ...]:
        return tuple(row for row in self.rows if row.best_rank is not None)

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """The tests of the ranked rows' pairs; none for a table of more than `MOST_PAIRED` of
        them."""
        if len(self.ranked) > MOST_PAIRED:
            return ()
        return tuple(pairs({row.short_name: row.object_means(self.sort) for row in self.ranked}))

    @property
    def parts(self) -> str:
        """The sets of samples that its rows are scored on, in words."""
        split = f"{self.key.split} split"
        names = [split] if any(row.on(TEST) for row in self.rows) else []
        return " + ".join(names + ["unseen"] * any(row.on(UNSEEN) for row in self.rows))

    @property
    def title(self) -> str:
        """The group's heading, the same in the terminal, in Markdown and on the page."""
        key = self.key
        return (
            f"{key.data_title}: {key.frames}, {key.track} track, {self.parts}, against "
            f"{key.against}{key.rules}"
        )

    @property
    def vouched(self) -> bool:
        """Whether the maintainers vouch for any of its rows."""
        return any(row.entry.vouched for row in self.rows)


def is_trivial(row: Ranked) -> bool:
    """Whether it is a row of a trivial method (`Method.trivial`) that was measured here; what
    others call their methods does not count."""
    method = methods().get(row.entry.row.submission.method)
    return method is not None and method.trivial and row.entry.all_checked


def more_than_trivial(groups: Sequence[Group]) -> list[Group]:
    """The groups that hold more than trivial rows, whose errors the others' ratios show; all where
    none does."""
    return [group for group in groups if not all(map(is_trivial, group.rows))] or list(groups)


def set_ratios(groups: Sequence[Group]) -> None:
    """Give the rows of ``groups`` their ``ratio``: object MAE over the smallest that a trivial row
    by the same rules has on the row's objects. Trivial rows need at most one frame, so they count
    in all classes; a row that is given something of the ground truth counts in the tracks that are
    given no less."""
    trivial: dict[GroupKey, list[tuple[set[str], dict[str, float]]]] = {}
    for group in groups:
        for row in filter(is_trivial, group.rows):
            trivial.setdefault(_alike(group.key), []).append(
                (given_words(group.key.track), row.object_means(OBJECT_KEY))
            )
    for group in groups:
        means = [
            own
            for given, own in trivial.get(_alike(group.key), [])
            if given <= given_words(group.key.track)
        ]
        for row in group.rows:
            row.ratio = _ratio(row, means)


def _alike(key: GroupKey) -> GroupKey:
    """What tables share whose rows are scored by the same rules on the same data."""
    return replace(key, frames=FRAMES_CLASSES[0], track="metric")


def given_words(track: Track) -> set[str]:
    """What of the ground truth the track's methods are given, in the words of `Track`."""
    return set(track.removeprefix("oracle ").split(" + ")) - {"metric"}


def _ratio(row: Ranked, trivial: Sequence[Mapping[str, float]]) -> float | None:
    errors = row.object_means(OBJECT_KEY)
    means = [
        fmean(means[name] for name in errors)
        for means in trivial
        if errors and means.keys() >= errors.keys()
    ]
    return fmean(errors.values()) / min(means) if means and min(means) > 0 else None


DEFAULT_SORT = RANK_KEY


def discover(here: Path) -> list[Path]:
    """Result files where none are named: the rows shipped with the package, then ``result*.json``
    and ``results/*.json`` of the folder ``here``."""
    return [
        *shipped_rows(),
        *sorted(here.glob("result*.json")),
        *sorted(here.glob("results/*.json")),
    ]


def shipped_rows() -> list[Path]:
    """The row files that ship with the package."""
    return sorted(rows.SHIPPED_ROWS.glob("*.json"))


def expand(paths: Iterable[Path]) -> list[Path]:
    """Files as given, folders as the ``*.json`` in them. SubmissionError for an empty folder or a
    file given twice."""
    files: list[Path] = []
    for path in paths:
        named = sorted(path.glob("*.json")) if path.is_dir() else [path]
        if not named:
            shown = printable(path)
            raise SubmissionError(
                f"{shown}: expected result files (*.json) in this folder, found none"
            )
        files += named
    seen: set[Path] = set()
    for path in files:
        if (whole := path.resolve()) in seen:
            raise SubmissionError(f"{printable(path)} is given twice; name each result once")
        seen.add(whole)
    return files


def read_entries(files: Sequence[Path]) -> list[Entry]:
    """Read every file strictly; SubmissionError names the first that is no sound result."""
    return [read_entry(path) for path in files]


def rank(entries: Iterable[Entry], sort: str = DEFAULT_SORT) -> list[Group]:
    """Groups in the order of `GroupKey.order`, those without a vouched row last; their rows by rank
    in ``sort`` (by default the `GroupKey.rank_key` of each), then the best value first, unknown
    values last. Equal values are ordered by name, so the order of the files changes nothing. Raises
    SubmissionError where rows contradict each other: a name twice in a group, or in any what looks
    like that of a vouched row; other objects of the same data; a vouched part of a row with one
    that nobody vouches for."""
    if sort in METRICS and METRICS[sort].helped_by_missing:
        raise SubmissionError(
            f"{sort}: a method could lead by answering few pixels; sort by {DEFAULT_SORT}"
        )
    if sort not in sort_keys():
        raise SubmissionError(
            f"expected a sort key out of {', '.join(sort_keys())}, got {printable(sort)!r}"
        )
    members: dict[GroupKey, list[Entry]] = {}
    notes: dict[GroupKey, list[str]] = {}
    vouched: dict[object, Entry] = {}
    originals: dict[object, Entry] = {}
    # Vouched rows first: of two copies they stay, and what others contradict is theirs.
    for entry in sorted(
        entries, key=lambda e: (list(MEANING).index(e.provenance), e.is_unseen, e.name, e.path.name)
    ):
        key = GroupKey.of(entry)
        predictions = entry.is_unseen, entry.row.predictions_sha256
        # Whatever a row says of its frames and track, predictions that are vouched for are those of
        # one method.
        original = vouched.get((_alike(key), predictions)) or originals.setdefault(
            (key, predictions), entry
        )
        if entry.vouched:
            vouched[_alike(key), predictions] = original
        if original is entry:
            members.setdefault(key, []).append(entry)
        else:
            notes.setdefault(GroupKey.of(original), []).append(copy_note(entry, original))
    groups = [_group(key, of_key, notes.get(key, []), sort) for key, of_key in members.items()]
    groups.sort(key=lambda group: (not group.vouched, group.key.order))
    _check_names([row for group in groups for row in group.rows])
    set_ratios(groups)
    return groups


def _check_names(shown: Sequence[Ranked]) -> None:
    """Refuse (SubmissionError) a row that nobody vouches for under a name that looks like the full
    or the short one of a vouched row, in any table. That very name is the name of a row of the same
    method."""
    taken = {
        name: row for row in shown if row.entry.vouched for name in (row.short_name, row.entry.name)
    }
    for entry in (entry for row in shown for entry in row.entries if not entry.vouched):
        for name, row in taken.items():
            own = name if entry.provenance == LOCAL else row.entry.name
            of_method = entry.row.submission.method == row.entry.row.submission.method
            if looks_like(entry.name, name) and not (entry.name == own and of_method):
                raise SubmissionError(
                    f"{printable(entry.path)}: the name {printable(entry.name)!r} is "
                    f"{printable(name)!r}, or "
                    f"looks like it, which is that of {printable(row.entry.path)}; give "
                    f"it another name"
                )


def _group(key: GroupKey, entries: Sequence[Entry], notes: list[str], sort: str) -> Group:
    sort = key.rank_key if sort == DEFAULT_SORT else sort
    methods = _methods(entries)
    claims = [first.name for first, _ in methods if first.provenance == SELF_REPORTED]
    names = short_names([first.row.submission for first, _ in methods], claims)
    shown = [
        Ranked(first, name, unseen) for (first, unseen), name in zip(methods, names, strict=True)
    ]
    # Smaller is better: a tolerance share with its sign turned.
    turned = operator.neg if sort in METRICS and METRICS[sort].better == "higher" else operator.pos

    def by_rank(row: Ranked) -> tuple[object, ...]:
        value = row.value(sort)
        ranks = row.best_rank or math.inf, row.worst_rank or 0
        return value is None, *ranks, 0.0 if value is None else turned(value), row.entry.name

    shown.sort(key=by_rank)
    complete = [
        row for row in shown if (row.unseen or not key.takes_unseen) and row.value(sort) is not None
    ]
    family = [row for row in complete if row.entry.vouched] or [
        row for row in complete if row.provenance == LOCAL
    ]
    if why := _no_ranks(key, shown, complete, family, sort):
        return Group(key, tuple(shown), sort, (why, *notes))
    objects = sorted(family[0].object_means(sort))
    errors = np.array([[row.object_means(sort)[name] for name in objects] for row in family])
    for row, ranks in zip(family, rank_ranges(errors), strict=True):
        row.best_rank, row.worst_rank = ranks
    values = sorted(row.value(sort) or 0.0 for row in family)
    for row in complete:
        row.place = 1 + bisect_left(values, row.value(sort) or 0.0)
    if len(complete) < len(shown):
        notes.insert(0, "Rows without a result on the unseen objects have no rank.")
    return Group(key, tuple(sorted(shown, key=by_rank)), sort, tuple(notes))


def _methods(entries: Sequence[Entry]) -> list[tuple[Entry, Entry | None]]:
    """The two parts of each method, that on the test objects first, if there is one.
    SubmissionError where two rows contradict each other."""
    by_name: dict[str, tuple[Entry, Entry | None]] = {}
    by_data: dict[bool, Entry] = {}
    for entry in sorted(entries, key=lambda entry: entry.is_unseen):
        key = name_key(entry.name)
        if key in by_name:
            test, unseen = by_name[key]
            _check_one_method(unseen or test, entry)
        by_name[key] = (by_name[key][0], entry) if key in by_name else (entry, None)
        first = by_data.setdefault(entry.is_unseen, entry)
        if _counts(first) != _counts(entry):
            files = [printable(e.path) for e in (entry, first)]
            raise SubmissionError(
                f"{files[0]}: its objects, samples or pixels are not those of {files[1]} on the "
                f"same data; score the "
                "predictions again, or leave it out"
            )
    return list(by_name.values())


def _counts(entry: Entry) -> set[tuple[str, int, int, int]]:
    return {
        (part.object, part.samples, part.object_pixels, part.void_pixels)
        for part in entry.row.per_object
    }


def _check_one_method(first: Entry, second: Entry) -> None:
    """Refuse (SubmissionError) two rows of one name that are not a method's on the two test
    sets."""
    files = [printable(entry.path) for entry in (first, second)]
    both = f"{files[0]} and {files[1]} both hold {printable(first.name)!r}"
    if first.name != second.name:
        both += f" or what looks like it, {printable(second.name)!r},"
    if first.is_unseen == second.is_unseen:
        raise SubmissionError(f"{both} on the same data; leave one out, or give one another name")
    about_first, about_second = first.row.submission, second.row.submission
    weights = "weights_sha256"
    for what, of_first, of_second in (
        ("method", about_first.method, about_second.method),
        ("frames_used", sorted(about_first.frames_used), sorted(about_second.frames_used)),
        (
            f"settings.{weights}",
            about_first.settings.get(weights),
            about_second.settings.get(weights),
        ),
    ):
        if of_first != of_second:
            raise SubmissionError(
                f"{both}, on the test and on the unseen objects, but {what} is "
                f"{printable(str(of_first))} and "
                f"{printable(str(of_second))}; run both with the same method, or give one another "
                f"name"
            )
    if first.vouched != second.vouched:
        raise SubmissionError(
            f"{both}, and the maintainers vouch for one of them only ({first.provenance} and "
            f"{second.provenance}); a "
            "row is joined of two parts that are vouched for, or of two that are not: give one "
            "another name"
        )


def _no_ranks(
    key: GroupKey,
    shown: Sequence[Ranked],
    complete: Sequence[Ranked],
    family: Sequence[Ranked],
    sort: str,
) -> str:
    """Why a table has no ranks; empty where it has."""
    if sort not in RANKED:
        return f"No ranks by {sort}: the order is that of the values."
    objects = max(len(row.objects) for row in complete or shown)
    smallest = (
        f"With {objects} object{'s' * (objects != 1)} the smallest p value of a test is "
        f"{2.0 ** (1 - objects):g}"
    )
    too_few = f" {smallest}, above 5%." if objects < FEWEST_OBJECTS else ""
    if key.takes_unseen and len(complete) < 2:
        how_many = "no row here has both" if not complete else "only one row here has both"
        return (
            f"No ranks: they need the test objects and those of {UNSEEN}, and {how_many}.{too_few}"
        )
    if too_few:
        return f"No ranks.{too_few} Each row's interval is its own."
    if len(complete) > 1 and not family:
        return "No ranks: nobody vouches for a row here."
    return "" if len(family) > 1 else "No ranks: there are not two rows to compare."


LONGEST_NAME = 36
"""Characters of a short name."""


def short_names(submissions: Sequence[Submission], own: Collection[str] = ()) -> list[str]:
    """A short name for each of the ``submissions`` of a group, whose own names differ. The order
    changes no name. Where two would look the same, the later by its own name has a number behind
    it. Those in ``own``, which only claim to be this package's methods, keep their own names,
    behind all others."""
    derived = {s.name: None if s.name in own else _from_settings(s) for s in submissions}
    chosen: dict[str, str] = {}
    taken: set[str] = set()
    for name in sorted(derived, key=lambda name: (name in own, derived[name] is None, name)):
        short, number = derived[name] or cut_at_word(printable(name)), 1
        candidate = short
        while name_key(candidate) in taken:
            number += 1
            suffix = f" ({number})"
            candidate = cut_at_word(short, LONGEST_NAME - len(suffix)) + suffix
        taken.add(name_key(candidate))
        chosen[name] = candidate
    return [chosen[submission.name] for submission in submissions]


def cut_at_word(text: str, longest: int = LONGEST_NAME) -> str:
    """``text``, or as many of its words as fit into ``longest`` characters with an ellipsis behind
    them."""
    if len(text) <= longest:
        return text
    words = text[:longest].rpartition(" ")[0].rstrip(" ,;:-+(")
    return (words or text[: longest - 1]) + "…"


def _from_settings(submission: Submission) -> str | None:
    """A name made of the method's settings; None for a submission that is not one of this package's
    methods."""
    method = methods().get(submission.method, network_method())
    for maker in (method, network_method()):
        try:
            name = maker.short_name(submission)
        except (
            KeyError,
            TypeError,
            ValueError,
        ):  # settings that the package's methods do not write
            return None
        if name is not None:
            return name if len(name) <= LONGEST_NAME else None
    return None
