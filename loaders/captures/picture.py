"""A decoded capture as a picture: a frame, depth, its uncertainty, modulation, and why pixels have no depth."""

import io
from collections.abc import Sequence
from textwrap import wrap

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding import Reason

_REASONS = {
    Reason.DECODED: "decoded",
    Reason.NO_RAY: "no ray",
    Reason.LOW_MODULATION: "low modulation",
    Reason.SATURATED: "saturated",
    Reason.INCONSISTENT_ORDER: "order not clear",
    Reason.OUTSIDE_PATTERN: "outside the pattern",
    Reason.DIRECTIONS_DISAGREE: "directions disagree",
    Reason.OUTSIDE_RANGE: "outside the range",
    Reason.NOT_ASKED: "not asked",
}
_COLUMNS = 250
_COLOURS = ("#3ca951", "#9498a0", "#22252b", "#ff725c", "#efb118", "#a463f2", "#ff8ab7", "#4269d0", "#ffffff")


def capture_picture(
    title: str,
    grey: NDArray,
    depth_mm: NDArray[np.float32],
    sigma_mm: NDArray[np.float32],
    modulation: NDArray,
    reason: NDArray[np.uint8],
    findings: Sequence[str] = (),
) -> bytes:
    """PNG of maps (H, W): a frame in grey levels, depth and standard uncertainty in mm (0 = none), modulation in grey
    levels, and `Reason` codes; the ``findings`` stand below it."""
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    lines = [line for finding in findings for line in wrap(finding, _COLUMNS)]
    figure = Figure(figsize=(17, 3.9 + 0.17 * len(lines)), dpi=100, layout="constrained")
    if lines:
        figure.supxlabel("\n".join(lines), fontsize=8, x=0.01, ha="left", color="#b00020")
    figure.suptitle(title, fontsize=11)
    found = depth_mm > 0
    low, high = np.quantile(depth_mm[found], (0.005, 0.995)) if found.any() else (0.0, 1.0)
    top = np.quantile(sigma_mm[found], 0.95) if found.any() else 1.0
    panels = (
        ("mean of the frames, grey levels", grey, "gray", 0.0, max(float(np.quantile(grey, 0.999)), 1.0)),
        ("depth, mm", np.where(found, depth_mm, np.nan), "viridis", low, high),
        ("standard uncertainty by noise, mm", np.where(found, sigma_mm, np.nan), "magma", 0.0, top),
        ("modulation, grey levels", modulation, "gray", 0.0, float(max(np.nanmax(modulation, initial=1.0), 1.0))),
    )
    axes = figure.subplots(1, 5)
    for plot, (name, image, colours, bottom, most) in zip(axes, panels, strict=False):
        drawn = plot.imshow(image, cmap=colours, vmin=bottom, vmax=most, interpolation="nearest")
        figure.colorbar(drawn, ax=plot, fraction=0.046, pad=0.02).ax.tick_params(labelsize=7)
        plot.set_title(name, fontsize=9)
    axes[4].imshow(reason, cmap=ListedColormap(_COLOURS), vmin=0, vmax=len(_COLOURS) - 1, interpolation="nearest")
    axes[4].set_title("pixels", fontsize=9)
    shares = np.bincount(reason.ravel(), minlength=len(_COLOURS)) / reason.size
    handles = [
        Patch(facecolor=_COLOURS[code], edgecolor="0.6", label=f"{name} {100 * shares[code]:.1f}%")
        for code, name in _REASONS.items()
        if shares[code] > 0
    ]
    axes[4].legend(handles=handles, fontsize=7, loc="upper left", bbox_to_anchor=(0.0, -0.02), ncols=2, frameon=False)
    for plot in axes:
        plot.set_xticks([])
        plot.set_yticks([])
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return content.getvalue()
