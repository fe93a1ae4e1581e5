"""Counterfactual scenes: the unchanged one is the dataset's, and a changed one differs in what it
says."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import tiny_settings

from fpp_ml_bench.baselines.diagnostics.scenes import (
    LARGEST_SHIFT_RAD,
    ONE_SURFACE,
    PITCH_FACTOR,
    Scene,
    SceneRenderer,
    chosen_samples,
    counterfactuals,
    direct_light,
    layer_of,
    moved,
    original,
    plane,
)
from fpp_ml_bench.baselines.phase.geometry import Carriers
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.loaders.captures.exports import pixel_normals
from fpp_ml_bench.loaders.render.builder import build
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.named_rigs import crossed_rig, paper_rig

SAMPLE, OTHER = "power_drill_A0", "mug_A60"


@pytest.fixture(scope="module")
def renderer(opened):
    return SceneRenderer.of(opened)


@pytest.fixture(scope="module")
def sample_scene(opened, renderer):
    return original(opened, renderer, SAMPLE)


@pytest.fixture(scope="module")
def scenes(opened, renderer, sample_scene):
    return counterfactuals(
        renderer, sample_scene, "horizontal", [object_mask(opened.depth_mm(OTHER))]
    )


def of_kind(scenes, *kinds):
    return [variant for variant in scenes if variant.kind in kinds]


WORN = (
    named_light("hard")
    .changed("surface", gloss=0.0, textures="none")
    .changed(calibration_px=0.0)
    .changed("camera", blur_px=0.0, falloff=0, exposure=0.8)
)
"""A defocused, flickering projector and a sensor with a response: stages that scenes share with
their dataset."""


@pytest.mark.long
@pytest.mark.parametrize("light", [named_light("paper"), WORN], ids=["paper", "hard"])
def test_an_unchanged_scene_is_the_datasets_own(light, tmp_path):
    """Of a dataset in direct light, one ray a pixel: bounces and mixed pixels need the mesh, which
    a scene has not."""
    direct = light.changed("bounces", interreflection=False, ambient_occlusion=False, shadows=False)
    settings = tiny_settings(
        light=direct.changed("camera", rays_across=1), objects=("mug", "power_drill")
    )
    build(tmp_path / "direct", settings, workers=1)
    dataset = DatasetFolder(tmp_path / "direct")
    renderer = SceneRenderer.of(dataset)
    assert renderer.lamp == settings.light
    for sample in (SAMPLE, OTHER):
        sample_scene = original(dataset, renderer, sample)
        frames = renderer.frames(sample_scene, range(len(dataset.sequence)))
        for index, frame in enumerate(frames):
            difference = np.abs(frame.astype(int) - dataset.frame(sample, index))
            assert difference.max() <= 1
            assert (difference > 0).sum() <= 5
        same = sample_scene.mask == (dataset.depth_mm(sample) > 0)
        assert (~same).sum() <= 1


def test_direct_light_keeps_projector_sensor_and_brightness():
    hard = named_light("hard")
    direct = direct_light(hard)
    assert direct.projector == hard.projector and direct.ambient_grey == hard.ambient_grey
    off = {"gloss", "textures", "interreflection", "shadows", "ambient occlusion"}
    off |= {"lens blur", "vignetting", "calibration error"}
    assert {name for name, on in hard.stages().items() if on and not direct.stages()[name]} <= off
    assert not any(direct.stages()[name] for name in off)
    low, high = hard.camera.exposure
    assert (
        direct.camera.exposure == pytest.approx(np.sqrt(low * high))
        and direct_light(direct) == direct
    )


def test_a_move_shifts_the_phase_and_keeps_outline_and_brightness(
    opened, renderer, sample_scene, scenes
):
    sequence, layer = opened.sequence, layer_of(opened.rig, "horizontal")
    before = layer.at(sample_scene.mask).absolute_phase(sample_scene.depth_mm[sample_scene.mask])
    moves = of_kind(scenes, "phase", "constant")
    assert {move.name for move in moves} == {"constant", "ramp across", "ramp down", "bump"}
    near_mm, far_mm = renderer.rig.working_range_mm
    for move in moves:
        assert ((move.scene.depth_mm > 0) == (sample_scene.depth_mm > 0)).all()
        object_depths = move.scene.depth_mm[move.scene.depth_mm > 0]
        assert near_mm - 1e-6 <= object_depths.min() and object_depths.max() <= far_mm + 1e-6
        shift = (
            layer.at(sample_scene.mask).absolute_phase(move.scene.depth_mm[sample_scene.mask])
            - before
        )
        assert np.abs(shift).max() <= abs(move.amplitude_rad) + 1e-9 <= LARGEST_SHIFT_RAD + 2e-9
        white = renderer.frames(move.scene, [sequence.white])[sequence.white]
        np.testing.assert_array_equal(
            white, renderer.frames(sample_scene, [sequence.white])[sequence.white]
        )
    bump = next(move for move in of_kind(scenes, "light") if move.name == "bump")
    fringe, unmoved = (renderer.frames(scene, [0])[0] for scene in (bump.scene, sample_scene))
    assert (fringe != unmoved).any()


def test_a_moved_plane_keeps_its_law():
    rig = paper_rig(176)
    surface = plane(rig, 1.8, (15.0, -10.0))
    still = moved(surface, rig, "vertical", lambda x, y: np.zeros_like(x))
    np.testing.assert_allclose(still.depth_m, surface.depth_m, rtol=1e-12)
    np.testing.assert_allclose(still.normals, surface.normals, atol=1e-5)
    # psi = gain / Z is linear in 1 / Z on the paper's rig, so a plane moved by a linear shift is a
    # plane again.
    tilted = moved(surface, rig, "vertical", lambda x, y: 1.0 + 8.0 * x - 5.0 * y)
    design = np.column_stack([surface.x, surface.y, np.ones_like(surface.x)])
    law, *_ = np.linalg.lstsq(design, 1 / tilted.depth_m, rcond=None)
    np.testing.assert_allclose(design @ law, 1 / tilted.depth_m, rtol=1e-9)
    normal = -law / np.linalg.norm(law)
    np.testing.assert_allclose(tilted.normals, np.tile(normal, (surface.x.size, 1)), atol=1e-5)
    normals = pixel_normals(surface.depth_mm((176, 176)), rig.camera, ONE_SURFACE).reshape(-1, 3)
    np.testing.assert_allclose(normals, surface.normals, atol=1e-9)


def test_a_move_shifts_both_carriers_of_crossed_frames_as_a_change_of_depth_does():
    rig = crossed_rig(48)
    for bent in (
        rig,
        replace(
            rig, projector=replace(rig.projector, distortion=(-0.08, 0.05, 0.001, -0.001, 0.0))
        ),
    ):
        surface = plane(bent, 1.8, tilt_deg=(10.0, 5.0))
        nearer = moved(surface, bent, "crossed", lambda x, y: 1 + x, 0.3)
        seen = [bent.project(one.points_m()) for one in (surface, nearer)]
        shifts = [
            2 * np.pi * (along_u * (seen[1][0] - seen[0][0]) + along_v * (seen[1][1] - seen[0][1]))
            for along_u, along_v in bent.crossed.cycles_per_px
        ]
        carriers = Carriers.of(bent, bent.crossed)
        faster = int(np.median(np.abs(carriers.gain[1])) > np.median(np.abs(carriers.gain[0])))
        np.testing.assert_allclose(shifts[faster], 0.3 * (1 + surface.x), atol=1e-6)
        ratio = (carriers.gain[1 - faster] / carriers.gain[faster]).ravel()
        np.testing.assert_allclose(shifts[1 - faster], ratio * shifts[faster], atol=2e-3)
    with pytest.raises(DiagnosisError, match="no crossed frames"):
        layer_of(paper_rig(64), "crossed")


def test_crossed_fringes_are_mirrored_and_widened():
    renderer = SceneRenderer(crossed_rig(320))
    surface = plane(renderer.rig, 1.8)
    scene = Scene(surface, renderer.light(surface), np.ones(renderer.shape, bool), (0,))
    light = {
        name: renderer.frames(replace(scene, projected=name), [0])[0]
        for name in ("sequence", "other direction", "other pitch")
    }
    spectra = {name: np.abs(np.fft.fft2(grey - grey.mean())) for name, grey in light.items()}
    peaks = {
        name: np.abs(np.fft.fftfreq(320)[list(np.unravel_index(power.argmax(), power.shape))])
        for name, power in spectra.items()
    }
    assert np.hypot(*peaks["other pitch"]) == pytest.approx(
        np.hypot(*peaks["sequence"]) / PITCH_FACTOR, rel=0.05
    )
    mirrored = spectra["other direction"][:, 1:], spectra["sequence"][:, :0:-1]
    assert np.corrcoef(mirrored[0].ravel(), mirrored[1].ravel())[0, 1] > 0.9


def test_another_outline_leaves_what_is_kept_as_it_was(renderer, sample_scene, scenes):
    frame = renderer.frames(sample_scene, [0])[0]
    outline_changes = of_kind(scenes, "outline")
    assert [change.name for change in outline_changes] == [
        "ellipse",
        "another object's outline",
        "grown",
    ]
    for outline_change in outline_changes:
        unchanged = outline_change.scene.mask & sample_scene.mask
        assert unchanged.any() and (
            outline_change.name == "grown" or (outline_change.scene.mask == unchanged).all()
        )
        changed_frame = renderer.frames(outline_change.scene, [0])[0]
        np.testing.assert_array_equal(changed_frame[unchanged], frame[unchanged])
        assert (changed_frame != frame).any()
        masked_frame = renderer.frames(outline_change.scene, [0], masked=True)[0]
        assert (masked_frame[~outline_change.scene.mask] == 0).all()
    ellipse, _, grown = outline_changes
    assert 0.45 < ellipse.scene.mask.sum() / sample_scene.mask.sum() < 0.55
    assert (
        sample_scene.mask <= grown.scene.mask
    ).all() and sample_scene.mask.sum() < grown.scene.mask.sum()


def test_fringes_are_removed_swapped_and_widened_where_it_says(
    opened, renderer, sample_scene, scenes
):
    sequence = opened.sequence
    reprojected = {variant.name: variant.scene for variant in of_kind(scenes, "projected")}
    inside = np.zeros(renderer.shape, dtype=bool)
    inside.ravel()[sample_scene.surface.pixels] = True
    steps = [*sequence.sinusoids("horizontal")[:6]]
    usual = np.stack([renderer.frames(sample_scene, steps)[index] for index in steps]).astype(float)

    def swing(name):
        frames = renderer.frames(reprojected[name], steps)
        return np.ptp(np.stack([frames[index] for index in steps]).astype(float), axis=0)

    bright = np.ptp(usual, axis=0) > 30
    assert (swing("no fringe inside")[bright & inside] < 15).all()
    # The mean of whole periods is half of white light.
    level = renderer.frames(reprojected["no fringe inside"], steps)[steps[0]][inside].astype(float)
    white, black = (
        renderer.frames(sample_scene, [index])[index][inside].astype(float)
        for index in (sequence.white, sequence.black)
    )
    assert np.median(level - (white + black) / 2) == pytest.approx(0, abs=1.0)
    np.testing.assert_array_equal(
        swing("no fringe inside")[~inside], np.ptp(usual, axis=0)[~inside]
    )
    np.testing.assert_array_equal(swing("no fringe outside")[inside], np.ptp(usual, axis=0)[inside])
    swapped = renderer.frames(reprojected["other direction"], [0, sequence.white])
    np.testing.assert_array_equal(
        swapped[0], renderer.frames(sample_scene, [sequence.steps])[sequence.steps]
    )
    np.testing.assert_array_equal(
        swapped[sequence.white], renderer.frames(sample_scene, [sequence.white])[sequence.white]
    )
    column = renderer.frames(reprojected["other pitch"], [0])[0][:, 4].astype(float)
    plain = renderer.frames(sample_scene, [0])[0][:, 4].astype(float)

    def period(values):
        return (
            1 / np.fft.rfftfreq(4096)[np.argmax(np.abs(np.fft.rfft(values - values.mean(), 4096)))]
        )

    assert period(column) / period(plain) == pytest.approx(PITCH_FACTOR, rel=0.03)


def test_samples_are_spread_over_objects_and_views(opened):
    chosen = chosen_samples(opened, "train", 3)
    assert [sample for sample, _ in chosen] == [
        "bowl_A0",
        "bowl_A120",
        "bowl_A240",
        "cork_A120",
        "cork_A240",
        "cork_A60",
    ]
    assert all(
        outlines and outlines[0].split("_")[0] != sample.split("_")[0]
        for sample, outlines in chosen
    )
    empty = SimpleNamespace(path=opened.path, samples_by_object=lambda split: {})
    with pytest.raises(DiagnosisError, match="no sample with an object"):
        chosen_samples(empty, "test", 2)
