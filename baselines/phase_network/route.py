"""The learned route: a measured phase, the network's order, mask and correction, and the calibration layer's depth.

The network can't put a pixel anywhere else: the order is one of the candidates, the correction is bounded, and depth is
what the calibration layer makes of both.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_network.decide import Answers, ask, decided_mask
from fpp_ml_bench.baselines.phase_network.inputs import STEPS, Image, Scene
from fpp_ml_bench.baselines.phase_network.network import PhaseNet
from fpp_ml_bench.baselines.phase_network.samples import Geometry, first_order
from fpp_ml_bench.baselines.phase_route.calibration_layer import TAU
from fpp_ml_bench.baselines.phase_route.confidence import MARGIN_SCALE
from fpp_ml_bench.baselines.phase_route.labels import LARGE, least_energy
from fpp_ml_bench.baselines.phase_route.measurement import Measurement
from fpp_ml_bench.baselines.phase_route.observation import Observation
from fpp_ml_bench.baselines.phase_route.orders import spread_over_pixels
from fpp_ml_bench.baselines.phase_route.settings import Settings
from fpp_ml_bench.baselines.phase_route.shading import wrapped
from fpp_ml_bench.rig import Rig

LEAST_ODDS = 1e-6
"""Chance of a wrong order below which a network's word is not taken."""
CORRECTED_SHARE = 0.3
"""Of a correction that counts as uncertainty of the phase."""


@dataclass(frozen=True)
class Levers:
    """What the network decides; False: the measured route's own answer stays.

    ``order``, ``mask``, ``phase``; ``shading``: whether it sees brightness, and the first order may use it; ``graph``:
    weight of smoothness between neighbours in a least-energy labelling of its orders (depth may jump), 0: each pixel's
    likeliest;
    ``bound_rad``: corrections are cut off there, None: the network's own bound.
    """

    order: bool = True
    mask: bool = True
    phase: bool = True
    shading: bool = True
    graph: float = 3.0
    bound_rad: float | None = None


@dataclass(frozen=True)
class Asked:
    """One image half way: what was ``seen``, the measured route's own order, the ``base``, and its ``margin``, and the
    network's ``answers`` about the ``scene``; None where there is no object."""

    seen: Observation
    base: NDArray[np.int32]
    margin: Image
    scene: Scene | None
    answers: Answers | None


class NetworkRoute:
    """One rig, one fringe direction, one network."""

    def __init__(
        self,
        rig: Rig,
        settings: Settings,
        network: PhaseNet,
        threshold: float = 0.0,
        levers: Levers | None = None,
        lead: float = 0.0,
    ) -> None:
        self.levers = levers or Levers()
        self.geometry = Geometry.of(rig, replace(settings, shading=self.levers.shading))
        self.network, self.threshold, self.lead = network, threshold, lead

    def measure(self, image: NDArray[np.uint8]) -> Measurement:
        """Everything about one captured fringe uint8 (H, W). Raises `DecodeError` for another dtype or shape."""
        return self.conclude(self.observe(image))

    def observe(self, image: NDArray[np.uint8]) -> Asked:
        """What the measured route saw of ``image``, and what the network says to it."""
        geometry = self.geometry
        seen = geometry.route.observe(image)
        base, margin = first_order(seen, geometry.rig, geometry.route.settings)
        seen.watch.done("order")
        if seen.empty:
            return Asked(seen, base, margin, None, None)
        scene = Scene.of(seen, base, geometry.rig)
        answers = ask(self.network, scene, geometry, self.levers.shading, self.lead)
        seen.watch.done("network")
        return Asked(seen, base, margin, scene, answers)

    def conclude(self, asked: Asked, levers: Levers | None = None) -> Measurement:
        """The measurement that the network's answers make, as far as ``levers`` (default: the route's) let them."""
        levers, route, seen = levers or self.levers, self.geometry.route, asked.seen
        order, margin, scene, answers = asked.base, asked.margin, asked.scene, asked.answers
        if scene is None or answers is None:
            return route.conclude(seen, order, margin)
        inside = decided_mask(answers, scene, self.threshold) if levers.mask else seen.inside
        if levers.order:
            order, margin = self._order(answers, scene, inside, seen, levers.graph)
        phase, correction = seen.phase_rad, np.zeros_like(seen.phase_rad)
        if levers.phase:
            correction = answers.correction_rad
            if levers.bound_rad is not None:
                correction = np.clip(correction, -levers.bound_rad, levers.bound_rad)
            moved = seen.phase_rad + correction
            phase = wrapped(moved).astype(np.float32)
            order = order + np.rint((moved - phase) / TAU).astype(np.int32)
        uncertainty = (seen.uncertainty_rad + CORRECTED_SHARE * np.abs(correction)).astype(np.float32)
        return route.conclude(replace(seen, inside=inside, phase_rad=phase, uncertainty_rad=uncertainty), order, margin)

    def _order(
        self, answers: Answers, scene: Scene, inside: NDArray[np.bool_], seen: Observation, graph: float
    ) -> tuple[NDArray[np.int32], Image]:
        """Order of every pixel, and its margin: the one whose chance of being wrong is what the network gives it."""
        odds = np.exp(answers.logits - answers.logits.max(axis=0))
        odds /= odds.sum(axis=0)
        place = answers.logits.argmax(axis=0)
        if graph > 0:
            place = self._labelled(odds, scene, inside, seen, graph)
        chance = np.clip(np.take_along_axis(odds, place[None].astype(np.intp), axis=0)[0], LEAST_ODDS, 1 - LEAST_ODDS)
        margin = np.float32(MARGIN_SCALE) * np.log(chance / (1 - chance))
        return scene.order + np.array(STEPS, np.int32)[place], np.maximum(margin, 0).astype(np.float32)

    def _labelled(
        self, odds: NDArray, scene: Scene, inside: NDArray[np.bool_], seen: Observation, graph: float
    ) -> NDArray[np.intp]:
        """Places of the orders of least energy, on a grid of every few pixels, brought to the pixels."""
        stride = seen.question.stride
        every = (slice(None, None, stride), slice(None, None, stride))
        weight = inside.astype(np.float32)
        size = (stride, stride)
        share = cv2.blur(weight, size)
        cost = np.stack([cv2.blur((-np.log(one + 1e-9) * weight).astype(np.float32), size) for one in odds])
        cost = (cost / np.maximum(share, 1e-3))[:, *every] * np.float32(stride**2)
        here = inside[every]
        zero = seen.layer.residual_phase(seen.phase_rad, 0.0)
        coarse = (zero + TAU * scene.order)[every]
        phases = np.stack([coarse + TAU * step for step in STEPS]).astype(np.float32)
        links = [
            (a & b).astype(np.float32) * np.float32(graph * stride)
            for a, b in ((here[:, 1:], here[:, :-1]), (here[1:], here[:-1]))
        ]
        cost = np.where(here, np.minimum(cost, LARGE), 0).astype(np.float32)
        choice, margin = least_energy(cost, phases, links[0], links[1], self.geometry.route.settings.jump_rad)
        question = replace(seen.question, residual_rad=phases, inside=here)
        order, _ = spread_over_pixels(question, choice, margin, zero)
        wanted = np.clip(order - scene.order, -1, 1) + 1
        possible = np.take_along_axis(odds, wanted[None], axis=0)[0] > 0
        return np.where(possible, wanted, odds.argmax(axis=0))
