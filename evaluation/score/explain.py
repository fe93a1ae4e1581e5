"""What scoring skipped: columns that no score needs, and the search for depth edges far from the object."""

import numpy as np

from fpp_ml_bench.depth import object_mask, object_near_edges
from fpp_ml_bench.evaluation.protocol import WIDE_BAND_PX
from fpp_ml_bench.loaders.sample import stored_frames
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.skipping import Explanation, LeftOut, explained, saved_by

_DEPTH_BYTES, _FRAME_BYTES = 4, 1


def explain_eval(dataset: DatasetFolder, split: str, target: str, edge_band_px: int) -> Explanation:
    """What scoring one split skipped. Reads the split's targets again."""
    samples = dataset.samples(split)
    height, width = dataset.size
    pixels = height * width
    boxes = {sample: _box_px(dataset, sample, target) for sample in samples}
    frames = len(stored_frames(dataset.sequence, dataset.manifest.stored))
    depths = 1 + dataset.has_exact
    read = 1 + (target != "depth")
    median = sorted(samples, key=lambda sample: boxes[sample])[len(samples) // 2]
    depth_mm = dataset.target_mm(median, target)
    skipped = len(samples) * pixels - sum(boxes.values())
    lines = [
        LeftOut(
            "columns that no score needs", "images", len(samples) * read, len(samples) * (frames + depths - read),
            len(samples) * pixels * (frames * _FRAME_BYTES + (depths - read) * _DEPTH_BYTES), None,
            "not read; seconds not measured, they depend on the disk",
        ),
        LeftOut(
            "depth edges far from the object", "pixels", sum(boxes.values()), skipped, None,
            saved_by(
                lambda: object_near_edges(depth_mm, (edge_band_px, WIDE_BAND_PX)), pixels - boxes[median], skipped
            ),
            f"processor seconds of one sample ({median}) without skipping minus with it, measured now, scaled to the "
            "pixels that all samples skipped",
        ),
    ]  # fmt: skip
    return explained("fpp-eval", f"{len(samples)} samples of {width}x{height} px", lines)


def _box_px(dataset: DatasetFolder, sample: str, target: str) -> int:
    """Pixels of the box around the object in which edges are searched."""
    inside = object_mask(dataset.target_mm(sample, target))
    dataset.release(sample)
    extents = []
    for axis in (1, 0):
        occupied = np.flatnonzero(inside.any(axis=axis))
        if not occupied.size:
            return 0
        extents.append(min(int(occupied[-1]) + 2, inside.shape[1 - axis]) - max(int(occupied[0]) - 1, 0))
    return extents[0] * extents[1]
