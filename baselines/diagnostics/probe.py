"""What a probe is asked with and what it answers; a finding is kept on disk, so that no probe runs twice."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from fpp_ml_bench.errors import DiagnosisError

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.diagnostics.subject import Subject
    from fpp_ml_bench.loaders.store import DatasetFolder

Cell = str | int | float | None


@dataclass(frozen=True)
class ProbeSettings:
    """How much is asked. None leaves it to the probe.

    ``samples``: of each split that a probe reads, at most; they are taken evenly over the split (`spread`). ``seeds``:
    how often what depends on chance is repeated, 1 or more. ``quick``: a look rather than a measurement.

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
        odd = next((row for row in self.rows if len(row) != len(self.header)), None)
        if odd is not None:
            raise ValueError(f"table {self.title!r}: a row has {len(odd)} cells, its header has {len(self.header)}")


@dataclass(frozen=True)
class Figure:
    """A picture ``file`` (PNG, in the probe's folder), with what it is called and what it shows in words."""

    title: str
    file: str
    alt: str


@dataclass(frozen=True)
class Finding:
    """The answer of one probe.

    ``summary``: one or two plain sentences, honest about what they rest on. ``values``: JSON (no NaN: None instead),
    which goes to ``diagnose.json``. ``skipped``: why the probe does not apply to this subject; then all else is empty.
    """

    probe: str
    title: str
    summary: str
    values: Mapping[str, Any] = field(default_factory=dict)
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()
    skipped: str | None = None


class Progress(Protocol):
    """Told from time to time how far a probe is."""

    def __call__(self, done: int, total: int, doing: str = "") -> None: ...


def silent(done: int, total: int, doing: str = "") -> None:
    """A `Progress` that shows nothing."""


class Probe(Protocol):
    """One question. ``version`` goes up when the answer to the same question changes."""

    name: str
    title: str
    question: str
    version: int

    def applies_to(self, subject: "Subject") -> str | None:
        """None where the probe can run, else why not, for the report."""

    def run(
        self, subject: "Subject", dataset: "DatasetFolder", settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        """The finding; its pictures are in ``folder``, which exists."""


def spread(names: Sequence[str], limit: int | None) -> list[str]:
    """At most ``limit`` of ``names``, evenly over them, in their order."""
    if limit is None or limit >= len(names):
        return list(names)
    return [names[(2 * place + 1) * len(names) // (2 * limit)] for place in range(limit)]


def finding_key(probe: Probe, subject: "Subject", dataset: "DatasetFolder", settings: ProbeSettings) -> str:
    """What a finding depends on, as 64 hex digits."""
    content = {
        "probe": probe.name, "version": probe.version, "subject": subject.sha256, "layers": list(subject.layer_names),
        "dataset": dataset.fingerprint, "settings": asdict(settings),
    }  # fmt: skip
    return sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def save_finding(folder: Path, key: str, finding: Finding, seconds: float) -> None:
    """``PROBE.json`` in ``folder``, complete or not at all; its pictures must be there already.

    Raises ``ValueError`` for a value that JSON can't hold, NaN and infinity included.
    """
    from fpp_ml_bench.loaders.manifest import write_atomically

    content = {"key": key, "seconds": round(seconds, 2), "finding": asdict(finding)}
    text = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)
    write_atomically(folder / f"{finding.probe}.json", (text + "\n").encode("utf-8"))


def kept_finding(folder: Path, name: str, key: str) -> tuple[Finding, float] | None:
    """The finding of probe ``name`` and the seconds it took, if it was made with the same ``key`` and is whole."""
    try:
        content = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
        if content["key"] != key:
            return None
        found = dict(content["finding"])
        found["tables"] = tuple(Table(**table) for table in found["tables"])
        found["figures"] = tuple(Figure(**figure) for figure in found["figures"])
        finding = Finding(**found)
        seconds = float(content["seconds"])
    except (OSError, ValueError, TypeError, KeyError):
        return None  # absent, half written, or of another version: it is made again
    return (finding, seconds) if all((folder / figure.file).is_file() for figure in finding.figures) else None
