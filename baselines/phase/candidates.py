"""Second stop: the depths that a measured phase allows at every point of a grid, and what is known
of each.

One carrier alone: each order that puts a pixel into the working range. Two carriers: each order of
the carrier with the larger gain, at the nearness that fits both phases best, and the distance of
both phases from it. Three crossed frames: the orders of the shifted carrier, whose phase has no
error.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.geometry import (
    TAU,
    CalibrationLayer,
    Crop,
    Image,
    Mask,
    grid_of,
    main_carrier,
    wrapped,
)
from fpp_ml_bench.baselines.phase.observe import Capture, CrossedObservation, Observation
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.optics.rig import Rig

LEAST_GREY = 0.1
"""Least brightness, in grey levels, whose logarithm is taken: a tenth of a level, so that black
pixels give a finite number."""
JUMP_RAD_PER_PX = 0.1
"""Change of the residual phase per px from which on two neighbours lie on two surfaces. Used only
where every pixel has a phase of its own. A smaller limit cuts steep surfaces apart."""
JUMP_LOG_PER_PX = 0.06
"""Change of the log brightness per px from which on two such neighbours lie on two surfaces. A
smaller limit cuts shaded or textured surfaces apart."""
JUMP_WEIGHT = 0.05
"""Factor on the link between two such neighbours. Above 0, so that a pixel between two jumps still
follows its neighbours a little."""
WELL_LIT = 8.0
"""Modulation over the image's noise from which on a window's phase counts fully as evidence. Below
it, the weight falls in proportion."""
LEAST_TRUST = 0.05
"""Least weight, 0 to 1, of the evidence at a point. Above 0, so that evidence in the dark still
decides where no neighbour does."""


@dataclass(frozen=True)
class Candidates:
    """K candidates a point: maps (K, h, w). ``phase_rad`` float32: by which neighbours are
    compared; ``exists``: whether it lies in the working range; ``trust`` (h, w) float32, 0 to 1:
    weight of the evidence there; ``inside`` (h, w): object; ``links`` (h, w - 1) and (h - 1, w)
    float32: how much neighbours along x and y should agree, 0 where one of them is not object."""

    phase_rad: Image
    exists: Mask
    trust: Image
    inside: Mask
    links: tuple[Image, Image]


@dataclass(frozen=True)
class FringeCandidates(Candidates):
    """Orders of one carrier, the lowest first; ``phase_rad``: residual phase. ``depth_mm`` and
    ``irradiance`` (1/m^2): of a matte surface there; ``brightness`` (h, w): measured, in 1/m^2;
    ``trust``: small at rims and dark slopes."""

    depth_mm: Image
    irradiance: Image
    brightness: Image


@dataclass(frozen=True)
class CrossedCandidates(Candidates):
    """Orders of two carriers, the furthest first; ``phase_rad``: joint phase. ``nearness`` q,
    ``misfit_rad``: distance of both phases from those at q."""

    nearness: NDArray[np.float32]
    misfit_rad: Image


def links_between(inside: Mask) -> tuple[Image, Image]:
    """Links along x (h, w - 1) and y (h - 1, w), float32: 1 between two object pixels, else 0."""
    pairs = (inside[:, 1:], inside[:, :-1]), (inside[1:], inside[:-1])
    link_x, link_y = ((a & b).astype(np.float32) for a, b in pairs)
    return link_x, link_y


def chosen_values(values: NDArray, choice: NDArray) -> NDArray:
    """``values`` (K, h, w) of the candidate chosen at each pixel, (h, w)."""
    return np.take_along_axis(values, choice[None].astype(np.intp), axis=0)[0]


def fringe_candidates(seen: Observation) -> FringeCandidates:
    """The orders that the working range allows; where it allows none, the nearest."""
    grid, where = grid_of(seen.stride), grid_of(seen.stride, seen.crop)
    layer, orders = seen.layer.at(grid), seen.candidates
    count = np.maximum(orders.count[grid], 1)
    steps = np.arange(count.max(initial=1))[:, None, None]
    phase = layer.residual_phase(seen.phase_rad[grid], orders.first[grid] + steps).astype(
        np.float32
    )
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        light = irradiance(
            layer, phase, (seen.slopes[0][grid], seen.slopes[1][grid]), seen.rig, where
        )
        depth = layer.depth_of_residual_mm(phase).astype(np.float32)
    # NaN where the lamp's strength is unknown: then brightness tells nothing, and no evidence
    # separates orders.
    brightness = seen.fit.brightness[grid] / np.float32(seen.background.strength / 2)
    lit = np.nan_to_num(np.clip(brightness * seen.rig.standoff_m**2, 0.02, 1), nan=1.0)
    trust = np.clip((seen.fit.weight[grid] - 0.4) / 0.5, 0.05, 1) * lit**2
    inside, trust = seen.inside[grid], trust.astype(np.float32)
    links = _links(seen, inside, phase[0], seen.fit.brightness[grid])
    return FringeCandidates(phase, steps < count, trust, inside, links, depth, light, brightness)


def crossed_candidates(seen: CrossedObservation) -> CrossedCandidates:
    """All orders in the range. Of a shifted carrier the phase has no error: the orders are its
    orders, and it alone tells the nearness."""
    carriers, noise_grey = seen.carriers.at(grid_of(seen.stride)), seen.background.noise_grey
    gain, moved = carriers.gain, seen.moved
    main = main_carrier(gain) if moved is None else moved
    ends = [gain[main] * carriers.nearness(end) for end in seen.range_mm]
    low, high = np.minimum(*ends), np.maximum(*ends)
    residual = wrapped(seen.point_phase_rad - carriers.infinity_rad)
    proposing, other, joint = residual[main], residual[1 - main], carriers.joint_gain
    ratio = gain[1 - main] / gain[main]
    first = np.ceil((low - proposing) / TAU)
    turns = np.arange(int(np.ceil(float((high - low).max()) / TAU)) + 1)
    if float(np.median(gain[main])) < 0:  # the furthest first
        turns = turns[::-1]
    psi = proposing + TAU * (first + turns[:, None, None])
    beside = wrapped(other - psi * ratio)
    if moved is None:  # the point of the line nearest to the measured pair, and its distance
        nearness = (gain[main] * psi + gain[1 - main] * (psi * ratio + beside)) / joint**2
        misfit = np.abs(beside * gain[main]) / joint
    else:
        nearness, misfit = psi / gain[main], np.abs(beside)
    q, misfit, inside = (
        nearness.astype(np.float32),
        misfit.astype(np.float32),
        seen.inside[grid_of(seen.stride)],
    )
    # Of a window both carriers must be seen; beside a pixel's own phase, the window of the other
    # one.
    modulation = seen.modulation[:, *grid_of(seen.stride)]
    weakest = modulation.min(axis=0) if moved is None else modulation[1 - moved]
    trust = np.clip(weakest / np.float32(WELL_LIT * noise_grey), LEAST_TRUST, 1)
    links = _links(seen, inside, residual[main], modulation[main])
    return CrossedCandidates(
        (q * joint).astype(np.float32),
        psi <= high,
        trust,
        inside,
        links,
        q,
        misfit.astype(np.float32),
    )


def _links(
    seen: Capture, inside: Mask, residual_rad: Image, brightness: Image
) -> tuple[Image, Image]:
    """`links_between`, weaker where the surface visibly jumps: every pixel has a phase of its own
    there."""
    links = links_between(inside)
    if not seen.pixelwise:
        return links
    log_brightness = np.log(np.maximum(brightness, LEAST_GREY))
    for axis, link in zip((1, 0), links, strict=True):
        jump = np.abs(wrapped(np.diff(residual_rad, axis=axis))) > JUMP_RAD_PER_PX * seen.stride
        jump |= np.abs(np.diff(log_brightness, axis=axis)) > JUMP_LOG_PER_PX * seen.stride
        link[jump] *= np.float32(JUMP_WEIGHT)
    return links


def irradiance(
    layer: CalibrationLayer,
    residual_rad: NDArray,
    slopes: tuple[Image, Image],
    rig: Rig,
    crop: Crop,
) -> Image:
    """cos(theta) / r^2 in 1/m^2 that a matte surface receives from the projector, float32 (H, W);
    below 0: turned away. ``residual_rad`` (H, W) of one candidate on the pixels ``crop`` of the
    image, ``slopes`` its change a px."""
    x, y = (axis[crop].astype(np.float32) for axis in rig.camera.rays())
    z = (layer.depth_of_residual_mm(residual_rad) / MM_PER_M).astype(np.float32)
    if layer.lens is None:
        rate = -layer.gain / (residual_rad * residual_rad * layer.forward)
    else:
        rate = (layer.depth_of_residual_mm(residual_rad + 1e-3) / MM_PER_M - z) / 1e-3
    # At a fixed psi depth still changes with the pixel where the projector is rotated against the
    # camera.
    drifts = [_drift(layer, residual_rad, z, axis, crop) for axis in (1, 0)]
    zx, zy = (
        (rate * slope + drift).astype(np.float32)
        for slope, drift in zip(slopes, drifts, strict=True)
    )
    dx, dy = np.float32(1 / rig.camera.fx), np.float32(1 / rig.camera.fy)
    # Tangents of the surface Z (x, y, 1) along the image's rows and columns, and their cross
    # product.
    ax, ay, az = zx * x + z * dx, zx * y, zx
    bx, by, bz = zy * x, zy * y + z * dy, zy
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    cx, cy, cz = (np.float32(c) for c in -rig.R.T @ rig.t)
    lx, ly, lz = cx - z * x, cy - z * y, cz - z
    squared = lx * lx + ly * ly + lz * lz
    length = np.sqrt((nx * nx + ny * ny + nz * nz) * squared)
    return -(nx * lx + ny * ly + nz * lz) / (length * squared)


def _drift(
    layer: CalibrationLayer, residual_rad: NDArray, z: Image, axis: int, crop: Crop
) -> NDArray | float:
    """Change of depth in m a px along ``axis`` at a fixed residual phase."""
    if min(layer.gain.shape) < 2:
        return 0.0
    step = crop[axis].step or 1
    gain, forward = (
        np.gradient(values, axis=axis) / step for values in (layer.gain, layer.forward)
    )
    if not gain.any() and not forward.any():
        return 0.0
    return (gain / residual_rad - z * forward) / layer.forward
