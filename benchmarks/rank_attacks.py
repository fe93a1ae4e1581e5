"""Attacks on the leaderboard's rank key: what a prediction gains by another mask or by other
answers, in mm.

    python benchmarks/rank_attacks.py DATASET PREDICTIONS

PREDICTIONS: .npy maps of the test split, as ``fpp-bench predict`` writes them, with their
uncertainty where there is one. Each attack changes every map without looking at the truth; the last
one looks, and says what a perfect mask is worth. The table has the paper's object and background
MAE beside the key, whose charge is that of the dataset's rig.
"""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from fpp_ml_bench import evaluate
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.loaders.sample import DEPTH_EXACT, Flag
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.tables import Table

Depth = NDArray[np.float32]
SHOWN = (
    "object_mae_mm",
    "background_mae_mm",
    "overall_mae_mm",
    "two_sided_mae_mm",
    "object_missing_share",
    "invented_share",
)


def nearest(depth_mm: Depth, where: NDArray[np.bool_]) -> Depth:
    """The map with the depth of the nearest answer at the pixels ``where``."""
    if not (depth_mm > 0).any():
        return depth_mm
    rows, columns = ndimage.distance_transform_edt(
        depth_mm <= 0, return_distances=False, return_indices=True
    )
    return np.where(where & (depth_mm <= 0), depth_mm[rows, columns], depth_mm)


def widened(depth_mm: Depth, px: int) -> Depth:
    """Dilated by so many pixels, or eroded for a negative number."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(px) + 1,) * 2)
    mask = (depth_mm > 0).astype(np.uint8)
    if px > 0:
        return nearest(depth_mm, cv2.dilate(mask, kernel) > 0)
    return np.where(cv2.erode(mask, kernel) > 0, depth_mm, 0).astype(np.float32)


def holes_filled(depth_mm: Depth) -> Depth:
    return nearest(depth_mm, ndimage.binary_fill_holes(depth_mm > 0))


def without_least_sure(depth_mm: Depth, sigma_mm: Depth, share: float) -> Depth:
    """Without an answer at the ``share`` of the answered pixels that state the largest
    uncertainty."""
    answered = depth_mm > 0
    if not answered.any():
        return depth_mm
    return np.where(
        answered & (sigma_mm > np.quantile(sigma_mm[answered], 1 - share)), 0, depth_mm
    ).astype(np.float32)


def attacks(
    rig_middle_mm: float, wall_mm: float, smoothed_px: int = 5
) -> Iterator[tuple[str, Callable[[Depth, Depth, Depth], Depth]]]:
    """Name, and what becomes of depth, uncertainty and truth."""
    yield "as it is", lambda depth, sigma, truth: depth
    for px in (1, 3, -1, -3):
        words = f"{'dilated' if px > 0 else 'eroded'} by {abs(px)} px"
        yield words, lambda depth, sigma, truth, px=px: widened(depth, px)
    yield "holes filled", lambda depth, sigma, truth: holes_filled(depth)
    yield (
        "image filled with the nearest depth",
        lambda depth, sigma, truth: nearest(depth, depth <= 0),
    )
    yield (
        "image filled with the middle of the range",
        lambda depth, sigma, truth: np.where(depth > 0, depth, rig_middle_mm),
    )
    yield (
        "the wall copied into the background",
        lambda depth, sigma, truth: np.where(depth > 0, depth, wall_mm),
    )
    yield "median of 5 px", lambda depth, sigma, truth: cv2.medianBlur(depth, smoothed_px)
    for share in (0.001, 0.01, 0.05):
        yield (
            f"refused, {share:.1%} least sure",
            lambda depth, sigma, truth, share=share: without_least_sure(depth, sigma, share),
        )
    yield "refused, all", lambda depth, sigma, truth: np.zeros_like(depth)
    yield (
        "the true mask",
        lambda depth, sigma, truth: np.where(truth > 0, nearest(depth, truth > 0), 0),
    )


def table(dataset: Path, predictions: Path) -> Table:
    opened = DatasetFolder(dataset)
    samples = opened.samples("test")
    depths, truths, flags, sigmas = [], [], [], []
    for sample in samples:
        depths.append(np.load(predictions / f"{sample}.npy").astype(np.float32))
        stated = predictions / f"{sample}.sigma.npy"
        sigmas.append(
            np.load(stated).astype(np.float32) if stated.exists() else np.zeros_like(depths[-1])
        )
        truths.append(np.array(opened.depth_mm(sample, DEPTH_EXACT), np.float32))
        flags.append(np.where(opened.void(sample, DEPTH_EXACT), np.uint8(Flag.UNLIT), np.uint8(0)))
    rig = opened.rig
    found = Table("Attack", numbers=SHOWN)
    middle_mm, wall_mm = sum(rig.working_range_mm) / 2, (rig.background_m or 0.0) * MM_PER_M
    for name, attack in attacks(middle_mm, wall_mm):
        attacked = [
            attack(*maps).astype(np.float32) for maps in zip(depths, sigmas, truths, strict=True)
        ]
        scores = evaluate(
            attacked, truths, flags=flags, units="mm", charge_mm=rig.half_range_mm
        ).metrics
        values = [getattr(scores, key) for key in SHOWN]
        found.add_row(
            name,
            *(
                f"{100 * value:.2f}%" if "share" in key else f"{value:.3f}"
                for key, value in zip(SHOWN, values, strict=True)
            ),
        )
    return found


if __name__ == "__main__":
    words = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    words.add_argument("dataset", type=Path)
    words.add_argument("predictions", type=Path)
    given = words.parse_args()
    print("\n".join(table(given.dataset, given.predictions).markdown()))
