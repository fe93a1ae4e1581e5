"""The projected patterns against the formula, and their PNG files."""

import numpy as np
import pytest
from conftest import read_image

from fpp_ml_bench.errors import FppBenchError, RigError
from fpp_ml_bench.files import write_files
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.patterns import (
    pattern_files,
    pattern_image,
    pattern_profile,
    pattern_profiles,
)
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import Sequence

SMALL = Rig(
    camera=Pinhole(24, 24, 50.0, 50.0, 11.5, 11.5),
    projector=Pinhole(64, 48, 90.0, 90.0, 31.5, 23.5),
    rotation=np.eye(3),
    translation_m=(0.12, -0.1, 0.0),
    pitch_horizontal_px=8.0,
    pitch_vertical_px=12.8,
    sequence=Sequence(4, 4, 4),
)


@pytest.mark.parametrize("direction, length", [("horizontal", 1140), ("vertical", 912)])
def test_sinusoids_are_the_paper_formula_within_rounding(direction, length):
    rig = paper_rig()
    w = np.arange(length)
    for n, index in enumerate(rig.sequence.sinusoids(direction)):
        exact = 127.5 + 127.5 * np.cos(2 * np.pi * w / 18 + 2 * np.pi * n / 18)
        profile = pattern_profile(rig, index)
        assert profile.dtype == np.uint8 and np.abs(profile - exact).max() <= 0.5 + 1e-9


def test_images_vary_along_the_right_axis_and_agree_with_the_profiles():
    table = pattern_profiles(SMALL)
    assert table.shape == (18, 64) and table.dtype == np.uint8
    for frame in SMALL.sequence:
        image, profile = pattern_image(SMALL, frame.index), pattern_profile(SMALL, frame.index)
        assert image.shape == (48, 64) and image.dtype == np.uint8
        lines = image.T if frame.direction == "horizontal" else image
        assert (lines == lines[0]).all() and np.array_equal(
            lines[0], np.broadcast_to(profile, lines[0].shape)
        )
        assert np.array_equal(table[frame.index, : len(profile)], profile)
        assert (table[frame.index, len(profile) :] == profile[-1]).all()
    assert pattern_image(SMALL, SMALL.sequence.black).max() == 0
    assert pattern_image(SMALL, SMALL.sequence.white).min() == 255


@pytest.mark.parametrize("index", [-1, 18, 1.0, True, None])
def test_frames_outside_the_sequence_are_refused(index):
    with pytest.raises(RigError, match="frames 0 to 17"):
        pattern_image(SMALL, index)


def test_export_is_lossless_and_in_order(tmp_path):
    paths = write_files(tmp_path / "patterns", pattern_files(SMALL), FppBenchError)
    assert [path.name for path in paths] == [f"A_{i:02}.png" for i in range(18)]
    for index, path in enumerate(paths):
        image = read_image(path)
        assert image.ndim == 2 and np.array_equal(image, pattern_image(SMALL, index))


def test_export_to_an_impossible_place_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(FppBenchError, match="can't be written"):
        write_files(tmp_path / "file" / "patterns", pattern_files(SMALL), FppBenchError)
