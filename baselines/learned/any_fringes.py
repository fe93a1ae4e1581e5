"""The answer of fringe-net's networks for any rig: the wrapped phases of one carrier or two and where
the object is, at the pixels of what a route observed, and what a route makes of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.learned.fringe_net import (
    CrossedPhases,
    FringeScene,
    Phases,
    fringe_channels,
    phases_of,
)
from fpp_ml_bench.baselines.learned.network import FringeNet
from fpp_ml_bench.baselines.learned.routes import EXPECTED_SHARE
from fpp_ml_bench.baselines.learned.warp import PLACES, Warp
from fpp_ml_bench.baselines.phase.depth import Fitted
from fpp_ml_bench.baselines.phase.geometry import Image, Mask
from fpp_ml_bench.baselines.phase.observe import Capture, CrossedObservation, Observation
from fpp_ml_bench.baselines.phase.order import FringeOrder
from fpp_ml_bench.constants import TAU

MISFIT_UNIT = 4.0
"""Of the channel of the empty scene's misfit, the arcsinh of its standard deviations over this."""


def empty_scene_channel(residual: Image, noise_grey: float, shown: bool) -> Image:
    """The misfit of the empty scene (h, w), 0 where no plane is ``shown``."""
    if not shown:
        return np.zeros_like(residual)
    return (np.arcsinh(residual / np.float32(noise_grey)) / MISFIT_UNIT).astype(np.float32)


@dataclass(frozen=True)
class AnyFringes:
    """Networks for the carriers of a rig. ``step_rad`` (K, 2): change of their phases per px along
    x and y; ``signs`` (K,): 1 where a phase grows with nearness; ``threshold`` on the logit of the
    mask."""

    step_rad: NDArray[np.float64]
    signs: NDArray[np.float64]
    networks: Sequence[FringeNet]
    threshold: float
    warp: Warp
    """From the image to one that the networks know."""

    @classmethod
    def of(
        cls,
        step_rad: NDArray[np.float64],
        signs: NDArray[np.float64],
        networks: Sequence[FringeNet],
        threshold: float = 0.0,
    ) -> "AnyFringes":
        """With the warp that the carriers need."""
        return cls(step_rad, signs, networks, threshold, Warp.to_periods(step_rad, signs))

    def answer(self, seen: Capture, grey: Image) -> tuple[Phases, Mask]:
        """Phases of the K carriers of ``grey`` (h, w), which was observed as ``seen``, and the
        object."""
        warp, background = self.warp, seen.background
        misfit = empty_scene_channel(background.residual, background.noise_grey, background.shown)
        image = grey
        if warp.needed:
            image, misfit = warp.image(grey), warp.image(misfit)
        whole = slice(0, image.shape[0]), slice(0, image.shape[1])
        scene = FringeScene.of(image, warp.period_px, whole)
        shown = np.full_like(misfit, background.shown)
        x = np.concatenate([fringe_channels(scene), [misfit, shown]])
        phases, logit = phases_of(self.networks, x)
        places = list(PLACES[len(self.signs)])
        phase_rad, sigma_rad = phases.phase_rad[places], phases.sigma_rad[places]
        if warp.needed:
            phase_rad, logit, *sigmas = warp.back(phase_rad, [logit, *sigma_rad], grey.shape)
            sigma_rad = np.stack(sigmas)
        inside = seen.inside if seen.given else logit > self.threshold
        return Phases(phase_rad, sigma_rad), inside


@dataclass(frozen=True)
class AnyPair:
    """The parts of a route of two carriers: phases and object for the choice of the order
    (`before`), and the nearness of every pixel (`after`)."""

    fringes: AnyFringes

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
        """The nearness that the phases tell."""
        return CrossedPhases.after(fitted)


@dataclass(frozen=True)
class AnyLine:
    """The parts of a route of one carrier: the object for the choice of the order (`before`), which
    is that of the local fit, and then the phase (`after`)."""

    fringes: AnyFringes

    def before(self, seen: Observation) -> Observation:
        """The observation of this object."""
        phases, inside = self.fringes.answer(seen, seen.greys[0])
        sigma_rad = np.float32(EXPECTED_SHARE) * phases.sigma_rad[0]
        return replace(seen, inside=inside, other_phase=(phases.phase_rad[0], sigma_rad))

    @staticmethod
    def after(chosen: FringeOrder) -> FringeOrder:
        """The order with this phase."""
        seen = chosen.seen
        if seen.other_phase is None:  # no object
            return chosen
        phase_rad, sigma_rad = seen.other_phase
        order = chosen.order + np.rint((seen.phase_rad - phase_rad) / TAU).astype(np.int32)
        measured = replace(seen, phase_rad=phase_rad, uncertainty_rad=sigma_rad)
        return FringeOrder(measured, order, chosen.margin)
