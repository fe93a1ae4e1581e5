"""A calibration board as a flat sheet with a print, before the camera.

The print is a function of the place on the sheet, neither mesh nor picture. A pixel on one of its
edges is the mean of `EDGE_RAYS` x `EDGE_RAYS` rays, each as dark as the share of its own area that
is: a circle's grey levels then have their centroid where it should be, to a thousandth of a pixel
(`tests/render/test_photographed_boards.py`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.calibration.boards import Board
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import CalibrationError
from fpp_ml_bench.loaders.render.boards.poses import BoardPose, sheet_corners_mm
from fpp_ml_bench.loaders.render.illumination import LitPixels, Material, light_surface
from fpp_ml_bench.loaders.render.pixels import MixedPixels, at_borders
from fpp_ml_bench.loaders.render.raycast import Hits, TracedObject
from fpp_ml_bench.loaders.render.scene import SolidMesh, along_rays
from fpp_ml_bench.loaders.render.view import Studio, TracedView

DARK = 0.25
"""Albedo of the print, over that of the sheet. Fringes on it keep a modulation above the decoder's
limit of 5 grey levels in the named light `paper`, so circles are decoded inside too."""
EDGE_RAYS = 4
"""Rays along each side of a pixel that sees an edge of the print: with four, a circle's centroid is
right to a thousandth of a pixel."""
Values = NDArray[np.float64]
Footprint = tuple[Values, ...]
"""How x and y on the board, mm, change over the width of a ray's part of the image, and then over
its height: four."""


class OnBoard(NamedTuple):
    """Where n rays meet the board's plane: ``x_mm`` and ``y_mm`` on the board, ``depth_m``, NaN
    where they don't; and whether that is on its ``sheet``."""

    x_mm: Values
    y_mm: Values
    depth_m: Values
    sheet: NDArray[np.bool_]


@np.errstate(divide="ignore", invalid="ignore")
def meet(x: Values, y: Values, board: Board, pose: BoardPose) -> OnBoard:
    """Where rays (x, y, 1), any equal shapes, meet the board."""
    turn, (tx, ty, tz) = pose.rotation, pose.translation_m
    ax, ay, az = (row[2] for row in turn)  # the board's normal
    depth = (ax * tx + ay * ty + az * tz) / (ax * x + ay * y + az)
    depth = np.where(depth > 0, depth, np.nan)
    dx, dy, dz = depth * x - tx, depth * y - ty, depth - tz
    across, down = (
        (turn[0][i] * dx + turn[1][i] * dy + turn[2][i] * dz) * MM_PER_M for i in (0, 1)
    )
    (left, top), (right, bottom) = sheet_corners_mm(board)
    return OnBoard(
        across, down, depth, (across >= left) & (across <= right) & (down >= top) & (down <= bottom)
    )


def dark_share(board: Board, x_mm: Values, y_mm: Values, footprint: Footprint) -> Values:
    """Share of the print in the parts of the board that rays at (x, y) see, from 0 to 1; NaN for
    NaN. Along an edge its mean is exact: it is a ramp about the edge, as wide as the part seen."""
    spacing = board.spacing_mm
    if board.kind == "checker":
        inside, sign = np.ones_like(x_mm), np.ones_like(x_mm)
        axes = (
            (x_mm, board.columns, footprint[0], footprint[2]),
            (y_mm, board.rows, footprint[1], footprint[3]),
        )
        for place, count, across, down in axes:
            line = np.clip(np.rint(place / spacing), 0, count - 1)
            width = np.sqrt(across * across + down * down)
            parity = 1.0 - 2.0 * np.mod(line, 2)
            sign = sign * parity * (2.0 * _ramp(place - spacing * line, width) - 1.0)
            middle, half = (count - 1) / 2 * spacing, (count + 1) / 2 * spacing
            inside = inside * _ramp(half - np.abs(place - middle), width)
        return inside * (1.0 + sign) / 2
    row = np.clip(np.rint(y_mm / spacing), 0, board.rows - 1)
    first, step = (np.mod(row, 2), 2.0) if board.kind == "circles-asymmetric" else (0.0, 1.0)
    column = np.clip(np.rint((x_mm / spacing - first) / step), 0, board.columns - 1)
    dx, dy = x_mm - (first + step * column) * spacing, y_mm - row * spacing
    away = np.sqrt(dx * dx + dy * dy)
    over = np.maximum(away, 1e-9)
    across = (dx * footprint[0] + dy * footprint[1]) / over
    down = (dx * footprint[2] + dy * footprint[3]) / over
    return _ramp(board.radius_mm - away, np.sqrt(across * across + down * down))


def _ramp(inside: Values, width: Values) -> Values:
    """From 0 to 1 over ``width`` about the edge, ``inside`` of which is the distance into the
    dark."""
    return np.clip(inside / np.maximum(width, 1e-9) + 0.5, 0.0, 1.0)


def check_print(board: Board) -> None:
    """Raise `CalibrationError` for a board that can't be printed."""
    if board.kind == "charuco":
        raise CalibrationError(
            "board: charuco boards can't be photographed here; give checker or circles"
        )
    if board.kind != "checker" and not 0 < board.radius_mm < board.spacing_mm / 2:
        raise CalibrationError(
            f"board {board}: expected circles with a radius below half of the spacing "
            f"({board.spacing_mm / 2:g} mm), "
            f"got one of {board.radius_mm:g} mm"
        )


def board_view(
    studio: Studio, board: Board, pose: BoardPose, stream: tuple[object, ...]
) -> TracedView:
    """The board before the studio's camera, lit; ``stream`` names its noise. It is flat and matte,
    its white is the light's material, and it stands alone: it gets the projector's light and the
    lamps', no further bounces."""
    rig, light, camera = studio.rig, studio.light, studio.rig.camera
    place = meet(*camera.rays(), board, pose)
    (x_down, x_across), (y_down, y_across) = np.gradient(place.x_mm), np.gradient(place.y_mm)
    footprint = x_across, y_across, x_down, y_down
    # Over twice the pixel's part: strictly between 0 and 1 wherever an edge crosses the pixel.
    dark = dark_share(
        board, place.x_mm, place.y_mm, tuple(np.multiply(2.0, part) for part in footprint)
    )
    sheet = place.sheet
    edges = np.flatnonzero(
        at_borders(np.where(sheet, 1, -1)) | (sheet & (dark > 0) & (dark < 1)).ravel()
    )
    traced, facing = _outline(board, pose), -np.array([row[2] for row in pose.rotation])
    white = (1.0 - light.surface.gloss) * light.surface.albedo

    def lit(points_m: Values, normals: Values, print_share: Values) -> LitPixels:
        material = Material(white * (1.0 - (1.0 - DARK) * print_share), 0.0)
        return light_surface(
            points_m, normals, rig, light, studio.exposure.pattern, material, traced
        )

    pixels = np.flatnonzero(sheet)
    depth_m = place.depth_m.ravel()[pixels]
    x, y = (axis.ravel()[pixels] for axis in camera.rays())
    points_m = along_rays(x, y, depth_m)
    normals = np.tile(facing, (len(pixels), 1))
    hits = Hits(pixels, depth_m, normals, np.zeros(len(pixels), dtype=np.int32))
    board_light = lit(points_m, normals, dark.ravel()[pixels])

    count = EDGE_RAYS * EDGE_RAYS
    rows, columns = (axis[:, None] for axis in np.divmod(edges, camera.width))
    down, across = (
        (axis + 0.5) / EDGE_RAYS - 0.5 for axis in np.divmod(np.arange(count), EDGE_RAYS)
    )
    x, y = camera.normalised((columns + across).ravel(), (rows + down).ravel())
    place = meet(x, y, board, pose)
    upon = place.sheet
    parts = tuple(
        np.nan_to_num(np.repeat(part.ravel()[edges], count)) / EDGE_RAYS for part in footprint
    )
    print_share = np.where(upon, dark_share(board, place.x_mm, place.y_mm, parts), 0.0)
    points_m = along_rays(x, y, np.where(upon, place.depth_m, rig.background))
    normals = np.where(upon[:, None], facing, [0.0, 0.0, -1.0])
    covered = upon.reshape(-1, count).mean(axis=1)
    mixed = MixedPixels(
        edges, points_m, normals, np.where(upon, 0, -1).astype(np.int32), covered < 1, covered
    )
    return TracedView(
        traced,
        pose.translation_m[2],
        hits,
        board_light,
        mixed,
        lit(points_m, normals, print_share),
        studio.brightness(stream),
        stream,
    )


def _outline(board: Board, pose: BoardPose) -> TracedObject:
    """The sheet as two triangles, which cast its shadow."""
    (left, top), (right, bottom) = (
        np.array(corner) / MM_PER_M for corner in sheet_corners_mm(board)
    )
    corners = np.array(
        [[left, top, 0.0], [right, top, 0.0], [right, bottom, 0.0], [left, bottom, 0.0]]
    )
    mesh = SolidMesh("board", corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))
    return TracedObject(mesh, pose.points_m(corners))
