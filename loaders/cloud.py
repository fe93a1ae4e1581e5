"""A depth map as a point cloud to look at: a PLY file, and an HTML page that draws the points in
any browser.

The page contains its points, style and script, and loads nothing: it works from a mail or without a
network.
"""

from base64 import b64encode
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.errors import CaptureError
from fpp_ml_bench.files import printable, write_files
from fpp_ml_bench.loaders.captures.exports import camera_points, depth_ply
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.style import DEPTH_COLOURS, page

MOST_POINTS = 150_000
"""Drawn by the page: a phone turns so many smoothly, and the file stays below 1.5 MB."""
_STEPS = 65535
"""Steps of a position along the longest side of the box around the points."""
_ENDS = 0.01, 0.99
"""The colours of depth span these quantiles, and the view is centred between them: a few wrong
points can't squeeze the rest into one colour."""


def cloud_html(title: str, points_mm: NDArray[np.floating], grey: NDArray[np.uint8]) -> bytes:
    """An HTML page that draws ``points_mm`` (N, 3), camera coordinates in mm (x right, y down, z
    forward), with their grey levels uint8 (N,). Of more than `MOST_POINTS` it draws every k-th, and
    says so. Positions are rounded to 1/65535 of the longest side of the box around them. Raises
    `CaptureError` for no point, points that are not finite, or grey levels of another length or
    dtype."""
    from matplotlib import colormaps

    points, count = np.asarray(points_mm, dtype=np.float64), len(points_mm)
    if points.shape != (count, 3) or not count or not np.isfinite(points).all():
        raise CaptureError(
            f"points_mm: expected finite points of shape (N, 3), N > 0, got shape {points.shape}"
        )
    if grey.shape != (count,) or grey.dtype != np.uint8:
        raise CaptureError(
            f"grey: expected uint8 of shape ({count},), got {grey.dtype} of shape {grey.shape}"
        )
    every = -(-count // MOST_POINTS)
    points, shown = points[::every], grey[::every]
    first = points.min(axis=0)
    step_mm = float(np.ptp(points, axis=0).max()) / _STEPS or 1.0
    ends = np.quantile(points, _ENDS, axis=0)
    colours = colormaps[DEPTH_COLOURS](np.arange(256), bytes=True)[:, :3]
    data = {
        "places": _text(np.rint((points - first) / step_mm).astype("<u2")),
        "greys": _text(shown),
        "colours": _text(colours),
        "first_mm": first.tolist(),
        "step_mm": step_mm,
        "ends_mm": ends.tolist(),
        "white": max(float(np.quantile(shown, _ENDS[1])), 1.0),
    }
    here, title = Path(__file__).parent / "templates", printable(title)
    style, script = (
        (here / name).read_text(encoding="utf-8") for name in ("cloud.css", "cloud.js")
    )
    values: dict[str, Any] = {"count": count, "shown": len(points), "every": every, "data": data}
    return page("fpp_ml_bench.loaders", "cloud.html", title, style, script, **values)


def _text(values: NDArray) -> str:
    return b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


def write_cloud(
    folder: Path, name: str, title: str, rig: Rig, depth_mm: ArrayLike, grey: ArrayLike
) -> list[Path]:
    """Write ``name.ply`` and ``name.html`` into ``folder``, which is made if it is missing; returns
    their paths.

    The points are those of a depth map (H, W) in mm, measured or predicted, 0 = none, seen by the
    camera of ``rig``; ``grey`` (H, W): grey levels of 0 to 255. Raises `CaptureError` for a map
    without any depth, with values that are negative or not finite, or of another size than the
    camera's, and for a folder that can't be written."""
    points_mm, there = camera_points(depth_mm, rig.camera)
    ply = depth_ply(depth_mm, rig.camera, grey)
    levels = np.clip(np.rint(np.asarray(grey)[there]), 0, GREY_LEVELS).astype(np.uint8)
    contents = {f"{name}.ply": ply, f"{name}.html": cloud_html(title, points_mm, levels)}
    return write_files(folder, contents, CaptureError)
