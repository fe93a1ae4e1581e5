"""Another reading of depth maps is named where it fits far better; of depths that are merely wrong
nothing is said."""

import numpy as np
import pytest

from fpp_ml_bench.depth_readings import another_reading, glance
from fpp_ml_bench.optics.named_rigs import paper_rig

SIZE = 90
CAMERA = paper_rig(SIZE).camera
ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE].astype(float)
ALONG = np.sqrt(
    1 + ((COLUMNS - CAMERA.cx) / CAMERA.fx) ** 2 + ((ROWS - CAMERA.cy) / CAMERA.fy) ** 2
)
NOISE = np.random.default_rng(0).normal(0, 1, (6, SIZE, SIZE))


def scene(number):
    """A tilted plate with a step, which lies elsewhere and is turned in each view."""
    across, down = COLUMNS - 20 - 8 * number, ROWS - 15 - 5 * number
    inside = (across >= 0) & (across < 42 - 3 * number) & (down >= 0) & (down < 50 - 6 * number)
    return np.where(inside, 1700 + (3 + number) * across + 2 * down + 60 * (down > 20), 0.0)


TRUE = np.stack([scene(number) for number in range(6)])
RIGHT = np.where(TRUE > 0, TRUE + NOISE, 0)


def reading(given, true=TRUE):
    seen = [
        glance(f"cork_A{60 * n}", *pair, None, CAMERA)
        for n, pair in enumerate(zip(given, true, strict=True))
    ]
    return another_reading("the maps", seen)


READ = {
    "upside down": RIGHT[:, ::-1],
    "mirrored left to right": RIGHT[:, :, ::-1],
    "turned by 180 degrees": RIGHT[:, ::-1, ::-1],
    "transposed": RIGHT.swapaxes(1, 2),
    "turned to the right": np.rot90(RIGHT, 1, (1, 2)),
    "turned to the left": np.rot90(RIGHT, -1, (1, 2)),
    "in cm": RIGHT / 10,
    "in inches": RIGHT / 25.4,
    "in micrometres": RIGHT * 1000,
    "negative": -RIGHT,
    "upside down, negative": -RIGHT[:, ::-1],
    "cork_A0 has that of cork_A60": np.roll(RIGHT, -1, axis=0),
    "cork_A60 has that of cork_A180": RIGHT[[0, 3, 2, 1, 4, 5]],
    "as disparity": np.divide(3e5, RIGHT, out=np.zeros_like(RIGHT), where=RIGHT > 0),
    "as heights above a plane": np.where(RIGHT > 0, 2500 - RIGHT, 0),
    "as distances along the ray": RIGHT * ALONG,
}


@pytest.mark.parametrize("words", READ)
def test_the_reading_is_named(words):
    assert f"the maps far better: {words}" in reading(READ[words]).replace(
        "as those of other samples (", ""
    )


MERELY_WRONG = {
    "right": RIGHT,
    "too deep": np.where(TRUE > 0, RIGHT + 8, 0),
    "a constant": np.full_like(TRUE, 1800),
    "the depth of one sample for all": np.repeat(RIGHT[:1], 6, axis=0),
    "noise": 1500 + 600 * np.random.default_rng(1).random(TRUE.shape),
    "wrong orders": np.where((TRUE > 0) & (NOISE > 1), RIGHT + 256, RIGHT),
    "half of the object": np.where(COLUMNS < 45, RIGHT, 0),
    "deeper towards the right": np.where(TRUE > 0, RIGHT + 0.3 * COLUMNS, 0),
}


@pytest.mark.parametrize("case", MERELY_WRONG)
def test_nothing_is_said_of(case):
    assert reading(MERELY_WRONG[case]) is None


def test_distances_are_found_despite_noise_and_wrong_orders():
    given = np.where(TRUE > 0, TRUE * ALONG + 4 * NOISE + 256 * (NOISE > 2), 0)
    assert "as distances along the ray" in reading(given)


def test_no_object_and_an_image_that_is_not_square():
    assert reading(RIGHT, TRUE * 0) is None
    assert "upside down" in reading(RIGHT[:, ::-1, :70], TRUE[:, :, :70])
    assert another_reading("nothing", []) is None
