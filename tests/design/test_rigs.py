"""Drawn rigs: the same numbers for the same seed, no broken rule, and each rule found where it is
broken on purpose."""

from dataclasses import replace

import numpy as np
import pytest

from fpp_ml_bench.design.rigs import (
    axes_deg,
    broken_rule,
    coverage,
    drawn_rig,
)
from fpp_ml_bench.design.search import LEAST_RIVAL_RAD, Assumptions, describe
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.rig_file import rig_from_dict


@pytest.mark.long
def test_a_drawn_rig_is_one_that_a_lab_could_own() -> None:
    rig, again = (drawn_rig(np.random.default_rng([5, 3])) for _ in range(2))
    assert rig == again == rig_from_dict(rig.to_dict())
    assert broken_rule(rig) is None
    assert rig.crossed is not None and len(rig.crossed) == 3
    assert {len(rig.sequence.sinusoids(way)) for way in rig.directions} == {18}
    (candidate,) = describe(rig, [rig.crossed], Assumptions())
    assert candidate.rival_rad >= LEAST_RIVAL_RAD
    assert drawn_rig(np.random.default_rng([5, 4])) != rig


def test_coverage_and_angle_are_those_of_the_geometry() -> None:
    rig = paper_rig()
    assert coverage(rig, rig.standoff_m) == pytest.approx(
        8 / 9
    )  # the projector sees it but for a rim
    beside = np.degrees(np.arctan(rig.baseline_m / rig.standoff_m))
    assert axes_deg(rig) == pytest.approx(beside, rel=1e-6)
    half = replace(rig, projector=replace(rig.projector, fx=16 * 1824.0, fy=16 * 1824.0))
    assert coverage(half, rig.standoff_m) < 0.1


def changed(**camera: float) -> Rig:
    rig = paper_rig()
    return replace(rig, camera=replace(rig.camera, **camera))


BROKEN = {
    "sees the pattern": changed(fx=700.0, fy=700.0),
    "blur": replace(
        changed(fx=6000.0, fy=6000.0), working_range_mm=(1100.0, 2100.0), standoff_m=1.8
    ),
    "axes meet": replace(paper_rig(), translation_m=(0.02, -0.02, 0.0)),
    "projector px": replace(
        paper_rig(), projector=replace(paper_rig().projector, fx=400.0, fy=400.0)
    ),
}


@pytest.mark.parametrize("words", BROKEN)
def test_a_broken_rule_is_named(words: str) -> None:
    assert words in str(broken_rule(BROKEN[words]))
