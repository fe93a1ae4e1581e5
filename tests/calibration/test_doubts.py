"""What a calibration says of itself: a sentence on what is improbable, and none where all is
right."""

import re

import numpy as np
import pytest
from calibration import rigs

from fpp_ml_bench.calibration.boards import parse_board
from fpp_ml_bench.calibration.solve import calibrate

BOARD = parse_board("checker:5x4:36")
NOISE_PX = 0.05


def doubts(poses, board=BOARD, sizes=(rigs.CAMERA_SIZE, rigs.PROJECTOR_SIZE), **options):
    return calibrate(poses, board, *sizes, hold_out=False, **options).doubts


def clean(points_mm=None, count=6):
    return rigs.poses(BOARD.points_mm() if points_mm is None else points_mm, count, NOISE_PX)


def shown(poses, change):
    """The poses with projector coordinates (n, 2) that ``change`` makes of the number of the pose
    and its own."""
    changed = []
    for number, pose in enumerate(poses):
        points = change(number, pose.projector.points_px)
        changed.append(pose._replace(projector=pose.projector._replace(points_px=points)))
    return changed


def keystone(across, down):
    """A picture that is corrected by these shares of its size."""
    size = np.array(rigs.PROJECTOR_SIZE)

    def change(_, points):
        place = points / size - 0.5
        return (place / (1 + place @ [across, down])[:, None] + 0.5) * size

    return change


def bent(sag_mm):
    points = BOARD.points_mm()
    points[:, 2] += sag_mm * ((points[:, 0] - 72) / 72) ** 2
    return points


@pytest.mark.parametrize(("count", "noise_px"), [(3, 0.0), (3, 0.4), (6, 0.05)])
def test_a_right_calibration_is_not_doubted(count, noise_px):
    assert doubts(rigs.poses(BOARD.points_mm(), count, noise_px)) == ()


@pytest.mark.long
def test_an_irregular_board_and_panels_of_oblong_pixels_are_not_doubted():
    irregular = BOARD.points_mm() + np.random.default_rng(3).normal(0, 0.08, (20, 3))
    assert doubts(clean(irregular)) == () == doubts(clean(irregular), estimate_board=True)
    halved = shown(clean(), lambda _, points: points / [1, 2] - [0, 0.25])
    assert doubts(halved, sizes=(rigs.CAMERA_SIZE, (912, 570))) == ()


@pytest.mark.long
@pytest.mark.parametrize(
    ("poses", "options", "said"),
    [
        (
            shown(clean(), keystone(0.15, 0.25)),
            {},
            r"warning: the projector's pixels seem skewed by .0\.\d+ px per px",
        ),
        (
            shown(clean(), keystone(-0.04, 0.06)),
            {},
            r"warning: the projector's pixels seem skewed .* explains \d\d%",
        ),
        (
            shown(clean(), keystone(0.15, 0.2)),
            {"estimate_board": True},
            "warning: the projector's pixels seem skewed",
        ),
        (
            shown(clean(), keystone(0, 0.3)),
            {},
            r"note: the projector's fx / fy is 1\.\d+, expected 0.99\d+ to 1.0",
        ),
        (
            clean(BOARD.points_mm() * [1, 1.02, 1]),
            {},
            r"columns seem farther apart than its rows by -(1\.9|2\.0)\d%",
        ),
        (
            clean(bent(1.5)),
            {},
            r"warning: the board's ends seem bent by \+(2\.[01]|1\.9)\d% of half its side",
        ),
        (clean(bent(1.5)), {"estimate_board": True}, None),
        (
            shown(clean(), lambda i, p: p + 3.0 * (i > 2)),
            {},
            r"fit alone \(0\.\d+ and 0\.\d+ px\), but not together",
        ),
        (shown(clean(), lambda i, p: p + 4.0 * (i == 4)), {}, r"not together .* worst in pose4"),
        (
            rigs.poses(BOARD.points_mm(), 6, 1.2),
            {},
            r"warning: RMS 1\.\d+ px in the camera, 1\.\d+ .* expected below 1",
        ),
    ],
)
def test_what_does_not_fit_is_named_with_its_figure(poses, options, said):
    found = " ".join(doubts(poses, **options))
    assert (said is None and not found) or re.search(said, found)


def test_one_cause_is_named_once():
    assert len(doubts(clean(bent(1.5)))) == 1


@pytest.mark.parametrize(
    ("factor", "figures"),
    [
        (0.1, r"baseline in mm is 18\.\d+, expected 30"),
        (1 / 25.4, "board's longer side in mm is 5.6"),
        (12, "side .* 1728"),
    ],
)
def test_a_board_in_another_unit_is_named(factor, figures):
    said = " ".join(doubts(clean(), parse_board(f"checker:5x4:{36 * factor}")))
    assert re.search(f"note: the .*{figures}", said) and "in mm (1 cm is 10, 1 inch 25.4)" in said


def test_a_part_of_a_larger_image_is_named():
    part = [
        pose._replace(size=(500, 600), corners_px=pose.corners_px - [500, 200]) for pose in clean()
    ]
    said = doubts(part, sizes=((500, 600), rigs.PROJECTOR_SIZE))
    assert len(said) == 1
    assert re.match(
        r"note: the camera's principal point from the middle, in sides, is 0\.2\d*, expected 0 to",
        said[0],
    )


def test_a_lens_that_bends_too_much_is_named():
    def change(_, points):
        from_axis = (points - [450, 500]) / 1400
        return points - 1400 * from_axis * (from_axis**2).sum(axis=1, keepdims=True) * 0.9

    assert "note: the projector's distortion is 0." in " ".join(doubts(shown(clean(), change)))
