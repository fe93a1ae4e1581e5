"""A crossed frame that audits its own calibration: the projector is changed, the rig's file is not."""

from dataclasses import replace

import numpy as np
import pytest
from crossed_scenes import RIG, frame, route, slab

from fpp_ml_bench.baselines.phase.audit import CERTAIN, measure_audited
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.errors import DecodeError, PredictionError
from fpp_ml_bench.optics.rig import Rig, rotation_matrix

ROLL_DEG, ZOOM_PERCENT = 0.2, -0.3
"""About 1 px of the projector at the border of the working range."""


def surface() -> np.ndarray:
    """A tilted slab with waves of 20 mm."""
    depth_mm = slab()
    y, x = np.mgrid[: depth_mm.shape[0], : depth_mm.shape[1]]
    return np.where(depth_mm > 0, depth_mm + 20 * np.sin(x / 25) * np.cos(y / 30), 0.0)


def rolled(degrees: float) -> Rig:
    turn = rotation_matrix((0.0, 0.0, np.deg2rad(degrees)))
    rows = tuple(map(tuple, (turn @ RIG.R).tolist()))
    return replace(RIG, rotation=rows, translation_m=tuple((turn @ RIG.t).tolist()))


def with_projector(**changes: float) -> Rig:
    return replace(RIG, projector=replace(RIG.projector, **changes))


def zoomed(percent: float) -> Rig:
    factor = 1 + percent / 100
    return with_projector(fx=RIG.projector.fx * factor, fy=RIG.projector.fy * factor)


def errors_mm(measured, depth_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    known = (measured.depth_mm > 0) & (depth_mm > 0)
    assert known.sum() > 0.9 * (depth_mm > 0).sum()
    return np.abs(measured.depth_mm - depth_mm)[known], measured.sigma_mm[known]


def test_a_right_calibration_loses_nothing() -> None:
    image = frame(surface())
    plain, (measured, audit) = route().measure(image), measure_audited(route(), image)
    np.testing.assert_array_equal(measured.depth_mm, plain.depth_mm)
    assert (measured.sigma_mm >= plain.sigma_mm).all()
    for size, sigma in (audit.roll_deg, audit.zoom_percent):
        assert abs(size) < CERTAIN * sigma
    assert audit.across_px[0] < 0.1


@pytest.mark.long
@pytest.mark.parametrize(
    ("rig", "roll_deg", "zoom_percent"),
    [(rolled(ROLL_DEG), ROLL_DEG, 0.0), (zoomed(ZOOM_PERCENT), 0.0, ZOOM_PERCENT)],
    ids=["roll", "zoom"],
)
def test_roll_and_zoom_are_found_and_corrected(
    rig: Rig, roll_deg: float, zoom_percent: float
) -> None:
    depth_mm = surface()
    image = frame(depth_mm, rig)
    before, _ = errors_mm(route().measure(image), depth_mm)
    measured, audit = measure_audited(route(), image)
    after, sigma_mm = errors_mm(measured, depth_mm)
    assert np.median(after) < 0.4 * np.median(before)
    assert (after < 1.96 * sigma_mm).mean() > 0.9
    for (size, sigma), true in ((audit.roll_deg, roll_deg), (audit.zoom_percent, zoom_percent)):
        assert size == pytest.approx(true, abs=3 * sigma)
    assert audit.across_px[1] < 0.5 * audit.across_px[0]
    assert "across the epipolar lines" in audit.report()["audit"]["says"]


@pytest.mark.long
def test_a_frame_that_no_small_motion_explains_is_refused() -> None:
    image = frame(surface(), rolled(4.0))
    _, audit = measure_audited(route(), image)
    assert not audit.fits and audit.report()["audit"]["says"] == audit.finding
    frames = [None] * len(RIG.sequence)
    frames[RIG.sequence.crossed_frames[0]] = image
    with pytest.raises(DecodeError, match=r"calibration does not fit.*calibrate again"):
        load_method("crossed", RIG, audit=True).answer(frames)
    answer = load_method("crossed", RIG, audit=True, anyway=True).answer(frames)
    assert answer.depth.any() and "does not fit" in answer.report["audit"]["says"]
    with pytest.raises(PredictionError, match="--anyway: expected --audit"):
        load_method("crossed", RIG, anyway=True)


def test_what_lies_along_the_lines_is_not_seen_and_stated() -> None:
    """A principal point that is off moves all points alike: across the lines that is seen."""
    depth_mm = surface()
    rig = with_projector(cx=RIG.projector.cx + 0.7, cy=RIG.projector.cy + 0.7)
    image = frame(depth_mm, rig)
    before, plain_mm = errors_mm(route().measure(image), depth_mm)
    measured, audit = measure_audited(route(), image)
    after, sigma_mm = errors_mm(measured, depth_mm)
    assert np.median(after) == pytest.approx(np.median(before), rel=0.05)
    assert np.median(sigma_mm) > 1.2 * np.median(plain_mm)
    assert (after < 1.96 * sigma_mm).mean() > 0.9
    assert audit.along_px > 0.3


def test_an_image_without_points_says_nothing() -> None:
    image = np.full(frame(surface()).shape, 40, np.uint8)
    measured, audit = measure_audited(route(), image)
    assert not measured.depth_mm.any() and audit.points == 0
    assert audit.report()["audit"]["says"] == "too few points to audit the calibration"


@pytest.mark.long
@pytest.mark.parametrize("name", ["crossed", "fringe-net"])
def test_a_method_reports_its_audit(name: str) -> None:
    method = load_method(name, RIG, audit=True)
    assert method.reports and method.settings["audit"] is True
    assert "audit" not in load_method(name, RIG).settings
    answer = method.answer([frame(surface(), zoomed(ZOOM_PERCENT))] + [None] * 60)
    found, sigma = answer.report["audit"]["zoom_percent"]
    assert found == pytest.approx(ZOOM_PERCENT, abs=3 * sigma) and abs(found) > CERTAIN * sigma


def test_one_carrier_has_nothing_to_audit() -> None:
    with pytest.raises(PredictionError, match="--audit needs a frame of two carriers"):
        load_method("fringe-net", RIG, fringes="vertical", audit=True)
