"""Groups of the leaderboard: what results must share to be ranked together, what its methods assumed or were told, and
how a group, its data and its rows are called. Rows of this package's methods get a short name from their settings;
every other submission keeps its own name, cut at a word.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import index

from fpp_ml_bench.constants import CONFIGS
from fpp_ml_bench.evaluation.result import Result
from fpp_ml_bench.evaluation.submission import Submission
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.rows import Entry
from fpp_ml_bench.loaders.storage import EARLIER, benchmark_of

LEGACY_FINGERPRINTS = (
    "5b87ff86edee389e45c5a2110ac34ab4fa3310c096a0860780a20dd69fdcac06",
    "c5f61ca76258e24bc197e1d8a3dce100ecddabb90eef57b1ae0c43334648f4de",
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
ASSUMED = "one albedo, a lit background"
_ASSUMES = (
    "Assumes one albedo for all surfaces and a lit background, which shows how strong the lamp is: the brightness of "
    "the fringe image decides the fringe order."
)
"""What the phase route and the learned one assume, in a few words and as a sentence, unless ``shading`` is off."""
LONGEST_NAME = 36
"""Characters of a short name."""

_DIRECTIONS = ("horizontal", "vertical", "both")
_NETWORKS = {"unet": "UNet", "resunet": "ResUNet", "transunet": "TransUNet", "pix2pix": "pix2pixHD"}
_LOSSES = {"rmse": "RMSE", "l1": "L1", "gan": "GAN"}
_RANGES = {"oracle": "", "mean": "mean range", "predicted": "pred. range", None: ""}
"""By the setting ``depth_range``. That the range was told is the group's track."""


@dataclass(frozen=True, order=True)
class GroupKey:
    """What two results must share to be compared. ``fingerprint`` identifies the dataset, not its folder's name."""

    track: str
    mode: str
    split: str
    target: str
    fingerprint: str
    size: tuple[int, int]
    edge_band_px: int
    protocol_version: str

    @classmethod
    def of(cls, result: Result) -> "GroupKey":
        data, protocol = result.dataset, (result.edge_band_px, result.protocol_version)
        size = data.size[0], data.size[1]
        return cls(result.track, result.mode, data.split, result.target, data.fingerprint, size, *protocol)

    @property
    def is_legacy(self) -> bool:
        benchmark = benchmark_of(self.fingerprint)
        return benchmark in EARLIER if benchmark is not None else self.fingerprint in LEGACY_FINGERPRINTS

    @property
    def order(self) -> tuple[object, ...]:
        """Sort key of the groups: named benchmarks, other data, legacy data; the larger images first."""
        data = 2 if self.is_legacy else 0 if benchmark_of(self.fingerprint) is not None else 1
        return (data, -self.size[0] * self.size[1], self.fingerprint, self)

    @property
    def data_title(self) -> str:
        """``fpp-bench-full version 0, 960 x 960 px``; other data by size and the fingerprint's first 8 digits."""
        benchmark, pixels = benchmark_of(self.fingerprint), f"{self.size[1]} x {self.size[0]} px"
        if benchmark is not None:
            return f"{benchmark.title}, {pixels}" + (", legacy" if self.is_legacy else "")
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
    method, shading = result.submission.method, result.submission.settings.get("shading")
    return ASSUMED if method in ("phase", "phase-net") and shading is True else ""


def assumption_sentences(result: Result) -> str:
    """For the row's own page: what the method assumes, and what it was told of the samples that it is scored on."""
    told = TOLD[result.track]
    return " ".join([*([_ASSUMES] if assumption(result) else []), *([f"Told {told}."] if told else [])])


def short_names(submissions: Sequence[Submission]) -> list[str]:
    """A short name for each of the ``submissions`` of a group, whose own names differ. The order changes no name. Where
    two would get the same, the later by its own name has a number behind it."""
    derived = {submission.name: _from_settings(submission) for submission in submissions}
    chosen: dict[str, str] = {}
    taken: set[str] = set()
    for name in sorted(derived, key=lambda name: (derived[name] is None, name)):
        short, number = derived[name] or cut_at_word(printable(name)), 1
        candidate = short
        while candidate in taken:
            number += 1
            suffix = f" ({number})"
            candidate = cut_at_word(short, LONGEST_NAME - len(suffix)) + suffix
        taken.add(candidate)
        chosen[name] = candidate
    return [chosen[submission.name] for submission in submissions]


def cut_at_word(text: str, longest: int = LONGEST_NAME) -> str:
    """``text``, or as many of its words as fit into ``longest`` characters with an ellipsis behind them."""
    if len(text) <= longest:
        return text
    words = text[:longest].rpartition(" ")[0].rstrip(" ,;:-+(")
    return (words or text[: longest - 1]) + "…"


def _from_settings(submission: Submission) -> str | None:
    """A name made of the method's settings; None for a submission that is not one of this package's methods."""
    try:
        title, make = _METHODS.get(submission.method, ("", _network))
        name = (make if submission.name.startswith(title) else _network)(submission)
    except (KeyError, TypeError, ValueError):  # settings that the package's methods do not write
        return None
    return name if len(name) <= LONGEST_NAME else None


def _direction(submission: Submission) -> str:
    return _DIRECTIONS[_DIRECTIONS.index(submission.settings["direction"])]  # type: ignore[arg-type]


def _classical(submission: Submission) -> str:
    steps, direction = index(submission.settings["steps"]), _direction(submission)  # type: ignore[arg-type]
    if not submission.settings.get("fewest"):
        return f"Classical {steps}+Gray, {direction}"
    gray = len(submission.frames_used) - steps * (2 if direction == "both" else 1)
    return f"Classical {steps}, {direction}, {f'{gray} Gray' if gray else 'no Gray'}"


def _phase(submission: Submission) -> str:
    settings, direction = submission.settings, _direction(submission)
    if "error_mm" in settings:
        name = f"Phase, fewest {direction}, {float(settings['error_mm'] or 0):g} mm"
    else:
        name = f"Phase, {index(settings['frames'])} {direction}"  # type: ignore[arg-type]
    standoff = settings.get("prior") == "standoff"
    if not settings["shading"]:
        return f"{name}, standoff alone" if standoff else f"{name}, no shading"
    return f"{name}, standoff" if standoff else name


def _phase_net(submission: Submission) -> str:
    shading = "" if submission.settings["shading"] else ", no shading"
    return f"{printable(submission.settings['weights'])}, 1 {_direction(submission)}{shading}"


def _network(submission: Submission) -> str:
    settings = submission.settings
    network = _NETWORKS[str(settings["network"])]
    if not submission.name.startswith(f"{network}, "):
        raise ValueError("a name of its own")
    normalisation = {"individual": "", "raw": " raw", "global": " global"}[str(settings["normalisation"])]
    trained_frames = str(settings["trained_frames"])
    if trained_frames not in CONFIGS:
        raise ValueError("unknown frames")
    frames = {"single_shot": "", "all": " all frames"}.get(trained_frames, f" {trained_frames}")
    parts = [f"{network}{normalisation} {_loss(str(settings['loss']))}{frames}"]
    parts += ["no background" if settings["background_removed"] else "", _RANGES[settings.get("depth_range")]]  # type: ignore[index]
    return ", ".join(filter(None, parts))


def _loss(label: str) -> str:
    """``hybrid_l1_0.7`` as ``hybrid L1 0.7``; the weight is checked to be a number."""
    kind, _, rest = label.partition("_")
    if kind == "hybrid":
        loss, _, weight = rest.partition("_")
        return f"hybrid {_LOSSES[loss]} {float(weight):g}"
    return f"masked {_LOSSES[rest]}" if kind == "masked" else _LOSSES[label]


_METHODS = {
    "classical": ("Classical ", _classical),
    "phase": ("Phase route, ", _phase),
    "phase-net": ("Phase route, ", _phase_net),
}
"""How the names of each method's submissions begin, and what makes the short name."""
