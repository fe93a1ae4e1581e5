"""Input of the network: maps of one image that mean the same for any rig, fringe direction and distance.

The phase route gives every pixel a wrapped phase and a *base order*. For the base order and the orders before and after
it, the network gets the expected brightness compared with the measured one, and whether the depth lies in the working
range. No map holds a distance. Maps are rotated so that phase grows downwards and with nearness, whatever the fringe
direction.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import TAU, CalibrationLayer, Crop, Image, Mask, wrapped
from fpp_ml_bench.baselines.phase.candidates import irradiance
from fpp_ml_bench.baselines.phase.depth import PhaseRoute
from fpp_ml_bench.baselines.phase.observe import Observation, Settings
from fpp_ml_bench.baselines.phase.order import LEAST_BRIGHTNESS
from fpp_ml_bench.baselines.phase.resampling import Periods, grid_of, repeated
from fpp_ml_bench.optics.rig import Rig

STEPS = (-1, 0, 1)  # the candidates: a period further than the base order, the base order, a period nearer
SIDES = ((0.0, 1.0), (0.7, 0.7), (1.0, 0.0), (0.7, -0.7), (0.0, -1.0), (-0.7, -0.7), (-1.0, 0.0), (-0.7, 0.7))
"""Directions (rows, columns, in rotated maps) from which a pixel may take its phase instead."""
SIDE_PERIODS = 0.45
"""Distance, in periods, from which the phase is taken: the fit's window there hardly reaches beyond the pixel."""
LARGEST_RAD = 1.5708  # largest correction that is proposed
AROUND_PX = 1.5
"""Gaussian over which the misfit of a proposal is averaged: the light of a single pixel fits many phases."""
SIDE_CHANNELS = (
    *(f"from {row:+.1f} {column:+.1f}: correction" for row, column in SIDES),
    "own misfit around",
    *(f"from {row:+.1f} {column:+.1f}: misfit around" for row, column in SIDES),
)
"""The maps of `from_the_sides`, the last of a network's input."""
CHANNELS = (
    "light",
    "plane light",
    "plane misfit",
    "classical mask",
    "cos",
    "sin",
    "brightness",
    "window share",
    "fit misfit",
    "slope along",
    "slope across",
    "further: brightness misfit",
    "base: brightness misfit",
    "nearer: brightness misfit",
    "further exists",
    "nearer exists",
    "relief",
    "first guess",
    *SIDE_CHANNELS,
)
FIRST_SIDE = CHANNELS.index("first guess") + 1
FIRST_MISFIT = FIRST_SIDE + len(SIDES)
"""First of the misfit channels: of no correction, and of each proposed correction."""
SHADING = (1, 6, 11, 12, 13)
"""Channels that assume one albedo for all surfaces; 0 for predictions without brightness."""
LEAST_WEIGHT = 0.02  # least share of the fit's window that must lie on the object for the fit to count
RELIEF_RAD = 1.5  # unit of the channel ``relief``, small enough that the corrections show in it
SINE_FLOOR = 0.1
STEP_PX = 2  # brightness of the candidates is computed on every second pixel


@dataclass(frozen=True)
class Rotation:
    """How maps (h, w) of an image are rotated for the network: ``transposed``, then rows ``reversed``; ``sign``: factor
    that makes the phase of a nearer surface larger."""

    transposed: bool
    reversed: bool
    sign: float

    @classmethod
    def of(cls, layer: CalibrationLayer, direction: str) -> "Rotation":
        """From the calibration layer of a whole image."""
        sign, vertical = 1.0 if float(np.median(layer.gain)) > 0 else -1.0, direction == "vertical"
        carrier = layer.infinity_rad + TAU * layer.infinity_order
        return cls(vertical, float(np.median(np.diff(carrier, axis=int(vertical)))) * sign <= 0, sign)

    def turn(self, image: NDArray) -> NDArray:
        """Maps (..., h, w) rotated for the network."""
        turned = image.swapaxes(-1, -2) if self.transposed else image
        return turned[..., ::-1, :] if self.reversed else turned

    def back(self, image: NDArray) -> NDArray:
        """Rotated maps as the image has them."""
        unturned = image[..., ::-1, :] if self.reversed else image
        return unturned.swapaxes(-1, -2) if self.transposed else unturned

    def down_and_right(self, slopes: Image) -> tuple[Image, Image]:
        """Slopes down and to the right in rotated maps, from those along an image's x and y (2, h, w); not rotated
        themselves."""
        right, down = slopes[::-1] if self.transposed else slopes
        return (-self.sign if self.reversed else self.sign) * down, self.sign * right


@dataclass(frozen=True)
class Geometry:
    """Route and rotation for all images of a rig and fringe direction."""

    rig: Rig
    route: PhaseRoute
    rotation: Rotation

    @classmethod
    def of(cls, rig: Rig, settings: Settings, periods: Periods | None = None) -> "Geometry":
        """As `phase.PhaseRoute`: ``rig`` of the geometry is that of the images resampled to ``periods``."""
        route = PhaseRoute(rig, settings, periods=periods)
        return cls(route.rig, route, Rotation.of(route.layer, settings.direction))

    @property
    def layer(self) -> CalibrationLayer:
        return self.route.layer

    @property
    def shading(self) -> bool:
        """Whether brightness is a cue for the order: one albedo for all surfaces."""
        return self.route.settings.shading

    def in_range(self, depth_mm: NDArray) -> Mask:
        """Whether a depth lies in the working range, or its slack."""
        (near, far), slack = self.rig.working_range_mm, self.route.settings.slack_mm
        return (depth_mm > near - slack) & (depth_mm < far + slack)


@dataclass(frozen=True)
class CroppedMaps:
    """Maps (..., h, w) of the part ``crop`` of an image: those named in ``real_maps``, and in ``other_maps``."""

    real_maps: ClassVar[tuple[str, ...]]
    other_maps: ClassVar[tuple[str, ...]]

    crop: Crop

    def window(self, rows: slice, columns: slice) -> Self:
        """A part of these maps; slices with start and stop."""
        top, left = self.crop[0].start, self.crop[1].start
        crop = slice(top + rows.start, top + rows.stop), slice(left + columns.start, left + columns.stop)
        names = *self.real_maps, *self.other_maps
        maps: dict[str, Any] = {name: getattr(self, name)[..., rows, columns] for name in names}
        return replace(self, crop=crop, **maps)

    def single(self, real: type = np.float32) -> Self:
        """Real maps in single precision, or in another: half saves memory, and is not for use."""
        maps: dict[str, Any] = {name: getattr(self, name).astype(real) for name in self.real_maps}
        return replace(self, **maps)


@dataclass(frozen=True)
class Scene(CroppedMaps):
    """The part ``crop`` of an image, maps (h, w) in the image's own orientation. ``light``: captured light without the
    ambient light, and ``plane_light``: the empty scene's prediction of it, both as multiples of a plane like the
    background at the standoff, or of the object's median brightness; ``noise`` in the same unit; ``inside``: mask of
    the measured route; ``phase_rad`` in [-pi, pi] and ``order``: the base order; ``bright``: half the modulation, in
    units of light; ``weight``: of the fit's window; ``slopes`` (2, h, w) of the residual phase, rad a px along x and y;
    ``middle_rad``: median residual phase of the object."""

    real_maps = "light", "plane_light", "phase_rad", "bright", "weight", "slopes"
    other_maps = "inside", "order"

    light: Image
    plane_light: Image
    noise: float
    inside: Mask
    phase_rad: Image
    order: NDArray[np.int32]
    bright: Image
    weight: Image
    slopes: Image
    middle_rad: float

    @classmethod
    def of(cls, observation: Observation, order: NDArray[np.int32], shading: bool) -> "Scene":
        """From an observation of the measured route, with that route's ``order`` (h, w) as the base order. ``shading``:
        whether the unit of light is that of the background, which tells distances of surfaces with its albedo."""
        background, fit = observation.background, observation.fit
        standoff_m2, on_fringe = observation.rig.standoff_m**2, observation.inside & (fit.brightness > 0)
        typical = float(np.median(fit.brightness[on_fringe])) if on_fringe.any() else 1.0
        by_background = shading and background.calibrated
        unit = np.float32(standoff_m2 / (background.strength / 2) if by_background else 1.0 / max(typical, 1.0))
        light = (observation.greys[0] - np.float32(background.ambient_grey)) * unit
        residual = observation.layer.residual_phase(observation.phase_rad, order)
        on_object = observation.inside & np.isfinite(residual)
        return cls(
            crop=observation.crop,
            light=light,
            plane_light=(light - background.residual * unit).astype(np.float32),
            noise=float(background.noise_grey * unit),
            inside=observation.inside,
            phase_rad=observation.phase_rad,
            order=order,
            bright=(fit.brightness * unit).astype(np.float32),
            weight=fit.weight,
            slopes=np.stack(observation.slopes),
            middle_rad=float(np.median(residual[on_object])) if on_object.any() else 0.0,
        )

    @property
    def strength(self) -> float:
        """The object's median modulation in sigmas of the noise."""
        lit = self.bright[self.inside & (self.bright > 0)]
        return float(np.median(lit)) / self.noise if lit.size else 0.0

    def single(self, real: type = np.float32) -> "Scene":
        return replace(super().single(real), order=self.order.astype(np.int16 if real is np.float16 else np.int32))


def coarse_irradiance(scene: Scene, geometry: Geometry, residuals_rad: Sequence[NDArray]) -> NDArray[np.float32]:
    """`irradiance` (n, h', w') with each of ``residuals_rad`` (h, w), on every `STEP_PX`-th pixel."""
    grid, where = grid_of(STEP_PX), grid_of(STEP_PX, scene.crop)
    layer, slopes = geometry.layer.at(where), (scene.slopes[0][grid], scene.slopes[1][grid])
    return np.stack([irradiance(layer, rad[grid], slopes, geometry.rig, where) for rad in residuals_rad])


def channels(scene: Scene, geometry: Geometry) -> tuple[Image, Mask]:
    """Input of the network (`CHANNELS`, h', w') float32, rotated, and which candidates exist, bool (3, h', w'): those
    in the working range, so that a single one settles the order, or the base where none is. Without shading the maps
    that assume one albedo are 0."""
    rig, rotation, layer = geometry.rig, geometry.rotation, geometry.layer.at(scene.crop)
    residual = layer.residual_phase(scene.phase_rad, scene.order)
    candidates = [residual + rotation.sign * TAU * step for step in STEPS]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # Brightness with each candidate, in units of light; NaN where a candidate lies behind a device.
        light = coarse_irradiance(scene, geometry, [candidate.astype(np.float32) for candidate in candidates])
        exists = geometry.in_range(np.stack([layer.depth_of_residual_mm(candidate) for candidate in candidates]))
    expected = repeated((light * rig.standoff_m**2).astype(np.float32), STEP_PX, scene.light.shape)
    exists[1] |= ~exists.any(axis=0)
    floor = np.float32(LEAST_BRIGHTNESS * rig.standoff_m**2)
    bright = np.maximum(scene.bright, floor)
    with np.errstate(invalid="ignore"):
        ratio = np.log(bright / np.maximum(np.nan_to_num(expected, nan=1.0), floor))
    ratio = np.clip(ratio, -1.5, 1.5) * exists
    cosine, sine = np.cos(scene.phase_rad), np.sin(scene.phase_rad)
    misfit = (scene.light - scene.bright * (1 + cosine)) / np.maximum(bright, np.float32(0.05))
    plane_misfit = np.arcsinh((scene.light - scene.plane_light) / np.float32(scene.noise)) / 4
    relief = np.nan_to_num(rotation.sign * (residual - scene.middle_rad)) / RELIEF_RAD
    # The correction c that a pixel's own light asks for if its brightness g is right: light = g (1 + cos(phase + c)).
    guess = -misfit * rotation.sign * sine / (sine * sine + SINE_FLOOR)
    unit = geometry.route.period_px / TAU
    down, right = rotation.down_and_right(scene.slopes)
    fitted = np.stack(
        [
            cosine,
            rotation.sign * sine,
            np.log(bright) / 2,
            scene.weight,
            np.clip(misfit, -2, 2),
            unit * down,
            unit * right,
            *ratio,
            exists[0],
            exists[2],
            np.clip(relief, -4, 4),
            np.clip(guess, -1.5, 1.5),
        ]
    ).astype(np.float32)
    fitted *= scene.weight > LEAST_WEIGHT
    image_maps = np.stack([scene.light, scene.plane_light, plane_misfit, scene.inside]).astype(np.float32)
    turned_maps = rotation.turn(np.nan_to_num(np.concatenate([image_maps, fitted])))
    x = np.concatenate([turned_maps, _turned_sides(scene, layer, geometry)])
    if not geometry.shading:
        x[list(SHADING)] = 0
    return x, np.ascontiguousarray(rotation.turn(exists))


def _misfit_around(light: Image, bright: Image, raised: NDArray, valid: Mask | bool = True) -> Image:
    """Root mean square, in the pixel's surroundings, by which light over brightness differs from a fringe's, which is
    ``raised``; 2 where not ``valid``."""
    misfit = light / np.maximum(bright, np.float32(0.05)) - raised
    square = np.clip(np.where(valid, misfit, np.float32(2)), -2, 2).astype(np.float32) ** 2
    return np.sqrt(cv2.GaussianBlur(square, (0, 0), AROUND_PX, borderType=cv2.BORDER_REPLICATE))


def from_the_sides(
    light: Image,
    maps: NDArray[np.float32],
    reach_px: int,
    raised: Callable[[NDArray | float], NDArray],
    difference: Callable[[NDArray], NDArray] = lambda rad: rad,
) -> Image:
    """The phase extrapolated to a pixel from each of `SIDES`, minus its own phase, and the misfit of its light with it:
    (17, h, w) float32. ``maps`` (5, h, w): phase, its slopes down and right, brightness, object; ``raised``: light over
    brightness of the pixel's fringe with the phase moved by so many rad; ``difference``: of two phases, from their
    difference. Beside a depth edge the window of a pixel covers two surfaces, a window further in only one."""
    _, height, width = maps.shape
    padded = np.pad(maps, ((0, 0), (reach_px, reach_px), (reach_px, reach_px)))
    corrections, misfits = [], [_misfit_around(light, maps[3], raised(0.0))]
    for row, column in SIDES:
        dy, dx = round(row * reach_px), round(column * reach_px)
        side_maps = padded[:, reach_px + dy : reach_px + dy + height, reach_px + dx : reach_px + dx + width]
        on_object = side_maps[4] > 0
        step = side_maps[0] - side_maps[1] * np.float32(dy) - side_maps[2] * np.float32(dx) - maps[0]
        step = np.clip(difference(step), -LARGEST_RAD, LARGEST_RAD) * on_object
        corrections.append(step)
        misfits.append(_misfit_around(light, side_maps[3], raised(step), on_object))
    return np.stack(corrections + misfits).astype(np.float32)


def _turned_sides(scene: Scene, layer: CalibrationLayer, geometry: Geometry) -> Image:
    """`from_the_sides` of a scene, rotated for the network."""
    rotation, turn, sign = geometry.rotation, geometry.rotation.turn, np.float32(geometry.rotation.sign)
    psi = turn(sign * wrapped(scene.phase_rad - layer.infinity_rad).astype(np.float32))
    phase = turn(sign * scene.phase_rad)
    turned_maps = (*rotation.down_and_right(scene.slopes), scene.bright, scene.inside.astype(np.float32))
    maps = np.stack([psi, *map(turn, turned_maps)])
    reach_px = max(1, round(SIDE_PERIODS * geometry.route.period_px))
    return from_the_sides(turn(scene.light), maps, reach_px, lambda step: 1 + np.cos(phase + step), wrapped)
