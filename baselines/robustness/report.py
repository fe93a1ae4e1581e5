"""The page of all methods measured below a folder: curves by axis, a table, and the scenes that went worst."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.robustness.axes import CLEAN, corruptions
from fpp_ml_bench.baselines.robustness.run import Setup, View, read_axis
from fpp_ml_bench.baselines.robustness.scenes import Condition, FrameCache
from fpp_ml_bench.baselines.robustness.scores import mean_scores
from fpp_ml_bench.evaluation.report import data_uri, page, render
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

    @property
    def mae_mm(self) -> float | None:
        return self.mean("mae_mm")

    def axis_mae_mm(self, axis: str) -> float | None:
        """Mean over the severities of an axis that were measured."""
        return _mean([scores["mae_mm"] for scores in self.means.get(axis, {}).values()])

    def mean(self, key: str) -> float | None:
        """Mean of a score over all axes and severities that were measured."""
        found = [s[key] for axis, by in self.means.items() if axis != CLEAN for s in by.values()]
        return _mean(found)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known and len(known) == len(values) else None


def read_measured(out: Path) -> list[Measured]:
    """Every method below ``out``, the best first. PredictionError for a damaged file."""
    found = []
    for folder in sorted(path for path in out.iterdir() if path.is_dir()):
        files = [folder / f"{axis}.json" for axis in (CLEAN, *corruptions().axes)]
        contents = [content for file in files if (content := read_axis(file)) is not None]
        if contents:
            means = {content["axis"]: _means(content["views"]) for content in contents}
            found.append(Measured(folder, contents[0]["setup"], means))
    return sorted(found, key=lambda one: (one.mae_mm is None, one.mae_mm or 0.0))


def _means(views: Sequence[View]) -> dict[int, dict[str, float | None]]:
    severities = sorted({row["severity"] for row in views})
    return {s: mean_scores([row for row in views if row["severity"] == s]) for s in severities}


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
    """A plot for each axis: mean error against severity, a line a method; PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    axes = {name: axis for name, axis in corruptions().axes.items() if any(name in one.means for one in measured)}
    columns = 4
    rows = max(-(-len(axes) // columns), 1)
    figure, plots = plt.subplots(rows, columns, figsize=(13, 2.9 * rows), squeeze=False, layout="constrained")
    for plot, (name, axis) in zip(plots.flat, axes.items(), strict=False):
        for number, one in enumerate(measured):
            if name not in one.means:
                continue
            points = {0: one.means.get(CLEAN, {}).get(0, {}), **one.means[name]}
            drawn = {s: scores["mae_mm"] for s, scores in points.items() if scores.get("mae_mm") is not None}
            label = one.setup["title"] + (", unseen" if one.setup["set"] == "unseen" else "")
            label += " (quick)" if one.setup["quick"] else ""
            colour, dashes = _COLOURS[number % len(_COLOURS)], _DASHES[number // len(_COLOURS) % len(_DASHES)]
            plot.plot(list(drawn), list(drawn.values()), "o", ls=dashes, ms=3, lw=1.3, label=label, color=colour)
        plot.set_yscale("log")
        plot.set_ylim(0.1, 1000)
        plot.set_xticks(range(6), ["clean", *(f"{value:g}" for value in axis.severities)], fontsize=7)
        plot.tick_params(axis="y", labelsize=7)
        plot.set_title(f"{name}, {axis.unit}", fontsize=9)
        plot.axhline(corruptions().unanswered_mm, color="0.6", lw=0.8, ls=":")
        plot.grid(alpha=0.25)
    for plot in list(plots.flat)[len(axes) :]:
        plot.axis("off")
    for plot in plots[:, 0]:
        plot.set_ylabel("object MAE, mm", fontsize=8)
    handles, labels = plots.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    return _png(figure)


def write_worst(setup: Setup, rows: dict[str, list[View]], out: Path, cache: Path | None) -> None:
    """The scenes in which the method is worst, one for each of its worst axes: frame, depth, error; PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    last = {axis: [row for row in found if row["severity"] == max(setup.severities)] for axis, found in rows.items()}
    worst = [
        max(found, key=lambda row: row["mae_mm"] or 0.0) | {"axis": axis}
        for axis, found in last.items()
        if axis != CLEAN and found
    ]
    worst = sorted(worst, key=lambda row: -(row["mae_mm"] or 0.0))[:_SHOWN_WORST]
    if not worst:
        return
    figure, plots = plt.subplots(3, len(worst), figsize=(3.2 * len(worst), 8.6), squeeze=False, layout="constrained")
    images, clean = FrameCache(cache), setup.conditions(CLEAN)[0]
    for column, row in zip(plots.T, worst, strict=True):
        name, view = row["object"], row["sample"].removeprefix(f"{row['object']}_")
        objects = setup.conditions(row["axis"])[0].objects
        condition = Condition(row["axis"], row["severity"], objects, setup.size, setup.rig)
        frames, truth = images.frames(condition, name, view, setup.method.frames_used), images.truth(clean, name, view)
        depth_mm = setup.method.predict(frames)
        fringe = next(frame for frame in frames if frame is not None)
        error = np.where(truth.scored & (depth_mm > 0), np.abs(depth_mm - truth.depth_mm), np.nan)
        box = _box(truth.depth_mm)
        column[0].imshow(fringe[box], cmap="gray", vmin=0, vmax=255)
        column[0].set_title(
            f"{row['axis']} {corruptions().axes[row['axis']].severities[row['severity'] - 1]:g}\n"
            f"{row['sample']}, {row['mae_mm']:.1f} mm",
            fontsize=8,
        )
        low, high = condition.settings.rig.working_range_mm
        column[1].imshow(np.where(depth_mm > 0, depth_mm, np.nan)[box], cmap="viridis", vmin=low, vmax=high)
        last_image = column[2].imshow(error[box], cmap="magma", vmin=0, vmax=corruptions().wrong_order_mm)
        for plot in column:
            plot.axis("off")
    figure.colorbar(last_image, ax=plots[2], shrink=0.8, label="error, mm", location="bottom")
    write_atomically(out / WORST, _png(figure))


def _box(depth_mm: NDArray[np.float32]) -> tuple[slice, slice]:
    rows, columns = np.nonzero(depth_mm)
    return slice(max(rows.min() - 20, 0), rows.max() + 20), slice(max(columns.min() - 20, 0), columns.max() + 20)


def _png(figure: Any) -> bytes:
    import matplotlib.pyplot as plt

    content = io.BytesIO()
    figure.savefig(content, dpi=90, format="png")
    plt.close(figure)
    return content.getvalue()
