"""The light of crossed fringes: against a convolution of the image, and in a dataset."""

from dataclasses import replace

import numpy as np
import pytest
from rendering import PAPER, RIG
from scipy.ndimage import gaussian_filter, map_coordinates

from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.constants import VIEWS
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders.render.builder import build
from fpp_ml_bench.loaders.render.projector import PatternLight, defocus_variance_px2, response_table
from fpp_ml_bench.loaders.render.scene import BuildSettings, preset_settings
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.loaders.storage.verification import verify
from fpp_ml_bench.optics.named_rigs import CROSSED, crossed_rig, paper_rig
from fpp_ml_bench.optics.sequence import CodedSequence, Sequence

SHORT = replace(RIG, sequence=Sequence(steps=3))


@pytest.mark.long
@pytest.mark.parametrize("response", [1.0, (0.0, 0.3, 0.5, 1.0)])
@pytest.mark.parametrize("defocus_px", [0.0, 2.5])
def test_light_is_the_image_through_response_and_blur(response, defocus_px):
    family = Crossed((18.0, 13.0), (15.0, 80.0), (0.6, 0.4), ((90.0, 30.0),))
    rig = SHORT.with_crossed(family)
    light = PAPER.changed(
        "projector", response=response, pixel_blur_px=0.7, defocus_px=defocus_px, focus_m=1.6
    ).projector
    pattern, index = PatternLight.of(rig, light), rig.sequence.crossed_frames[0]
    u, v = np.random.default_rng(3).uniform(190, 250, (2, 500))
    distance_m = np.full(500, 2.1)
    out = pattern.read(pattern.place(u, v, distance_m, rig, light), np.full(500, 2.0))
    fine, image = 4, response_table(response)[family.image(912, 1140, 0)[150:290, 150:290]]
    places = np.arange(139 * fine + 1) / fine
    whole = map_coordinates(image, np.meshgrid(places, places, indexing="ij"), order=1)
    variance = light.pixel_blur_px**2 + (
        defocus_variance_px2(rig, light, distance_m)[0] if defocus_px else 0.0
    )
    area = [
        rig.projector_px_per_image_px(direction) ** 2 / 12
        for direction in ("horizontal", "vertical")
    ]
    blurred = gaussian_filter(whole, [fine * np.sqrt(variance + a) for a in area])
    expected = map_coordinates(blurred, [(v - 150) * fine, (u - 150) * fine], order=1)
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose(
        out[index], 2 * expected, atol=0.008
    )  # of which rounding to 8 bits 0.004


@pytest.mark.long
def test_a_dataset_of_crossed_frames_has_the_depth_of_the_other_frames(tmp_path):
    family = Crossed((18.0, 14.0), (0.0, 75.0), shifts_deg=CROSSED["crossed-18"].shifts_deg)
    settings = BuildSettings(paper_rig(240).with_crossed(family), ("cork",), stored="crossed")
    build(tmp_path / "crossed", settings, 1)
    build(tmp_path / "paper", BuildSettings(paper_rig(240), ("cork",), stored="single_shot"), 1)
    opened, paper = DatasetFolder(tmp_path / "crossed"), DatasetFolder(tmp_path / "paper")
    assert opened.configs == ("single_shot", "crossed") and opened.manifest.stored_frames == (
        0,
        1,
        2,
    )
    assert not verify(tmp_path / "crossed")
    for view in VIEWS[:2]:
        depth_mm, other_mm = (dataset.depth_mm(f"cork_{view}") for dataset in (opened, paper))
        both = (depth_mm > 0) & (other_mm > 0)
        assert both.sum() > 100 and np.abs(depth_mm - other_mm)[both].mean() < 0.5
        frames = np.stack([opened.frame(f"cork_{view}", n) for n in range(3)]).astype(float)
        assert np.median(np.ptp(frames, axis=0)[both]) > 40


def test_what_can_not_be_built_is_said():
    alone = replace(
        paper_rig(240), sequence=CodedSequence(None, None, ("crossed",), Crossed((18.0, 14.0)))
    )
    with pytest.raises(BuildError, match="no ground truth can be decoded; add the horizontal"):
        BuildSettings(alone, ("cork",))
    with pytest.raises(BuildError, match="frames 'crossed': this rig's sequence has none"):
        BuildSettings(paper_rig(240), ("cork",), stored="crossed")
    assert preset_settings("unseen", 480, rig="crossed") == replace(
        preset_settings("unseen", 480), rig=crossed_rig(480), stored="crossed"
    )
