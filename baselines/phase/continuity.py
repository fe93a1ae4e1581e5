"""Fringe orders from the working range alone, without brightness: the whole of a smooth surface must lie in the range.

A single pixel often has several orders in the range. Over a smooth surface, all pixels share one error of the order. So
an order is settled if every other order would put a part of the surface outside the range. If another order keeps the
whole surface inside, the two can't be distinguished, and the order is ambiguous.
"""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from fpp_ml_bench.baselines.phase.calibration_layer import TAU, Image, Mask
from fpp_ml_bench.baselines.phase.object_mask import disk
from fpp_ml_bench.baselines.phase.observation import Observation

STEEPEST_PERIODS = 1.2
"""Largest change of the residual phase along a period of the image, in periods, within a smooth surface: a window that
covers both sides of a depth edge turns the jump into a slope, mostly a larger one."""
LARGEST_MISFIT, MISFIT_PERIODS = 0.4, 0.06
"""Largest misfit of the fringe over its brightness within a surface, and the Gaussian, in periods, under which it is
averaged: a depth edge is a line along which the window's fringe is not seen, whatever the phases of both sides."""
NECK_PERIODS = 0.25
"""Half the width of the narrowest connection between parts of a surface. Along a depth edge the jump is a whole number
of periods here and there, and looks continuous; such places are short."""
LEAST_AREA_PERIODS = 0.5  # smallest surface, in squares of one period
OUT_SHARE, OUT_AREA_PERIODS = 0.05, 0.1
"""Share of a surface, and its area in squares of one period, that must leave the range for an order to be ruled out."""
REACH_PERIODS = 0.35
CONTINUES_RAD = 0.8
"""Distance from a settled surface, and difference of the residual phase, within which a pixel continues it."""
SURE, LIKELY = 1.0, 0.03
"""Margins of an order that is settled, and of one that may well be wrong, so that its stated uncertainty is a good part
of an order: at the edge of a surface the phase may be that of two."""


def margin_by_range(seen: Observation, order: NDArray[np.int32]) -> Image:
    """Margin of ``order`` (h, w), float32: `SURE` where range and continuity rule every other order out, `LIKELY` where
    the range leaves a pixel alone one order, or beside a settled surface that it continues, else 0."""
    residual = seen.layer.residual_phase(seen.phase_rad, order)
    steepness = np.hypot(*_slopes(residual, seen.inside)) * seen.period_px / TAU
    smooth = seen.inside & (steepness < STEEPEST_PERIODS) & (_misfit(seen) < LARGEST_MISFIT)
    neck, square = disk(NECK_PERIODS * seen.period_px), seen.period_px**2
    cores = cv2.morphologyEx(smooth.astype(np.uint8), cv2.MORPH_OPEN, neck)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(cores, connectivity=4)
    areas = stats[:, cv2.CC_STAT_AREA]
    settled = areas >= LEAST_AREA_PERIODS * square
    settled[0] = False
    for rival in (-1, 1):  # the range is an interval: an order further away leaves it with more pixels
        outside = np.bincount(labels[~_in_range(seen, order + rival)], minlength=count)
        settled &= (outside > OUT_SHARE * areas) & (outside > OUT_AREA_PERIODS * square)
    settled &= np.bincount(labels[~_in_range(seen, order)], minlength=count) < OUT_SHARE * areas
    sure = settled[labels]
    likely = seen.inside & (seen.candidates.count == 1)
    if sure.any():
        distance, (y, x) = distance_transform_edt(~sure, return_indices=True)
        continues = np.abs(residual - residual[y, x]) < CONTINUES_RAD
        likely |= seen.inside & continues & (distance < REACH_PERIODS * seen.period_px)
    return np.select([sure, likely], [np.float32(SURE), np.float32(LIKELY)], np.float32(0))


def _misfit(seen: Observation) -> Image:
    """Misfit of the fringe in the first frame over its brightness, (h, w), on the scale of a depth edge's line."""
    misfit = seen.greys[0] - np.float32(seen.background.ambient_grey) - seen.fit.light
    relative = np.where(seen.inside, misfit / np.maximum(seen.fit.brightness, 1), 0).astype(np.float32)
    return np.sqrt(cv2.GaussianBlur(relative * relative, (0, 0), MISFIT_PERIODS * seen.period_px))


def _in_range(seen: Observation, order: NDArray[np.int32]) -> Mask:
    first, count = seen.candidates.first, seen.candidates.count
    return (order >= first) & (order < first + count)


def _slopes(residual_rad: Image, inside: Mask) -> tuple[Image, Image]:
    """Larger of the two one-sided changes a px along x and y, between object pixels."""
    slopes = []
    for axis in (1, 0):
        pair = np.delete(inside, 0, axis) & np.delete(inside, -1, axis)
        change = np.abs(np.diff(residual_rad, axis=axis)) * pair
        ends = [(1, 0), (0, 1)]
        padded = [np.pad(change, [end if along == axis else (0, 0) for along in (0, 1)]) for end in ends]
        slopes.append(np.maximum(*padded))
    return slopes[0], slopes[1]
