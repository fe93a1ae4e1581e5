"""What all probes share: their base class, settings and results, how these are stored, drawn and
reported.

A `Subject` is the model that is diagnosed, a `Probe` is one test of it, and a `Finding` is the
probe's result; `diagnose` puts them on one page, which loads nothing, and into a JSON file. A probe
gives rows for tables, and lines or pictures for figures; `style.panels` and `style.gallery` draw
them in one style.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from hashlib import sha256
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from fpp_ml_bench import __version__
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.evaluation.result.file import write_json
from fpp_ml_bench.files import LOCK_FILE, exclusive, printable, read_json, write_atomically
from fpp_ml_bench.machine import describe_hardware
from fpp_ml_bench.style import data_uri, page
from fpp_ml_bench.tables import Table

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.diagnostics.subjects import Subject
    from fpp_ml_bench.loaders.storage.store import DatasetFolder

JSON_FILE, REPORT_FILE = "diagnose.json", "index.html"
FORMAT_VERSION = 2
_PACKAGES = ("numpy", "torch", "captum")
_STYLE = """
.drawn img { display: block; width: 100%; min-width: 34rem; background: #fff; border-radius: 6px; }
.question { font-style: italic; color: var(--soft); }
figure + .scroll, .scroll + .scroll { margin-top: 1.25rem; }
.dense td:first-child { text-align: left; white-space: normal; min-width: 6.5rem; }
.dense th:first-child { text-align: left; }
ul.short { padding-left: 1.1rem; max-width: 46rem; }
ul.short li { margin: .5rem 0; }
"""
Progress = Callable[[int, int, str], None]
"""Called by a running probe with the steps done, their total, and the activity."""


def silent(*progress: object) -> None:
    """A `Progress` that shows nothing."""


@dataclass(frozen=True)
class ProbeSettings:
    """How much a probe measures; None means the probe's default. ``samples``: most samples of each
    split, taken evenly over it (`spread`). ``seeds``: repeats of what depends on random numbers.
    ``quick``: a short run for a first look."""

    samples: int | None = None
    seeds: int | None = None
    quick: bool = False

    def choose(
        self, names: Sequence[str], usual: int | None = None, quick: int | None = None
    ) -> list[str]:
        """At most ``samples`` of ``names``, by default ``usual``, or ``quick`` of them in a quick
        run."""
        return spread(names, self.samples or (quick if self.quick else usual))


def spread(names: Sequence[str], limit: int | None) -> list[str]:
    """At most ``limit`` of ``names``, taken evenly, in their order."""
    if limit is None or limit >= len(names):
        return list(names)
    return [names[(2 * place + 1) * len(names) // (2 * limit)] for place in range(limit)]


def with_interval(value: float | None, interval: Sequence[float] | None = None) -> str:
    """A mean with its interval as a table's cell; a dash for None."""
    span = "" if interval is None else f" ({interval[0]:.3f} to {interval[1]:.3f})"
    return "-" if value is None else f"{value:.3f}{span}"


def table_of(
    title: str, first: str, rows: Mapping[str, Mapping[str, Any]], columns: Mapping[str, str]
) -> Table:
    """The named ``rows``; ``columns``: titles by the keys of what a row shows. Floats have four
    significant digits; a mapping is a value ``r`` with its ``interval``; a dash stands for None,
    and where a row lacks a key."""

    def text(value: Any) -> str:
        if isinstance(value, Mapping):
            return with_interval(value["r"], value["interval"])
        return "-" if value is None else f"{value:.4g}"

    cells = [
        {first: printable(name, 500), **{columns[key]: text(row.get(key)) for key in columns}}
        for name, row in rows.items()
    ]
    return Table.of(title, cells)


@dataclass(frozen=True)
class Figure:
    """A picture with its title and a description ``alt``."""

    title: str
    alt: str
    png: bytes = field(repr=False)


@dataclass(frozen=True)
class Finding:
    """The result of a probe: ``summary`` in one or two sentences, ``values`` for JSON, with None
    instead of NaN. ``skipped``: why the probe does not apply to this subject; then the other fields
    are empty."""

    summary: str = ""
    values: Mapping[str, Any] = field(default_factory=dict)
    table: Table | None = None
    figure: Figure | None = None
    skipped: str | None = None


class Probe(ABC):
    """A test of a model. ``version`` goes up when its result for the same model changes.
    ``without_network``: what a method without a network lacks for this probe, or None."""

    name: str
    title: str
    question: str
    version = 1
    without_network: str | None = None

    def applies_to(self, subject: Subject) -> str | None:
        """None where the probe can run, else the reason why it can't, for the report."""
        if self.without_network is None or subject.network is not None:
            return None
        return f"{subject.name} is a method without a network: {self.without_network}."

    @abstractmethod
    def run(
        self, subject: Subject, dataset: DatasetFolder, settings: ProbeSettings, progress: Progress
    ) -> Finding:
        """Measure ``subject``."""


PROBES = {
    "linear": "LinearProbing",
    "grad-cam": "GradCam",
    "flat-plane": "FlatPlane",
    "counterfactual": "Counterfactual",
    "identifiability": "Identifiability",
}
"""The probes in the order of the report, and their classes; each is in the module of its name,
which is imported when it runs."""


def make_probe(name: str) -> Probe:
    """The probe ``name`` of `PROBES`."""
    module = import_module(f"{__package__}.{name.replace('-', '_')}")
    probe: Probe = getattr(module, PROBES[name])()
    return probe


@dataclass(frozen=True)
class ProbeResult:
    """A finding, its seconds, and whether it was ``reused`` from an earlier run."""

    probe: Probe
    finding: Finding
    seconds: float
    reused: bool


def diagnose(
    subject: Subject,
    dataset: DatasetFolder,
    probe_names: Sequence[str],
    settings: ProbeSettings,
    out: Path,
    progress: Callable[[Probe], Progress],
    command: str = "",
) -> list[ProbeResult]:
    """Run the probes ``probe_names`` and write ``out/index.html`` and ``out/diagnose.json``; all
    results in the report's order. A finding in ``out`` is reused if subject, dataset, settings and
    the probe's version are the same; those of other probes join the report. ``progress`` is called
    with a probe before it runs. The report quotes ``command``. Raises `DiagnosisError` if ``out``
    holds other files or another process is at it, and errors of probes; earlier findings stay."""
    _prepare(out)
    with exclusive(out / LOCK_FILE, out, "writing a report there", DiagnosisError):
        results, nothing = [], cache(lambda: subject.predicts_nothing(dataset))
        shown = [name for name in PROBES if name in probe_names or (out / f"{name}.json").is_file()]
        for name, probe in zip(
            shown, [*map(make_probe, shown)], strict=True
        ):  # what is not installed shows now
            key = finding_key(probe, subject, dataset, settings)
            if stored := load_finding(out, name, key):
                results.append(ProbeResult(probe, *stored, reused=True))
            elif name in probe_names:
                started = perf_counter()
                if reason := probe.applies_to(subject) or nothing():
                    finding = Finding(skipped=reason)
                else:
                    finding = probe.run(subject, dataset, settings, progress(probe))
                seconds = round(perf_counter() - started, 2)
                save_finding(out, name, key, finding, seconds)
                results.append(ProbeResult(probe, finding, seconds, reused=False))
        context = _context(subject, dataset, settings, command)
        findings = {
            result.probe.name: {"seconds": result.seconds, "title": result.probe.title}
            | {key: getattr(result.finding, key) for key in ("summary", "skipped", "values")}
            for result in results
        }
        content = {
            "format": "fpp-ml-bench diagnosis",
            "version": FORMAT_VERSION,
            **context,
            "findings": findings,
        }
        write_json(content, out / JSON_FILE)
        write_atomically(out / REPORT_FILE, report_page(context, results))
        return results


def finding_key(
    probe: Probe, subject: Subject, dataset: DatasetFolder, settings: ProbeSettings
) -> str:
    """Hash (64 hex digits) of everything that a finding depends on."""
    content = {
        "probe": probe.name,
        "version": probe.version,
        "subject": subject.sha256,
        "layers": list(subject.layer_names),
        "dataset": dataset.fingerprint,
        "settings": asdict(settings),
    }
    return sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def save_finding(folder: Path, name: str, key: str, finding: Finding, seconds: float) -> None:
    """Write ``NAME.json`` and its picture ``NAME.png`` into ``folder``. Raises ``ValueError`` for
    NaN, infinity."""
    content, table = asdict(replace(finding, table=None)), finding.table
    if table is not None:
        content["table"] = {"title": str(table.title), "columns": table.titles, "rows": table.texts}
    if content["figure"] is not None:
        write_atomically(folder / f"{name}.png", content["figure"].pop("png"))
    write_json({"key": key, "seconds": seconds, "finding": content}, folder / f"{name}.json")


def load_finding(folder: Path, name: str, key: str) -> tuple[Finding, float] | None:
    """The stored finding of probe ``name`` and its seconds, if it is complete and was made with the
    same ``key``."""
    try:
        content = read_json(folder / f"{name}.json", DiagnosisError)
        if content["key"] != key:
            return None
        fields = content["finding"]
        if fields["figure"] is not None:
            table = fields["table"]
            fields["table"] = Table.of(
                table["title"],
                [dict(zip(table["columns"], row, strict=True)) for row in table["rows"]],
            )
            fields["figure"] = Figure(**fields["figure"], png=(folder / f"{name}.png").read_bytes())
        return Finding(**fields), float(content["seconds"])
    except (OSError, ValueError, TypeError, KeyError):
        return None  # absent, half written, or of another version: it is made again


def _prepare(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        names = sorted(path.name for path in out.iterdir())
    except OSError as error:
        raise DiagnosisError(
            f"{out}: can't be made a folder ({error.strerror}); give another --out"
        ) from None
    ours = {JSON_FILE, REPORT_FILE, LOCK_FILE, *(f"{name}.json" for name in PROBES)}
    foreign = [name for name in names if name not in ours and not name.endswith((".png", ".tmp"))]
    if foreign:
        raise DiagnosisError(
            f"{out}: holds {foreign[0]}, which is no part of a report; give a new or empty folder"
        )


def _context(
    subject: Subject, dataset: DatasetFolder, settings: ProbeSettings, command: str
) -> dict[str, Any]:
    subject_keys = ("name", "title", "sha256", "units", "normalisation", "frames_used", "direction")
    return {
        "subject": {
            **{key: getattr(subject, key) for key in subject_keys},
            "layers": subject.layer_names,
        },
        "dataset": {
            "name": dataset.path.resolve().name,
            "fingerprint": dataset.fingerprint,
            "size": list(dataset.size),
            "samples": {split: len(names) for split, names in dataset.splits.items()},
        },
        "settings": asdict(settings),
        "command": command,
        "software": {
            "fpp_ml_bench": __version__,
            **{name: version(name) for name in _PACKAGES if find_spec(name)},
        },
        "hardware": describe_hardware().to_dict(),
    }


def report_page(context: Mapping[str, Any], results: Sequence[ProbeResult]) -> bytes:
    """The report: a section for each probe; ``context`` is what ``diagnose.json`` says about
    subject, dataset, settings and machine."""
    name = context["subject"]["name"]
    return page(
        "fpp_ml_bench.baselines.diagnostics",
        "diagnosis.html",
        f"{name}: diagnosis",
        _STYLE,
        description=f"What {name} read",
        results=results,
        data_uri=data_uri,
        **context,
    )
