"""Pictures of a report: a figure of the errors and of a stated uncertainty, and the panels of a sample."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.evaluation.report.html import data_uri, millimetres
from fpp_ml_bench.evaluation.result.parts import Uncertainty


def errors_figure(errors_mm: Sequence[float], block: Uncertainty | None) -> str:
    """PNG as a data URI: the object MAE in mm of every sample, ascending, and of a stated uncertainty how much of the
    object lies within the interval that should hold a share of it, and the error of the rest when the least sure pixels
    are left out."""
    plots: list[tuple[str, str, Any, dict[str, list[float]]]] = [
        ("sample", "object MAE, mm", range(1, len(errors_mm) + 1), {"": sorted(errors_mm)})
    ]
    if block is not None and (reliability := block.reliability) is not None:
        lines = {"as stated": reliability.nominal, "observed": reliability.observed}
        plots.append(("nominal coverage", "observed coverage", reliability.nominal, lines))
    if block is not None and (curves := block.sparsification) is not None:
        lines = {"best order": curves.best_mae_mm, "by sigma": curves.mae_mm}
        plots.append(("share of object pixels left out", "MAE of the rest, mm", curves.left_out, lines))
    figure = Figure(figsize=(4.4 * len(plots), 3.4), dpi=100, layout="constrained")
    for axes, (across, up, places, lines) in zip(figure.subplots(1, len(plots), squeeze=False)[0], plots, strict=True):
        for number, (title, values) in enumerate(lines.items()):
            axes.plot(places, values, "--" if number == 0 and title else ".-", label=title)
        axes.set(xlabel=across, ylabel=up)
        if len(lines) > 1:
            axes.legend(frameon=False)
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return data_uri(content.getvalue())


PANEL_PX = 320
CLIP_PERCENTILE = 95
"""Where the paper clips its error maps (figures of Section 6); here it is the percentile over the object pixels."""


@dataclass(frozen=True)
class Panel:
    """A picture: ``indices`` (0 is transparent) into the colour map ``colours``; the ends of its scale as text."""

    title: str
    indices: NDArray[np.uint8]
    colours: str
    description: str
    low: str = ""
    high: str = ""

    @property
    def png(self) -> bytes:
        return palette_png(self.indices, colour_table(self.colours))

    @property
    def address(self) -> str:
        return data_uri(self.png)

    @property
    def scale_address(self) -> str:
        """The colour bar, of a panel whose scale has ends."""
        ramp = np.linspace(1, 255, 128).round().astype(np.uint8)[None].repeat(2, axis=0)
        return data_uri(palette_png(ramp, colour_table(self.colours)))


def sample_panels(
    fringe: NDArray[np.uint8], target_mm: NDArray[np.floating], prediction_mm: NDArray[np.floating], sample: str
) -> list[Panel]:
    """The five panels of a sample; all maps (H, W), depth in mm with 0 = background."""
    inside = object_mask(np.asarray(target_mm))
    error_mm = np.asarray(prediction_mm, np.float64) - target_mm
    object_depth = target_mm[inside] if inside.any() else np.zeros(1)
    low, high = float(object_depth.min()), float(object_depth.max())
    clip = float(np.percentile(np.abs(error_mm[inside if inside.any() else ...]), CLIP_PERCENTILE))
    predicted = np.asarray(prediction_mm) > 0
    either = inside | predicted
    ends = f"{low:.0f}", f"{high:.0f} mm"
    limit = f"{millimetres(clip)} mm"
    truth, prediction = _levels(target_mm, inside, low, high), _levels(prediction_mm, predicted, low, high)
    absolute, signed = _levels(np.abs(error_mm), either, 0.0, clip), _levels(error_mm, either, -clip, clip)
    same_scale = f"predicted depth on the same scale; {predicted.mean():.1%} of the image is predicted as object"
    clipped = f"absolute error, clipped at its 95th percentile over the object, {limit}"
    near_far = f"prediction minus truth, blue too near, red too far, clipped at {limit}"
    return [
        Panel("Fringe", np.maximum(_subsampled(fringe), 1), "gray", f"{sample}: the captured fringe image"),
        Panel("Truth", truth, "viridis", f"{sample}: true depth, {ends[0]} to {ends[1]}", *ends),
        Panel("Prediction", prediction, "viridis", f"{sample}: {same_scale}", *ends),
        Panel("Absolute error", absolute, "magma", f"{sample}: {clipped}", "0", limit),
        Panel("Signed error", signed, "coolwarm", f"{sample}: {near_far}", f"-{limit}", f"+{limit}"),
    ]


def _subsampled(image: NDArray) -> NDArray:
    step = max(1, -(-max(image.shape) // PANEL_PX))
    return image[::step, ::step]


def _levels(values: NDArray, visible: NDArray[np.bool_], low: float, high: float) -> NDArray[np.uint8]:
    """``low`` to ``high`` as 1 to 255, clipped at both ends; 0, which is transparent, where not ``visible``."""
    values, visible = _subsampled(np.asarray(values, np.float64)), _subsampled(visible)
    share = np.clip((values - low) / (high - low), 0, 1) if high > low else np.zeros_like(values)
    return np.where(visible, 1 + np.round(254 * share), 0).astype(np.uint8)


@cache
def colour_table(name: str, levels: int = 255) -> NDArray[np.uint8]:
    """Index 0, which is transparent, and ``levels`` RGB colours of a matplotlib map, (levels + 1, 3)."""
    table = matplotlib.colormaps[name](np.linspace(0, 1, levels))[:, :3]
    return np.vstack([np.zeros((1, 3)), 255 * table]).round().astype(np.uint8)


def palette_png(indices: NDArray[np.uint8], colours: NDArray[np.uint8]) -> bytes:
    """A PNG of ``indices`` (H, W) into ``colours`` (256, 3); index 0 is transparent."""
    image = Image.fromarray(indices)
    image.putpalette(colours.astype(np.uint8).tobytes())  # makes it an image of mode P
    content = io.BytesIO()
    image.save(content, "PNG", transparency=0, compress_level=9)
    return content.getvalue()
