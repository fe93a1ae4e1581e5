"""How likely an order is wrong, as it is stated: from the network's logits, calibrated on validation views."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines import phase_route
from fpp_ml_bench.baselines.phase_network.answers import probabilities
from fpp_ml_bench.baselines.phase_route import Image, Mask
from fpp_ml_bench.baselines.training import Panel, draw_curves

TINY = 1e-12  # least probability whose logarithm is taken
LEAST_CHANCE = 1e-6  # of a wrong order, whatever the network answers
DOUBT = 0.25
"""Chance of a wrong order that a doubted pixel states at least: its sigma is then above a quarter of the error that a
wrong order makes, so that this error is none that was denied."""
TEMPERATURES = tuple(float(value) for value in np.geomspace(0.5, 8, 17))
OFFSETS = tuple(float(value) for value in np.arange(-4, 1.01, 0.25))
SURPRISE_PX = 2000
DOUBTED = (0.2, 0.1, 0.05, 0.02, 0.01, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5)
MOST_CONFIDENT = 0.0005  # share of a light's object pixels that may be wrong and not doubted: half of what is aimed at
EDGES = (0, 1e-5, 1e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.2, 0.3, 0.4, 0.5, 1.01)  # of the bins of the reliability curve

Lines = dict[str, tuple[Sequence[float], Sequence[float]]]


@dataclass(frozen=True)
class Odds:
    """How logits become the stated chance of a wrong order (Platt 1999): the logarithm of the odds that they give the
    chosen order to be wrong is divided by ``temperature``, and ``offset`` is added, since neighbours have helped to
    choose it. A pixel whose chance is above ``doubted`` states at least `DOUBT`."""

    temperature: float = 1.0
    offset: float = 0.0
    doubted: float = 1.0


@dataclass(frozen=True)
class Judged:
    """Object pixels of a validation view of the light ``group``: ``logits`` (3, n), the index of the order that was
    chosen (n), and whether it was ``wrong`` (n)."""

    group: str
    logits: Image
    choice: NDArray[np.intp]
    wrong: Mask


def wrong_chance(logits: Image, choice: NDArray[np.intp], odds: Odds) -> Image:
    """Probability (...) that the candidate ``choice`` (...) is wrong, from ``logits`` (3, ...); 0 where there is no
    other."""
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
    return np.maximum(np.float32(phase_route.MARGIN_SCALE) * np.log((1 - chance) / chance), 0).astype(np.float32)


def chosen_odds(judged: Sequence[Judged]) -> Odds:
    """The temperature and offset out of `TEMPERATURES` and `OFFSETS` with the least mean negative log-likelihood of
    right and wrong orders, and the largest of `DOUBTED` at which no light has more than `MOST_CONFIDENT` wrong pixels
    that are not doubted."""
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
        shares.setdefault(view.group, []).append(float((view.wrong & certain).sum()) / max(view.wrong.size, 1))
    return {group: float(np.mean(values)) for group, values in shares.items()}


def reliability(judged: Sequence[Judged], odds: Odds) -> list[tuple[float, float, float]]:
    """For each bin of `EDGES` that has pixels: mean stated chance of a wrong order, share of wrong orders, and share of
    all pixels; before any is doubted."""
    calm = replace(odds, doubted=1.0)
    chances = np.concatenate([wrong_chance(view.logits, view.choice, calm) for view in judged])
    wrong = np.concatenate([view.wrong for view in judged])
    places = np.digitize(chances, EDGES) - 1
    rows = []
    for place in range(len(EDGES) - 1):
        inside = places == place
        if inside.any():
            stated = float(chances[inside].mean(dtype=np.float64))
            rows.append((stated, float(wrong[inside].mean()), float(inside.mean())))
    return rows


def draw_reliability(path: Path, judged: Sequence[Judged], odds: Odds) -> None:
    """Picture of `reliability`: how often orders are wrong over how often they are said to be, in percent."""
    rows = reliability(judged, odds)
    stated, seen, share = ([100 * row[column] for row in rows] for column in range(3))
    curve: Lines = {"validation": (stated, seen), "calibrated": ([0, 60], [0, 60])}
    shares: Lines = {"_": (stated, share)}
    panels = [
        Panel("wrong orders, %", "stated chance of a wrong order, %", curve),
        Panel("share of the object pixels, %", "stated chance of a wrong order, %", shares, log=True),
    ]
    draw_curves(path, "How often an order is wrong, and how often it is said to be", panels)
