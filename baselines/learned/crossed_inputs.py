"""Input of crossed-net: maps of one frame, each relative to the frame's own light, and none of a distance.

The measured route gives every pixel a nearness and how well both phases agree there, a turn further, and a turn nearer.
Light and brightness are given as multiples of the object's median brightness, noise and plane in sigmas of the noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.learned.inputs import (
    LARGEST_RAD,
    SIDE_CHANNELS,
    SIDE_PERIODS,
    SIDES,
    CroppedMaps,
    from_the_sides,
)
from fpp_ml_bench.baselines.phase.calibration_layer import Carriers, Image, Mask, wrapped
from fpp_ml_bench.baselines.phase.depth import Fitted
from fpp_ml_bench.baselines.phase.local_fit import fringes, phase_slopes

CHANNELS = (
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
DOWN, RIGHT = CHANNELS.index("slope down"), CHANNELS.index("slope right")
FIRST_SIDE = CHANNELS.index("first guess") + 1
SLOPE_PERIODS = 0.13  # sigma over which slopes are averaged
RELIEF_RAD = 1.5  # unit of the relief, small enough that the corrections show in it
SLOPE_FLOOR = 0.1
LEAST_BRIGHT = 0.05  # least brightness that is divided by, as a multiple of the object's median
LEAST_SHARE = 0.02  # of the fit's window that must lie on the object for the fit to count


@dataclass(frozen=True)
class Scene(CroppedMaps):
    """The part ``crop`` of an image; maps (h, w), or (n, h, w). ``light`` without ambient light, and ``bright``, of the
    fit, as multiples of the object's median brightness; ``plane_misfit``: arcsinh of the light less the plane's in
    sigmas, 0 where no plane is ``shown``; ``inside``: mask of the measured route; ``nearness`` float32: of the fit;
    ``share``: of its window that lies on the object; ``window_rad`` (2): phases of the first windows less the fit's;
    ``modulation`` (2) of these, over that of the fit; ``step_rad`` (2): joint phase of a turn further and nearer, less
    the base's; ``misfit_rad`` (3) and ``exists`` (3): of further, base and nearer; ``contrast`` of both carriers;
    ``strength``: the object's median modulation in sigmas of the noise."""

    real_maps = "light", "plane_misfit", "bright", "share", "window_rad", "modulation", "step_rad", "misfit_rad"
    other_maps = "inside", "nearness", "exists"

    light: Image
    plane_misfit: Image
    shown: bool
    inside: Mask
    nearness: NDArray[np.float32]
    bright: Image
    share: Image
    window_rad: Image
    modulation: Image
    step_rad: Image
    misfit_rad: Image
    exists: Mask
    contrast: tuple[float, float]
    strength: float

    @classmethod
    def of(cls, seen: Fitted) -> "Scene":
        """From an observation of the measured route."""
        fit, background, carriers = seen.fit, seen.background, seen.carriers
        lit = fit.brightness[seen.inside & (fit.brightness > 0)]
        level = np.float32(max(float(np.median(lit)), 1.0) if lit.size else 1.0)
        bright = fit.brightness / level
        floor = np.maximum(fit.brightness, LEAST_BRIGHT * level)
        modulation = [grey / (contrast * floor) for grey, contrast in zip(seen.modulation, seen.contrast, strict=True)]
        found = seen.candidates
        steps = (found.nearness[[0, 2]] - found.nearness[1]) * carriers.joint_gain
        shown = background.shown
        plane = np.arcsinh(background.residual / np.float32(background.noise_grey)) / 4 * np.float32(shown)
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

    def with_base(self, candidate: int, where: Mask, carriers: Carriers) -> "Scene":
        """The same with a turn further (0) or nearer (2) as the base on the pixels ``where`` (h, w) at which it exists;
        of the turn beyond nothing is known. ``carriers``: those of the whole image."""
        part, nearer = carriers.at(self.crop), candidate == 2
        where = where & self.exists[candidate]
        change_rad = self.step_rad[int(nearer)] * where
        nothing, back = np.full_like(change_rad, np.pi), np.zeros_like(change_rad)
        old_base, beyond = (0, 2) if nearer else (2, 0)
        misfit, exists, step = self.misfit_rad.copy(), self.exists.copy(), self.step_rad.copy()
        misfit[1], exists[1] = self.misfit_rad[candidate], True
        misfit[old_base], exists[old_base] = self.misfit_rad[1], True
        misfit[beyond], exists[beyond] = nothing, False
        step[int(not nearer)], step[int(nearer)] = -change_rad, back
        change = change_rad / part.joint_gain
        window = wrapped(self.window_rad - part.gain * change).astype(np.float32)
        nearness = (self.nearness + change).astype(np.float32)
        new = {"misfit_rad": misfit, "exists": exists, "step_rad": step, "window_rad": window, "nearness": nearness}
        return replace(self, **{name: np.where(where, maps, getattr(self, name)) for name, maps in new.items()})


def without_plane(scene: Scene) -> Scene:
    """The same where no plane is known."""
    return replace(scene, plane_misfit=np.zeros_like(scene.plane_misfit), shown=False)


def channels(scene: Scene, carriers: Carriers) -> tuple[Image, Mask]:
    """Input of the network (`CHANNELS`, h, w) float32, and which candidates exist, bool (3, h, w): the base always
    does. ``carriers``: those of the whole image."""
    part = carriers.at(scene.crop)
    period_px, joint = carriers.period_px, part.joint_gain
    psi = scene.nearness * joint
    right, down = phase_slopes(psi, scene.inside, SLOPE_PERIODS * period_px)
    bright = np.maximum(scene.bright, np.float32(LEAST_BRIGHT))
    raised, slope = fringes(part, scene.nearness, scene.contrast)
    misfit = (scene.light - scene.bright * raised) / bright
    waves = [wave(phase) for phase in part.phases(scene.nearness) for wave in (np.cos, np.sin)]
    middle = float(np.median(psi[scene.inside])) if scene.inside.any() else 0.0
    guess = misfit * slope / (slope * slope + SLOPE_FLOOR)
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
    fitted *= scene.share > LEAST_SHARE
    shown = np.full(psi.shape, scene.shown)
    own = np.stack([np.clip(scene.light, -1, 8), scene.plane_misfit, shown, scene.inside]).astype(np.float32)
    maps = np.stack([psi, down, right, scene.bright, scene.inside]).astype(np.float32)

    def moved(step_rad: NDArray | float) -> NDArray:
        return fringes(part, scene.nearness + step_rad / joint, scene.contrast)[0]

    sides = from_the_sides(scene.light, maps, max(1, round(SIDE_PERIODS * period_px)), moved)
    return np.nan_to_num(np.concatenate([own, fitted, sides])), exists


def symmetric(maps: Sequence[NDArray], x: Image, turn: int) -> tuple[list[NDArray], Image]:
    """``maps`` (..., n, n) and the input ``x`` (C, n, n) in one of the 8 orientations of a square: bit 0 of ``turn``
    flips rows, bit 1 columns, bit 2 swaps them. What points somewhere is turned with them."""
    x = x.copy()
    places = list(SIDES)
    if turn & 1:
        maps, x = [values[..., ::-1, :] for values in maps], x[..., ::-1, :]
        x[DOWN] *= -1
        places = [(-row, column) for row, column in places]
    if turn & 2:
        maps, x = [values[..., ::-1] for values in maps], x[..., ::-1]
        x[RIGHT] *= -1
        places = [(row, -column) for row, column in places]
    if turn & 4:
        maps, x = [values.swapaxes(-1, -2) for values in maps], x.swapaxes(-1, -2)
        x = x.copy()
        x[[DOWN, RIGHT]] = x[[RIGHT, DOWN]]
        places = [(column, row) for row, column in places]
    order = [places.index(side) for side in SIDES]
    count = len(SIDES)
    corrections, own = x[FIRST_SIDE : FIRST_SIDE + count], x[FIRST_SIDE + count]
    misfits = x[FIRST_SIDE + count + 1 :]
    sides = np.concatenate([corrections[order], own[None], misfits[order]])
    x = np.concatenate([x[:FIRST_SIDE], sides])
    return [np.ascontiguousarray(values) for values in maps], np.ascontiguousarray(x)
