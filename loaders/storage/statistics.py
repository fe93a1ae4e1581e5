"""Statistics of a dataset from its builder's measurements: cover, depth range, ground-truth uncertainty per split."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from fpp_ml_bench.loaders.storage.manifest import Manifest


@dataclass(frozen=True)
class SplitStatistics:
    """Statistics of a split; lengths in mm, shares from 0 to 1, None where a dataset has no exact depth.

    ``gt_mae_mm`` and ``gt_rmse_mm`` are the uncertainty of the ground truth: decoded against exact depth over all
    object pixels, averaged over samples like every score. ``gt_interior_*``: the same over object pixels 3 px or more
    from depth edges.
    """

    split: str
    samples: int
    objects: int
    cover_mean: float
    cover_min: float
    cover_max: float
    depth_range_median_mm: float
    depth_range_max_mm: float
    gt_mae_mm: float | None
    gt_rmse_mm: float | None
    gt_interior_mae_mm: float | None
    gt_interior_rmse_mm: float | None
    gt_max_mm: float | None
    undecoded_share: float | None


def split_statistics(manifest: Manifest) -> list[SplitStatistics]:
    """Statistics of each split that has rows in the manifest."""
    return [_split(split, rows, manifest) for split, rows in manifest.samples.items()]


def whole_statistics(manifest: Manifest) -> SplitStatistics:
    """Statistics of all rows together, as a split called ``all``."""
    return _split("all", [row for rows in manifest.samples.values() for row in rows], manifest)


def _split(split: str, rows: list[dict[str, Any]], manifest: Manifest) -> SplitStatistics:
    pixels = manifest.size[0] * manifest.size[1]
    cover = np.array([row["object_px"] for row in rows]) / pixels
    ranges = np.array([row["depth_max_mm"] - row["depth_min_mm"] for row in rows])

    def average(key: str) -> float | None:
        values = [row[key] for row in rows if row.get(key) is not None]
        return float(np.mean(values)) if values else None

    largest = [row["gt_max_mm"] for row in rows if row.get("gt_max_mm") is not None]
    exact_px = sum(row.get("exact_px", 0) for row in rows)
    return SplitStatistics(
        split=split,
        samples=len(rows),
        objects=len({row["object"] for row in rows}),
        cover_mean=float(cover.mean()),
        cover_min=float(cover.min()),
        cover_max=float(cover.max()),
        depth_range_median_mm=float(np.median(ranges)),
        depth_range_max_mm=float(ranges.max()),
        gt_mae_mm=average("gt_mae_mm"),
        gt_rmse_mm=average("gt_rmse_mm"),
        gt_interior_mae_mm=average("gt_interior_mae_mm"),
        gt_interior_rmse_mm=average("gt_interior_rmse_mm"),
        gt_max_mm=max(largest) if largest else None,
        undecoded_share=sum(row["undecoded_px"] for row in rows) / exact_px if exact_px else None,
    )


def ground_truth_summary(manifest: Manifest) -> list[str]:
    """A sentence per split on the error of the decoded ground truth against the exact depth; none for imported data."""
    return [
        f"{s.split}: ground truth within {s.gt_mae_mm:.3f} mm MAE, {s.gt_rmse_mm:.3f} mm RMSE of the exact depth "
        f"({s.gt_interior_mae_mm:.3f} mm 3 px or more from depth edges); {100 * s.undecoded_share:.2f}% of object "
        "pixels not decodable"
        for s in split_statistics(manifest)
        if s.gt_mae_mm is not None and s.gt_interior_mae_mm is not None and s.undecoded_share is not None
    ]
