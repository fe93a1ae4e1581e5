"""The response of projector and camera from photographed boards, against the light that
photographed."""

import pytest
from captures import rig_with

from fpp_ml_bench.calibration.projector_points import fit_response
from fpp_ml_bench.loaders.captures.decoding import board_poses
from fpp_ml_bench.loaders.render.boards.captures import photograph_board
from fpp_ml_bench.loaders.render.boards.poses import board_poses as poses_of
from fpp_ml_bench.loaders.render.boards.poses import fitting_board
from fpp_ml_bench.loaders.render.light import named_light

pytestmark = pytest.mark.long


@pytest.mark.parametrize("gamma", [1.0, 1.6])
def test_gamma_is_that_of_the_light(tmp_path, gamma):
    wave = {"scheme": "phase-shift", "steps": [4, 8]}
    codes = {
        "order": ["vertical", "horizontal", "white"],
        "vertical": {**wave, "pitches_px": [24, 912]},
        "horizontal": {**wave, "pitches_px": [24, 1140]},
    }
    rig = rig_with(codes, 480)
    board = fitting_board(rig)
    light = named_light("paper").changed("projector", response=gamma)
    photograph_board(tmp_path / "boards", rig, board, poses_of(rig, board, 3), light)
    *_, response = board_poses(tmp_path / "boards", board, tmp_path / "boards" / "rig.yaml")
    assert response.gamma == pytest.approx(gamma, abs=0.03)
    assert 0 < response.sigma < 0.01 and response.misfit_grey < 3 and 50 < response.white_grey < 255


def test_no_captures_have_no_response():
    assert fit_response([]) is None
