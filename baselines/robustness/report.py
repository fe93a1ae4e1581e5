"""The page of all methods measured below a folder: curves by axis, a table, and the scenes that went worst."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fpp_ml_bench.baselines.diagnostics.probe import Line, Panel, Picture, chart, gallery
from fpp_ml_bench.baselines.robustness.axes import CLEAN, corruptions, severity_means
from fpp_ml_bench.baselines.robustness.run import Setup, View, read_axis
from fpp_ml_bench.baselines.robustness.scenes import FrameCache
from fpp_ml_bench.evaluation.report.html import data_uri, page, render
from fpp_ml_bench.files import write_atomically

PAGE, CURVES, WORST = "index.html", "curves.png", "worst.png"
_SHOWN_WORST = 4
_COLOURS = (
    "#4269d0",
    "#efb118",
    "#ff725c",
    "#3ca951",
    "#a463f2",
    "#97bbf5",
    "#9c6b4e",
    "#6cc5b0",
    "#ff8ab7",
    "#9498a0",
)
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
    worst = [
        (one.setup["title"], data_uri((one.folder / WORST).read_bytes()))
        for one in measured
        if (one.folder / WORST).is_file()
    ]
    body = render(
        "fpp_ml_bench.baselines.robustness",
        "robustness.html",
        methods=measured,
        axes=corruptions().axes,
        rules=corruptions(),
        curves=data_uri(curves),
        worst=worst,
        clean=CLEAN,
    )
    write_atomically(out / PAGE, page("Robustness: FPP-ML-Bench", body).encode("utf-8"))
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
            style = "o" + _DASHES[number // len(_COLOURS) % len(_DASHES)]
            errors = [scores.get("mae_mm") for scores in points.values()]
            lines.append(Line(label, list(points), errors, _COLOURS[number % len(_COLOURS)], style))
        if lines:
            lines.append(Line("charge for no answer", range(6), [corruptions().unanswered_mm] * 6, "0.6", ":"))
            ticks = {"xticks": range(6), "xticklabels": ["clean", *(f"{value:g}" for value in axis.severities)]}
            scale = {"yscale": "log", "ylim": (0.1, 1000), "ylabel": "object MAE, mm"}
            panels.append(Panel(f"{name}, {axis.unit}", lines, {**ticks, **scale}))
    return chart(panels, 4, (3.3, 2.9))


def write_worst(setup: Setup, rows: dict[str, list[View]], out: Path, cache: Path | None) -> None:
    """The scenes in which the method is worst, one for each of its worst axes: frame, depth, error; PNG."""
    worst = [
        max((row for row in found if row["severity"] == max(setup.severities)), key=_error_mm) | {"axis": axis}
        for axis, found in rows.items()
        if axis != CLEAN and found
    ]
    images, clean = FrameCache(cache), setup.conditions(CLEAN)[0]
    low, high = clean.settings.rig.working_range_mm
    most = corruptions().wrong_order_mm
    titles: list[str] = []
    pictures: dict[str, list[Picture]] = {"captured": [], f"depth,\n{low:g} to\n{high:g} mm": []}
    pictures[f"error,\n0 to {most:g} mm"] = []
    for row in sorted(worst, key=_error_mm, reverse=True)[:_SHOWN_WORST]:
        name, view = row["object"], row["sample"].removeprefix(f"{row['object']}_")
        condition = next(c for c in setup.conditions(row["axis"]) if c.severity == row["severity"])
        frames, truth = images.frames(condition, name, view, setup.method.frames_used), images.truth(clean, name, view)
        depth_mm = setup.method.predict(frames)
        fringe = next(frame for frame in frames if frame is not None)
        error = np.where(truth.scored & (depth_mm > 0), np.abs(depth_mm - truth.depth_mm), np.nan)
        depth_mm = np.where(depth_mm > 0, depth_mm, np.nan)
        seen = np.nonzero(truth.depth_mm)
        box = tuple(slice(max(places.min() - 20, 0), places.max() + 20) for places in seen)
        severity = corruptions().axes[row["axis"]].severities[row["severity"] - 1]
        titles.append(f"{row['axis']} {severity:g}\n{row['sample']}, {row['mae_mm']:.1f} mm")
        shown = (
            Picture(fringe[box]),
            Picture(depth_mm[box], "viridis", low, high),
            Picture(error[box], "magma", 0, most),
        )
        for column, picture in zip(pictures.values(), shown, strict=True):
            column.append(picture)
    if titles:
        write_atomically(out / WORST, gallery(pictures, titles, 2.4))


def _error_mm(row: View) -> float:
    return row["mae_mm"] or 0.0
