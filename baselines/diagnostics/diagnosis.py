"""Runs the probes on a subject, stores each finding, and writes the report: a page that loads nothing, and JSON."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any

from fpp_ml_bench import __version__
from fpp_ml_bench.baselines.diagnostics.probe import (
    PROBES,
    Cell,
    Figure,
    Finding,
    Probe,
    ProbeSettings,
    Progress,
    Table,
    make_probe,
    with_interval,
)
from fpp_ml_bench.baselines.diagnostics.subjects import Subject
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.evaluation.result.file import write_json
from fpp_ml_bench.files import LOCK_FILE, exclusive, printable, read_json, write_atomically
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.machine import describe_hardware
from fpp_ml_bench.options import did_you_mean
from fpp_ml_bench.style import data_uri, page

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
    """Run the probes ``probe_names`` (all if empty) and write ``out/index.html`` and ``out/diagnose.json``; all results
    in the report's order. A finding in ``out`` is reused if subject, dataset, settings and the probe's version are the
    same; those of other probes join the report. ``progress`` is called with a probe before it runs. The report quotes
    ``command``. Raises `DiagnosisError` if ``out`` holds other files or another process is at it, and errors of probes;
    earlier findings stay."""
    _prepare(out)
    with exclusive(out / LOCK_FILE, out, "writing a report there", DiagnosisError):
        selected = checked_names(probe_names)
        results, nothing = [], cache(lambda: subject.predicts_nothing(dataset))
        for name in PROBES:
            if name not in selected and not (out / f"{name}.json").is_file():
                continue
            probe = make_probe(name)
            key = finding_key(probe, subject, dataset, settings)
            stored = load_finding(out, name, key)
            if stored is not None:
                results.append(ProbeResult(probe, *stored, reused=True))
            elif name in selected:
                started = perf_counter()
                if reason := probe.applies_to(subject) or (nothing() if probe.asks_subject else None):
                    finding = probe.skip(reason)
                else:
                    finding = probe.run(subject, dataset, settings, progress(probe))
                seconds = round(perf_counter() - started, 2)
                save_finding(out, key, finding, seconds)
                results.append(ProbeResult(probe, finding, seconds, reused=False))
        context = _context(subject, dataset, settings, command)
        findings = {
            one.probe.name: {"seconds": one.seconds}
            | {key: getattr(one.finding, key) for key in ("title", "summary", "skipped", "values")}
            for one in results
        }
        content = {"format": "fpp-ml-bench diagnosis", "version": FORMAT_VERSION, **context, "findings": findings}
        write_json(content, out / JSON_FILE)
        html = report_page(context, [(one.probe.question, one.finding) for one in results])
        write_atomically(out / REPORT_FILE, html)
        return results


def checked_names(names: Sequence[str]) -> tuple[str, ...]:
    """``names``, each once, in the report's order; all probes if empty. Raises `DiagnosisError` for an unknown name."""
    for name in names:
        if name not in PROBES:
            raise DiagnosisError(f"unknown probe {name!r}; {did_you_mean(name, PROBES)}")
    return tuple(name for name in PROBES if not names or name in names)


def finding_key(probe: Probe, subject: Subject, dataset: DatasetFolder, settings: ProbeSettings) -> str:
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


def save_finding(folder: Path, key: str, finding: Finding, seconds: float) -> None:
    """Write ``PROBE.json`` and its picture ``PROBE.png`` into ``folder``. Raises ``ValueError`` for NaN, infinity."""
    content = asdict(finding)
    if content["figure"] is not None:
        write_atomically(folder / f"{finding.probe}.png", content["figure"].pop("png"))
    write_json({"key": key, "seconds": seconds, "finding": content}, folder / f"{finding.probe}.json")


def load_finding(folder: Path, name: str, key: str) -> tuple[Finding, float] | None:
    """The stored finding of probe ``name`` and its seconds, if it is complete and was made with the same ``key``."""
    try:
        content = read_json(folder / f"{name}.json", DiagnosisError)
        if content["key"] != key:
            return None
        fields = content["finding"]
        if fields["figure"] is not None:
            fields["table"] = Table(**fields["table"])
            fields["figure"] = Figure(**fields["figure"], png=(folder / f"{name}.png").read_bytes())
        return Finding(**fields), float(content["seconds"])
    except (OSError, ValueError, TypeError, KeyError):
        return None  # absent, half written, or of another version: it is made again


def _prepare(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        names = sorted(path.name for path in out.iterdir())
    except OSError as error:
        raise DiagnosisError(f"{out}: can't be made a folder ({error.strerror}); give another --out") from None
    ours = {JSON_FILE, REPORT_FILE, LOCK_FILE, *(f"{name}.json" for name in PROBES)}
    foreign = [name for name in names if name not in ours and not name.endswith((".png", ".tmp"))]
    if foreign:
        raise DiagnosisError(f"{out}: holds {foreign[0]}, which is no part of a report; give a new or empty folder")


def _context(subject: Subject, dataset: DatasetFolder, settings: ProbeSettings, command: str) -> dict[str, Any]:
    subject_keys = ("name", "title", "sha256", "units", "normalisation", "frames_used", "direction")
    return {
        "subject": {**{key: getattr(subject, key) for key in subject_keys}, "layers": subject.layer_names},
        "dataset": {
            "name": dataset.path.resolve().name,
            "fingerprint": dataset.fingerprint,
            "size": list(dataset.size),
            "samples": {split: len(names) for split, names in dataset.splits.items()},
        },
        "settings": asdict(settings),
        "command": command,
        "software": {"fpp_ml_bench": __version__, **{name: version(name) for name in _PACKAGES}},
        "hardware": describe_hardware().to_dict(),
    }


def report_page(context: Mapping[str, Any], findings: Sequence[tuple[str, Finding]]) -> bytes:
    """The report: a section for each finding with its question; ``context`` is what ``diagnose.json`` says about
    subject, dataset, settings and machine."""
    name = context["subject"]["name"]
    return page(
        "fpp_ml_bench.baselines.diagnostics",
        "diagnosis.html",
        f"{name}: diagnosis",
        _STYLE,
        description=f"What {name} read",
        sections=findings,
        data_uri=data_uri,
        cells=lambda table: [[cell_text(cell) for cell in row] for row in table.rows],
        **context,
    )


def cell_text(cell: Cell) -> str:
    """A cell as text: floats with four significant digits, a dash for None."""
    if cell is None:
        return "-"
    if isinstance(cell, Mapping):
        return with_interval(cell["r"], cell["interval"])
    if isinstance(cell, (list, tuple)):
        low, high = map(cell_text, cell)
        return low if low == high else f"{low} to {high}"
    return f"{cell:.4g}" if isinstance(cell, float) else printable(cell, 500)
