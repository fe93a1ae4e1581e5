"""Coding schemes: patterns in, coordinates out, against `fringes`-free closed forms, OpenCV, and
themselves."""

import math

import cv2
import numpy as np
import pytest
import yaml
from captures import rig_with

from fpp_ml_bench.coding.code import Limits, Reason
from fpp_ml_bench.coding.gray_code import GrayCells, GrayOnly
from fpp_ml_bench.errors import DecodeError, RigError
from fpp_ml_bench.optics.patterns import pattern_image
from fpp_ml_bench.optics.rig_file import load_rig, save_rig
from fpp_ml_bench.optics.sequence import SCHEMES, CodedSequence, code_from_dict

LENGTH = 912
LIMITS = Limits()
CODES = yaml.safe_load("""
unit cue: {scheme: phase-shift, pitches_px: [57, 912], steps: 3, sign: -1}
hierarchy: {scheme: phase-shift, pitches_px: [1000, 200, 25], steps: [4, 4, 6]}
heterodyne: {scheme: phase-shift, pitches_px: [42, 45, 48], steps: 4}
number-theoretical: {scheme: phase-shift, pitches_px: [29, 33], steps: 5}
own shifts: {scheme: phase-shift, pitch_px: 24, shifts_deg: [0, 90, 200, 250], gray: {}}
whole-period cells: {scheme: phase-shift, pitch_px: 24, steps: 4, gray: {cell_px: 24}}
inverses: {scheme: phase-shift, pitch_px: 36, steps: 3, gray: {inverse: after all}}
origin: {scheme: phase-shift, pitches_px: [60, 920], steps: 4, origin_px: -3.5}
gray alone: {scheme: gray, cell_px: 2}
gray in pairs: {scheme: gray, cell_px: 4, inverse: after each, least_first: true}
gray centred: {scheme: gray, cell_px: 1, bits: 10, origin_px: -56}
cells of another origin:
  {scheme: phase-shift, pitch_px: 18, steps: 6, gray: {origin_px: -4.5, least_first: true}}
the paper's: {scheme: phase-shift, pitch_px: 18, steps: 18, gray: {}}
""")


def code_of(name):
    return code_from_dict(CODES[name], LENGTH, "code")


def seen(code, position_px, mean=120.0, amplitude=100.0, noise=0.0, seed=0):
    """Grey levels at sub-pixel positions of the patterns, with black and white where the code needs
    them."""
    profiles = code.profiles(LENGTH).astype(float)
    if code.needs_flat:
        profiles = np.vstack([profiles, np.zeros(LENGTH), np.full(LENGTH, 255.0)])
    levels = np.stack([np.interp(position_px, np.arange(LENGTH), row) for row in profiles])
    grey = mean + amplitude * (levels / 127.5 - 1)
    return (grey + np.random.default_rng(seed).normal(0, noise, grey.shape)).astype(np.float32)


@pytest.mark.parametrize("name", CODES)
def test_a_code_gives_its_own_pixels_back(name):
    code, pixels = code_of(name), np.arange(LENGTH, dtype=float)
    found = code.decode(seen(code, pixels, 127.5, 127.5), LENGTH, Limits(max_clipped_steps=20))
    good = found.reason == Reason.DECODED
    assert good.mean() > (0.9 if name == "whole-period cells" else 0.99)
    # 8-bit patterns are rounded to half a grey level of 127.5; a cell knows its pixels to half its
    # width.
    bound = code.cell_px / 2 if isinstance(code, GrayOnly) else 0.05
    assert np.abs(found.coordinate_px - pixels)[good].max() <= bound
    assert code.step_px == (bound if isinstance(code, GrayOnly) else 0)


@pytest.mark.parametrize("name", [name for name in CODES if not name.startswith("gray")])
def test_noise_is_what_the_code_says_and_no_order_slips(name):
    code, position = code_of(name), np.random.default_rng(3).uniform(5, LENGTH - 6, 20_000)
    found = code.decode(seen(code, position, noise=1.0), LENGTH, LIMITS)
    good = found.reason == 0
    error = found.coordinate_px[good] - position[good]
    assert good.mean() > 0.85 and np.abs(error).max() < 0.3 * code.pitch_px
    stated = float(code.sigma_px(100.0, 1.0))
    rounding = 0.29 * 100 / 127.5  # of the 8-bit patterns, in grey levels here
    assert np.sqrt(np.mean(error**2)) == pytest.approx(stated * math.hypot(1, rounding), rel=0.2)


def test_gray_frames_are_opencvs():
    frames = GrayCells(1, 10, "after each").profiles(912)
    done, patterns = cv2.structured_light.GrayCodePattern.create(912, 4).generate()
    assert done and np.array_equal(frames, [pattern[0] for pattern in patterns[:20]])


def test_cells_begin_at_their_origin_and_either_bit_comes_first():
    centred, usual = GrayCells(1, 10, origin_px=-56).profiles(912), GrayCells(1, 10).profiles(1024)
    assert np.array_equal(centred, usual[:, 56:968])
    assert np.array_equal(GrayCells(1, 10, least_first=True).profiles(1024), usual[::-1])
    # 3 px per cell from -4: pixels 0 and 1 are the rest of cell 1, and the last pixel is alone in
    # cell 305.
    cells = GrayCells.from_entries({"cell_px": 3, "origin_px": -4}, LENGTH)
    assert cells.bits == 9 and cells.centre_px(np.array([0, 1, 2, 305, 306]), LENGTH)[
        1:4
    ].tolist() == [0.5, 3, 911]
    assert np.isnan(cells.centre_px(np.array([0, 306]), LENGTH)).all()


def test_a_rig_dictionary_names_only_what_is_unusual():
    usual = {"cell_px": 2, "bits": 9, "inverse": "none"}
    assert GrayCells(2, 9).to_dict() == usual
    assert GrayCells(2, 9, "none", -3.0, True).to_dict() == {
        **usual,
        "origin_px": -3.0,
        "least_first": True,
    }


def test_pairs_need_no_white_and_black():
    rig = coded_rig(vertical=CODES["gray in pairs"], order=["vertical"])
    code = rig.code("vertical")
    assert len(rig.sequence) == 16 and not code.needs_flat and code_of("gray alone").needs_flat
    levels = seen(code, np.full(4, 301.5))
    levels[:, 0] = 100.0  # no light of the projector
    levels[:, 1] = 255.0
    levels[:2, 2] = 255.0  # both of one pair
    found = code.decode(levels, LENGTH, LIMITS)
    assert found.reason.tolist() == [
        Reason.LOW_MODULATION,
        Reason.LOW_MODULATION,
        Reason.SATURATED,
        Reason.DECODED,
    ]
    assert found.coordinate_px[3] == 301.5 and found.modulation[3] == pytest.approx(100)


def test_dark_saturated_and_contradicting_pixels_have_their_reason():
    code = code_of("hierarchy")
    position = np.full(4, 300.25)
    levels = seen(code, position)
    levels[:, 0] = 100.0
    levels[:, 1] = 255.0
    levels[4:8, 2] = levels[4:8, 2][::-1] + 40 * np.array([1, -1, -1, 1])
    found = code.decode(levels, LENGTH, LIMITS)
    assert found.reason.tolist()[:2] == [Reason.LOW_MODULATION, Reason.LOW_MODULATION]
    assert found.reason[3] == Reason.DECODED and found.coordinate_px[3] == pytest.approx(
        300.25, abs=0.05
    )
    bright = seen(code, position, mean=200, amplitude=100).clip(0, 255)
    assert (code.decode(bright, LENGTH, LIMITS).reason == Reason.SATURATED).all()


def test_a_single_period_shorter_than_the_pattern_has_no_order():
    position = np.array([100.0, 500.0])

    def found(pitch_px):
        wave = {"scheme": "phase-shift", "pitch_px": pitch_px, "steps": 4}
        code = code_from_dict(wave, LENGTH, "code")
        return code.decode(seen(code, position), LENGTH, LIMITS)

    assert (found(57).reason == Reason.INCONSISTENT_ORDER).all()
    np.testing.assert_allclose(found(912).coordinate_px, position, atol=0.6)


def test_fewer_than_three_steps_are_no_phase():
    code = code_from_dict({"scheme": "phase-shift", "pitch_px": 57, "steps": 1}, LENGTH, "code")
    assert len(code.profiles(LENGTH)) == 1
    with pytest.raises(DecodeError, match=r"1 step\(s\); a phase needs at least 3"):
        code.decode(np.zeros((1, 5), np.uint8), LENGTH, LIMITS)


def coded_rig(**sequence):
    return rig_with(sequence, 64, background_m=..., standoff_m=...)


@pytest.mark.parametrize("name", CODES)
def test_a_rig_file_holds_every_code(name, tmp_path):
    rig = coded_rig(order=["white", "vertical", "black"], vertical=CODES[name])
    save_rig(rig, tmp_path / "rig.yaml")
    assert load_rig(tmp_path / "rig.yaml") == rig
    assert isinstance(rig.sequence, CodedSequence) and rig.directions == ("vertical",)
    assert rig.background_m is None
    assert len(rig.sequence) == len(rig.code("vertical").shown) + 2 and rig.sequence.white == 0
    assert np.array_equal(pattern_image(rig, 1)[0], rig.code("vertical").profiles(912)[0])
    assert rig.code("vertical").scheme in SCHEMES


def test_a_direction_that_is_not_projected_is_named():
    rig = coded_rig(vertical=CODES["unit cue"])
    assert rig.pitch("vertical") == 57 and rig.standoff_m == 1.8
    with pytest.raises(RigError, match="vertical fringes, and no horizontal ones"):
        rig.pitch("horizontal")
    with pytest.raises(RigError, match="background_m: missing"):
        _ = rig.background


def test_single_frames_are_described_and_made_but_not_decoded_pixel_by_pixel():
    x = np.arange(912)
    rig = coded_rig(vertical={"scheme": "composite", "pitches_px": [18, 22]})
    expected = 127.5 + 63.75 * (np.cos(2 * np.pi * x / 18) + np.cos(2 * np.pi * x / 22))
    assert np.abs(pattern_image(rig, 0)[0] - expected).max() <= 0.51 and rig.pitch("vertical") == 18
    with pytest.raises(DecodeError, match="pixel by pixel"):
        rig.code("vertical").decode(np.zeros((1, 4), np.uint8), LENGTH, LIMITS)


WAVE = "vertical: {scheme: phase-shift, pitch_px: 18"


@pytest.mark.parametrize(
    "text, said",
    [
        ("order: [vertical]", "no direction is coded"),
        ("vertical: {scheme: magic}", "vertical.scheme: expected phase-shift, gray"),
        (f"{WAVE}}}", "steps: missing"),
        (f"{WAVE}, steps: 3, sign: 0}}", "sign: expected 1"),
        (f"{WAVE}, steps: 3, colour: 1}}", "colour: unknown key"),
        (f"{WAVE}, steps: 3, shifts_deg: [0]}}", "not both"),
        (
            "vertical: {scheme: phase-shift, pitches_px: [18, 36], steps: [3]}",
            "each of 2 periods",
        ),
        (f"{WAVE}, steps: 3, gray: {{bits: 2}}}}", "need 7 bits"),
        (f"{WAVE}, steps: 3, gray: {{cell_px: 20}}}}", "exceed"),
        ("{vertical: {scheme: gray, inverse: 'yes'}, order: [vertical]}", "inverse: expected none"),
        ("{vertical: {scheme: gray}, order: [vertical]}", "black, white missing"),
        ("vertical: {scheme: gray, origin_px: 1}", "vertical.origin_px: expected 0 or less"),
        (
            "vertical: {scheme: gray, origin_px: -113, bits: 10}",
            "hold 1025 Gray cells.*need 11 bits",
        ),
        (f"{WAVE}, steps: 3}}\norder: [vertical, vertical]", "at most once"),
        (f"{WAVE}, steps: 3}}\norder: [horizontal]", "expected each of vertical, black, white"),
        ("vertical: {scheme: composite, pitches_px: [18]}", "two periods and more"),
        ("vertical: {scheme: composite, pitches_px: [18, 2]}", "4 px and more"),
    ],
)
def test_a_sequence_that_is_none_is_refused(text, said):
    with pytest.raises(RigError, match=said):
        coded_rig(**yaml.safe_load(text))
