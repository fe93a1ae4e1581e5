"""The learned route: a measured phase, the network's order, mask and correction, and the calibration layer's depth.

The network can't give any other depth: the order is one of the candidates, the correction is bounded, and the
calibration layer computes depth from both.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_network.decide import Answers, decided_mask, network_answers
from fpp_ml_bench.baselines.phase_network.inputs import STEPS, Image, Scene
from fpp_ml_bench.baselines.phase_network.network import PhaseNet
from fpp_ml_bench.baselines.phase_network.samples import Geometry, first_order
from fpp_ml_bench.baselines.phase_route import (
    LARGE,
    MARGIN_SCALE,
    TAU,
    Measurement,
    Observation,
    Settings,
    least_energy,
    spread_over_pixels,
    wrapped,
)
from fpp_ml_bench.optics import Rig

LEAST_ODDS = 1e-6
"""Least probability of a wrong order, whatever the network answers."""
CORRECTED_SHARE = 0.3
"""Share of a correction that counts as uncertainty of the phase."""


@dataclass(frozen=True)
class Levers:
    """Which of the network's answers are used; False: the measured route's own value stays.

    ``order``, ``mask``, ``phase``; ``shading``: whether network and base order use brightness; ``graph``: weight of
    smoothness between neighbours in a least-energy labelling of the orders (depth may jump), 0: the most likely order
    of each pixel alone; ``bound_rad``: corrections are clipped there, None: the network's own bound.
    """

    order: bool = True
    mask: bool = True
    phase: bool = True
    shading: bool = True
    graph: float = 3.0
    bound_rad: float | None = None


@dataclass(frozen=True)
class AnsweredObservation:
    """The measured route's ``observation`` of an image, its order (``base``) and that order's ``margin``, and the
    network's ``answers`` for the ``scene``; both are None for an image without an object."""

    observation: Observation
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

    def observe(self, image: NDArray[np.uint8]) -> AnsweredObservation:
        """The measured route's observation of ``image``, and the network's answers."""
        geometry = self.geometry
        observation = geometry.route.observe(image)
        base, margin = first_order(observation, geometry.rig, geometry.route.settings)
        observation.watch.done("order")
        if observation.empty:
            return AnsweredObservation(observation, base, margin, None, None)
        scene = Scene.of(observation, base, geometry.rig)
        answers = network_answers(self.network, scene, geometry, self.levers.shading, self.lead)
        observation.watch.done("network")
        return AnsweredObservation(observation, base, margin, scene, answers)

    def conclude(self, answered: AnsweredObservation, levers: Levers | None = None) -> Measurement:
        """The measurement from the network's answers, as far as ``levers`` (default: the route's) use them."""
        levers, route, observation = levers or self.levers, self.geometry.route, answered.observation
        order, margin, scene, answers = answered.base, answered.margin, answered.scene, answered.answers
        if scene is None or answers is None:
            return route.conclude(observation, order, margin)
        inside = decided_mask(answers, scene, self.threshold) if levers.mask else observation.inside
        if levers.order:
            order, margin = self._order(answers, scene, inside, observation, levers.graph)
        phase, correction = observation.phase_rad, np.zeros_like(observation.phase_rad)
        if levers.phase:
            correction = answers.correction_rad
            if levers.bound_rad is not None:
                correction = np.clip(correction, -levers.bound_rad, levers.bound_rad)
            moved = observation.phase_rad + correction
            phase = wrapped(moved).astype(np.float32)
            order = order + np.rint((moved - phase) / TAU).astype(np.int32)
        uncertainty = (observation.uncertainty_rad + CORRECTED_SHARE * np.abs(correction)).astype(np.float32)
        return route.conclude(
            replace(observation, inside=inside, phase_rad=phase, uncertainty_rad=uncertainty), order, margin
        )

    def _order(
        self, answers: Answers, scene: Scene, inside: NDArray[np.bool_], observation: Observation, graph: float
    ) -> tuple[NDArray[np.int32], Image]:
        """Order of every pixel, and its margin, from the network's probability that the order is wrong."""
        probabilities = np.exp(answers.logits - answers.logits.max(axis=0))
        probabilities /= probabilities.sum(axis=0)
        candidate = answers.logits.argmax(axis=0)
        if graph > 0:
            candidate = self._labelled(probabilities, scene, inside, observation, graph)
        probability = np.clip(
            np.take_along_axis(probabilities, candidate[None].astype(np.intp), axis=0)[0], LEAST_ODDS, 1 - LEAST_ODDS
        )
        margin = np.float32(MARGIN_SCALE) * np.log(probability / (1 - probability))
        return scene.order + np.array(STEPS, np.int32)[candidate], np.maximum(margin, 0).astype(np.float32)

    def _labelled(
        self, probabilities: NDArray, scene: Scene, inside: NDArray[np.bool_], observation: Observation, graph: float
    ) -> NDArray[np.intp]:
        """Index of each pixel's order, by least energy on a grid of every few pixels."""
        stride = observation.question.stride
        grid = (slice(None, None, stride), slice(None, None, stride))
        weight = inside.astype(np.float32)
        size = (stride, stride)
        share = cv2.blur(weight, size)
        cost = np.stack(
            [cv2.blur((-np.log(probability + 1e-9) * weight).astype(np.float32), size) for probability in probabilities]
        )
        cost = (cost / np.maximum(share, 1e-3))[:, *grid] * np.float32(stride**2)
        grid_inside = inside[grid]
        residual_at_zero = observation.layer.residual_phase(observation.phase_rad, 0.0)
        coarse = (residual_at_zero + TAU * scene.order)[grid]
        phases = np.stack([coarse + TAU * step for step in STEPS]).astype(np.float32)
        links = [
            (a & b).astype(np.float32) * np.float32(graph * stride)
            for a, b in ((grid_inside[:, 1:], grid_inside[:, :-1]), (grid_inside[1:], grid_inside[:-1]))
        ]
        cost = np.where(grid_inside, np.minimum(cost, LARGE), 0).astype(np.float32)
        choice, margin = least_energy(cost, phases, links[0], links[1], self.geometry.route.settings.jump_rad)
        question = replace(observation.question, residual_rad=phases, inside=grid_inside)
        order, _ = spread_over_pixels(question, choice, margin, residual_at_zero)
        candidate = np.clip(order - scene.order, -1, 1) + 1
        possible = np.take_along_axis(probabilities, candidate[None], axis=0)[0] > 0
        return np.where(possible, candidate, probabilities.argmax(axis=0))
