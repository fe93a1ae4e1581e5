"""What the network sees of one image: maps that mean the same for any rig, fringe direction and distance.

The measured route (`fpp_ml_bench.baselines.phase_route`) gives every pixel a wrapped phase and a first order, the
*base*. The network is shown the base and its two neighbours, one order nearer and one further: how bright each would be
against how bright it is, and whether it lies in the working range. Nothing it sees tells how far away an object stands,
only what follows from a distance: that is why it works where objects stand elsewhere than in training.

Maps are turned so that the fringe's phase grows along rows' normal (downwards) and a nearer surface has more of it. One
network then serves both fringe directions.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route.calibration_layer import TAU, CalibrationLayer
from fpp_ml_bench.baselines.phase_route.observation import Crop, Observation
from fpp_ml_bench.baselines.phase_route.orders import LEAST_BRIGHTNESS
from fpp_ml_bench.baselines.phase_route.shading import irradiance
from fpp_ml_bench.rig import Rig

Image = NDArray[np.float32]

STEPS = (-1, 0, 1)
"""The candidates: a period further than the base, the base, a period nearer."""
CHANNELS = (
    "light", "plane light", "plane misfit", "classical mask", "cos", "sin", "brightness", "window share", "fit misfit",
    "slope along", "slope across", "further: brightness misfit", "base: brightness misfit",
    "nearer: brightness misfit", "further exists", "nearer exists", "relief",
)  # fmt: skip
SHADING = (6, 11, 12, 13)
"""Channels that rest on one albedo for all surfaces; 0 for a network that is to do without."""
LEAST_WEIGHT = 0.02
"""Least share of the fit's window on the object where its answer counts."""
STEP_PX = 2
"""Brightness of the candidates is computed on every second pixel."""


@dataclass(frozen=True)
class Rotation:
    """How maps (h, w) of an image are turned for the network: ``transposed``, then rows ``reversed``; ``sign`` of the
    phase that makes a nearer surface have more of it."""

    transposed: bool
    reversed: bool
    sign: float

    @classmethod
    def of(cls, layer: CalibrationLayer, direction: str) -> "Rotation":
        """From the calibration layer of a whole image."""
        sign = 1.0 if float(np.median(layer.gain)) > 0 else -1.0
        carrier = layer.infinity_rad + TAU * layer.infinity_order
        axis = 1 if direction == "vertical" else 0
        grows = float(np.median(np.diff(carrier, axis=axis))) * sign > 0
        return cls(direction == "vertical", not grows, sign)

    def turn(self, image: NDArray) -> NDArray:
        """Maps (..., h, w) as the network sees them."""
        turned = image.swapaxes(-1, -2) if self.transposed else image
        return turned[..., ::-1, :] if self.reversed else turned

    def back(self, image: NDArray) -> NDArray:
        """Maps as the image has them, from maps as the network sees them."""
        unturned = image[..., ::-1, :] if self.reversed else image
        return unturned.swapaxes(-1, -2) if self.transposed else unturned


@dataclass(frozen=True)
class Scene:
    """What a part ``crop`` of an image shows, maps (h, w) as the image has them.

    ``light`` and ``plane_light``: captured light less the ambient one, and what the empty scene predicts of it, as
    multiples of a white plane at the standoff; ``noise`` in the same unit; ``inside``: classical mask; ``phase_rad`` in
    [-pi, pi] and ``order``: the base; ``bright``: half the modulation, in units of light; ``weight``: of the fit's
    window; ``slopes`` of the residual phase, rad a px along x and y; ``relief_rad``: residual phase of the object's
    middle.
    """

    crop: Crop
    light: Image
    plane_light: Image
    noise: float
    inside: NDArray[np.bool_]
    phase_rad: Image
    order: NDArray[np.int32]
    bright: Image
    weight: Image
    slopes: tuple[Image, Image]
    middle_rad: float

    @classmethod
    def of(cls, seen: Observation, order: NDArray[np.int32], rig: Rig) -> "Scene":
        """From what the measured route saw, with its own ``order`` (h, w) as the base."""
        background = seen.background
        unit = np.float32(rig.standoff_m**2 / (background.strength / 2))
        light = (seen.grey - np.float32(background.ambient_grey)) * unit
        misfit = background.residual[seen.crop] * unit
        residual = seen.layer.residual_phase(seen.phase_rad, order)
        known = seen.inside & np.isfinite(residual)
        middle = float(np.median(residual[known])) if known.any() else 0.0
        return cls(
            crop=seen.crop, light=light, plane_light=(light - misfit).astype(np.float32),
            noise=float(background.noise_grey * unit), inside=seen.inside, phase_rad=seen.phase_rad, order=order,
            bright=(seen.fit.brightness * unit).astype(np.float32), weight=seen.fit.weight, slopes=seen.slopes,
            middle_rad=middle,
        )  # fmt: skip

    def window(self, rows: slice, columns: slice) -> "Scene":
        """A part of it; slices of this scene's own maps, with start and stop."""
        top, left = self.crop[0].start, self.crop[1].start
        here = (rows, columns)
        return replace(
            self, crop=(slice(top + rows.start, top + rows.stop), slice(left + columns.start, left + columns.stop)),
            light=self.light[here], plane_light=self.plane_light[here], inside=self.inside[here],
            phase_rad=self.phase_rad[here], order=self.order[here], bright=self.bright[here],
            weight=self.weight[here], slopes=(self.slopes[0][here], self.slopes[1][here]),
        )  # fmt: skip

    def half(self) -> "Scene":
        """The same in half precision, to be kept; `single` before it is used."""
        return self._as(np.float16, np.int16)

    def single(self) -> "Scene":
        """In single precision."""
        return self._as(np.float32, np.int32)

    def _as(self, real: type, whole: type) -> "Scene":
        maps = {
            name: getattr(self, name).astype(real) for name in ("light", "plane_light", "phase_rad", "bright", "weight")
        }
        slopes = (self.slopes[0].astype(real), self.slopes[1].astype(real))
        return replace(self, **maps, slopes=slopes, order=self.order.astype(whole))


def candidate_brightness(scene: Scene, layer: CalibrationLayer, rig: Rig, sign: float) -> tuple[Image, NDArray]:
    """Brightness that each of `STEPS` would have, in units of light, and its depth in mm: (3, h, w) float32 each.

    ``layer``: of the scene's part of the image. NaN where a candidate lies behind a device.
    """
    height, width = scene.light.shape
    every = (slice(None, None, STEP_PX), slice(None, None, STEP_PX))
    where = (
        slice(scene.crop[0].start, scene.crop[0].stop, STEP_PX),
        slice(scene.crop[1].start, scene.crop[1].stop, STEP_PX),
    )
    coarse = layer.at(every)
    slopes = scene.slopes[0][every], scene.slopes[1][every]
    base = coarse.residual_phase(scene.phase_rad[every], scene.order[every])
    bright, depth = [], []
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for step in STEPS:
            residual = (base + sign * TAU * step).astype(np.float32)
            bright.append(irradiance(coarse, residual, slopes, rig, where) * np.float32(rig.standoff_m**2))
            depth.append(coarse.depth_of_residual_mm(residual))

    def fine(maps: list) -> NDArray:
        stacked = np.stack(maps).astype(np.float32)
        return stacked.repeat(STEP_PX, axis=1).repeat(STEP_PX, axis=2)[:, :height, :width]

    return fine(bright), fine(depth)


def channels(
    scene: Scene, layer: CalibrationLayer, rig: Rig, rotation: Rotation, period_px: float, slack_mm: float
) -> tuple[Image, NDArray[np.bool_]]:
    """Input of the network (`CHANNELS`, h', w') float32, turned, and which candidates exist, bool (3, h', w').

    The base always exists: where even it lies outside the range, nothing better is known.
    """
    expected, depth = candidate_brightness(scene, layer, rig, rotation.sign)
    near, far = rig.working_range_mm
    with np.errstate(invalid="ignore"):
        exists = (depth > near - slack_mm) & (depth < far + slack_mm)
    exists[1] = True
    floor = np.float32(LEAST_BRIGHTNESS * rig.standoff_m**2)
    bright = np.maximum(scene.bright, floor)
    with np.errstate(invalid="ignore"):
        ratio = np.log(bright / np.maximum(np.nan_to_num(expected, nan=1.0), floor))
    ratio = np.clip(ratio, -1.5, 1.5) * exists
    cosine, sine = np.cos(scene.phase_rad), np.sin(scene.phase_rad)
    misfit = (scene.light - scene.bright * (1 + cosine)) / np.maximum(bright, np.float32(0.05))
    plane_misfit = np.arcsinh((scene.light - scene.plane_light) / np.float32(scene.noise)) / 4
    residual = layer.residual_phase(scene.phase_rad, scene.order)
    relief = np.nan_to_num(rotation.sign * (residual - scene.middle_rad) / TAU)
    unit = period_px / TAU
    along, across = (1, 0) if not rotation.transposed else (0, 1)
    flip = -1.0 if rotation.reversed else 1.0
    fitted = np.stack([
        cosine, rotation.sign * sine, np.log(bright) / 2, scene.weight, np.clip(misfit, -2, 2),
        flip * rotation.sign * unit * scene.slopes[along], rotation.sign * unit * scene.slopes[across],
        ratio[0], ratio[1], ratio[2], exists[0], exists[2], np.clip(relief, -2, 2),
    ]).astype(np.float32)  # fmt: skip
    fitted *= scene.weight > LEAST_WEIGHT
    seen = np.stack([scene.light, scene.plane_light, plane_misfit, scene.inside]).astype(np.float32)
    whole = np.concatenate([seen, fitted])
    return np.ascontiguousarray(rotation.turn(np.nan_to_num(whole))), np.ascontiguousarray(rotation.turn(exists))
