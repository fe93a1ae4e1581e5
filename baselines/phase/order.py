"""Third stop: the order of each pixel, by costs of its candidates and by least energy over
neighbours.

What tells an order are the `TERMS`, each a cost without unit for every candidate, and an
assumption. A single point is often wrong; there the energy (`labels.least_energy`) lets its
neighbours decide. Where nothing calibrates brightness, the order follows from range and continuity
(`margin_by_range`): over a smooth surface all pixels share one error of the order, so that an order
is settled if every other order would put a part of the surface outside the range. If another order
keeps the whole surface inside, the two can't be distinguished, and the order is ambiguous.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from fpp_ml_bench.baselines.phase.candidates import (
    Candidates,
    CrossedCandidates,
    FringeCandidates,
    chosen_values,
    links_between,
)
from fpp_ml_bench.baselines.phase.geometry import TAU, Image, Mask, nearest_inside
from fpp_ml_bench.baselines.phase.object_mask import disk
from fpp_ml_bench.baselines.phase.observe import Capture, CrossedObservation, Observation
from fpp_ml_bench.baselines.phase.settings import Settings
from fpp_ml_bench.constants import MM_PER_M

LARGE = np.float32(1e4)
"""Cost of a candidate that does not exist: far above any sum of costs, and small enough to be added
in float32."""
EVIDENCE_PERIODS = 2.0
"""Side of the square over which evidence for an order is averaged: a single pixel's brightness is
too uncertain."""
LEAST_BRIGHTNESS = 1e-3
"""Least irradiance, in 1/m^2, whose logarithm is taken: a surface turned away has 0 or less."""
PHASE_SIGMA_RAD = 0.35
"""Standard deviation, in rad, of a carrier's phase in a window, edges and texture included. A
larger one gives the evidence less weight beside neighbours."""
LEAST_SIGMA_RAD = 0.1
"""The same of phases whose uncertainty networks state, where they state none: a calibration that is
off. Chosen, with `SHARED_SIGMAS`, on validation objects before four validation rigs."""
SHARED_SIGMAS = 3.0
"""Stated standard uncertainties of a phase that count as one: neighbours share most of what a
network saw, and so its error."""
MOST_AGREEMENT = 2.83**2 / 2
"""Largest cost of a phase misfit, that of 2.83 standard deviations: beyond it a window across an
edge may show anything."""
JUMP_RAD = 2.5
"""Jump of the residual or joint phase between neighbours from which on it costs no more: a depth
edge costs this, whatever its height. Chosen, as the costs below, on train and validation
objects."""
SHADING_COST = 0.003
"""Cost of a pixel, in rad of a jump, for each `SHADING_SPREAD` by which a candidate's log
brightness is off."""
SHADING_SPREAD = 0.1
"""Misfit of the log brightness, natural, that costs `SHADING_COST`: about 10%."""
SHADING_LIMIT = 3.0
"""Misfit in units of `SHADING_SPREAD` from which on it costs no more, so that one odd pixel does
not outvote its neighbours."""
PRIOR_COST = 0.002
"""Cost of a pixel, in rad of a jump, for each 100 mm from the standoff; used with `--prior
standoff` alone."""
SMOOTHNESS = 33.0
"""Weight of the link between two pixels: a pixel's window shares most of its light with its
neighbour's, and one pixel's light may be that of two surfaces."""
LIGHT_SIGMA = 0.06
"""Standard uncertainty of the model of a pixel's light over its brightness, apart from noise.
Chosen, as weights and limits of three crossed frames, on training and validation objects with thin
parts (`docs/results/crossed.md`)."""
LIGHT_NOISE = 1.2
"""Factor on noise over brightness that is added to that uncertainty: the mean and the modulation of
three frames both have noise."""
MOST_LIGHT = 6.5
"""Largest cost of a pixel's light, that of 3.6 standard deviations: beyond it the pixel shows
something else."""
INDIRECT_PERIODS = 1.0
"""Side, in periods, of the window of the median that light from other surfaces is taken from: such
light changes slowly."""
MOST_INDIRECT = 0.4
"""Largest share of the brightness that may be light from other surfaces. Above it the median more
likely holds wrong candidates than such light."""
MEDIAN_STEP = 0.005
"""Step of the levels of which the median is taken, in shares of the brightness: 255 levels cover
+-0.635, beyond `MOST_INDIRECT`, and OpenCV's median of bytes is fast."""
LEAST_BRIGHT = 1.0
"""Least brightness, in grey levels, that light is divided by: it keeps the share finite in the
dark."""
EVIDENCE_SCALE = 1.0
"""Difference of the evidence's cost by which the odds of two orders of crossed fringes grow e-fold.
The costs are squared sigmas over 2, that is log-odds, so the scale is 1."""
ENERGY_SCALE = 4.0
"""Difference of the energy by which these odds grow e-fold. Larger than that of the evidence: the
energy counts jumps to neighbours too, and not the pixel's evidence alone."""
EVEN_ODDS = 0.8
"""Sum of both scaled differences at which the two orders are equally likely. A larger number states
more doubt at every pixel."""
EVIDENCE_WEIGHT = 2.0
"""One carrier's phase has no error: evidence tells twice as much of the order as in one frame."""
STEEPEST_PERIODS = 1.2
"""Largest change of the residual phase along a period of the image, in periods, on a smooth
surface: at a depth edge it is mostly larger, since a window turns the jump into a slope. Chosen, as
those to `LIKELY`, on an image of a real skull (`docs/results/phase_route.md`)."""
LARGEST_MISFIT = 0.4
"""Largest misfit of the fringe over its brightness within a surface. A depth edge is a line along
which the window's fringe is not seen, whatever the phases of both sides."""
MISFIT_PERIODS = 0.06
"""Sigma, in periods, of the Gaussian under which that misfit is averaged: narrow, because the line
is."""
NECK_PERIODS = 0.25
"""Half the width of the narrowest connection between parts of a surface. Along a depth edge the
jump is a whole number of periods here and there, and looks continuous; such places are short."""
LEAST_SETTLED_AREA_PERIODS = 0.5
"""Area, in squares of one period, of the smallest surface whose order the range may settle. A
smaller surface stays ambiguous, or continues a settled one."""
OUT_SHARE = 0.05
"""Least share of a surface that must leave the range for an order to be ruled out; its own order
must leave less of it beyond. A smaller share lets stray pixels decide."""
OUT_AREA_PERIODS = 0.1
"""Least area of the part that leaves the range, in squares of one period: on a small surface the
share alone would be a few pixels."""
REACH_PERIODS = 0.35
"""Distance from a settled surface, in periods, within which a pixel continues it."""
CONTINUES_RAD = 0.8
"""Difference of the residual phase, in rad, from that surface within which such a pixel continues
it: far less than the 2 pi of another order."""
SURE = 1.0
"""Margin of an order that range and continuity settle, 1: that which rules the rival out."""
LIKELY = 0.03
"""Margin of an order that may well be wrong, as at the edge of a surface, where the phase may be
that of two. Its stated uncertainty is then a good part of an order."""


class Term(NamedTuple):
    """Evidence for the order: what it ``assumes`` of a scene, and the cost (K, h, w) float32 of
    every candidate of an observation, by the settings."""

    assumes: str
    cost: Callable[[Any, Any, Settings], Image]


def brightness_cost(seen: Observation, offered: FringeCandidates, settings: Settings) -> Image:
    """The phase fixes how fast 1/Z changes along the surface, the order fixes Z itself: together
    they give distance and normal of every candidate, and so the brightness of a matte surface
    there."""
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = np.maximum(offered.irradiance, LEAST_BRIGHTNESS)
        ratio = np.maximum(offered.brightness, LEAST_BRIGHTNESS) / expected
        misfit = np.abs(np.log(np.nan_to_num(ratio, nan=1.0))) / np.float32(SHADING_SPREAD)
    cost = np.float32(SHADING_COST) * np.minimum(misfit, SHADING_LIMIT)
    return cost * offered.trust  # type: ignore[no-any-return]


def standoff_cost(seen: Observation, offered: FringeCandidates, settings: Settings) -> Image:
    """By the distance from the rig's standoff."""
    offset = np.abs(offered.depth_mm - np.float32(seen.rig.standoff_m * MM_PER_M)) / 100
    return np.float32(PRIOR_COST) * np.minimum(np.nan_to_num(offset, nan=10.0), 10)


def agreement_cost(
    seen: CrossedObservation, offered: CrossedCandidates, settings: Settings
) -> Image:
    """By the distance of both phases from the candidate's: s standard deviations cost s^2 / 2.
    Where networks state the uncertainty of the phases, it is theirs."""
    sigma_rad: Image | np.float32 = np.float32(PHASE_SIGMA_RAD)
    if seen.sigma_rad is not None:
        stated = seen.sigma_rad[:, :: seen.stride, :: seen.stride].max(axis=0)
        sigma_rad = np.hypot(np.float32(LEAST_SIGMA_RAD), np.float32(SHARED_SIGMAS) * stated)
    return np.minimum((offered.misfit_rad / sigma_rad) ** 2 / 2, np.float32(MOST_AGREEMENT))


def pixel_light_cost(
    seen: CrossedObservation, offered: CrossedCandidates, settings: Settings
) -> Image:
    """By the deviation of the still carrier's measured cosine from that at the candidate's depth, s
    standard deviations for s^2 / 2. The measured one follows from a pixel's mean grey level and its
    brightness, which the modulation of the other carrier gives. Light from other surfaces is the
    local median of what the candidates of least misfit leave."""
    carriers, moved = seen.carriers, int(seen.moved or 0)
    still = 1 - moved
    bright = np.maximum(
        seen.modulation[moved] / np.float32(seen.contrast[moved]), np.float32(LEAST_BRIGHT)
    )
    expected = np.cos(carriers.infinity_rad[still] + carriers.gain[still] * offered.nearness)
    left = seen.light / bright - 1 - np.float32(seen.contrast[still]) * expected
    likely = np.where(offered.exists, offered.misfit_rad, LARGE).argmin(axis=0)
    indirect = local_median(
        chosen_values(left, likely), seen.inside, INDIRECT_PERIODS * seen.period_px
    )
    left -= np.minimum(indirect, np.float32(MOST_INDIRECT))
    sigma = np.hypot(
        np.float32(LIGHT_SIGMA), np.float32(LIGHT_NOISE * seen.background.noise_grey) / bright
    )
    return np.minimum((left / sigma) ** 2 / 2, np.float32(MOST_LIGHT)).astype(np.float32)


TERMS = {
    "shading": Term(
        "Assumes one albedo for all surfaces and a lit background, which shows how strong the lamp "
        "is: the brightness "
        "of the fringe image decides the fringe order.",
        brightness_cost,
    ),
    "standoff": Term(
        "Assumes objects near the rig's standoff, true of fixed placement.", standoff_cost
    ),
    "agreement": Term(
        "Assumes that no texture near a carrier's period looks like that carrier.", agreement_cost
    ),
    "pixel light": Term("Assumes that light from other surfaces changes slowly.", pixel_light_cost),
}
"""Beside them, range and continuity count always: a candidate beyond the working range does not
exist, and neighbours belong to one surface, except where the phase or the brightness jumps."""


def terms_of(settings: Settings) -> list[str]:
    """Names of the terms that decide the order of one carrier."""
    return ["shading"] * settings.shading + ["standoff"] * (settings.prior == "standoff")


def cost_of(names: Sequence[str], seen: Capture, offered: Candidates, settings: Settings) -> Image:
    """Cost (K, h, w) of every candidate by the terms ``names``."""
    cost = np.zeros_like(offered.phase_rad)
    for name in names:
        cost += TERMS[name].cost(seen, offered, settings)
    return cost


def solved(offered: Candidates, cost: Image, smoothness: float) -> tuple[NDArray[np.int32], Image]:
    """Index of the candidate of least energy, int32 (h, w), and the margin of the energy (0 for a
    tie)."""
    from fpp_ml_bench.baselines.phase.labels import least_energy  # compiled when it is imported

    unary = np.where(offered.inside, np.where(offered.exists, cost, LARGE), np.float32(0)).astype(
        np.float32
    )
    link_x, link_y = (np.float32(smoothness) * link for link in offered.links)
    return least_energy(unary, offered.phase_rad, link_x, link_y, JUMP_RAD)


@dataclass(frozen=True)
class FringeOrder:
    """Fringes of one direction with the ``order`` of every pixel, int32 (h, w), and its ``margin``,
    float32 (h, w): how clearly it won, 0 for a tie, 1 or more for certain."""

    seen: Observation
    order: NDArray[np.int32]
    margin: Image


def fringe_order(settings: Settings, seen: Observation, offered: FringeCandidates) -> FringeOrder:
    """The order of every pixel, by the terms of the settings and over neighbours."""
    cost = cost_of(terms_of(settings), seen, offered, settings)
    index, margin = solved(offered, cost * seen.stride**2, 1.0)
    largest = max(SHADING_COST * SHADING_LIMIT * settings.shading, PRIOR_COST)
    proof = cost / np.float32(largest)
    proof[~offered.exists] = 2.0
    margin = np.minimum(
        margin / np.float32(JUMP_RAD), _evidence(proof, index, seen, offered.inside)
    )
    chosen_rad, margin = (
        seen.spread(values) for values in (chosen_values(offered.phase_rad, index), margin)
    )
    # A pixel takes the order whose residual phase is nearest to that of its grid point.
    order = np.rint((chosen_rad - seen.layer.residual_phase(seen.phase_rad, 0.0)) / TAU).astype(
        np.int32
    )
    return FringeOrder(seen, order, margin)


def _evidence(proof: Image, choice: NDArray[np.int32], seen: Observation, inside: Mask) -> Image:
    """By how much the cost of the second-best order exceeds that of the choice, averaged over
    object pixels nearby."""
    if len(proof) == 1:
        return np.full(choice.shape, 2.0, np.float32)
    gap = (
        (_rivals(proof, choice, np.inf).min(axis=0) - chosen_values(proof, choice)) * inside
    ).astype(np.float32)
    side = 2 * max(1, round(EVIDENCE_PERIODS * seen.period_px / seen.stride / 2)) + 1
    maps = (gap, inside.astype(np.float32))
    mean_gap, share = (
        cv2.blur(values, (side, side), borderType=cv2.BORDER_CONSTANT) for values in maps
    )
    return mean_gap / np.maximum(share, 1e-3)  # type: ignore[return-value]  # cv2 keeps float32


def _rivals(cost: Image, choice: NDArray[np.int32], ruled_out: float | np.float32) -> Image:
    """``cost`` (K, h, w) with the chosen candidate ruled out."""
    rivals = cost.copy()
    np.put_along_axis(rivals, choice[None].astype(np.intp), ruled_out, axis=0)
    return rivals


@dataclass(frozen=True)
class CrossedOrder:
    """The order of crossed fringes, maps float32 (h, w): ``nearness``, and ``misfit_rad``, the
    distance of both phases from those there; ``wrong_chance``: probability that it is wrong;
    ``rival``: nearness of the best candidate but the chosen one, the chosen one's own where there
    is no other."""

    nearness: Image
    misfit_rad: Image
    wrong_chance: Image
    rival: Image


def crossed_order(
    settings: Settings, seen: CrossedObservation, offered: CrossedCandidates
) -> CrossedOrder:
    """The order of every pixel of crossed fringes."""
    terms, smoothness, evidence_weight = ["agreement"], 1.0, 1.0
    if seen.moved is not None:
        terms, smoothness, evidence_weight = (
            ["agreement", "pixel light"],
            SMOOTHNESS,
            EVIDENCE_WEIGHT,
        )
    cost = cost_of(terms, seen, offered, settings)
    cost = np.where(offered.exists, cost * offered.trust, LARGE).astype(np.float32)
    index, margin = solved(offered, cost, smoothness)
    evidence = _rivals(cost, index, LARGE).min(axis=0) - chosen_values(cost, index)
    evidence = np.minimum(evidence, np.float32(MOST_AGREEMENT)).astype(np.float32)
    misfit = _rivals(np.where(offered.exists, offered.misfit_rad, LARGE), index, LARGE)
    rival = chosen_values(
        offered.nearness, np.where(misfit.min(axis=0) < LARGE, misfit.argmin(axis=0), index)
    )
    evidence *= np.float32(evidence_weight)
    margin = margin / np.float32(smoothness)
    odds = evidence / EVIDENCE_SCALE + margin / ENERGY_SCALE - EVEN_ODDS
    chance = (1 / (1 + np.exp(np.clip(odds, -50, 50)))).astype(np.float32)
    nearness, misfit_rad = (
        chosen_values(values, index) for values in (offered.nearness, offered.misfit_rad)
    )
    return CrossedOrder(*map(seen.spread, (nearness, misfit_rad, chance, rival)))


def local_median(values: Image, inside: Mask, window_px: float) -> Image:
    """Median of ``values`` (h, w) over the square of ``window_px`` around each pixel, in steps of
    `MEDIAN_STEP` between -127 and 127 of them; beyond ``inside`` they are those of the nearest
    pixel within."""
    levels = np.clip(np.rint(values / np.float32(MEDIAN_STEP)), -127, 127).astype(np.int16)
    levels = levels[nearest_inside(inside)]
    size = 2 * int(window_px / 2) + 1
    median = cv2.medianBlur((levels + 128).astype(np.uint8), size)
    return (median.astype(np.float32) - 128) * np.float32(MEDIAN_STEP)


def margin_by_range(seen: Observation, order: NDArray[np.int32]) -> Image:
    """Margin of ``order`` (h, w), float32: `SURE` where range and continuity rule every other order
    out, `LIKELY` where the range leaves a pixel alone one order, or beside a settled surface that
    it continues, else 0."""
    residual = seen.layer.residual_phase(seen.phase_rad, order)
    # Misfit of the fringe in the first frame over its brightness, on the scale of a depth edge's
    # line.
    light = seen.greys[0] - np.float32(seen.background.ambient_grey) - seen.fit.light
    relative = np.where(seen.inside, light / np.maximum(seen.fit.brightness, 1), 0).astype(
        np.float32
    )
    misfit = np.sqrt(cv2.GaussianBlur(relative * relative, (0, 0), MISFIT_PERIODS * seen.period_px))
    steepness = np.hypot(*_slopes(residual, seen.inside)) * seen.period_px / TAU
    smooth = seen.inside & (steepness < STEEPEST_PERIODS) & (misfit < LARGEST_MISFIT)
    neck, square = disk(NECK_PERIODS * seen.period_px), seen.period_px**2
    cores = cv2.morphologyEx(smooth.astype(np.uint8), cv2.MORPH_OPEN, neck)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(cores, connectivity=4)
    areas = stats[:, cv2.CC_STAT_AREA]
    settled = areas >= LEAST_SETTLED_AREA_PERIODS * square
    settled[0] = False
    for rival in (
        -1,
        1,
    ):  # the range is an interval: an order further away leaves it with more pixels
        outside = np.bincount(labels[~_in_range(seen, order + rival)], minlength=count)
        settled &= (outside > OUT_SHARE * areas) & (outside > OUT_AREA_PERIODS * square)
    settled &= np.bincount(labels[~_in_range(seen, order)], minlength=count) < OUT_SHARE * areas
    sure = settled[labels]
    likely = seen.inside & (seen.candidates.count == 1)
    if sure.any():
        distance, (y, x) = distance_transform_edt(~sure, return_indices=True)
        continues = np.abs(residual - residual[y, x]) < CONTINUES_RAD
        likely |= seen.inside & continues & (distance < REACH_PERIODS * seen.period_px)
    return np.select([sure, likely], [np.float32(SURE), np.float32(LIKELY)], np.float32(0))


def _in_range(seen: Observation, order: NDArray[np.int32]) -> Mask:
    first, count = seen.candidates.first, seen.candidates.count
    return (order >= first) & (order < first + count)


def _slopes(residual_rad: Image, inside: Mask) -> tuple[Image, Image]:
    """Larger of the two one-sided changes a px along x and y, between object pixels."""
    slopes = []
    for axis, link in zip((1, 0), links_between(inside), strict=True):
        change = np.abs(np.diff(residual_rad, axis=axis)) * link
        slopes.append(
            np.maximum(*(np.insert(change, place, 0, axis) for place in (0, change.shape[axis])))
        )
    return slopes[0], slopes[1]
