"""Exporting a dataset: as Parquet, as the published tree (PNG fringes, .mat depth, raw scans), its
meshes and patterns. In the tree, depth in mm is written as float32, the same bits as in the
dataset. The normalised representations are written as float64, from which the same float32 mm are
recovered; float32 would be off by a few 0.0001 mm."""

import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import PUBLISHED_SPLIT_FOLDERS, VIEWS
from fpp_ml_bench.containers import matrix_bytes, pfm_bytes, png_bytes
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.depth import depth_range_mm, normalise, object_mask
from fpp_ml_bench.errors import BuildError, DatasetError
from fpp_ml_bench.files import whole_folder, write_files
from fpp_ml_bench.loaders.captures.exports import depth_ply, depth_png, finest_unit_mm
from fpp_ml_bench.loaders.published import tree
from fpp_ml_bench.loaders.sample import SINGLE_SHOT_FRAME
from fpp_ml_bench.loaders.storage.manifest import GENERATED, MESH_FOLDER
from fpp_ml_bench.loaders.storage.parquet import write_parquet
from fpp_ml_bench.loaders.storage.store import ALL_SPLITS, DatasetFolder
from fpp_ml_bench.optics.patterns import pattern_files
from fpp_ml_bench.optics.sequence import Direction, Sequence

FORMS = ("parquet", "mat", "maps", "meshes", "patterns")
MAP_FORMS, SCALE_FILE = ("pfm", "png", "ply"), "png_scale.txt"
SAMPLE_FORMS = ("parquet", "mat", "maps")
"""Forms whose progress is counted in samples."""

_PHASE_DIRECTION: Direction = "horizontal"
"""The published phases do not name their direction; they belong to the fringes of the single-shot
frame."""


def write_tree(
    dataset: DatasetFolder,
    folder: Path,
    splits: list[str],
    threads: int,
    row_done: Callable[[], None] = lambda: None,
) -> None:
    """Write ``splits`` of a dataset into ``folder`` as the published layout; raw scans where all
    frames are stored. ``fpp-bench import`` reads the same frames, depth and splits back from the
    tree. The layout has no place for ``depth_exact``, which is not written. Raises ``OSError`` when
    the disk can't be written."""
    samples = [(split, sample) for split in splits for sample in dataset.samples(split)]
    with ThreadPoolExecutor(threads) as pool:  # the first error cancels what has not begun
        for _ in pool.map(lambda named: _write_sample(dataset, folder, *named), samples):
            row_done()


def _write_sample(dataset: DatasetFolder, folder: Path, split: str, sample: str) -> None:
    published_split = PUBLISHED_SPLIT_FOLDERS[split]
    depth_mm = dataset.depth_mm(sample)
    frame = dataset.frame(sample, SINGLE_SHOT_FRAME)
    fringe = png_bytes(frame)
    background_removed = png_bytes(np.where(object_mask(depth_mm), frame, np.uint8(0)))
    low_mm, high_mm = depth_range_mm(depth_mm)
    training = folder / tree.TRAINING
    for name, variable in tree.VARIABLES.items():
        represented: NDArray = depth_mm
        if name != "raw":
            represented = normalise(
                depth_mm.astype(np.float64), name, low_mm, high_mm, out=np.empty(depth_mm.shape)
            )
        depth = matrix_bytes({variable: represented})
        for variants, image in (
            (tree.VARIANT_FOLDERS, fringe),
            (tree.BACKGROUND_REMOVED_FOLDERS, background_removed),
        ):
            part = training / variants[name] / published_split
            _write(part / tree.FRINGE / f"{sample}.png", image)
            _write(part / tree.DEPTH / f"{sample}.mat", depth)
    limits = matrix_bytes(dict(zip(tree.INFO_VARIABLES, (low_mm, high_mm), strict=True)))
    _write(training / tree.INFO / published_split / tree.DEPTH / f"{sample}.mat", limits)
    if "all" in dataset.configs:
        labels = dataset.measured(sample)
        _write_scan(dataset, sample, folder / tree.RAW_SCANS / labels["object"] / labels["view"])


def _write_scan(dataset: DatasetFolder, sample: str, folder: Path) -> None:
    """Frames in the paper's order, wrapped phase, and unwrapped phase (NaN where a pixel can't be
    decoded)."""
    frames = dataset.frames(sample, range(len(dataset.sequence)))
    for index, image in enumerate(frames):
        _write(folder / tree.frame_file(index), png_bytes(image))
    measured = decode_stack(frames, dataset.rig, _PHASE_DIRECTION, details=True).details[
        _PHASE_DIRECTION
    ]
    absolute_rad = measured.coordinate_px * (2 * np.pi / dataset.rig.pitch(_PHASE_DIRECTION))
    wrapped, unwrapped = measured.phase.astype(np.float32), absolute_rad.astype(np.float32)
    _write(folder / tree.WRAPPED_PHASE, matrix_bytes({tree.WRAPPED_PHASE_VARIABLE: wrapped}))
    _write(folder / tree.UNWRAPPED_PHASE, matrix_bytes({tree.UNWRAPPED_PHASE_VARIABLE: unwrapped}))


def write_maps(
    dataset: DatasetFolder,
    folder: Path,
    splits: list[str],
    forms: tuple[str, ...],
    depth_of: Callable[[str], NDArray[Any]],
    progress: Callable[[int], None],
) -> None:
    """Write what ``depth_of`` gives for every sample of ``splits``, (H, W) in mm, 0 = none, as
    ``SAMPLE.FORM`` in ``forms`` of `MAP_FORMS`, and `SCALE_FILE`, which says what a level of the
    PNG is."""
    samples = [sample for split in splits for sample in dataset.samples(split)]
    unit_mm = 0.0
    if "png" in forms:
        largest_mm = max(float(depth_of(sample).max()) for sample in samples)
        unit_mm = finest_unit_mm(largest_mm)
        _write(folder / SCALE_FILE, f"{unit_mm:g} mm are a level of every PNG here\n".encode())
    written = {
        "pfm": pfm_bytes,
        "png": lambda depth_mm: depth_png(depth_mm, unit_mm),
        "ply": lambda depth_mm: depth_ply(depth_mm, dataset.rig.camera),
    }
    for sample in samples:
        depth_mm = depth_of(sample).astype(np.float32)
        for form in forms:
            _write(folder / f"{sample}.{form}", written[form](depth_mm))
        progress(1)


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def chosen_splits(dataset: DatasetFolder, split: str) -> list[str]:
    """Splits that ``split`` names, in row order; raises `DatasetError` when the dataset has no such
    samples."""
    dataset.samples(split)
    return list(dataset.splits) if split == ALL_SPLITS else [split]


def export(
    dataset: DatasetFolder,
    out: Path,
    forms: list[str],
    splits: list[str],
    threads: int = 1,
    progress: Callable[[int], None] = lambda rows: None,
    map_forms: tuple[str, ...] = MAP_FORMS,
    depth_of: Callable[[str], NDArray[Any]] | None = None,
) -> None:
    """Write a dataset in ``forms`` (of `FORMS`): a single form into ``out``, several forms into
    folders of their names. ``out`` must be new or empty and is written completely or not at all;
    ``progress`` is called with numbers of samples written. Raises `BuildError` for an unusable
    ``out`` or disk, `DatasetError` for data that the dataset lacks."""
    if not forms or not set(forms) <= set(FORMS):
        raise BuildError(
            f"export: expected some of {', '.join(FORMS)}, got {', '.join(forms) or 'none'}"
        )
    if out.resolve() == dataset.path.resolve() or dataset.path.resolve() in out.resolve().parents:
        raise BuildError(f"{out}: lies in the dataset itself; give another folder")
    rows = [row for split in splits for row in dataset.manifest.samples[split]]
    if "mat" in forms and not (
        isinstance(dataset.sequence, Sequence) and {row["view"] for row in rows} <= set(VIEWS)
    ):
        raise DatasetError(
            f"{dataset.path}: the published layout holds views {', '.join(VIEWS)} and the paper's "
            f"kind of frames, and "
            "this dataset has others; export it as parquet"
        )
    meshes = _meshes(dataset, [row["object"] for row in rows]) if "meshes" in forms else []
    never = "give a new folder, an export never adds to a folder or overwrites it"
    with whole_folder(out, "exporting there", BuildError, never) as staging:
        for form in forms:
            folder = staging / form if len(forms) > 1 else staging
            folder.mkdir(exist_ok=True)
            if form == "parquet":
                write_parquet(dataset, folder, splits, threads, progress)
            elif form == "mat":
                write_tree(dataset, folder, splits, threads, lambda: progress(1))
            elif form == "maps":
                depth_mm = depth_of or dataset.depth_mm
                write_maps(dataset, folder, splits, map_forms, depth_mm, progress)
            elif form == "meshes":
                for path in meshes:
                    shutil.copyfile(path, folder / path.name)
            else:
                write_files(folder, pattern_files(dataset.rig), BuildError)


def _meshes(dataset: DatasetFolder, objects: list[str]) -> list[Path]:
    listed = {dataset.path / file.path for file in dataset.manifest.others}
    paths = [dataset.path / MESH_FOLDER / f"{name}.ply" for name in dict.fromkeys(objects)]
    for path in paths:
        if path not in listed or not path.is_file():
            imported = dataset.manifest.origin != GENERATED
            hint = "imported datasets have no meshes" if imported else "run: fpp-bench verify"
            raise DatasetError(f"{path}: the mesh is missing; {hint}")
    return paths
