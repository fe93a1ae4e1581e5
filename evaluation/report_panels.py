"""The paper's four panels of a sample (fringe, truth, prediction, absolute error), and the signed error beside them.

Pictures are reduced to `PANEL_PX` by leaving pixels out, not by averaging: a mean across a depth edge is not a depth.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.evaluation.numbers import millimetres
from fpp_ml_bench.evaluation.report_html import data_uri, escaped, palette_png
from fpp_ml_bench.pixel_sets import object_mask

PANEL_PX = 320
CLIP_PERCENTILE = 95
"""Where the paper clips its error maps (figures of Section 6); here it is the percentile over the object pixels."""


@dataclass(frozen=True)
class Panel:
    """A picture: ``indices`` (0 is transparent) into the colour map ``colours``, a description, its scale."""

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
    def scale_png(self) -> bytes | None:
        """The colour bar; None for a panel without ends."""
        ramp = np.linspace(1, 255, 128).round().astype(np.uint8)[None].repeat(2, axis=0)
        return palette_png(ramp, colour_table(self.colours)) if self.high else None


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
    ends = f"{low:.0f}", f"{high:.0f} mm"
    limit = f"{millimetres(clip)} mm"
    return [
        Panel("Fringe", np.maximum(_subsampled(fringe), 1), "gray", f"{sample}: the captured fringe image"),
        _coloured(
            "Truth", target_mm, inside, "viridis", low, high, ends,
            f"{sample}: true depth, {ends[0]} to {ends[1]}",
        ),
        _coloured(
            "Prediction", prediction_mm, predicted, "viridis", low, high, ends,
            f"{sample}: predicted depth on the same scale; {predicted.mean():.1%} of the image is predicted as object",
        ),
        _coloured(
            "Absolute error", np.abs(error_mm), inside | predicted, "magma", 0.0, clip, ("0", limit),
            f"{sample}: absolute error, clipped at its 95th percentile over the object, {limit}",
        ),
        _coloured(
            "Signed error", error_mm, inside | predicted, "coolwarm", -clip, clip, (f"-{limit}", f"+{limit}"),
            f"{sample}: prediction minus truth, blue too near, red too far, clipped at {limit}",
        ),
    ]  # fmt: skip


def panels_html(panels: list[Panel]) -> str:
    """The panels side by side; each picture has a description in words."""
    figures = []
    for panel in panels:
        scale = ""
        if panel.scale_png is not None:
            bar = f'<img src="{data_uri(panel.scale_png)}" alt="" width="128" height="8">'
            scale = (
                f'<span class="scale"><span>{escaped(panel.low)}</span>{bar}<span>{escaped(panel.high)}</span></span>'
            )
        figures.append(
            f'<figure><img src="{data_uri(panel.png)}" alt="{escaped(panel.description, 400)}">'
            f"<figcaption>{escaped(panel.title)}{scale}</figcaption></figure>"
        )
    return f'<div class="panels">{"".join(figures)}</div>'


@cache
def colour_table(name: str, levels: int = 255) -> NDArray[np.uint8]:
    """Index 0, which is transparent, and ``levels`` RGB colours of a matplotlib map, (levels + 1, 3)."""
    import matplotlib

    table = matplotlib.colormaps[name](np.linspace(0, 1, levels))[:, :3]
    return np.vstack([np.zeros((1, 3)), 255 * table]).round().astype(np.uint8)


def _subsampled(image: NDArray) -> NDArray:
    step = max(1, -(-max(image.shape) // PANEL_PX))
    return image[::step, ::step]


def _coloured(
    title: str,
    values: NDArray,
    visible: NDArray[np.bool_],
    colours: str,
    low: float,
    high: float,
    ends: tuple[str, str],
    description: str,
) -> Panel:
    """Values from ``low`` to ``high`` in colours, clipped at both ends, transparent where not ``visible``."""
    values, visible = _subsampled(np.asarray(values, np.float64)), _subsampled(visible)
    share = np.clip((values - low) / (high - low), 0, 1) if high > low else np.zeros_like(values)
    indices = np.where(visible, 1 + np.round(254 * share), 0).astype(np.uint8)
    return Panel(title, indices, colours, description, *ends)
