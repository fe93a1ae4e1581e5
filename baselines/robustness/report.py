"""The page of all methods measured below a folder: curves by axis, and a table."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fpp_ml_bench.baselines.diagnostics.probe import Line, Panel, chart
from fpp_ml_bench.baselines.robustness.axes import CLEAN, corruptions, severity_means
from fpp_ml_bench.baselines.robustness.run import read_axis
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.style import LINE_COLOURS, data_uri, page

PAGE, CURVES = "index.html", "curves.png"
_DASHES = ("-", "--", ":")


@dataclass(frozen=True)
class Measured:
    """A method's folder: what was measured, and mean scores by axis and severity."""

    folder: Path
    setup: dict[str, Any]
    means: dict[str, dict[int, dict[str, float | None]]]

    def mean(self, key: str = "mae_mm", axis: str | None = None) -> float | None:
        """Mean of a score over the severities of an axis, or of all, that were measured; None where one is unknown."""
        axes = self.means.keys() - {CLEAN} if axis is None else {axis}
        values = [scores[key] for name, by in self.means.items() if name in axes for scores in by.values()]
        known = [value for value in values if value is not None]
        return float(np.mean(known)) if known and len(known) == len(values) else None


def read_measured(out: Path) -> list[Measured]:
    """Every method below ``out``, the best first. PredictionError for a damaged file."""
    found = []
    for folder in sorted(path for path in out.iterdir() if path.is_dir()):
        files = [folder / f"{axis}.json" for axis in (CLEAN, *corruptions().axes)]
        contents = [content for file in files if (content := read_axis(file)) is not None]
        if contents:
            means = {content["axis"]: severity_means(content["views"]) for content in contents}
            found.append(Measured(folder, contents[0]["setup"], means))
    return sorted(found, key=lambda one: (one.mean() is None, one.mean() or 0.0))


def write_page(out: Path) -> Path:
    """Curves and page of all methods below ``out``; the page's path."""
    measured = read_measured(out)
    curves = draw_curves(measured)
    write_atomically(out / CURVES, curves)
    content = page(
        "fpp_ml_bench.baselines.robustness",
        "robustness.html",
        "Robustness: FPP-ML-Bench",
        methods=measured,
        axes=corruptions().axes,
        rules=corruptions(),
        curves=data_uri(curves),
        clean=CLEAN,
    )
    write_atomically(out / PAGE, content)
    return out / PAGE


def draw_curves(measured: Sequence[Measured]) -> bytes:
    """A panel for each axis: mean error against severity, a line a method; PNG."""
    panels = []
    for name, axis in corruptions().axes.items():
        lines = []
        for number, one in enumerate(measured):
            if name not in one.means:
                continue
            points = {0: one.means.get(CLEAN, {}).get(0, {}), **one.means[name]}
            label = one.setup["title"] + (", unseen" if one.setup["set"] == "unseen" else "")
            label += " (quick)" if one.setup["quick"] else ""
            style = "o" + _DASHES[number // len(LINE_COLOURS) % len(_DASHES)]
            errors = [scores.get("mae_mm") for scores in points.values()]
            lines.append(Line(label, list(points), errors, LINE_COLOURS[number % len(LINE_COLOURS)], style))
        if lines:
            lines.append(Line("charge for no answer", range(6), [corruptions().unanswered_mm] * 6, "0.6", ":"))
            ticks = {"xticks": range(6), "xticklabels": ["clean", *(f"{value:g}" for value in axis.severities)]}
            scale = {"yscale": "log", "ylim": (0.1, 1000), "ylabel": "object MAE, mm"}
            panels.append(Panel(f"{name}, {axis.unit}", lines, {**ticks, **scale}))
    return chart(panels, 4, (3.3, 2.9))
