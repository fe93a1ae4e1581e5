"""An object's views put together: one point cloud from their depth maps, and the pixels that other views contradict.

The builder turned the object about its axis by the view's angle, and put the axis at a distance that the manifest
states. Undoing both takes the points of any view into the object's own frame, so nothing is registered. Object
coordinates are metres, z up, as in the dataset's meshes.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import FULL_SIZE, MM_PER_M, VIEW_DEGREES, VIEWS
from fpp_ml_bench.errors import DatasetError, PredictionError
from fpp_ml_bench.evaluation.protocol import TARGETS
from fpp_ml_bench.evaluation.score.check import Rules, check_folder
from fpp_ml_bench.files import printable, write_files
from fpp_ml_bench.loaders.render.mesh_files import ply_bytes
from fpp_ml_bench.loaders.render.scene import turned, unturned
from fpp_ml_bench.loaders.sample import DEPTH_EXACT
from fpp_ml_bench.loaders.storage.manifest import GENERATED
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.options import did_you_mean

FUSION_FILE = "fusion.json"
OBJECT_AXES = "unit m (metres); object axes: z up"
CELL_MM = 2.0
"""Edge of a cell: 2.5 pixels of the paper's rig at 960 px and its standoff."""
TOLERANCE_MM = 20.0
"""Depths that differ by less agree: far above the noise of any method, far below half an order (150 mm). Of 5 to 40 mm,
chosen on the validation split."""
_REACH_PX = 2
"""At 960 px: a view's answers this many pixels around a point are compared with it, which forgives silhouettes."""
_REACH_CELLS = 1 << 20

Points = NDArray[np.float64]
Values = NDArray[np.float64]
Flags = NDArray[np.bool_]
Map = NDArray[np.floating]
Maps = Callable[[str], tuple[Map, Map | None]]
"""Depth in mm, and the standard uncertainty where it is stated, (H, W) each, of a sample."""


@dataclass(frozen=True, eq=False)
class PlacedView:
    """A depth map (H, W) in mm, 0 or less without an answer, of an object turned by ``degrees`` whose axis is
    ``distance_m`` from the camera; ``sigma_mm`` (H, W), 0 where none is stated, or None."""

    depth_mm: Map
    camera: Pinhole
    degrees: float
    distance_m: float
    sigma_mm: Map | None = None

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


def contradicted(views: Sequence[PlacedView]) -> list[Flags]:
    """For each view its contradicted ``pixels``, bool (n,), without ground truth. One view contradicts nothing.

    Each point is looked for in every other view. A view supports the point if it answers about the same depth there. It
    sees through the point if it answers a larger depth there, or no object at all. A point behind an answered surface
    is hidden, and the view says nothing about it. A pixel is contradicted if a view sees through its point and no view
    supports it. So a wrong order that puts its point on another side of the object, where some view supports it, is
    missed."""
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
            supported[inside] |= (depth >= near - TOLERANCE_MM) & (depth <= far + TOLERANCE_MM)
            seen_through[inside] |= depth < near - TOLERANCE_MM
        flags.append(seen_through & ~supported)
    return flags


def _answer_range(view: PlacedView) -> tuple[Values, Values]:
    """The nearest and the farthest answer around each pixel, (H, W) in mm. Without an answer they are inf and -inf, or
    both -inf in a hole, which an outline encloses: there the object is not background, but has no answer."""
    answered = view.depth_mm > 0
    reach = max(1, round(_REACH_PX * view.camera.width / FULL_SIZE))
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    depth = view.depth_mm.astype(np.float64)
    nearest = np.asarray(cv2.erode(np.where(answered, depth, np.inf), window), np.float64)
    farthest = np.asarray(cv2.dilate(np.where(answered, depth, -np.inf), window), np.float64)
    # Enclosed are pixels without an answer from which no path of such pixels leads to the image's border.
    framed = np.pad((~answered).astype(np.uint8), 1, constant_values=1)
    _, labels = cv2.connectedComponents(framed, connectivity=4, ltype=cv2.CV_32S)
    enclosed = ((labels != labels[0, 0]) & (framed > 0))[1:-1, 1:-1]
    nearest[np.isinf(nearest) & enclosed] = -np.inf
    return nearest, farthest


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


Counts = dict[str, float | None]


def fused(views: Sequence[PlacedView], cell_mm: float = CELL_MM) -> tuple[Points, Counts]:
    """One cloud (k, 3) of an object in object coordinates, metres: `cell_means` of its views' points by their
    `point_weights`, without the contradicted ones. And counts: ``cloud_points``; ``answered_px`` of all views, which
    have a depth; ``contradicted_px`` of these, and their share (``contradicted_share``, None without a depth)."""
    wrong = np.concatenate(contradicted(views))
    points = np.concatenate([view.points_m for view in views])
    cloud_m = cell_means(points[~wrong], np.concatenate(point_weights(views))[~wrong], cell_mm)
    answered, contradictions = wrong.size, int(wrong.sum())
    counts: Counts = {"cloud_points": len(cloud_m), "answered_px": answered, "contradicted_px": contradictions}
    return cloud_m, counts | {"contradicted_share": contradictions / answered if answered else None}


def prediction_maps(
    predictions: str | Path, dataset: DatasetFolder, split: str, target: str = DEPTH_EXACT
) -> tuple[str, Maps]:
    """The name of a method and its maps of ``split``: of a folder of predictions, which is checked as a whole first, or
    the dataset's own where ``predictions`` is the text ``depth`` or ``depth_exact``. Normalised predictions get the
    range of the column ``target``. Raises PredictionError for predictions that could not be scored."""
    if isinstance(predictions, str) and predictions in TARGETS:
        column = predictions
        return f"{column} of {printable(dataset.path.name)}", lambda sample: (dataset.depth_mm(sample, column), None)
    checked = check_folder(predictions, dataset, split)
    described, listing = checked.sound(), checked.listing
    read = listing.reader(dataset.size, described.png_mm_per_level, described.nodata)
    rules = Rules(target, described.units, described.range_rule, "standard")

    def maps(sample: str) -> tuple[Map, Map | None]:
        depth_mm, _ = rules.pair(read(sample)[0], dataset, sample)
        sigma_mm = listing.sigma_mm(sample, dataset.size) if listing.sigmas else None
        return np.array(depth_mm), sigma_mm

    return described.name, maps


def views_by_object(dataset: DatasetFolder, split: str, only: str | None = None) -> dict[str, list[str]]:
    """The samples of each object of ``split``, or of the object ``only``, whose placement is known. Raises
    `DatasetError` for another object, for one with a single view, and for data without placement."""
    views = dataset.samples_by_object(split)
    if only is not None and only not in views:
        raise DatasetError(f"{dataset.path}: no object {only!r} in split {split}; {did_you_mean(only, views)}")
    chosen = {name: samples for name, samples in views.items() if only in (None, name)}
    if not chosen:
        raise DatasetError(f"{dataset.path}: split {split} holds no sample; there is nothing to put together")
    for name, samples in chosen.items():
        if len(samples) < 2:
            raise DatasetError(f"{dataset.path}: {name} has one view only, {samples[0]}; expected two or more")
        for sample in samples:
            placement(dataset, sample)
    return chosen


def fuse_split(
    predictions: str | Path,
    dataset: DatasetFolder,
    split: str,
    out: Path,
    only: str | None = None,
    cell_mm: float = CELL_MM,
) -> tuple[str, int, Iterator[tuple[str, Counts]]]:
    """The method's name, the number of objects, and the objects of ``split`` (``only``: a single one) one after another
    with their counts, as they are put together and written: ``{object}.ply``, the object's cloud, and at last
    `FUSION_FILE`, the counts of all objects, and by which rules. Raises what `prediction_maps` and `views_by_object`
    raise, and PredictionError for a folder that can't be written."""
    if not 0 < cell_mm < 1000:
        raise PredictionError(f"--cell-mm {cell_mm:g}: expected the edge of a cell in mm, above 0 and below 1000")
    chosen = views_by_object(dataset, split, only)
    name, maps = prediction_maps(predictions, dataset, split)

    def written() -> Iterator[tuple[str, Counts]]:
        objects: dict[str, Counts] = {}
        for obj, samples in chosen.items():
            views = []
            for sample in samples:
                depth_mm, sigma_mm = maps(sample)
                views.append(PlacedView(depth_mm, dataset.rig.camera, *placement(dataset, sample), sigma_mm))
                dataset.release(sample)
            cloud_m, objects[obj] = fused(views, cell_mm)
            write_files(out, {f"{obj}.ply": ply_bytes(cloud_m, comment=OBJECT_AXES)}, PredictionError)
            yield obj, objects[obj]
        document = {
            "method": name,
            "dataset": dataset.fingerprint,
            "split": split,
            "cell_mm": cell_mm,
            "tolerance_mm": TOLERANCE_MM,
            "objects": objects,
        }
        content = (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()
        write_files(out, {FUSION_FILE: content}, PredictionError)

    return name, len(chosen), written()
