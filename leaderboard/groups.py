"""The leaderboard's tables: what rows must share to stand in one, and how a table and its data are called. The
row of a method on the test objects and that on the unseen ones are shown as one."""

from dataclasses import dataclass, field
from functools import cached_property

from fpp_ml_bench.constants import FULL_SIZE
from fpp_ml_bench.evaluation.metrics import HEADLINE
from fpp_ml_bench.evaluation.protocol import FRAMES_CLASSES, PROTOCOL_VERSION, FramesClass, Track
from fpp_ml_bench.evaluation.score import Interval
from fpp_ml_bench.leaderboard.pairs import Pair, pairs
from fpp_ml_bench.leaderboard.row_file import ObjectMeans, Row, interval_over, mean_over
from fpp_ml_bench.leaderboard.rows import MEANING, Entry
from fpp_ml_bench.loaders.storage import BENCHMARKS, Benchmark, benchmark_of

EARLIER_PROTOCOL_NOTE = (
    "Scored by an earlier protocol, with other rules than today's results: these rows compare only within their group."
)
TEST, UNSEEN = "fpp-bench-full", "fpp-bench-unseen"
"""The benchmark whose test split, and the set of unseen objects that, make one row."""
MOST_PAIRED = 40
"""Ranked rows up to which a table lists its pairs, 780 of them."""


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
    def aside(self) -> str:
        """What sets a benchmark apart from those that are shown first, in words: another light or a small image, as
        ``workshop``, ``224 px``; empty for the others."""
        benchmark = self.benchmark
        if benchmark is None or (benchmark.light == "paper" and benchmark.size == FULL_SIZE):
            return ""
        words = [benchmark.light, f"{benchmark.size} px"]
        return ", ".join(word for word, usual in zip(words, ("paper", f"{FULL_SIZE} px"), strict=True) if word != usual)

    @property
    def notes(self) -> list[str]:
        """Why the rows are not comparable with today's results; empty where they are."""
        return [EARLIER_PROTOCOL_NOTE] * (self.protocol_version != PROTOCOL_VERSION)

    @property
    def order(self) -> tuple[object, ...]:
        """Sort key of the groups: named benchmarks as they are listed, other data, earlier protocols; the larger images
        first, then the fewer frames, the metric track before the others."""
        place = len(BENCHMARKS) if self.benchmark is None else BENCHMARKS.index(self.benchmark)
        return (
            len(self.notes),
            self.benchmark is None,
            -self.size[0] * self.size[1],
            place,
            self.data,
            self.protocol_version,
            FRAMES_CLASSES.index(self.frames),
            self.track != "metric",
            self,
        )

    @property
    def data_title(self) -> str:
        """``fpp-bench-full version 2, 960 x 960 px``; other data by size and the first 8 digits of their hash."""
        pixels = f"{self.size[1]} x {self.size[0]} px"
        data = f"{pixels}, data {self.data[:8]}" if self.benchmark is None else f"{self.data}, {pixels}"
        return data + (f", protocol {self.protocol_version}" if self.notes else "")

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
    _intervals: dict[str, Interval | None] = field(default_factory=dict, compare=False, repr=False)

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
        if self.unseen is None:
            return self.entry.row.intervals.of(key)
        if key not in self._intervals:
            self._intervals[key] = interval_over(self.objects, key) if key in HEADLINE else None
        return self._intervals[key]

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
