"""The choice of each pixel's fringe order, without learning: by brightness and smoothness (docs/phase_and_order.md).

The phase fixes how fast 1/Z changes along the surface, the order fixes Z itself: together they give distance and normal
of every candidate, and so the brightness of a matte surface there. That assumes the same albedo for plane and objects,
which is true of the paper's scenes (Section 2.2) but not of painted objects: `PhaseMethod(shading=False)`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from fpp_ml_bench.baselines.phase.calibration_layer import TAU, CalibrationLayer, Image, Mask, wrapped
from fpp_ml_bench.baselines.phase.labels import LARGE, least_energy
from fpp_ml_bench.baselines.phase.object_mask import Crop
from fpp_ml_bench.baselines.phase.observation import Observation, Settings
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.optics.rig import Rig

NODES_PER_PERIOD = 7.5  # grid points along a period: every third pixel at 960 px
EVIDENCE_PERIODS = 2.0
"""Side of the square over which evidence for an order is averaged: a single pixel's brightness is too uncertain."""
LEAST_BRIGHTNESS = 1e-3  # least irradiance whose logarithm is taken, 1/m^2: a surface turned away
LEAST_GREY = 0.1  # least brightness, in grey levels, whose logarithm is taken
JUMP_RAD_PER_PX, JUMP_LOG_PER_PX = 0.1, 0.06
"""Change of residual phase, and of log brightness, from which on two neighbours with a phase of their own lie on two
surfaces."""
JUMP_WEIGHT = 0.05  # weight of the link between two such neighbours


@dataclass(frozen=True)
class Question:
    """All that a `Chooser` may use: K candidates a pixel on the grid (h, w) of every ``stride``-th pixel, nearest order
    first. ``residual_rad``, ``depth_mm``, ``exists`` and ``irradiance`` (1/m^2) are (K, h, w); ``brightness``:
    measured, in 1/m^2; ``trust`` 0 to 1: weight of the brightness there (small at rims and on dark slopes); ``inside``:
    object; ``smooth_x`` (h, w - 1) and ``smooth_y`` (h - 1, w): how much neighbours should agree."""

    residual_rad: Image
    depth_mm: Image
    exists: Mask
    irradiance: Image
    brightness: Image
    trust: Image
    inside: Mask
    stride: int
    period_px: float
    smooth_x: Image | float
    smooth_y: Image | float


Chooser = Callable[[Question, Rig, Settings], tuple[NDArray[np.int32], Image]]
"""Index of the chosen candidate int32 (h, w), and how clearly it won, float32: 0 for a tie, 1 or more for certain."""


def grid_of(stride: int, crop: Crop = (slice(None), slice(None))) -> Crop:
    """Every ``stride``-th row and column of ``crop``."""
    return slice(crop[0].start, crop[0].stop, stride), slice(crop[1].start, crop[1].stop, stride)


def links_between(inside: Mask) -> tuple[Image, Image]:
    """Links along x (h, w - 1) and y (h - 1, w), float32: 1 between two object pixels, else 0."""
    pairs = (inside[:, 1:], inside[:, :-1]), (inside[1:], inside[:-1])
    link_x, link_y = ((a & b).astype(np.float32) for a, b in pairs)
    return link_x, link_y


def chosen_values(values: NDArray, choice: NDArray) -> NDArray:
    """``values`` (K, h, w) of the candidate chosen at each pixel, (h, w)."""
    return np.take_along_axis(values, choice[None].astype(np.intp), axis=0)[0]


def stride_of(period_px: float) -> int:
    """Image px a step of the grid on which orders are chosen."""
    return max(1, round(period_px / NODES_PER_PERIOD))


def question_of(seen: Observation) -> Question:
    """The question for what was measured in a capture."""
    stride = stride_of(seen.period_px)
    grid, where, rig, fit = grid_of(stride), grid_of(stride, seen.crop), seen.rig, seen.fit
    layer = seen.layer.at(grid)
    count = np.maximum(seen.candidates.count[grid], 1)
    first, phase = seen.candidates.first[grid], seen.phase_rad[grid]
    steps = range(int(count.max(initial=1)))
    residual = np.stack([layer.residual_phase(phase, first + k) for k in steps]).astype(np.float32)
    grid_slopes = seen.slopes[0][grid], seen.slopes[1][grid]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        light = np.stack([irradiance(layer, candidate, grid_slopes, rig, where) for candidate in residual])
        depth = np.stack([layer.depth_of_residual_mm(candidate) for candidate in residual]).astype(np.float32)
    # NaN where the lamp's strength is unknown: then brightness tells nothing, and no evidence separates orders.
    brightness = fit.brightness[grid] / np.float32(seen.background.strength / 2)
    lit = np.nan_to_num(np.clip(brightness * rig.standoff_m**2, 0.02, 1), nan=1.0)
    trust = np.clip((fit.weight[grid] - 0.4) / 0.5, 0.05, 1) * lit**2
    exists = np.stack([k < count for k in steps])
    # Jumps between neighbours show where every pixel has a phase of its own.
    smooth = jump_links(residual[0], fit.brightness[grid], stride) if seen.pixelwise else (1.0, 1.0)
    trust, inside = trust.astype(np.float32), seen.inside[grid]
    return Question(residual, depth, exists, light, brightness, trust, inside, stride, seen.period_px, *smooth)


def irradiance(
    layer: CalibrationLayer, residual_rad: NDArray, slopes: tuple[Image, Image], rig: Rig, crop: Crop
) -> Image:
    """cos(theta) / r^2 in 1/m^2 that a matte surface receives from the projector, float32 (H, W); below 0: turned away.
    ``residual_rad`` (H, W) of one candidate on the pixels ``crop`` of the image, ``slopes`` its change a px."""
    x, y = (axis[crop].astype(np.float32) for axis in rig.camera.rays())
    z = (layer.depth_of_residual_mm(residual_rad) / MM_PER_M).astype(np.float32)
    if layer.lens is None:
        rate = -layer.gain / (residual_rad * residual_rad * layer.forward)
    else:
        rate = (layer.depth_of_residual_mm(residual_rad + 1e-3) / MM_PER_M - z) / 1e-3
    # At a fixed psi depth still changes with the pixel where the projector is rotated against the camera.
    drifts = [_drift(layer, residual_rad, z, axis, crop) for axis in (1, 0)]
    zx, zy = ((rate * slope + drift).astype(np.float32) for slope, drift in zip(slopes, drifts, strict=True))
    dx, dy = np.float32(1 / rig.camera.fx), np.float32(1 / rig.camera.fy)
    # Tangents of the surface Z (x, y, 1) along the image's rows and columns, and their cross product.
    ax, ay, az = zx * x + z * dx, zx * y, zx
    bx, by, bz = zy * x, zy * y + z * dy, zy
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    cx, cy, cz = (np.float32(c) for c in -rig.R.T @ rig.t)
    lx, ly, lz = cx - z * x, cy - z * y, cz - z
    squared = lx * lx + ly * ly + lz * lz
    length = np.sqrt((nx * nx + ny * ny + nz * nz) * squared)
    return -(nx * lx + ny * ly + nz * lz) / (length * squared)


def _drift(layer: CalibrationLayer, residual_rad: NDArray, z: Image, axis: int, crop: Crop) -> NDArray | float:
    """Change of depth in m a px along ``axis`` at a fixed residual phase."""
    if min(layer.gain.shape) < 2:
        return 0.0
    step = crop[axis].step or 1
    gain, forward = (np.gradient(values, axis=axis) / step for values in (layer.gain, layer.forward))
    if not gain.any() and not forward.any():
        return 0.0
    return (gain / residual_rad - z * forward) / layer.forward


def jump_links(residual_rad: Image, brightness: Image, stride: int) -> tuple[Image, Image]:
    """Weights of the links along x (h, w - 1) and y (h - 1, w): less where the surface visibly jumps."""
    log_brightness = np.log(np.maximum(brightness, LEAST_GREY))
    links = []
    for axis in (1, 0):
        jump = np.abs(wrapped(np.diff(residual_rad, axis=axis))) > JUMP_RAD_PER_PX * stride
        jump |= np.abs(np.diff(log_brightness, axis=axis)) > JUMP_LOG_PER_PX * stride
        links.append(np.where(jump, np.float32(JUMP_WEIGHT), np.float32(1)))
    return links[0], links[1]


def by_shading_and_smoothness(question: Question, rig: Rig, settings: Settings) -> tuple[NDArray[np.int32], Image]:
    """The chooser without learning: brightness and prior as costs, smoothness by `least_energy`."""
    cost = np.zeros_like(question.residual_rad)
    if settings.shading:
        with np.errstate(divide="ignore", invalid="ignore"):
            expected = np.maximum(question.irradiance, LEAST_BRIGHTNESS)
            ratio = np.maximum(question.brightness, LEAST_BRIGHTNESS) / expected
            misfit = np.abs(np.log(np.nan_to_num(ratio, nan=1.0))) / np.float32(settings.shading_spread)
        cost += np.float32(settings.shading_cost) * np.minimum(misfit, settings.shading_limit) * question.trust
    if settings.prior == "standoff":
        offset = np.abs(question.depth_mm - np.float32(rig.standoff_m * MM_PER_M)) / 100
        cost += np.float32(settings.prior_cost) * np.minimum(np.nan_to_num(offset, nan=10.0), 10)
    largest = max(settings.shading_cost * settings.shading_limit * settings.shading, settings.prior_cost)
    proof = cost / np.float32(largest)
    proof[~question.exists] = 2.0
    cost *= question.stride**2
    cost = np.where(question.inside, np.where(question.exists, cost, LARGE), np.float32(0)).astype(np.float32)
    link_x, link_y = links_between(question.inside)
    links = link_x * question.smooth_x, link_y * question.smooth_y
    choice, margin = least_energy(cost, question.residual_rad, *links, settings.jump_rad)
    return choice, np.minimum(margin / np.float32(settings.jump_rad), _evidence(proof, choice, question))


def _evidence(proof: Image, choice: NDArray[np.int32], question: Question) -> Image:
    """By how much the cost of the second-best order exceeds that of the choice, averaged over object pixels nearby."""
    if len(proof) == 1:
        return np.full(choice.shape, 2.0, np.float32)
    rivals = proof.copy()
    np.put_along_axis(rivals, choice[None].astype(np.intp), np.inf, axis=0)
    gap = ((rivals.min(axis=0) - chosen_values(proof, choice)) * question.inside).astype(np.float32)
    side = 2 * max(1, round(EVIDENCE_PERIODS * question.period_px / question.stride / 2)) + 1
    maps = (gap, question.inside.astype(np.float32))
    mean_gap, share = (cv2.blur(values, (side, side), borderType=cv2.BORDER_CONSTANT) for values in maps)
    return mean_gap / np.maximum(share, 1e-3)  # type: ignore[return-value]  # cv2 keeps float32


def repeated(coarse: NDArray, stride: int, shape: tuple[int, ...]) -> NDArray:
    """Maps (..., h', w') of every ``stride``-th pixel as maps of all (..., h, w); ``shape`` (..., h, w)."""
    return coarse.repeat(stride, axis=-2).repeat(stride, axis=-1)[..., : shape[-2], : shape[-1]]


def nearest_inside(inside: Mask) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns (h, w) of the pixel of ``inside`` that is nearest to every pixel; every pixel's own where
    ``inside`` has none."""
    if inside.all() or not inside.any():
        places: NDArray = np.indices(inside.shape)
    else:
        places = distance_transform_edt(~inside, return_distances=False, return_indices=True)
    return places[0], places[1]


def spread_over_pixels(
    seen: Observation, chosen_rad: Image, margin: Image, inside: Mask
) -> tuple[NDArray[np.int32], Image]:
    """Order of every pixel, int32 (H, W), and its margin: the order whose residual phase is nearest to that which was
    chosen at the grid point; ``inside``: object on the grid."""
    nearest = nearest_inside(inside)
    chosen_rad, margin = chosen_rad[nearest], margin[nearest]
    residual_at_zero_rad = seen.layer.residual_phase(seen.phase_rad, 0.0)
    stride, shape = stride_of(seen.period_px), residual_at_zero_rad.shape
    order = np.rint((repeated(chosen_rad, stride, shape) - residual_at_zero_rad) / TAU).astype(np.int32)
    return order, repeated(margin, stride, shape)
