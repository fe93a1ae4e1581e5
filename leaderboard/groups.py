"""The leaderboard's tables: what results must share to stand in one, and how a table and its data are called. The
result of a method on the test objects and that on the unseen ones are one row."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean

from fpp_ml_bench.constants import FULL_SIZE
from fpp_ml_bench.evaluation.protocol import HEADLINE, METRICS, PROTOCOL_VERSION, Track
from fpp_ml_bench.evaluation.result import Result
from fpp_ml_bench.evaluation.score import Interval, object_interval
from fpp_ml_bench.leaderboard.pairs import Pair
from fpp_ml_bench.leaderboard.rows import Entry
from fpp_ml_bench.loaders.storage import BENCHMARKS, EARLIER, benchmark_of, current_benchmark
from fpp_ml_bench.optics import DIRECTIONS, PAPER_SEQUENCE

LEGACY_FINGERPRINTS = (
    "5b87ff86edee389e45c5a2110ac34ab4fa3310c096a0860780a20dd69fdcac06",
    "c5f61ca76258e24bc197e1d8a3dce100ecddabb90eef57b1ae0c43334648f4de",
)
"""Data of earlier rows that the package does not build any more, unless it is a named benchmark."""
LEGACY_NOTE = (
    "Legacy: scored on data that the current version of the package does not build any more; these rows compare only "
    "within their group."
)
EARLIER_PROTOCOL_NOTE = (
    "Scored by an earlier protocol, with other rules than today's results: these rows compare only within their group."
)
ONE_FRAME, FEW_FRAMES, FULL_SEQUENCE = CLASSES = ("one frame", "few frames, no code", "full sequence")
"""What a method captures: at most one frame; several but no Gray code; frames with Gray code."""
TEST, UNSEEN = "fpp-bench-full", "fpp-bench-unseen"
COMPLETES = {UNSEEN: TEST, "fpp-bench-crossed-unseen": "fpp-bench-crossed"}
"""Sets of unseen objects, and the benchmark whose test split each makes one row with."""


def frames_class(frames_used: Sequence[int]) -> str:
    """Of `CLASSES`. The frames are numbered as in the paper's sequence, which all named benchmarks and the published
    dataset have; a result does not say what other sequence its data have."""
    if len(frames_used) <= 1:
        return ONE_FRAME
    code = {index for direction in DIRECTIONS for index in PAPER_SEQUENCE.gray(direction)}
    return FULL_SEQUENCE if code & set(frames_used) else FEW_FRAMES


@dataclass(frozen=True, order=True)
class GroupKey:
    """What two results must share to be compared. ``fingerprint`` identifies the dataset, not its folder's name; for
    results on the unseen objects it is that of the benchmark whose test split they complete."""

    frames: str
    track: Track
    mode: str
    split: str
    target: str
    fingerprint: str
    size: tuple[int, int]
    edge_band_px: int
    protocol_version: str

    @classmethod
    def of(cls, result: Result) -> "GroupKey":
        data, frames = result.dataset, frames_class(result.submission.frames_used)
        fingerprint = _completed().get(data.fingerprint, data.fingerprint) if data.split == "test" else data.fingerprint
        return cls(
            frames, result.track, result.mode, data.split, result.target, fingerprint, (data.size[0], data.size[1]),
            result.edge_band_px, result.protocol_version,
        )  # fmt: skip

    @property
    def takes_unseen(self) -> bool:
        """Whether a row of this group has a result on the unseen objects beside that on the test objects."""
        return self.split == "test" and self.fingerprint in _completed().values()

    @property
    def is_legacy(self) -> bool:
        benchmark = benchmark_of(self.fingerprint)
        return benchmark in EARLIER if benchmark is not None else self.fingerprint in LEGACY_FINGERPRINTS

    @property
    def aside(self) -> str:
        """What sets a benchmark apart from those that are shown first, in words: another light or a small image, as
        ``workshop``, ``crossed, hard``, ``224 px``; empty for the others."""
        benchmark = benchmark_of(self.fingerprint)
        if benchmark is None or (benchmark.light == "paper" and benchmark.size == FULL_SIZE):
            return ""
        words = [benchmark.rig, benchmark.light, f"{benchmark.size} px"]
        usual = "paper", "paper", f"{FULL_SIZE} px"
        return ", ".join(word for word, other in zip(words, usual, strict=True) if word != other)

    @property
    def notes(self) -> list[str]:
        """Why the rows are not comparable with today's results; empty where they are."""
        earlier = self.protocol_version != PROTOCOL_VERSION
        return [LEGACY_NOTE] * self.is_legacy + [EARLIER_PROTOCOL_NOTE] * earlier

    @property
    def order(self) -> tuple[object, ...]:
        """Sort key of the groups: named benchmarks as they are listed, other data, earlier protocols, legacy data; the
        larger images first, then the fewer frames, the metric track before the others."""
        benchmark = benchmark_of(self.fingerprint)
        data = 3 if self.is_legacy else 2 if self.protocol_version != PROTOCOL_VERSION else 0 if benchmark else 1
        place = BENCHMARKS.index(benchmark) if benchmark in BENCHMARKS else len(BENCHMARKS)
        return (
            data, -self.size[0] * self.size[1], place, self.fingerprint, self.protocol_version,
            CLASSES.index(self.frames), self.track != "metric", self,
        )  # fmt: skip

    @property
    def data_title(self) -> str:
        """``fpp-bench-full version 0, 960 x 960 px``; other data by size and the fingerprint's first 8 digits."""
        benchmark, pixels = benchmark_of(self.fingerprint), f"{self.size[1]} x {self.size[0]} px"
        data = f"{pixels}, data {self.fingerprint[:8]}" if benchmark is None else f"{benchmark.title}, {pixels}"
        protocol = "" if self.protocol_version == PROTOCOL_VERSION else f", protocol {self.protocol_version}"
        return data + (", legacy" if self.is_legacy else "") + protocol

    @property
    def against(self) -> str:
        """The ground truth in words: exact depth or decoded depth."""
        return "exact depth" if self.target == "depth_exact" else "decoded depth"


@dataclass(frozen=True)
class Ranked:
    """A row: a method's result on the test objects in ``entry`` and on the ``unseen`` ones, or ``entry`` alone. With
    the best and the worst rank that the tests allow, None where it is not ranked; ``ratio``: its object MAE over that
    of the best trivial method on the same objects, None without any."""

    entry: Entry
    short_name: str
    unseen: Entry | None = None
    best_rank: int | None = None
    worst_rank: int | None = None
    ratio: float | None = None

    @property
    def ranks(self) -> str:
        """``1-4``, or the single number where both ranks agree; a dash without any."""
        if self.best_rank is None:
            return "-"
        return str(self.best_rank) if self.best_rank == self.worst_rank else f"{self.best_rank}-{self.worst_rank}"

    @cached_property
    def _samples(self) -> list[tuple[str, dict[str, float | None]]]:
        results = [entry.result for entry in (self.entry, self.unseen) if entry is not None]
        return [(row.object, {key: getattr(row, key) for key in METRICS}) for r in results for row in r.per_sample]

    @cached_property
    def _intervals(self) -> dict[str, Interval | None]:
        objects = [name for name, _ in self._samples]
        return {key: object_interval([row[key] for _, row in self._samples], objects) for key in HEADLINE}

    def value(self, key: str) -> float | None:
        """Mean of a sort key over all samples of the row; None for an empty pixel set or an unknown time."""
        if self.unseen is None or key not in METRICS:
            return self.entry.value(key)
        values = [value for _, row in self._samples if (value := row[key]) is not None]
        return fmean(values) if values else None

    def interval(self, key: str) -> Interval | None:
        """The 95% interval of ``key`` over all objects of the row; None where it has none."""
        return self.entry.interval(key) if self.unseen is None else self._intervals.get(key)

    @cached_property
    def objects(self) -> tuple[str, ...]:
        """The objects that it is scored on."""
        return tuple(dict.fromkeys(name for name, _ in self._samples))

    def object_means(self, key: str) -> dict[str, float]:
        """Mean of a score over the views of each object that has one."""
        views: dict[str, list[float]] = {}
        for name, row in self._samples:
            if (value := row[key]) is not None:
                views.setdefault(name, []).append(value)
        return {name: fmean(values) for name, values in views.items()}

    def on(self, benchmark: str) -> Entry | None:
        """The part of it on the objects of `TEST` or on those of `UNSEEN`, whatever their frames are."""
        parts = [entry for entry in (self.entry, self.unseen) if entry is not None]
        return next((e for e in parts if (_is_unseen(e) == (benchmark == UNSEEN))), None)


def _completed() -> dict[str, str]:
    """Fingerprints of the sets of unseen objects, and of the benchmark that each completes."""
    pairs = ((current_benchmark(unseen), current_benchmark(test)) for unseen, test in COMPLETES.items())
    return {unseen.fingerprint: test.fingerprint for unseen, test in pairs if unseen is not None and test is not None}


def _is_unseen(entry: Entry) -> bool:
    return entry.result.dataset.fingerprint in _completed()


def joined(entries: Sequence[Entry]) -> tuple[Entry, Entry | None]:
    """The results of a method as `Ranked` takes them: that on the test objects first, if there is one."""
    ordered = sorted(entries, key=_is_unseen)
    return ordered[0], ordered[1] if len(ordered) > 1 else None


@dataclass(frozen=True)
class Group:
    """Rows that may be compared: by rank, then the best value first. ``pairs`` of the ranked rows; ``unranked`` says
    why rows have no rank, empty where all have one. ``dataset_name`` is what the dataset's folder was called."""

    key: GroupKey
    dataset_name: str
    rows: tuple[Ranked, ...]
    pairs: tuple[Pair, ...] = ()
    unranked: str = ""

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
