"""The mask of one crossed frame where the wall or the object is hard to see, and edges between
surfaces."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from crossed_scenes import frame, noisy, route, slab
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase import empty_scene, local_fit, object_mask, observe
from fpp_ml_bench.baselines.phase.depth import Reason
from fpp_ml_bench.baselines.phase.geometry import Carriers, wrapped
from fpp_ml_bench.baselines.phase.observe import TwoCarriers
from fpp_ml_bench.baselines.phase.route import two_carriers
from fpp_ml_bench.baselines.phase.settings import Settings
from fpp_ml_bench.optics.named_rigs import crossed_rig
from fpp_ml_bench.optics.rig import Rig

WHOLE = crossed_rig(960)
CUT = replace(WHOLE, camera=replace(WHOLE.camera, width=320, height=320, cx=159.5, cy=159.5))
FAMILY = WHOLE.crossed
DEPTH_MM = slab(CUT)
INSIDE = DEPTH_MM > 0
Y, X = np.indices(DEPTH_MM.shape)
CHECKS = np.where((X // 32 + Y // 32) % 2, 1.0, 0.35)


def shares(image: NDArray[np.uint8]) -> tuple[float, float]:
    """Of the object without a depth, and of the background with one."""
    answered = route(CUT, FAMILY).measure(image).depth_mm > 0
    return float((~answered[INSIDE]).mean()), float(answered[~INSIDE].mean())


def shown(noise_grey: float = 0.7, **light: object) -> NDArray[np.uint8]:
    return frame(DEPTH_MM, CUT, FAMILY, noise_grey=noise_grey, **light)  # type: ignore[arg-type]


def test_a_plain_slab() -> None:
    missed, invented = shares(shown())
    assert missed < 1e-3 and invented < 5e-3


@pytest.mark.parametrize("wall_grey", [4.0, 40.0, 90.0])
def test_a_wall_without_visible_fringes(wall_grey: float) -> None:
    """Blurred out, or no wall: half of the slab has less modulation than would count as a fringe by
    itself."""
    image = shown(white_grey=np.where(X < 160, 14.0, 150.0))
    missed, invented = shares(np.where(INSIDE, image, noisy(np.full(image.shape, wall_grey))))
    assert missed < 0.02 and invented < 0.01


def test_texture_over_wall_and_object(monkeypatch: pytest.MonkeyPatch) -> None:
    painted = np.rint(6 + CHECKS * (shown(noise_grey=0.0).astype(float) - 6))
    image = noisy(painted, seed=5)
    missed, invented = shares(image)
    assert missed < 0.01 and invented < 0.06
    monkeypatch.setattr(empty_scene, "TEXTURED", np.inf)
    assert shares(image)[0] > 0.2


def test_noise_hides_no_dark_part(monkeypatch: pytest.MonkeyPatch) -> None:
    dark = (np.abs(X - 160) < 40) & (np.abs(Y - 160) < 40)
    image = shown(noise_grey=6.0, white_grey=np.where(dark, 30.0, 160.0))
    missed, invented = shares(image)
    assert missed < 5e-3 and invented < 5e-3
    monkeypatch.setattr(object_mask, "ENCLOSED_EXCESS", np.inf)
    assert shares(image)[0] > 0.03


def test_dark_paint_is_not_unlit(monkeypatch: pytest.MonkeyPatch) -> None:
    image = shown(white_grey=4.5, noise_grey=1.2)
    assert shares(image)[0] < 0.05
    monkeypatch.setattr("fpp_ml_bench.baselines.phase.observe.UNLIT_PX", 1)
    assert shares(image)[0] > 0.2


def test_a_shadow_that_other_light_reaches_is_no_object(monkeypatch: pytest.MonkeyPatch) -> None:
    shadow = (X < 60) & ~INSIDE
    image = np.where(shadow, noisy(np.full(shadow.shape, 14.0), seed=8), shown())

    def answered() -> float:
        return float((route(CUT, FAMILY).measure(image).depth_mm > 0)[shadow].mean())

    assert (
        answered() < 0.5 and shares(image)[0] < 2e-3
    )  # a window beside the wall sees the wall's fringes
    monkeypatch.setattr(observe, "FAINT_SIGMAS", 0.0)
    assert answered() > 0.95


def test_seams_along_a_shadow_are_no_object() -> None:
    inside = np.zeros((80, 80), bool)
    inside[10:70, 10:70] = True
    dark = np.zeros_like(inside)
    dark[13:67, 13:40] = True  # a shadow with a seam of 3 px around it, beside an object
    twig = np.zeros_like(inside)
    twig[38:41, 70:80] = True  # a thin part of the object, far from the shadow
    kept = object_mask.lit_part(inside | twig, dark)
    assert not kept[:, :38].any() and kept[12:68, 44:70].all() and kept[twig].all()


def test_the_wall_is_seen_through_narrow_gaps(monkeypatch: pytest.MonkeyPatch) -> None:
    bars = INSIDE & (X % 24 >= 10)  # gaps of 10 px, which closing fills for the most part
    image = frame(np.where(bars, DEPTH_MM, 0.0), CUT, FAMILY)

    def filled() -> tuple[float, float]:
        answered = route(CUT, FAMILY).measure(image).depth_mm > 0
        return float(answered[INSIDE & ~bars].mean()), float((~answered[bars]).mean())

    (seen, missed), allowed = filled(), 1e-3
    monkeypatch.setattr(object_mask, "GAP_OBJECT", np.inf)
    closed, missed_before = filled()
    assert closed > 0.4 and seen < 0.7 * closed and missed < missed_before + allowed


def test_a_pixel_that_the_wall_explains_too_is_answered_and_said_to_be_in_doubt() -> None:
    bars = INSIDE & (X % 24 >= 6)
    image = frame(np.where(bars, DEPTH_MM, 0.0), CUT, FAMILY)
    found = route(CUT, FAMILY).measure(image)
    doubted = found.sigma_mm > 1000  # the wall is 1.4 m behind
    assert 50 < doubted.sum() < 0.02 * INSIDE.sum() and (found.reason == Reason.WALL)[doubted].any()
    assert (found.depth_mm[doubted] > 0).all() and doubted[bars].mean() < 0.002
    strict = two_carriers(TwoCarriers(CUT, Settings(min_confidence=0.02), FAMILY)).measure(image)
    assert (
        not (strict.depth_mm[doubted] > 0).any()
        and (strict.depth_mm > 0).sum() > 0.9 * (found.depth_mm > 0).sum()
    )


def test_a_step_between_two_surfaces_is_sharp(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the neighbours' offers switched off, the control, the error beside the step is
    larger."""
    step_mm = np.where(INSIDE, np.where(X < 160, 1760.0, 1800.0), 0.0)
    image = frame(step_mm, CUT, FAMILY)
    beside = INSIDE & (np.abs(X - 159.5) < 6) & (np.abs(Y - 160) < 70)

    def error_mm() -> float:
        return float(np.abs(route(CUT, FAMILY).measure(image).depth_mm - step_mm)[beside].mean())

    sharp = error_mm()
    monkeypatch.setattr(local_fit, "SIDE_PERIODS", (0.0,))
    assert sharp < 0.8 * error_mm()


def moved_rig(projector_px: float) -> Rig:
    """What photographs where `CUT` is its calibration: its projector's image is shifted and a
    little turned."""
    turn = 0.3 * projector_px / CUT.projector.fx
    first, second, third = np.array([[1, -turn, 0], [turn, 1, 0], [0, 0, 1]]) @ CUT.R
    projector = replace(
        CUT.projector, cx=CUT.projector.cx + projector_px, cy=CUT.projector.cy - projector_px / 2
    )
    return replace(CUT, projector=projector, rotation=(tuple(first), tuple(second), tuple(third)))


BESIDE = {f"calibration {px} px": moved_rig(px) for px in (-1.0, 0.5, 1.0)}
BESIDE |= {f"wall at {depth_m} m": replace(CUT, background_m=depth_m) for depth_m in (3.14, 3.26)}


@pytest.mark.long
@pytest.mark.parametrize("true", BESIDE.values(), ids=BESIDE)
def test_the_wall_is_found_beside_its_place(true: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    image = frame(DEPTH_MM, true, FAMILY)
    missed, invented = shares(image)
    assert missed < 2e-3 and invented < 5e-3
    monkeypatch.setattr(empty_scene, "MOVED_SHARE", np.inf)
    monkeypatch.setattr(empty_scene, "EXACT_RAD", np.inf)
    assert shares(image)[1] > 0.05


def test_a_surface_far_from_the_walls_phases_is_no_wall() -> None:
    image = frame(np.full(DEPTH_MM.shape, 1800.0), CUT, FAMILY)
    assert (route(CUT, FAMILY).measure(image).depth_mm > 0).mean() > 0.95


def like_the_wall(true: Rig) -> NDArray[np.float64]:
    """A slab that shows ``true`` all but the phases that `CUT` expects of its wall: its depth in mm
    (H, W)."""
    expected, carriers = route(CUT, FAMILY).model.carriers, Carriers.of(true, FAMILY)
    wall = expected.phases(expected.nearness(3200.0))
    depths_mm = np.arange(1500.0, 2100.0, 1.0)
    off_rad = [
        np.hypot(*wrapped(carriers.phases(carriers.nearness(depth)) - wall)).mean()
        for depth in depths_mm
    ]
    return np.where(INSIDE, depths_mm[np.argmin(off_rad)], 0.0)


@pytest.mark.long
@pytest.mark.parametrize(
    "true", [CUT, BESIDE["calibration 1.0 px"]], ids=["no wall", "calibration 1 px"]
)
def test_a_flat_object_is_not_taken_for_the_wall(true: Rig) -> None:
    image = frame(like_the_wall(true), true, FAMILY)
    if true is CUT:
        image = np.where(INSIDE, image, noisy(np.full(image.shape, 3.0), seed=4))
    missed, invented = shares(image)
    assert missed < 0.1 and invented < 5e-3


def test_a_projectors_gamma_does_not_bend_the_corners_of_the_wall(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # A corner of the whole image, where the wall's light falls off most.
    corner = replace(WHOLE, camera=replace(WHOLE.camera, width=320, height=320))
    light = empty_scene.plane_irradiance(corner, corner.background_m)
    image = frame(DEPTH_MM, corner, FAMILY, background_grey=150 * light / light.max(), gamma=2.6)

    def invented() -> float:
        anew = two_carriers(TwoCarriers(corner, family=FAMILY))
        return float((anew.measure(image).depth_mm > 0)[~INSIDE].mean())

    assert invented() < 5e-3
    monkeypatch.setattr(empty_scene, "RESPONSE_POWERS", ())
    assert invented() > 0.02


@pytest.mark.long
@pytest.mark.parametrize("frames", [1, 3])
def test_what_is_in_the_images_border_alone_is_no_object(
    frames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A blurred image: beyond its border the blur has nothing to mix."""
    method = two_carriers(TwoCarriers(CUT, family=FAMILY, moved=0 if frames == 3 else None))
    images = [frame(DEPTH_MM, CUT, FAMILY, number=number) for number in range(frames)]
    images = [
        cv2.GaussianBlur(image, (0, 0), 2.0, borderType=cv2.BORDER_REPLICATE) for image in images
    ]
    border = np.ones(DEPTH_MM.shape, bool)
    border[9:-9, 9:-9] = False

    def answered() -> float:
        return float((method.measure(images).depth_mm > 0)[border].mean())

    assert answered() == 0
    monkeypatch.setattr(observe, "beyond_border", lambda region, period_px: region)
    assert answered() > 0.01
