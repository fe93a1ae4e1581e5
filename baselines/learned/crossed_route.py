"""The learned crossed route: measured candidates, the network's order, mask, bounded correction and its scale."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.learned.crossed_inputs import LEAST_SHARE, Scene, channels
from fpp_ml_bench.baselines.learned.network import PhaseNet
from fpp_ml_bench.baselines.learned.odds import (
    Answers,
    answers_of_maps,
    decided_object,
    least_energy_order,
    probabilities,
    threshold_at,
)
from fpp_ml_bench.baselines.phase.calibration_layer import Carriers, Image, Mask
from fpp_ml_bench.baselines.phase.candidates import chosen_values
from fpp_ml_bench.baselines.phase.depth import CrossedRoute, Fitted, Measurement
from fpp_ml_bench.baselines.phase.observe import Settings
from fpp_ml_bench.baselines.phase.order import JUMP_RAD
from fpp_ml_bench.baselines.phase.resampling import Periods, nearest_inside
from fpp_ml_bench.optics.rig import Rig

DENIED = 6.0  # a pixel of the measured mask stays object unless its logit is this far below the threshold
PERHAPS = 4.0  # a pixel whose logit is this far below the threshold still takes part in the labelling of orders
LEAST_CHANCE = 1e-6  # of a wrong order, whatever the network answers
STATED_FLOOR_RAD, STATED_SHARE, LEAST_STATED = 0.02, 0.8, 0.45
"""Of the network's scale as a sigma: what it states even where its error is a third of that, since it learned in lights
most of which are noisier; the share of the rest that is right; and the least share of it that is stated. Chosen on
validation views for the weights that come with the package."""


def network_answers(network: PhaseNet, scene: Scene, carriers: Carriers, lead: float = 0.0) -> Answers:
    """Run ``network`` on a scene; ``lead``: see `Answers.with_lead`."""
    answers = answers_of_maps(network, *channels(scene, carriers))
    return replace(answers, sigma_rad=stated_rad(answers.sigma_rad)).with_lead(lead)


def stated_rad(sigma_rad: Image) -> Image:
    """Standard uncertainty in rad of the joint phase from that of the network's scale."""
    least = (np.float32(LEAST_STATED) * sigma_rad) ** 2
    rest = np.maximum(sigma_rad**2 - np.float32(STATED_FLOOR_RAD**2), least)
    return np.float32(STATED_SHARE) * np.sqrt(rest)  # type: ignore[no-any-return]


def decided_mask(answers: Answers, scene: Scene, threshold: float) -> Mask:
    """`decided_object` pixels (h, w)."""
    return decided_object(answers, scene.inside, scene.strength, threshold, DENIED)


def offers_rad(scene: Scene) -> Image:
    """Joint phase of the candidates further, base and nearer less that of the base, (3, h, w)."""
    return np.stack([scene.step_rad[0], np.zeros_like(scene.step_rad[0]), scene.step_rad[1]])


class CrossedNetRoute:
    """One rig and network; ``threshold`` on the logit of the mask."""

    def __init__(
        self,
        rig: Rig,
        network: PhaseNet,
        threshold: float,
        lead: float,
        settings: Settings | None = None,
        periods: Periods | None = None,
    ) -> None:
        self.route = CrossedRoute(rig, settings, periods=periods)
        self.network, self.threshold, self.lead = network, threshold, lead

    def measure(self, image: NDArray) -> Measurement:
        """Everything about one crossed frame (H, W). Raises `DecodeError` for another dtype or shape."""
        seen = self.route.fitted(self.route.observe(image))
        if not seen.inside.any():
            return self.route.conclude(seen)
        scene = Scene.of(seen)
        answers = network_answers(self.network, scene, self.route.carriers, self.lead)
        return self.conclude(seen, scene, answers)

    def conclude(self, seen: Fitted, scene: Scene, answers: Answers) -> Measurement:
        """The measurement from the network's answers."""
        joint, offers = seen.carriers.joint_gain, offers_rad(scene)
        inside = decided_mask(answers, scene, self.threshold)
        # Orders are labelled on all that may be object: a hole in the mask must not part a surface.
        perhaps = scene.inside | (answers.object_logit > threshold_at(scene.strength, self.threshold) - PERHAPS)
        psi = scene.nearness * joint
        candidates = np.stack([psi + scene.step_rad[0], psi, psi + scene.step_rad[1]])
        choice = least_energy_order(answers.logits, candidates, perhaps, self.route.stride, JUMP_RAD)
        nearness = scene.nearness + (chosen_values(offers, choice) + answers.correction_rad) / joint
        known = scene.share > LEAST_SHARE
        if not known[inside].all():  # beyond the reach of any window: as the nearest pixel within it
            nearness = nearness[nearest_inside(known)]
        chances = probabilities(answers.logits)
        wrong = np.clip(1 - chosen_values(chances, choice), LEAST_CHANCE, 1)
        np.put_along_axis(chances, choice[None], -1, axis=0)
        rival = (scene.nearness + chosen_values(offers, chances.argmax(axis=0)) / joint).astype(np.float32)
        fit = replace(seen.fit, nearness=nearness.astype(np.float32), uncertainty_rad=answers.sigma_rad)
        return self.route.conclude(replace(seen, fit=fit, inside=inside, rival=rival), wrong.astype(np.float32))
