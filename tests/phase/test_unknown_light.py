"""Images that show no known background: fringes of any contrast on surfaces of any brightness, and
of any period."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from crossed_scenes import noisy
from flat_planes import RIG, photograph, plane_depth_m, plane_fringe
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase import geometry
from fpp_ml_bench.baselines.phase.depth import Reason
from fpp_ml_bench.baselines.phase.observe import OneCarrier
from fpp_ml_bench.baselines.phase.route import one_carrier
from fpp_ml_bench.baselines.phase.settings import Settings
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.errors import CaptureError
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig import Rig

SMALL = paper_rig(240)
NARROW = replace(SMALL, working_range_mm=(1600.0, 2000.0))
LONG = replace(SMALL, pitch_horizontal_px=110.0, pitch_vertical_px=110.0)
"""34 image px a period at 240 px."""


def in_the_dark(
    rig: Rig, depth_m: NDArray[np.float64], contrast: float = 0.9, direction: str = "vertical"
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """A disk of the surface ``depth_m`` (H, W), whose brightness changes by a factor of two across
    it, in a dark room where an unmodulated lamp lights a corner; and where the disk is. Phase by
    `Rig.project`."""
    x, y = rig.camera.rays()
    coordinate = rig.project(np.stack([x, y, np.ones_like(x)], axis=-1) * depth_m[..., None])[
        direction == "horizontal"
    ]
    height, width = x.shape
    v, u = np.mgrid[:height, :width]
    disk = (u - width / 2) ** 2 + (v - height / 2) ** 2 < (0.35 * width) ** 2
    mean = 30 * (1 + u / width)
    fringe = mean * (1 + contrast * np.cos(2 * np.pi * coordinate / rig.pitch(direction)))  # type: ignore[arg-type]
    grey = np.where(disk, fringe, 0.0) + 2
    grey[: height // 6, : width // 6] = 60
    return noisy(grey, 1.0, seed=1), disk


def bowl(rig: Rig, nearest_m: float, farthest_m: float) -> NDArray[np.float64]:
    """Depth of a surface of revolution about the camera's axis."""
    x, y = rig.camera.rays()
    radius = (x**2 + y**2) / (0.35 * rig.camera.width / rig.camera.fx) ** 2
    return nearest_m + (farthest_m - nearest_m) * np.minimum(radius, 1.2)


@pytest.mark.parametrize("contrast", [1.0, 0.8])
def test_range_and_continuity_settle_the_order_of_a_surface_that_fills_the_range(
    contrast: float,
) -> None:
    depth_m = bowl(NARROW, 1.62, 1.97)
    image, disk = in_the_dark(NARROW, depth_m, contrast)
    measurement = one_carrier(OneCarrier(NARROW, Settings("vertical"))).measure(image)
    answered = measurement.depth_mm > 0
    error = np.abs(measurement.depth_mm - depth_m * 1000)
    assert measurement.background_share == 0
    assert (answered & disk).sum() > 0.9 * disk.sum()
    assert (
        answered & ~disk
    ).sum() < 0.03 * disk.sum()  # neither the dark room nor the lamp's corner
    assert np.median(error[answered & disk]) < 3
    settled = answered & disk & (measurement.reason == Reason.MEASURED)
    assert settled.sum() > 0.6 * disk.sum()
    assert (error[settled] < 125).all()  # no wrong order among them; a period is 250 mm deep
    assert (error < 3 * measurement.sigma_mm)[settled].mean() > 0.9


def test_no_known_background_is_one_that_is_not_in_view() -> None:
    rig = replace(NARROW, background_m=None)
    image, _ = in_the_dark(NARROW, bowl(NARROW, 1.62, 1.97))
    unknown, unseen = (
        one_carrier(OneCarrier(some, Settings("vertical"))).measure(image) for some in (rig, NARROW)
    )
    np.testing.assert_array_equal(unknown.depth_mm, unseen.depth_mm)
    np.testing.assert_array_equal(unknown.reason, unseen.reason)


def test_a_dim_texture_is_not_taken_for_the_background() -> None:
    x, y = SMALL.camera.rays()
    grey = 3 + 1.5 * np.cos(2 * np.pi * 95 * (x + 0.4 * y))
    measurement = one_carrier(OneCarrier(SMALL)).measure(noisy(grey, 0.6, seed=0))
    assert measurement.background_share == 0
    assert not measurement.depth_mm.any()


@pytest.mark.long
def test_long_periods_are_measured_on_a_smaller_image(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = replace(RIG, pitch_horizontal_px=110.0, pitch_vertical_px=110.0)
    row = photograph("cracker_box", "A60", rig)
    assert rig.image_px_per_period("horizontal") > 60
    errors = []
    for longest_px in (geometry.LONGEST_PX, 1e9):  # resampled, and not
        monkeypatch.setattr(geometry, "LONGEST_PX", longest_px)
        model = OneCarrier(rig, Settings())
        measurement = one_carrier(model).measure(row.frames[0])
        target = row.depth_mm > 0
        assert measurement.depth_mm.shape == target.shape
        assert (measurement.depth_mm[target] > 0).mean() > 0.95
        errors.append(np.median(np.abs(measurement.depth_mm - row.depth_mm)[target]))
        answered = measurement.depth_mm > 0
        layer = model.captured_layer.at(answered)
        again = layer.depth_mm(
            measurement.wrapped_phase_rad[answered].astype(float), measurement.order[answered]
        )
        assert np.abs(again - measurement.depth_mm[answered]).max() < 0.05
        assert sum(measurement.counts.values()) == target.size
    assert errors[0] < 1.1 * errors[1] + 1


def test_what_comes_back_is_interpolated_but_not_across_a_jump(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(geometry, "LONGEST_PX", 9)
    monkeypatch.setattr(geometry, "BEST_PX", 8)
    depth_m = plane_depth_m(LONG, 1.7, (0.05, 0.1))
    right = np.arange(240) >= 120
    image = plane_fringe(LONG, 18, depth_m)
    image[:, right] = plane_fringe(LONG, 18, depth_m + 0.25)[:, right]
    exact_mm = 1000 * (depth_m + 0.25 * right)
    told = {"white_grey": 180.0, "ambient_grey": 6.0}
    model = OneCarrier(LONG, Settings("vertical", **told))  # type: ignore[arg-type]
    assert model.resampling.needed and model.rig.camera.width < 60
    assert (
        model.resampling.captured_crop((slice(0, 10), slice(1, model.rig.camera.width)))[1].stop
        == 240
    )
    measurement = one_carrier(model).measure(image)
    away = np.abs(np.arange(240) - 119.5) > 45
    error = np.abs(measurement.depth_mm - exact_mm)[:, away][60:180]
    assert np.median(error) < 5
    empty = np.zeros((240, 240), np.uint8)
    assert not one_carrier(OneCarrier(LONG)).measure(empty).depth_mm.any()


def test_a_mask_of_the_user(tmp_path: Path) -> None:
    def png(mask: NDArray[np.bool_]) -> bytes:
        return cv2.imencode(".png", mask * np.uint8(255))[1].tobytes()

    image, disk = in_the_dark(NARROW, bowl(NARROW, 1.62, 1.97))
    file = tmp_path / "mask.png"
    file.write_bytes(png(disk))
    method = load_method("phase", NARROW, direction="vertical", mask=file)
    assert method.settings["mask"] == "mask.png"
    depth_mm = method.predict([None] * 18 + [image])
    assert not depth_mm[~disk].any() and (depth_mm[disk] > 0).mean() > 0.9
    for name, content, message in (
        ("absent.png", None, "found nothing there"),
        ("text.png", b"no image", "text.png: .*capture or copy it again"),
        ("small.png", png(disk[:3, :4]), r"got \(3, 4\)"),
        ("empty.png", png(disk & ~disk), "shows no object"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(CaptureError, match=message):
            load_method("phase", NARROW, mask=tmp_path / name)
