"""The two theorems: frames that are the same bytes at two depths, and exponents against closed
forms."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fpp_ml_bench.baselines.diagnostics.scenes import SceneRenderer
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.optics.named_rigs import paper_rig

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from theory import DISTANCES_M, depth_error_mm, exponent, kappa_per_m, main, twins_of


@pytest.mark.parametrize("direction, other_frame", [("horizontal", 18), ("vertical", 0)])
def test_two_depths_give_the_same_bytes(direction, other_frame, opened):
    twins = twins_of(opened, SceneRenderer.of(opened), direction)
    inside = twins.depths_mm[0] > 0
    distance_mm = np.abs(twins.depths_mm[1] - twins.depths_mm[0])[inside]
    assert distance_mm.min() > 150 and ((twins.depths_mm[1] > 0) == inside).all()
    np.testing.assert_array_equal(twins.frames[0], twins.frames[1])
    assert (
        twins.other_frame == other_frame
        and (twins.other_frames[0] != twins.other_frames[1]).mean() > 0.01
    )
    assert 0 < twins.paint.min() <= twins.paint.max() <= 1


def test_no_room_for_a_period_is_said(opened):
    renderer = SceneRenderer.of(opened)
    renderer.rig = replace(renderer.rig, working_range_mm=(1700.0, 1900.0))
    with pytest.raises(DiagnosisError, match="no test object fits twice"):
        twins_of(opened, renderer)


@pytest.mark.parametrize("direction, baseline_m", [("horizontal", 0.1), ("vertical", 0.125)])
def test_one_period_against_the_closed_form(direction, baseline_m):
    rig, kappa = paper_rig(176), 18 / (1824 * baseline_m)
    assert kappa_per_m(rig, direction) == pytest.approx(kappa, rel=1e-12)
    for z in np.geomspace(0.3, 9.0, 50):
        away, toward = (depth_error_mm(rig, direction, z, periods) for periods in (1.0, -1.0))
        assert away == pytest.approx(1000 * z**2 * kappa / (1 - z * kappa), rel=1e-9)
        assert toward == pytest.approx(1000 * z**2 * kappa / (1 + z * kappa), rel=1e-9)
        # The closed form's own: Z^2 / (1 -+ Z kappa).
        assert exponent(rig, direction, z, 1.0) == pytest.approx(
            2 + z * kappa / (1 - z * kappa), rel=1e-6
        )
        assert exponent(rig, direction, z, -1.0) == pytest.approx(
            2 - z * kappa / (1 + z * kappa), rel=1e-6
        )
    beyond = 1.01 / kappa
    assert (
        depth_error_mm(rig, direction, beyond, 1.0) is None
        and exponent(rig, direction, beyond, 1.0) is None
    )


def test_the_exponent_is_two_where_the_mistake_is_small_and_the_baseline_thin():
    rig = paper_rig(176)
    for z in DISTANCES_M:
        assert exponent(rig, "horizontal", z, 1 / 64) == pytest.approx(2, rel=0.01)
    # With a projector 0.1 m behind, psi = gain / (Z + 0.1): the local exponent is 2 Z / (Z + 0.1)
    # for a small mistake.
    behind = replace(rig, translation_m=(*rig.translation_m[:2], rig.translation_m[2] + 0.1))
    assert exponent(behind, "horizontal", 0.5, 1 / 64) == pytest.approx(2 * 0.5 / 0.6, rel=0.01)


def test_the_script_says_both(opened, tmp_path, monkeypatch, capsys):
    drawn = tmp_path / "twins.png"
    monkeypatch.setattr(sys, "argv", ["theory.py", str(opened.path), "--picture", str(drawn)])
    assert main() == 0
    said = capsys.readouterr().out
    assert "fringe: 0 of " in said and "| a period, away | 1.8 |" in said
    assert drawn.stat().st_size > 5000
