"""The row of maps that both phase benchmarks draw of a view."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Panel = tuple[str, np.ndarray, Mapping[str, Any]]
"""Title, map (h, w), and how ``imshow`` draws it."""


def draw_panels(panels: Sequence[Panel], title: str, path: Path) -> None:
    """Six maps of the same size beside each other, each with its own scale, as a PNG at ``path``."""
    import matplotlib.pyplot as plt

    height, width = panels[0][1].shape
    figure, axes = plt.subplots(1, 6, figsize=(18, 18 / 6 * height / width + 0.9), layout="constrained")
    for axis, (name, values, style) in zip(axes, panels, strict=True):
        drawn = axis.imshow(values, interpolation="nearest", **style)
        axis.set_title(name, fontsize=11)
        axis.set_axis_off()
        figure.colorbar(drawn, ax=axis, orientation="horizontal", pad=0.02, fraction=0.05)
    figure.suptitle(title)
    figure.savefig(path, dpi=60)
    plt.close(figure)
