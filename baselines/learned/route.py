"""The learned route: a measured phase, the network's order, mask and bounded correction, the calibration layer's depth.

The network can't give any other depth.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.learned.inputs import LEAST_WEIGHT, STEPS, Geometry, Scene, channels
from fpp_ml_bench.baselines.learned.network import PhaseNet
from fpp_ml_bench.baselines.learned.odds import (
    Answers,
    Odds,
    answers_of_maps,
    decided_object,
    least_energy_order,
    margin_of,
    wrong_chance,
)
from fpp_ml_bench.baselines.phase.calibration_layer import TAU, Mask, wrapped
from fpp_ml_bench.baselines.phase.depth import FringeMeasurement
from fpp_ml_bench.baselines.phase.observe import Settings
from fpp_ml_bench.baselines.phase.resampling import Periods, stride_of
from fpp_ml_bench.optics.rig import Rig

OPEN_MARGIN = 1e-6
"""Least margin of an order that gets a depth where brightness can't tell it: a wrong one is less likely than not."""
EXPECTED_SHARE = float(np.sqrt(2 / np.pi))  # expected size of a normal error, in standard deviations
DENIED = 5.0  # a pixel of the measured route's mask stays object unless its logit is this far below the threshold


def network_answers(network: PhaseNet, scene: Scene, geometry: Geometry, lead: float = 0.0) -> Answers:
    """Run ``network`` on a scene; ``lead``: see `Answers.with_lead`."""
    turned = answers_of_maps(network, *channels(scene, geometry))
    back, sign = geometry.rotation.back, geometry.rotation.sign
    logits, inside, correction, sigma = (np.ascontiguousarray(back(maps)) for maps in vars(turned).values())
    logits = logits if sign > 0 else np.ascontiguousarray(logits[::-1])
    return Answers(logits, inside, correction * np.float32(sign), sigma).with_lead(lead)


def decided_mask(answers: Answers, scene: Scene, threshold: float) -> Mask:
    """`decided_object` pixels (h, w), where enough of the local fit's window lies on the object."""
    return decided_object(answers, scene.inside, scene.strength, threshold, DENIED) & (scene.weight > LEAST_WEIGHT)


def decided_order(answers: Answers, scene: Scene, inside: Mask, geometry: Geometry) -> NDArray[np.intp]:
    """Index of each pixel's candidate (h, w): `least_energy_order`."""
    base = geometry.layer.at(scene.crop).residual_phase(scene.phase_rad, scene.order)
    phases = np.stack([base + TAU * step for step in STEPS]).astype(np.float32)
    stride, jump_rad = stride_of(geometry.route.period_px), geometry.route.settings.jump_rad
    return least_energy_order(answers.logits, phases, inside, stride, jump_rad)


class NetworkRoute:
    """One rig, one fringe direction, one network; images whose fringe period is beyond ``periods`` are resampled. An
    image whose brightness nothing calibrates (`phase.EmptyScene`) is measured without the network: what it learnt
    of order and mask rests on the brightness of a lit background."""

    def __init__(
        self,
        rig: Rig,
        settings: Settings,
        network: PhaseNet,
        threshold: float = 0.0,
        lead: float = 0.0,
        odds: Odds | None = None,
        periods: Periods | None = None,
    ) -> None:
        self.geometry = Geometry.of(rig, settings, periods)
        self.network, self.threshold, self.lead, self.odds = network, threshold, lead, odds or Odds()

    def measure(self, image: NDArray[np.uint8]) -> FringeMeasurement:
        """Everything about one captured fringe uint8 (H, W). Raises `DecodeError` for another dtype or shape."""
        geometry, route = self.geometry, self.geometry.route
        seen = route.observe(image)
        base, margin = route.choose(seen)
        if not (seen.background.calibrated and seen.inside.any()):
            return route.conclude(seen, base, margin)
        scene = Scene.of(seen, base, geometry.shading)
        answers = network_answers(self.network, scene, geometry, self.lead)
        inside = decided_mask(answers, scene, self.threshold)
        choice = decided_order(answers, scene, inside, geometry)
        moved = seen.phase_rad + answers.correction_rad
        phase = wrapped(moved).astype(np.float32)
        order = base + np.array(STEPS, np.int32)[choice] + np.rint((moved - phase) / TAU).astype(np.int32)
        uncertainty = np.float32(EXPECTED_SHARE) * answers.sigma_rad
        seen = replace(seen, inside=inside, phase_rad=phase, uncertainty_rad=uncertainty)
        margin = margin_of(wrong_chance(answers.logits, choice, self.odds))
        return route.conclude(seen, order, margin, -np.inf if geometry.shading else OPEN_MARGIN)
