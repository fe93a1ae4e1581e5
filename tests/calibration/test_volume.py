"""The depth error of a rig over another's range, against closed forms, and of rigs found from
photographed boards."""

from dataclasses import replace

import numpy as np
import pytest
from captures import rig_with

from fpp_ml_bench.calibration.projector_points import Pose, ProjectorPoints
from fpp_ml_bench.calibration.result import Lens
from fpp_ml_bench.calibration.solve import calibrate
from fpp_ml_bench.calibration.volume import (
    LENS_VALUES,
    Places,
    depth_spread,
    volume_error_mm,
)
from fpp_ml_bench.errors import CalibrationError
from fpp_ml_bench.loaders.render.boards.poses import board_poses, fitting_board
from fpp_ml_bench.optics.named_rigs import paper_rig

RIG = paper_rig(240)
DEPTHS_MM = np.linspace(1500, 2100, 9)


def test_a_rig_has_no_error_against_itself():
    error = volume_error_mm(RIG, RIG)
    assert error.worst_mm < 1e-9 and error.scale == pytest.approx(1, abs=1e-12)


def test_a_longer_baseline_scales_depth():
    longer = replace(RIG, translation_m=tuple(1.05 * t for t in RIG.translation_m))
    error = volume_error_mm(longer, RIG)
    assert error.scale == pytest.approx(1.05, abs=1e-12)
    assert error.worst_mm == pytest.approx(0.05 * 2100) and 0.05 * 1500 < error.rms_mm < 0.05 * 2100


def test_a_shifted_principal_point_of_one_direction_shifts_inverse_depth():
    """u_p = f (x + b / Z) + c: c + 1 px seen as c gives 1 / Z + 1 / (f b)."""
    wave = {"scheme": "phase-shift", "pitches_px": [18, 912], "steps": 3}
    true = rig_with({"vertical": wave}, 240)
    other = replace(true, projector=replace(true.projector, cx=true.projector.cx - 1))
    expected = 1 / (1 / DEPTHS_MM + 1 / (1824 * 125.0)) - DEPTHS_MM
    assert volume_error_mm(other, true).worst_mm == pytest.approx(np.abs(expected).max(), rel=1e-9)


def test_rigs_with_nothing_in_common_are_refused():
    with pytest.raises(CalibrationError, match="camera: expected 240 x 240"):
        volume_error_mm(paper_rig(480), RIG)
    with pytest.raises(CalibrationError, match="no depth by the other rig"):
        volume_error_mm(replace(RIG, translation_m=tuple(-t for t in RIG.translation_m)), RIG)


def test_an_unsure_baseline_leaves_a_share_of_every_depth():
    """Depth is proportional to the baseline, and nothing else is unsure."""
    parameters = 2 * (LENS_VALUES + len(RIG.camera.distortion)) + 6
    root = np.zeros((parameters, 2))
    root[-3:, 0] = 0.0006 * 1000 * RIG.t
    root[-3:, 1] = 0.0008 * 1000 * RIG.t
    places = Places.over(RIG)
    spread = depth_spread(places, root)
    expected = np.where(places.shown, 0.001 * places.depth_mm, np.nan)
    np.testing.assert_allclose(spread.mm, expected, rtol=1e-6)
    assert list(spread.maps(places)) == pytest.approx([1500, 1800, 2100])


@pytest.mark.long
def test_a_calibration_says_how_wrong_the_depth_by_it_is():
    """Twelve calibrations, each from other errors of the board's points: what their depths are off
    by has the size that their covariances state."""
    rig = paper_rig(300)
    board = replace(fitting_board(rig), detail_mm=0.0)
    exact = []
    for pose in board_poses(rig, board, 8):
        points = pose.points_m(board.points_mm() / 1000)
        image = rig.camera.fx * points[:, :2] / points[:, 2:]
        exact.append((image + np.array(rig.camera.centre), np.stack(rig.project(points), 1)))
    size, of_projector = ((device.width, device.height) for device in (rig.camera, rig.projector))
    relative, random = [], np.random.default_rng(3)
    for _ in range(12):
        poses = []
        for name, (image, shown) in enumerate(exact):
            shown = shown + random.normal(0, 0.1, shown.shape)
            unknown = np.zeros_like(shown), np.zeros((len(shown), 2, 2)), {}
            seen = image + random.normal(0, 0.04, image.shape)
            poses.append(Pose(f"{name}", size, seen, ProjectorPoints(shown, *unknown)))
        lenses = Lens("none"), Lens("none")
        found = calibrate(poses, board, size, of_projector, lenses, hold_out=False)
        own = found.applied_to(rig)
        error = Places.over(rig).found_mm(own) - Places.over(rig).depth_mm
        relative.append(error / depth_spread(Places.over(own), found.root).mm)
    # Points share a calibration's error, so that there are about twelve independent values.
    assert 0.6 < np.sqrt(np.nanmean(np.square(relative))) < 1.4
    assert np.nanmean(np.abs(relative) < 2) > 0.88
