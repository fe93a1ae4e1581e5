"""Which pixels of a view the other views contradict, without ground truth.

Each point is looked for in every other view. A view supports the point if it answers about the same depth there. It
sees through the point if it answers a larger depth there, or no object at all. A point behind an answered surface is
hidden, and the view says nothing about it. A pixel is contradicted if a view sees through its point and no view
supports it. So a wrong order that puts its point on another side of the object, where some view supports it, is missed.

Two more rules found no more on the validation split: to flag points that all other views hide, and to flag points
behind a surface that two other views agree on; the latter doubled the false alarms.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.views.placement import PlacedView
from fpp_ml_bench.constants import FULL_SIZE

TOLERANCE_MM = 20.0
"""Depths that differ by less agree: far above the noise of any method, far below half an order (150 mm). Of 5 to 40 mm,
chosen on the validation split."""
_REACH_PX = 2
"""At 960 px: a view's answers this many pixels around a point are compared with it, which forgives silhouettes."""

Flags = NDArray[np.bool_]


def contradicted(views: Sequence[PlacedView], tolerance_mm: float = TOLERANCE_MM) -> list[Flags]:
    """For each view its contradicted ``pixels``, bool (n,). One view contradicts nothing."""
    ranges = [_answer_range(view) for view in views]
    flags = []
    for view in views:
        supported, seen_through = (np.zeros(view.pixels.size, dtype=bool) for _ in range(2))
        for other, (nearest, farthest) in zip(views, ranges, strict=True):
            if other is view:
                continue
            u, v, z = other.seen(view.points_m)
            inside = (u > -0.5) & (u < other.camera.width - 0.5) & (v > -0.5) & (v < other.camera.height - 0.5)
            column, row = (np.rint(axis[inside]).astype(np.intp) for axis in (u, v))
            near, far, depth = nearest[row, column], farthest[row, column], z[inside]
            supported[inside] |= (depth >= near - tolerance_mm) & (depth <= far + tolerance_mm)
            seen_through[inside] |= depth < near - tolerance_mm
        flags.append(seen_through & ~supported)
    return flags


def _answer_range(view: PlacedView) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The nearest and the farthest answer around each pixel, (H, W) in mm. Without an answer they are inf and -inf, or
    both -inf in a hole, which an outline encloses: there the object is not background, but has no answer."""
    answered = view.depth_mm > 0
    reach = max(1, round(_REACH_PX * view.camera.width / FULL_SIZE))
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    depth = view.depth_mm.astype(np.float64)
    nearest = np.asarray(cv2.erode(np.where(answered, depth, np.inf), window), np.float64)
    farthest = np.asarray(cv2.dilate(np.where(answered, depth, -np.inf), window), np.float64)
    nearest[np.isinf(nearest) & _enclosed(answered)] = -np.inf
    return nearest, farthest


def _enclosed(answered: Flags) -> Flags:
    """Pixels without an answer from which no path of such pixels leads to the image's border."""
    framed = np.pad((~answered).astype(np.uint8), 1, constant_values=1)
    _, labels = cv2.connectedComponents(framed, connectivity=4, ltype=cv2.CV_32S)
    return ((labels != labels[0, 0]) & (framed > 0))[1:-1, 1:-1]
