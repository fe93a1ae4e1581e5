"""An object's views in one frame: from depth maps to object coordinates and back, by the dataset's placement.

The builder turned the object about its axis by the view's angle, and put the axis at a distance that the manifest
states. Undoing both takes the points of any view into the object's own frame, so nothing is registered. Object
coordinates are metres, z up, as in the dataset's meshes.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import MM_PER_M, VIEW_DEGREES, VIEWS
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.loaders.render import turned, unturned
from fpp_ml_bench.loaders.storage import GENERATED, DatasetFolder
from fpp_ml_bench.optics import Pinhole

Points = NDArray[np.float64]
Values = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PlacedView:
    """A depth map (H, W) in mm, 0 or less without an answer, of an object turned by ``degrees`` whose axis is
    ``distance_m`` from the camera; ``sigma_mm`` (H, W), 0 where none is stated, or None."""

    depth_mm: NDArray[np.floating]
    camera: Pinhole
    degrees: float
    distance_m: float
    sigma_mm: NDArray[np.floating] | None = None

    @cached_property
    def pixels(self) -> NDArray[np.intp]:
        """Flat indices (n,) of the pixels with a depth and a ray, ascending."""
        x, y = self.camera.rays()
        return np.flatnonzero((self.depth_mm > 0) & np.isfinite(x) & np.isfinite(y))

    @cached_property
    def points_m(self) -> Points:
        """Object coordinates (n, 3) of ``pixels`` in metres."""
        x, y = (axis.ravel()[self.pixels] for axis in self.camera.rays())
        z = self.depth_mm.ravel()[self.pixels].astype(np.float64) / MM_PER_M
        return unturned(np.column_stack([x * z, y * z, z - self.distance_m]), self.degrees)

    def seen(self, points_m: Points) -> tuple[Values, Values, Values]:
        """Pixel coordinates u and v, NaN where the camera can't see, and depth in mm, (n,) each, of object points."""
        points = turned(points_m, self.degrees)
        points[:, 2] += self.distance_m
        u, v = self.camera.project(points)
        return u, v, points[:, 2] * MM_PER_M


def placement(dataset: DatasetFolder, sample: str) -> tuple[float, float]:
    """By how many degrees a sample's object was turned, and the distance of its axis from the camera in metres. Raises
    `DatasetError` for data that states no placement."""
    measured = dataset.measured(sample)
    view, distance_mm = measured["view"], measured.get("distance_mm")
    if dataset.manifest.origin != GENERATED or distance_mm is None or view not in VIEWS:
        raise DatasetError(
            f"{dataset.path}: {sample} has no known placement ({dataset.manifest.origin} data); views are put together "
            "by the placement that a generated dataset states: give one made by fpp-bench build"
        )
    return VIEW_DEGREES[VIEWS.index(view)], distance_mm / MM_PER_M
