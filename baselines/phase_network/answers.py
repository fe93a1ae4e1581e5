"""A `PhaseNet`'s answers for one image, its order by least energy, and how likely that order is wrong."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_network.network import PhaseNet
from fpp_ml_bench.baselines.phase_route import (
    LARGE,
    Image,
    Mask,
    least_energy,
    links_between,
    nearest_inside,
    of_choice,
    repeated,
)

GRAPH = 3.0  # weight of smoothness between neighbours in the labelling of the orders
SCALE_TO_SIGMA = float(np.sqrt(2))  # of a Laplace distribution
WEAK, STRONG = 10.0, 40.0
"""Strengths, an object's median modulation in sigmas of the noise, from which on its mask's threshold is `SPREAD` below
or above the network's."""
SPREAD = 1.5


@dataclass(frozen=True)
class Answers:
    """Maps (h, w) of the scene's crop, in the image's own orientation. ``logits`` (3, h, w): of the candidate a period
    further, the base, and the candidate a period nearer, -inf where there is none; ``object_logit``;
    ``correction_rad``: to be added to the phase; ``sigma_rad``: standard uncertainty of the corrected phase."""

    logits: Image
    object_logit: Image
    correction_rad: Image
    sigma_rad: Image

    def with_lead(self, lead: float) -> "Answers":
        """The same with ``lead`` added to the base's logit. Training makes up wrong base orders, so the network holds
        the base wrong more often than it is; the lead, chosen on the validation views, makes up for that."""
        return replace(self, logits=self.logits + np.array([0, lead, 0], np.float32)[:, None, None])


def threshold_at(strength: float, threshold: float) -> float:
    """The threshold of the mask's logit in a scene: ``threshold`` at a strength of 20. In a weak frame the network is
    less sure of everything, and a missed pixel costs more than an invented one."""
    place = np.log(max(strength, 1e-3) / WEAK) / np.log(STRONG / WEAK)
    return threshold + SPREAD * float(np.clip(2 * place - 1, -1, 1))


def probabilities(logits: Image) -> Image:
    """Of the three candidates, (3, ...), from their logits (3, ...)."""
    chances = np.exp(logits - logits.max(axis=0))
    return chances / chances.sum(axis=0)  # type: ignore[no-any-return]


def answers_of_maps(network: PhaseNet, x: Image, exists: Mask) -> Answers:
    """The answers of a network that states its uncertainty, for its input ``x`` (C, h, w); ``exists`` bool (3, h, w):
    the candidates that there are, at least one a pixel."""
    _, height, width = x.shape
    padded = np.pad(x, ((0, 0), (0, -height % network.stride), (0, -width % network.stride)))
    with torch.inference_mode():
        batch = torch.from_numpy(padded)[None].contiguous(memory_format=torch.channels_last)
        order, inside, correction, scale = (out[0, ..., :height, :width].numpy() for out in network(batch))
    logits = np.where(exists, order, np.float32(-np.inf))
    return Answers(logits, inside, correction, np.float32(SCALE_TO_SIGMA) * np.exp(scale))


def least_energy_order(
    chances: Image, phases_rad: Image, inside: Mask, stride: int, jump_rad: float, graph: float = GRAPH
) -> NDArray[np.intp]:
    """Index of each pixel's candidate (h, w) by least energy on a grid of every ``stride``-th pixel. ``chances``
    (3, h, w): probabilities, 0 where there is no candidate; ``phases_rad`` (3, h, w): what neighbours are compared by;
    ``jump_rad``: a jump between neighbours from which on it costs no more. A pixel takes the candidate nearest to what
    its grid point chose, or the nearest grid point that lies ``inside``."""
    weight, size, grid = inside.astype(np.float32), (stride, stride), slice(None, None, stride)
    cost = np.stack([cv2.blur((-np.log(p + 1e-9) * weight).astype(np.float32), size) for p in chances])
    cost = (cost / np.maximum(cv2.blur(weight, size), 1e-3))[:, grid, grid] * np.float32(stride**2)
    points, phases = inside[grid, grid], phases_rad[:, grid, grid].astype(np.float32)
    link_x, link_y = (link * np.float32(graph * stride) for link in links_between(points))
    cost = np.where(points, np.minimum(cost, LARGE), 0).astype(np.float32)
    choice, _ = least_energy(cost, phases, link_x, link_y, jump_rad)
    chosen_rad = of_choice(phases, choice)
    chosen_rad = chosen_rad[nearest_inside(points)]
    apart = np.abs(phases_rad - repeated(chosen_rad, stride, inside.shape))
    return np.where(chances > 0, apart, np.inf).argmin(axis=0)
