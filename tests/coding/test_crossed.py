"""Crossed fringes: two carriers in a frame, in a rig file, as an image, and as the mean of a pair
of frames."""

import numpy as np
import pytest
from captures import rig_with

from fpp_ml_bench.coding.crossed import Crossed, crossed_from_pair
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.errors import DecodeError, RigError
from fpp_ml_bench.optics.named_rigs import crossed_rig, paper_rig
from fpp_ml_bench.optics.patterns import pattern_image, pattern_profile
from fpp_ml_bench.optics.rig_file import load_rig, save_rig
from fpp_ml_bench.optics.sequence import CodedSequence

FAMILY = {
    "pitches_px": [18, 14.5],
    "angles_deg": [30, 100],
    "weights": [0.6, 0.3],
    "shifts_deg": [[0, 0], [120, 45]],
}


def rig_of(**sequence):
    return rig_with(sequence, 64)


def test_each_frame_is_the_sum_of_two_shifted_carriers():
    family = Crossed.from_entries(FAMILY)
    v, u = np.mgrid[:40, :50]
    for n, shifts_deg in enumerate(FAMILY["shifts_deg"]):
        expected = np.full((40, 50), 127.5)
        for pitch_px, angle_deg, weight, shift_deg in zip(
            FAMILY["pitches_px"], FAMILY["angles_deg"], FAMILY["weights"], shifts_deg, strict=True
        ):
            angle = np.radians(angle_deg)
            along = (v * np.cos(angle) + u * np.sin(angle)) / pitch_px
            expected += 127.5 * weight * np.cos(2 * np.pi * along + np.radians(shift_deg))
        image = family.image(50, 40, n)
        assert image.dtype == np.uint8 and image.shape == (40, 50)
        assert np.abs(image - expected).max() <= 0.5 + 1e-9
    (f_u, f_v), (g_u, g_v) = family.cycles_per_px
    np.testing.assert_allclose([f_u * 18, f_v * 18], [0.5, np.sqrt(3) / 2])
    np.testing.assert_allclose(np.hypot(g_u, g_v), 1 / 14.5)


def test_a_rig_file_holds_crossed_fringes_beside_codes_or_alone(tmp_path):
    wave = {"scheme": "phase-shift", "pitch_px": 57, "steps": 3}
    for sequence in (
        {"crossed": FAMILY},
        {"order": ["crossed", "vertical", "black"], "crossed": FAMILY, "vertical": wave},
    ):
        rig = rig_of(**sequence)
        save_rig(rig, tmp_path / "rig.yaml")
        assert load_rig(tmp_path / "rig.yaml") == rig
        indices = rig.sequence.config("crossed")
        assert [rig.sequence.frames[i].kind for i in indices] == ["crossed"] * len(rig.crossed)
        assert rig.sequence.config("single_shot") == indices[:1]
        for n, index in enumerate(indices):
            assert np.array_equal(pattern_image(rig, index), rig.crossed.image(912, 1140, n))
    alone = rig_of(crossed=FAMILY)
    assert alone.directions == () and alone.crossed == Crossed.from_entries(FAMILY)
    with pytest.raises(DecodeError, match="crossed fringes alone can't be decoded"):
        decode_stack(np.zeros((2, 64, 64), np.uint8), alone)
    with pytest.raises(RigError, match="an image, no profile"):
        pattern_profile(alone, 0)
    with pytest.raises(RigError, match="projects crossed fringes alone"):
        alone.pitch("vertical")


def test_the_crossed_rig_is_the_papers_with_three_frames_before_its_own():
    rig, paper = crossed_rig(96), paper_rig(96)
    assert rig.sequence.config("crossed") == (0, 1, 2) and rig.sequence.config("single_shot") == (
        0,
    )
    assert paper.sequence.config("crossed") == () and paper.crossed is None
    assert isinstance(rig.sequence, CodedSequence) and len(rig.sequence) == 55
    for direction in ("horizontal", "vertical"):
        assert rig.code(direction) == paper.code(direction) and rig.code(direction).is_plain
        for own, of_paper in zip(
            rig.sequence.coded(direction), paper.sequence.coded(direction), strict=True
        ):
            assert np.array_equal(pattern_image(rig, own), pattern_image(paper, of_paper))
    cycles = [rig.image_px_of_carrier(cycles) for cycles in Crossed((18.0, 18.0)).cycles_per_px]
    np.testing.assert_allclose(
        cycles, [rig.image_px_per_period(d) for d in ("horizontal", "vertical")]
    )
    with pytest.raises(RigError, match=r"carrier 1 covers only 2\.51 px of a 160 px image"):
        crossed_rig(160).check_sampling()


def test_a_pair_of_frames_makes_the_crossed_frame_of_its_family():
    assert Crossed.of_pair(paper_rig()) == Crossed((18.0, 18.0))
    wave = {"scheme": "phase-shift", "pitch_px": 57, "shifts_deg": [30, 150, 270], "origin_px": 5}
    rig = rig_of(horizontal=wave, vertical={**wave, "pitch_px": 48, "origin_px": 0})
    made = crossed_from_pair(pattern_image(rig, 0), pattern_image(rig, 3))
    assert made.dtype == np.uint8
    assert np.abs(made.astype(int) - Crossed.of_pair(rig).image(912, 1140, 0)).max() <= 1
    with pytest.raises(RigError, match="two uint8 images"):
        crossed_from_pair(np.zeros((3, 4)), np.zeros((3, 4), np.uint8))


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"pitches_px": [18, 2]}, "crossed.pitches_px: expected 4 px and more"),
        ({"pitches_px": [18, 3000]}, "exceeds the pattern of 912 x 1140 px"),
        ({"angles_deg": [0, 182]}, "0 and 182 degrees are parallel"),
        ({"weights": [0.7, 0.4]}, "weights: expected two above 0 with a sum of at most 1"),
        ({"shifts_deg": []}, "a pair of degrees for each frame"),
        ({"shifts_deg": [[0, 0], [120]]}, r"shifts_deg\[1\]: expected 2 numbers"),
        ({"steps": 3}, "crossed.steps: unknown key"),
    ],
)
def test_a_family_that_is_none_is_refused(changes, said):
    with pytest.raises(RigError, match=said):
        rig_of(crossed={**FAMILY, **changes})


@pytest.mark.parametrize(
    "sequence, said",
    [
        ({"order": ["black"], "crossed": FAMILY}, "crossed missing"),
        (
            {"order": ["crossed", "vertical"], "crossed": FAMILY},
            "expected each of crossed, black, white at most once",
        ),
        ({"crossed": 3}, "crossed: expected a mapping with the keys pitches_px"),
    ],
)
def test_an_order_that_does_not_fit_is_refused(sequence, said):
    with pytest.raises(RigError, match=said):
        rig_of(**sequence)
