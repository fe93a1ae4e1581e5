"""The learned route: a measured phase, the network's order, mask and bounded correction, the calibration layer's depth.

The network can't give any other depth.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines import phase_route
from fpp_ml_bench.baselines.phase_network.answers import (
    GRAPH,
    Answers,
    answers_of_maps,
    least_energy_order,
    probabilities,
    threshold_at,
)
from fpp_ml_bench.baselines.phase_network.inputs import LEAST_WEIGHT, STEPS, Geometry, Scene, channels
from fpp_ml_bench.baselines.phase_network.network import PhaseNet
from fpp_ml_bench.baselines.phase_network.odds import Odds, margin_of, wrong_chance
from fpp_ml_bench.baselines.phase_route import TAU, Image, Mask, Measurement, Observation, Settings, wrapped
from fpp_ml_bench.optics import Rig

OPEN_MARGIN = 1e-6
"""Least margin of an order that gets a depth where brightness can't tell it: a wrong one is less likely than not."""
EXPECTED_SHARE = float(np.sqrt(2 / np.pi))  # expected size of a normal error, in standard deviations
DENIED = 5.0  # a pixel of the measured route's mask stays object unless its logit is this far below the threshold


def network_answers(network: PhaseNet, scene: Scene, geometry: Geometry, shading: bool, lead: float = 0.0) -> Answers:
    """Run ``network`` on a scene; ``lead``: see `Answers.with_lead`."""
    turned = answers_of_maps(network, *channels(scene, geometry, shading))
    back, sign = geometry.rotation.back, geometry.rotation.sign
    logits, inside, correction, sigma = (np.ascontiguousarray(back(maps)) for maps in vars(turned).values())
    logits = logits if sign > 0 else np.ascontiguousarray(logits[::-1])
    return Answers(logits, inside, correction * np.float32(sign), sigma).with_lead(lead)


def decided_mask(answers: Answers, scene: Scene, threshold: float) -> Mask:
    """Object pixels (h, w): those whose logit is above the `threshold_at` the scene's strength, and those of the
    measured route's mask whose logit is at most `DENIED` below it; only where enough of the local fit's window lies on
    the object."""
    logit, threshold = answers.object_logit, threshold_at(scene.strength, threshold)
    is_object = (logit > threshold) | (scene.inside & (logit > threshold - DENIED))
    return is_object & (scene.weight > LEAST_WEIGHT)


@dataclass(frozen=True)
class Levers:
    """Which of the network's answers are used; False: the measured route's own value stays. ``order``, ``mask``,
    ``phase``; ``shading``: whether network and base order use brightness, as the network learned to; ``graph``: weight
    of smoothness between neighbours in a least-energy labelling of the orders (depth may jump), 0: the most likely
    order of each pixel alone; ``bound_rad``: corrections are clipped there, None: the network's own bound."""

    order: bool = True
    mask: bool = True
    phase: bool = True
    shading: bool = True
    graph: float = GRAPH
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
    """One rig, one fringe direction, one network; images whose fringe period is beyond ``periods`` are resampled. An
    image whose brightness nothing calibrates (`phase_route.EmptyScene`) is measured without the network: what it learnt
    of order and mask rests on the brightness of a lit background."""

    def __init__(
        self,
        rig: Rig,
        settings: Settings,
        network: PhaseNet,
        threshold: float = 0.0,
        levers: Levers | None = None,
        lead: float = 0.0,
        odds: Odds | None = None,
        periods: phase_route.Periods | None = None,
    ) -> None:
        self.levers = levers or Levers()
        self.geometry = Geometry.of(rig, replace(settings, shading=self.levers.shading), periods)
        self.network, self.threshold, self.lead, self.odds = network, threshold, lead, odds or Odds()

    def measure(self, image: NDArray[np.uint8]) -> Measurement:
        """Everything about one captured fringe uint8 (H, W). Raises `DecodeError` for another dtype or shape."""
        return self.conclude(self.observe(image))

    def observe(self, image: NDArray[np.uint8]) -> AnsweredObservation:
        """The measured route's observation of ``image``, and the network's answers."""
        geometry = self.geometry
        observation = geometry.route.observe(image)
        base, margin = geometry.route.choose(observation)
        observation.watch.done("order")
        scene = answers = None
        if observation.background.calibrated and observation.inside.any():
            scene = Scene.of(observation, base, self.levers.shading)
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
        uncertainty = np.float32(EXPECTED_SHARE) * answers.sigma_rad if levers.phase else observation.uncertainty_rad
        seen = replace(observation, inside=inside, phase_rad=phase, uncertainty_rad=uncertainty)
        least_margin = OPEN_MARGIN if levers.order and not levers.shading else -np.inf
        return route.conclude(seen, order, margin, least_margin)

    def _order(
        self, answers: Answers, scene: Scene, inside: Mask, observation: Observation, graph: float
    ) -> tuple[NDArray[np.int32], Image]:
        """Order of every pixel, and its margin, from the network's probability that the order is wrong."""
        choice = decided_order(answers, scene, inside, self.geometry, graph)
        margin = margin_of(wrong_chance(answers.logits, choice, self.odds))
        return scene.order + np.array(STEPS, np.int32)[choice], margin


def decided_order(
    answers: Answers, scene: Scene, inside: Mask, geometry: Geometry, graph: float = GRAPH
) -> NDArray[np.intp]:
    """Index of each pixel's candidate (h, w): the likeliest for a ``graph`` of 0, else `least_energy_order`."""
    if graph <= 0:
        return answers.logits.argmax(axis=0)
    base = geometry.layer.at(scene.crop).residual_phase(scene.phase_rad, scene.order)
    phases = np.stack([base + TAU * step for step in STEPS]).astype(np.float32)
    stride = phase_route.stride_of(geometry.route.period_px)
    jump_rad = geometry.route.settings.jump_rad
    return least_energy_order(probabilities(answers.logits), phases, inside, stride, jump_rad, graph)
