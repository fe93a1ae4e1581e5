"""The learned parts of a phase route: the network's order, mask, bounded correction and its scale
for a measured phase or two. The network can't give any other depth. And the filter of a decoded
depth: what it sees, maps without a distance, a direction or a grey level, and the depth that
follows from its answers."""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.learned.inputs import (
    STEPS,
    CroppedMaps,
    CrossedScene,
    Geometry,
    PhaseScene,
    crossed_channels,
    phase_channels,
)
from fpp_ml_bench.baselines.learned.network import DepthFilter, PhaseNet
from fpp_ml_bench.baselines.learned.odds import (
    LEAST_CHANCE,
    SCALE_TO_SIGMA,
    Answers,
    Odds,
    answers_of_maps,
    decided_mask,
    least_energy_order,
    margin_of,
    probabilities,
    threshold_at,
    wrong_chance,
)
from fpp_ml_bench.baselines.phase.candidates import chosen_values
from fpp_ml_bench.baselines.phase.depth import Fitted
from fpp_ml_bench.baselines.phase.geometry import (
    TAU,
    Carriers,
    Image,
    Mask,
    nearest_inside,
    stride_of,
    wrapped,
)
from fpp_ml_bench.baselines.phase.object_mask import gaps
from fpp_ml_bench.baselines.phase.order import FringeOrder

OPEN_MARGIN = 1e-6
"""Least margin of an order that gets a depth where brightness can't tell it: a wrong one is less
likely than not."""
EXPECTED_SHARE = float(np.sqrt(2 / np.pi))
"""Expected size of a normal error, in standard deviations."""
CLEAR = 1.0
"""Logit of the mask from which on the network is believed where the background explains a pixel
better."""
PERHAPS = 4.0
"""A pixel whose logit is this far below the threshold still takes part in the labelling of
orders."""
STATED_FLOOR_RAD, STATED_SHARE, LEAST_STATED = 0.02, 0.8, 0.45
"""Of the network's scale as a sigma: what it states even where its error is a third of that, since
it learned in lights most of which are noisier; the share of the rest that is right; and the least
share of it that is stated. Chosen on validation views for the weights that come with the
package."""
DEPTH_CHANNELS = (
    "found",
    "against the mean of near neighbours",
    "against the mean of far neighbours",
    "sigma",
    "modulation",
    "slope",
    "spread",
)
NEAR_PX, FAR_PX = 1.0, 3.0
"""Standard deviations of the Gaussians over which neighbours are averaged."""
MARGIN_PX = 8  # of the crop around the found pixels
FURTHEST = 8.0  # sigmas at which a deviation is clipped
FAINT = 1e-6


def phase_answers(
    network: PhaseNet, scene: PhaseScene, geometry: Geometry, lead: float = 0.0
) -> Answers:
    """Run ``network`` on a scene; ``lead``: see `Answers.with_lead`."""
    turned = answers_of_maps(network, *phase_channels(scene, geometry))
    back, sign = geometry.rotation.back, geometry.rotation.sign
    logits, inside, correction, sigma = (
        np.ascontiguousarray(back(maps))
        for maps in (turned.logits, turned.object_logit, turned.correction_rad, turned.sigma_rad)
    )
    logits = logits if sign > 0 else np.ascontiguousarray(logits[::-1])
    return Answers(logits, inside, correction * np.float32(sign), sigma).with_lead(lead)


def decided_order(
    answers: Answers, scene: PhaseScene, inside: Mask, geometry: Geometry
) -> NDArray[np.intp]:
    """Index of each pixel's candidate (h, w): `least_energy_order`."""
    base = geometry.layer.at(scene.crop).residual_phase(scene.phase_rad, scene.order)
    phases = np.stack([base + TAU * step for step in STEPS]).astype(np.float32)
    return least_energy_order(answers.logits, phases, inside, stride_of(geometry.period_px))


@dataclass(frozen=True)
class PhaseNetPart:
    """What phase-net makes of the measured order of one fringe: mask, order, correction. An image
    whose brightness nothing calibrates (`phase.EmptyScene`) is left as it is: what the network
    learnt of order and mask rests on the brightness of a lit background."""

    geometry: Geometry
    network: PhaseNet
    threshold: float = 0.0
    lead: float = 0.0
    odds: Odds = field(default_factory=Odds)

    def __call__(self, chosen: FringeOrder) -> FringeOrder:
        seen, base = chosen.seen, chosen.order
        if not (seen.background.calibrated and seen.inside.any()):
            return chosen
        scene = PhaseScene.of(seen, base, self.geometry.shading)
        answers = phase_answers(self.network, scene, self.geometry, self.lead)
        inside = decided_mask(answers, scene, self.threshold)
        choice = decided_order(answers, scene, inside, self.geometry)
        moved = seen.phase_rad + answers.correction_rad
        phase = wrapped(moved).astype(np.float32)
        order = (
            base
            + np.array(STEPS, np.int32)[choice]
            + np.rint((moved - phase) / TAU).astype(np.int32)
        )
        uncertainty = np.float32(EXPECTED_SHARE) * answers.sigma_rad
        seen = replace(seen, inside=inside, phase_rad=phase, uncertainty_rad=uncertainty)
        margin = margin_of(wrong_chance(answers.logits, choice, self.odds))
        return FringeOrder(seen, order, margin, -np.inf if self.geometry.shading else OPEN_MARGIN)


def crossed_answers(
    network: PhaseNet, scene: CrossedScene, carriers: Carriers, lead: float = 0.0
) -> Answers:
    """Run ``network`` on a scene; ``lead``: see `Answers.with_lead`."""
    answers = answers_of_maps(network, *crossed_channels(scene, carriers))
    return replace(answers, sigma_rad=stated_rad(answers.sigma_rad)).with_lead(lead)


def stated_rad(sigma_rad: Image) -> Image:
    """Standard uncertainty in rad of the joint phase from that of the network's scale."""
    least = (np.float32(LEAST_STATED) * sigma_rad) ** 2
    rest = np.maximum(sigma_rad**2 - np.float32(STATED_FLOOR_RAD**2), least)
    return np.float32(STATED_SHARE) * np.sqrt(rest)  # type: ignore[no-any-return]


@dataclass(frozen=True)
class CrossedNetPart:
    """What crossed-net makes of the measured nearness of one crossed frame: mask, order,
    correction. ``threshold`` on the logit of the mask."""

    carriers: Carriers
    network: PhaseNet
    threshold: float
    lead: float

    def __call__(self, fitted: Fitted) -> Fitted:
        if not fitted.seen.inside.any():
            return fitted
        scene = CrossedScene.of(fitted)
        return self.answered(
            fitted, scene, crossed_answers(self.network, scene, self.carriers, self.lead)
        )

    def answered(self, fitted: Fitted, scene: CrossedScene, answers: Answers) -> Fitted:
        """What follows from the network's answers."""
        seen = fitted.seen
        joint, offers = seen.carriers.joint_gain, scene.offers_rad
        inside = decided_mask(answers, scene, self.threshold)
        if not seen.given:
            plane, _ = gaps(inside, seen.background, fitted.fit.misfit_grey)
            inside &= ~plane | (answers.object_logit > CLEAR)
        # Orders are labelled on all that may be object: a hole in the mask must not part a surface.
        perhaps = scene.inside | (
            answers.object_logit > threshold_at(scene.strength, self.threshold) - PERHAPS
        )
        psi = scene.nearness * joint
        candidates = np.stack([psi + scene.step_rad[0], psi, psi + scene.step_rad[1]])
        choice = least_energy_order(answers.logits, candidates, perhaps, seen.stride)
        nearness = scene.nearness + (chosen_values(offers, choice) + answers.correction_rad) / joint
        known = scene.known
        if not known[
            inside
        ].all():  # beyond the reach of any window: as the nearest pixel within it
            nearness = nearness[nearest_inside(known)]
        chances = probabilities(answers.logits)
        wrong = np.clip(1 - chosen_values(chances, choice), LEAST_CHANCE, 1).astype(np.float32)
        np.put_along_axis(chances, choice[None], -1, axis=0)
        rival = (scene.nearness + chosen_values(offers, chances.argmax(axis=0)) / joint).astype(
            np.float32
        )
        return replace(
            fitted,
            seen=replace(seen, inside=inside),
            fit=replace(
                fitted.fit, nearness=nearness.astype(np.float32), uncertainty_rad=answers.sigma_rad
            ),
            rival=rival,
            wrong_chance=wrong,
            wall=inside & (answers.object_logit < 0),  # likelier than the object
        )


@dataclass(frozen=True)
class DepthScene(CroppedMaps):
    """The part ``crop`` of a decoded view, float32 maps (h, w): ``depth_mm``, less its median
    ``middle_mm``, and ``sigma_mm``, both 0 where nothing is ``found``; ``modulation`` in grey
    levels, 0 where there is none. ``unit_mm``: median of sigma, and ``bright``: of the modulation,
    over the found pixels of the view."""

    depth_mm: Image
    sigma_mm: Image
    modulation: Image
    found: Mask
    middle_mm: float
    unit_mm: float
    bright: float

    @classmethod
    def of(cls, depth_mm: Image, sigma_mm: Image, modulation: Image) -> "DepthScene | None":
        """From maps (H, W), of which a depth of 0 is none; None where nothing was found."""
        found = (depth_mm > 0) & (sigma_mm > 0)
        if not found.any():
            return None
        crop = tuple(
            slice(max(int(places[0]) - MARGIN_PX, 0), int(places[-1]) + 1 + MARGIN_PX)
            for places in (np.flatnonzero(found.any(axis=1)), np.flatnonzero(found.any(axis=0)))
        )
        rows, columns = crop
        found = found[rows, columns]
        middle = float(np.median(depth_mm[rows, columns][found]))
        relative = np.where(found, depth_mm[rows, columns] - np.float32(middle), 0).astype(
            np.float32
        )
        sigma = np.where(found, sigma_mm[rows, columns], 0).astype(np.float32)
        light = np.nan_to_num(modulation[rows, columns]).astype(np.float32)
        unit, bright = (float(np.median(maps[found])) for maps in (sigma, light))
        return cls((rows, columns), relative, sigma, light, found, middle, unit, max(bright, FAINT))


def depth_channels(scene: DepthScene) -> NDArray[np.float32]:
    """Input of the network (`DEPTH_CHANNELS`, h, w) float32, the same for any orientation of the
    image."""
    found, depth, sigma = scene.found, scene.depth_mm, scene.sigma_mm
    weight = np.zeros_like(depth)
    np.divide(1.0, np.square(sigma), out=weight, where=found)
    typical = np.float32(scene.unit_mm)
    unit = np.where(found, sigma, typical)
    near, far = (_mean(depth, weight, px) for px in (NEAR_PX, FAR_PX))
    spread = np.sqrt(np.maximum(_mean(np.square(depth - near), weight, NEAR_PX), 0)) / unit
    across, down = (cv2.Sobel(near, cv2.CV_32F, *axes, scale=1 / 8) for axes in ((1, 0), (0, 1)))
    slope = np.hypot(across, down) / unit
    detail = [
        np.clip((depth - mean) / unit, -FURTHEST, FURTHEST) / 2 * found for mean in (near, far)
    ]
    relative = np.log(np.maximum(scene.modulation, FAINT) / np.float32(scene.bright))
    maps = (
        found,
        *detail,
        np.log(unit / typical),
        np.clip(relative, -3, 3),
        np.log1p(slope),
        np.log1p(spread),
    )
    return np.stack([np.asarray(one, dtype=np.float32) for one in maps])


def _mean(values: Image, weight: Image, px: float) -> Image:
    """Mean of ``values`` under a Gaussian of ``px`` and by ``weight``; 0 where there is no weight
    near."""
    total = cv2.GaussianBlur(values * weight, (0, 0), px)
    of_weight = cv2.GaussianBlur(weight, (0, 0), px)
    mean: Image = np.divide(total, of_weight, out=np.zeros_like(total), where=of_weight > 0)
    return mean


@dataclass(frozen=True)
class Filtered:
    """Maps (h, w) of a `DepthScene`: ``depth_mm``, less the scene's median; ``sigma_mm``, its
    standard uncertainty; ``object_logit``; ``near``: whether a neighbour has a depth."""

    depth_mm: Image
    sigma_mm: Image
    object_logit: Image
    near: Mask


def filtered(network: DepthFilter, scene: DepthScene) -> Filtered:
    """Run ``network`` on a scene."""
    depth, logit, scale, near = network.outputs(
        depth_channels(scene), scene.depth_mm, scene.sigma_mm, scene.found
    )
    return Filtered(depth, np.exp(scale) * np.float32(SCALE_TO_SIGMA * scene.unit_mm), logit, near)


def decided(answer: Filtered, scene: DepthScene, threshold: float) -> Mask:
    """Pixels that get a depth: those that had one, and those beside one whose logit is above
    ``threshold``."""
    return scene.found | (answer.near & (answer.object_logit > threshold))


def written(
    answer: Filtered, scene: DepthScene, inside: Mask, shape: tuple[int, int]
) -> tuple[Image, Image]:
    """Depth and its standard uncertainty in mm, float32 ``shape``, 0 outside ``inside``."""
    depth_mm, sigma_mm = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    depth_mm[scene.crop] = np.where(inside, answer.depth_mm + np.float32(scene.middle_mm), 0)
    sigma_mm[scene.crop] = np.where(inside, answer.sigma_mm, 0)
    return depth_mm, sigma_mm
