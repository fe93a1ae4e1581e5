"""The question which order each pixel has, and its answer without learning.

`Question` holds all that a chooser may look at, on a grid of every `STRIDE`-th pixel: for each candidate its residual
phase, depth and the brightness it would mean, and what was seen. `by_shading_and_smoothness` answers it with a least
energy; a learned chooser with the same signature can take its place (`PhaseRoute(rig, settings, chooser)`).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route.calibration_layer import TAU, CalibrationLayer, Candidates
from fpp_ml_bench.baselines.phase_route.labels import LARGE, least_energy
from fpp_ml_bench.baselines.phase_route.local_fit import FringeFit
from fpp_ml_bench.baselines.phase_route.settings import Settings
from fpp_ml_bench.baselines.phase_route.shading import irradiance
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.rig import Rig

Image = NDArray[np.float32]

STRIDE = 3
LEAST_BRIGHTNESS = 1e-3
"""Least irradiance whose logarithm is taken, 1/m^2: a surface turned away."""


@dataclass(frozen=True)
class Question:
    """K candidates a pixel on the grid (h, w), nearest order first: ``residual_rad``, ``depth_mm``, ``exists`` and
    ``irradiance`` (1/m^2) are (K, h, w); ``brightness``: measured, in the same 1/m^2; ``trust`` 0 to 1: how much the
    brightness says there (rims and dark slopes say little); ``inside``: object.
    """

    residual_rad: Image
    depth_mm: Image
    exists: NDArray[np.bool_]
    irradiance: Image
    brightness: Image
    trust: Image
    inside: NDArray[np.bool_]


Chooser = Callable[[Question, Rig, Settings], tuple[NDArray[np.int32], Image]]
"""Place of the chosen candidate int32 (h, w), and the margin to the second best, float32, larger is surer."""


def ask(
    phase_rad: Image,
    fit: FringeFit,
    slopes: tuple[Image, Image],
    candidates: Candidates,
    inside: NDArray[np.bool_],
    layer: CalibrationLayer,
    rig: Rig,
    crop: tuple[slice, slice],
    strength: float,
) -> Question:
    """The question for a part of the image: arrays (H, W) of the pixels ``crop``; ``strength`` from `Background`."""
    grid = (slice(None, None, STRIDE), slice(None, None, STRIDE))
    here = layer.at(grid)
    where = tuple(slice(one.start, one.stop, STRIDE) for one in crop)
    count = np.maximum(candidates.count[grid], 1)
    first, phase = candidates.first[grid], phase_rad[grid]
    steps = range(int(count.max(initial=1)))
    residual = np.stack([here.residual_phase(phase, first + k) for k in steps]).astype(np.float32)
    slope = slopes[0][grid], slopes[1][grid]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        light = np.stack([irradiance(here, one, slope, rig, where) for one in residual])  # type: ignore[arg-type]
        depth = np.stack([here.depth_of_residual_mm(one) for one in residual]).astype(np.float32)
    seen = fit.brightness[grid] / np.float32(strength / 2)
    trust = np.clip((fit.weight[grid] - 0.4) / 0.5, 0.05, 1) * np.clip(seen * rig.standoff_m**2, 0.02, 1) ** 2
    exists = np.stack([k < count for k in steps])
    return Question(residual, depth, exists, light, seen, trust.astype(np.float32), inside[grid])


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
        off = np.abs(question.depth_mm - np.float32(rig.standoff_m * MM_PER_M)) / 100
        cost += np.float32(settings.prior_cost) * np.minimum(np.nan_to_num(off, nan=10.0), 10)
    cost *= STRIDE * STRIDE
    inside = question.inside
    cost = np.where(inside, np.where(question.exists, cost, LARGE), np.float32(0)).astype(np.float32)
    link_x, link_y = (
        (a & b).astype(np.float32) for a, b in ((inside[:, 1:], inside[:, :-1]), (inside[1:], inside[:-1]))
    )
    return least_energy(cost, question.residual_rad, link_x, link_y, settings.jump_rad)


def spread_over_pixels(
    question: Question, choice: NDArray[np.int32], margin: Image, residual_at_zero: NDArray
) -> tuple[NDArray[np.int32], Image]:
    """Order of every pixel, int32 (H, W), and its margin: of its own orders the one nearest to its grid point's choice.

    ``residual_at_zero`` (H, W): residual phase that order 0 would mean.
    """
    from scipy.ndimage import distance_transform_edt

    chosen = np.take_along_axis(question.residual_rad, choice[None].astype(np.intp), axis=0)[0]
    if question.inside.any() and not question.inside.all():
        y, x = distance_transform_edt(~question.inside, return_distances=False, return_indices=True)
        chosen, margin = chosen[y, x], margin[y, x]
    height, width = residual_at_zero.shape
    fine = [chosen, margin]
    fine = [one.repeat(STRIDE, axis=0).repeat(STRIDE, axis=1)[:height, :width] for one in fine]
    return np.rint((fine[0] - residual_at_zero) / TAU).astype(np.int32), fine[1]
