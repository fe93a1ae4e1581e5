"""An object's clouds as a picture, coloured by their distance to the surface."""

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.views.placement import Points
from fpp_ml_bench.baselines.views.scores import FusedObject
from fpp_ml_bench.baselines.views.surface import Surface
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.loaders.render import turned

_TILE_PX, _TITLE_PX, _BAR_PX = 300, 26, 34
_WHOLE_MM = 10.0
"""Distance to the surface at the end of the colours."""
_SPAN = 2.4
"""Width of a tile in radii of the object, so that wrong orders beside it show."""
_TILT = np.deg2rad(25.0)


def clouds_png(fused: FusedObject) -> bytes:
    """A PNG with the clouds of an object's first view, of all views, and of all without contradicted pixels, seen from
    above and the side."""
    clouds = (("one view", fused.alone_m[0]), ("all views", fused.all_m), ("all views, consistent", fused.kept_m))
    tiles = [np.vstack([_title(title), _tile(cloud, fused.surface)]) for title, cloud in clouds]
    row = np.hstack(tiles)
    encoded, png = cv2.imencode(".png", np.vstack([row, _bar(row.shape[1])]))
    if not encoded:
        raise PredictionError(f"{fused.name}: the picture could not be encoded")
    return png.tobytes()


def _tile(points_m: Points, surface: Surface) -> NDArray[np.uint8]:
    """A cloud (k, 3) as BGR (tile, tile, 3), nearer points in front."""
    low, high = surface.samples_m.min(axis=0), surface.samples_m.max(axis=0)
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    tile = np.full((_TILE_PX, _TILE_PX, 3), 255, np.uint8)
    if not len(points_m):
        return tile
    x, y, z = turned(points_m - centre, 30.0).T
    y, z = y * np.cos(_TILT) - z * np.sin(_TILT), y * np.sin(_TILT) + z * np.cos(_TILT)
    column, row = (np.floor((axis / (_SPAN * radius) + 0.5) * _TILE_PX) for axis in (x, y))
    inside = (column >= 0) & (column < _TILE_PX - 1) & (row >= 0) & (row < _TILE_PX - 1)
    share = np.clip(surface.distances_mm(points_m[inside]) / _WHOLE_MM, 0, 1)
    colours = cv2.applyColorMap(np.round(255 * share).astype(np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0]
    order = np.argsort(-z[inside], kind="stable")  # far to near: of several values for a pixel the last one stays
    rows, columns = (axis[inside].astype(np.intp)[order] for axis in (row, column))
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        tile[rows + down, columns + right] = colours[order]
    return tile


def _title(text: str) -> NDArray[np.uint8]:
    head = np.full((_TITLE_PX, _TILE_PX, 3), 255, np.uint8)
    cv2.putText(head, text, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return head


def _bar(width: int) -> NDArray[np.uint8]:
    """The colours with the distances at their ends."""
    bar = np.full((_BAR_PX, width, 3), 255, np.uint8)
    ramp = np.linspace(0, 255, 256).astype(np.uint8)[None].repeat(12, axis=0)
    bar[10:22, 60:316] = cv2.applyColorMap(ramp, cv2.COLORMAP_VIRIDIS)
    for text, left in (("0 mm", 8), (f"{_WHOLE_MM:g} mm and more from the surface", 324)):
        cv2.putText(bar, text, (left, 21), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return bar
