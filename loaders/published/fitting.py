"""What a published tree's raw scans and depths say about the rig, whose pitch and projector are not published."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from fpp_ml_bench.calibration import MOST_PX, DepthView, view_from_frames
from fpp_ml_bench.decoding import decode_stack
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DecodeError, LayoutError
from fpp_ml_bench.loaders.published.importing import SampleReader
from fpp_ml_bench.loaders.published.tree import RAW_SCANS, PublishedSample
from fpp_ml_bench.loaders.sample import Row
from fpp_ml_bench.optics import Rig

_LEAST_PX_A_VIEW = 2000
AGREEING_MM = 1.0
"""Largest median difference between a tree's depth and what its own rig decodes from its frames: twice the error of
the benchmark's ground truth."""


def tree_views(
    reader: SampleReader, threads: int = 1, progress: Callable[[int], None] = lambda views: None
) -> list[DepthView]:
    """Phase and depth of all samples of a tree, some pixels of each. ``reader``: that of `plan_import`; of its rig,
    camera, sequence and frame order are used. ``progress`` is called with numbers of views read. Raises `LayoutError`
    for a tree without raw scans or a file that is wrong, `DecodeError` for frames that can't be decoded."""
    if reader.order is None:
        raise LayoutError(
            f"{reader.tree.root}: has no raw scans; the rig is found from all frames of a view, in {RAW_SCANS}/"
        )
    samples = list(reader.tree.by_name.values())
    most_px = max(_LEAST_PX_A_VIEW, MOST_PX // len(samples))

    def view(sample: PublishedSample) -> DepthView:
        row = reader.read(sample)
        measured = view_from_frames(sample.sample, _frames(row, reader.rig), row.depth_mm, reader.rig, most_px)
        progress(1)
        return measured

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(view, samples))


def depth_difference_mm(reader: SampleReader) -> float | None:
    """Median difference (absolute, mm) between the first sample's depth and what ``reader.rig`` decodes from its
    frames; inf where it decodes less than half of the pixels or none, None for a tree without raw scans."""
    if reader.order is None:
        return None
    row = reader.read(next(iter(reader.tree.by_name.values())))
    try:
        decoded_mm = decode_stack(_frames(row, reader.rig), reader.rig, mask=object_mask(row.depth_mm)).depth_mm
    except DecodeError:
        return float("inf")
    both = object_mask(decoded_mm) & object_mask(row.depth_mm)
    if 2 * np.count_nonzero(both) < np.count_nonzero(object_mask(row.depth_mm)):
        return float("inf")
    return float(np.median(np.abs(decoded_mm[both].astype(np.float64) - row.depth_mm[both])))


def _frames(row: Row, rig: Rig) -> list[np.ndarray]:
    return [row.frames[index] for index in range(len(rig.sequence))]
