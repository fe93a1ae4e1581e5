"""The choice of each pixel's fringe order, without learning.

`Question` holds all that a chooser may use, on a grid of every `stride`-th pixel: for each candidate order its residual
phase, its depth and the brightness that it predicts, and the measured brightness. `by_shading_and_smoothness` minimises
an energy; a learned chooser with the same signature can replace it (`PhaseRoute(rig, settings, chooser)`).
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route.calibration_layer import TAU, CalibrationLayer, Candidates
from fpp_ml_bench.baselines.phase_route.labels import LARGE, least_energy
from fpp_ml_bench.baselines.phase_route.local_fit import FringeFit
from fpp_ml_bench.baselines.phase_route.settings import Settings
from fpp_ml_bench.baselines.phase_route.shading import irradiance
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.optics import Rig

Image = NDArray[np.float32]

NODES_PER_PERIOD = 7.5
"""Grid points along a period: every third pixel at 960 px."""
EVIDENCE_PERIODS = 2.0
"""Side of the square over which evidence for an order is averaged: a single pixel's brightness is too uncertain."""
LEAST_BRIGHTNESS = 1e-3
"""Least irradiance whose logarithm is taken, 1/m^2: a surface turned away."""
JUMP_RAD_PER_PX, JUMP_LOG_PER_PX = 0.1, 0.06
"""Change of residual phase, and of log brightness, from which on two neighbours with a phase of their own lie on two
surfaces."""
JUMP_WEIGHT = 0.05
"""Weight of the link between two such neighbours."""


@dataclass(frozen=True)
class Question:
    """K candidates a pixel on the grid (h, w), nearest order first: ``residual_rad``, ``depth_mm``, ``exists`` and
    ``irradiance`` (1/m^2) are (K, h, w); ``brightness``: measured, in the same 1/m^2; ``trust`` 0 to 1: weight of the
    brightness there (small at rims and on dark slopes); ``inside``: object; ``stride``: image px a grid step;
    ``smooth_x`` (h, w - 1) and ``smooth_y`` (h - 1, w): how much neighbours should agree, None for everywhere.
    """

    residual_rad: Image
    depth_mm: Image
    exists: NDArray[np.bool_]
    irradiance: Image
    brightness: Image
    trust: Image
    inside: NDArray[np.bool_]
    stride: int
    period_px: float
    smooth_x: Image | None = None
    smooth_y: Image | None = None


Chooser = Callable[[Question, Rig, Settings], tuple[NDArray[np.int32], Image]]
"""Index of the chosen candidate int32 (h, w), and how clearly it won, float32: 0 for a tie, 1 or more for certain."""


def question_of(
    phase_rad: Image,
    fit: FringeFit,
    slopes: tuple[Image, Image],
    candidates: Candidates,
    inside: NDArray[np.bool_],
    layer: CalibrationLayer,
    rig: Rig,
    crop: tuple[slice, slice],
    strength: float,
    period_px: float,
    sharp: bool = False,
) -> Question:
    """The question for a part of the image: arrays (H, W) of the pixels ``crop``; ``strength`` from `Background`;
    ``sharp``: whether every pixel has a phase of its own, so that jumps between neighbours show."""
    stride = max(1, round(period_px / NODES_PER_PERIOD))
    grid = (slice(None, None, stride), slice(None, None, stride))
    grid_layer = layer.at(grid)
    where = tuple(slice(side.start, side.stop, stride) for side in crop)
    count = np.maximum(candidates.count[grid], 1)
    first, phase = candidates.first[grid], phase_rad[grid]
    steps = range(int(count.max(initial=1)))
    residual = np.stack([grid_layer.residual_phase(phase, first + k) for k in steps]).astype(np.float32)
    grid_slopes = slopes[0][grid], slopes[1][grid]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        light = np.stack([irradiance(grid_layer, candidate, grid_slopes, rig, where) for candidate in residual])  # type: ignore[arg-type]
        depth = np.stack([grid_layer.depth_of_residual_mm(candidate) for candidate in residual]).astype(np.float32)
    brightness = fit.brightness[grid] / np.float32(strength / 2)
    trust = np.clip((fit.weight[grid] - 0.4) / 0.5, 0.05, 1) * np.clip(brightness * rig.standoff_m**2, 0.02, 1) ** 2
    exists = np.stack([k < count for k in steps])
    smooth = _smooth_links(residual[0], brightness, stride) if sharp else (None, None)
    return Question(
        residual, depth, exists, light, brightness, trust.astype(np.float32), inside[grid], stride, period_px, *smooth
    )


def _smooth_links(residual_rad: Image, brightness: Image, stride: int) -> tuple[Image, Image]:
    """Weights of the links along x (h, w - 1) and y (h - 1, w): less where the surface visibly jumps."""
    log_brightness = np.log(np.maximum(brightness, LEAST_BRIGHTNESS))
    links = []
    for axis in (1, 0):
        change = np.diff(residual_rad, axis=axis)
        change -= np.float32(TAU) * np.rint(change / np.float32(TAU))
        jump = (np.abs(change) > JUMP_RAD_PER_PX * stride) | (
            np.abs(np.diff(log_brightness, axis=axis)) > JUMP_LOG_PER_PX * stride
        )
        links.append(np.where(jump, np.float32(JUMP_WEIGHT), np.float32(1)))
    return links[0], links[1]


def by_shading_and_smoothness(question: Question, rig: Rig, settings: Settings) -> tuple[NDArray[np.int32], Image]:
    """The chooser without learning: brightness and prior as costs, smoothness by `least_energy`."""
    cost = np.zeros_like(question.residual_rad)
    if settings.shading:
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.maximum(question.brightness, LEAST_BRIGHTNESS) / np.maximum(
                question.irradiance, LEAST_BRIGHTNESS
            )
            misfit = np.abs(np.log(np.nan_to_num(ratio, nan=1.0))) / np.float32(settings.shading_spread)
        cost += np.float32(settings.shading_cost) * np.minimum(misfit, settings.shading_limit) * question.trust
    if settings.prior == "standoff":
        offset = np.abs(question.depth_mm - np.float32(rig.standoff_m * MM_PER_M)) / 100
        cost += np.float32(settings.prior_cost) * np.minimum(np.nan_to_num(offset, nan=10.0), 10)
    inside = question.inside
    proof = cost / np.float32(
        max(settings.shading_cost * settings.shading_limit * settings.shading, settings.prior_cost)
    )
    proof[~question.exists] = 2.0
    cost *= question.stride**2
    cost = np.where(inside, np.where(question.exists, cost, LARGE), np.float32(0)).astype(np.float32)
    link_x, link_y = (
        (a & b).astype(np.float32) for a, b in ((inside[:, 1:], inside[:, :-1]), (inside[1:], inside[:-1]))
    )
    if question.smooth_x is not None and question.smooth_y is not None:
        link_x, link_y = link_x * question.smooth_x, link_y * question.smooth_y
    choice, margin = least_energy(cost, question.residual_rad, link_x, link_y, settings.jump_rad)
    return choice, np.minimum(margin / np.float32(settings.jump_rad), _evidence(proof, choice, question))


def _evidence(proof: Image, choice: NDArray[np.int32], question: Question) -> Image:
    """By how much the cost of the second-best order exceeds that of the choice, averaged over object pixels nearby."""
    if len(proof) == 1:
        return np.full(choice.shape, 2.0, np.float32)
    own = np.take_along_axis(proof, choice[None].astype(np.intp), axis=0)[0]
    rivals = proof.copy()
    np.put_along_axis(rivals, choice[None].astype(np.intp), np.inf, axis=0)
    gap = ((rivals.min(axis=0) - own) * question.inside).astype(np.float32)
    side = 2 * max(1, round(EVIDENCE_PERIODS * question.period_px / question.stride / 2)) + 1
    mean = cv2.blur(gap, (side, side), borderType=cv2.BORDER_CONSTANT)
    return mean / np.maximum(
        cv2.blur(question.inside.astype(np.float32), (side, side), borderType=cv2.BORDER_CONSTANT), 1e-3
    )


def spread_over_pixels(
    question: Question, choice: NDArray[np.int32], margin: Image, residual_at_zero: NDArray
) -> tuple[NDArray[np.int32], Image]:
    """Order of every pixel, int32 (H, W), and its margin: the order whose residual phase is nearest to that of the
    grid point's choice.

    ``residual_at_zero`` (H, W): residual phase at order 0.
    """
    from scipy.ndimage import distance_transform_edt

    chosen_rad = np.take_along_axis(question.residual_rad, choice[None].astype(np.intp), axis=0)[0]
    if question.inside.any() and not question.inside.all():
        y, x = distance_transform_edt(~question.inside, return_distances=False, return_indices=True)
        chosen_rad, margin = chosen_rad[y, x], margin[y, x]
    height, width = residual_at_zero.shape
    residual_rad, fine_margin = (
        grid_map.repeat(question.stride, axis=0).repeat(question.stride, axis=1)[:height, :width]
        for grid_map in (chosen_rad, margin)
    )
    return np.rint((residual_rad - residual_at_zero) / TAU).astype(np.int32), fine_margin
