"""Lights: the named ones, strict YAML files, every wrong key named, and changed copies."""

import pytest
import yaml

from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders.render.light import (
    LIGHTS,
    NAMED,
    CameraLight,
    Light,
    load_light,
    named_light,
)


def written(tmp_path, text):
    path = tmp_path / "own.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", NAMED)
def test_named_lights_are_the_files_beside_the_module(name):
    light, file = load_light(name), LIGHTS / f"{name}.yaml"
    assert light is named_light(name) and light.name == name and load_light(file) == light
    # Every number written is the number read, and what is written again is the same light.
    read = light.model_dump(mode="json")
    for key, value in yaml.safe_load(file.read_text()).items():
        assert read[key] == ({**read[key], **value} if isinstance(value, dict) else value)
    assert Light.model_validate(yaml.safe_load(yaml.safe_dump(read))) == light


def test_named_lights_are_all_the_files_there_are():
    assert sorted(path.stem for path in LIGHTS.glob("*.yaml")) == sorted(NAMED)


def test_the_papers_light_is_plain():
    light = named_light("paper")
    assert light.projector == light.projector.model_construct()  # every default is "off"
    assert (
        light.surface.gloss == 0 and light.surface.textures == "none" and not light.bounces.shadows
    )
    assert light.camera.exposure == 1 and light.camera.response == 1 and light.camera.bits == 8
    assert (light.motion_mm, light.calibration_px) == (0, 0)


def test_a_file_may_name_as_little_as_its_name(tmp_path):
    assert load_light(written(tmp_path, "name: mine")) == Light(name="mine")
    full = load_light(
        written(tmp_path, "name: mine\ncamera: {full_well_e: null, exposure: [0.5, 2], bits: 12}\n")
    )
    assert full.camera == CameraLight(full_well_e=None, exposure=(0.5, 2.0), bits=12)


def test_every_wrong_key_is_named(tmp_path):
    path = written(
        tmp_path,
        "name: mine\nprojector: {gamma: 2.2, falloff: 9}\nsurface: {albedo: '0.8', textures: "
        "marble}\n"
        "bounces: {shadows: 1}\ncamera: {bits: 9, exposure: [2, 1]}\nambient_grey: -1\nlamp: 3\n",
    )
    with pytest.raises(BuildError) as error:
        load_light(path)
    message = str(error.value)
    assert str(path) in message
    for key in (
        "projector.gamma",
        "projector.falloff",
        "surface.albedo",
        "surface.textures",
        "bounces.shadows",
        "camera.bits",
        "ambient_grey",
        "lamp",
    ):
        assert f"\n  {key}" in message, key


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("{}", "name: is missing"),
        ("name: ''", "name"),
        ("name: a\ncamera: {exposure: [2, 1]}", "exposure"),
        ("name: a\ncamera: {exposure: [0.5, 1, 2]}", "exposure"),
        ("name: a\ncamera: {response: [0, 0.6, 0.5, 1]}", "camera.response"),
        ("name: a\ncamera: {response: [0.1, 1]}", "camera.response"),
        ("name: a\ncamera: {response: 0.1}", "camera.response"),
        ("name: a\ncamera: {rays_across: 2.0}", "camera.rays_across"),
        ("name: a\ncamera: {full_well_e: 50}", "camera.full_well_e"),
        ("name: a\nsurface: {albedo: 1.0}", "surface.albedo"),
        ("name: a\nsurface: {gloss: 1.0}", "surface.gloss"),  # nothing to set the exposure on
        ("name: a\nprojector: {defocus_px: -1}", "projector.defocus_px"),
        ("name: a\nprojector: {focus_m: 0}", "projector.focus_m"),
        ("name: a\ncalibration_px: .inf", "calibration_px"),
    ],
)
def test_files_that_are_refused(tmp_path, text, named):
    with pytest.raises(BuildError, match=r"own\.yaml") as error:
        load_light(written(tmp_path, text))
    assert named in str(error.value)


def test_names_and_files_that_are_not_there(tmp_path):
    with pytest.raises(BuildError, match="paper, workshop, hard or a YAML file"):
        load_light("sunny")
    with pytest.raises(BuildError, match=r"none\.yaml"):
        load_light(tmp_path / "none.yaml")


def test_shares_of_the_albedo_leave_the_description_of_other_lights_as_it_was():
    light = named_light("paper")
    assert not {"object_share", "wall_share"} & light.model_dump()["surface"].keys()
    painted = light.changed("surface", object_share=0.2)
    assert painted.model_dump(mode="json")["surface"]["object_share"] == 0.2 and painted != light
    assert Light.model_validate(painted.model_dump()) == painted


def test_changed_copies_are_checked_like_a_file():
    light = named_light("paper")
    brighter = light.changed("camera", exposure=2.0, bits=10)
    assert (brighter.camera.exposure, brighter.camera.bits) == (2.0, 10)
    assert brighter.changed("camera", exposure=1.0, bits=8) == light
    for stage, values in (("camera", {"iso": 100}), ("", {"ambient_grey": -1.0})):
        with pytest.raises(ValueError, match="validation error"):
            light.changed(stage, **values)
    with pytest.raises(KeyError):
        light.changed("lens", blur_px=1.0)
    assert len({light, brighter, light.changed()}) == 2  # hashable, equal by value
