"""The phase route on planes of known depth, on objects, on other rigs, and where it must say no."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import fpp_bench, refusal
from flat_planes import (
    DIRECT,
    FIRST,
    OTHER_RIG,
    PAPER,
    RIG,
    USERS_WORD,
    photograph,
    plane_depth_m,
    plane_frames,
    plane_fringe,
    turned,
)

from fpp_ml_bench.baselines.phase.depth import Reason
from fpp_ml_bench.baselines.phase.empty_scene import image_noise_grey
from fpp_ml_bench.baselines.phase.method import PhaseMethod
from fpp_ml_bench.baselines.phase.observe import SECOND_WINDOW_PERIODS, OneCarrier
from fpp_ml_bench.baselines.phase.order import FringeOrder
from fpp_ml_bench.baselines.phase.route import FringeRoute, one_carrier
from fpp_ml_bench.baselines.phase.settings import Settings
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.decoding.triangulation import depth_noise_mm
from fpp_ml_bench.errors import DecodeError, PredictionError
from fpp_ml_bench.evaluation.submission.description import read_submission
from fpp_ml_bench.loaders.render.builder import build
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.rig_file import rig_from_dict

SIZE = RIG.camera.width
TURNED_RIG = turned(RIG, 5.0, (-0.02, -0.14, 0.03))


@cache
def route(direction: str, rig: Rig = RIG, **options: object) -> FringeRoute:
    return one_carrier(OneCarrier(rig, Settings(direction=direction, **options)))  # type: ignore[arg-type]


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
@pytest.mark.parametrize(
    ("rig", "distance_m"),
    [(RIG, 1.52), (OTHER_RIG, 2.08), (TURNED_RIG, 1.8)],
)
def test_a_plane_that_fills_the_frame(rig: Rig, distance_m: float, direction: str) -> None:
    tilt = (0.1, -0.06)
    depth_m = plane_depth_m(
        rig, distance_m if distance_m == 1.8 else distance_m + (1.8 - distance_m) * 0.2, tilt
    )
    for exact_m, slope in ((plane_depth_m(rig, distance_m), (0.0, 0.0)), (depth_m, tilt)):
        measurement = route(direction, rig, **USERS_WORD).measure(
            plane_fringe(rig, FIRST[direction], exact_m, slope)
        )
        lit = measurement.modulation_grey > 5
        assert lit.mean() > 0.7  # the projector's field ends before the camera's
        error = np.abs(measurement.depth_mm - exact_m * 1000)[lit]
        assert error.mean() < 1.0
        given = (
            measurement.depth_mm[lit] > 0
        )  # at the end of the projector's field a depth may lie beyond the range
        assert (
            given.mean() > 0.9999 and (measurement.reason[lit][~given] == Reason.OUT_OF_RANGE).all()
        )


@pytest.mark.long
@pytest.mark.parametrize("pitch_px", [18, 44])
@pytest.mark.parametrize("frames", [1, 2, 3])
def test_fringes_with_a_crest_anywhere(frames: int, pitch_px: float) -> None:
    """Steps in another order, and an origin that is not pixel 0, tell the same depth."""
    for shifts in (
        {"shifts_deg": [0, 120, 240]},
        {"shifts_deg": [90, 210, 330], "origin_px": 7},
        {"steps": 3, "sign": -1, "origin_px": 4.5},
    ):
        code = {"scheme": "phase-shift", "pitch_px": pitch_px, **shifts}
        entries = {key: value for key, value in RIG.to_dict().items() if key != "pitch_px"}
        rig = rig_from_dict({**entries, "sequence": {"order": ["vertical"], "vertical": code}})
        exact_m = plane_depth_m(rig, 1.75, (0.1, 0.05))
        method = PhaseMethod(rig, direction="vertical", frames=frames, **USERS_WORD)
        measurement = method.measure(plane_frames(rig, method.frames_used, exact_m, (0.1, 0.05)))
        lit = measurement.modulation_grey > 5
        assert lit.mean() > 0.7
        assert np.abs(measurement.depth_mm - exact_m * 1000)[lit].mean() < 1.0


def test_an_order_that_nothing_tells_is_said_before() -> None:
    """Of a rig whose range holds more than one period, and that shows no plane of known depth."""
    unknown = replace(RIG, background_m=None)
    said = PhaseMethod(unknown).caution
    assert "1500 to 2100 mm holds" in said and "periods of the horizontal fringes" in said
    assert "no background_m" in said and "--white-grey" in said
    for rig, options in ((RIG, {}), (unknown, {"white_grey": 200.0})):
        assert PhaseMethod(rig, **options).caution == ""
    near, far = RIG.working_range_mm
    period_mm = (far - near) / RIG.periods_in_range("horizontal")
    assert PhaseMethod(unknown.with_range((1700.0, 1700 + period_mm / 2))).caution == ""


@pytest.mark.parametrize("frames", [1, 2, 3])
@pytest.mark.parametrize(
    "rig", [RIG, replace(RIG, pitch_horizontal_px=90.0)], ids=["captured", "resampled"]
)
def test_beyond_the_end_of_the_range_there_is_no_depth(rig: Rig, frames: int) -> None:
    """A plane that leaves the range in the middle of the image, by 11 mm at most: exact up to the
    end, none beyond."""
    tilt = (0.025, 0.0)
    exact_m = plane_depth_m(rig, 2.1, tilt)
    method = PhaseMethod(rig, frames=frames, **USERS_WORD)
    assert method.route.model.resampling.needed == (rig is not RIG)
    measurement = method.measure(plane_frames(rig, method.frames_used, exact_m, tilt))
    depth_mm, exact_mm, lit = measurement.depth_mm, exact_m * 1000, measurement.modulation_grey > 5
    assert (depth_mm <= 2100).all() and (measurement.sigma_mm[depth_mm == 0] == 0).all()
    within, beyond = lit & (exact_mm < 2094), lit & (exact_mm > 2106)
    assert within.sum() > 30_000 and beyond.sum() > 30_000
    assert (np.abs(depth_mm - exact_mm)[within] < 8).mean() > 0.99
    assert (depth_mm[beyond] == 0).mean() > 0.98
    assert (measurement.reason[beyond] == Reason.OUT_OF_RANGE).mean() > 0.98


def test_plane_noise_is_what_the_window_leaves_of_it() -> None:
    # One ray a pixel: a pixel with an area keeps 99.6% of the modulation, which moves the phase by
    # 0.1 mm of its own.
    exact_m = plane_depth_m(RIG, 1.8)
    middle = (slice(180, 300), slice(180, 300))
    spread = {}
    for noise in (1.0, 3.0):
        measurement = route("vertical", **USERS_WORD).measure(
            plane_fringe(RIG, 18, exact_m, noise=noise, light=DIRECT)
        )
        error = (measurement.depth_mm - exact_m * 1000)[middle]
        spread[noise] = error.std()
        sigma_px = SECOND_WINDOW_PERIODS * RIG.image_px_per_period("vertical")
        averaged = int(4 * np.pi * sigma_px**2)
        predicted = depth_noise_mm(
            RIG, 1800.0, "vertical", averaged, measurement.modulation_grey[middle].mean(), noise
        )
        # Where the fringe is at its extremes a narrow window sees less of the phase: up to twice
        # the even spread.
        assert 0.6 * predicted < spread[noise] < 2.5 * predicted
    assert 2.2 < spread[3.0] / spread[1.0] < 4


@pytest.mark.long
@pytest.mark.parametrize("rig", [RIG, OTHER_RIG], ids=["paper", "other"])
@pytest.mark.parametrize("name", ["cork", "cracker_box"])
def test_objects_at_unknown_distance(name: str, rig: Rig) -> None:
    row = photograph(name, "A60", rig)
    measurement = route("horizontal", rig).measure(row.frames[0])
    target = row.depth_mm > 0
    error = np.abs(measurement.depth_mm - row.depth_mm)[target]
    assert np.median(error) < 3
    assert (error > 100).mean() < 0.02  # wrong orders, and object pixels taken for background
    assert (measurement.depth_mm[~target] > 0).mean() < 0.02
    assert measurement.background_share > 0.2
    assert sum(measurement.counts.values()) == target.size


def test_confidence_orders_errors_and_the_strict_mode_uses_it() -> None:
    row = photograph("mug", "A60")
    dense = route("horizontal").measure(row.frames[0])
    strict = route("horizontal", min_confidence=0.6).measure(row.frames[0])
    both = (row.depth_mm > 0) & (dense.depth_mm > 0)
    error, sure = np.abs(dense.depth_mm - row.depth_mm)[both], dense.confidence[both]
    halves = sure > np.median(sure)
    assert error[halves].mean() < 0.5 * error[~halves].mean()
    confident = strict.depth_mm > 0
    assert 0.3 < confident.sum() / both.sum() < 1
    assert np.array_equal(strict.depth_mm[confident], dense.depth_mm[confident])
    assert (strict.confidence[confident] >= 0.6).all()
    assert strict.counts["unsure"] > 0


def test_depth_lies_on_the_candidates_whoever_chooses() -> None:
    random_route = route("horizontal")
    seen = random_route.observe(photograph("cork", "A60").frames[0], None)
    first, count = seen.candidates.first, np.maximum(seen.candidates.count, 1)
    order = first + np.random.default_rng(0).integers(0, count).astype(np.int32)
    measurement = random_route.depth(FringeOrder(seen, order, np.zeros(order.shape, np.float32)))
    on_object = measurement.depth_mm > 0
    assert on_object.sum() > 3000 and np.array_equal(
        measurement.order[seen.crop][seen.inside], order[seen.inside]
    )
    layer = random_route.model.layer.at(on_object)
    again = layer.depth_mm(
        measurement.wrapped_phase_rad[on_object].astype(np.float64), measurement.order[on_object]
    )
    assert np.abs(again - measurement.depth_mm[on_object]).max() < 1e-2


def test_nothing_is_measured_where_nothing_is() -> None:
    empty = plane_fringe(RIG, 0, plane_depth_m(RIG, RIG.background_m))
    measurement = route("horizontal").measure(empty)
    assert not measurement.depth_mm.any()
    assert measurement.counts["background"] == empty.size
    dark = np.full((SIZE, SIZE), round(PAPER.ambient_grey), np.uint8)
    assert not route("horizontal").measure(dark).depth_mm.any()


@pytest.mark.long
def test_saturated_ambiguous_and_thin_are_said() -> None:
    exact_m = plane_depth_m(RIG, 1.8)
    image = plane_fringe(RIG, 0, exact_m)
    bright = np.clip(image * 2.5, 0, 255).astype(
        np.uint8
    )  # white at the near end of the range: grey level 450
    assert route("horizontal").measure(bright).counts["saturated"] > 0.2 * image.size
    # Without brightness and without a prior a plane can't be told from one a period away: no
    # margin, and it says so.
    blind = route("horizontal", shading=False, **USERS_WORD).measure(image)
    assert blind.counts["ambiguous"] > 0.5 * image.size
    assert blind.confidence.max() < 0.2
    near = route("horizontal", shading=False, prior="standoff", **USERS_WORD).measure(image)
    lit = near.modulation_grey > 5
    assert np.abs(near.depth_mm - 1800)[lit].mean() < 1
    pole = plane_fringe(RIG, 0, plane_depth_m(RIG, RIG.background_m)).copy()
    pole[100:380, 240:244] = image[100:380, 240:244]
    thin = route("horizontal").measure(pole)
    assert thin.counts["thin"] > 500
    assert thin.counts["measured"] < 200


@pytest.mark.long
@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
@pytest.mark.parametrize("frames", [1, 2, 3])
def test_without_background_brightness_needs_the_users_word(frames: int, direction: str) -> None:
    exact_m = plane_depth_m(RIG, 1.8)
    first = FIRST[direction]
    told = route(direction, frames=frames, **USERS_WORD)
    fringes = [plane_fringe(RIG, first + step, exact_m) for step in told.model.steps]
    blind = route(direction, frames=frames).measure(fringes)
    assert blind.background_share == 0
    several = (blind.modulation_grey > 5) & (blind.candidates.count > 1)
    assert several.mean() > 0.7
    assert (blind.depth_mm[several] == 0).mean() > 0.95
    # Another reason may come before AMBIGUOUS: no pixel there is to be trusted.
    assert (blind.reason[several] != Reason.MEASURED).all()
    assert (blind.reason[several] == Reason.AMBIGUOUS).mean() > 0.95
    assert blind.confidence[several].max() < 0.5
    measurement = told.measure(fringes)
    lit = measurement.modulation_grey > 5
    assert np.abs(measurement.depth_mm - 1800)[lit].mean() < 1.5
    assert (measurement.reason[lit] == Reason.MEASURED).mean() > 0.9
    assert np.median(measurement.confidence[lit]) > 0.5


def test_the_users_word_gives_way_to_the_images_own_background() -> None:
    image = photograph("cork", "A60").frames[0]
    own = route("horizontal").measure(image)
    told = route("horizontal", **USERS_WORD).measure(image)
    assert own.background_share > 0.2
    np.testing.assert_array_equal(told.depth_mm, own.depth_mm)
    np.testing.assert_array_equal(told.confidence, own.confidence)


@pytest.mark.long
@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
@pytest.mark.parametrize("name", ["cork", "mug"])
def test_exposure_does_not_matter(name: str, direction: str) -> None:
    """The lamp's strength is read from the image, so pixels that are found have the same error.
    Noise stays as it is, so dim pixels go missing: of the cork 23, 34 and 61 in 8,260. The
    benchmark's object MAE counts each with its whole depth, so that one rises, from 7.6 to 16.6
    mm."""
    errors, found = {}, {}
    for exposure in (1.0, 0.5, 0.25):
        row = photograph(name, "A60", light=PAPER.changed("camera", exposure=exposure))
        depth_mm = route(direction).measure(row.frames[FIRST[direction]]).depth_mm
        assert row.depth_exact_mm is not None
        target = row.depth_exact_mm > 0
        both = target & (depth_mm > 0)
        errors[exposure] = np.abs(depth_mm - row.depth_exact_mm)[both].mean(dtype=np.float64)
        found[exposure] = both.sum() / target.sum()
    for exposure in (0.5, 0.25):
        assert abs(errors[exposure] - errors[1.0]) < 0.10 * errors[1.0] + 0.5
        assert found[exposure] > found[1.0] - 0.01


@pytest.mark.parametrize("sigma", [1.0, 2.0, 4.0])
def test_noise_of_an_image_is_found_in_it(sigma: float) -> None:
    # Read noise alone: shot noise has another sigma at every grey level.
    electrons = 1e6
    light = PAPER.changed("camera", full_well_e=255 * electrons, read_noise_e=sigma * electrons)
    row = photograph("mug", "A60", light=light)
    for first in FIRST.values():
        assert image_noise_grey(row.frames[first]) == pytest.approx(sigma, rel=0.15)


@pytest.mark.long
@pytest.mark.parametrize(
    "span", [(1700.0, 1900.0), (1100.0, 2600.0)], ids=["one period or none", "ten periods"]
)
def test_ranges_of_one_period_and_of_ten(span: tuple[float, float]) -> None:
    pitch = 18.0 if span[0] > 1500 else 12.0
    sequence = replace(RIG.sequence, bits_vertical=8)
    rig = replace(RIG, working_range_mm=span, pitch_vertical_px=pitch, sequence=sequence)
    image = plane_fringe(rig, 18, plane_depth_m(rig, 1.8))
    measurement = route("vertical", rig, **USERS_WORD).measure(image)
    lit = measurement.modulation_grey > 5
    assert measurement.candidates.count.max() in ((1, 2) if pitch == 18 else (10, 11))
    assert np.median(np.abs(measurement.depth_mm - 1800)[lit]) < 1


@pytest.mark.long
def test_the_users_word_from_the_command_line(tmp_path: Path) -> None:
    dataset, out, mask = tmp_path / "set", tmp_path / "phase", tmp_path / "mask.png"
    build(dataset, BuildSettings(RIG, ("cork",), stored="single_shot"), workers=1)
    cv2.imwrite(str(mask), np.full((SIZE, SIZE), 255, np.uint8))
    words = ["predict", "phase", dataset, "--split", "all", "--mask", mask, "--prior", "standoff"]
    words += ["--white-grey", "180", "--ambient-grey", "0"]
    assert fpp_bench(*words, "--out", out) == 0
    told = read_submission(out)
    assert told.settings | {"white_grey": 180.0, "ambient_grey": 0.0} == told.settings
    assert told.settings["mask"] == "mask.png" and "standoff" in told.name
    for word, message in (
        (["--white-grey", "-1"], "white_grey -1.0: expected more than 0"),
        (["--ambient-grey", "nan"], "ambient_grey nan: expected 0 to 255"),
    ):
        error = refusal(fpp_bench, "predict", "phase", dataset, *word, "--out", tmp_path / "wrong")
        assert message in error and not (tmp_path / "wrong").exists()


def test_refusals_name_what_came() -> None:
    with pytest.raises(DecodeError, match="frame 0 is missing"):
        PhaseMethod(RIG).predict([None] * 52)
    with pytest.raises(DecodeError, match="uint8"):
        route("horizontal").measure(np.zeros((SIZE, SIZE)))
    with pytest.raises(DecodeError, match=r"\(100, 480\)"):
        route("horizontal").measure(np.zeros((100, SIZE), np.uint8))
    for wrong in (
        {"direction": "both"},
        {"prior": "shape"},
        {"min_confidence": 1.0},
        {"pitch": 3},
        {"white_grey": 0.0},
        {"white_grey": float("nan")},
        {"white_grey": float("inf")},
        {"ambient_grey": -1.0},
        {"ambient_grey": float("nan")},
        {"ambient_grey": 300.0},
    ):
        with pytest.raises(PredictionError, match=next(iter(wrong))):
            PhaseMethod(RIG, **wrong)


def test_fringes_along_the_baseline_are_refused() -> None:
    beside = replace(paper_rig(224), translation_m=(0.16, 0.0, 0.0))
    with pytest.raises(PredictionError, match="horizontal fringes tell no depth on this rig"):
        load_method("phase", beside, direction="horizontal")
    with pytest.raises(PredictionError, match="use the other direction"):
        load_method("fringe-net", beside, fringes="horizontal")
    for method in ("phase", "fringe-net"):
        assert load_method(method, beside).frames_used == (18,)
