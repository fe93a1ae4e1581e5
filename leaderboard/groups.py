"""The leaderboard's tables: what rows must share to stand in one, how a table and its data are called, and which row is
behind which. The row of a method on the test objects and that on the unseen ones are shown as one.

Two rows are compared by their paired differences over the objects: a sign-flip test of each pair, Holm's correction
over all pairs of the table, and the ranks that follow.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.registry import methods
from fpp_ml_bench.constants import FULL_SIZE
from fpp_ml_bench.evaluation.metrics import HEADLINE, RANK_KEY
from fpp_ml_bench.evaluation.protocol import FRAMES_CLASSES, FramesClass, Track
from fpp_ml_bench.evaluation.score.uncertainty import (
    SIGNIFICANT,
    Interval,
    holm,
    object_interval,
    sign_flip_bounds,
    sign_flip_p,
)
from fpp_ml_bench.leaderboard.row_file import ObjectMeans, Row, interval_over, mean_over
from fpp_ml_bench.leaderboard.rows import MEANING, Entry
from fpp_ml_bench.loaders.storage.benchmark import BENCHMARKS, Benchmark, benchmark_of

TEST, UNSEEN = "fpp-bench-full", "fpp-bench-unseen"
"""The benchmark whose test split, and the set of unseen objects that, make one row."""
MOST_PAIRED = 40
"""Ranked rows up to which a table lists its pairs, 780 of them."""
_AT_ONCE = 50_000
"""Pairs whose differences are held at once."""


@dataclass(frozen=True, order=True)
class GroupKey:
    """What two rows must share to be compared. ``data`` is the title of the benchmark whose scenes were scored, or for
    other data their `DatasetInfo.truth`, whatever was projected; the unseen objects have that of the benchmark whose
    test split they complete."""

    frames: FramesClass
    track: Track
    mode: str
    split: str
    target: str
    data: str
    size: tuple[int, int]
    edge_band_px: int
    protocol_version: str

    @classmethod
    def of(cls, row: Row) -> "GroupKey":
        info, benchmark = row.dataset, scenes_of(row)
        data = info.truth if benchmark is None else _title(TEST) if is_unseen(row) else benchmark.title
        return cls(
            row.frames_class,
            row.track,
            row.mode,
            info.split,
            row.target,
            data,
            (info.size[0], info.size[1]),
            row.edge_band_px,
            row.protocol_version,
        )

    @property
    def benchmark(self) -> Benchmark | None:
        """Whose scenes these are; None for data without a name."""
        return next((benchmark for benchmark in BENCHMARKS if benchmark.title == self.data), None)

    @property
    def takes_unseen(self) -> bool:
        """Whether a row of this group has a part on the unseen objects beside that on the test objects."""
        return self.split == "test" and self.data == _title(TEST)

    @property
    def special_data(self) -> str:
        """What sets a benchmark apart from those that are shown first, in words: another light or a small image, as
        ``workshop``, ``224 px``; empty for the others."""
        benchmark = self.benchmark
        if benchmark is None or (benchmark.light == "paper" and benchmark.size == FULL_SIZE):
            return ""
        words = [benchmark.light, f"{benchmark.size} px"]
        return ", ".join(word for word, usual in zip(words, ("paper", f"{FULL_SIZE} px"), strict=True) if word != usual)

    @property
    def order(self) -> tuple[object, ...]:
        """Sort key of the groups: named benchmarks as they are listed, then other data; the larger images first, then
        the fewer frames, the metric track before the others."""
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
        """``fpp-bench-full version 2, 960 x 960 px``; other data by size and the first 8 digits of their hash."""
        pixels = f"{self.size[1]} x {self.size[0]} px"
        return f"{pixels}, data {self.data[:8]}" if self.benchmark is None else f"{self.data}, {pixels}"

    @property
    def against(self) -> str:
        """The ground truth in words: exact depth or decoded depth."""
        return "exact depth" if self.target == "depth_exact" else "decoded depth"


@dataclass(frozen=True)
class Ranked:
    """A row: a method on the test objects in ``entry`` and on the ``unseen`` ones, or ``entry`` alone. With the best
    and the worst rank that the tests allow, None where it is not ranked; a row beside the ranks has a ``place``, 1 +
    the ranked rows with a smaller error. ``ratio``: its object MAE over that of the best trivial method on the same
    objects, None without any."""

    entry: Entry
    short_name: str
    unseen: Entry | None = None
    best_rank: int | None = None
    worst_rank: int | None = None
    place: int | None = None
    ratio: float | None = None

    @property
    def ranks(self) -> str:
        """``1-4``, or the single number where both ranks agree; ``(4)`` beside the ranks; a dash without any."""
        if self.best_rank is None:
            return "-" if self.place is None else f"({self.place})"
        return str(self.best_rank) if self.best_rank == self.worst_rank else f"{self.best_rank}-{self.worst_rank}"

    @property
    def provenance(self) -> str:
        """The weakest of its parts' (a key of `MEANING`)."""
        return max((part.provenance for part in self._parts), key=list(MEANING).index)

    @property
    def _parts(self) -> list[Entry]:
        return [entry for entry in (self.entry, self.unseen) if entry is not None]

    @cached_property
    def objects(self) -> tuple[ObjectMeans, ...]:
        """The objects that it is scored on."""
        return tuple(part for entry in self._parts for part in entry.row.per_object)

    def value(self, key: str) -> float | None:
        """Mean of a sort key over all samples of the row; None for an empty pixel set or an unknown time. Of a row with
        two parts, scores beside `HEADLINE` are weighted by the samples of each."""
        if self.unseen is None or key in ("seconds_per_sample", "frames_used"):
            return self.entry.value(key)
        if key in HEADLINE:
            return mean_over(self.objects, key)
        known = [(value, part.row.dataset.samples) for part in self._parts if (value := part.value(key)) is not None]
        return sum(value * samples for value, samples in known) / sum(n for _, n in known) if known else None

    def interval(self, key: str) -> Interval | None:
        """The 95% interval of ``key`` over all objects of the row; None where it has none."""
        return self.entry.row.intervals.of(key) if self.unseen is None else self._joined.get(key)

    @cached_property
    def _joined(self) -> dict[str, Interval | None]:
        return {key: interval_over(self.objects, key) for key in HEADLINE}

    def object_means(self, key: str) -> dict[str, float]:
        """Mean of a headline score over the views of each object that has one."""
        return {part.object: value for part in self.objects if (value := getattr(part, key)) is not None}

    def on(self, benchmark: str) -> Entry | None:
        """The part of it on the objects of `TEST` or on those of `UNSEEN`, whatever its frames are."""
        return next((part for part in self._parts if is_unseen(part.row) == (benchmark == UNSEEN)), None)


def scenes_of(row: Row) -> Benchmark | None:
    """The benchmark whose scenes a row is scored on, whatever was projected."""
    return benchmark_of(row.dataset.content)


def is_unseen(row: Row) -> bool:
    """Whether a row is scored on the set of unseen objects."""
    benchmark = scenes_of(row)
    return benchmark is not None and benchmark.name == UNSEEN and row.dataset.split == "test"


def _title(name: str) -> str:
    return next(benchmark.title for benchmark in BENCHMARKS if benchmark.name == name)


@dataclass(frozen=True)
class Pair:
    """Two rows by their short names, the smaller error first: the mean of second minus first over the ``objects`` (at
    least 0), its 95% interval, the sign-flip test's p value, and that value after Holm's correction over all pairs of
    the table. ``behind``: whether the second is behind the first, the corrected value being at most 5%."""

    first: str
    second: str
    objects: int
    difference: float
    interval: Interval | None
    p: float
    p_holm: float
    behind: bool


def pairs(errors: Mapping[str, Mapping[str, float]]) -> list[Pair]:
    """Every pair of the rows by name, whose errors by object are ``errors``; smaller is better."""
    compared = []
    for first, second in combinations(errors, 2):
        differences = [errors[second][name] - errors[first][name] for name in errors[first]]
        if fmean(differences) < 0:
            first, second, differences = second, first, [-value for value in differences]
        compared.append((first, second, differences, sign_flip_p(differences)))
    adjusted = holm([p for *_, p in compared])
    return [
        Pair(
            first,
            second,
            len(differences),
            fmean(differences),
            object_interval(differences, range(len(differences))),
            p,
            p_holm,
            p_holm <= SIGNIFICANT,
        )
        for (first, second, differences, p), p_holm in zip(compared, adjusted, strict=True)
    ]


def behind(errors: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Who is behind whom, as `pairs` says: ``errors`` (rows, objects), smaller is better, gives (rows, rows), [i, j]
    True where row j is behind row i. A pair is tested by itself only where the bounds of its p value don't decide."""
    first, second = np.triu_indices(len(errors), 1)
    low, high = np.empty(len(first)), np.empty(len(first))
    for start in range(0, len(first), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        low[part], high[part] = sign_flip_bounds(errors[second[part]] - errors[first[part]])
    apart, left = np.zeros(len(first), bool), len(first)
    while left:  # Holm's procedure: with each pair that differs, fewer are left, and the next may have a larger p
        for pair in np.flatnonzero((left * low <= SIGNIFICANT) & (left * high > SIGNIFICANT)):
            low[pair] = high[pair] = sign_flip_p(errors[second[pair]] - errors[first[pair]])
        apart = left * high <= SIGNIFICANT
        if (now_left := len(first) - int(np.count_nonzero(apart))) == left:
            break
        left = now_left
    means = errors.mean(axis=1)
    is_behind = np.zeros((len(errors), len(errors)), bool)
    second_ahead = means[second] < means[first]
    better, worse = np.where(second_ahead, second, first), np.where(second_ahead, first, second)
    is_behind[better[apart], worse[apart]] = True
    return is_behind


def rank_ranges(errors: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Best and worst rank that the tests allow each row of ``errors``, as `behind` takes them. Best: 1 and the number
    of rows that it is behind. Worst: the number of all rows without those behind it."""
    is_behind = behind(errors)
    best, worst = 1 + is_behind.sum(axis=0), len(errors) - is_behind.sum(axis=1)
    return list(zip(best.tolist(), worst.tolist(), strict=True))


@dataclass(frozen=True)
class Group:
    """Rows that may be compared: by rank, then the best value first. ``notes`` say why rows have no rank, and which are
    left out."""

    key: GroupKey
    rows: tuple[Ranked, ...]
    sort: str
    notes: tuple[str, ...] = ()

    @property
    def ranked(self) -> tuple[Ranked, ...]:
        return tuple(row for row in self.rows if row.best_rank is not None)

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """The tests of the ranked rows' pairs; none for a table of more than `MOST_PAIRED` of them."""
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
        mode = "" if key.mode == "standard" else f", mode {key.mode}"
        return f"{key.data_title}: {key.frames}, {key.track} track, {self.parts}, against {key.against}{mode}"


def is_trivial(row: Ranked) -> bool:
    """Whether it is a row of a trivial method (`Method.trivial`) that was measured here; what others call their methods
    does not count."""
    method = methods().get(row.entry.row.submission.method)
    return method is not None and method.trivial and row.entry.all_checked


def more_than_trivial(groups: Sequence[Group]) -> list[Group]:
    """The groups that hold more than trivial rows, whose errors the others' ratios show; all where none does."""
    return [group for group in groups if not all(map(is_trivial, group.rows))] or list(groups)


def with_ratios(groups: Sequence[Group]) -> list[Group]:
    """``groups`` whose rows have their ``ratio``: object MAE over the smallest that a trivial row by the same rules has
    on the row's objects. Trivial rows need at most one frame, so they count in all classes; a row that is given
    something of the ground truth counts in the tracks that are given no less."""
    trivial: dict[tuple[object, ...], list[tuple[set[str], dict[str, float]]]] = {}
    for group in groups:
        for row in filter(is_trivial, group.rows):
            trivial.setdefault(_data(group.key), []).append((_given(group.key), row.object_means(RANK_KEY)))
    with_ratio = []
    for group in groups:
        means = [own for given, own in trivial.get(_data(group.key), []) if given <= _given(group.key)]
        with_ratio.append(replace(group, rows=tuple(replace(row, ratio=_ratio(row, means)) for row in group.rows)))
    return with_ratio


def _given(key: GroupKey) -> set[str]:
    """What of the ground truth the track's methods are given, in the words of `Track`."""
    return set(key.track.removeprefix("oracle ").split(" + ")) - {"metric"}


def _data(key: GroupKey) -> tuple[object, ...]:
    return key.data, key.size, key.split, key.target, key.mode, key.edge_band_px, key.protocol_version


def _ratio(row: Ranked, trivial: Sequence[Mapping[str, float]]) -> float | None:
    errors = row.object_means(RANK_KEY)
    means = [fmean(means[name] for name in errors) for means in trivial if errors and means.keys() >= errors.keys()]
    return fmean(errors.values()) / min(means) if means and min(means) > 0 else None
