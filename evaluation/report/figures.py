"""Pictures of a report: the bars of a histogram of errors, curves of a stated uncertainty, the panels of a sample."""

import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.evaluation.report.html import data_uri, millimetres, percent
from fpp_ml_bench.evaluation.result.parts import Uncertainty

_BELOW = 44
"""Height in px of the numbers and the name below an axis."""
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


def _scale(low: float, high: float, first_px: int, last_px: int) -> Callable[[float], float]:
    """The place in px of a value on an axis."""
    return lambda value: round(first_px + (last_px - first_px) * (value - low) / (high - low), 1)


def histogram(values: Sequence[float], mean: float, label: str) -> SimpleNamespace:
    """What ``report.html`` draws: the bars of a histogram of ``values`` (mm), its axes and its mean, in px."""
    width, height, left, right, top = 720, 240, 44, 708, 22
    edges, counts = bins(values)
    base, tallest = height - _BELOW, max(counts)
    across, up = _scale(edges[0], edges[-1], left, right), _scale(0, tallest, base, top)
    bars = []
    for low, high, count in zip(edges, edges[1:], counts, strict=False):
        if count:
            box = across(low) + 1, up(count), across(high) - across(low) - 2, base - up(count)
            bars.append((*(round(number, 1) for number in box), f"{low:.4g} to {high:.4g} mm: {count}"))
    return SimpleNamespace(
        width=width,
        height=height,
        left=left,
        right=right,
        top=top,
        base=base,
        bars=bars,
        levels=[(up(count), count) for count in range(0, tallest + 1, max(1, math.ceil(tallest / 4)))],
        edges=[(across(edge), f"{edge:.4g}") for edge in edges[:: max(1, math.ceil(len(edges) / 9))]],
        mean=mean,
        mean_x=across(mean),
        description=f"Histogram of {label} over {len(values)} samples, from {min(values):.4g} to {max(values):.4g} mm",
    )


Points = Sequence[tuple[float, float]]


def uncertainty_plots(block: Uncertainty | None) -> list[SimpleNamespace]:
    """The plots of a result's stated uncertainty, as the lines that ``report.html`` draws: reliability and
    sparsification; none where it states nothing."""
    plots = []
    if block is not None and (reliability := block.reliability) is not None:
        observed = [(0.0, 0.0), *zip(reliability.nominal, reliability.observed, strict=True)]
        lines = {"as stated": [(0.0, 0.0), (1.0, 1.0)], "observed": observed}
        plots.append(_plot(lines, 1.0, "nominal coverage", percent))
    if block is not None and (curves := block.sparsification) is not None:
        lines = {
            "best order": list(zip(curves.left_out, curves.best_mae_mm, strict=True)),
            "by sigma": list(zip(curves.left_out, curves.mae_mm, strict=True)),
        }
        highest = max(curves.mae_mm) or 1.0
        plots.append(_plot(lines, highest, "share of object pixels left out; MAE of the rest, mm", millimetres))
    return plots


def _plot(
    lines: Mapping[str, Points], highest: float, label: str, write: Callable[[float | None], str]
) -> SimpleNamespace:
    """Lines over [0, 1] in px, the first of them dashed; ``write`` gives a height as text. The legend stands where no
    line is: left of rising lines, right of falling ones."""
    width, height, left, right, top = 460, 300, 64, 448, 14
    base = height - _BELOW
    across, up = _scale(0, 1, left, right), _scale(0, highest, base, top)
    drawn = [
        SimpleNamespace(
            title=title,
            dashed=number == 0,
            kind="ideal" if number == 0 else "curve",
            points=" ".join(f"{across(x)},{up(y)}" for x, y in points),
        )
        for number, (title, points) in enumerate(lines.items())
    ]
    rising = all(points[-1][1] > points[0][1] for points in lines.values())
    ticks = [step / 4 for step in range(5)]
    ends = "; ".join(f"{title}: {write(points[0][1])} to {write(points[-1][1])}" for title, points in lines.items())
    return SimpleNamespace(
        width=width,
        height=height,
        left=left,
        right=right,
        base=base,
        lines=drawn,
        label=label,
        levels=[(up(highest * tick), write(highest * tick)) for tick in ticks],
        edges=[(across(tick), percent(tick)) for tick in ticks],
        legend=[(top + 15 * number, line) for number, line in enumerate(drawn)],
        legend_x=left + 12 if rising else right - 110,
        description=f"{label[0].upper()}{label[1:]}. {ends}",
    )


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
