"""Common style of the report's figures: small files, black on white."""

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
"""Colours of the targets: edges and depth as in the paper's figure, phase, and fringe order."""
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
    """Set titles and a light grid, and remove the box."""
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
    drawn_image = axes.imshow(image, cmap=colours, vmin=low, vmax=high, interpolation="nearest")
    axes.set_title(title, fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])
    return drawn_image


def bars_of(
    axes: "Axes", positions: NDArray, values: Sequence[float | None], intervals: Sequence[tuple[float, float] | None],
    width: float, colour: str, label: str,
) -> None:  # fmt: skip
    """Bars with their intervals; no bar for a value of None."""
    heights = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    axes.bar(positions, heights, width, color=colour, label=label)
    for x, value, interval in zip(positions, heights, intervals, strict=True):
        if interval is not None and np.isfinite(value):
            axes.plot([x, x], interval, color="#191c20", linewidth=1)


def save_png(figure: "Drawing", path: Path) -> None:
    """Write ``figure`` as PNG with 256 colours, a third of the size; the bytes are reproducible."""
    from PIL import Image

    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, facecolor="white", metadata={"Software": None})
    buffer.seek(0)
    reduced = Image.open(buffer).convert("RGB").quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    reduced.save(path, optimize=True)
