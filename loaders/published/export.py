"""Exporting a dataset as the published tree: PNG fringes, .mat depth in three representations, raw scans, phases.

Depth in mm is written as float32, the same bits as in the dataset. The normalised representations are written as
float64, from which the same float32 mm are recovered; float32 would be off by a few 0.0001 mm.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import PUBLISHED_SPLIT_FOLDERS
from fpp_ml_bench.decoding import decode_stack
from fpp_ml_bench.depth import Normalisation, normalise, object_mask
from fpp_ml_bench.loaders.published.mat_files import matrix_bytes
from fpp_ml_bench.loaders.published.png import png_bytes
from fpp_ml_bench.loaders.published.tree import (
    BACKGROUND_REMOVED_FOLDERS,
    DEPTH,
    FRINGE,
    INFO,
    INFO_VARIABLES,
    RAW_SCANS,
    TRAINING,
    UNWRAPPED_PHASE,
    UNWRAPPED_PHASE_VARIABLE,
    VARIABLES,
    VARIANT_FOLDERS,
    WRAPPED_PHASE,
    WRAPPED_PHASE_VARIABLE,
    frame_file,
)
from fpp_ml_bench.loaders.sample import SINGLE_SHOT_FRAME
from fpp_ml_bench.loaders.storage import DatasetFolder, depth_range_mm
from fpp_ml_bench.optics import Direction

_PHASE_DIRECTION: Direction = "horizontal"
"""The published phases do not name their direction; they belong to the fringes of the single-shot frame."""


def write_tree(
    dataset: DatasetFolder, folder: Path, splits: list[str], threads: int, row_done: Callable[[], None] = lambda: None
) -> None:
    """Write ``splits`` of a dataset into ``folder`` as the published layout; raw scans where all frames are stored.

    ``fpp-bench import`` reads the same frames, depth and splits back from the tree. The layout has no place for
    ``depth_exact``, which is not written. Raises ``OSError`` when the disk can't be written.
    """
    samples = [(split, sample) for split in splits for sample in dataset.samples(split)]
    with ThreadPoolExecutor(threads) as pool:  # the first error cancels what has not begun
        for _ in pool.map(lambda named: _write_sample(dataset, folder, *named), samples):
            row_done()


def _write_sample(dataset: DatasetFolder, folder: Path, split: str, sample: str) -> None:
    published = PUBLISHED_SPLIT_FOLDERS[split]
    depth_mm = dataset.depth_mm(sample)
    frame = dataset.frame(sample, SINGLE_SHOT_FRAME)
    fringe = png_bytes(frame)
    background_removed = png_bytes(np.where(object_mask(depth_mm), frame, np.uint8(0)))
    low_mm, high_mm = depth_range_mm(depth_mm, sample)
    training = folder / TRAINING
    for name, variable in VARIABLES.items():
        depth = matrix_bytes({variable: _represented(depth_mm, name, low_mm, high_mm)})
        for variant, image in ((VARIANT_FOLDERS[name], fringe), (BACKGROUND_REMOVED_FOLDERS[name], background_removed)):
            _write(training / variant / published / FRINGE / f"{sample}.png", image)
            _write(training / variant / published / DEPTH / f"{sample}.mat", depth)
    limits = matrix_bytes(dict(zip(INFO_VARIABLES, (low_mm, high_mm), strict=True)))
    _write(training / INFO / published / DEPTH / f"{sample}.mat", limits)
    if "all" in dataset.configs:
        labels = dataset.measured(sample)
        _write_scan(dataset, sample, folder / RAW_SCANS / labels["object"] / labels["view"])


def _represented(depth_mm: NDArray[np.float32], name: Normalisation, low_mm: float, high_mm: float) -> NDArray:
    if name == "raw":
        return depth_mm
    return normalise(depth_mm.astype(np.float64), name, low_mm, high_mm, out=np.empty(depth_mm.shape))


def _write_scan(dataset: DatasetFolder, sample: str, folder: Path) -> None:
    """Frames in the paper's order, wrapped phase, and unwrapped phase (NaN where a pixel can't be decoded)."""
    frames = dataset.frames(sample, range(len(dataset.sequence)))
    for index, image in enumerate(frames):
        _write(folder / frame_file(index), png_bytes(image))
    measured = decode_stack(frames, dataset.rig, _PHASE_DIRECTION, details=True).details[_PHASE_DIRECTION]
    absolute_rad = measured.coordinate_px * (2 * np.pi / dataset.rig.pitch(_PHASE_DIRECTION))
    _write(folder / WRAPPED_PHASE, matrix_bytes({WRAPPED_PHASE_VARIABLE: measured.phase.astype(np.float32)}))
    _write(folder / UNWRAPPED_PHASE, matrix_bytes({UNWRAPPED_PHASE_VARIABLE: absolute_rad.astype(np.float32)}))


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
