"""The empty scene on rigs and in lights that are not the paper's: lenses that darken and blur the
corners, and a projector that does not light all of the wall."""

from dataclasses import replace

import numpy as np
import pytest

from fpp_ml_bench.baselines.learned.scenes import photographed
from fpp_ml_bench.baselines.phase import empty_scene
from fpp_ml_bench.baselines.phase.observe import OneCarrier, TwoCarriers
from fpp_ml_bench.baselines.phase.settings import Settings
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.sample import VOID
from fpp_ml_bench.optics.named_rigs import crossed_rig

RIG = crossed_rig(480, "crossed-18")
WIDE = replace(
    RIG,
    camera=replace(RIG.camera, fx=560.0, fy=560.0),
    projector=replace(RIG.projector, fx=900.0, fy=900.0),
)
"""Both devices see twice as much, to the corners of which light falls off by more than a half."""
LIGHT = named_light("paper").changed(ambient_grey=15.0)
LENSES = LIGHT.changed("projector", falloff=4, defocus_px=1.0).changed(
    "camera", falloff=8, read_noise_e=3.0
)


def _invented(rig, light, fringes: str) -> float:
    """Share of the background that is taken for object."""
    studio = Studio(BuildSettings(rig, ("mug",), light=light))
    model = (
        TwoCarriers(rig) if fringes == "crossed" else OneCarrier(rig, Settings(direction=fringes))
    )
    frame = 0 if fringes == "crossed" else rig.sequence.sinusoids(fringes)[0]
    images, depth_mm, flags = photographed(studio, "mug", "A0", (frame,))
    seen = model.observe(images[0])
    inside = np.zeros(depth_mm.shape, bool)
    inside[seen.crop] = seen.inside
    assert seen.background.shown and inside[depth_mm > 0].mean() > 0.9
    return float(inside[(depth_mm == 0) & ((flags & VOID) == 0)].mean())


@pytest.mark.long
@pytest.mark.parametrize("fringes", ["crossed", "horizontal"])
def test_dark_and_blurred_corners_are_no_object(fringes: str) -> None:
    assert _invented(WIDE, LENSES, fringes) < 0.01


NARROW = replace(RIG, projector=replace(RIG.projector, width=700, cx=455.5))
"""A projector that leaves a quarter of the wall dark."""


@pytest.mark.long
def test_a_wall_beyond_the_projectors_image_is_no_object(monkeypatch: pytest.MonkeyPatch) -> None:
    lit, edge = empty_scene.pattern_on_plane(NARROW, NARROW.background_m)
    assert 0.02 < 1 - lit.mean() < 0.4 and edge.any()
    for fringes in ("crossed", "horizontal", "vertical"):
        assert _invented(NARROW, LIGHT, fringes) < 0.005
    found = _invented(NARROW, LENSES, "crossed")
    monkeypatch.setattr(
        empty_scene,
        "pattern_on_plane",
        lambda rig, depth_m: (np.ones(lit.shape, np.float32), np.zeros(lit.shape, bool)),
    )
    assert found < 0.02 and _invented(NARROW, LENSES, "crossed") > 1.5 * found
