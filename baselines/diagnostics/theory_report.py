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
    twins, curves = values["twins"], {one["name"]: one for one in values["curves"]}
    small = next(iter(curves.values()))
    away, both = curves["one period, away"], curves["one period, mean of both"]
    return (
        f"{twins['sample']} and a surface {twins['depth_apart_mean_mm']:.0f} mm from it on every ray give the same "
        f"{twins['direction']} fringe: {twins['differing_pixels']} of the image's pixels differ (the frame of the "
        f"other direction: {twins['differing_pixels_other_direction']}). The depth error of a small mistake grows with "
        f"exponent {small['exponent']:.3f} over {_span(small['fitted_m'])}. A whole period is no small mistake on this "
        f"rig: within 1% the exponent is 2 {_where(away['quadratic_m'])} for an error away from the camera, and "
        f"{_where(both['quadratic_m'])} for the mean of both sides."
    )


def _span(ends: Sequence[float]) -> str:
    return f"{ends[0]:.2g} to {ends[1]:.2g} m"


def _where(ends: Sequence[float] | None) -> str:
    return "nowhere from 0.3 m on" if ends is None else f"from {_span(ends)}"


def tables(values: Mapping[str, Any], curves: "Sequence[ErrorCurve]") -> list[Table]:
    """Exponents, and errors at some distances."""
    rows: list[list[Cell]] = [
        [one.name, one.exponent, _span(one.fitted_m), "-" if (span := one.quadratic_m()) is None else _span(span)]
        for one in curves
    ]
    errors: list[list[Cell]] = []
    for one in curves:
        at = [float(np.interp(np.log(z), np.log(one.distances_m), one.error_mm)) for z in _SHOWN_M]
        errors.append([one.name, *("no depth" if not np.isfinite(value) else f"{value:.4g}" for value in at)])
    twins = values["twins"]
    same: list[list[Cell]] = [
        ["pixels of the object", twins["object_pixels"]],
        ["depth between the two, mean, mm", twins["depth_apart_mean_mm"]],
        ["pixels that differ, with noise", twins["differing_pixels"]],
        ["pixels that differ, without noise", twins["differing_pixels_noiseless"]],
        ["pixels that differ in the other direction's frame", twins["differing_pixels_other_direction"]],
        ["paint on the brighter one, least share of its light", twins["paint_least"]],
    ]
    return [
        Table("Two scenes, one frame", ("What", "Value"), same),
        Table(
            "Exponent of distance in the depth error",
            ("Mistake", "Fitted exponent", "Fitted over", "Within 1% of 2"),
            rows,
        ),
        Table("Depth error, mm", ("Mistake", *(f"{z:g} m" for z in _SHOWN_M)), errors),
    ]


def draw(twins: "Twins", curves: "Sequence[ErrorCurve]", folder: Path) -> list[Figure]:
    """Both figures, written into ``folder``."""
    return [_twins(twins, folder), _curves(curves, folder)]


def _twins(twins: "Twins", folder: Path) -> Figure:
    figure, axes = figures.drawing(2, 4, 10, 5.0)
    seen = twins.depths_mm[0] > 0
    known = [depth[seen] for depth in twins.depths_mm]
    low, high = min(one.min() for one in known), max(one.max() for one in known)
    for line, (depth, frame, other) in enumerate(zip(twins.depths_mm, twins.frames, twins.others, strict=True)):
        name = "AB"[line]
        shown = figures.picture(
            axes[line, 0], np.where(seen, depth, np.nan), f"scene {name}: depth, mm", "viridis", low, high
        )
        figures.picture(axes[line, 1], frame, f"its {twins.direction} fringe", low=0, high=255)
        figures.picture(axes[line, 2], other, "its other direction", low=0, high=255)
        figure.colorbar(shown, ax=axes[line, 0], fraction=0.05, pad=0.03).ax.tick_params(labelsize=7)
    for line, (pair, what) in enumerate(((twins.frames, twins.direction), (twins.others, "other direction"))):
        apart = pair[1].astype(np.int64) - pair[0]
        title = f"B - A, {what}:\n{int((apart != 0).sum())} pixels differ"
        drawn = figures.picture(axes[line, 3], apart, title, "coolwarm", -60, 60)
    figure.colorbar(drawn, ax=axes[:, 3], fraction=0.05, pad=0.03, label="grey levels").ax.tick_params(labelsize=7)
    figures.save_png(figure, folder / TWINS_FILE)
    return Figure(
        "Two scenes, one frame", TWINS_FILE, "Two depths a period apart, their identical fringes, and their difference"
    )


def _curves(curves: "Sequence[ErrorCurve]", folder: Path) -> Figure:
    figure, axes = figures.drawing(1, 2, 10, 3.8)
    errors, exponents = axes[0]
    colours = (figures.EDGES, figures.DEPTH, figures.PHASE, figures.ORDER, figures.RAW)
    for one, colour in zip(curves, colours, strict=True):
        known = np.isfinite(one.error_mm)
        errors.loglog(one.distances_m[known], one.error_mm[known], color=colour, label=one.name, linewidth=1.4)
        exponents.semilogx(one.distances_m, one.local, color=colour, linewidth=1.4)
    exponents.axhspan(1.98, 2.02, color="#dfe1e5")
    exponents.text(0.31, 2.2, "grey: 2 within 1%", fontsize=7)
    exponents.set_ylim(1.0, 3.5)
    figures.tidy(errors, "Depth error of a mistake", "distance, m", "mm")
    figures.tidy(exponents, "Local exponent of distance", "distance, m")
    for axis in (errors, exponents):
        axis.axvspan(1.5, 2.1, color="#f0e6d2", zorder=0)
        axis.set_xticks([0.3, 1, 3, 10], ["0.3", "1", "3", "10"])
        axis.minorticks_off()
    errors.legend(fontsize=7, frameon=False)
    errors.text(1.53, errors.get_ylim()[0] * 1.3, "working\nrange", fontsize=7)
    figures.save_png(figure, folder / CURVES_FILE)
    return Figure(
        "Depth error against distance", CURVES_FILE, "Depth error of a phase mistake from 0.3 to 10 m, and its exponent"
    )
