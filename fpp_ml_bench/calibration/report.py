"""The residuals of a calibration as a picture."""

from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np

from fpp_ml_bench.calibration.result import Calibration

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_residuals(calibration: Calibration) -> bytes:
    """PNG of a calibration: for camera and projector the residuals by pose and the points in the image, and the RMS of
    each pose."""
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    poses = calibration.poses
    colours = colormaps["turbo"](np.linspace(0.05, 0.95, len(poses)))
    figure = Figure(figsize=(13, 8), layout="constrained", dpi=90)
    plots = figure.subplots(2, 3)
    for row, (name, device) in enumerate((("camera", calibration.camera), ("projector", calibration.projector))):
        scatter, cover = plots[row, 0], plots[row, 1]
        for pose, colour in zip(poses, colours, strict=True):
            errors = pose.projector_residuals_px if row else pose.camera_residuals_px
            pixels = pose.projector_px if row else pose.corners_px
            scatter.plot(*errors.T, ".", ms=3, color=colour, label=pose.name)
            cover.quiver(*pixels.T, *errors.T, color=colour, angles="xy", width=0.003)
        rms = calibration.projector_rms_px if row else calibration.camera_rms_px
        scatter.set(title=f"{name}: residuals, RMS {rms:.3f} px", xlabel="x, px", ylabel="y, px", aspect="equal")
        scatter.axhline(0, color="0.6", lw=0.6)
        scatter.axvline(0, color="0.6", lw=0.6)
        cover.set(
            title=f"{name}: points and residuals (enlarged)",
            xlabel="column, px",
            ylabel="row, px",
            aspect="equal",
            xlim=(-0.5, device.width - 0.5),
            ylim=(device.height - 0.5, -0.5),
        )
    _bars(plots[0, 2], calibration)
    plots[1, 2].axis("off")
    handles, labels = plots[0, 0].get_legend_handles_labels()
    plots[1, 2].legend(handles, labels, loc="upper left", ncols=1 + len(poses) // 20, fontsize=8, markerscale=3)
    picture = BytesIO()
    FigureCanvasAgg(figure).print_png(picture)
    return picture.getvalue()


def _bars(axes: "Axes", calibration: Calibration) -> None:
    """RMS of each pose in camera and projector, and held out; poses that spoil the fit are marked."""
    poses, place = calibration.poses, np.arange(len(calibration.poses))
    series = {
        "camera": [pose.camera_rms_px for pose in poses],
        "projector": [pose.projector_rms_px for pose in poses],
        "both, held out": [pose.held_out_rms_px for pose in poses],
    }
    for number, (label, values) in enumerate(series.items()):
        if np.isfinite(values).all():
            axes.bar(place + 0.27 * (number - 1), values, 0.27, label=label)
    marks = [pose.name + (" (!)" if pose.name in calibration.spoilers else "") for pose in poses]
    axes.set_xticks(place, marks, rotation=90 if len(poses) > 6 else 20, fontsize=7)
    axes.set(title="RMS by pose, (!) fits the others badly", ylabel="px")
    axes.legend(fontsize=8)
