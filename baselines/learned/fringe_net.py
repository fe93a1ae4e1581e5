"""fringe-net: networks that give the numerator M and denominator D of a fringe's wrapped phase, atan2(M, D), from one
image (Feng et al. 2019), in the place of the local fit. Mask, order and depth are those of the measured routes.

An ensemble of networks answers with the sum of its members' (D, M). Its uncertainty is the mean of the variances that
the members state and the variance between their phases (Lakshminarayanan et al. 2017).
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
from fpp_ml_bench.baselines.phase.calibration_layer import TAU, Crop, Image, Mask, wrapped
from fpp_ml_bench.baselines.phase.depth import CrossedRoute, FringeMeasurement, Measurement, NearnessFit
from fpp_ml_bench.baselines.phase.local_fit import fringes
from fpp_ml_bench.baselines.phase.observe import CrossedObservation, Frames, Observation
from fpp_ml_bench.baselines.phase.resampling import Periods
from fpp_ml_bench.baselines.phase.settings import Settings
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.optics.rig import Rig

WINDOW_PERIODS = 0.6  # sigma of the Gaussian over which mean and spread of the grey levels are taken
LEAST_SPREAD_GREY = 1.0
FURTHEST = 4.0  # spreads at which grey levels are clipped
FRINGE_CHANNELS = "grey level", "against its surroundings"


@dataclass(frozen=True)
class FringeScene(CroppedMaps):
    """The part ``crop`` of an image, grey levels (h, w): ``grey``, and ``mean`` and ``spread``, standard deviation,
    around each pixel."""

    grey: Image
    mean: Image
    spread: Image

    @classmethod
    def of(cls, grey: Image, period_px: float, crop: Crop) -> "FringeScene":
        """Of a part ``grey`` float32 (h, w) of an image whose longest fringe has ``period_px``."""
        mean, power = (cv2.GaussianBlur(one, (0, 0), WINDOW_PERIODS * period_px) for one in (grey, grey * grey))
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
    """Of K carriers: ``phase_rad`` in [-pi, pi] and ``sigma_rad``, its standard uncertainty, float32 (K, h, w)."""

    phase_rad: Image
    sigma_rad: Image


def phases_of(networks: Sequence[FringeNet], x: Image) -> Phases:
    """The answer of one network or several to the input ``x`` (C, h, w)."""
    answers = [network.outputs(x)[0] for network in networks]
    total = np.sum(answers, axis=0)
    count = len(total) // 3
    phase = np.arctan2(total[:count], total[count : 2 * count])
    variance: NDArray = np.mean([(SCALE_TO_SIGMA * np.exp(one[2 * count :])) ** 2 for one in answers], axis=0)
    if len(answers) > 1:
        apart = [wrapped(np.arctan2(one[:count], one[count : 2 * count]) - phase) for one in answers]
        variance = variance + np.sum(np.square(apart), axis=0) / (len(answers) - 1)
    return Phases(phase.astype(np.float32), np.sqrt(variance).astype(np.float32))


class FringeNetRoute(Geometry):
    """Fringes of one direction, turned for the network so that phase grows downwards. The order is that of the local
    fit: with the exact phase larger parts hang together, and all of a part is wrong where a texture misleads it."""

    def __init__(
        self, rig: Rig, settings: Settings, networks: Sequence[FringeNet], periods: Periods | None = None
    ) -> None:
        super().__init__(rig, settings, periods)
        self.networks = networks

    def phases(self, seen: Observation) -> Phases:
        """Of the one carrier."""
        x = fringe_channels(FringeScene.of(seen.greys[0], self.period_px, seen.crop))
        turned = phases_of(self.networks, np.ascontiguousarray(self.rotation.turn(x)))
        phase, sigma = (np.ascontiguousarray(self.rotation.back(maps)) for maps in vars(turned).values())
        return Phases(np.float32(self.rotation.sign) * phase, sigma)

    def measure(self, image: Frames, mask: Mask | None = None) -> FringeMeasurement:
        seen = self.observe(image, mask)
        order, margin = self.choose(seen)
        if seen.inside.any():
            found = self.phases(seen)
            phase = found.phase_rad[0]
            order = order + np.rint((seen.phase_rad - phase) / TAU).astype(np.int32)
            seen = replace(seen, phase_rad=phase, uncertainty_rad=np.float32(EXPECTED_SHARE) * found.sigma_rad[0])
        return self.conclude(seen, order, margin)


class FringeNetCrossedRoute(CrossedRoute):
    """Both carriers of one crossed frame, of the rig that the networks learned from."""

    def __init__(
        self, rig: Rig, settings: Settings, networks: Sequence[FringeNet], periods: Periods | None = None
    ) -> None:
        super().__init__(rig, settings, periods=periods)
        self.networks = networks

    def phases(self, seen: CrossedObservation) -> Phases:
        """Of both carriers."""
        return phases_of(self.networks, fringe_channels(FringeScene.of(seen.grey, self.period_px, seen.crop)))

    def measure(self, image: Frames, mask: Mask | None = None) -> Measurement:
        seen = self.observe(image, mask)
        if not seen.inside.any():
            return self.conclude(self.fitted(seen))
        found = self.phases(seen)
        points = found.phase_rad[:, :: seen.stride, :: seen.stride]
        fitted = self.fitted(replace(seen, phase_rad=found.phase_rad, point_phase_rad=points))
        return self.conclude(replace(fitted, fit=_nearness_fit(fitted, fitted.fit, found.sigma_rad)))


def _nearness_fit(seen: CrossedObservation, fit: NearnessFit, sigma_rad: Image) -> NearnessFit:
    """The nearness that the two phases of every pixel tell, in the orders of a ``fit``."""
    carriers = seen.carriers
    beside = wrapped(seen.phase_rad - carriers.phases(fit.nearness))
    nearness = fit.nearness + (carriers.gain * beside).sum(axis=0) / carriers.joint_gain**2
    misfit = seen.light - np.maximum(fit.brightness, 0) * fringes(carriers, nearness, seen.contrast)[0]
    uncertainty = np.hypot(*(carriers.gain * sigma_rad)) / carriers.joint_gain
    maps = (nearness, fit.brightness, misfit, fit.weight, uncertainty)
    return NearnessFit(*(np.asarray(values, np.float32) for values in maps))
