"""What putting views together is worth: clouds against the object's surface, flags against the exact depth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.robustness import corruptions
from fpp_ml_bench.baselines.views.consistency import Flags, contradicted
from fpp_ml_bench.baselines.views.fusion import CELL_MM, fuse
from fpp_ml_bench.baselines.views.placement import PlacedView, Points
from fpp_ml_bench.baselines.views.surface import Surface
from fpp_ml_bench.evaluation.score import Interval, object_interval

WITHIN_MM = 2.0
"""A point this near to the surface is on it, and a piece of surface this near to a point is covered."""
CLOUD_SCORES = ("accuracy_mm", "near_share", "covered_share")
Row = dict[str, float | None]


@dataclass(frozen=True)
class Truth:
    """``depth_mm`` (H, W) exact, and ``scored`` bool (H, W): object pixels that are not void."""

    depth_mm: NDArray[np.floating]
    scored: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class FusedObject:
    """An object's clouds in object coordinates, metres: of each view alone, of all views, of all without contradicted
    pixels; its surface; and its scores: `cloud_scores` with the prefixes ``one_`` (mean over the views), ``all_`` and
    ``kept_``, and `flag_scores`."""

    name: str
    surface: Surface
    alone_m: list[Points]
    all_m: Points
    kept_m: Points
    scores: Row


def fuse_object(
    name: str, views: Sequence[PlacedView], truths: Sequence[Truth], surface: Surface, cell_mm: float = CELL_MM
) -> FusedObject:
    """Put an object's views together and score what comes out."""
    flags = contradicted(views)
    alone = [fuse([view], cell_mm=cell_mm) for view in views]
    every, kept = fuse(views, cell_mm=cell_mm), fuse(views, [~flag for flag in flags], cell_mm)
    of_views = [cloud_scores(cloud, surface) for cloud in alone]
    scores = {f"one_{key}": _mean([row[key] for row in of_views]) for key in of_views[0]}
    for prefix, cloud in (("all", every), ("kept", kept)):
        scores |= {f"{prefix}_{key}": value for key, value in cloud_scores(cloud, surface).items()}
    return FusedObject(name, surface, alone, every, kept, scores | flag_scores(views, truths, flags))


def cloud_scores(points_m: Points, surface: Surface) -> Row:
    """`CLOUD_SCORES` of a cloud (k, 3): the mean distance of its points to the surface and the share of them within
    `WITHIN_MM` of it, both None without a point, and the share of the surface that it covers."""
    covered = surface.covered_share(points_m, WITHIN_MM)
    if not len(points_m):
        return {"accuracy_mm": None, "near_share": None, "covered_share": covered}
    distances = surface.distances_mm(points_m)
    near = float((distances <= WITHIN_MM).mean())
    return {"accuracy_mm": float(distances.mean()), "near_share": near, "covered_share": covered}


def flag_scores(views: Sequence[PlacedView], truths: Sequence[Truth], flags: Sequence[Flags]) -> Row:
    """Over the answered object pixels of all views that are not void: ``wrong_px``, more than a wrong order's error
    off, ``found_px`` of them flagged; ``found_share`` of them (None without any) and ``false_share`` of the others
    that is flagged, ``dropped_share`` of both; the mean error ``mae_mm`` of all, ``kept_mae_mm`` without the flagged.
    """
    errors, flagged = [], []
    for view, truth, flag in zip(views, truths, flags, strict=True):
        scored = truth.scored.ravel()[view.pixels]
        pixels = view.pixels[scored]
        errors.append(np.abs(view.depth_mm.ravel()[pixels].astype(np.float64) - truth.depth_mm.ravel()[pixels]))
        flagged.append(flag[scored])
    error, flag = np.concatenate(errors), np.concatenate(flagged)
    wrong = error > corruptions().wrong_order_mm
    return {
        "scored_px": float(error.size),
        "wrong_px": float(wrong.sum()),
        "found_px": float((flag & wrong).sum()),
        "found_share": _share(flag, wrong),
        "false_share": _share(flag, ~wrong),
        "dropped_share": _share(flag, np.ones_like(wrong)),
        "mae_mm": _mean_error(error),
        "kept_mae_mm": _mean_error(error[~flag]),
    }


def _share(flag: Flags, among: Flags) -> float | None:
    return float(flag[among].mean()) if among.any() else None


def _mean_error(error_mm: NDArray[np.float64]) -> float | None:
    return float(error_mm.mean()) if error_mm.size else None


def _mean(values: Sequence[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return float(np.mean(present)) if present else None


def means(objects: Mapping[str, Row]) -> dict[str, tuple[float | None, Interval | None]]:
    """Of each score but the numbers of pixels: mean over the objects that have it, and its 95% interval over them."""
    keys = [key for key in next(iter(objects.values())) if not key.endswith("_px")]
    columns = {key: [row[key] for row in objects.values()] for key in keys}
    return {key: (_mean(values), object_interval(values, list(objects))) for key, values in columns.items()}
