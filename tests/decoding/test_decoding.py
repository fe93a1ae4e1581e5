"""The whole decoder: depth and reasons of simulated captures, compiled and in NumPy."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from captures import LENSES, PAPER, TURNED, capture, projected, rig_with, tilted

from fpp_ml_bench.baselines.stability.frames import coded_rig, direction_levels, plane_stack
from fpp_ml_bench.coding.code import Limits, Reason
from fpp_ml_bench.decoding.blocks import plan_direction
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.decoding.triangulation import coordinate_slope_px_per_mm, depth_noise_mm
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics.sequence import DIRECTIONS, Sequence

MODULATION = 0.45 * 127.5
RIGS = pytest.mark.parametrize("rig", [PAPER, TURNED, LENSES], ids=["paper", "turned", "lenses"])


def lit(rig, depth_m):
    """Pixels that see the pattern, 2 px inside it, to exclude interpolation with the dark outside
    its border."""
    u, v = projected(rig, depth_m)
    return (u > 2) & (u < rig.projector.width - 3) & (v > 2) & (v < rig.projector.height - 3)


@RIGS
@pytest.mark.parametrize("direction", ["vertical", "horizontal", "both"])
def test_depth_error_is_the_noise_it_must_have(rig, direction):
    depth = tilted(rig)
    decoded, good = decode_stack(capture(rig, depth), rig, direction), lit(rig, depth)
    assert good.mean() > 0.8 and (decoded.reason[good] == Reason.DECODED).all()
    assert decoded.depth_mm.dtype == np.float32
    steps = rig.sequence.steps
    # Noise of one grey level and the variance of rounding, 1/12.
    predicted = depth_noise_mm(
        rig, depth * 1000, direction, steps, MODULATION, np.sqrt(1 + 1 / 12), rig.camera.rays()
    )
    error = (decoded.depth_mm - depth * 1000)[good]
    assert np.abs(error).max() < 30  # an order wrong by 1 is 250 mm
    core = np.abs(error / predicted[good])
    assert np.median(core) == pytest.approx(0.6745, rel=0.06)


@pytest.mark.parametrize(
    "code",
    [
        {"cell_px": 2},
        {"cell_px": 16, "inverse": "after all"},
        {"cell_px": 1, "origin_px": -56},
        {"cell_px": 4, "inverse": "after each", "least_first": True},
    ],
    ids=str,
)
def test_gray_code_alone_answers_within_its_cells(code):
    codes = {direction: {"scheme": "gray", **code} for direction in DIRECTIONS}
    order = [*codes, *(() if "inverse" in code else ("black", "white"))]
    rig = rig_with({"order": order, **codes})
    depth = tilted(rig)
    decoded, seen = decode_stack(capture(rig, depth), rig), lit(rig, depth)
    assert seen.mean() > 0.8 and (decoded.reason[seen] == Reason.DECODED).mean() >= 0.97
    slopes = [
        coordinate_slope_px_per_mm(rig, depth * 1000, direction, rig.camera.rays())
        for direction in DIRECTIONS
    ]
    sigma_mm = code["cell_px"] / np.sqrt(12) / np.hypot(*slopes)
    answered = seen & (decoded.depth_mm > 0)
    ratio = (np.abs(decoded.depth_mm - depth * 1000) / sigma_mm)[answered]
    # 0.6745 for a normal distribution, 0.72 for the sum of two equal uniform ones.
    assert np.median(ratio) < 0.8


@RIGS
@pytest.mark.parametrize("direction", ["vertical", "horizontal", "both"])
def test_frames_of_floats_decode_as_those_of_bytes(rig, direction):
    frames = capture(rig, tilted(rig), noise=3.0, albedo=0.9)
    for frame in frames[::3]:
        frame[:20] = np.random.default_rng(1).integers(
            0, 256, frame[:20].shape, dtype=np.uint8
        )  # no signal at all
    compiled = decode_stack(frames, rig, direction, details=True)
    floats = [frame.astype(np.float32) for frame in frames]
    plain = decode_stack(floats, rig, direction, details=True)
    assert np.array_equal(compiled.reason, plain.reason) and compiled.counts == plain.counts
    assert len(np.unique(plain.reason)) >= 3
    # Both round a float64 depth once to float32: at most one unit in the last place apart.
    ulp = np.spacing(np.maximum(plain.depth_mm, np.float32(1)))
    assert (np.abs(compiled.depth_mm - plain.depth_mm) <= ulp).all()
    for name, found in compiled.details.items():
        expected = plain.details[name]
        np.testing.assert_allclose(found.phase, expected.phase, atol=1e-12, rtol=0)
        np.testing.assert_array_equal(found.modulation, expected.modulation)
        np.testing.assert_allclose(found.coordinate_px, expected.coordinate_px, atol=1e-10, rtol=0)


def test_mask_threads_and_layout_change_no_bit():
    frames = capture(PAPER, tilted(PAPER))
    full = decode_stack(frames, PAPER, details=True)
    mask = np.random.default_rng(3).random(frames[0].shape) < 0.3
    masked = decode_stack(frames, PAPER, mask=mask, details=True)
    assert np.array_equal(masked.depth_mm, np.where(mask, full.depth_mm, 0))
    assert np.array_equal(masked.reason, np.where(mask, full.reason, Reason.NOT_ASKED))
    for name in full.details:
        assert np.array_equal(masked.details[name].phase[mask], full.details[name].phase[mask])
    assert masked.counts["not_asked"] == (~mask).sum() and sum(masked.counts.values()) == mask.size
    read_only = np.stack(frames)
    read_only.flags.writeable = False
    columns = [np.asfortranarray(frame) for frame in frames]
    for variant in (read_only, columns):
        again = decode_stack(variant, PAPER, threads=2)
        assert np.array_equal(again.depth_mm, full.depth_mm)
        assert np.array_equal(again.reason, full.reason)
    nothing = decode_stack(frames, PAPER, mask=np.zeros_like(mask))
    assert not nothing.depth_mm.any() and nothing.counts["not_asked"] == mask.size


def reasons(frames, rig=PAPER, direction="both", **arguments):
    return decode_stack(frames, rig, direction, **arguments).reason


def test_every_reason_is_given_where_it_holds():
    depth = tilted(PAPER)
    frames = capture(PAPER, depth, noise=0.3)
    inside = np.s_[80:120, 80:120]
    assert (reasons(frames)[inside] == Reason.DECODED).all()

    dark = [frame.copy() for frame in frames]
    for frame in dark:
        frame[inside] = 7
    assert (reasons(dark)[inside] == Reason.LOW_MODULATION).all()

    glaring = [np.minimum(frame * 4.0, 255).astype(np.uint8) for frame in frames]
    assert (reasons(glaring)[inside] == Reason.SATURATED).mean() > 0.95
    assert (
        reasons(glaring, limits=Limits(max_clipped_steps=18))[inside] == Reason.DECODED
    ).mean() > 0.9

    flipped = [frame.copy() for frame in frames]
    sequence = PAPER.sequence
    level = np.stack([frames[i] for i in sequence.sinusoids("vertical")]).mean(axis=0)
    blurred = list(sequence.gray("vertical"))[2:4]
    for index in blurred:
        flipped[index][inside] = level[inside]
    assert (reasons(flipped, direction="vertical")[inside] == Reason.INCONSISTENT_ORDER).all()
    assert (reasons(flipped, direction="horizontal")[inside] == Reason.DECODED).all()

    shifted = list(frames)  # v as of a surface 100 mm farther, u of the true surface
    farther = capture(PAPER, depth + 0.1, noise=0.3)
    for index in [*sequence.sinusoids("horizontal"), *sequence.gray("horizontal")]:
        shifted[index] = farther[index]
    assert (reasons(shifted)[inside] == Reason.DIRECTIONS_DISAGREE).all()

    background = capture(PAPER, np.full_like(depth, 3.2), noise=0.3)
    decoded = decode_stack(background, PAPER)
    assert (decoded.reason[inside] == Reason.OUTSIDE_RANGE).all() and not decoded.depth_mm.any()

    # A lens that folds 0.3 from the axis, and an image that reaches 0.35: the corners have no ray.
    camera = replace(PAPER.camera, fx=280.0, fy=280.0, distortion=(-1.8, 0.0, 0.0, 0.0, 0.0))
    folded = replace(PAPER, camera=camera)
    no_ray = np.isnan(folded.camera.rays()[0])
    assert no_ray.any() and not no_ray.all()
    assert (reasons(frames, folded)[no_ray] == Reason.NO_RAY).all()
    assert (reasons(frames, folded)[inside] != Reason.NO_RAY).any()


def test_a_coordinate_beyond_the_patterns_border_is_outside():
    rig = PAPER
    depth = tilted(rig)
    frames = capture(rig, depth, noise=0.0)
    # A rig whose projector is 305 px narrower than the projected pattern: the last cells are
    # outside.
    narrow = replace(rig, projector=replace(rig.projector, width=rig.projector.width - 305))
    decoded = decode_stack(frames, narrow, "vertical", details=True)
    u, _ = projected(rig, depth)
    rejected = np.isin(decoded.reason, [Reason.OUTSIDE_PATTERN, Reason.INCONSISTENT_ORDER])
    assert rejected[(u > 607) & (u < 905)].all() and not rejected[(u > 2) & (u < 606)].any()
    assert (decoded.reason == Reason.OUTSIDE_PATTERN).any()


@pytest.mark.parametrize("bits", [1, 2, 7, 10, 13, 15])
def test_every_cell_of_a_full_code_has_its_coordinate(bits):
    """15 bits fill the compiled decoder's 16-bit integers."""
    side = min(65536, 2**bits * 2)
    device = replace(PAPER.projector, width=side, height=side)
    rig = replace(
        PAPER,
        projector=device,
        sequence=Sequence(3, bits, bits),
        pitch_vertical_px=4.0,
        pitch_horizontal_px=4.0,
    )
    exact_px = np.arange(2**bits) * 2 + 0.5
    levels = np.rint(direction_levels(rig, exact_px)).astype(np.uint8)
    decoded = plan_direction(rig, "vertical", 3).decode(levels, Limits())
    assert (decoded.reason == Reason.DECODED).all()
    assert (
        np.abs(decoded.coordinate_px - exact_px).max() < 0.01
    )  # 4 px / 2 pi of half a grey level in 100


def test_frames_that_are_not_used_may_be_missing():
    frames = capture(PAPER, tilted(PAPER))
    full = decode_stack(frames, PAPER, "horizontal", steps=6)
    needed = [frame if i in full.frames_used else None for i, frame in enumerate(frames)]
    again = decode_stack(needed, PAPER, "horizontal", steps=6)
    assert np.array_equal(again.depth_mm, full.depth_mm)
    assert full.frames_used == (0, 3, 6, 9, 12, 15, *range(36, 43))
    with pytest.raises(
        DecodeError, match=r"frame 18: vertical sinusoid, step 0: expected an image, got None"
    ):
        decode_stack(needed, PAPER, "vertical", steps=6)


@pytest.mark.parametrize(
    "change, arguments, message",
    [
        (lambda f: f[:-1], {}, "52 frames.*got 51"),
        (lambda f: [x[:, :-1] for x in f], {}, r"expected shape.*\(200, 200\).*got \(200, 199\)"),
        (lambda f: [x.astype(np.float64) for x in f], {}, "expected uint8.*float64"),
        (lambda f: [x.astype(np.float32) + 300 for x in f], {}, "float32 grey levels of 0 to 255"),
        (
            lambda f: [*(x.astype(np.float32) for x in f[:9]), *f[9:]],
            {},
            "dtype of the other frames",
        ),
        (lambda f: f, {"direction": "diagonal"}, "horizontal, vertical or both"),
        (lambda f: f, {"steps": 2}, "3 to the 18"),
        (lambda f: f, {"threads": 0}, "threads"),
        (lambda f: f, {"mask": np.ones((200, 200))}, "mask: expected bool"),
        (lambda f: f, {"limits": Limits(min_modulation=float("nan"))}, "min_modulation"),
    ],
)
def test_what_cannot_be_decoded_is_refused(change, arguments, message):
    frames = [np.zeros((200, 200), dtype=np.uint8)] * 52
    with pytest.raises(DecodeError, match=message):
        decode_stack(change(frames), PAPER, **arguments)


def test_noise_alone_is_never_given_a_depth_by_both_directions():
    frames = list(np.random.default_rng(8).integers(0, 256, (52, 200, 200), dtype=np.uint8))
    decoded = decode_stack(frames, PAPER)
    assert (decoded.depth_mm > 0).mean() < 1e-3


@pytest.mark.processes
def test_without_numba_the_decoder_still_works():
    """In a separate process in which numba can't be imported."""
    code = (
        "import sys; sys.modules['numba'] = None\n"
        "import numpy as np\n"
        "from fpp_ml_bench.machine import njit\n"
        "from fpp_ml_bench.decoding.decode import decode_stack\n"
        "from fpp_ml_bench.optics.named_rigs import paper_rig\n"
        "assert njit(len) is len\n"
        "decoded = decode_stack(np.zeros((52, 200, 200), np.uint8), paper_rig(200))\n"
        "assert decoded.counts['low_modulation'] == 40000, decoded.counts\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("steps", [4, 18])
@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
def test_a_black_frame_is_refused_by_name(steps, direction):
    rig = coded_rig(steps=steps)
    frames, _ = plane_stack(rig)
    dead = rig.sequence.sinusoids(direction)[2]
    frames[dead] = np.zeros_like(frames[dead])
    with pytest.raises(
        DecodeError, match=rf"frame {dead}: {direction} sinusoid, step 2.*capture failed"
    ):
        decode_stack(frames, rig, direction="both")


def test_a_dimmed_frame_is_refused_unless_it_is_not_used():
    rig = coded_rig()
    frames, _ = plane_stack(rig)
    frames[1] = frames[1] // 2
    with pytest.raises(DecodeError, match="frame 1: horizontal sinusoid, step 1"):
        decode_stack(frames, rig)
    assert (decode_stack(frames, rig, steps=9).depth_mm > 0).mean() > 0.9
    assert (decode_stack(frames, rig, direction="vertical").depth_mm > 0).mean() > 0.9


@pytest.mark.parametrize("steps", [4, 18])
@pytest.mark.parametrize("pitch", [18.0, 900.0])
@pytest.mark.parametrize("bend", ["gamma", "clipped", "dark", "flat", "black", "random"])
def test_no_correct_capture_is_refused(steps, pitch, bend):
    rig = coded_rig(pitch, steps)
    frames, _ = plane_stack(rig, mean=100.0, modulation=90.0)
    change = {
        "gamma": lambda grey: 255 * (grey / 255.0) ** 2.2,
        "clipped": lambda grey: np.minimum(2.5 * grey, 255.0),
        "dark": lambda grey: grey / 20.0,
        "flat": lambda grey: np.full(grey.shape, 90.0),
        "black": lambda grey: np.zeros(grey.shape),
        "random": lambda grey: np.random.default_rng(3).integers(0, 256, grey.shape),
    }[bend]
    stack = [None if grey is None else np.rint(change(grey)).astype(np.uint8) for grey in frames]
    decode_stack(stack, rig)
    few = np.zeros((32, 32), dtype=bool)
    few[3:12, 4:12] = True  # 72 pixels: a small patch of phase
    decode_stack(stack, rig, mask=few)
