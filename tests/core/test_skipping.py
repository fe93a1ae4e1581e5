"""What a scene does not need is left out, and the results are the same bytes with skipping off."""

import numpy as np
import pytest
from captures import LENSES, PAPER, TURNED, capture, tilted
from conftest import TINY_SIZE, tiny_settings

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.run import captured_frames
from fpp_ml_bench.coding.code import Limits
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.loaders.render.builder import build
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.render.raycast import TracedObject
from fpp_ml_bench.loaders.render.sensor import Exposure
from fpp_ml_bench.skipping import SWITCH, skipping, skipping_enabled


def test_the_switch_is_the_environment_and_comes_back(monkeypatch):
    monkeypatch.delenv(SWITCH, raising=False)
    assert skipping_enabled()
    with skipping(False):
        assert not skipping_enabled()
        with skipping(True):
            assert skipping_enabled()
        assert not skipping_enabled()
    assert skipping_enabled()
    monkeypatch.setenv(SWITCH, "0")
    assert not skipping_enabled()


SHADY = (
    named_light("paper")
    .changed("bounces", shadows=True, interreflection=False, ambient_occlusion=False)
    .changed("camera", rays_across=1)
)


def counting(monkeypatch):
    """What really happens: shadow rays traced, pixels exposed whole or in part."""
    counts = {"rays": 0, "exposed": 0}
    shadowed, expose = TracedObject.shadowed, Exposure.expose

    def counted_rays(self, points_m, light_m):
        counts["rays"] += len(points_m)
        return shadowed(self, points_m, light_m)

    def counted_expose(self, frames, lit, pixels, *rest):
        counts["exposed"] += len(frames) * pixels.size
        return expose(self, frames, lit, pixels, *rest)

    monkeypatch.setattr(TracedObject, "shadowed", counted_rays)
    monkeypatch.setattr(Exposure, "expose", counted_expose)
    return counts


def test_what_the_manifest_says_is_what_was_traced_and_exposed(tmp_path, monkeypatch):
    counts = counting(monkeypatch)
    settings = tiny_settings(objects=("cork",), stored="single_shot", light=SHADY)
    manifest = build(tmp_path / "on", settings, workers=1)
    rows = manifest.samples["train"]
    pixels, traced = TINY_SIZE**2, counts["rays"]
    assert traced == sum(row["shadow_rays"] for row in rows) < 0.1 * len(rows) * pixels
    # Frame 0 whole; it and 49 that only the ground truth needs at the object alone; black and white
    # nowhere.
    assert counts["exposed"] == sum(pixels + 50 * row["exact_px"] for row in rows)
    counts.update(rays=0, exposed=0)
    with skipping(False):
        build(tmp_path / "off", settings, workers=1)
    assert counts["rays"] > 2 * traced
    assert counts["exposed"] == sum(52 * (pixels + row["exact_px"]) for row in rows)


# ---- decoding

RIGS = pytest.mark.parametrize("rig", [PAPER, TURNED, LENSES], ids=["paper", "turned", "lenses"])


def sparse(rig, share=0.3):
    """Frames of a tilted plane that fills a band of the image, far background elsewhere, some of it
    dark."""
    shape = rig.camera.height, rig.camera.width
    surface = tilted(rig)
    surface[int(share * shape[0]) :] = 3.2
    albedo = np.full(shape, 0.45)
    albedo[-shape[0] // 4 :] = 0.005
    return capture(rig, surface, albedo=albedo), surface < 3


@RIGS
@pytest.mark.parametrize("steps", [3, None])
def test_depth_alone_is_the_depth_with_reasons(rig, steps):
    frames, seen = sparse(rig)
    everything = decode_stack(frames, rig, steps=steps)
    alone = decode_stack(frames, rig, steps=steps, reasons=False)
    np.testing.assert_array_equal(alone.depth_mm, everything.depth_mm)
    decoded = alone.depth_mm > 0
    assert decoded.sum() > 0.5 * seen.sum()
    # A pixel without depth says so, though perhaps for another reason; one with depth is decoded.
    np.testing.assert_array_equal(alone.reason == 0, decoded)
    assert everything.second_px == seen.size
    if rig is LENSES:  # no bound is known for a projector with distortion: nothing is left out
        assert alone.second_px == seen.size
    else:
        assert decoded.sum() <= alone.second_px < 1.1 * seen.sum() < 0.4 * seen.size
    with skipping(False):
        off = decode_stack(frames, rig, steps=steps, reasons=False)
    np.testing.assert_array_equal(off.depth_mm, alone.depth_mm)
    np.testing.assert_array_equal(off.reason, everything.reason)
    assert off.second_px == seen.size


@pytest.mark.parametrize("disagreement", [0.02, 1.5, 8.0])
def test_no_pixel_near_the_ends_of_the_range_is_lost(disagreement):
    """Planes at the very ends of the range, noise that moves pixels across them, and any
    tolerance."""
    near_mm, far_mm = PAPER.working_range_mm
    shape = PAPER.camera.height, PAPER.camera.width
    for depth_mm in (near_mm, far_mm):
        frames = capture(PAPER, np.full(shape, depth_mm / 1000), noise=12.0)
        limits = Limits(max_disagreement_px=disagreement)
        everything = decode_stack(frames, PAPER, steps=3, limits=limits)
        alone = decode_stack(frames, PAPER, steps=3, limits=limits, reasons=False)
        assert 0.01 < (everything.depth_mm > 0).mean() < 0.9
        np.testing.assert_array_equal(alone.depth_mm, everything.depth_mm)


def test_an_image_without_object_never_reads_the_second_direction():
    frames = capture(PAPER, np.full((PAPER.camera.height, PAPER.camera.width), 3.2))
    decoded = decode_stack(frames, PAPER, reasons=False, threads=2)
    assert decoded.second_px == 0 and not decoded.depth_mm.any()


# ---- reading


def test_frames_that_a_method_does_not_use_are_not_read(opened):
    method = ClassicalMethod(opened.rig, direction="vertical", steps=3)
    frames = captured_frames(opened, method, opened.samples("test")[0])
    assert [i for i, frame in enumerate(frames) if frame is not None] == list(method.frames_used)
