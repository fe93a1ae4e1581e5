"""Pictures of a report: a figure of the errors and of a stated uncertainty, and the panels of a sample."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.evaluation.report.html import data_uri, millimetres
from fpp_ml_bench.evaluation.result.parts import Uncertainty
from fpp_ml_bench.loaders.pictures import Panel
from fpp_ml_bench.style import DEPTH_COLOURS, ERROR_COLOURS, FRAME_COLOURS, SIGMA_COLOURS, figure, figure_png, styled


@styled
def errors_figure(errors_mm: Sequence[float], block: Uncertainty | None) -> str:
    """PNG as a data URI: the object MAE in mm of every sample, ascending, and of a stated uncertainty how much of the
    object lies within the interval that should hold a share of it, and the error of the rest when the least sure pixels
    are left out."""
    plots: list[tuple[str, str, Any, dict[str, list[float]]]] = [
        ("sample", "object MAE, mm", range(1, len(errors_mm) + 1), {"": sorted(errors_mm)})
    ]
    if block is not None and (reliability := block.reliability) is not None:
        lines = {"as stated": reliability.nominal, "observed": reliability.observed}
        plots.append(("nominal coverage", "observed coverage", reliability.nominal, lines))
    if block is not None and (curves := block.sparsification) is not None:
        lines = {"best order": curves.best_mae_mm, "by sigma": curves.mae_mm}
        plots.append(("share of object pixels left out", "MAE of the rest, mm", curves.left_out, lines))
    drawn = figure(4.4 * len(plots), 3.4)
    for axes, (across, up, places, lines) in zip(drawn.subplots(1, len(plots), squeeze=False)[0], plots, strict=True):
        for number, (title, values) in enumerate(lines.items()):
            axes.plot(places, values, "--" if number == 0 and title else ".-", label=title)
        axes.set(xlabel=across, ylabel=up)
        if len(lines) > 1:
            axes.legend()
    return figure_uri(drawn)


CLIP_PERCENTILE = 95
"""Where the paper clips its error maps (figures of Section 6); here it is the percentile over the object pixels."""


def sample_panels(
    fringe: NDArray[np.uint8], target_mm: NDArray[np.floating], prediction_mm: NDArray[np.floating]
) -> list[Panel]:
    """The five panels of a sample; all maps (H, W), depth in mm with 0 = background, which is not drawn (NaN)."""
    inside, predicted = object_mask(np.asarray(target_mm)), np.asarray(prediction_mm) > 0
    error_mm = np.asarray(prediction_mm, np.float64) - target_mm
    object_depth = target_mm[inside] if inside.any() else np.zeros(1)
    low, high = float(object_depth.min()), float(object_depth.max())
    clip = float(np.percentile(np.abs(error_mm[inside if inside.any() else ...]), CLIP_PERCENTILE))
    drawn_mm = np.where(inside | predicted, error_mm, np.nan)
    return [
        ("Fringe", fringe, FRAME_COLOURS, 0, 255),
        ("Truth, mm", np.where(inside, target_mm, np.nan), DEPTH_COLOURS, low, high),
        ("Prediction, mm", np.where(predicted, prediction_mm, np.nan), DEPTH_COLOURS, low, high),
        (f"Absolute error, to {millimetres(clip)} mm", np.abs(drawn_mm), SIGMA_COLOURS, 0.0, clip),
        (f"Signed error, to {millimetres(clip)} mm", drawn_mm, ERROR_COLOURS, -clip, clip),
    ]


def figure_uri(drawn: Figure) -> str:
    """A figure as PNG, as a data URI."""
    return data_uri(figure_png(drawn))
