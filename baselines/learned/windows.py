"""Windows of measured views, and how a network is judged on whole views: what phase-net,
crossed-net and classical-net have in common."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.learned.inputs import SIDE_CHANNELS, SIDES
from fpp_ml_bench.baselines.learned.scenes import View
from fpp_ml_bench.baselines.phase.geometry import Image, Mask
from fpp_ml_bench.depth import depth_edges
from fpp_ml_bench.optics.sequence import Direction

IGNORED = -100
"""Class of a pixel that is left out of the order's loss: background, or none of the three
candidates is right."""
EDGE_POINTS = 2000  # pixels of interest that a sample holds, as centres of training windows
TYPICAL_MM = 1800.0
"""Depth error that a missed or invented pixel counts with."""

Window = dict[str, NDArray]
"""One training example, maps (..., n, n) by name: ``x`` (C, n, n) float32, the network's input, and
what its losses compare with. Of a `PhaseNet`: ``exists`` bool (3, n, n): candidates; ``order``
int64, 0 to 2 or `IGNORED`; ``correction_rad`` and ``fitted``: error of the phase beside the order,
and where it counts; ``target``: object; ``mask_valid``: where the mask's loss counts, not on void
pixels, nor for an object that moved."""
CANDIDATE_MAPS = "exists", "order", "correction_rad", "fitted", "target", "mask_valid"


@dataclass(frozen=True)
class Sample:
    """A measured view in the light ``group``: its ``scene``, the maps that a network is given, and
    the truth, (h, w) each: ``target``: object pixels that are not ``void``, which are neither
    object nor background; ``missing``: what the true phase or depth has beyond the scene's, 0
    outside the object; ``edges`` int32 (n, 2): rows and columns of interest, beside depth edges and
    silhouettes. ``direction`` of its fringes, where a network learns both."""

    name: str
    group: str
    scene: Any
    target: Mask
    void: Mask
    missing: NDArray
    edges: NDArray[np.int32]
    direction: Direction = "horizontal"

    @classmethod
    def of(
        cls,
        view: View,
        scene: Any,
        missing: NDArray,
        interesting: Mask | bool = False,
        direction: Direction = "horizontal",
    ) -> "Sample":
        """Of a ``view`` that is cut to the crop of ``scene``; ``interesting``: further pixels of
        interest."""
        # Always the same points of a view.
        places = np.argwhere(depth_edges(view.depth_mm) | interesting).astype(np.int32)
        edges = places[np.random.default_rng(0).permutation(len(places))[:EDGE_POINTS]]
        return cls(view.name, view.group, scene, view.target, view.void, missing, edges, direction)

    def place(
        self, size: int, near_edge: float, random: np.random.Generator
    ) -> tuple[slice, slice]:
        """Rows and columns of a random window of ``size`` px, as often as ``near_edge`` says near a
        point of interest."""
        height, width = self.target.shape
        if random.random() < near_edge and len(self.edges):
            row, column = self.edges[random.integers(len(self.edges))] + random.integers(
                -size // 3, size // 3 + 1, 2
            )
        else:
            row, column = random.integers(height), random.integers(width)
        top = int(np.clip(row - size // 2, 0, max(height - size, 0)))
        left = int(np.clip(column - size // 2, 0, max(width - size, 0)))
        return slice(top, min(top + size, height)), slice(left, min(left + size, width))


def wrong_place(
    shape: tuple[int, ...], whole: float, patch: float, random: np.random.Generator
) -> tuple[Mask | None, bool]:
    """Where in a window of ``shape`` wrong base orders are made up, because training objects have
    few: everywhere, as often as ``whole`` says, or in a patch, as often as ``patch`` says of the
    others; None: nowhere. And whether it is everywhere."""
    if random.random() < whole:
        return np.ones(shape, bool), True
    if random.random() >= patch:
        return None, False
    coarse = random.standard_normal((12, 12)).astype(np.float32)
    noise: Image = cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC)  # type: ignore[assignment]
    return noise > random.uniform(0.5, 1.5), False


def padded(size: int, window: Window) -> Window:
    """A window of ``size`` px of one that may be smaller; what is added counts nowhere."""
    height, width = window["x"].shape[-2:]
    pad = ((0, size - height), (0, size - width))
    added = {"exists": True, "order": IGNORED}
    return {
        name: np.pad(maps, ((0, 0),) * (maps.ndim - 2) + pad, constant_values=added.get(name, 0))
        for name, maps in window.items()
    }


def symmetric(window: Window, channels: Sequence[str], turn: int) -> Window:
    """The window of a `PhaseNet`, whose input has ``channels``, in one of the 8 orientations of a
    square: bit 0 of ``turn`` flips rows, bit 1 columns, bit 2 swaps them. What points somewhere is
    turned with it."""
    window = window | {"x": window["x"].copy()}
    slopes = [channels.index("slope down"), channels.index("slope right")]
    places = list(SIDES)
    for axis, slope in enumerate(slopes):
        if turn & (1 << axis):
            window = {name: np.flip(maps, axis - 2) for name, maps in window.items()}
            window["x"][slope] *= -1
            places = [
                (-row, column) if slope == slopes[0] else (row, -column) for row, column in places
            ]
    if turn & 4:
        window = {name: maps.swapaxes(-1, -2) for name, maps in window.items()}
        window["x"][slopes] = window["x"][slopes[::-1]]
        places = [(column, row) for row, column in places]
    x, first, count = window["x"], len(channels) - len(SIDE_CHANNELS), len(SIDES)
    order = np.array([places.index(side) for side in SIDES])
    x[first:] = x[[*(first + order), first + count, *(first + count + 1 + order)]]
    return {name: np.ascontiguousarray(maps) for name, maps in window.items()}


def view_scores(
    sample: Sample, inside: Mask, found_mm: NDArray, true_mm: NDArray
) -> dict[str, float]:
    """Scores of a view from its mask ``inside``, the depth found there and the true one, (h, w)
    each. ``object_mae_mm`` counts a missed pixel with its whole depth; ``missed_percent``: share of
    the object's pixels; ``invented_kpx``: background pixels with a depth, in thousands."""
    detected, true = inside[sample.target], true_mm[sample.target]
    error = np.minimum(np.abs(np.nan_to_num(found_mm[sample.target]) - true), true)
    return {
        "object_mae_mm": float(np.where(detected, error, true).mean(dtype=np.float64)),
        "missed_percent": 100 * float((~detected).mean()),
        "invented_kpx": float((inside & ~sample.target & ~sample.void).sum()) / 1000,
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
    growth: float = 1.0,
) -> float:
    """The threshold, out of the rising ``thresholds`` on the mask's logit, with the least sum of
    object and background error: a missed object pixel and an invented background pixel are off by
    the same distance, each divided by the number of pixels of its kind. ``views``: each with the
    mask that it gets by a threshold; ``pixels``: of a whole image. Among the thresholds within
    ``tolerance_mm`` of the least, the lowest: it misses the fewest pixels. With a ``growth`` the
    lowest whose background error is at most so many times that one's: few missed pixels make most
    of the squared error of the object."""
    found = []
    for truth, decided in views:
        object_px, row = max(int(truth.target.sum()), 1), []
        for threshold in thresholds:
            inside = decided(threshold)
            missed, invented = (
                (truth.target & ~inside).sum(),
                (inside & ~truth.target & ~truth.void).sum(),
            )
            row.append(
                (TYPICAL_MM * missed / object_px, TYPICAL_MM * invented / (pixels - object_px))
            )
        found.append(row)
    missed_mm, invented_mm = np.mean(found, axis=0).T
    both = missed_mm + invented_mm
    chosen = np.flatnonzero(both <= both.min() + tolerance_mm)[0]
    return thresholds[int(np.flatnonzero(invented_mm <= growth * invented_mm[chosen])[0])]
