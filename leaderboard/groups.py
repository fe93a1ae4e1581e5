"""Groups of the leaderboard: what results must share to be ranked together, how a group and its data are called, and
what its methods assumed or were told."""

from dataclasses import dataclass

from fpp_ml_bench.evaluation.result import Result
from fpp_ml_bench.leaderboard.rows import Entry
from fpp_ml_bench.loaders.storage import benchmark_of

LEGACY_FINGERPRINTS = frozenset(
    {
        "5b87ff86edee389e45c5a2110ac34ab4fa3310c096a0860780a20dd69fdcac06",
        "c5f61ca76258e24bc197e1d8a3dce100ecddabb90eef57b1ae0c43334648f4de",
    }
)
"""Data of earlier rows that the package does not build any more, unless it is a named benchmark."""
LEGACY_NOTE = (
    "Legacy: scored on data that the current version of the package does not build any more; these rows compare only "
    "within their group."
)
TOLD = {
    "metric": "",
    "oracle mask": "the test sample's object mask",
    "oracle range": "the test sample's depth range",
    "oracle range + mask": "the test sample's depth range and object mask",
}
"""What the methods of a track are told about the very samples that they are scored on."""
_BRIGHTNESS = (
    "one albedo, known exposure",
    "Assumes one albedo for all surfaces and a known exposure (the lamp's strength and the ambient light): the "
    "brightness of the fringe image decides the fringe order.",
)
_ASSUMED = {"phase": _BRIGHTNESS, "phase-net": _BRIGHTNESS}
"""By method: in a few words for a table, and as a sentence. It holds unless the setting ``shading`` is off."""


@dataclass(frozen=True, order=True)
class GroupKey:
    """What two results must share to be compared. The dataset is identified by its
    ``fingerprint``, not by its folder's name."""

    track: str
    mode: str
    split: str
    target: str
    fingerprint: str
    size: tuple[int, int]
    edge_band_px: int
    protocol_version: str

    @property
    def is_legacy(self) -> bool:
        return benchmark_of(self.fingerprint) is None and self.fingerprint in LEGACY_FINGERPRINTS

    @property
    def order(self) -> tuple[object, ...]:
        """Sort key of the groups: named benchmarks, other data, legacy data; the larger images first."""
        data = 2 if self.is_legacy else 0 if benchmark_of(self.fingerprint) is not None else 1
        return (data, -self.size[0] * self.size[1], self.fingerprint, self)

    @property
    def data_title(self) -> str:
        """``fpp-bench-full version 0, 960 x 960 px``; other data by size and the fingerprint's first 8 digits."""
        height, width = self.size
        benchmark, pixels = benchmark_of(self.fingerprint), f"{width} x {height} px"
        if benchmark is not None:
            return f"{benchmark.title}, {pixels}"
        return f"{pixels}, data {self.fingerprint[:8]}" + (", legacy" if self.is_legacy else "")

    @property
    def against(self) -> str:
        """The ground truth in words: exact depth or decoded depth."""
        return "exact depth" if self.target == "depth_exact" else "decoded depth"

    @property
    def title(self) -> str:
        """The group's heading, the same in the terminal, in Markdown and on the page."""
        mode = "" if self.mode == "standard" else f", mode {self.mode}"
        return f"{self.data_title}: {self.track} track, {self.split} split, against {self.against}{mode}"


@dataclass(frozen=True)
class Ranked:
    """An entry with the best and the worst rank in its group that the intervals allow, and its short name there."""

    best_rank: int
    worst_rank: int
    entry: Entry
    short_name: str

    @property
    def ranks(self) -> str:
        """``1-4``, or the single number where both ranks agree."""
        return str(self.best_rank) if self.best_rank == self.worst_rank else f"{self.best_rank}-{self.worst_rank}"


@dataclass(frozen=True)
class Group:
    """Entries that may be compared, the best value first; ``dataset_name`` is what the dataset's folder was called."""

    key: GroupKey
    dataset_name: str
    rows: tuple[Ranked, ...]


def assumption(result: Result) -> str:
    """In a few words; empty where a method assumes nothing of the scene, or is not of this package."""
    return _of(result)[0]


def assumption_sentences(result: Result) -> str:
    """For the row's own page: what the method assumes, and what it was told of the samples that it is scored on."""
    told = TOLD[result.track]
    return " ".join(sentence for sentence in (_of(result)[1], f"Told {told}." if told else "") if sentence)


def _of(result: Result) -> tuple[str, str]:
    submission = result.submission
    return _ASSUMED.get(submission.method, ("", "")) if submission.settings.get("shading") is True else ("", "")
