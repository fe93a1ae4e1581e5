"""The learned route: a measured phase, the network's order, mask and bounded correction, the calibration layer's depth.

The network can't give any other depth.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fpp_ml_bench.baselines import phase_route
from fpp_ml_bench.baselines.phase_network.inputs import LEAST_WEIGHT, STEPS, Geometry, Scene, channels
from fpp_ml_bench.baselines.phase_network.network import PhaseNet
from fpp_ml_bench.baselines.phase_route import TAU, Image, Mask, Measurement, Observation, Settings, of_choice, wrapped
from fpp_ml_bench.optics import Rig

LEAST_ODDS = 1e-6  # least probability of a wrong order, whatever the network answers
CORRECTED_SHARE = 0.3  # share of a correction that counts as uncertainty of the phase
IMPOSSIBLE = -np.inf  # logit of an order that puts its pixel out of the working range
DENIED = 5.0  # a pixel of the measured route's mask stays object unless its logit is this far below the threshold


@dataclass(frozen=True)
class Answers:
    """The network's answers in the image's own orientation, maps (h, w) of the scene's crop; ``logits`` (3, h, w): of
    the base order minus one, the base order, and plus one; ``correction_rad``: to be added to the wrapped phase."""

    logits: Image
    object_logit: Image
    correction_rad: Image


def network_answers(
    network: PhaseNet, scene: Scene, geometry: Geometry, shading: bool = True, lead: float = 0.0
) -> Answers:
    """Run ``network`` on a scene. ``lead`` is added to the base order's logit. Training windows get made-up wrong base
    orders (see `windows`), so the network holds the base order wrong more often than it is; the lead, chosen on the
    validation split, makes up for that."""
    x, exists = channels(scene, geometry, shading)
    _, height, width = x.shape
    padded = np.pad(x, ((0, 0), (0, -height % network.stride), (0, -width % network.stride)))
    with torch.inference_mode():
        batch = torch.from_numpy(padded)[None].contiguous(memory_format=torch.channels_last)
        order, inside, correction = (out[0, ..., :height, :width].numpy() for out in network(batch))
    order = np.where(exists, order, np.float32(IMPOSSIBLE))
    sign = geometry.rotation.sign
    order, inside, correction = (np.ascontiguousarray(geometry.rotation.back(m)) for m in (order, inside, correction))
    order = order if sign > 0 else np.ascontiguousarray(order[::-1])
    return with_lead(Answers(order, inside, correction * np.float32(sign)), lead)


def with_lead(answers: Answers, lead: float) -> Answers:
    """``answers`` with ``lead`` added to the base order's logit."""
    return replace(answers, logits=answers.logits + np.array([0, lead, 0], np.float32)[:, None, None])


def decided_mask(answers: Answers, scene: Scene, threshold: float) -> Mask:
    """Object pixels (h, w): those whose logit is above ``threshold``, and those of the measured route's mask whose
    logit is at most `DENIED` below it; only where enough of the local fit's window lies on the object."""
    logit = answers.object_logit
    is_object = (logit > threshold) | (scene.inside & (logit > threshold - DENIED))
    return is_object & (scene.weight > LEAST_WEIGHT)


@dataclass(frozen=True)
class Levers:
    """Which of the network's answers are used; False: the measured route's own value stays. ``order``, ``mask``,
    ``phase``; ``shading``: whether network and base order use brightness; ``graph``: weight of smoothness between
    neighbours in a least-energy labelling of the orders (depth may jump), 0: the most likely order of each pixel alone;
    ``bound_rad``: corrections are clipped there, None: the network's own bound."""

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
    """One rig, one fringe direction, one network; images whose fringe period is beyond ``periods`` are resampled. An
    image whose brightness nothing calibrates (`phase_route.EmptyScene`) is measured without the network: what it learnt
    of order and mask rests on the brightness of a lit background."""

    def __init__(
        self, rig: Rig, settings: Settings, network: PhaseNet, threshold: float = 0.0, levers: Levers | None = None,
        lead: float = 0.0, periods: phase_route.Periods | None = None,
    ) -> None:  # fmt: skip
        self.levers = levers or Levers()
        self.geometry = Geometry.of(rig, replace(settings, shading=self.levers.shading), periods)
        self.network, self.threshold, self.lead = network, threshold, lead

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
            scene = Scene.of(observation, base)
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
        seen = replace(observation, inside=inside, phase_rad=phase, uncertainty_rad=uncertainty)
        return route.conclude(seen, order, margin)

    def _order(
        self, answers: Answers, scene: Scene, inside: Mask, observation: Observation, graph: float
    ) -> tuple[NDArray[np.int32], Image]:
        """Order of every pixel, and its margin, from the network's probability that the order is wrong."""
        probabilities = np.exp(answers.logits - answers.logits.max(axis=0))
        probabilities /= probabilities.sum(axis=0)
        candidate = answers.logits.argmax(axis=0)
        if graph > 0:
            candidate = self._labelled(probabilities, scene, inside, observation, graph)
        probability = np.clip(of_choice(probabilities, candidate), LEAST_ODDS, 1 - LEAST_ODDS)
        margin = np.float32(phase_route.MARGIN_SCALE) * np.log(probability / (1 - probability))
        return scene.order + np.array(STEPS, np.int32)[candidate], np.maximum(margin, 0).astype(np.float32)

    def _labelled(
        self, probabilities: NDArray, scene: Scene, inside: Mask, observation: Observation, graph: float
    ) -> NDArray[np.intp]:
        """Index of each pixel's order, by least energy on a grid of every few pixels."""
        stride = phase_route.stride_of(observation.period_px)
        grid, size = phase_route.grid_of(stride), (stride, stride)
        weight = inside.astype(np.float32)
        cost = np.stack([cv2.blur((-np.log(p + 1e-9) * weight).astype(np.float32), size) for p in probabilities])
        cost = (cost / np.maximum(cv2.blur(weight, size), 1e-3))[:, *grid] * np.float32(stride**2)
        grid_inside = inside[grid]
        coarse = (observation.layer.residual_phase(observation.phase_rad, 0.0) + TAU * scene.order)[grid]
        phases = np.stack([coarse + TAU * step for step in STEPS]).astype(np.float32)
        link_x, link_y = (link * np.float32(graph * stride) for link in phase_route.links_between(grid_inside))
        cost = np.where(grid_inside, np.minimum(cost, phase_route.LARGE), 0).astype(np.float32)
        choice, margin = phase_route.least_energy(cost, phases, link_x, link_y, self.geometry.route.settings.jump_rad)
        order, _ = phase_route.spread_over_pixels(observation, of_choice(phases, choice), margin, grid_inside)
        candidate = np.clip(order - scene.order, -1, 1) + 1
        return np.where(of_choice(probabilities, candidate) > 0, candidate, probabilities.argmax(axis=0))
