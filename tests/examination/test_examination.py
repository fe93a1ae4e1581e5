"""The examination on captures by our own light, right ones and each with one fault."""

from dataclasses import replace

import numpy as np
import pytest
from captures import capture, projected, rig_with, tilted

from fpp_ml_bench.examination.examine import examine
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.render.meshes import solid_mesh
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.view import Studio

SIZE = 200
FOUR = {"scheme": "phase-shift", "pitch_px": 57, "steps": 4, "gray": {}}
UNIT = {"scheme": "phase-shift", "pitches_px": [912, 57], "steps": 4}
PAPER = {"steps": 5, "bits_horizontal": 7, "bits_vertical": 7}
TWO = {
    "order": ["vertical", "horizontal", "white", "black"],
    "vertical": UNIT,
    "horizontal": UNIT | {"pitches_px": [1140, 57]},
}


def vertical(code):
    return rig_with({"order": ["vertical"], "vertical": code})


def frames_of(rig, **light):
    return np.stack(capture(rig, tilted(rig), **light))


def said(frames, rig, **options):
    """Names and texts of what refuses or warns."""
    found = examine(frames, rig, **options)
    return [
        (finding.name, str(finding)) for finding in found.findings if finding.severity != "note"
    ]


def photographed(rig, light):
    """Frames of an object by the renderer."""
    studio = Studio(BuildSettings(rig, ("mug",), light=named_light(light)))
    row = studio.photograph(solid_mesh("mug"), "A60")
    return np.stack([row.frames[index] for index in range(len(rig.sequence))])


@pytest.mark.long
@pytest.mark.parametrize("light", ["paper", "workshop", "hard"])
@pytest.mark.parametrize(
    "sequence",
    [
        PAPER | {"steps": 3},
        PAPER | {"steps": 18},
        TWO,
        {"order": ["vertical", "white", "black"], "vertical": {"scheme": "gray", "cell_px": 4}},
        {"order": ["vertical"], "vertical": UNIT | {"steps": 3}},
    ],
)
def test_what_decodes_right_is_not_refused_nor_warned_of(sequence, light):
    rig = rig_with(sequence)
    assert said(photographed(rig, light), rig) == []


@pytest.mark.long
@pytest.mark.parametrize("steps", [3, 4, 9])
@pytest.mark.parametrize("gamma, noise", [(1.0, 4.0), (1.5, 1.0), (2.2, 1.0)])
def test_gamma_and_noise_are_no_faults_and_gamma_is_named_where_it_shows(steps, gamma, noise):
    rig = vertical(FOUR | {"steps": steps})
    light = frames_of(rig, noise=0.0).astype(np.float64)
    bent = 255 * (light / 255) ** gamma + np.random.default_rng(1).normal(0, noise, light.shape)
    found = examine(np.clip(np.rint(bent), 0, 255).astype(np.uint8), rig)
    noted = [finding.name for finding in found.findings if finding.severity == "note"]
    assert len(noted) == len(found.findings)
    assert ("response" in noted) == (gamma > 1 and steps <= 4)


@pytest.mark.parametrize("steps", [3, 8])
@pytest.mark.parametrize("copied", [True, False])
def test_a_frame_delivered_twice_is_named(steps, copied):
    rig = vertical(FOUR | {"steps": steps})
    frames, others = frames_of(rig), frames_of(rig, seed=1)
    frames[steps - 1] = (frames if copied else others)[steps - 2]
    ((name, text),) = said(frames, rig)
    assert name == "equal frames" and f"step {steps - 2} and {steps - 1}: vertical sinusoid" in text


@pytest.mark.long
@pytest.mark.parametrize("steps", [3, 4, 8])
def test_lamps_that_flicker_by_two_percent_are_no_fault(steps):
    rig = vertical(FOUR | {"steps": steps})
    frames = frames_of(rig).astype(np.float64)
    gain = 1 + 0.02 * np.random.default_rng(2).standard_normal(len(frames))
    assert said(np.rint(frames * gain[:, None, None]).astype(np.uint8), rig) == []


@pytest.mark.long
@pytest.mark.parametrize("steps", [3, 4, 18])
def test_a_late_frame_is_a_wrong_step_and_no_response(steps):
    rig = vertical(FOUR | {"steps": steps})
    frames = frames_of(rig)
    late = (frames[steps - 1].astype(float) + frames[steps - 2]) / 2
    frames[steps - 1] = np.rint(late).astype(np.uint8)
    assert [name for name, _ in said(frames, rig)] == ["wrong step"]


@pytest.mark.long
@pytest.mark.parametrize("degrees", [-30, 10, 180])
def test_the_common_offset_of_phase_and_gray_code_is_measured(degrees):
    shown = vertical(FOUR | {"origin_px": 57 * degrees / 360})
    assert said(frames_of(shown), shown) == []
    rig = vertical(FOUR)
    ((name, text),) = said(frames_of(shown), rig)
    assert name == "phase and Gray code"
    origin_px = float(text.split("origin_px: ")[1].split()[0])
    assert abs((origin_px - 57 * degrees / 360 + 28.5) % 57 - 28.5) < 0.3


BITS = 5
PAIRS = {"scheme": "gray", "cell_px": 8, "inverse": "after each"}  # 7 bits
READINGS = {
    "pairs least first": (
        PAIRS,
        [12, 13, 10, 11, 8, 9, 6, 7, 4, 5, 2, 3, 0, 1],
        "least significant bit first",
    ),
    "inverse after all": (
        PAIRS,
        [*range(0, 14, 2), *range(1, 14, 2)],
        "inverse frames come after all",
    ),
    "Gray code first": (
        FOUR,
        [4, 5, 6, 7, 8, 0, 1, 2, 3],
        "order vertical Gray code, vertical sinusoids",
    ),
    "rotated": (FOUR, [7, 8, 0, 1, 2, 3, 4, 5, 6], "starts with frame"),
    "backward": (FOUR, np.s_[::-1], "all frames in the opposite order"),
    "least bit first": (FOUR, [0, 1, 2, 3, 8, 7, 6, 5, 4], "least significant bit first"),
    "inverse": (FOUR, lambda frames: 255 - frames, "all frames inverted"),
    "inverse bits": (
        FOUR,
        lambda frames: np.concatenate([frames[:4], 160 - frames[4:].clip(0, 160)]),
        "is inverted",
    ),
    "other sign": (FOUR, [0, 3, 2, 1, 4, 5, 6, 7, 8], "shifts of the other sign"),
    "mirrored": (FOUR, np.s_[:, :, ::-1], "mirrored left to right"),
    "turned": (FOUR, np.s_[:, ::-1, ::-1], "turned by 180 degrees"),
    "two frames exchanged": (UNIT, [0, 6, 2, 3, 4, 5, 1, 7], "frames that changed places"),
    "periods exchanged": (
        UNIT,
        [4, 5, 6, 7, 0, 1, 2, 3],
        "of period 1, vertical sinusoids of period 0",
    ),
    "other sign of both": (UNIT, [0, 3, 2, 1, 4, 7, 6, 5], "shifts of the other sign"),
    "sine for cosine": (UNIT, [1, 2, 3, 0, 5, 6, 7, 4], "sine for cosine"),
}
"""Code, the frames' new order or what else becomes of them, and what is said of it."""


@pytest.mark.long
@pytest.mark.parametrize("name", READINGS)
@pytest.mark.parametrize("range_mm", [(1500, 2100), (600, 6000)])
def test_the_reading_that_fits_is_named(name, range_mm):
    code, change, text = READINGS[name]
    rig = vertical(code).with_range(range_mm)
    frames = frames_of(rig)
    frames = change(frames) if callable(change) else frames[change]
    ((found, says),) = said(np.ascontiguousarray(frames), rig)
    assert found == "another reading fits" and text in says


def test_binary_numbers_for_gray_code():
    rig = vertical(FOUR)
    frames = frames_of(rig)
    cells = np.arange(912) // 28.5
    for bit in range(BITS):
        levels = (cells.astype(int) >> (BITS - 1 - bit) & 1) * 255.0
        u, _ = projected(rig, tilted(rig))
        frames[4 + bit] = np.rint(4 + 0.45 * np.interp(u, np.arange(912), levels))
    assert "binary numbers" in said(frames, rig)[0][1]


@pytest.mark.long
def test_two_directions_tell_more():
    rig = rig_with(TWO)
    frames = frames_of(rig)
    for order, text in (
        ([*range(8, 16), *range(8), 16, 17], "order horizontal"),
        (np.s_[:, ::-1], "mirrored top to bottom"),
        (
            [*range(8), 8, 11, 10, 9, 12, 15, 14, 13, 16, 17],
            "horizontal phase shifts of the other sign",
        ),
        ([*range(16), 17, 16], "white and black"),
    ):
        assert text in said(np.ascontiguousarray(frames[order]), rig)[0][1]


@pytest.mark.long
def test_directions_of_different_codes_have_readings_of_their_own():
    """One without Gray code, and two with 5 and 8 bits: each is rearranged by its own code."""
    two = {"order": ["horizontal", "vertical"], "vertical": FOUR}
    mixed = rig_with({**two, "horizontal": TWO["horizontal"]})
    order = [*range(12), *range(16, 11, -1)]
    assert "vertical Gray code with the least" in said(frames_of(mixed)[order], mixed)[0][1]
    both = rig_with({**two, "horizontal": FOUR | {"pitch_px": 16}}, 400)
    order = [0, 1, 2, 3, *range(11, 3, -1), 12, 13, 14, 15, *range(20, 15, -1)]
    text = said(frames_of(both)[order], both)[0][1]
    assert "another reading" in text and "Gray code with the least significant bit first" in text
    assert "another reading" in text and "Gray code with the least significant bit first" in text


@pytest.mark.long
def test_the_scene_of_two_captures_is_named():
    rig = rig_with(TWO)
    texture = 0.2 + 0.6 * (np.indices((SIZE, SIZE)).sum(axis=0) // 25 % 2)
    one, other = (
        np.rint(frames_of(rig) * part).astype(np.uint8) for part in (texture, 1 - texture)
    )
    assert said(one, rig) == []
    assert "scene moved" in [name for name, _ in said(np.concatenate([one[:8], other[8:]]), rig)]


@pytest.mark.long
def test_depths_out_of_the_range_name_the_range_or_the_unit():
    rig = vertical(FOUR)
    frames = frames_of(rig)
    text = said(frames, rig.with_range((500, 900)))[0][1]
    near, far = (float(end) for end in text.split("--working-range ")[1].split()[0].split(","))
    assert near < 1800 < far and "another working range" in text
    tenth = replace(rig, translation_m=tuple(length / 10 for length in rig.translation_m))
    text = said(frames, tenth)[0][1]
    assert "cm were read as mm (10 times)" in text and "--working-range" not in text


def test_what_a_rig_can_not_tell_is_listed():
    one, both = vertical(UNIT | {"steps": 3}), rig_with(PAPER)
    listed = " ".join(examine(frames_of(one), one).not_checked)
    assert "one direction" in listed and "no Gray code" in listed and "three steps" in listed
    assert examine(frames_of(both), both).not_checked == ()


@pytest.mark.long
def test_only_what_is_asked_for_is_looked_at():
    rig = rig_with(TWO)
    frames = frames_of(rig)
    frames[9] = frames[8]  # of the horizontal fringes
    assert said(frames, rig) and said(frames, rig, directions=("vertical",)) == []
    mask = np.zeros((SIZE, SIZE), bool)
    mask[:50] = True
    frames = frames_of(rig)
    frames[3, 50:] = frames[2, 50:]
    assert said(frames, rig) and said(frames, rig, mask=mask) == []
    dark = examine(frames // 60, rig)
    assert dark.findings == () and "pixels looked at are lit" in dark.not_checked[-1]


@pytest.mark.long
@pytest.mark.parametrize("steps", [3, 8])
@pytest.mark.parametrize("torn", [1, -1, "gray"])
@pytest.mark.parametrize("first, last", [(185, 199), (0, 70)])
def test_rows_that_show_another_pattern_are_named(steps, torn, first, last):
    rig = vertical(FOUR | {"steps": steps})
    frames, others = frames_of(rig), frames_of(rig, seed=1)
    index, other = (steps + 2, steps + 3) if torn == "gray" else (1, 1 + torn)
    frames[index, first : last + 1] = others[other, first : last + 1]
    ((name, text),) = said(frames, rig)
    assert name == "torn frames" and "differ from the other rows" in text
    start, end = text.split("rows ")[1].split(" differ")[0].split(" to ")
    # To a sixteenth of the rows.
    assert abs(int(start) - first) <= 13 and abs(int(end) - last) <= 13


def test_rows_whose_frames_are_all_late_contradict_the_code():
    rig = vertical(FOUR | {"steps": 3})
    frames = frames_of(rig)
    frames[1:, 140:] = frames_of(rig, seed=1)[:-1, 140:]
    frames[0, 140:] = 100
    ((name, text),) = said(frames, rig)
    assert name == "contradictions" and "most in rows 138 to 199" in text
    assert "no cause that was tried fits" in text


def test_steps_that_are_equally_bright_where_fringes_hardly_run_are_no_tear():
    """A period of the whole pattern: in a band all pixels have one phase, at which two steps may be
    equal."""
    rig = vertical(UNIT)
    texture = 0.5 + 0.5 * (np.indices((SIZE, SIZE)).sum(axis=0) // 9 % 2)
    frames = np.rint(frames_of(rig) * texture).astype(np.uint8)
    assert said(frames, rig) == []


@pytest.mark.parametrize("top", [200, 235])
def test_levels_that_pile_up_are_saturated_wherever_that_is(top):
    rig = vertical(FOUR)
    bright = np.stack(capture(rig, tilted(rig), albedo=1.2, noise=0.0)).astype(np.float64)
    summed = sum(
        np.minimum(bright + np.random.default_rng(n).normal(0, 1, bright.shape), top)
        for n in range(10)
    )
    levels = np.rint(summed).astype(np.float32) * np.float32(255 / 4095)
    assert examine(levels, rig).full_grey == levels.max()
    clipped = np.minimum(bright, top).astype(np.uint8)
    assert examine(clipped, rig).full_grey == top


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_whole_crest_is_not_saturated(noise):
    rig = vertical(FOUR)
    assert examine(frames_of(rig, noise=noise), rig).full_grey == 255


@pytest.mark.parametrize(
    "turned, cause", [(0.0, "response"), (90.0, "no cause that was tried fits")]
)
def test_a_wave_that_no_response_makes_has_no_cause(turned, cause):
    """Equal brightness looks alike at every pixel, so its waves are symmetric: a second harmonic
    turned against the first comes from elsewhere."""
    rig = vertical(FOUR | {"steps": 3})
    frames = frames_of(rig)
    u, _ = projected(rig, tilted(rig))
    for step in range(3):
        phase = 2 * np.pi * (u / 57 + step / 3)
        wave = np.cos(phase) + 0.1 * np.cos(2 * phase + np.deg2rad(turned))
        noise = np.random.default_rng(step).standard_normal(wave.shape)
        frames[step] = np.rint(100 + 50 * wave + noise)
    (finding,) = (found for found in examine(frames, rig).findings if found.name == "response")
    assert cause in str(finding) and finding.severity == "note"


@pytest.mark.parametrize("index", [5, 13])
def test_a_torn_inverse_frame_or_fine_bit_along_the_code_is_named(index):
    """Rows of a code of the projector's rows: a band shows few cells, and is
    named where a bit changes in it, for no bit is its own inverse."""
    rig = rig_with({"order": ["horizontal"], "horizontal": PAIRS})
    frames, others = frames_of(rig), frames_of(rig, seed=1)
    assert said(frames, rig) == []
    frames[index, 130:] = others[index - 1, 130:]
    ((name, text),) = said(frames, rig)
    assert name == "torn frames" and "differ from the other rows" in text
