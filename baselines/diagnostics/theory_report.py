"""The two theorems in words, a table, and two figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fpp_ml_bench.baselines.diagnostics import figures
from fpp_ml_bench.baselines.diagnostics.probe import Cell, Figure, Table

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.diagnostics.theory import ErrorCurve, Twins

TWINS_FILE, CURVES_FILE = "theory_twins.png", "theory_range.png"
_SHOWN_M = (0.3, 1.0, 1.8, 3.0, 5.0, 10.0)


def summary(values: Mapping[str, Any]) -> str:
    """Both theorems with their numbers."""
    twins, curves = values["twins"], {curve["name"]: curve for curve in values["curves"]}
    small = next(iter(curves.values()))
    away, both = curves["one period, away"], curves["one period, mean of both"]
    return (
        f"{twins['sample']} and a surface {twins['depth_apart_mean_mm']:.0f} mm from it on average give the same "
        f"{twins['direction']} fringe: {twins['differing_pixels']} of the image's pixels differ (the frame of the "
        f"other direction: {twins['differing_pixels_other_direction']}). The depth error of a small phase error grows "
        f"with exponent {small['exponent']:.3f} over {_span(small['fitted_m'])}. For a whole period the exponent is 2 "
        f"within 1% {_where(away['quadratic_m'])} for an error away from the camera, and {_where(both['quadratic_m'])} "
        f"for the mean of both sides."
    )


def _span(ends: Sequence[float]) -> str:
    return f"{ends[0]:.2g} to {ends[1]:.2g} m"


def _where(ends: Sequence[float] | None) -> str:
    return "at no distance from 0.3 m" if ends is None else f"from {_span(ends)}"


def tables(values: Mapping[str, Any], curves: "Sequence[ErrorCurve]") -> list[Table]:
    """Exponents, and errors at some distances."""
    rows: list[list[Cell]] = [
        [
            curve.name,
            curve.exponent,
            _span(curve.fitted_m),
            "-" if (span := curve.quadratic_m()) is None else _span(span),
        ]
        for curve in curves
    ]
    errors: list[list[Cell]] = []
    for curve in curves:
        at = [float(np.interp(np.log(z), np.log(curve.distances_m), curve.error_mm)) for z in _SHOWN_M]
        errors.append([curve.name, *("no depth" if not np.isfinite(value) else f"{value:.4g}" for value in at)])
    twins = values["twins"]
    same: list[list[Cell]] = [
        ["pixels of the object", twins["object_pixels"]],
        ["depth between the two, mean, mm", twins["depth_apart_mean_mm"]],
        ["pixels that differ, with noise", twins["differing_pixels"]],
        ["pixels that differ, without noise", twins["differing_pixels_noiseless"]],
        ["pixels that differ in the other direction's frame", twins["differing_pixels_other_direction"]],
        ["least albedo factor on the brighter surface", twins["paint_least"]],
    ]
    return [
        Table("Two scenes, one frame", ("What", "Value"), same),
        Table(
            "Exponent of distance in the depth error",
            ("Phase error", "Fitted exponent", "Fitted over", "Within 1% of 2"),
            rows,
        ),
        Table("Depth error, mm", ("Phase error", *(f"{z:g} m" for z in _SHOWN_M)), errors),
    ]


def draw(twins: "Twins", curves: "Sequence[ErrorCurve]", folder: Path) -> list[Figure]:
    """Both figures, written into ``folder``."""
    return [_twins(twins, folder), _curves(curves, folder)]


def _twins(twins: "Twins", folder: Path) -> Figure:
    figure, axes = figures.drawing(2, 4, 10, 5.0)
    inside = twins.depths_mm[0] > 0
    depths = [depth[inside] for depth in twins.depths_mm]
    low, high = min(depth_mm.min() for depth_mm in depths), max(depth_mm.max() for depth_mm in depths)
    for row, (depth, frame, other_frame) in enumerate(
        zip(twins.depths_mm, twins.frames, twins.other_frames, strict=True)
    ):
        name = "AB"[row]
        image = figures.picture(
            axes[row, 0], np.where(inside, depth, np.nan), f"scene {name}: depth, mm", "viridis", low, high
        )
        figures.picture(axes[row, 1], frame, f"its {twins.direction} fringe", low=0, high=255)
        figures.picture(axes[row, 2], other_frame, "its other direction", low=0, high=255)
        figure.colorbar(image, ax=axes[row, 0], fraction=0.05, pad=0.03).ax.tick_params(labelsize=7)
    for row, (pair, direction) in enumerate(((twins.frames, twins.direction), (twins.other_frames, "other direction"))):
        difference = pair[1].astype(np.int64) - pair[0]
        title = f"B - A, {direction}:\n{int((difference != 0).sum())} pixels differ"
        difference_image = figures.picture(axes[row, 3], difference, title, "coolwarm", -60, 60)
    figure.colorbar(difference_image, ax=axes[:, 3], fraction=0.05, pad=0.03, label="grey levels").ax.tick_params(
        labelsize=7
    )
    figures.save_png(figure, folder / TWINS_FILE)
    return Figure(
        "Two scenes, one frame", TWINS_FILE, "Two depths a period apart, their identical fringes, and their difference"
    )


def _curves(curves: "Sequence[ErrorCurve]", folder: Path) -> Figure:
    figure, axes = figures.drawing(1, 2, 10, 3.8)
    errors, exponents = axes[0]
    colours = (figures.EDGES, figures.DEPTH, figures.PHASE, figures.ORDER, figures.RAW)
    for curve, colour in zip(curves, colours, strict=True):
        finite = np.isfinite(curve.error_mm)
        errors.loglog(curve.distances_m[finite], curve.error_mm[finite], color=colour, label=curve.name, linewidth=1.4)
        exponents.semilogx(curve.distances_m, curve.local, color=colour, linewidth=1.4)
    exponents.axhspan(1.98, 2.02, color="#dfe1e5")
    exponents.text(0.31, 2.2, "grey: 2 within 1%", fontsize=7)
    exponents.set_ylim(1.0, 3.5)
    figures.tidy(errors, "Depth error of a phase error", "distance, m", "mm")
    figures.tidy(exponents, "Local exponent of distance", "distance, m")
    for axis in (errors, exponents):
        axis.axvspan(1.5, 2.1, color="#f0e6d2", zorder=0)
        axis.set_xticks([0.3, 1, 3, 10], ["0.3", "1", "3", "10"])
        axis.minorticks_off()
    errors.legend(fontsize=7, frameon=False)
    errors.text(1.53, errors.get_ylim()[0] * 1.3, "working\nrange", fontsize=7)
    figures.save_png(figure, folder / CURVES_FILE)
    return Figure(
        "Depth error against distance", CURVES_FILE, "Depth error of a phase error from 0.3 to 10 m, and its exponent"
    )
