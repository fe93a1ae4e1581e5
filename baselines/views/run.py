"""Reading an object's views from predictions or from the dataset, and writing what became of them."""

import json
from collections.abc import Callable, Iterator, Mapping
from difflib import get_close_matches
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from fpp_ml_bench.baselines.views.consistency import TOLERANCE_MM
from fpp_ml_bench.baselines.views.fusion import CELL_MM
from fpp_ml_bench.baselines.views.picture import clouds_png
from fpp_ml_bench.baselines.views.placement import PlacedView, placement
from fpp_ml_bench.baselines.views.scores import WITHIN_MM, FusedObject, Row, Truth, fuse_object, means
from fpp_ml_bench.baselines.views.surface import mesh_file, surface_of
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DatasetError, PredictionError
from fpp_ml_bench.evaluation import submission
from fpp_ml_bench.evaluation.protocol import TARGETS
from fpp_ml_bench.evaluation.score import check_folder, scored_pair
from fpp_ml_bench.files import printable, write_files
from fpp_ml_bench.loaders.sample import DEPTH_EXACT
from fpp_ml_bench.loaders.storage import DatasetFolder

FUSION_FILE = "fusion.json"
Map = NDArray[np.floating]
Maps = Callable[[str], tuple[Map, Map | None]]
"""Depth in mm, and the standard uncertainty where it is stated, (H, W) each, of a sample."""


def prediction_maps(predictions: str | Path, dataset: DatasetFolder, split: str) -> tuple[str, Maps]:
    """The name of a method and its maps of ``split``: of a folder of predictions, which is checked as a whole first, or
    the dataset's own where ``predictions`` is the text ``depth`` or ``depth_exact``. Raises PredictionError for
    predictions that could not be scored."""
    if isinstance(predictions, str) and predictions in TARGETS:
        column = predictions
        return f"{column} of {printable(dataset.path.name)}", lambda sample: (dataset.depth_mm(sample, column), None)
    folder = Path(predictions)
    checked = check_folder(folder, dataset, split)
    if checked.problems or checked.description is None:
        raise PredictionError(
            f"{printable(str(folder), 500)} can't be used, {len(checked.problems)} problems:", checked.problems
        )
    described = checked.description
    reader = submission.reader_for(checked.form, folder, checked.samples, dataset.size, described.png_mm_per_level)

    def read(sample: str) -> tuple[Map, Map | None]:
        target_mm = dataset.target_mm(sample, DEPTH_EXACT)
        left_out = dataset.left_out(sample, described.range_rule, DEPTH_EXACT)
        depth_mm, _ = scored_pair(reader.read(sample)[0], target_mm, described.units, "standard", sample, left_out)
        sigma_mm = submission.read_sigma(folder, sample, dataset.size) if checked.sigmas else None
        return np.array(depth_mm), sigma_mm

    return described.name, read


def views_by_object(dataset: DatasetFolder, split: str, only: str | None = None) -> dict[str, list[str]]:
    """The samples of each object of ``split``, or of the object ``only``, whose placement is known. Raises
    `DatasetError` for another object, for one with a single view, and for data without placement."""
    views: dict[str, list[str]] = {}
    for sample in dataset.samples(split):
        views.setdefault(dataset.measured(sample)["object"], []).append(sample)
    if only is not None and only not in views:
        near = ", ".join(get_close_matches(only, views, n=3)) or f"there are {', '.join(views)}"
        raise DatasetError(f"{dataset.path}: no object {only!r} in split {split}; {near}")
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
    predictions: str | Path, dataset: DatasetFolder, split: str, only: str | None = None, cell_mm: float = CELL_MM
) -> tuple[str, Iterator[FusedObject]]:
    """The method's name, and the objects of ``split`` put together one after another (``only``: a single one). Raises
    what `prediction_maps`, `views_by_object` and `mesh_file` raise."""
    if not 0 < cell_mm < 1000:
        raise PredictionError(f"--cell-mm {cell_mm:g}: expected the edge of a cell in mm, above 0 and below 1000")
    chosen = views_by_object(dataset, split, only)
    name, maps = prediction_maps(predictions, dataset, split)
    for obj in chosen:
        mesh_file(dataset, obj)

    def fused() -> Iterator[FusedObject]:
        for obj, samples in chosen.items():
            views, truths = [], []
            for sample in samples:
                depth_mm, sigma_mm = maps(sample)
                views.append(PlacedView(depth_mm, dataset.rig.camera, *placement(dataset, sample), sigma_mm))
                exact_mm = dataset.target_mm(sample, DEPTH_EXACT)
                truths.append(Truth(exact_mm, object_mask(exact_mm) & ~dataset.void(sample, DEPTH_EXACT)))
                dataset.release(sample)
            yield fuse_object(obj, views, truths, surface_of(dataset, obj), cell_mm)

    return name, fused()


def write_object(out: Path, fused: FusedObject) -> list[Path]:
    """Write ``{object}.ply``, the cloud of all views without contradicted pixels (metres, object coordinates), and
    ``{object}.png``, its clouds as a picture. Raises PredictionError for a folder that can't be written."""
    # A mesh without faces: trimesh can't write a PointCloud without points.
    cloud = trimesh.Trimesh(fused.kept_m, np.zeros((0, 3), np.int64), process=False, validate=False)
    content = trimesh.exchange.ply.export_ply(cloud, vertex_normal=False)
    return write_files(out, {f"{fused.name}.ply": content, f"{fused.name}.png": clouds_png(fused)}, PredictionError)


def write_scores(
    out: Path, name: str, dataset: DatasetFolder, split: str, cell_mm: float, objects: Mapping[str, Row]
) -> list[Path]:
    """Write `FUSION_FILE`: the scores of all objects, their means, and by which rules. Errors as `write_object`."""
    summary = {key: {"mean": mean, "interval": interval} for key, (mean, interval) in means(objects).items()}
    document = {
        "method": name,
        "dataset": dataset.fingerprint,
        "split": split,
        "cell_mm": cell_mm,
        "within_mm": WITHIN_MM,
        "tolerance_mm": TOLERANCE_MM,
        "mean_over_objects": summary,
        "objects": dict(objects),
    }
    content = (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()
    return write_files(out, {FUSION_FILE: content}, PredictionError)
