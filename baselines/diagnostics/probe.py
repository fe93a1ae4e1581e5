"""What all probes share: their base class, settings and results, their names, and the style of figures.

Importing this module imports neither numpy nor matplotlib, so that the command line can name the probes.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from fpp_ml_bench.errors import DiagnosisError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from fpp_ml_bench.baselines.diagnostics.subjects import Subject
    from fpp_ml_bench.loaders.storage import DatasetFolder

Cell = str | int | float | None
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


def with_interval(value: float | None, interval: Sequence[float] | None) -> str:
    """A mean with its interval as a table's cell; a dash for None."""
    span = "" if interval is None else f" ({interval[0]:.3f} to {interval[1]:.3f})"
    return "-" if value is None else f"{value:.3f}{span}"


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
    """The result of a probe: ``summary`` in one or two sentences, ``values`` for JSON, with None instead of NaN.
    ``skipped``: why the probe does not apply to this subject; then the other fields are empty."""

    probe: str
    title: str
    summary: str
    values: Mapping[str, Any] = field(default_factory=dict)
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()
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
    def run(
        self, subject: Subject, dataset: DatasetFolder, settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        """Measure ``subject``; pictures are written into ``folder``, which exists."""

    def skip(self, reason: str) -> Finding:
        """Why this probe has no result."""
        return Finding(self.name, self.title, "", skipped=reason)

    def finding(self, summary: str, values: Mapping[str, Any], tables: Sequence[Table], *figures: Figure) -> Finding:
        """The result of this probe."""
        return Finding(self.name, self.title, summary, values, tables, figures)


PROBES = {
    "linear": ("linear", "LinearProbing"),
    "grad-cam": ("grad_cam", "GradCam"),
    "flat-plane": ("flat_plane", "FlatPlane"),
    "counterfactual": ("counterfactual", "Counterfactual"),
    "theory": ("theory", "Theory"),
}
"""The probes by name, in the order of the report: module of this package, imported on first use, and class in it."""


class Sheet:
    """A figure of ``rows x columns`` axes in the report's style, black on white; sizes in inches, ``options`` as of
    ``subplots``. ``axes``: an array of that shape."""

    COLOURS: ClassVar = {
        "edges": "#2e8b57",
        "depth": "#c0392b",
        "object_depth": "#e08e79",
        "distance": "#c0392b",
        "phase": "#1b5bb8",
        "order": "#8a4b00",
        "raw": "#59616b",
        "random": "#9aa3ad",
    }
    """Colours of the targets, edges and depth as in the paper's figure; of the raw input, and of random weights."""
    INK, GRID = "#191c20", "#dfe1e5"

    def __init__(self, rows: int, columns: int, width: float, height: float, **options: Any) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(self.figure)
        self.axes: Any = self.figure.subplots(rows, columns, squeeze=False, **options)

    def tidy(self, axes: Axes, title: str = "", x: str = "", y: str = "") -> None:
        """Set titles and a light grid, and remove the box."""
        axes.set_title(title, fontsize=10, loc="left")
        axes.set_xlabel(x, fontsize=9)
        axes.set_ylabel(y, fontsize=9)
        axes.tick_params(labelsize=8)
        axes.grid(axis="y", color=self.GRID, linewidth=0.8)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)

    def picture(self, axes: Axes, image: NDArray, title: str = "", colours: str = "gray", *limits: float) -> Any:
        """An image (H, W) without ticks; ``limits``, low and high, default to its own range."""
        axes.set_title(title, fontsize=9)
        axes.set(xticks=[], yticks=[])
        low, high = limits or (None, None)
        return axes.imshow(image, cmap=colours, vmin=low, vmax=high, interpolation="nearest")

    def scale(self, image: Any, axes: Any, size: int = 7, **options: Any) -> None:
        """The colour scale of a `picture` beside ``axes``."""
        self.figure.colorbar(image, ax=axes, **options).ax.tick_params(labelsize=size)

    def bars(self, axes: Axes, positions: NDArray, bars: Sequence[tuple[Any, Any]], **style: Any) -> None:
        """Bars of (value, interval), each of which may be None; ``style`` as of ``bar``."""
        axes.bar(positions, [math.nan if value is None else value for value, _ in bars], **style)
        for x, (value, interval) in zip(positions, bars, strict=True):
            if value is not None and interval is not None:
                axes.plot([x, x], interval, color=self.INK, linewidth=1)

    def legend(self, axes: Axes, columns: int) -> None:
        """The legend of ``axes`` below the figure."""
        handles, labels = axes.get_legend_handles_labels()
        self.figure.legend(handles, labels, fontsize=8, frameon=False, ncols=columns, loc="outside lower center")

    def save(self, folder: Path, file: str, title: str, alt: str) -> Figure:
        """Write ``file`` with 256 colours, a third of the size; the bytes are reproducible."""
        from PIL import Image

        buffer = BytesIO()
        self.figure.savefig(buffer, format="png", dpi=130, facecolor="white", metadata={"Software": None})
        reduced = Image.open(buffer).convert("RGB").quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
        reduced.save(folder / file, optimize=True)
        return Figure(title, file, alt)
