"""The projector from phase and known depth, on surfaces whose phases OpenCV projects, with the
projector hidden."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fpp_ml_bench.calibration.from_depth import fit_projector
from fpp_ml_bench.calibration.projection import DepthView, view_from_frames, view_from_maps
from fpp_ml_bench.errors import CalibrationError, DecodeError
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.patterns import pattern_image
from fpp_ml_bench.optics.pinhole import Pinhole

SIDE = 48
KNOWN = paper_rig(SIDE)
TURN, SHIFT_M = np.array([0.05, -0.08, 0.02]), np.array([0.18, -0.07, 0.04])
Y, X = np.mgrid[-1 : 1 : SIDE * 1j, -1 : 1 : SIDE * 1j]


def surface_mm(number=0):
    """A bumpy surface around 1.8 m, 200 mm deep, somewhere else in each view."""
    return 1780 + 15 * number + 70 * np.sin(3 * X + number) * np.cos(2.5 * Y) + 40 * X - 30 * Y


def periods_of(depth_mm, focal=(1700.0, 1700.0), centre=(455.5, 569.5), pitch=(24.0, 20.0), k1=0.0):
    """Absolute phase / 2 pi at each camera pixel, by direction, with OpenCV's projection."""
    x, y = KNOWN.camera.rays()
    points_m = np.stack([x, y, np.ones_like(x)], axis=-1) * depth_mm[..., None] / 1000
    matrix = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1.0]])
    lens = np.array([k1, 0, 0, 0.0])
    pixels = cv2.projectPoints(points_m.reshape(-1, 3), TURN, SHIFT_M, matrix, lens)[0]
    pixels = pixels.reshape(*depth_mm.shape, 2)
    return {"vertical": pixels[..., 0] / pitch[0], "horizontal": pixels[..., 1] / pitch[1]}


def view(number=0, noise=0.0, depth_mm=None, **projector):
    depth_mm = surface_mm(number) if depth_mm is None else depth_mm
    rng = np.random.default_rng(number)
    periods = {
        name: w + noise * rng.standard_normal(w.shape)
        for name, w in periods_of(depth_mm, **projector).items()
    }
    return view_from_maps(f"view {number}", KNOWN.camera, periods, depth_mm)


def test_without_noise_the_hidden_projector_is_found_from_one_view():
    rig, fit = fit_projector([view()], KNOWN)
    assert (rig.pitch_vertical_px, rig.pitch_horizontal_px) == (24, 20)
    assert fit.pitch_px == pytest.approx((24, 20), rel=1e-6)
    np.testing.assert_allclose(rig.t, SHIFT_M, atol=1e-7)
    np.testing.assert_allclose(rig.R, cv2.Rodrigues(TURN)[0], atol=1e-7)
    assert rig.projector.fx == pytest.approx(1700, rel=1e-6)
    assert rig.projector.fx == rig.projector.fy
    assert rig.projector.centre == (455.5, 569.5)
    assert fit.total.rms_mm < 1e-5
    assert fit.total.rms_px < 1e-5
    assert fit.total.pixels == SIDE * SIDE
    assert "whole px" in fit.pitch_from


def test_noise_and_wrong_pixels_leave_the_pitch_and_the_standard_errors_honest():
    views = [view(number, noise=0.002) for number in range(4)]
    rng = np.random.default_rng(9)
    for v in views:  # every twentieth pixel is something else, as at silhouettes
        v.depth_mm[rng.random(len(v.depth_mm)) < 0.05] += rng.normal(200, 100)
    rig, fit = fit_projector(views, KNOWN)
    assert (rig.pitch_vertical_px, rig.pitch_horizontal_px) == (24, 20)
    assert np.abs(np.subtract(fit.pitch_px, (24, 20))).max() < 0.05
    off_px = np.abs(np.subtract(fit.pitch_px, (24, 20)))
    assert (off_px < 5 * np.array(fit.pitch_error_px)).all()
    assert [residual.name for residual in fit.views] == [f"view {number}" for number in range(4)]
    assert abs(fit.total.median_mm) < 0.1


@pytest.mark.parametrize(
    ("pitch", "words"),
    [((912 / 50, 1140 / 50), "912 px / 50"), ((17.93, 21.37), "middle")],
    ids=["part", "no whole"],
)
def test_a_pitch_that_is_no_whole_number_stays_what_it_is(pitch, words):
    rig, fit = fit_projector([view(pitch=pitch)], KNOWN)
    assert (rig.pitch_vertical_px, rig.pitch_horizontal_px) == pytest.approx(pitch, rel=1e-6)
    assert words in fit.pitch_from and "whole px" not in fit.pitch_from


def test_a_shifted_principal_point_is_refused_until_the_pitch_or_the_focal_length_is_given():
    views = [view(number, centre=(430.0, 800.0)) for number in range(2)]
    with pytest.raises(CalibrationError, match="not be square"):
        fit_projector(views, KNOWN)
    for known in ({"pitch_px": (24.0, 20.0)}, {"focal_px": 1700.0}):
        rig, _ = fit_projector(views, KNOWN, **known)
        assert (rig.pitch_vertical_px, rig.pitch_horizontal_px) == (24, 20)
        assert rig.projector.centre == pytest.approx((430, 800), abs=1e-3)
        assert rig.projector.focal == pytest.approx((1700, 1700), rel=1e-6)


def test_a_lens_and_pixels_that_are_not_square_are_found_where_the_pitch_is_known():
    views = [view(number, focal=(1700.0, 1500.0), k1=-0.08) for number in range(2)]
    rig, fit = fit_projector(views, KNOWN, pitch_px=(24.0, 20.0), lens=True)
    assert rig.projector.focal == pytest.approx((1700, 1500), rel=1e-5)
    assert rig.projector.distortion[0] == pytest.approx(-0.08, rel=1e-3)
    assert fit.total.rms_mm < 1e-3


def test_depths_outside_the_rigs_range_widen_it():
    rig, _ = fit_projector([view(depth_mm=surface_mm() + 700)], KNOWN)
    assert rig.working_range_mm[0] == 1500
    assert rig.working_range_mm[1] > 2560
    assert rig.background_m > 2.56
    assert rig.camera == KNOWN.camera


def flat(tilt=0.0):
    x, y = KNOWN.camera.rays()
    return 1800 / (1 + tilt * x + 0.5 * tilt * y)


def mirrored(side):
    v = view()
    periods = v.periods.copy()
    periods[side] = (912 / 24, 1140 / 20)[side] - periods[side]
    return v._replace(periods=periods)


def scrambled():
    v = view()
    rng = np.random.default_rng(0)
    return v._replace(periods=rng.permuted(v.periods, axis=1))


@pytest.mark.parametrize(
    ("views", "message"),
    [
        ([view(depth_mm=flat(0.5))], "flat"),
        ([view(depth_mm=flat(), noise=0.002)], "flat"),
        ([mirrored(0)], "mirrored"),
        ([mirrored(1)], "mirrored"),
        ([scrambled()], "no projector explains"),
        ([], "at least 200 pixels"),
        ([view(depth_mm=np.where(X < -0.95, surface_mm(), 0))], "at least 200 pixels"),
        ([view(centre=(-200.0, 569.5))], "outside the pattern"),
    ],
    ids=[
        "tilted",
        "noisy flat",
        "mirrored u",
        "mirrored v",
        "scrambled",
        "none",
        "few",
        "centre outside",
    ],
)
def test_what_does_not_determine_a_projector_is_refused(views, message):
    with pytest.raises(CalibrationError, match=message):
        fit_projector(views, KNOWN)


def test_shallow_relief_is_enough_or_refused_by_its_noise():
    relief = flat() + 12 * np.sin(3 * X) * np.cos(2 * Y)
    rig, fit = fit_projector([view(depth_mm=relief, noise=0.02)], KNOWN)
    assert (rig.pitch_vertical_px, rig.pitch_horizontal_px) == (24, 20)
    assert fit.pitch_error_px[0] > 0.05
    with pytest.raises(CalibrationError, match="too little relief"):
        fit_projector([view(depth_mm=relief, noise=0.1)], KNOWN)


def test_flat_boards_at_several_places_determine_it():
    views = [
        view(n, depth_mm=flat(tilt) + shift)
        for n, (tilt, shift) in enumerate([(0, 0), (0.6, 100), (-0.5, 200)])
    ]
    rig, fit = fit_projector(views, KNOWN)
    assert (rig.pitch_vertical_px, rig.pitch_horizontal_px) == (24, 20)
    assert fit.total.rms_mm < 1e-4


def test_maps_that_do_not_fit_are_refused():
    depth_mm = surface_mm()
    both = periods_of(depth_mm)
    for periods, given_mm, message in (
        (both, depth_mm[1:], "expected depth of shape"),
        (
            {**both, "horizontal": both["horizontal"][:, 1:]},
            depth_mm,
            "expected horizontal phase of shape",
        ),
        ({"vertical": both["vertical"]}, depth_mm, "no phase of the horizontal fringes"),
        (both, np.where(X > 0, depth_mm, np.nan), "NaN"),
        (both, -depth_mm, "negative"),
    ):
        with pytest.raises(CalibrationError, match=message):
            view_from_maps("v", KNOWN.camera, periods, given_mm)
    with pytest.raises(CalibrationError, match="one of them"):
        fit_projector([view()], KNOWN, pitch_px=(24, 20), focal_px=1700)


def test_pixels_without_phase_are_left_out():
    depth_mm = surface_mm()
    periods = periods_of(depth_mm)
    periods["vertical"][:10] = np.nan
    kept = view_from_maps("v", KNOWN.camera, periods, depth_mm)
    assert len(kept.depth_mm) == SIDE * (SIDE - 10)
    assert len(view_from_maps("v", KNOWN.camera, periods, depth_mm, most_px=500).depth_mm) <= 500


@pytest.mark.parametrize(("vertical", "horizontal"), [(18.0, 18.0), (912 / 50, 19.0)])
def test_frames_give_periods_without_their_pitch(vertical, horizontal):
    """Patterns looked at directly: the camera sees projector pixels 1:1."""
    camera = Pinhole(912, 1140, 1824.0, 1824.0, 455.5, 569.5)
    shown = replace(
        paper_rig(), camera=camera, pitch_vertical_px=vertical, pitch_horizontal_px=horizontal
    )
    frames = [
        np.ascontiguousarray(pattern_image(shown, index)) for index in range(len(shown.sequence))
    ]
    ignorant = replace(shown, pitch_vertical_px=30.0, pitch_horizontal_px=30.0)
    measured = view_from_frames("v", frames, np.full((1140, 912), 1800.0), ignorant)
    assert isinstance(measured, DepthView)
    u, v = camera.pixels(*measured.rays)
    np.testing.assert_allclose(measured.periods[0] * vertical, u, atol=0.02)
    np.testing.assert_allclose(measured.periods[1] * horizontal, v, atol=0.02)
    assert len(measured.depth_mm) > 10_000
    with pytest.raises(DecodeError):
        view_from_frames("v", frames[:-1], np.full((1140, 912), 1800.0), ignorant)
