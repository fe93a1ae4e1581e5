"""Rivals on the torus: against all pairs of depths of all pixels, and the figures of pairs on rigs
of several kinds."""

from dataclasses import replace

import numpy as np
import pytest

from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.design.rivals import (
    EpipolarLines,
    background_distance,
    rival_distance,
    wrong_orders,
)
from fpp_ml_bench.design.search import Assumptions, describe, search, square_pair
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.optics.named_rigs import CROSSED, paper_rig

PAPER = paper_rig()
TURNED = replace(
    PAPER,
    rotation=((0.98, 0.0, 0.198997487421324), (0.0, 1.0, 0.0), (-0.198997487421324, 0.0, 0.98)),
    translation_m=(-0.25, -0.12, 0.06),
)
"""Looks to the side, with the projector in front of the camera: lines of all directions and
lengths."""
SIDEWAYS = replace(PAPER, translation_m=(0.16, 0.0, 0.0))


def brute_force(rig, crossed, samples=500):
    """Least distance of the phases of two depths of a pixel of the image's grid whose orders
    differ, and of the background from any depth, rad."""
    columns, rows = (
        axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(0, rig.camera.width - 1, 5)])
    )
    near_m, far_m = (limit / 1000 for limit in rig.working_range_mm)
    depths_m = 1 / np.linspace(1 / near_m, 1 / far_m, samples)
    rival, background = np.inf, np.inf
    for x, y in zip(*rig.camera.normalised(columns, rows), strict=True):
        seen = rig.project(np.outer(depths_m, [x, y, 1.0]))
        middle = rig.project(rig.standoff_m * np.array([x, y, 1.0]))
        if not (np.isfinite(seen[0]).all() and 0 <= middle[0] <= 911 and 0 <= middle[1] <= 1139):
            continue
        behind = rig.project(rig.background_m * np.array([x, y, 1.0]))
        phases, of_plane = (
            np.stack([f_u * u + f_v * v for f_u, f_v in crossed.cycles_per_px], axis=-1)
            for u, v in (seen, behind)
        )
        apart = phases[:, None] - phases
        order = np.rint(apart)
        distance = 2 * np.pi * np.hypot(*np.moveaxis(apart - order, -1, 0))
        rival = min(rival, distance[(order != 0).any(axis=-1)].min(initial=np.inf))
        apart = phases - of_plane
        background = min(background, 2 * np.pi * np.hypot(*(apart - np.rint(apart)).T).min())
    return rival, background


@pytest.mark.long
@pytest.mark.parametrize("rig", [PAPER, TURNED, SIDEWAYS], ids=["paper", "turned", "sideways"])
@pytest.mark.parametrize(
    "crossed",
    [
        Crossed((18.0, 18.0)),
        Crossed((18.0, 14.0)),
        Crossed((13.0, 24.0), (30.0, 75.0)),
        Crossed((9.0, 22.5), (150, 20)),
    ],
)
def test_distances_are_those_of_all_pairs_of_depths(rig, crossed):
    lines = EpipolarLines.of(rig)
    turns = lines.turns(crossed)
    rival, background = brute_force(rig, crossed)
    assert float(rival_distance(turns).min()) == pytest.approx(min(rival, 7), abs=0.05)
    assert float(background_distance(turns, lines.background).min()) == pytest.approx(
        background, abs=0.05
    )
    candidate = describe(rig, [crossed], Assumptions())[0]
    assert candidate.rival_rad == rival_distance(turns).min()
    assert candidate.background_rad == background_distance(turns, lines.background).min()


def test_the_expected_errors_are_about_those_measured():
    """Measured by `benchmarks/crossed_sweep.py` on 15 validation views, the mean of both lights,
    with the right mask: share of wrong orders before neighbours help, and mean error in mm."""
    measured = {
        6: (5.0, 2.22),
        8: (2.9, 2.35),
        10: (1.7, 2.30),
        12: (1.4, 2.87),
        14: (1.3, 3.70),
        18: (0.9, 4.52),
    }
    lines = EpipolarLines.of(PAPER)
    found = describe(PAPER, [square_pair(lines, pitch) for pitch in measured], Assumptions())
    for candidate, (wrong_percent, mean_mm) in zip(found, measured.values(), strict=True):
        assert wrong_percent / 7 < 100 * candidate.wrong_share < 2 * wrong_percent
        assert candidate.expected_mm == pytest.approx(mean_mm, rel=0.25)


def test_wrong_orders_of_drawn_errors():
    turns, sigma = np.array([1.93, -2.41]), 0.5
    generator, places = np.random.default_rng(1), np.linspace(0.0, 1.0, 1500)
    along = turns / np.hypot(*turns)
    across = np.array([-along[1], along[0]])
    error = generator.laplace(0.0, sigma / np.sqrt(2), 4000)[:, None] * across / (2 * np.pi)
    true = generator.uniform(0.0, 1.0, 4000)
    apart = (true[:, None] * turns + error)[:, None] - places[:, None] * turns
    order = np.rint(apart)
    best = np.argmin(((apart - order) ** 2).sum(axis=-1), axis=1)
    wrong = (order[np.arange(4000), best] != 0).any(axis=-1)
    lines = EpipolarLines.of(PAPER)
    rate, error_mm = wrong_orders(lines, turns, sigma)
    assert float(rate) == pytest.approx(wrong.mean(), rel=0.12)
    off_mm = np.abs(lines.depths_mm(places[best]) - lines.depths_mm(true)) * wrong
    assert float(error_mm) == pytest.approx(off_mm.mean(), rel=0.12)
    assert float(wrong_orders(lines, turns, sigma, 0.25)[0]) == pytest.approx(rate / 4)


def test_a_carrier_along_the_epipolar_lines_tells_no_depth():
    lines = EpipolarLines.of(SIDEWAYS)
    assert lines.flat_angle_deg == pytest.approx(0, abs=1e-6)
    straight, tilted = describe(
        SIDEWAYS, [Crossed((18.0, 18.0)), Crossed((18.0, 14.0), (45.0, 120.0))], Assumptions()
    )
    assert straight.flat == (0,) and straight.rival_rad < 1e-9 and tilted.flat == ()
    found = search(SIDEWAYS, Assumptions(), (12.0, 18.0))
    assert found.proposed.rival_rad > 0.9 and found.proposed.flat == ()


def test_noise_alone_is_that_of_drawn_noise():
    """Of both phases together, by least squares along the line at the far end."""
    crossed, assumed = Crossed((18.0, 14.0)), Assumptions(phase_error=1e-6)
    slopes = (
        2 * np.pi * EpipolarLines.of(PAPER).far_px_per_mm[0] @ np.array(crossed.cycles_per_px).T
    )
    rows, columns = np.mgrid[-40:41, -40:41]
    (found,) = describe(PAPER, [crossed], replace(assumed, surfaces_mm=(2099.999, 2100.0)))
    window = np.exp(-(rows**2 + columns**2) / (2 * (0.27 * max(found.image_px)) ** 2))
    window /= window.sum()
    kept = np.exp(-2 * (np.pi * assumed.blur_px / np.array([18, 14])) ** 2)
    modulations = 0.5 * assumed.white_grey / 2 * (1500 / 2100) ** 2 * kept
    weights = (modulations * slopes) ** 2 / ((modulations * slopes) ** 2).sum() / slopes
    generator, errors = np.random.default_rng(2), []
    for _ in range(400):
        noise = generator.normal(0, assumed.noise_grey, (2, *window.shape))
        waves = np.exp(-2j * np.pi * np.stack([rows / 22.6, columns / 17.5]))
        values = modulations / 2 + (window * noise * waves).sum(axis=(1, 2))
        errors.append(weights @ np.angle(values))
    assert found.phase_mm == pytest.approx(np.std(errors), rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize("rig", [PAPER, TURNED, SIDEWAYS], ids=["paper", "turned", "sideways"])
def test_the_search_proposes_the_least_expected_error(rig):
    found = search(rig, Assumptions())
    pitches = [candidate.crossed.pitches_px[0] for candidate in found.searched]
    assert pitches == sorted(pitches) and len(pitches) > 5
    assert found.proposed.expected_mm == min(candidate.expected_mm for candidate in found.searched)
    for candidate in found.searched:
        assert all(6 <= seen <= 40 for seen in candidate.image_px)
        assert candidate.expected_mm == candidate.phase_mm + candidate.wrong_mm
        assert (
            max(candidate.turns) == pytest.approx(candidate.turns[0]) and candidate.turns[1] < 1.5
        )
    phases, orders = (
        np.array([getattr(one, f"{name}_mm") for one in found.searched])
        for name in ("phase", "wrong")
    )
    assert phases[0] < phases[-1] and orders[0] > orders[-1]
    blurred = search(rig, Assumptions(blur_px=2.0)).proposed
    assert blurred.crossed.pitches_px[0] > found.proposed.crossed.pitches_px[0]


def test_the_finer_crossed_rigs_have_farther_rivals_and_less_error_but_a_wall_that_looks_like_a_depth():
    found = {name: describe(PAPER, [family], Assumptions())[0] for name, family in CROSSED.items()}
    coarse, finer, finest = (found[f"crossed-{period}"] for period in (18, 12, 10))
    assert finer.rival_rad > 1.2 > finest.rival_rad > coarse.rival_rad > 0.95
    assert coarse.phase_mm > finer.phase_mm > finest.phase_mm
    assert max(finer.background_rad, finest.background_rad) < 0.05 < coarse.background_rad


def test_a_projector_that_looks_away_is_refused():
    away = replace(
        PAPER, rotation=((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)), background_m=None
    )
    with pytest.raises(RigError, match="no pixel sees the pattern"):
        EpipolarLines.of(away)


def test_a_pair_with_a_rival_too_near_is_not_proposed() -> None:
    """Over 0.6 to 3.1 m the finest periods have wrong orders within 0.15 rad; a coarser one has
    none."""
    deep = replace(PAPER, working_range_mm=(600.0, 3100.0))
    found = search(deep, Assumptions(), (8.0, 10.0, 12.0))
    assert [candidate.rival_rad < 0.15 for candidate in found.searched] == [True, True, False]
    assert found.proposed is found.searched[2]
    with pytest.raises(RigError, match=r"each of 2 periods has a wrong order within 0\.13 rad"):
        search(deep, Assumptions(), (8.0, 10.0))
