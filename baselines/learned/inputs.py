"""Input of phase-net and crossed-net: maps of one image that mean the same for any rig, fringe
direction and distance.

A measured route gives every pixel a phase and a *base order*. For the base order and the orders
before and after it, the network gets how well they fit: for one fringe the expected brightness
compared with the measured one, and whether the depth lies in the working range; for a crossed frame
how well both phases agree. No map holds a distance, and light is relative to the image's own. Maps
of one fringe are rotated so that phase grows downwards and with nearness, whatever its
direction."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.candidates import irradiance
from fpp_ml_bench.baselines.phase.depth import Fitted
from fpp_ml_bench.baselines.phase.geometry import (
    TAU,
    CalibrationLayer,
    Carriers,
    Crop,
    Image,
    Mask,
    grid_of,
    repeated,
    wrapped,
)
from fpp_ml_bench.baselines.phase.local_fit import fringes, phase_slopes
from fpp_ml_bench.baselines.phase.observe import SLOPE_PERIODS, Observation, OneCarrier
from fpp_ml_bench.baselines.phase.order import LEAST_BRIGHTNESS

STEPS = (-1, 0, 1)
"""The candidates: a period further than the base order, the base order, a period nearer."""
SIDES = (
    (0.0, 1.0),
    (0.7, 0.7),
    (1.0, 0.0),
    (0.7, -0.7),
    (0.0, -1.0),
    (-0.7, -0.7),
    (-1.0, 0.0),
    (-0.7, 0.7),
)
"""Directions (rows, columns, in rotated maps) from which a pixel may take its phase instead."""
SIDE_PERIODS = 0.45
"""Distance, in periods, from which the phase is taken: the fit's window there hardly reaches beyond
the pixel."""
LARGEST_RAD = 1.5708  # largest correction that is proposed
AROUND_PX = 1.5
"""Gaussian over which the misfit of a proposal is averaged: the light of a single pixel fits many
phases."""
SIDE_CHANNELS = (
    *(f"from {row:+.1f} {column:+.1f}: correction" for row, column in SIDES),
    "own misfit around",
    *(f"from {row:+.1f} {column:+.1f}: misfit around" for row, column in SIDES),
)
"""The maps of `from_the_sides`, the last of a network's input."""
PHASE_CHANNELS = (
    "light",
    "plane light",
    "plane misfit",
    "classical mask",
    "cos",
    "sin",
    "brightness",
    "window share",
    "fit misfit",
    "slope down",
    "slope right",
    "further: brightness misfit",
    "base: brightness misfit",
    "nearer: brightness misfit",
    "further exists",
    "nearer exists",
    "relief",
    "first guess",
    *SIDE_CHANNELS,
)
SHADING = (1, 6, 11, 12, 13)
"""Channels that assume one albedo for all surfaces; 0 for predictions without brightness."""
LEAST_SHARE = 0.02
RELIEF_RAD = 1.5  # unit of the channel ``relief``, small enough that the corrections show in it
SINE_FLOOR = 0.1
STEP_PX = 2  # brightness of the candidates is computed on every second pixel
CROSSED_CHANNELS = (
    "light",
    "plane misfit",
    "plane shown",
    "measured mask",
    "cos 1",
    "sin 1",
    "cos 2",
    "sin 2",
    "brightness",
    "window share",
    "fit misfit",
    "slope down",
    "slope right",
    "window phase 1",
    "window phase 2",
    "modulation 1",
    "modulation 2",
    "further: misfit",
    "base: misfit",
    "nearer: misfit",
    "further exists",
    "nearer exists",
    "relief",
    "first guess",
    *SIDE_CHANNELS,
)
LEAST_BRIGHT = 0.05  # least brightness that is divided by, as a multiple of the object's median


@dataclass(frozen=True)
class Rotation:
    """How maps (h, w) of an image are rotated for the network: ``transposed``, then rows
    ``reversed``; ``sign``: factor that makes the phase of a nearer surface larger."""

    transposed: bool
    reversed: bool
    sign: float

    @classmethod
    def of(cls, layer: CalibrationLayer, direction: str) -> "Rotation":
        """From the calibration layer of a whole image."""
        sign, vertical = 1.0 if float(np.median(layer.gain)) > 0 else -1.0, direction == "vertical"
        carrier = layer.infinity_rad + TAU * layer.infinity_order
        return cls(
            vertical, float(np.median(np.diff(carrier, axis=int(vertical)))) * sign <= 0, sign
        )

    def turn(self, image: NDArray) -> NDArray:
        """Maps (..., h, w) rotated for the network."""
        turned = image.swapaxes(-1, -2) if self.transposed else image
        return turned[..., ::-1, :] if self.reversed else turned

    def back(self, image: NDArray) -> NDArray:
        """Rotated maps as the image has them."""
        unturned = image[..., ::-1, :] if self.reversed else image
        return unturned.swapaxes(-1, -2) if self.transposed else unturned

    def down_and_right(self, slopes: Image) -> tuple[Image, Image]:
        """Slopes down and to the right in rotated maps, from those along an image's x and y (2, h,
        w); not rotated themselves."""
        right, down = slopes[::-1] if self.transposed else slopes
        return (-self.sign if self.reversed else self.sign) * down, self.sign * right


class Geometry:
    """A measurement model of one fringe direction, and the rotation of all its images."""

    def __init__(self, model: OneCarrier) -> None:
        self.model, self.layer, self.period_px = model, model.layer, model.period_px
        self.rotation = Rotation.of(model.layer, model.settings.direction)

    @property
    def shading(self) -> bool:
        """Whether brightness is a cue for the order: one albedo for all surfaces."""
        return self.model.settings.shading

    def in_range(self, depth_mm: NDArray) -> Mask:
        """Whether a depth lies in the working range, or its slack."""
        low, high = self.model.range_mm
        return (depth_mm > low) & (depth_mm < high)


@dataclass(frozen=True)
class CroppedMaps:
    """Maps (..., h, w) of the part ``crop`` of an image: all fields that are arrays. Those named in
    ``exact`` stay in the precision that they have."""

    exact: ClassVar[tuple[str, ...]] = ()

    crop: Crop

    def with_maps(self, change: Callable[[str, NDArray], NDArray]) -> Self:
        """The same with every map changed; ``crop`` stays. ``change``: of a map's name, and the
        map."""
        maps: dict[str, Any] = {
            n: change(n, m) for n, m in vars(self).items() if isinstance(m, np.ndarray)
        }
        return replace(self, **maps)

    def window(self, rows: slice, columns: slice) -> Self:
        """A part of these maps; slices with start and stop."""
        top, left = self.crop[0].start, self.crop[1].start
        crop = (
            slice(top + rows.start, top + rows.stop),
            slice(left + columns.start, left + columns.stop),
        )
        return replace(self.with_maps(lambda name, values: values[..., rows, columns]), crop=crop)

    def single(self, real: type = np.float32) -> Self:
        """Maps in single precision, or in another: half saves memory, and is not for use."""
        whole = np.int16 if real is np.float16 else np.int32

        def converted(name: str, values: NDArray) -> NDArray:
            if name in self.exact or values.dtype == bool:
                return values
            return values.astype(real if values.dtype.kind == "f" else whole)

        return self.with_maps(converted)


@dataclass(frozen=True)
class CandidateScene(CroppedMaps):
    """A measured view with three candidates for each pixel's order: a turn further than the base,
    the base, a turn nearer. ``light`` without ambient light and ``bright``, half the modulation, of
    the local fit, in one unit; ``inside``: mask of the measured route; ``share`` of the fit's
    window that lies on the object; ``strength``: the object's median modulation in sigmas of the
    noise. ``denied``: how far below the threshold the logit of a pixel ``inside`` must be for it
    not to be object."""

    denied: ClassVar[float]

    light: Image
    inside: Mask
    bright: Image
    share: Image
    strength: float

    @property
    def known(self) -> Mask:
        """Pixels with enough of the local fit's window on the object for the fit to count."""
        return self.share > LEAST_SHARE

    @property
    def usable(self) -> Mask | bool:
        """Pixels that can be object."""
        return True


@dataclass(frozen=True)
class PhaseScene(CandidateScene):
    """Maps in the image's own orientation. ``light`` and ``plane_light``, the empty scene's
    prediction of it, as multiples of a plane like the background at the standoff, or of the
    object's median brightness, ``noise`` in the same unit; ``phase_rad`` in [-pi, pi] and
    ``order``: the base order; ``slopes`` (2, h, w) of the residual phase, rad a px along x and y;
    ``middle_rad``: median residual phase of the object."""

    denied: ClassVar[float] = 5.0

    plane_light: Image
    noise: float
    phase_rad: Image
    order: NDArray[np.int32]
    slopes: Image
    middle_rad: float

    @classmethod
    def of(cls, observation: Observation, order: NDArray[np.int32], shading: bool) -> "PhaseScene":
        """From an observation of the measured route, with that route's ``order`` (h, w) as the base
        order. ``shading``: whether the unit of light is that of the background, which tells
        distances of surfaces with its albedo."""
        background, fit = observation.background, observation.fit
        standoff_m2, on_fringe = (
            observation.rig.standoff_m**2,
            observation.inside & (fit.brightness > 0),
        )
        typical = float(np.median(fit.brightness[on_fringe])) if on_fringe.any() else 1.0
        by_background = shading and background.calibrated
        unit = np.float32(
            standoff_m2 / (background.strength / 2) if by_background else 1.0 / max(typical, 1.0)
        )
        light = (observation.greys[0] - np.float32(background.ambient_grey)) * unit
        residual = observation.layer.residual_phase(observation.phase_rad, order)
        on_object = observation.inside & np.isfinite(residual)
        bright, noise = (
            (fit.brightness * unit).astype(np.float32),
            float(background.noise_grey * unit),
        )
        lit = bright[observation.inside & (bright > 0)]
        return cls(
            crop=observation.crop,
            light=light,
            plane_light=(light - background.residual * unit).astype(np.float32),
            noise=noise,
            inside=observation.inside,
            phase_rad=observation.phase_rad,
            order=order,
            bright=bright,
            share=fit.weight,
            strength=float(np.median(lit)) / noise if lit.size else 0.0,
            slopes=np.stack(observation.slopes),
            middle_rad=float(np.median(residual[on_object])) if on_object.any() else 0.0,
        )

    @property
    def usable(self) -> Mask:
        return self.known


def coarse_irradiance(
    scene: PhaseScene, geometry: Geometry, residuals_rad: Sequence[NDArray]
) -> NDArray[np.float32]:
    """`irradiance` (n, h', w') with each of ``residuals_rad`` (h, w), on every `STEP_PX`-th
    pixel."""
    grid, where = grid_of(STEP_PX), grid_of(STEP_PX, scene.crop)
    layer, slopes = geometry.layer.at(where), (scene.slopes[0][grid], scene.slopes[1][grid])
    return np.stack(
        [irradiance(layer, rad[grid], slopes, geometry.model.rig, where) for rad in residuals_rad]
    )


def phase_channels(scene: PhaseScene, geometry: Geometry) -> tuple[Image, Mask]:
    """Input of the network (`PHASE_CHANNELS`, h', w') float32, rotated, and which candidates exist,
    bool (3, h', w'): those in the working range, so that a single one settles the order, or the
    base where none is. Without shading the maps that assume one albedo are 0."""
    rig, rotation, layer = geometry.model.rig, geometry.rotation, geometry.layer.at(scene.crop)
    residual = layer.residual_phase(scene.phase_rad, scene.order)
    candidates = [residual + rotation.sign * TAU * step for step in STEPS]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # Brightness with each candidate, in units of light; NaN where a candidate lies behind a
        # device.
        light = coarse_irradiance(
            scene, geometry, [candidate.astype(np.float32) for candidate in candidates]
        )
        exists = geometry.in_range(
            np.stack([layer.depth_of_residual_mm(candidate) for candidate in candidates])
        )
    expected = repeated((light * rig.standoff_m**2).astype(np.float32), STEP_PX, scene.light.shape)
    exists[1] |= ~exists.any(axis=0)
    floor = np.float32(LEAST_BRIGHTNESS * rig.standoff_m**2)
    bright = np.maximum(scene.bright, floor)
    with np.errstate(invalid="ignore"):
        ratio = np.log(bright / np.maximum(np.nan_to_num(expected, nan=1.0), floor))
    ratio = np.clip(ratio, -1.5, 1.5) * exists
    cosine, sine = np.cos(scene.phase_rad), np.sin(scene.phase_rad)
    misfit = (scene.light - scene.bright * (1 + cosine)) / np.maximum(
        bright, np.float32(LEAST_BRIGHT)
    )
    plane_misfit = np.arcsinh((scene.light - scene.plane_light) / np.float32(scene.noise)) / 4
    relief = np.nan_to_num(rotation.sign * (residual - scene.middle_rad)) / RELIEF_RAD
    # The correction c that a pixel's own light asks for if its brightness g is right: light = g (1
    # + cos(phase + c)).
    guess = -misfit * rotation.sign * sine / (sine * sine + SINE_FLOOR)
    unit = geometry.period_px / TAU
    down, right = rotation.down_and_right(scene.slopes)
    fitted = np.stack(
        [
            cosine,
            rotation.sign * sine,
            np.log(bright) / 2,
            scene.share,
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
    fitted *= scene.known
    image_maps = np.stack([scene.light, scene.plane_light, plane_misfit, scene.inside]).astype(
        np.float32
    )
    turned_maps = rotation.turn(np.nan_to_num(np.concatenate([image_maps, fitted])))
    x = np.concatenate([turned_maps, _turned_sides(scene, layer, geometry)])
    if not geometry.shading:
        x[list(SHADING)] = 0
    return x, np.ascontiguousarray(rotation.turn(exists))


def _misfit_around(
    light: Image, bright: Image, raised: NDArray, valid: Mask | bool = True
) -> Image:
    """Root mean square, in the pixel's surroundings, by which light over brightness differs from a
    fringe's, which is ``raised``; 2 where not ``valid``."""
    misfit = light / np.maximum(bright, np.float32(LEAST_BRIGHT)) - raised
    square = np.clip(np.where(valid, misfit, np.float32(2)), -2, 2).astype(np.float32) ** 2
    return np.sqrt(cv2.GaussianBlur(square, (0, 0), AROUND_PX, borderType=cv2.BORDER_REPLICATE))


def from_the_sides(
    light: Image,
    maps: NDArray[np.float32],
    reach_px: int,
    raised: Callable[[NDArray | float], NDArray],
    difference: Callable[[NDArray], NDArray] = lambda rad: rad,
) -> Image:
    """The phase extrapolated to a pixel from each of `SIDES`, minus its own phase, and the misfit
    of its light with it: (17, h, w) float32. ``maps`` (5, h, w): phase, its slopes down and right,
    brightness, object; ``raised``: light over brightness of the pixel's fringe with the phase moved
    by so many rad; ``difference``: of two phases, from their difference. Beside a depth edge the
    window of a pixel covers two surfaces, a window further in only one."""
    _, height, width = maps.shape
    padded = np.pad(maps, ((0, 0), (reach_px, reach_px), (reach_px, reach_px)))
    corrections, misfits = [], [_misfit_around(light, maps[3], raised(0.0))]
    for row, column in SIDES:
        dy, dx = round(row * reach_px), round(column * reach_px)
        side_maps = padded[
            :, reach_px + dy : reach_px + dy + height, reach_px + dx : reach_px + dx + width
        ]
        on_object = side_maps[4] > 0
        step = (
            side_maps[0] - side_maps[1] * np.float32(dy) - side_maps[2] * np.float32(dx) - maps[0]
        )
        step = np.clip(difference(step), -LARGEST_RAD, LARGEST_RAD) * on_object
        corrections.append(step)
        misfits.append(_misfit_around(light, side_maps[3], raised(step), on_object))
    return np.stack(corrections + misfits).astype(np.float32)


def _turned_sides(scene: PhaseScene, layer: CalibrationLayer, geometry: Geometry) -> Image:
    """`from_the_sides` of a scene, rotated for the network."""
    rotation, turn, sign = (
        geometry.rotation,
        geometry.rotation.turn,
        np.float32(geometry.rotation.sign),
    )
    psi = turn(sign * wrapped(scene.phase_rad - layer.infinity_rad).astype(np.float32))
    phase = turn(sign * scene.phase_rad)
    turned_maps = (
        *rotation.down_and_right(scene.slopes),
        scene.bright,
        scene.inside.astype(np.float32),
    )
    maps = np.stack([psi, *map(turn, turned_maps)])
    reach_px = max(1, round(SIDE_PERIODS * geometry.period_px))
    return from_the_sides(
        turn(scene.light), maps, reach_px, lambda step: 1 + np.cos(phase + step), wrapped
    )


@dataclass(frozen=True)
class CrossedScene(CandidateScene):
    """Maps (h, w), or (n, h, w). ``light`` and ``bright`` as multiples of the object's median
    brightness; ``plane_misfit``: arcsinh of the light less the plane's in sigmas, 0 where no plane
    is ``shown``; ``nearness`` float32: of the fit; ``window_rad`` (2): phases of the first windows
    less the fit's; ``modulation`` (2) of these, over that of the fit; ``step_rad`` (2): joint phase
    of a turn further and nearer, less the base's; ``misfit_rad`` (3) and ``exists`` (3): of
    further, base and nearer; ``contrast`` of both carriers."""

    exact = ("nearness",)
    denied: ClassVar[float] = 6.0

    plane_misfit: Image
    shown: bool
    nearness: NDArray[np.float32]
    window_rad: Image
    modulation: Image
    step_rad: Image
    misfit_rad: Image
    exists: Mask
    contrast: tuple[float, float]

    @property
    def offers_rad(self) -> Image:
        """Joint phase of the candidates further, base and nearer less that of the base, (3, h,
        w)."""
        return np.stack([self.step_rad[0], np.zeros_like(self.step_rad[0]), self.step_rad[1]])

    @classmethod
    def of(cls, fitted: Fitted) -> "CrossedScene":
        """From an observation of the measured route."""
        seen, fit, found = fitted.seen, fitted.fit, fitted.candidates
        background, carriers = seen.background, seen.carriers
        lit = fit.brightness[seen.inside & (fit.brightness > 0)]
        level = np.float32(max(float(np.median(lit)), 1.0) if lit.size else 1.0)
        bright = fit.brightness / level
        floor = np.maximum(fit.brightness, LEAST_BRIGHT * level)
        modulation = [
            grey / (contrast * floor)
            for grey, contrast in zip(seen.modulation, seen.contrast, strict=True)
        ]
        steps = (found.nearness[[0, 2]] - found.nearness[1]) * carriers.joint_gain
        shown = background.shown
        plane = (
            np.arcsinh(background.residual / np.float32(background.noise_grey))
            / 4
            * np.float32(shown)
        )
        return cls(
            crop=carriers.crop,
            light=(seen.grey - np.float32(background.ambient_grey)) / level,
            plane_misfit=plane.astype(np.float32),
            shown=shown,
            inside=seen.inside,
            nearness=fit.nearness,
            bright=bright,
            share=fit.weight,
            window_rad=wrapped(seen.phase_rad - carriers.phases(fit.nearness)).astype(np.float32),
            modulation=np.clip(np.stack(modulation), 0, 4).astype(np.float32),
            step_rad=steps.astype(np.float32),
            misfit_rad=found.misfit_rad,
            exists=found.exists,
            contrast=seen.contrast,
            strength=float(level * np.mean(seen.contrast) / background.noise_grey),
        )

    def with_base(self, candidate: int, where: Mask, carriers: Carriers) -> "CrossedScene":
        """The same with a turn further (0) or nearer (2) as the base on the pixels ``where`` (h, w)
        at which it exists; of the turn beyond nothing is known. ``carriers``: those of the whole
        image."""
        part, nearer = carriers.at(self.crop), candidate == 2
        where = where & self.exists[candidate]
        change_rad = self.step_rad[int(nearer)] * where
        zero, old, new = np.zeros_like(change_rad), self.misfit_rad[1], self.misfit_rad[candidate]
        misfits, exists, steps = (
            [old, new, zero + np.float32(np.pi)],
            [True, True, False],
            [-change_rad, zero],
        )
        one_way = 1 if nearer else -1  # from further to nearer, or back
        change = change_rad / part.joint_gain
        window = wrapped(self.window_rad - part.gain * change).astype(np.float32)
        nearness = (self.nearness + change).astype(np.float32)
        maps = {
            "misfit_rad": np.stack(misfits[::one_way]),
            "exists": np.array(exists[::one_way])[:, None, None],
            "step_rad": np.stack(steps[::one_way]),
            "window_rad": window,
            "nearness": nearness,
        }
        return replace(
            self,
            **{name: np.where(where, values, getattr(self, name)) for name, values in maps.items()},
        )


def crossed_channels(scene: CrossedScene, carriers: Carriers) -> tuple[Image, Mask]:
    """Input of the network (`CROSSED_CHANNELS`, h, w) float32, and which candidates exist, bool (3,
    h, w): the base always does. ``carriers``: those of the whole image."""
    part = carriers.at(scene.crop)
    period_px, joint = carriers.period_px, part.joint_gain
    psi = scene.nearness * joint
    right, down = phase_slopes(psi, scene.inside, SLOPE_PERIODS * period_px)
    bright = np.maximum(scene.bright, np.float32(LEAST_BRIGHT))
    raised, slope = fringes(part, scene.nearness, scene.contrast)
    misfit = (scene.light - scene.bright * raised) / bright
    waves = [wave(phase) for phase in part.phases(scene.nearness) for wave in (np.cos, np.sin)]
    middle = float(np.median(psi[scene.inside])) if scene.inside.any() else 0.0
    guess = misfit * slope / (slope * slope + SINE_FLOOR)
    exists = scene.exists.copy()
    exists[1] = True
    unit = np.float32(period_px / (2 * np.pi))
    fitted = np.stack(
        [
            *waves,
            np.log(bright) / 2,
            scene.share,
            np.clip(misfit, -2, 2),
            unit * down,
            unit * right,
            *np.clip(scene.window_rad, -2, 2),
            *(scene.modulation - 1),
            *np.minimum(scene.misfit_rad, 2) * exists,
            exists[0],
            exists[2],
            np.clip((psi - middle) / RELIEF_RAD, -4, 4),
            np.clip(guess, -LARGEST_RAD, LARGEST_RAD),
        ]
    ).astype(np.float32)
    fitted *= scene.known
    shown = np.full(psi.shape, scene.shown)
    own = np.stack([np.clip(scene.light, -1, 8), scene.plane_misfit, shown, scene.inside]).astype(
        np.float32
    )
    maps = np.stack([psi, down, right, scene.bright, scene.inside]).astype(np.float32)

    def moved(step_rad: NDArray | float) -> NDArray:
        return fringes(part, scene.nearness + step_rad / joint, scene.contrast)[0]

    sides = from_the_sides(scene.light, maps, max(1, round(SIDE_PERIODS * period_px)), moved)
    return np.nan_to_num(np.concatenate([own, fitted, sides])), exists
