"""A histogram of per-sample errors as SVG, in the page's own colours."""

import math
from collections.abc import Sequence

from fpp_ml_bench.evaluation.numbers import millimetres
from fpp_ml_bench.evaluation.report_html import escaped

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
