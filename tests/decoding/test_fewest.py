"""The fewest frames that a rig's range needs: compared with closed forms; decoding with them gives
the same bytes."""

from dataclasses import replace

import numpy as np
import pytest
from captures import LENSES, PAPER, capture, tilted
from conftest import TINY_SIZE, fpp_bench, printed, refusal

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.coding.code import Limits
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.decoding.fewest import fewest_steps, gray_levels_in_view, orders_from_phases
from fpp_ml_bench.loaders.sample import VOID, Flag
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.sequence import DIRECTIONS

COARSE = replace(
    PAPER,
    pitch_horizontal_px=36.0,
    pitch_vertical_px=40.0,
    sequence=replace(PAPER.sequence, steps=4),
)  # fewer cells than the code has words: its first bits never change


def fewest_gray_bits(rig, direction):
    """Gray bits that must be captured for a direction or ``both``, per direction."""
    if direction == "both" and orders_from_phases(rig).unambiguous:
        return {"horizontal": (), "vertical": ()}
    return {
        name: tuple(
            bit for bit, level in enumerate(gray_levels_in_view(rig, name)) if level is None
        )
        for name in DIRECTIONS
        if direction in (name, "both")
    }


def test_bits_that_are_constant_in_view_are_not_needed():
    # 912 / 20 = 46 cells and 1140 / 18 = 64 cells need 6 bits each, of 7.
    for direction in DIRECTIONS:
        assert fewest_gray_bits(COARSE, direction)[direction] == (1, 2, 3, 4, 5, 6)
        assert fewest_gray_bits(PAPER, direction)[direction] == tuple(range(7))
    # In a tenth of the pattern fewer bits change.
    narrow = replace(
        PAPER,
        camera=replace(PAPER.camera, fx=20_000.0, fy=20_000.0),
        working_range_mm=(1790.0, 1810.0),
    )
    bits = fewest_gray_bits(narrow, "vertical")["vertical"]
    assert len(bits) < 7 and bits[-1] == 6


def test_two_phases_of_the_papers_rig_by_hand():
    """Along a ray u moves by f b_x and v by f b_y per unit of inverse depth: 125 to 100 at every
    pixel."""
    code = orders_from_phases(PAPER)
    eu, ev = np.array([125.0, -100.0]) / np.hypot(125, 100)
    pairs = [(i, j) for i in range(-3, 4) for j in range(-2, 3) if (i, j) != (0, 0)]
    assert code.least_gap_px == pytest.approx(
        min(abs(18 * (i * ev - j * eu)) for i, j in pairs), rel=1e-9
    )
    assert code.driver == "vertical" and code.most_periods == pytest.approx(
        PAPER.periods_in_range("vertical")
    )
    assert code.unambiguous and fewest_gray_bits(PAPER, "both") == {
        "horizontal": (),
        "vertical": (),
    }
    # Equal baselines and pitches: both phases are equal and don't determine the order.
    alike = replace(PAPER, translation_m=(0.1, -0.1, 0.0))
    assert orders_from_phases(alike).least_gap_px == pytest.approx(0, abs=1e-9)
    assert fewest_gray_bits(alike, "both") == {
        name: fewest_gray_bits(alike, name)[name] for name in DIRECTIONS
    }
    assert not orders_from_phases(LENSES).unambiguous


def fewer(rig, frames, direction):
    """The frames that are needed; None in the place of the others."""
    needed = fewest_gray_bits(rig, direction)
    indices = {rig.sequence.gray(name)[bit] for name, bits in needed.items() for bit in bits}
    indices |= {i for name in needed for i in rig.sequence.sinusoids(name)}
    return [frame if index in indices else None for index, frame in enumerate(frames)]


@pytest.mark.parametrize(
    ("rig", "direction", "gray"),
    [
        (PAPER, "both", 0),
        (PAPER, "vertical", 7),
        (COARSE, "horizontal", 6),
        (LENSES, "both", None),
    ],
)
def test_depth_with_the_fewest_frames_is_the_same_bytes(rig, direction, gray):
    surface = tilted(rig)
    surface[: surface.shape[0] // 4] = rig.background_m
    frames = capture(rig, surface)
    full = decode_stack(frames, rig, direction)
    fewest = decode_stack(fewer(rig, frames, direction), rig, direction, fewest=True)
    assert (full.depth_mm > 0).sum() > 0.4 * surface.size
    np.testing.assert_array_equal(fewest.depth_mm, full.depth_mm)
    if gray is not None:
        assert len(fewest.frames_used) == rig.sequence.steps * (1 + (direction == "both")) + gray
    assert set(fewest.frames_used) < set(full.frames_used) or fewest.frames_used == full.frames_used


def test_a_pair_far_from_its_epipolar_line_is_refused_and_a_tight_limit_holds():
    frames = capture(PAPER, tilted(PAPER), noise=25.0)
    loose, tight = (
        decode_stack(frames, PAPER, steps=3, fewest=True, limits=limits)
        for limits in (Limits(), Limits(max_disagreement_px=0.1))
    )
    assert 0 < (tight.depth_mm > 0).sum() < (loose.depth_mm > 0).sum()
    assert tight.counts["directions_disagree"] > loose.counts["directions_disagree"] > 0


def test_details_go_with_the_fewest_frames():
    frames = capture(PAPER, tilted(PAPER))
    fewest, every = (decode_stack(frames, PAPER, fewest=few, details=True) for few in (True, False))
    decoded = fewest.depth_mm > 0
    for name in DIRECTIONS:
        of_fewest, of_every = (
            found.details[name].coordinate_px[decoded] for found in (fewest, every)
        )
        np.testing.assert_array_equal(of_fewest, of_every)


def test_steps_follow_the_square_root_law():
    arguments = {"modulation": 50.0, "noise_grey": 1.0}
    steps = {mm: fewest_steps(PAPER, "both", mm, **arguments) for mm in (10.0, 0.6, 0.5, 0.4, 0.01)}
    assert steps[10.0] == 3 and steps[0.01] is None
    assert steps[0.6] < steps[0.5] < steps[0.4]
    assert steps[0.4] == pytest.approx(steps[0.6] * (0.6 / 0.4) ** 2, abs=1.5)


def test_predicting_with_the_fewest_frames(tiny, tmp_path):
    dataset = DatasetFolder(tiny)
    method = ClassicalMethod(dataset.rig, direction="both", steps=3, fewest=True)
    assert len(method.frames_used) == 6
    assert method.title == "Classical 3-step, both directions, no Gray code"
    assert ClassicalMethod(paper_rig(TINY_SIZE), direction="vertical", fewest=True).frames_used == (
        *range(18, 36),
        *dataset.sequence.gray("vertical"),
    )
    predict = f"predict classical {tiny} --out {tmp_path}"
    assert fpp_bench(f"{predict}/all --steps 3") == 0
    assert fpp_bench(f"{predict}/six --steps 3 --fewest") == 0
    for sample in dataset.samples("test"):
        six, twenty = (np.load(tmp_path / name / f"{sample}.npy") for name in ("six", "all"))
        # A pixel of two surfaces, or of bounced light, has no one phase: there the two may differ.
        special = (dataset.flags(sample) & (VOID | Flag.INTERREFLECTION)) > 0
        np.testing.assert_array_equal(six[~special], twenty[~special])
        assert (six != twenty).sum() < 0.005 * six.size
    said = printed(fpp_bench, f"{predict}/noise --depth-noise 0.8 --fewest")
    assert "no Gray code" in said
    for wrong in ("--depth-noise 0.001", "--depth-noise 0.8 --steps 5", "--depth-noise -1"):
        assert "--depth-noise" in refusal(fpp_bench, f"{predict}/wrong", wrong)
