"""The nearness at every grid point: the turn at which both phases agree, by least energy over pairs of neighbours.

Each order of the carrier with the larger gain that lies in the working range is a candidate. Its nearness is the one
that fits both phases best, and its cost grows with the remaining distance from both phases, in rad. A single point is
wrong where noise or a depth edge makes a rival fit better; there the energy lets its neighbours decide
(`phase.least_energy`).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import TAU, Image, Mask, wrapped
from fpp_ml_bench.baselines.phase.carriers import Carriers
from fpp_ml_bench.baselines.phase.labels import LARGE, least_energy
from fpp_ml_bench.baselines.phase.orders import chosen_values, links_between

PHASE_SIGMA_RAD = 0.35  # of a carrier's phase in a window, edges and texture included
MOST_SIGMAS = 2.83
"""Misfit, in sigmas, from which on it costs no more: a window across an edge may show anything."""
JUMP_RAD = 2.5  # jump of the joint phase between neighbours from which on it costs no more


@dataclass(frozen=True)
class Candidates:
    """K candidates at each grid point (K, h', w'), the furthest first: ``nearness`` q, ``misfit_rad``: distance of both
    phases from those at q, and whether it ``exists``, that is lies in the working range."""

    nearness: NDArray[np.float32]
    misfit_rad: Image
    exists: Mask


def candidates(carriers: Carriers, phase_rad: Image, slack_mm: float, exact: int | None = None) -> Candidates:
    """All candidates of wrapped phases (2, h', w') in the range with ``slack_mm`` more at both ends. Of the carrier
    ``exact``, if one is given, the phase has no error: the orders are its orders, and it alone tells the nearness."""
    near_mm, far_mm = carriers.rig.working_range_mm
    gain = carriers.gain
    main = int(np.median(np.abs(gain[1])) > np.median(np.abs(gain[0]))) if exact is None else exact
    ends = [gain[main] * carriers.nearness(end) for end in (near_mm - slack_mm, far_mm + slack_mm)]
    low, high = np.minimum(*ends), np.maximum(*ends)
    residual = wrapped(phase_rad - carriers.infinity_rad)
    proposing, other, joint = residual[main], residual[1 - main], carriers.joint_gain
    ratio = gain[1 - main] / gain[main]
    first = np.ceil((low - proposing) / TAU)
    count = int(np.ceil(float((high - low).max()) / TAU)) + 1
    nearness, misfits, exists = [], [], []
    for turn in range(count):
        psi = proposing + TAU * (first + turn)
        beside = wrapped(other - psi * ratio)
        if exact is None:  # the point of the line nearest to the measured pair, and its distance
            nearness.append((gain[main] * psi + gain[1 - main] * (psi * ratio + beside)) / joint**2)
            misfits.append(np.abs(beside * gain[main]) / joint)
        else:
            nearness.append(psi / gain[main])
            misfits.append(np.abs(beside))
        exists.append(psi <= high)
    furthest_first = slice(None, None, 1 if float(np.median(gain[main])) > 0 else -1)
    maps = (np.stack(values)[furthest_first] for values in (nearness, misfits, exists))
    q, misfit, exist = maps
    return Candidates(q.astype(np.float32), misfit.astype(np.float32), exist)


def chosen(
    carriers: Carriers,
    found: Candidates,
    trust: Image,
    inside: Mask,
    links: tuple[Image, Image] | None = None,
    more_cost: Image | None = None,
) -> tuple[NDArray[np.int32], Image, Image]:
    """Index of the candidate of least energy, int32 (h', w'), the margin of the energy (0 for a tie), and the evidence:
    cost of the best rival minus cost of the chosen candidate. A misfit of s standard deviations costs s^2 / 2.
    ``trust`` (h', w'): weight of a point's evidence, 0 to 1; ``links`` along x and y: weight of the smoothness between
    neighbours (default: 1 on the object); ``more_cost`` (K, h', w'): added to the misfit's cost of each candidate."""
    most = np.float32(MOST_SIGMAS**2 / 2)
    cost = np.minimum((found.misfit_rad / np.float32(PHASE_SIGMA_RAD)) ** 2 / 2, most)
    if more_cost is not None:
        cost = cost + more_cost
    cost = np.where(found.exists, cost * trust, LARGE).astype(np.float32)
    joint_rad = (found.nearness * carriers.joint_gain).astype(np.float32)
    unary = np.where(inside, cost, np.float32(0))
    index, margin = least_energy(unary, joint_rad, *(links or links_between(inside)), JUMP_RAD)
    evidence = np.minimum(_without(cost, index).min(axis=0) - chosen_values(cost, index), most)
    return index, margin, evidence.astype(np.float32)


def rival(found: Candidates, index: NDArray[np.int32]) -> Image:
    """Nearness of the best candidate but the chosen one, (h', w'); the chosen one's own where there is no other."""
    cost = _without(np.where(found.exists, found.misfit_rad, LARGE), index)
    best = np.where(cost.min(axis=0) < LARGE, cost.argmin(axis=0), index)
    return chosen_values(found.nearness, best)  # type: ignore[no-any-return]


def neighbours(found: Candidates, index: NDArray[np.int32]) -> Candidates:
    """The candidates a turn further than the chosen one, the chosen one, and a turn nearer."""
    count = len(found.nearness)
    places = [np.clip(index + step, 0, count - 1) for step in (-1, 0, 1)]
    inside = [(index > 0), np.ones(index.shape, bool), (index < count - 1)]
    nearness, misfit_rad = (
        np.stack([chosen_values(maps, place) for place in places]) for maps in (found.nearness, found.misfit_rad)
    )
    pairs = zip(places, inside, strict=True)
    return Candidates(
        nearness, misfit_rad, np.stack([chosen_values(found.exists, place) & one for place, one in pairs])
    )


def _without(cost: Image, index: NDArray[np.int32]) -> Image:
    """``cost`` (K, h', w') with the chosen candidate ruled out."""
    rivals = cost.copy()
    np.put_along_axis(rivals, index[None].astype(np.intp), LARGE, axis=0)
    return rivals
