"""fringe-net: networks that give the numerator M and denominator D of a fringe's wrapped phase,
atan2(M, D), from one image (Feng et al. 2019), in the place of the local fit. Mask, order and depth
are those of the measured routes.

An ensemble of networks answers with the sum of its members' (D, M). Its uncertainty is the mean of
the variances that the members state and the variance between their phases (Lakshminarayanan et al.
2017).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.learned.inputs import CroppedMaps, Geometry
from fpp_ml_bench.baselines.learned.network import FringeNet
from fpp_ml_bench.baselines.learned.odds import SCALE_TO_SIGMA
from fpp_ml_bench.baselines.learned.routes import EXPECTED_SHARE
from fpp_ml_bench.baselines.learned.warp import Warp
from fpp_ml_bench.baselines.phase.depth import Fitted, NearnessFit
from fpp_ml_bench.baselines.phase.geometry import Carriers, Crop, Image, wrapped
from fpp_ml_bench.baselines.phase.local_fit import fringes
from fpp_ml_bench.baselines.phase.observe import CrossedObservation, Observation
from fpp_ml_bench.baselines.phase.order import FringeOrder
from fpp_ml_bench.constants import GREY_LEVELS, MM_PER_M, TAU

WINDOW_PERIODS = 0.6
"""Sigma of the Gaussian over which mean and spread of the grey levels are taken."""
LEAST_SPREAD_GREY = 1.0
FURTHEST = 4.0  # spreads at which grey levels are clipped
FRINGE_CHANNELS = "grey level", "against its surroundings"


@dataclass(frozen=True)
class FringeScene(CroppedMaps):
    """The part ``crop`` of an image, grey levels (h, w): ``grey``, and ``mean`` and ``spread``,
    standard deviation, around each pixel."""

    grey: Image
    mean: Image
    spread: Image

    @classmethod
    def of(cls, grey: Image, period_px: float, crop: Crop) -> "FringeScene":
        """Of a part ``grey`` float32 (h, w) of an image whose longest fringe has ``period_px``."""
        mean, power = (
            cv2.GaussianBlur(one, (0, 0), WINDOW_PERIODS * period_px) for one in (grey, grey * grey)
        )
        spread = np.sqrt(np.maximum(power - mean * mean, LEAST_SPREAD_GREY**2))
        return cls(crop, grey, np.asarray(mean, np.float32), np.asarray(spread, np.float32))

    @property
    def unit_grey(self) -> Image:
        """The unit of M and D: amplitude of a sinusoid of this spread."""
        return np.float32(np.sqrt(2)) * self.spread  # type: ignore[no-any-return]


def fringe_channels(scene: FringeScene) -> Image:
    """Input of the network (`FRINGE_CHANNELS`, h, w) float32."""
    against = np.clip((scene.grey - scene.mean) / scene.unit_grey, -FURTHEST, FURTHEST)
    return np.stack([scene.grey / np.float32(GREY_LEVELS), against]).astype(np.float32)


@dataclass(frozen=True)
class Phases:
    """Of K carriers: ``phase_rad`` in [-pi, pi] and ``sigma_rad``, its standard uncertainty,
    float32 (K, h, w)."""

    phase_rad: Image
    sigma_rad: Image


def phases_of(networks: Sequence[FringeNet], x: Image) -> tuple[Phases, Image]:
    """The answer of one network or several to the input ``x`` (C, h, w): phases, and the logit
    (h, w) of a pixel to be object, 0 of networks without a mask."""
    answers = [network.outputs(x)[0] for network in networks]
    total = np.sum(answers, axis=0)
    count = len(total) // 3
    phase = np.arctan2(total[:count], total[count : 2 * count])
    variance: NDArray = np.mean(
        [(SCALE_TO_SIGMA * np.exp(one[2 * count : 3 * count])) ** 2 for one in answers], axis=0
    )
    if len(answers) > 1:
        apart = [
            wrapped(np.arctan2(one[:count], one[count : 2 * count]) - phase) for one in answers
        ]
        variance = variance + np.sum(np.square(apart), axis=0) / (len(answers) - 1)
    logit = total[3 * count :].sum(axis=0, dtype=np.float32) / len(answers)
    return Phases(phase.astype(np.float32), np.sqrt(variance).astype(np.float32)), logit


def warped_phases(
    networks: Sequence[FringeNet], grey: Image, period_px: float, warp: Warp
) -> Phases:
    """Phases at the pixels of an image ``grey`` (h, w), which ``warp`` takes to the fringes of
    ``period_px``, the longer one of two, that the networks learned from."""
    image = warp.image(grey)
    scene = FringeScene.of(image, period_px, (slice(0, image.shape[0]), slice(0, image.shape[1])))
    found, _ = phases_of(networks, fringe_channels(scene))
    phase_rad, *sigmas = warp.back(found.phase_rad, [*found.sigma_rad], grey.shape)
    return Phases(phase_rad, np.stack(sigmas))


@dataclass(frozen=True)
class FringePhase:
    """The phase of fringes of one direction by networks, for which they are turned so that phase
    grows downwards, and brought to the period of ``learned_px``. The order is that of the local
    fit: with the exact phase larger parts hang together, and all of a part is wrong where a texture
    misleads it."""

    geometry: Geometry
    networks: Sequence[FringeNet]
    learned_px: float
    warp: Warp | None
    """From the turned image; None where it is left as it is."""

    @classmethod
    def of(
        cls, geometry: Geometry, networks: Sequence[FringeNet], learned_px: float
    ) -> "FringePhase":
        """For the fringes of a geometry."""
        rotation, model = geometry.rotation, geometry.model
        phase = model.layer.absolute_phase(model.rig.standoff_m * MM_PER_M)
        turned = rotation.sign * rotation.turn(phase)
        step_rad = [np.diff(turned, axis=axis).mean() for axis in (1, 0)]
        warp = Warp.of_one(np.array(step_rad), learned_px)
        return cls(geometry, networks, learned_px, warp if warp.needed else None)

    def phases(self, seen: Observation) -> Phases:
        """Of the one carrier."""
        rotation, grey = self.geometry.rotation, seen.greys[0]
        if self.warp is not None:
            grey = np.ascontiguousarray(rotation.turn(grey))
            turned = warped_phases(self.networks, grey, self.learned_px, self.warp)
        else:
            x = fringe_channels(FringeScene.of(grey, self.geometry.period_px, seen.crop))
            turned, _ = phases_of(self.networks, np.ascontiguousarray(rotation.turn(x)))
        phase, sigma = (
            np.ascontiguousarray(rotation.back(maps))
            for maps in (turned.phase_rad, turned.sigma_rad)
        )
        return Phases(np.float32(rotation.sign) * phase, sigma)

    def __call__(self, chosen: FringeOrder) -> FringeOrder:
        seen = chosen.seen
        if not seen.inside.any():
            return chosen
        found = self.phases(seen)
        phase, sigma = found.phase_rad[0], np.float32(EXPECTED_SHARE) * found.sigma_rad[0]
        order = chosen.order + np.rint((seen.phase_rad - phase) / TAU).astype(np.int32)
        return FringeOrder(
            replace(seen, phase_rad=phase, uncertainty_rad=sigma), order, chosen.margin
        )


@dataclass(frozen=True)
class CrossedPhases:
    """The phases of both carriers of one crossed frame by networks: first for the choice of the
    order (`before`), then for the nearness of every pixel (`after`). ``carriers``: those of the
    image; ``learned``: of the networks'."""

    carriers: Carriers
    learned: Carriers
    networks: Sequence[FringeNet]
    warp: Warp | None
    """None where the image is left as it is."""

    @classmethod
    def of(
        cls, carriers: Carriers, learned: Carriers, networks: Sequence[FringeNet]
    ) -> "CrossedPhases":
        """With the warp that the carriers need."""
        warp = Warp.of_pair(carriers, learned)
        return cls(carriers, learned, networks, warp if warp.needed else None)

    def phases(self, seen: CrossedObservation) -> Phases:
        """Of both carriers."""
        if self.warp is not None:
            return warped_phases(self.networks, seen.grey, self.learned.period_px, self.warp)
        scene = FringeScene.of(seen.grey, self.carriers.period_px, seen.crop)
        return phases_of(self.networks, fringe_channels(scene))[0]

    def before(self, seen: CrossedObservation) -> CrossedObservation:
        """The observation with these phases."""
        found = self.phases(seen)
        points = found.phase_rad[:, :: seen.stride, :: seen.stride]
        return replace(
            seen, phase_rad=found.phase_rad, point_phase_rad=points, sigma_rad=found.sigma_rad
        )

    @staticmethod
    def after(fitted: Fitted) -> Fitted:
        """The nearness that they tell."""
        sigma_rad = fitted.seen.sigma_rad
        if sigma_rad is None:  # no object
            return fitted
        return replace(fitted, fit=_nearness_fit(fitted.seen, fitted.fit, sigma_rad))


def _nearness_fit(seen: CrossedObservation, fit: NearnessFit, sigma_rad: Image) -> NearnessFit:
    """The nearness that the two phases of every pixel tell, in the orders of a ``fit``."""
    carriers = seen.carriers
    beside = wrapped(seen.phase_rad - carriers.phases(fit.nearness))
    nearness = fit.nearness + (carriers.gain * beside).sum(axis=0) / carriers.joint_gain**2
    misfit = (
        seen.light - np.maximum(fit.brightness, 0) * fringes(carriers, nearness, seen.contrast)[0]
    )
    uncertainty = np.hypot(*(carriers.gain * sigma_rad)) / carriers.joint_gain
    maps = (nearness, fit.brightness, misfit, fit.weight, uncertainty)
    return NearnessFit(*(np.asarray(values, np.float32) for values in maps))
