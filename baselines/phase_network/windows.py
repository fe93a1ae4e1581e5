"""Windows of training samples, varied as other scenes would vary them.

Whole objects are moved to another distance, with the light that the calibrated lamp would give and the measured route's
errors as they were. Wrong base orders are made up in patches and whole windows, because the training objects have few.
Columns are mirrored, as with a projector on the other side. Brightness varies a little.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_network import inputs
from fpp_ml_bench.baselines.phase_network.inputs import FIRST_MISFIT, FIRST_SIDE, SIDES, Geometry, Scene
from fpp_ml_bench.baselines.phase_network.samples import Sample
from fpp_ml_bench.baselines.phase_route import TAU, Image, Mask, of_choice, repeated
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.optics import Direction

IGNORED = -100
"""Class of a pixel that is left out of the order's loss: background, or none of the three candidates is right."""
_MIRRORED = inputs.CHANNELS.index("slope across")
_PARTNERS = [SIDES.index((row, -column)) for row, column in SIDES]
_SWAPPED = [FIRST_SIDE + n for n in _PARTNERS] + [FIRST_MISFIT] + [FIRST_MISFIT + 1 + n for n in _PARTNERS]


@dataclass(frozen=True)
class Variation:
    """How often (0 to 1) and how much windows are varied; with 0 throughout they stay as captured. ``shift``: how often
    objects are moved to any distance of the working range; ``shift_blind``: the same for a network without brightness,
    so that it does not learn where they mostly stand."""

    near_edge: float = 0.7
    shift: float = 0.5
    shift_blind: float = 0.8
    brightness: float = 0.04
    wrong_window: float = 0.15
    wrong_patch: float = 0.3
    mirror: float = 0.5


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


def draw(
    samples: list[Sample],
    geometries: Mapping[Direction, Geometry],
    size: int,
    vary: Variation,
    shading: bool,
    random: np.random.Generator,
) -> Window:
    """A random window of ``size`` px of one of ``samples``; ``shading``: as of `inputs.channels`."""
    sample = samples[random.integers(len(samples))]
    geometry = geometries[sample.direction]
    rows, columns = place_of(sample.edges, sample.target.shape, size, random.random() < vary.near_edge, random)
    scene, missing = sample.scene.window(rows, columns).single(), sample.missing_rad[rows, columns].astype(np.float32)
    target, void = sample.target[rows, columns], sample.void[rows, columns]
    moved = random.random() < (vary.shift if shading else vary.shift_blind) and target.any()
    if moved:
        scene = _moved(scene, missing, target, geometry, vary, random)
    scene, missing = _wrong(scene, missing, geometry, vary, random)
    x, exists = inputs.channels(scene, geometry, shading)
    turn = geometry.rotation.turn
    missing = turn(missing) * np.float32(geometry.rotation.sign)
    window = _labelled(x, exists, missing, turn(target), size, turn(~void & (not moved)))
    return _mirrored(window) if random.random() < vary.mirror else window


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


def _moved(
    scene: Scene, missing: Image, target: Mask, geometry: Geometry, vary: Variation, random: np.random.Generator
) -> Scene:
    """The object at another distance within the working range."""
    near, far = geometry.rig.working_range_mm
    layer = geometry.layer.at(scene.crop)
    true_rad = (layer.residual_phase(scene.phase_rad, scene.order) + missing).astype(np.float32)
    middle = float(np.median(true_rad[target]))
    gain, forward = float(np.median(layer.gain)), float(np.median(layer.forward))
    depth_m = random.uniform(near, far) / MM_PER_M
    delta = np.float32(gain / (forward * depth_m + layer.back_m) - middle)
    with np.errstate(all="ignore"):
        before, after = np.maximum(inputs.coarse_irradiance(scene, geometry, (true_rad, true_rad + delta)), 1e-3)
        ratio = np.clip(np.nan_to_num(after / before, nan=1.0), 0.4, 2.5)
    ratio = repeated(ratio, inputs.STEP_PX, scene.light.shape).astype(np.float32)
    ratio = np.where(target, ratio * np.float32(np.exp(random.normal(0, vary.brightness))), np.float32(1))
    true_phase = scene.phase_rad + missing
    light = ratio * (scene.light + scene.bright * (np.cos(true_phase + delta) - np.cos(true_phase)))
    phase = scene.phase_rad + delta
    carry = np.rint(phase / TAU)
    return replace(
        scene,
        light=np.where(target, light, scene.light),
        bright=(scene.bright * ratio).astype(np.float32),
        phase_rad=(phase - TAU * carry).astype(np.float32),
        order=scene.order + carry.astype(np.int32),
        middle_rad=scene.middle_rad + float(delta),
    )


def _wrong(
    scene: Scene, missing: Image, geometry: Geometry, vary: Variation, random: np.random.Generator
) -> tuple[Scene, Image]:
    """Wrong base orders, where the working range allows them."""
    height, width = scene.light.shape
    off, middle = np.zeros((height, width), np.int32), 0
    if random.random() < vary.wrong_window:
        middle = int(random.choice((-1, 1)))
        off += middle
    elif random.random() < vary.wrong_patch:
        coarse = random.standard_normal((12, 12)).astype(np.float32)
        noise = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        off += (noise > random.uniform(0.5, 1.5)) * int(random.choice((-1, 1)))
    if not off.any():
        return scene, missing
    with np.errstate(all="ignore"):
        depth_mm = geometry.layer.at(scene.crop).depth_mm(scene.phase_rad, scene.order + off)
        off = np.where(geometry.in_range(depth_mm), off, 0).astype(np.int32)
    changed = replace(scene, order=scene.order + off, middle_rad=scene.middle_rad + TAU * middle)
    return changed, missing - np.float32(TAU) * off


def _labelled(x: Image, exists: Mask, missing: Image, target: Mask, size: int, mask_valid: Mask) -> Window:
    steps = np.rint(missing / TAU).astype(np.int64)
    possible = target & (np.abs(steps) <= 1)
    place = np.clip(steps, -1, 1) + 1
    possible &= of_choice(exists, place)
    correction = (missing - TAU * steps).astype(np.float32)
    _, height, width = x.shape
    pad = ((0, size - height), (0, size - width))
    deep = ((0, 0), *pad)
    return Window(
        np.pad(x, deep),
        np.pad(exists, deep, constant_values=True),
        np.pad(np.where(possible, place, IGNORED), pad, constant_values=IGNORED),
        np.pad(correction, pad),
        np.pad(possible, pad),
        np.pad(target, pad),
        np.pad(mask_valid, pad),
    )


def _mirrored(window: Window) -> Window:
    flipped = {name: getattr(window, name)[..., ::-1].copy() for name in Window.__dataclass_fields__}
    flipped["x"][_MIRRORED] *= -1
    flipped["x"][FIRST_SIDE:] = flipped["x"][_SWAPPED]
    return Window(**flipped)
