"""The epipolar residual as a whole: what moved since the calibration is named with its size, and
nothing else is."""

from dataclasses import replace

import numpy as np
import pytest
from captures import capture, rig_with, tilted

from fpp_ml_bench.examination.examine import examine
from fpp_ml_bench.optics.rig import rotation_matrix

pytestmark = pytest.mark.long

RIG = rig_with({"steps": 6, "bits_horizontal": 7, "bits_vertical": 7})
CAMERA = RIG.camera


def turned(*degrees):
    """The pose after a turn of the camera about its x, y and z axes."""
    rotation = RIG.R @ rotation_matrix(tuple(np.deg2rad(degrees)))
    return replace(RIG, rotation=tuple(tuple(row) for row in rotation.tolist()))


def examined(shown, rig=RIG, **options):
    """Of frames that the rig ``shown`` took, read by ``rig``."""
    return examine(np.stack(capture(shown, tilted(shown))), rig, **options)


@pytest.mark.parametrize(
    "shown, said",
    [
        (turned(0, 0, 0.6), "camera: a roll by 0.60 degrees"),
        (
            replace(RIG, camera=replace(CAMERA, fx=0.97 * CAMERA.fx, fy=0.97 * CAMERA.fy)),
            "length -3.0",
        ),
        (
            replace(RIG, camera=replace(CAMERA, cx=CAMERA.cx - 12, cy=CAMERA.cy - 9)),
            "another window or principal point",
        ),
        (turned(0.4, 0, 0), "a turn by 0.4"),
    ],
)
def test_what_moved_is_named_with_its_size(shown, said):
    (finding,) = (found for found in examined(shown).findings if found.name == "calibration")
    assert said in str(finding) and "epipolar" in finding.evidence


def test_a_large_pattern_is_refused_and_a_small_one_is_in_the_uncertainty():
    assert [finding.severity for finding in examined(turned(0, 0, 3)).findings] == ["refuse"]
    small = examined(turned(0, 0, 0.6))
    assert [finding.severity for finding in small.findings] == ["note"]
    rms_px = float(small.findings[0].evidence.split(" by ")[1].split()[0])
    for direction in RIG.directions:
        assert small.systematic_rad[direction] == pytest.approx(
            2 * np.pi * rms_px / RIG.pitch(direction), rel=0.01
        )


def test_a_right_calibration_gives_no_finding_and_one_direction_says_what_it_can_not_tell():
    both, one = examined(RIG), examined(RIG, directions=("vertical",))
    assert both.findings == one.findings == () and both.not_checked == ()
    listed = " ".join(one.not_checked)
    assert "another window of a sensor" in listed and "moved, turned or zoomed" in listed


def test_a_pattern_that_nothing_explains_has_no_cause():
    frames = np.stack(capture(RIG, tilted(RIG)))
    # The horizontal fringes are bent by a wave over the image.
    shift = np.rint(2 * np.sin(2 * np.pi * np.arange(200) / 200)).astype(int)
    bent = frames.copy()
    for index in RIG.sequence.coded("horizontal"):
        for column, down in enumerate(shift):
            bent[index, :, column] = np.roll(frames[index, :, column], down)
    (finding,) = examine(bent, RIG).findings
    assert finding.name == "calibration" and "no cause that was tried fits" in str(finding)
