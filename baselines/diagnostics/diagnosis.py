"""Runs the probes on a subject, stores each finding, and writes the report."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from fpp_ml_bench import __version__
from fpp_ml_bench.baselines.diagnostics.page import REPORT_FILE, report_page
from fpp_ml_bench.baselines.diagnostics.probe import (
    Finding,
    Probe,
    ProbeSettings,
    Progress,
    finding_key,
    load_finding,
    save_finding,
)
from fpp_ml_bench.baselines.diagnostics.registry import PROBES, checked_names, probe
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.machine import describe_hardware

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.diagnostics.subjects import Subject
    from fpp_ml_bench.loaders.storage import DatasetFolder

JSON_FILE = "diagnose.json"
FORMAT_VERSION = 1
_PACKAGES = ("numpy", "torch", "captum")


@dataclass(frozen=True)
class ProbeResult:
    """A finding, its seconds, and whether it was ``reused`` from an earlier run."""

    probe: Probe
    finding: Finding
    seconds: float
    reused: bool


@dataclass(frozen=True)
class Diagnosis:
    """All findings about a subject in the report's order, and the files ``report`` and ``values``."""

    results: tuple[ProbeResult, ...]
    report: Path
    values: Path


def diagnose(
    subject: "Subject", dataset: "DatasetFolder", probe_names: Sequence[str], settings: ProbeSettings, out: Path,
    progress: Callable[[Probe], Progress], command: str = "",
) -> Diagnosis:  # fmt: skip
    """Run the probes ``probe_names`` (all if empty) and write ``out/index.html`` and ``out/diagnose.json``.

    A finding in ``out`` is reused if subject, dataset, settings and the probe's version are the same. Findings of other
    probes in ``out`` join the report. ``progress`` is called with a probe before it runs. ``command`` is quoted in the
    report as the way to make it again.

    Raises `DiagnosisError` for an ``out`` that holds other files, and the errors of the probes; findings made before an
    error stay in ``out``.
    """
    _prepare(out)
    selected = checked_names(probe_names)
    results = []
    for name in PROBES:
        if name not in selected and not (out / f"{name}.json").is_file():
            continue
        current_probe = probe(name)
        key = finding_key(current_probe, subject, dataset, settings)
        stored = load_finding(out, name, key)
        if stored is not None:
            finding, seconds = stored
            results.append(ProbeResult(current_probe, finding, seconds, reused=True))
        elif name in selected:
            results.append(_run_probe(current_probe, subject, dataset, settings, out, key, progress))
    context = _context(subject, dataset, settings, command)
    content = {
        "format": "fpp-ml-bench diagnosis", "version": FORMAT_VERSION, **context,
        "findings": {
            result.finding.probe: {
                "title": result.finding.title, "summary": result.finding.summary, "skipped": result.finding.skipped,
                "seconds": result.seconds, "values": result.finding.values,
            }
            for result in results
        },
    }  # fmt: skip
    values, report = out / JSON_FILE, out / REPORT_FILE
    text = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)
    write_atomically(values, (text + "\n").encode("utf-8"))
    page = report_page(context, [(result.probe.question, result.finding) for result in results], out)
    write_atomically(report, page.encode("utf-8"))
    return Diagnosis(tuple(results), report, values)


def _run_probe(
    current_probe: Probe, subject: "Subject", dataset: "DatasetFolder", settings: ProbeSettings, out: Path, key: str,
    progress: Callable[[Probe], Progress],
) -> ProbeResult:  # fmt: skip
    reason = current_probe.applies_to(subject)
    started = perf_counter()
    if reason is None:
        finding = current_probe.run(subject, dataset, settings, out, progress(current_probe))
    else:
        finding = Finding(current_probe.name, current_probe.title, "", skipped=reason)
    seconds = round(perf_counter() - started, 2)
    save_finding(out, key, finding, seconds)
    return ProbeResult(current_probe, finding, seconds, reused=False)


def _prepare(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        names = sorted(path.name for path in out.iterdir())
    except OSError as error:
        raise DiagnosisError(f"{out}: can't be made a folder ({error.strerror}); give another --out") from None
    ours = {JSON_FILE, REPORT_FILE, *(f"{name}.json" for name in PROBES)}
    foreign = [name for name in names if name not in ours and not name.endswith((".png", ".tmp"))]
    if foreign:
        raise DiagnosisError(f"{out}: holds {foreign[0]}, which is no part of a report; give a new or empty folder")


def _context(subject: "Subject", dataset: "DatasetFolder", settings: ProbeSettings, command: str) -> dict[str, Any]:
    height, width = dataset.size
    return {
        "subject": {
            "name": subject.name, "title": subject.title, "sha256": subject.sha256, "units": subject.units,
            "normalisation": subject.normalisation, "frames_used": list(subject.frames_used),
            "direction": subject.direction, "layers": list(subject.layer_names),
        },
        "dataset": {
            "name": dataset.path.resolve().name, "fingerprint": dataset.fingerprint, "size": [height, width],
            "samples": {split: len(names) for split, names in dataset.splits.items()},
        },
        "settings": asdict(settings),
        "command": command,
        "software": {"fpp_ml_bench": __version__, **{name: version(name) for name in _PACKAGES}},
        "hardware": describe_hardware().to_dict(),
    }  # fmt: skip
