"""Windows of training samples, and how a network is judged on whole views: what phase-net, crossed-net and
classical-net have in common."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import Image, Mask

IGNORED = -100
"""Class of a pixel that is left out of the order's loss: background, or none of the three candidates is right."""
EDGE_POINTS = 2000  # pixels of interest that a sample holds, as centres of training windows
TYPICAL_MM = 1800.0
"""Depth error that a missed or invented pixel counts with."""


@dataclass(frozen=True)
class Sample:
    """A measured view: its ``scene``, the maps that a network is given, and the truth, (h, w) each: ``target``: object
    pixels that are not ``void``, which are neither object nor background; ``edges`` int32 (n, 2): rows and columns of
    interest, beside depth edges and silhouettes."""

    name: str
    scene: Any
    target: Mask
    void: Mask
    edges: NDArray[np.int32]


@dataclass(frozen=True)
class Window:
    """One training example: ``x`` (C, n, n) float32, ``exists`` (3, n, n); ``order`` int64 (n, n), 0 to 2 or `IGNORED`;
    ``correction_rad`` and ``fitted`` (n, n): error of the phase beside the order, and where it counts; ``target`` bool
    (n, n): object; ``mask_valid``: where the mask's loss counts, not on void pixels, nor for an object that moved."""

    x: Image
    exists: Mask
    order: NDArray[np.int64]
    correction_rad: Image
    fitted: Mask
    target: Mask
    mask_valid: Mask


def edge_points(interesting: Mask) -> NDArray[np.int32]:
    """Rows and columns int32 (n, 2) of at most `EDGE_POINTS` of the ``interesting`` pixels, always the same."""
    places = np.argwhere(interesting).astype(np.int32)
    return places[np.random.default_rng(0).permutation(len(places))[:EDGE_POINTS]]


def place_of(
    edges: NDArray[np.int32], shape: tuple[int, ...], size: int, near_edge: bool, random: np.random.Generator
) -> tuple[slice, slice]:
    """Rows and columns of a random window of ``size`` px in an image of ``shape``, or of one near a point of ``edges``
    (n, 2)."""
    height, width = shape
    if near_edge and len(edges):
        row, column = edges[random.integers(len(edges))] + random.integers(-size // 3, size // 3 + 1, 2)
    else:
        row, column = random.integers(height), random.integers(width)
    top = int(np.clip(row - size // 2, 0, max(height - size, 0)))
    left = int(np.clip(column - size // 2, 0, max(width - size, 0)))
    return slice(top, min(top + size, height)), slice(left, min(left + size, width))


def wrong_place(
    shape: tuple[int, ...], whole: float, patch: float, random: np.random.Generator
) -> tuple[Mask | None, bool]:
    """Where in a window of ``shape`` wrong base orders are made up, because training objects have few: everywhere, as
    often as ``whole`` says, or in a patch, as often as ``patch`` says of the others; None: nowhere. And whether it is
    everywhere."""
    if random.random() < whole:
        return np.ones(shape, bool), True
    if random.random() >= patch:
        return None, False
    coarse = random.standard_normal((12, 12)).astype(np.float32)
    noise: Image = cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC)  # type: ignore[assignment]
    return noise > random.uniform(0.5, 1.5), False


def padded(size: int, x: Image, exists: Mask, *maps: NDArray) -> Window:
    """A `Window` of ``size`` px of its fields in their order, which may be smaller; what is added counts nowhere."""
    height, width = x.shape[-2:]
    pad = ((0, size - height), (0, size - width))
    order, *others = maps
    return Window(
        np.pad(x, ((0, 0), *pad)),
        np.pad(exists, ((0, 0), *pad), constant_values=True),
        np.pad(order, pad, constant_values=IGNORED).astype(np.int64),
        *(np.pad(values, pad) for values in others),
    )


def candidate_scores(
    found_mm: NDArray,
    true_mm: NDArray,
    error_rad: NDArray,
    sigma_rad: NDArray,
    inside: Mask,
    truth: Sample,
    wrong_rad: float,
) -> dict[str, float | None]:
    """Scores of a view from its depth, true depth, error of the phase and its stated uncertainty at the pixels of
    ``truth.target``, (n,) each, and its mask ``inside`` (h, w). ``object_mae_mm`` counts a missed pixel with its whole
    depth; ``right_mae_mm``: MAE of pixels with the right order, whose phase is less than ``wrong_rad`` off;
    ``wrong_percent`` and ``missed_percent``: shares of the object's pixels; ``invented_kpx``: background pixels with a
    depth, in thousands; ``within_percent``: errors of the phase within the stated standard uncertainty, 68 of a normal
    distribution. Where no order is right, it and ``right_mae_mm`` are None."""
    detected, apart = inside[truth.target], np.abs(error_rad)
    error = np.minimum(np.abs(np.nan_to_num(found_mm) - true_mm), true_mm)
    error, wrong = np.where(detected, error, true_mm), apart > wrong_rad
    right = detected & ~wrong
    return {
        "object_mae_mm": float(error.mean()),
        "right_mae_mm": float(error[right].mean()) if right.any() else None,
        "wrong_percent": 100 * float(wrong.mean()),
        "missed_percent": 100 * float((~detected).mean()),
        "within_percent": 100 * float((apart < sigma_rad)[right].mean()) if right.any() else None,
        "invented_kpx": float((inside & ~truth.target & ~truth.void).sum()) / 1000,
    }


def mean_scores(rows: Iterable[Mapping[str, float | None]]) -> dict[str, float]:
    """Mean of each score over the rows that have it; a score that none has is left out."""
    known: dict[str, list[float]] = {}
    for row in rows:
        for key, value in row.items():
            if value is not None:
                known.setdefault(key, []).append(value)
    return {key: float(np.mean(values)) for key, values in known.items()}


def chosen_threshold(
    views: Iterable[tuple[Sample, Callable[[float], Mask]]],
    thresholds: Sequence[float],
    pixels: int,
    tolerance_mm: float = 0.0,
) -> float:
    """The threshold, out of the rising ``thresholds`` on the mask's logit, with the least sum of object and background
    error: a missed object pixel and an invented background pixel are off by the same distance, each divided by the
    number of pixels of its kind. ``views``: each with the mask that it gets by a threshold; ``pixels``: of a whole
    image. Among the thresholds within ``tolerance_mm`` of the least, the lowest: it misses the fewest pixels."""
    costs = []
    for truth, decided in views:
        object_px, row = max(int(truth.target.sum()), 1), []
        for threshold in thresholds:
            inside = decided(threshold)
            missed, invented = (truth.target & ~inside).sum(), (inside & ~truth.target & ~truth.void).sum()
            row.append(TYPICAL_MM * (missed / object_px + invented / (pixels - object_px)))
        costs.append(row)
    means = np.mean(costs, axis=0)
    return thresholds[int(np.flatnonzero(means <= means.min() + tolerance_mm)[0])]
