"""The maps that the benchmarks of the phase and crossed routes draw of a view."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Panel = tuple[str, np.ndarray, Mapping[str, Any]]
"""Title, map (h, w), and how ``imshow`` draws it."""


def draw_panels(panels: Sequence[Panel], title: str, path: Path, columns: int = 6) -> None:
    """Maps of the same size, ``columns`` beside each other, each with its own scale, as a PNG at ``path``."""
    import matplotlib.pyplot as plt

    height, width = panels[0][1].shape
    rows = -(-len(panels) // columns)
    tall = rows * (18 / columns * height / width + 0.9)
    figure, axes = plt.subplots(rows, columns, figsize=(18, tall), layout="constrained", squeeze=False)
    for axis, (name, values, style) in zip(axes.flat, panels, strict=False):
        drawn = axis.imshow(values, interpolation="nearest", **style)
        axis.set_title(name, fontsize=11)
        figure.colorbar(drawn, ax=axis, orientation="horizontal", pad=0.02, fraction=0.05)
    for axis in axes.flat:
        axis.set_axis_off()
    figure.suptitle(title)
    figure.savefig(path, dpi=60)
    plt.close(figure)
