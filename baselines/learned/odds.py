"""The output of a `PhaseNet` for an image, the order of least energy, and the stated probability
that this order is wrong, which is calibrated on validation views."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.learned.inputs import CandidateScene
from fpp_ml_bench.baselines.learned.network import PhaseNet
from fpp_ml_bench.baselines.phase.candidates import chosen_values, links_between
from fpp_ml_bench.baselines.phase.depth import MARGIN_SCALE
from fpp_ml_bench.baselines.phase.geometry import Image, Mask, nearest_inside, repeated
from fpp_ml_bench.baselines.phase.labels import least_energy
from fpp_ml_bench.baselines.phase.order import JUMP_RAD, LARGE

GRAPH = 3.0
"""Weight of smoothness between neighbours in the labelling of the orders, in which depth may
jump."""
SCALE_TO_SIGMA = float(np.sqrt(2))  # of a Laplace distribution
WEAK, STRONG = 10.0, 40.0
"""Strengths, an object's median modulation in sigmas of the noise, from which on its mask's
threshold is `SPREAD` below or above the network's."""
SPREAD = 1.5


@dataclass(frozen=True)
class Answers:
    """Maps (h, w) of the scene's crop, in the image's own orientation. ``logits`` (3, h, w): of the
    candidate a period further, the base, and the candidate a period nearer, -inf where there is
    none; ``object_logit``; ``correction_rad``: to be added to the phase; ``sigma_rad``: standard
    uncertainty of the corrected phase."""

    logits: Image
    object_logit: Image
    correction_rad: Image
    sigma_rad: Image

    def with_lead(self, lead: float) -> "Answers":
        """The same with ``lead`` added to the base's logit. Training makes up wrong base orders, so
        the network holds the base wrong more often than it is; the lead, chosen on the validation
        views, makes up for that."""
        return replace(self, logits=self.logits + np.array([0, lead, 0], np.float32)[:, None, None])


def threshold_at(strength: float, threshold: float) -> float:
    """The threshold of the mask's logit in a scene: ``threshold`` at a strength of 20. In a weak
    frame the network is less sure of everything, and a missed pixel costs more than an invented
    one."""
    place = np.log(max(strength, 1e-3) / WEAK) / np.log(STRONG / WEAK)
    return threshold + SPREAD * float(np.clip(2 * place - 1, -1, 1))


def decided_mask(answers: Answers, scene: CandidateScene, threshold: float) -> Mask:
    """Object pixels (h, w) of those that are usable: their logit is above the `threshold_at` the
    scene's strength, or they are of the measured route's mask and their logit is at most ``denied``
    below it."""
    logit, threshold = answers.object_logit, threshold_at(scene.strength, threshold)
    return (
        (logit > threshold) | (scene.inside & (logit > threshold - scene.denied))
    ) & scene.usable


def probabilities(logits: Image) -> Image:
    """Of the three candidates, (3, ...), from their logits (3, ...)."""
    chances = np.exp(logits - logits.max(axis=0))
    return chances / chances.sum(axis=0)  # type: ignore[no-any-return]


def answers_of_maps(network: PhaseNet, x: Image, exists: Mask) -> Answers:
    """The answers of a network that states its uncertainty, for its input ``x`` (C, h, w);
    ``exists`` bool (3, h, w): the candidates that there are, at least one a pixel."""
    order, inside, correction, scale = network.outputs(x)
    logits = np.where(exists, order, np.float32(-np.inf))
    return Answers(logits, inside, correction, np.float32(SCALE_TO_SIGMA) * np.exp(scale))


def least_energy_order(
    logits: Image, phases_rad: Image, inside: Mask, stride: int
) -> NDArray[np.intp]:
    """Index of each pixel's candidate (h, w) by least energy on a grid of every ``stride``-th
    pixel. ``logits`` as of `Answers`; ``phases_rad`` (3, h, w): what neighbours are compared by. A
    pixel takes the candidate nearest to what its grid point chose, or the nearest grid point that
    lies ``inside``."""
    chances = probabilities(logits)
    weight, size, grid = inside.astype(np.float32), (stride, stride), slice(None, None, stride)
    cost = np.stack(
        [cv2.blur((-np.log(p + 1e-9) * weight).astype(np.float32), size) for p in chances]
    )
    cost = (cost / np.maximum(cv2.blur(weight, size), 1e-3))[:, grid, grid] * np.float32(stride**2)
    points, phases = inside[grid, grid], phases_rad[:, grid, grid].astype(np.float32)
    link_x, link_y = (link * np.float32(GRAPH * stride) for link in links_between(points))
    cost = np.where(points, np.minimum(cost, LARGE), 0).astype(np.float32)
    choice, _ = least_energy(cost, phases, link_x, link_y, JUMP_RAD)
    chosen_rad = chosen_values(phases, choice)
    chosen_rad = chosen_rad[nearest_inside(points)]
    apart = np.abs(phases_rad - repeated(chosen_rad, stride, inside.shape))
    return np.where(chances > 0, apart, np.inf).argmin(axis=0)


TINY = 1e-12  # least probability whose logarithm is taken
LEAST_CHANCE = 1e-6  # of a wrong order, whatever the network answers
DOUBT = 0.25
"""Chance of a wrong order that a doubted pixel states at least: its sigma is then above a quarter
of the error that a wrong order makes, so that this error is none that was denied."""
TEMPERATURES = tuple(float(value) for value in np.geomspace(0.5, 8, 17))
OFFSETS = tuple(float(value) for value in np.arange(-4, 1.01, 0.25))
SURPRISE_PX = 2000
DOUBTED = (0.2, 0.1, 0.05, 0.02, 0.01, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5)
MOST_CONFIDENT = 0.0005
"""Share of a light's object pixels that may be wrong and not doubted: half of what is aimed at."""
EDGES = (0, 1e-5, 1e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.2, 0.3, 0.4, 0.5, 1.01)
"""Of the bins of the reliability curve."""


@dataclass(frozen=True)
class Odds:
    """How logits become the stated chance of a wrong order (Platt 1999): the logarithm of the odds
    that they give the chosen order to be wrong is divided by ``temperature``, and ``offset`` is
    added, since neighbours have helped to choose it. A pixel whose chance is above ``doubted``
    states at least `DOUBT`."""

    temperature: float = 1.0
    offset: float = 0.0
    doubted: float = 1.0


@dataclass(frozen=True)
class Judged:
    """Object pixels of a validation view of the light ``group``: ``logits`` (3, n), the index of
    the order that was chosen (n), and whether it was ``wrong`` (n)."""

    group: str
    logits: Image
    choice: NDArray[np.intp]
    wrong: Mask


def wrong_chance(logits: Image, choice: NDArray[np.intp], odds: Odds) -> Image:
    """Probability (...) that the candidate ``choice`` (...) is wrong, from ``logits`` (3, ...); 0
    where there is no other."""
    rivals = probabilities(logits)
    right = np.take_along_axis(rivals, choice[None], axis=0)[0]
    np.put_along_axis(rivals, choice[None], 0, axis=0)
    wrong = rivals.sum(axis=0)
    log_odds = np.log(np.maximum(wrong, TINY) / np.maximum(right, TINY))
    stated = 1 / (1 + np.exp(-(log_odds / odds.temperature + odds.offset)))
    stated = np.where(stated > odds.doubted, np.maximum(stated, DOUBT), stated)
    return np.where(wrong > 0, stated, 0).astype(np.float32)


def margin_of(wrong: Image) -> Image:
    """The margin that the phase route takes for a wrong order's chance: 0 from a half on."""
    chance = np.clip(wrong, LEAST_CHANCE, 1 - LEAST_CHANCE)
    return np.maximum(np.float32(MARGIN_SCALE) * np.log((1 - chance) / chance), 0).astype(
        np.float32
    )


def chosen_odds(judged: Sequence[Judged]) -> Odds:
    """The temperature and offset out of `TEMPERATURES` and `OFFSETS` with the least mean negative
    log-likelihood of right and wrong orders, and the largest of `DOUBTED` at which no light has
    more than `MOST_CONFIDENT` wrong pixels that are not doubted."""
    seen = [view for view in judged if view.wrong.size]
    tried = [Odds(temperature, offset) for temperature in TEMPERATURES for offset in OFFSETS]
    best = min(tried, key=lambda odds: sum(_surprise(view, odds) for view in seen))
    for doubted in DOUBTED:
        odds = replace(best, doubted=doubted)
        if max(confident_shares(judged, odds).values()) <= MOST_CONFIDENT:
            return odds
    return replace(best, doubted=0.0)


def _surprise(view: Judged, odds: Odds) -> float:
    """Mean negative log-likelihood over at most `SURPRISE_PX` pixels."""
    every = max(1, view.wrong.size // SURPRISE_PX)
    logits, choice, wrong = view.logits[:, ::every], view.choice[::every], view.wrong[::every]
    chance = np.clip(wrong_chance(logits, choice, odds), LEAST_CHANCE, 1 - LEAST_CHANCE)
    return float(-np.log(np.where(wrong, chance, 1 - chance).astype(np.float64)).mean())


def confident_shares(judged: Sequence[Judged], odds: Odds) -> dict[str, float]:
    """By light, the mean share of object pixels whose order is wrong and not doubted."""
    shares: dict[str, list[float]] = {}
    for view in judged:
        certain = wrong_chance(view.logits, view.choice, odds) < DOUBT
        shares.setdefault(view.group, []).append(
            float((view.wrong & certain).sum()) / max(view.wrong.size, 1)
        )
    return {group: float(np.mean(values)) for group, values in shares.items()}


def reliability(judged: Sequence[Judged], odds: Odds) -> list[tuple[float, float, float]]:
    """For each bin of `EDGES` that has pixels: mean stated chance of a wrong order, share of wrong
    orders, and share of all pixels; before any is doubted."""
    calm = replace(odds, doubted=1.0)
    chances = np.concatenate([wrong_chance(view.logits, view.choice, calm) for view in judged])
    wrong = np.concatenate([view.wrong for view in judged])
    places = np.digitize(chances, EDGES) - 1
    bins = [inside for place in range(len(EDGES) - 1) if (inside := places == place).any()]
    return [
        (float(chances[b].mean(dtype=np.float64)), float(wrong[b].mean()), float(b.mean()))
        for b in bins
    ]


def draw_reliability(path: Path, judged: Sequence[Judged], odds: Odds) -> None:
    """Picture of `reliability`: how often orders are wrong over how often they are said to be, in
    percent."""
    from fpp_ml_bench.baselines.training.engine import (
        Panel,
        draw_curves,
    )  # which a prediction does without

    rows = reliability(judged, odds)
    stated, seen, share = ([100 * row[column] for row in rows] for column in range(3))
    label = "stated chance of a wrong order, %"
    panels = [
        Panel(
            "wrong orders, %",
            label,
            {"validation": (stated, seen), "calibrated": ([0, 60], [0, 60])},
        ),
        Panel("share of the object pixels, %", label, {"_": (stated, share)}, log=True),
    ]
    draw_curves(path, "How often an order is wrong, and how often it is said to be", panels)
