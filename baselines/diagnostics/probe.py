"""Settings and results of probes; a finding is stored on disk, so that no probe runs twice."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from fpp_ml_bench.errors import DiagnosisError

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.diagnostics.subjects import Subject
    from fpp_ml_bench.loaders.storage import DatasetFolder

Cell = str | int | float | None


@dataclass(frozen=True)
class ProbeSettings:
    """How much a probe measures; None means the probe's default.

    ``samples``: most samples of each split, taken evenly over it (`spread`). ``seeds``: repeats of what depends on
    random numbers, 1 or more. ``quick``: a short run for a first look.

    Raises `DiagnosisError` for a number below 1.
    """

    samples: int | None = None
    seeds: int | None = None
    quick: bool = False

    def __post_init__(self) -> None:
        for name in ("samples", "seeds"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise DiagnosisError(f"{name}: expected 1 or more, got {value}")


@dataclass(frozen=True)
class Table:
    """Rows under a header. The first cell of a row names it; floats are shown with four significant digits."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]

    def __post_init__(self) -> None:
        uneven = next((row for row in self.rows if len(row) != len(self.header)), None)
        if uneven is not None:
            raise ValueError(f"table {self.title!r}: a row has {len(uneven)} cells, its header has {len(self.header)}")


@dataclass(frozen=True)
class Figure:
    """A picture ``file`` (PNG, in the probe's folder), with its title and a description ``alt``."""

    title: str
    file: str
    alt: str


@dataclass(frozen=True)
class Finding:
    """The result of a probe.

    ``summary``: the result in one or two sentences. ``values``: JSON for ``diagnose.json``, with None instead of NaN.
    ``skipped``: why the probe does not apply to this subject; then the other fields are empty.
    """

    probe: str
    title: str
    summary: str
    values: Mapping[str, Any] = field(default_factory=dict)
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()
    skipped: str | None = None


class Progress(Protocol):
    """Called by a running probe with its progress."""

    def __call__(self, done: int, total: int, activity: str = "") -> None: ...


def silent(done: int, total: int, activity: str = "") -> None:
    """A `Progress` that shows nothing."""


class Probe(Protocol):
    """A test of a model. ``version`` goes up when its result for the same model changes."""

    name: str
    title: str
    question: str
    version: int

    def applies_to(self, subject: "Subject") -> str | None:
        """None where the probe can run, else the reason why it can't, for the report."""

    def run(
        self, subject: "Subject", dataset: "DatasetFolder", settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        """Measure ``subject``; pictures are written into ``folder``, which exists."""


def spread(names: Sequence[str], limit: int | None) -> list[str]:
    """At most ``limit`` of ``names``, taken evenly, in their order."""
    if limit is None or limit >= len(names):
        return list(names)
    return [names[(2 * place + 1) * len(names) // (2 * limit)] for place in range(limit)]


def finding_key(probe: Probe, subject: "Subject", dataset: "DatasetFolder", settings: ProbeSettings) -> str:
    """Hash (64 hex digits) of everything that a finding depends on."""
    content = {
        "probe": probe.name, "version": probe.version, "subject": subject.sha256, "layers": list(subject.layer_names),
        "dataset": dataset.fingerprint, "settings": asdict(settings),
    }  # fmt: skip
    return sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def save_finding(folder: Path, key: str, finding: Finding, seconds: float) -> None:
    """Write ``PROBE.json`` into ``folder`` atomically; its pictures must be there already.

    Raises ``ValueError`` for a value that JSON can't hold, NaN and infinity included.
    """
    from fpp_ml_bench.files import write_atomically

    content = {"key": key, "seconds": round(seconds, 2), "finding": asdict(finding)}
    text = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)
    write_atomically(folder / f"{finding.probe}.json", (text + "\n").encode("utf-8"))


def load_finding(folder: Path, name: str, key: str) -> tuple[Finding, float] | None:
    """The stored finding of probe ``name`` and its seconds, if it is complete and was made with the same ``key``."""
    try:
        content = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
        if content["key"] != key:
            return None
        fields = dict(content["finding"])
        fields["tables"] = tuple(Table(**table) for table in fields["tables"])
        fields["figures"] = tuple(Figure(**figure) for figure in fields["figures"])
        finding = Finding(**fields)
        seconds = float(content["seconds"])
    except (OSError, ValueError, TypeError, KeyError):
        return None  # absent, half written, or of another version: it is made again
    return (finding, seconds) if all((folder / figure.file).is_file() for figure in finding.figures) else None
