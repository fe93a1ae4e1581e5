"""Summary of the flat-plane probe, its tables, and the paper's figure for each outline."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fpp_ml_bench.baselines.diagnostics import figures
from fpp_ml_bench.baselines.diagnostics.probe import Cell, Figure, Table

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.diagnostics.flat_plane import PlanePrediction

FILE = "flat_plane.png"
PAPER_MEAN, PAPER_DISTANCE_M = 0.088, 1.8
FRAME, RECTANGLE = "fills the frame", "rectangle"
Row = Mapping[str, Any]


def _of(rows: Sequence[Row], outline: str) -> list[Row]:
    """Rows of a kind of outline; ``silhouette`` means those of all objects."""
    plain = (FRAME, RECTANGLE)
    return [
        row for row in rows if row["outline"] == outline or (outline == "silhouette" and row["outline"] not in plain)
    ]


def summary(rows: Sequence[Row], control: Mapping[str, float], normalised: bool) -> str:
    """The share that collapsed in each outline, the mean prediction at the paper's distance, and for mm the means at
    all distances."""
    shares = {kind: float(np.mean([row["collapsed_share"] for row in _of(rows, kind)]))
              for kind in (RECTANGLE, FRAME, "silhouette")}  # fmt: skip
    facing = [row for row in _of(rows, RECTANGLE) if row["tilt_deg"] == [0.0, 0.0]]
    paper = next(row for row in facing if row["distance_m"] == PAPER_DISTANCE_M)
    mean_text = (
        f"{paper['answer_mean']:.3f} of the range (paper: {PAPER_MEAN})" if normalised else f"{paper['mean_mm']:.0f} mm"
    )
    text = (
        f"Predicted as background: {shares[RECTANGLE]:.0%} of a rectangular plane, {shares[FRAME]:.0%} of a plane that "
        f"fills the frame, {shares['silhouette']:.0%} of a plane in an object's outline; "
        f"{control['collapsed_share']:.0%} of real objects ({control['collapsed_share_true']:.0%} in truth). The "
        f"prediction for the rectangle at 1.8 m has a mean of {mean_text} and a spread of {paper['answer_std']:.3g}, "
        f"from {paper['answer_min']:.3g} to {paper['answer_max']:.3g}."
    )
    if not normalised:
        means = ", ".join(f"{row['mean_mm']:.0f}" for row in facing)
        distances = ", ".join(f"{1000 * row['distance_m']:.0f}" for row in facing)
        text += f" Facing planes at {distances} mm are predicted with means of {means} mm."
    return text


def tables(rows: Sequence[Row], control: Mapping[str, float], normalised: bool) -> list[Table]:
    """A row per plane; silhouettes as means over objects."""
    unit = "of range" if normalised else "mm"
    values = f"Least to most, {unit}"
    lines: list[list[Cell]] = []
    for kind in (FRAME, RECTANGLE, "silhouette"):
        kind_rows = _of(rows, kind)
        for key in dict.fromkeys((row["distance_m"], *row["tilt_deg"]) for row in kind_rows):
            same_pose = [row for row in kind_rows if (row["distance_m"], *row["tilt_deg"]) == key]
            mean = {
                name: float(np.mean([row[name] for row in same_pose]))
                for name in same_pose[0]
                if name.endswith(("_mm", "_share", "_mean", "_std"))
            }
            least, most = min(row["answer_min"] for row in same_pose), max(row["answer_max"] for row in same_pose)
            name = f"{kind}, {len(same_pose)} objects" if kind == "silhouette" else kind
            lines.append(
                [name, f"{key[0]:g} m", f"{key[1]:g}, {key[2]:g}", mean["answer_mean"], mean["answer_std"],
                 f"{least:.4g} to {most:.4g}", mean["collapsed_share"], mean["mean_mm"], mean["std_mm"],
                 mean["true_std_mm"], mean["mae_mm"]]
            )  # fmt: skip
    share: list[list[Cell]] = [["real objects, predicted", control["collapsed_share"]],
                               ["real objects, in truth", control["collapsed_share_true"]]]  # fmt: skip
    return [
        Table(
            "Predictions for planes" + (", mm by the mean range of the test split" if normalised else ""),
            ("Outline", "Distance", "Tilt, degrees", f"Mean, {unit}", f"Spread, {unit}", values,
             "Collapsed", "Mean, mm", "Spread, mm", "True spread, mm", "MAE, mm"),
            lines,
        ),
        Table("Share of background: the control", ("Pixels of", "Share"), share),
    ]  # fmt: skip


def draw(planes: "Sequence[PlanePrediction]", normalised: bool, folder: Path) -> list[Figure]:
    """The paper's figure, input and prediction, for each outline at 1.8 m, and the distribution of the predictions."""
    facing = [plane for plane in planes if plane.distance_m == PAPER_DISTANCE_M and plane.tilt_deg == (0.0, 0.0)]
    examples = [next(plane for plane in facing if plane.outline == kind) for kind in (FRAME, RECTANGLE)]
    examples += [plane for plane in facing if plane.outline not in (FRAME, RECTANGLE)][:1]
    figure, axes = figures.drawing(2, len(examples) + 1, 11, 5.2, width_ratios=[1] * len(examples) + [1.5])
    low, high = (-0.2, 1.2) if normalised else (0.0, 2400.0)
    unit = "share of range" if normalised else "mm"
    for column, plane in enumerate(examples):
        values = plane.prediction[plane.mask]
        figures.picture(axes[0, column], plane.frame, f"{plane.outline}\n{plane.distance_m:g} m", low=0, high=255)
        digits = 2 if normalised else 0
        least, most, mean = (f"{value:.{digits}f}" for value in (values.min(), values.max(), values.mean()))
        title = f"prediction over the plane:\n{least} to {most}, mean {mean}"
        image = figures.picture(axes[1, column], plane.prediction, title, "viridis", low, high)
    figure.colorbar(image, ax=axes[1, : len(examples)], fraction=0.05, pad=0.02, label=unit).ax.tick_params(labelsize=7)
    _against_distance(axes[0, -1], planes, normalised)
    _spread(axes[1, -1], examples, unit, (low, high))
    figures.save_png(figure, folder / FILE)
    description = (
        "Fringes on planes in three outlines, the predictions, their means against the distance, and their spread"
    )
    return [Figure("Flat planes", FILE, description)]


def _against_distance(axis: Any, planes: "Sequence[PlanePrediction]", normalised: bool) -> None:
    for kind, mark in ((FRAME, "o"), (RECTANGLE, "s"), ("silhouette", "^")):
        points: dict[float, list[float]] = {}
        for plane in planes:
            matches = plane.outline == kind or (kind == "silhouette" and plane.outline not in (FRAME, RECTANGLE))
            if matches and plane.tilt_deg == (0.0, 0.0):
                points.setdefault(plane.distance_m, []).append(
                    float(plane.prediction[plane.mask].mean(dtype=np.float64))
                )
        scale = 1.0 if normalised else 1000.0
        axis.plot(
            list(points), [np.mean(values) / scale for values in points.values()], mark + "-", markersize=5, label=kind
        )
    if not normalised:
        ends = [plane.distance_m for plane in planes]
        axis.plot([min(ends), max(ends)], [min(ends), max(ends)], color="#191c20", linewidth=0.8, label="true")
    figures.tidy(axis, "Mean prediction of a facing plane", "distance, m", "share of range" if normalised else "m")
    axis.legend(fontsize=7, frameon=False)


def _spread(axis: Any, examples: "Sequence[PlanePrediction]", unit: str, limits: tuple[float, float]) -> None:
    bins = np.linspace(*limits, 57)
    for plane in examples:
        values = np.clip(plane.prediction[plane.mask], *limits)
        axis.hist(values, bins, histtype="step", weights=np.full(values.size, 1 / values.size), label=plane.outline)
    figures.tidy(axis, "Predictions at 1.8 m (end bins: beyond)", unit, "share of pixels")
    axis.legend(fontsize=7, frameon=False)
