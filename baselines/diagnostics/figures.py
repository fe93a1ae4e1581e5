"""Figures of the report: one look for all, small files. Black on white, for they stand on a white card on the page."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

DPI = 130
EDGES, DEPTH, PHASE, ORDER = "#2e8b57", "#c0392b", "#1b5bb8", "#8a4b00"
"""Colours of what is asked for: edges and depth as in the paper's figure, phase and fringe order besides."""
RAW, RANDOM = "#59616b", "#9aa3ad"
"""Colours of the controls: the raw input, and a network with random weights."""


def drawing(rows: int, columns: int, width: float = 9.0, height: float = 3.4, **options: Any) -> "tuple[Drawing, Any]":
    """A figure of ``rows x columns`` axes (an array of that shape), sizes in inches; ``options`` as ``subplots``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def tidy(axes: "Axes", title: str = "", x: str = "", y: str = "") -> None:
    """Titles, a light grid, no box."""
    axes.set_title(title, fontsize=10, loc="left")
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(axis="y", color="#dfe1e5", linewidth=0.8)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def picture(
    axes: "Axes", image: NDArray, title: str = "", colours: str = "gray", low: float | None = None,
    high: float | None = None,
) -> Any:  # fmt: skip
    """An image (H, W) without ticks; limits default to its own range."""
    shown = axes.imshow(image, cmap=colours, vmin=low, vmax=high, interpolation="nearest")
    axes.set_title(title, fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])
    return shown


def bars_of(
    axes: "Axes", place: NDArray, values: Sequence[float | None], intervals: Sequence[tuple[float, float] | None],
    width: float, colour: str, label: str,
) -> None:  # fmt: skip
    """Bars with their intervals; a value of None leaves its place empty."""
    shown = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    axes.bar(place, shown, width, color=colour, label=label)
    for x, value, interval in zip(place, shown, intervals, strict=True):
        if interval is not None and np.isfinite(value):
            axes.plot([x, x], interval, color="#191c20", linewidth=1)


def save_png(figure: "Drawing", path: Path) -> None:
    """Write ``figure`` with 256 colours, a third of the bytes; the same bytes every time."""
    from PIL import Image

    held = BytesIO()
    figure.savefig(held, format="png", dpi=DPI, facecolor="white", metadata={"Software": None})
    held.seek(0)
    small = Image.open(held).convert("RGB").quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    small.save(path, optimize=True)
