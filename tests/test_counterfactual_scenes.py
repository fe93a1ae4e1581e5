"""Counterfactual scenes: the unchanged one is the dataset's, and a changed one differs in what it says."""

import numpy as np
import pytest

from fpp_ml_bench.baselines.diagnostics.counterfactual_original import original
from fpp_ml_bench.baselines.diagnostics.counterfactual_scenes import LARGEST_SHIFT_RAD, chosen_samples, counterfactuals
from fpp_ml_bench.baselines.diagnostics.synth import PITCH_FACTOR, Darkroom
from fpp_ml_bench.baselines.diagnostics.synth_surface import moved, normals_of_depth, plane
from fpp_ml_bench.errors import DiagnosisError

SAMPLE, OTHER = "power_drill_A0", "mug_A60"


@pytest.fixture(scope="module")
def room(opened):
    return Darkroom.of(opened)


@pytest.fixture(scope="module")
def scenes(opened, room):
    return counterfactuals(opened, room, SAMPLE, "horizontal", [OTHER])


def test_an_unchanged_scene_is_the_datasets_own(opened, room):
    for sample in (SAMPLE, OTHER):
        found = original(opened, room, sample)
        frames = room.frames(found.scene, range(len(opened.sequence)))
        for index, frame in enumerate(frames):
            apart = np.abs(frame.astype(int) - opened.frame(sample, index))
            assert apart.max() <= 1
            assert (apart > 0).sum() <= 5


def test_a_move_shifts_the_phase_and_keeps_outline_and_brightness(opened, room, scenes):
    found, sequence = scenes.original, opened.sequence
    before = scenes.layer.at(found.target).absolute_phase(found.depth_mm[found.target])
    names = [move.name for move in scenes.moves]
    assert set(names) == {"constant", "ramp across", "ramp down", "bump"}
    near, far = room.rig.working_range_mm
    for move in scenes.moves:
        assert ((move.depth_mm > 0) == (found.depth_mm > 0)).all()
        seen = move.depth_mm[move.depth_mm > 0]
        assert near - 1e-6 <= seen.min() and seen.max() <= far + 1e-6
        shift = scenes.layer.at(found.target).absolute_phase(move.depth_mm[found.target]) - before
        assert np.abs(shift).max() <= abs(move.amplitude_rad) + 1e-9 <= LARGEST_SHIFT_RAD + 2e-9
        white = room.frames(move.phase, [sequence.white])[sequence.white]
        np.testing.assert_array_equal(white, room.frames(found.scene, [sequence.white])[sequence.white])
    bump = next(move for move in scenes.moves if move.name == "bump")
    fringe, unmoved = (room.frames(scene, [0])[0] for scene in (bump.light, found.scene))
    assert (fringe != unmoved).any()


def test_a_moved_plane_keeps_its_law():
    from fpp_ml_bench.rig import paper_rig

    rig = paper_rig(176)
    surface = plane(rig, 1.8, (15.0, -10.0))
    still = moved(surface, rig, "vertical", lambda x, y: np.zeros_like(x))
    np.testing.assert_allclose(still.depth_m, surface.depth_m, rtol=1e-12)
    np.testing.assert_allclose(still.normals, surface.normals, atol=1e-5)
    # psi = gain / Z is linear in 1 / Z on the paper's rig, so a plane moved by a linear shift is a plane again.
    tilted = moved(surface, rig, "vertical", lambda x, y: 1.0 + 8.0 * x - 5.0 * y)
    design = np.column_stack([surface.x, surface.y, np.ones_like(surface.x)])
    law, *_ = np.linalg.lstsq(design, 1 / tilted.depth_m, rcond=None)
    np.testing.assert_allclose(design @ law, 1 / tilted.depth_m, rtol=1e-9)
    normal = -law / np.linalg.norm(law)
    np.testing.assert_allclose(tilted.normals, np.tile(normal, (surface.x.size, 1)), atol=1e-5)
    x, y = rig.camera.rays()
    found = normals_of_depth(surface.depth_mm(x.shape), x, y)
    np.testing.assert_allclose(found, surface.normals, atol=1e-9)


def test_another_outline_leaves_what_is_kept_as_it_was(room, scenes):
    found = scenes.original
    frame = room.frames(found.scene, [0])[0]
    assert [recut.name for recut in scenes.recuts] == ["ellipse", "another object's outline", "grown"]
    for recut in scenes.recuts:
        assert recut.keeps.any() and (recut.keeps <= found.target).all()
        again = room.frames(recut.scene, [0])[0]
        np.testing.assert_array_equal(again[recut.keeps], frame[recut.keeps])
        assert (again != frame).any()
        told = room.frames(recut.scene, [0], masked=True)[0]
        assert (told[~recut.scene.mask] == 0).all()
    ellipse, _, grown = scenes.recuts
    assert 0.45 < ellipse.keeps.sum() / found.target.sum() < 0.55
    assert grown.keeps.sum() == found.target.sum() < grown.scene.mask.sum()


def test_fringes_are_removed_swapped_and_widened_where_it_says(opened, room, scenes):
    found, sequence = scenes.original, opened.sequence
    inside = np.zeros(room.shape, dtype=bool)
    inside.ravel()[found.surface.pixels] = True
    steps = [*sequence.sinusoids("horizontal")[:6]]
    usual = np.stack([room.frames(found.scene, steps)[index] for index in steps]).astype(float)

    def swing(name):
        frames = room.frames(scenes.reprojected[name], steps)
        return np.ptp(np.stack([frames[index] for index in steps]).astype(float), axis=0)

    bright = np.ptp(usual, axis=0) > 30
    assert (swing("no fringe inside")[bright & inside] < 15).all()
    np.testing.assert_array_equal(swing("no fringe inside")[~inside], np.ptp(usual, axis=0)[~inside])
    np.testing.assert_array_equal(swing("no fringe outside")[inside], np.ptp(usual, axis=0)[inside])
    other = room.frames(scenes.reprojected["other direction"], [0, sequence.white])
    np.testing.assert_array_equal(other[0], room.frames(found.scene, [sequence.steps])[sequence.steps])
    np.testing.assert_array_equal(other[sequence.white], room.frames(found.scene, [sequence.white])[sequence.white])
    column = room.frames(scenes.reprojected["other pitch"], [0])[0][:, 4].astype(float)
    plain = room.frames(found.scene, [0])[0][:, 4].astype(float)

    def period(values):
        return 1 / np.fft.rfftfreq(4096)[np.argmax(np.abs(np.fft.rfft(values - values.mean(), 4096)))]

    assert period(column) / period(plain) == pytest.approx(PITCH_FACTOR, rel=0.03)


def test_samples_are_spread_over_objects_and_views(opened):
    chosen = chosen_samples(opened, "train", 3)
    assert [sample for sample, _ in chosen] == [
        "bowl_A0", "bowl_A120", "bowl_A240", "cork_A120", "cork_A240", "cork_A60",
    ]  # fmt: skip
    assert all(others and others[0].split("_")[0] != sample.split("_")[0] for sample, others in chosen)
    with pytest.raises(DiagnosisError, match="no sample with an object"):
        chosen_samples_of_nothing(opened)


def chosen_samples_of_nothing(opened):
    class Empty:
        path = opened.path

        def samples(self, split):
            return []

    return chosen_samples(Empty(), "test", 2)
