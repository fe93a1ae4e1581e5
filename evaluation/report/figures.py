"""A histogram of per-sample errors as SVG, in the page's own colours."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.evaluation.report.html import data_uri, escaped, palette_png
from fpp_ml_bench.evaluation.report.numbers import millimetres

WIDTH, HEIGHT = 720, 240
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, 12, 22, 44
_LEAST = 1e-30
_ROUND = (1.0, 2.0, 2.5, 5.0, 10.0)


def nice_step(span: float, parts: int) -> float:
    """The round number (1, 2, 2.5 or 5 x 10^k) next above ``span / parts``; 1 for a span of 0."""
    raw = span / parts
    if not raw > _LEAST:
        return 1.0
    power = 10.0 ** math.floor(math.log10(raw))
    return next(power * factor for factor in _ROUND if power * factor >= raw * (1 - 1e-12))


def bins(values: Sequence[float]) -> tuple[list[float], list[int]]:
    """Edges of equal bins at round numbers, and how many values lie in each; a value on an edge is right of it."""
    low, high = min(values), max(values)
    # Twice the cube root of n bins (Rice's rule); equal values get a single bin around them. Values that differ only
    # in their last digits would need edges that no float64 can hold, so the bins stay wider than 1e-6 of the value.
    step = nice_step(max(high - low, 1e-6 * high) if high > low else high, max(4, round(2 * len(values) ** (1 / 3))))
    first, last = math.floor(low / step), math.floor(high / step) + 1
    counts = [0] * (last - first)
    for value in values:
        counts[min(int(value / step) - first, len(counts) - 1)] += 1
    return [step * (first + n) for n in range(last - first + 1)], counts


def histogram_svg(values: Sequence[float], mean: float, label: str) -> str:
    """Histogram of ``values`` (mm) with their mean marked; ``label`` says what they are."""
    edges, counts = bins(values)
    tallest = max(counts)
    width, height = WIDTH - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM
    base = _TOP + height

    def across(value: float) -> float:
        return _LEFT + width * (value - edges[0]) / (edges[-1] - edges[0])

    parts = []
    step = max(1, math.ceil(tallest / 4))
    for count in range(0, tallest + 1, step):
        y = base - height * count / tallest
        parts.append(f'<path class="axis" d="M{_LEFT} {y:.1f}H{WIDTH - _RIGHT}"/>')
        parts.append(f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end" font-size="12">{count}</text>')
    for start, end, count in zip(edges, edges[1:], counts, strict=False):
        if count:
            x, tall = across(start) + 1, height * count / tallest
            parts.append(
                f'<rect class="bar" x="{x:.1f}" y="{base - tall:.1f}" width="{across(end) - x - 1:.1f}" '
                f'height="{tall:.1f}"><title>{start:.4g} to {end:.4g} mm: {count}</title></rect>'
            )
    every = max(1, math.ceil(len(edges) / 9))
    for edge in edges[::every]:
        parts.append(
            f'<text x="{across(edge):.1f}" y="{base + 18}" text-anchor="middle" font-size="12">{edge:.4g}</text>'
        )
    x = across(mean)
    anchor = "end" if x > WIDTH / 2 else "start"
    parts.append(f'<path class="mark" d="M{x:.1f} {_TOP - 6}V{base}" stroke-width="2" stroke-dasharray="4 3"/>')
    parts.append(
        f'<text class="name" x="{x + (-6 if anchor == "end" else 6):.1f}" y="{_TOP - 4}" text-anchor="{anchor}" '
        f'font-size="12">mean {millimetres(mean)} mm</text>'
    )
    parts.append(
        f'<text x="{_LEFT + width / 2:.1f}" y="{HEIGHT - 6}" text-anchor="middle" font-size="12">'
        f"{escaped(label)}, mm</text>"
    )
    description = f"Histogram of {label} over {len(values)} samples, from {min(values):.4g} to {max(values):.4g} mm"
    attributes = f'class="histogram" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escaped(description)}"'
    return f"<svg {attributes}>{''.join(parts)}</svg>"


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
