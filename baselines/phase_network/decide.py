"""From the network's answers to order, phase and mask of one image."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_network.inputs import LEAST_WEIGHT, SHADING, STEPS, Image, Scene, channels
from fpp_ml_bench.baselines.phase_network.network import PhaseNet
from fpp_ml_bench.baselines.phase_network.samples import Geometry

IMPOSSIBLE = -np.inf
"""Logit of an order that puts its pixel out of the working range."""

DENIED = 5.0
"""Logits below the threshold from which on a pixel of the measured route's mask is background after all."""


@dataclass(frozen=True)
class Answers:
    """The network's answers as the image has them, maps (h, w) of the scene's crop.

    ``logits`` (3, h, w): of one order less than the base's, the base, and one more; ``object_logit``;
    ``correction_rad``: to be added to the wrapped phase.
    """

    logits: Image
    object_logit: Image
    correction_rad: Image


def ask(network: PhaseNet, scene: Scene, geometry: Geometry, shading: bool = True, lead: float = 0.0) -> Answers:
    """Run ``network`` on one scene; ``lead`` is added to the logit of the base, because in training, where wrong orders
    are made up, it is wrong much more often than it is."""
    settings, rotation = geometry.route.settings, geometry.rotation
    layer = geometry.layer.at(scene.crop)
    x, exists = channels(scene, layer, geometry.rig, rotation, geometry.route.period_px, settings.slack_mm)
    if not shading:
        x[list(SHADING)] = 0
    _, height, width = x.shape
    stride = network.stride
    padded = np.pad(x, ((0, 0), (0, -height % stride), (0, -width % stride)))
    with torch.inference_mode():
        given = torch.from_numpy(padded)[None].contiguous(memory_format=torch.channels_last)
        order, inside, correction = (out[0, ..., :height, :width].numpy() for out in network(given))
    order = np.where(exists, order + np.array([0, lead, 0], np.float32)[:, None, None], np.float32(IMPOSSIBLE))
    back = rotation.back
    signed = back(order) if rotation.sign > 0 else back(order)[::-1]
    return Answers(
        np.ascontiguousarray(signed), np.ascontiguousarray(back(inside)),
        np.ascontiguousarray(back(correction)) * np.float32(rotation.sign),
    )  # fmt: skip


def decided_order(answers: Answers, scene: Scene) -> NDArray[np.int32]:
    """The likeliest order of every pixel, int32 (h, w)."""
    steps = np.array(STEPS, np.int32)
    return scene.order + steps[answers.logits.argmax(axis=0)]


def decided_mask(answers: Answers, scene: Scene, threshold: float) -> NDArray[np.bool_]:
    """Object: what the network holds likelier than ``threshold`` (a logit), and what the measured route's mask has and
    the network does not clearly deny; where the fit has something to stand on."""
    logit = answers.object_logit
    found = (logit > threshold) | (scene.inside & (logit > threshold - DENIED))
    return found & (scene.weight > LEAST_WEIGHT)
