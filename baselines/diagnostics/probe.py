"""What all probes share: settings and results, findings stored on disk, the probes by name, and the figures' style.

Importing this module imports neither numpy nor matplotlib, so that the command line can name the probes.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from difflib import get_close_matches
from hashlib import sha256
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing
    from numpy.typing import NDArray

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


def spread(names: Sequence[str], limit: int | None) -> list[str]:
    """At most ``limit`` of ``names``, taken evenly, in their order."""
    if limit is None or limit >= len(names):
        return list(names)
    return [names[(2 * place + 1) * len(names) // (2 * limit)] for place in range(limit)]


class Progress(Protocol):
    """Called by a running probe with its progress."""

    def __call__(self, done: int, total: int, activity: str = "") -> None: ...


def silent(done: int, total: int, activity: str = "") -> None:
    """A `Progress` that shows nothing."""


# ---- findings


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


def save_finding(folder: Path, key: str, finding: Finding, seconds: float) -> None:
    """Write ``PROBE.json`` into ``folder`` atomically; its pictures must be there already.

    Raises ``ValueError`` for a value that JSON can't hold, NaN and infinity included.
    """
    content = {"key": key, "seconds": round(seconds, 2), "finding": asdict(finding)}
    write_json(folder / f"{finding.probe}.json", content)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write ``content`` atomically. Raises ``ValueError`` for NaN and infinity."""
    text = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)
    write_atomically(path, (text + "\n").encode("utf-8"))


def load_finding(folder: Path, name: str, key: str) -> tuple[Finding, float] | None:
    """The stored finding of probe ``name`` and its seconds, if it is complete and was made with the same ``key``."""
    try:
        content = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
        if content["key"] != key:
            return None
        fields = dict(content["finding"])
        fields["tables"] = tuple(Table(**table) for table in fields["tables"])
        fields["figures"] = tuple(Figure(**figure) for figure in fields["figures"])
        finding, seconds = Finding(**fields), float(content["seconds"])
    except (OSError, ValueError, TypeError, KeyError):
        return None  # absent, half written, or of another version: it is made again
    return (finding, seconds) if all((folder / figure.file).is_file() for figure in finding.figures) else None


# ---- probes


class Probe:
    """A test of a model. ``version`` goes up when its result for the same model changes."""

    name: str
    title: str
    question: str
    version = 1

    def applies_to(self, subject: "Subject") -> str | None:
        """None where the probe can run, else the reason why it can't, for the report."""
        return None

    def run(
        self, subject: "Subject", dataset: "DatasetFolder", settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        """Measure ``subject``; pictures are written into ``folder``, which exists."""
        raise NotImplementedError


PROBES = {
    "linear": ("linear", "LinearProbing"),
    "grad-cam": ("grad_cam", "GradCam"),
    "flat-plane": ("flat_plane", "FlatPlane"),
    "counterfactual": ("counterfactual", "Counterfactual"),
    "theory": ("theory", "Theory"),
}
"""The probes by name, in the order of the report: module below this package, which is imported on first use, and class
in it, which is made without arguments."""


def checked_names(names: Sequence[str]) -> tuple[str, ...]:
    """``names`` without repeats, in the order of the report; all probes if empty. Raises `DiagnosisError` for an
    unknown name."""
    for name in names:
        if name not in PROBES:
            suggestions = get_close_matches(name, PROBES, n=1)
            hint = f"did you mean {suggestions[0]!r}? " if suggestions else ""
            raise DiagnosisError(f"unknown probe {name!r}; {hint}there are {', '.join(PROBES)}")
    return tuple(name for name in PROBES if not names or name in names)


def make_probe(name: str) -> Probe:
    """The probe ``name`` of `PROBES`."""
    module, cls = PROBES[name]
    probe: Probe = getattr(import_module(f"fpp_ml_bench.baselines.diagnostics.{module}"), cls)()
    return probe


def finding_key(probe: Probe, subject: "Subject", dataset: "DatasetFolder", settings: ProbeSettings) -> str:
    """Hash (64 hex digits) of everything that a finding depends on."""
    content = {
        "probe": probe.name, "version": probe.version, "subject": subject.sha256, "layers": list(subject.layer_names),
        "dataset": dataset.fingerprint, "settings": asdict(settings),
    }  # fmt: skip
    return sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


# ---- figures: small files, black on white

DPI = 130
COLOURS = {
    "edges": "#2e8b57", "depth": "#c0392b", "distance": "#c0392b", "phase": "#1b5bb8", "order": "#8a4b00",
    "raw": "#59616b", "random": "#9aa3ad",
}  # fmt: skip
"""Colours of the targets, edges and depth as in the paper's figure; of the raw input, and of random weights."""
INK, GRID = "#191c20", "#dfe1e5"


def drawing(rows: int, columns: int, width: float = 9.0, height: float = 3.4, **options: Any) -> "tuple[Drawing, Any]":
    """A figure of ``rows x columns`` axes (an array of that shape), sizes in inches; ``options`` as ``subplots``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def tidy(axes: "Axes", title: str = "", x: str = "", y: str = "") -> None:
    """Set titles and a light grid, and remove the box."""
    axes.set_title(title, fontsize=10, loc="left")
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(axis="y", color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def picture(
    axes: "Axes", image: "NDArray", title: str = "", colours: str = "gray", low: float | None = None,
    high: float | None = None,
) -> Any:  # fmt: skip
    """An image (H, W) without ticks; limits default to its own range."""
    axes.set_title(title, fontsize=9)
    axes.set(xticks=[], yticks=[])
    return axes.imshow(image, cmap=colours, vmin=low, vmax=high, interpolation="nearest")


def bars_of(axes: "Axes", positions: Sequence[float], bars: Sequence[tuple[Any, Any]], **style: Any) -> None:
    """Bars of (value, interval), each of which may be None; ``style`` as ``bar``."""
    axes.bar(positions, [math.nan if value is None else value for value, _ in bars], **style)
    for x, (value, interval) in zip(positions, bars, strict=True):
        if value is not None and interval is not None:
            axes.plot([x, x], interval, color=INK, linewidth=1)


def save_figure(drawn: "Drawing", folder: Path, figure: Figure) -> Figure:
    """``figure``, whose file is written into ``folder``: 256 colours, a third of the size; reproducible bytes."""
    from PIL import Image

    buffer = BytesIO()
    drawn.savefig(buffer, format="png", dpi=DPI, facecolor="white", metadata={"Software": None})
    buffer.seek(0)
    reduced = Image.open(buffer).convert("RGB").quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    reduced.save(folder / figure.file, optimize=True)
    return figure
