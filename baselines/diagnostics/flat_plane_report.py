"""What the flat plane says, in words, the table, and the paper's figure for each outline."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fpp_ml_bench.baselines.diagnostics import figures
from fpp_ml_bench.baselines.diagnostics.probe import Cell, Figure, Table

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.diagnostics.flat_plane import Shown

FILE = "flat_plane.png"
PAPER_MEAN, PAPER_DISTANCE_M = 0.088, 1.8
FRAME, RECTANGLE = "fills the frame", "rectangle"
Row = Mapping[str, Any]


def _of(rows: Sequence[Row], outline: str) -> list[Row]:
    """Rows of one kind of outline; ``silhouette`` stands for all objects'."""
    plain = (FRAME, RECTANGLE)
    return [
        row for row in rows if row["outline"] == outline or (outline == "silhouette" and row["outline"] not in plain)
    ]


def summary(rows: Sequence[Row], control: Mapping[str, float], normalised: bool) -> str:
    """The share that collapsed in each outline, the mean at the paper's distance, and what the plane's distance is to
    the answer."""
    shares = {kind: float(np.mean([row["collapsed_share"] for row in _of(rows, kind)]))
              for kind in (RECTANGLE, FRAME, "silhouette")}  # fmt: skip
    facing = [row for row in _of(rows, RECTANGLE) if row["tilt_deg"] == [0.0, 0.0]]
    paper = next(row for row in facing if row["distance_m"] == PAPER_DISTANCE_M)
    told = (
        f"{paper['answer_mean']:.3f} of the range (paper: {PAPER_MEAN})" if normalised else f"{paper['mean_mm']:.0f} mm"
    )
    text = (
        f"Answered as background: {shares[RECTANGLE]:.0%} of a rectangular plane, {shares[FRAME]:.0%} of one that "
        f"fills the frame, {shares['silhouette']:.0%} of one in an object's outline; {control['collapsed_share']:.0%} "
        f"of real objects ({control['collapsed_share_true']:.0%} in truth). The rectangle at 1.8 m is answered with a "
        f"mean of {told}; spread {paper['answer_std']:.3g}, {paper['answer_min']:.3g} to {paper['answer_max']:.3g}."
    )
    if not normalised:
        means = ", ".join(f"{row['mean_mm']:.0f}" for row in facing)
        asked = ", ".join(f"{1000 * row['distance_m']:.0f}" for row in facing)
        text += f" Facing planes at {asked} mm are answered with means of {means} mm."
    return text


def tables(rows: Sequence[Row], control: Mapping[str, float], normalised: bool) -> list[Table]:
    """A row a plane; silhouettes as means over objects."""
    unit = "of range" if normalised else "mm"
    values = f"Least to most, {unit}"
    lines: list[list[Cell]] = []
    for kind in (FRAME, RECTANGLE, "silhouette"):
        seen = _of(rows, kind)
        for key in dict.fromkeys((row["distance_m"], *row["tilt_deg"]) for row in seen):
            group = [row for row in seen if (row["distance_m"], *row["tilt_deg"]) == key]
            mean = {
                name: float(np.mean([row[name] for row in group]))
                for name in group[0]
                if name.endswith(("_mm", "_share", "_mean", "_std"))
            }
            least, most = min(row["answer_min"] for row in group), max(row["answer_max"] for row in group)
            name = f"{kind}, {len(group)} objects" if kind == "silhouette" else kind
            lines.append(
                [name, f"{key[0]:g} m", f"{key[1]:g}, {key[2]:g}", mean["answer_mean"], mean["answer_std"],
                 f"{least:.4g} to {most:.4g}", mean["collapsed_share"], mean["mean_mm"], mean["std_mm"],
                 mean["true_std_mm"], mean["mae_mm"]]
            )  # fmt: skip
    share: list[list[Cell]] = [["real objects, answered", control["collapsed_share"]],
                               ["real objects, in truth", control["collapsed_share_true"]]]  # fmt: skip
    return [
        Table(
            "Answers to planes" + (", mm by the mean range of the test split" if normalised else ""),
            ("Outline", "Distance", "Tilt, degrees", f"Mean, {unit}", f"Spread, {unit}", values,
             "Collapsed", "Mean, mm", "Spread, mm", "True spread, mm", "MAE, mm"),
            lines,
        ),
        Table("Share that reads as background: the control", ("What", "Share"), share),
    ]  # fmt: skip


def draw(planes: "Sequence[Shown]", normalised: bool, folder: Path) -> list[Figure]:
    """The paper's figure, input and answer, for each outline at 1.8 m, and the answer along the middle row."""
    facing = [one for one in planes if one.distance_m == PAPER_DISTANCE_M and one.tilt_deg == (0.0, 0.0)]
    chosen = [next(one for one in facing if one.outline == kind) for kind in (FRAME, RECTANGLE)]
    chosen += [one for one in facing if one.outline not in (FRAME, RECTANGLE)][:1]
    figure, axes = figures.drawing(2, len(chosen) + 1, 11, 5.2, width_ratios=[1] * len(chosen) + [1.5])
    low, high = (-0.2, 1.2) if normalised else (0.0, 2400.0)
    unit = "share of range" if normalised else "mm"
    for place, one in enumerate(chosen):
        values = one.answer[one.mask]
        figures.picture(axes[0, place], one.frame, f"{one.outline}\n{one.distance_m:g} m", low=0, high=255)
        digits = 2 if normalised else 0
        least, most, mean = (f"{value:.{digits}f}" for value in (values.min(), values.max(), values.mean()))
        title = f"answer over the plane:\n{least} to {most}, mean {mean}"
        drawn = figures.picture(axes[1, place], one.answer, title, "viridis", low, high)
    figure.colorbar(drawn, ax=axes[1, : len(chosen)], fraction=0.05, pad=0.02, label=unit).ax.tick_params(labelsize=7)
    _against_distance(axes[0, -1], planes, normalised)
    _spread(axes[1, -1], chosen, unit, (low, high))
    figures.save_png(figure, folder / FILE)
    said = "Fringes on planes in three outlines, the answers, their means against the distance, and their spread"
    return [Figure("Flat planes", FILE, said)]


def _against_distance(axis: Any, planes: "Sequence[Shown]", normalised: bool) -> None:
    for kind, mark in ((FRAME, "o"), (RECTANGLE, "s"), ("silhouette", "^")):
        points: dict[float, list[float]] = {}
        for one in planes:
            same = one.outline == kind or (kind == "silhouette" and one.outline not in (FRAME, RECTANGLE))
            if same and one.tilt_deg == (0.0, 0.0):
                points.setdefault(one.distance_m, []).append(float(one.answer[one.mask].mean(dtype=np.float64)))
        scale = 1.0 if normalised else 1000.0
        axis.plot(
            list(points), [np.mean(values) / scale for values in points.values()], mark + "-", markersize=5, label=kind
        )
    if not normalised:
        ends = [one.distance_m for one in planes]
        axis.plot([min(ends), max(ends)], [min(ends), max(ends)], color="#191c20", linewidth=0.8, label="true")
    figures.tidy(axis, "Mean answer of a facing plane", "distance, m", "share of range" if normalised else "m")
    axis.legend(fontsize=7, frameon=False)


def _spread(axis: Any, chosen: "Sequence[Shown]", unit: str, limits: tuple[float, float]) -> None:
    bins = np.linspace(*limits, 57)
    for one in chosen:
        values = np.clip(one.answer[one.mask], *limits)
        axis.hist(values, bins, histtype="step", weights=np.full(values.size, 1 / values.size), label=one.outline)
    figures.tidy(axis, "Answers at 1.8 m (ends: beyond)", unit, "share of pixels")
    axis.legend(fontsize=7, frameon=False)
