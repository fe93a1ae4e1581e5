"""One point cloud from several views: the weighted mean of the points in each cell of a grid."""

from collections.abc import Sequence

import numpy as np

from fpp_ml_bench.baselines.views.placement import PlacedView, Points, Values
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import PredictionError

CELL_MM = 2.0
"""Edge of a cell: 2.5 pixels of the paper's rig at 960 px and its standoff."""
_REACH_CELLS = 1 << 20


def point_weights(views: Sequence[PlacedView]) -> list[Values]:
    """1 / sigma^2 for each point of each view, (n,); of a point without a stated sigma the least weight of the others,
    and 1 everywhere where no view states any."""
    variances = [
        np.zeros(view.pixels.size) if view.sigma_mm is None else view.sigma_mm.ravel()[view.pixels].astype(float) ** 2
        for view in views
    ]
    largest = max((float(variance.max(initial=0.0)) for variance in variances), default=0.0) or 1.0
    return [1.0 / np.where(variance > 0, variance, largest) for variance in variances]


def cell_means(points_m: Points, weights: Values, cell_mm: float = CELL_MM) -> Points:
    """The mean of ``points_m`` (n, 3) in each cell of a grid of ``cell_mm``, weighted by ``weights`` (n,), above 0; (k,
    3) in the order of the cells. Raises PredictionError for points too far away for such cells."""
    cells = np.floor(points_m * (MM_PER_M / cell_mm))
    if not (np.abs(cells) < _REACH_CELLS).all():  # NaN too
        reach_m = _REACH_CELLS * cell_mm / MM_PER_M
        farthest_m = float(np.abs(points_m).max())
        raise PredictionError(
            f"a point is {farthest_m:.3g} m from the object's axis, and cells of {cell_mm:g} mm reach {reach_m:g} m; "
            "check the unit of the depth"
        )
    x, y, z = (cells + _REACH_CELLS).astype(np.int64).T
    _, cell = np.unique((x * (2 * _REACH_CELLS) + y) * (2 * _REACH_CELLS) + z, return_inverse=True)
    total = np.bincount(cell, weights)
    return np.column_stack([np.bincount(cell, weights * axis) / total for axis in points_m.T])


def fuse(views: Sequence[PlacedView], kept: Sequence[np.ndarray] | None = None, cell_mm: float = CELL_MM) -> Points:
    """One cloud (k, 3) in object coordinates, metres: `cell_means` of all views' points by their `point_weights`;
    with ``kept``, bool (n,) for each view, of these points only."""
    chosen = [np.ones(view.pixels.size, dtype=bool) for view in views] if kept is None else kept
    points = np.concatenate([view.points_m[keep] for view, keep in zip(views, chosen, strict=True)])
    weights = [weight[keep] for weight, keep in zip(point_weights(views), chosen, strict=True)]
    return cell_means(points, np.concatenate(weights), cell_mm)
