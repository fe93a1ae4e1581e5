"""What all probes share: their base class, settings and results, their names, and how figures are drawn.

A probe gives rows for tables, and lines or pictures for figures; `chart` and `gallery` draw them in one style.
Importing this module imports neither numpy nor matplotlib, so that the command line can name the probes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.style import FRAME_COLOURS, GRID, figure, figure_png, styled

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fpp_ml_bench.baselines.diagnostics.subjects import Subject
    from fpp_ml_bench.loaders.storage.store import DatasetFolder

TRAINED, UNTRAINED = "trained", "untrained"
Cell = str | int | float | Sequence[float] | Mapping[str, Any] | None
"""Of a table. A pair is a range, and a mapping a value ``r`` with its ``interval``."""
Progress = Callable[[int, int, str], None]
"""Called by a running probe with the steps done, their total, and the activity."""


def silent(*progress: object) -> None:
    """A `Progress` that shows nothing."""


@dataclass(frozen=True)
class ProbeSettings:
    """How much a probe measures; None means the probe's default. ``samples``: most samples of each split, taken evenly
    over it (`spread`). ``seeds``: repeats of what depends on random numbers. ``quick``: a short run for a first look.
    Raises `DiagnosisError` for a number below 1."""

    samples: int | None = None
    seeds: int | None = None
    quick: bool = False

    def __post_init__(self) -> None:
        for name in ("samples", "seeds"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise DiagnosisError(f"{name}: expected 1 or more, got {value}")

    def choose(self, names: Sequence[str], usual: int | None = None, quick: int | None = None) -> list[str]:
        """At most ``samples`` of ``names``, by default ``usual``, or ``quick`` of them in a quick run."""
        return spread(names, self.samples or (quick if self.quick else usual))


def spread(names: Sequence[str], limit: int | None) -> list[str]:
    """At most ``limit`` of ``names``, taken evenly, in their order."""
    if limit is None or limit >= len(names):
        return list(names)
    return [names[(2 * place + 1) * len(names) // (2 * limit)] for place in range(limit)]


def mean_of(values: Iterable[float | None]) -> float | None:
    """Mean of ``values`` other than None; None where there are none."""
    import numpy as np

    defined = [value for value in values if value is not None]
    return float(np.mean(defined)) if defined else None


def with_interval(value: float | None, interval: Sequence[float] | None = None) -> str:
    """A mean with its interval as a table's cell; a dash for None."""
    span = "" if interval is None else f" ({interval[0]:.3f} to {interval[1]:.3f})"
    return "-" if value is None else f"{value:.3f}{span}"


@dataclass(frozen=True)
class Table:
    """Rows under a header. The first cell of a row names it; floats are shown with four significant digits."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]

    @classmethod
    def of(cls, title: str, first: str, rows: Mapping[str, Mapping[str, Any]], columns: Mapping[str, str]) -> Table:
        """The named ``rows``; ``columns``: titles by the keys of what a row shows, and a dash where it lacks a key."""
        cells = [(name, *(row.get(key) for key in columns)) for name, row in rows.items()]
        return cls(title, (first, *columns.values()), cells)


@dataclass(frozen=True)
class Figure:
    """A picture with its title and a description ``alt``."""

    title: str
    alt: str
    png: bytes = field(repr=False)


@dataclass(frozen=True)
class Finding:
    """The result of a probe: ``summary`` in one or two sentences, ``values`` for JSON, with None instead of NaN.
    ``skipped``: why the probe does not apply to this subject; then the other fields are empty."""

    probe: str
    title: str
    summary: str
    values: Mapping[str, Any] = field(default_factory=dict)
    table: Table | None = None
    figure: Figure | None = None
    skipped: str | None = None


class Probe(ABC):
    """A test of a model. ``version`` goes up when its result for the same model changes. ``without_network``: what a
    method without a network lacks for this probe, or None. ``asks_subject``: whether the result is about the model."""

    name: str
    title: str
    question: str
    version = 1
    without_network: str | None = None
    asks_subject = True

    def applies_to(self, subject: Subject) -> str | None:
        """None where the probe can run, else the reason why it can't, for the report."""
        if self.without_network is None or subject.network is not None:
            return None
        return f"{subject.name} is a method without a network: {self.without_network}."

    @abstractmethod
    def run(self, subject: Subject, dataset: DatasetFolder, settings: ProbeSettings, progress: Progress) -> Finding:
        """Measure ``subject``."""

    def skip(self, reason: str) -> Finding:
        """Why this probe has no result."""
        return Finding(self.name, self.title, "", skipped=reason)

    def finding(self, summary: str, values: Mapping[str, Any], table: Table, figure: Figure) -> Finding:
        """The result of this probe."""
        return Finding(self.name, self.title, summary, values, table, figure)


PROBES = {
    "linear": "LinearProbing",
    "grad-cam": "GradCam",
    "flat-plane": "FlatPlane",
    "counterfactual": "Counterfactual",
    "theory": "Theory",
}
"""The probes in the order of the report, and their classes; each is in the module of its name, which is imported when
it runs."""


def make_probe(name: str) -> Probe:
    """The probe ``name`` of `PROBES`."""
    module = import_module(f"{__package__}.{name.replace('-', '_')}")
    probe: Probe = getattr(module, PROBES[name])()
    return probe


COLOURS = {
    "edges": "#2e8b57",
    "depth": "#c0392b",
    "object_depth": "#e08e79",
    "distance": "#c0392b",
    "phase": "#1b5bb8",
    "order": "#8a4b00",
    "random": "#9aa3ad",
    "ink": "#191c20",
}
"""Colours of the targets, edges and depth as in the paper's figure; of the raw input, of random weights, of text."""
_GAP = 4  # px between two pictures


@dataclass(frozen=True)
class Line:
    """Values ``y`` (n,) at ``x`` (n,), numbers or names; None is left out. ``ends``: the interval of each value.
    ``style``: marker and line as for matplotlib's ``plot``."""

    label: str
    x: Sequence[Any] | NDArray
    y: Sequence[float | None] | NDArray
    colour: str
    style: str = "o-"
    ends: Sequence[Sequence[float] | None] = ()


@dataclass(frozen=True)
class Panel:
    """Lines over one pair of axes; ``axes``: properties of matplotlib's ``Axes``, such as ``ylabel`` and ``ylim``."""

    title: str
    lines: Sequence[Line]
    axes: Mapping[str, Any]


@dataclass(frozen=True)
class Picture:
    """A map (H, W) from ``low`` to ``high`` (default: its largest value) in matplotlib's ``colours``; NaN is white."""

    image: NDArray
    colours: str = FRAME_COLOURS
    low: float = 0.0
    high: float | None = None

    def rgb(self) -> NDArray:
        """Float (H, W, 3) in [0, 1]."""
        import numpy as np
        from matplotlib import colormaps

        values = np.asarray(self.image, dtype=float)
        high = np.nanmax(values) if self.high is None else self.high
        share = np.clip((np.nan_to_num(values) - self.low) / ((high - self.low) or 1.0), 0, 1)
        return np.where(np.isnan(values)[..., None], 1.0, colormaps[self.colours](share)[..., :3])


@styled
def chart(panels: Sequence[Panel], columns: int, panel_size: tuple[float, float] = (5.0, 3.4)) -> bytes:
    """``panels`` in rows of ``columns``, of so many inches each, and one legend of all their lines; PNG."""
    rows = max(-(-len(panels) // columns), 1)
    drawn = figure(panel_size[0] * columns, panel_size[1] * rows)
    axes_of = drawn.subplots(rows, columns, squeeze=False)
    handles: dict[str, Any] = {}
    for axes in axes_of.flat[len(panels) :]:
        axes.axis("off")
    for panel, axes in zip(panels, axes_of.flat, strict=False):
        for line in panel.lines:
            values = [float("nan") if value is None else value for value in line.y]
            (handle,) = axes.plot(line.x, values, line.style, color=line.colour, markersize=4, linewidth=1.2)
            handles.setdefault(line.label, handle)
            for x, ends in zip(line.x, line.ends, strict=False):
                if ends is not None:
                    axes.plot([x] * len(ends), ends, color=line.colour, linewidth=0.8)
        axes.set(**panel.axes)
        axes.set_title(panel.title, loc="left")
        axes.tick_params(axis="x", rotation=40)
        axes.grid(axis="y", color=GRID)
    drawn.legend(handles.values(), handles, ncols=max(1, columns - 1), loc="outside lower center")
    return figure_png(drawn, reduced=True)


@styled
def gallery(rows: Mapping[str, Sequence[Picture]], columns: Sequence[str], picture_inches: float = 1.1) -> bytes:
    """Pictures in named rows and columns, so many inches wide each; PNG."""
    import numpy as np

    shapes = [picture.image.shape for row in rows.values() for picture in row]
    height, width = (max(lengths) + _GAP for lengths in zip(*shapes, strict=True))
    # One image: fifty small axes take ten times as long to lay out.
    sheet = np.ones((height * len(rows), width * len(columns), 3))
    for down, row in enumerate(rows.values()):
        for across, picture in enumerate(row):
            part = picture.rgb()
            sheet[down * height :, across * width :][: part.shape[0], : part.shape[1]] = part
    size = picture_inches * len(columns), picture_inches * len(rows) * height / width
    drawn = figure(size[0] + 1.2, size[1] + 0.6)
    axes = drawn.subplots()
    axes.imshow(sheet, interpolation="nearest")
    axes.xaxis.tick_top()
    axes.set_xticks(width * (np.arange(len(columns)) + 0.5), columns)
    axes.set_yticks(height * (np.arange(len(rows)) + 0.5), list(rows))
    axes.tick_params(length=0, labelsize=7)
    axes.spines[:].set_visible(False)
    return figure_png(drawn, reduced=True)
