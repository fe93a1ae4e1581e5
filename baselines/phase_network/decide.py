"""From the network's answers to order, phase and mask of an image."""

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
"""A pixel of the measured route's mask stays object unless its logit is this far below the threshold."""


@dataclass(frozen=True)
class Answers:
    """The network's answers in the image's own orientation, maps (h, w) of the scene's crop.

    ``logits`` (3, h, w): of the base order minus one, the base order, and plus one; ``object_logit``;
    ``correction_rad``: to be added to the wrapped phase.
    """

    logits: Image
    object_logit: Image
    correction_rad: Image


def network_answers(
    network: PhaseNet, scene: Scene, geometry: Geometry, shading: bool = True, lead: float = 0.0
) -> Answers:
    """Run ``network`` on a scene.

    ``lead``: the base order's lead, added to its logit. Training windows get made-up wrong base orders (see `windows`),
    so the network holds the base order wrong more often than it is; the lead, chosen on the validation split, makes up
    for that."""
    settings, rotation = geometry.route.settings, geometry.rotation
    layer = geometry.layer.at(scene.crop)
    x, exists = channels(scene, layer, geometry.rig, rotation, geometry.route.period_px, settings.slack_mm)
    if not shading:
        x[list(SHADING)] = 0
    _, height, width = x.shape
    stride = network.stride
    padded = np.pad(x, ((0, 0), (0, -height % stride), (0, -width % stride)))
    with torch.inference_mode():
        batch = torch.from_numpy(padded)[None].contiguous(memory_format=torch.channels_last)
        order, inside, correction = (out[0, ..., :height, :width].numpy() for out in network(batch))
    order = np.where(exists, order + np.array([0, lead, 0], np.float32)[:, None, None], np.float32(IMPOSSIBLE))
    back = rotation.back
    signed = back(order) if rotation.sign > 0 else back(order)[::-1]
    return Answers(
        np.ascontiguousarray(signed), np.ascontiguousarray(back(inside)),
        np.ascontiguousarray(back(correction)) * np.float32(rotation.sign),
    )  # fmt: skip


def decided_order(answers: Answers, scene: Scene) -> NDArray[np.int32]:
    """The most likely order of every pixel, int32 (h, w)."""
    steps = np.array(STEPS, np.int32)
    return scene.order + steps[answers.logits.argmax(axis=0)]


def decided_mask(answers: Answers, scene: Scene, threshold: float) -> NDArray[np.bool_]:
    """Object pixels (h, w): those whose logit is above ``threshold``, and those of the measured route's mask whose
    logit is at most `DENIED` below it; only where enough of the local fit's window lies on the object."""
    logit = answers.object_logit
    is_object = (logit > threshold) | (scene.inside & (logit > threshold - DENIED))
    return is_object & (scene.weight > LEAST_WEIGHT)
