"""Objects scaled with a rig's working volume: a near rig sees what the paper's sees, smaller."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from conftest import fpp_bench, printed, refusal

from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.render.meshes import solid_mesh
from fpp_ml_bench.loaders.render.scene import BuildSettings, UserMesh, volume_scale
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.named_rigs import crossed_rig, paper_rig

SIZE = 192


@pytest.mark.long
def test_a_rig_a_third_as_large_sees_the_same_in_a_third_of_the_depth():
    light = named_light("workshop").changed("camera", read_noise_e=0.1, full_well_e=1e6)

    def photographed(scale):
        rig = paper_rig(SIZE).times(scale)
        settings = BuildSettings(rig, ("mug",), light=light, object_scale=scale)
        return Studio(settings).photograph(settings.sized(solid_mesh("mug")), "A60")

    natural, small = photographed(1.0), photographed(0.3)
    assert np.abs(small.depth_exact_mm - 0.3 * natural.depth_exact_mm).max() < 1e-3
    assert small.measured["distance_mm"] == pytest.approx(0.3 * natural.measured["distance_mm"])
    for index in (0, 20, 40):
        apart = small.frames[index].astype(int) - natural.frames[index]
        assert np.abs(apart).max() <= 1 and (apart != 0).mean() < 0.01
    both = (small.depth_mm > 0) & (natural.depth_mm > 0)
    assert both.sum() > 0.95 * (natural.depth_mm > 0).sum()
    assert np.median(np.abs(small.depth_mm - 0.3 * natural.depth_mm)[both]) < 0.01


def test_the_volume_of_a_rig_tells_how_large_objects_may_be():
    for rig in (paper_rig(), paper_rig(224), crossed_rig(1280)):
        assert volume_scale(rig) == 1.0
    assert volume_scale(paper_rig().times(0.2505)) == 0.25
    short = replace(paper_rig(), working_range_mm=(1700.0, 1900.0))
    assert volume_scale(short) == 0.333
    narrow = replace(paper_rig(), camera=replace(paper_rig().camera, fx=5000.0))
    assert volume_scale(narrow) == 0.502
    for scale in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(BuildError, match="object scale"):
            BuildSettings(paper_rig(SIZE), ("mug",), object_scale=scale)


def test_users_meshes_keep_their_size():
    own = UserMesh("mine", "mine.stl")
    settings = BuildSettings(
        paper_rig(SIZE).times(0.5), ("mine", "mug"), user_meshes=(own,), object_scale=0.5
    )
    mug = solid_mesh("mug")
    assert settings.sized(replace(mug, name="mine")).vertices_m is mug.vertices_m
    assert np.array_equal(settings.sized(mug).vertices_m, 0.5 * mug.vertices_m)


@pytest.mark.long
def test_the_command_scales_and_says_so(tmp_path):
    file = tmp_path / "near.yaml"
    file.write_text(yaml.safe_dump(paper_rig(SIZE).times(0.3).to_dict()))
    build = f"build --rig {file} --objects cork --light workshop --workers 1 --out {tmp_path}"
    said = printed(fpp_bench, f"{build}/set")
    assert "objects, textures and focus are 0.3 times as large" in said
    dataset = DatasetFolder(tmp_path / "set")
    settings = json.loads((tmp_path / "set" / "manifest.json").read_text())["settings"]
    assert settings["object_scale"] == 0.3
    assert settings["light"]["projector"]["focus_m"] == pytest.approx(1.8)
    depth_mm = dataset.depth_mm(dataset.samples("train")[0], "depth_exact")
    assert 450 < depth_mm[depth_mm > 0].mean() < 630
    said = refusal(fpp_bench, f"{build}/own --object-scale 1")
    assert "does not fit the working range" in said
