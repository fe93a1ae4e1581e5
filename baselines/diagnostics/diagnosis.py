"""Asking a subject one probe after the other, keeping each answer, and writing the report."""

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
    kept_finding,
    save_finding,
)
from fpp_ml_bench.baselines.diagnostics.registry import PROBES, checked_names, probe
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.hardware import describe_hardware
from fpp_ml_bench.loaders.manifest import write_atomically

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.diagnostics.subject import Subject
    from fpp_ml_bench.loaders.store import DatasetFolder

JSON_FILE = "diagnose.json"
FORMAT_VERSION = 1
_PACKAGES = ("numpy", "torch", "captum")


@dataclass(frozen=True)
class Answer:
    """A finding, how long it took, and whether it was kept from an earlier run."""

    probe: Probe
    finding: Finding
    seconds: float
    kept: bool


@dataclass(frozen=True)
class Diagnosis:
    """All answers about a subject, in the report's order."""

    answers: tuple[Answer, ...]
    report: Path
    values: Path


def diagnose(
    subject: "Subject", dataset: "DatasetFolder", asked: Sequence[str], settings: ProbeSettings, out: Path,
    progress: Callable[[Probe], Progress], command: str = "",
) -> Diagnosis:  # fmt: skip
    """Run the probes ``asked`` by name (none: all) and write ``out/index.html`` and ``out/diagnose.json``.

    A finding that ``out`` holds from the same subject, dataset, settings and version of the probe is kept; those of
    probes that were not asked join the report. ``progress`` is called with a probe before it runs. ``command`` is
    quoted in the report as the way to make it again.

    Raises `DiagnosisError` for an ``out`` that holds something else, and what the probes raise; what was found before
    is kept.
    """
    _prepare(out)
    names = checked_names(asked)
    answers = []
    for name in PROBES:
        if name not in names and not (out / f"{name}.json").is_file():
            continue
        one = probe(name)
        key = finding_key(one, subject, dataset, settings)
        kept = kept_finding(out, name, key)
        if kept is not None:
            answers.append(Answer(one, *kept, kept=True))
        elif name in names:
            answers.append(_asked(one, subject, dataset, settings, out, key, progress))
    about = _about(subject, dataset, settings, command)
    content = {
        "format": "fpp-ml-bench diagnosis", "version": FORMAT_VERSION, **about,
        "findings": {
            one.finding.probe: {
                "title": one.finding.title, "summary": one.finding.summary, "skipped": one.finding.skipped,
                "seconds": one.seconds, "values": one.finding.values,
            }
            for one in answers
        },
    }  # fmt: skip
    values, report = out / JSON_FILE, out / REPORT_FILE
    text = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)
    write_atomically(values, (text + "\n").encode("utf-8"))
    page = report_page(about, [(one.probe.question, one.finding) for one in answers], out)
    write_atomically(report, page.encode("utf-8"))
    return Diagnosis(tuple(answers), report, values)


def _asked(
    one: Probe, subject: "Subject", dataset: "DatasetFolder", settings: ProbeSettings, out: Path, key: str,
    progress: Callable[[Probe], Progress],
) -> Answer:  # fmt: skip
    reason = one.applies_to(subject)
    started = perf_counter()
    if reason is None:
        finding = one.run(subject, dataset, settings, out, progress(one))
    else:
        finding = Finding(one.name, one.title, "", skipped=reason)
    seconds = round(perf_counter() - started, 2)
    save_finding(out, key, finding, seconds)
    return Answer(one, finding, seconds, kept=False)


def _prepare(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        held = sorted(path.name for path in out.iterdir())
    except OSError as error:
        raise DiagnosisError(f"{out}: can't be made a folder ({error.strerror}); give another --out") from None
    ours = {JSON_FILE, REPORT_FILE, *(f"{name}.json" for name in PROBES)}
    foreign = [name for name in held if name not in ours and not name.endswith((".png", ".tmp"))]
    if foreign:
        raise DiagnosisError(f"{out}: holds {foreign[0]}, which is no part of a report; give a new or empty folder")


def _about(subject: "Subject", dataset: "DatasetFolder", settings: ProbeSettings, command: str) -> dict[str, Any]:
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
