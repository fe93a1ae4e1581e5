"""fringe-net: networks that give, from one frame of one carrier or two, the numerator M and
denominator D of each carrier's wrapped phase, atan2(M, D) (Feng et al. 2019), its uncertainty, and
which pixels are object. Order and depth are those of the measured routes.

The image is warped to the carriers that the networks know (`warp`), so that they measure on any rig.
What the empty scene can't explain is an input of its own: where a lit background plane is known, it
tells object from wall.

An ensemble of networks answers with the sum of its members' (D, M). Its uncertainty is the mean of
the variances that the members state and the variance between their phases (Lakshminarayanan et al.
2017).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.learned.network import SCALE_TO_SIGMA, FringeNet
from fpp_ml_bench.baselines.learned.warp import PLACES, Warp
from fpp_ml_bench.baselines.phase.depth import Fitted, NearnessFit
from fpp_ml_bench.baselines.phase.geometry import Image, Mask, wrapped
from fpp_ml_bench.baselines.phase.local_fit import fringes
from fpp_ml_bench.baselines.phase.observe import (
    Capture,
    CrossedObservation,
    Observation,
    OneCarrier,
)
from fpp_ml_bench.baselines.phase.order import FringeOrder
from fpp_ml_bench.constants import GREY_LEVELS, TAU

WINDOW_PERIODS = 0.6
"""Sigma of the Gaussian over which mean and spread of the grey levels are taken."""
LEAST_SPREAD_GREY = 1.0
"""Least standard deviation of the grey levels around a pixel: noise of a dark image."""
FURTHEST = 4.0
"""Spreads at which grey levels are clipped."""
MISFIT_UNIT = 4.0
"""Of the channel of the empty scene's misfit, the arcsinh of its standard deviations over this."""
WIDE = -3.0, 2.0
"""Least logit of a pixel to be object where the measured mask calls it one, and where it does not,
so that few pixels are missed. Each mask knows what the other does not: the measured one the
silhouette to the pixel, the networks a wall that the empty scene explains badly. On validation
views before the paper's rig, `paper`, the measured mask misses 0.002% and invents 0.48% of the
object, the networks alone 0.11% and 0.57%, both 0.004% and 0.37%; on four drawn rigs in `workshop`
0.51% and 6.4%, 0.25% and 1.28%, 0.21% and 2.9%. With -2 the first invents 0.30%, but misses 0.014%,
and a missed pixel is off by its whole depth: the object's MAE was 1.18 mm and its RMSE 19.1, with
-3 1.05 and 11.5."""
EVEN = 0.0, 3.0
"""The same where a pixel that is as likely wall as object is left out, so that the fewest pixels
are wrong, missed or invented. On validation views before the paper's rig and eight drawn ones,
missed and invented in `paper`: 0.10% and 0.12%, 0.25% and 0.38%; in `workshop`: 0.18% and 0.39%,
0.38% and 1.0%. `WIDE` there: 0.003% and 0.39%, 0.006% and 1.3%; 0.04% and 1.5%, 0.04% and 4.1%."""
AVERAGE_PERIODS, AVERAGE_RAD = 0.2, 0.3
"""Sigmas over which the phase is averaged once its order is chosen (bilateral filter): across the
image in periods of the longer carrier, and between phases, so that surfaces apart stay apart. What a
network is off by differs from pixel to pixel. Error of answered object pixels of one network,
crossed, validation views, without and with it: paper's rig 0.68 and 0.61 per mille in `paper`, 1.15
and 1.03 in `workshop`; four drawn rigs 0.87 and 0.85, 1.69 and 1.62. Twice as far between phases or
1.5 times across the image: the same within 0.02."""
EXPECTED_SHARE = float(np.sqrt(2 / np.pi))
"""Expected size of a normal error, in standard deviations."""


@dataclass(frozen=True)
class FringeScene:
    """An image (h, w): its ``grey`` levels, and ``mean`` and ``spread``, standard deviation, around
    each pixel."""

    grey: Image
    mean: Image
    spread: Image

    @classmethod
    def of(cls, grey: Image, period_px: float) -> "FringeScene":
        """Of an image float32 whose longest fringe has ``period_px``."""
        mean, power = (
            cv2.GaussianBlur(image, (0, 0), WINDOW_PERIODS * period_px)
            for image in (grey, grey * grey)
        )
        spread = np.sqrt(np.maximum(power - mean * mean, LEAST_SPREAD_GREY**2))
        return cls(grey, np.asarray(mean, np.float32), np.asarray(spread, np.float32))

    @property
    def unit_grey(self) -> Image:
        """The unit of M and D: amplitude of a sinusoid of this spread."""
        return np.float32(np.sqrt(2)) * self.spread  # type: ignore[no-any-return]


def empty_scene_channel(residual: Image, noise_grey: float, shown: bool) -> Image:
    """The misfit of the empty scene (h, w), 0 where no plane is ``shown``."""
    if not shown:
        return np.zeros_like(residual)
    return (np.arcsinh(residual / np.float32(noise_grey)) / MISFIT_UNIT).astype(np.float32)


def channels(scene: FringeScene, misfit: Image, shown: bool) -> Image:
    """Input of the network float32 (4, h, w): grey level, and against its surroundings;
    `empty_scene_channel`, and whether a plane is shown."""
    against = np.clip((scene.grey - scene.mean) / scene.unit_grey, -FURTHEST, FURTHEST)
    plane = np.full_like(misfit, shown)
    return np.stack([scene.grey / np.float32(GREY_LEVELS), against, misfit, plane]).astype(
        np.float32
    )


@dataclass(frozen=True)
class Phases:
    """Of K carriers: ``phase_rad`` in [-pi, pi] and ``sigma_rad``, its standard uncertainty,
    float32 (K, h, w)."""

    phase_rad: Image
    sigma_rad: Image


def phases_of(networks: Sequence[FringeNet], x: Image) -> tuple[Phases, Image]:
    """The answer of one network or several to the input ``x`` (C, h, w): phases, and the logit
    (h, w) of a pixel to be object."""
    answers = [network.outputs(x) for network in networks]
    total = np.sum(answers, axis=0)
    count = len(total) // 3
    phase = np.arctan2(total[:count], total[count : 2 * count])
    variance: NDArray = np.mean(
        [(SCALE_TO_SIGMA * np.exp(answer[2 * count : 3 * count])) ** 2 for answer in answers],
        axis=0,
    )
    if len(answers) > 1:
        apart = [
            wrapped(np.arctan2(answer[:count], answer[count : 2 * count]) - phase)
            for answer in answers
        ]
        variance = variance + np.sum(np.square(apart), axis=0) / (len(answers) - 1)
    logit = (total[-1] / len(answers)).astype(np.float32)
    return Phases(phase.astype(np.float32), np.sqrt(variance).astype(np.float32)), logit


@dataclass(frozen=True)
class Fringes:
    """Networks for the carriers of a rig, the ``warp`` from its image to one that the networks
    know, and the ``limits`` of the object, `WIDE` or `EVEN`."""

    networks: Sequence[FringeNet]
    warp: Warp
    limits: tuple[float, float] = WIDE

    def answer(self, seen: Capture, grey: Image) -> tuple[Phases, Mask]:
        """Phases of the K carriers of ``grey`` (h, w), which was observed as ``seen``, and the
        object."""
        warp, background = self.warp, seen.background
        misfit = empty_scene_channel(background.residual, background.noise_grey, background.shown)
        image = grey
        if warp.needed:
            image, misfit = warp.image(grey), warp.image(misfit)
        scene = FringeScene.of(image, warp.period_px)
        phases, logit = phases_of(self.networks, channels(scene, misfit, background.shown))
        places = list(PLACES[len(warp.signs)])
        phase_rad, sigma_rad = phases.phase_rad[places], phases.sigma_rad[places]
        if warp.needed:
            phase_rad, logit, *sigmas = warp.back(phase_rad, [logit, *sigma_rad], grey.shape)
            sigma_rad = np.stack(sigmas)
        if seen.given:
            return Phases(phase_rad, sigma_rad), seen.inside
        least = np.where(seen.inside, *map(np.float32, self.limits))
        return Phases(phase_rad, sigma_rad), (logit > least) & ~seen.beyond


@dataclass(frozen=True)
class PairPart:
    """The parts of a route of two carriers: phases and object for the choice of the order
    (`before`), and the nearness of every pixel (`after`)."""

    fringes: Fringes

    def before(self, seen: CrossedObservation) -> CrossedObservation:
        """The observation with these phases and this object. What the networks call object is kept
        where the empty scene explains it as well."""
        phases, inside = self.fringes.answer(seen, seen.grey)
        points = phases.phase_rad[:, :: seen.stride, :: seen.stride]
        return replace(
            seen,
            inside=inside,
            given=True,
            phase_rad=phases.phase_rad,
            point_phase_rad=points,
            sigma_rad=phases.sigma_rad,
        )

    @staticmethod
    def after(fitted: Fitted) -> Fitted:
        """The nearness that they tell."""
        sigma_rad = fitted.seen.sigma_rad
        if sigma_rad is None:  # no object
            return fitted
        return replace(fitted, fit=_nearness_fit(fitted.seen, fitted.fit, sigma_rad))


@dataclass(frozen=True)
class LinePart:
    """The parts of a route of one carrier: the object for the choice of the order (`before`), which
    is that of the local fit (with the exact phase larger parts hang together, and all of a part is
    wrong where a texture misleads it), and then the phase (`after`)."""

    fringes: Fringes
    model: OneCarrier

    def before(self, seen: Observation) -> Observation:
        """The observation of this object."""
        phases, inside = self.fringes.answer(seen, seen.greys[0])
        sigma_rad = np.float32(EXPECTED_SHARE) * phases.sigma_rad[0]
        seen = self.model.with_object(seen, inside)
        return replace(seen, other_phase=(phases.phase_rad[0], sigma_rad))

    @staticmethod
    def after(chosen: FringeOrder) -> FringeOrder:
        """The order with this phase."""
        seen = chosen.seen
        if seen.other_phase is None:  # no object
            return chosen
        phase_rad, sigma_rad = seen.other_phase
        order = chosen.order + np.rint((seen.phase_rad - phase_rad) / TAU).astype(np.int32)
        residual_rad = seen.layer.residual_phase(phase_rad, order)
        moved = phase_rad + averaged(residual_rad, seen.inside, seen.period_px) - residual_rad
        phase_rad = wrapped(moved).astype(np.float32)
        order = order + np.rint((moved - phase_rad) / TAU).astype(np.int32)
        measured = replace(seen, phase_rad=phase_rad, uncertainty_rad=sigma_rad)
        return FringeOrder(measured, order, chosen.margin)


def averaged(phase_rad: NDArray, inside: Mask, period_px: float) -> Image:
    """Absolute phases float32 (h, w), in rad, those of pixels ``inside`` averaged over such pixels
    around whose phase is alike (`AVERAGE_PERIODS`, `AVERAGE_RAD`)."""
    far = float(phase_rad[inside].max(initial=0)) + 10 * AVERAGE_RAD
    known = np.where(inside, phase_rad, far).astype(np.float32)
    around = cv2.bilateralFilter(known, -1, AVERAGE_RAD, AVERAGE_PERIODS * period_px)
    return np.where(inside, around, phase_rad).astype(np.float32)


def _nearness_fit(seen: CrossedObservation, fit: NearnessFit, sigma_rad: Image) -> NearnessFit:
    """The nearness that the two phases of every pixel tell, in the orders of a ``fit``."""
    carriers = seen.carriers
    beside = wrapped(seen.phase_rad - carriers.phases(fit.nearness))
    nearness = fit.nearness + (carriers.gain * beside).sum(axis=0) / carriers.joint_gain**2
    unit_rad = float(np.median(carriers.joint_gain))
    nearness = averaged(nearness * unit_rad, seen.inside, seen.period_px) / unit_rad
    misfit = (
        seen.light - np.maximum(fit.brightness, 0) * fringes(carriers, nearness, seen.contrast)[0]
    )
    uncertainty = np.hypot(*(carriers.gain * sigma_rad)) / carriers.joint_gain
    return NearnessFit.of(nearness, fit.brightness, misfit, fit.weight, uncertainty)
