"""Building: the same bytes for any order of objects and number of workers, and settings that are
refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from conftest import (
    TINY_CONFIGS,
    TINY_OBJECTS,
    TINY_SIZE,
    file_bytes,
    fpp_bench,
    refusal,
    tiny_settings,
)

from fpp_ml_bench.constants import (
    MINI_OBJECTS,
    OBJECTS,
    PRESETS,
    SPLITS,
    TEST_OBJECTS,
    VALIDATION_OBJECTS,
    VIEWS,
    split_of,
)
from fpp_ml_bench.errors import BuildError, MeshError
from fpp_ml_bench.loaders.render.builder import assembly_of, build, plan_build
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.render.meshes import single_mesh
from fpp_ml_bench.loaders.render.scene import BuildSettings, UserMesh
from fpp_ml_bench.loaders.render.sensor import camera_noise
from fpp_ml_bench.loaders.sample import Row, available_configs, stored_frames, stored_groups
from fpp_ml_bench.loaders.storage.manifest import Manifest
from fpp_ml_bench.loaders.storage.shards import ShardWriter, plan_shards
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.sequence import PAPER_SEQUENCE

pytestmark = pytest.mark.long

PAPER = named_light("paper")
NOISY = PAPER.changed("camera", **camera_noise(2.0))


def test_two_workers_and_another_order_of_objects_give_the_same_bytes_in_every_file(tiny, tmp_path):
    settings = tiny_settings(objects=tuple(reversed(TINY_OBJECTS)))
    reported = []
    build(tmp_path / "again", settings, workers=2, progress=reported.append)
    assert file_bytes(tmp_path / "again") == file_bytes(tiny)
    assert sum(reported) == 24 and min(reported) >= 0


def test_storing_one_frame_keeps_the_bytes_of_frame_and_depth(opened, tmp_path):
    build(tmp_path / "one", tiny_settings(objects=("cork",), stored="single_shot"), workers=1)
    dataset = DatasetFolder(tmp_path / "one")
    assert dataset.configs == ("single_shot",)
    for sample in dataset.samples("train"):
        np.testing.assert_array_equal(dataset.frame(sample, 0), opened.frame(sample, 0))
        np.testing.assert_array_equal(dataset.depth_mm(sample), opened.depth_mm(sample))
        np.testing.assert_array_equal(
            dataset.depth_mm(sample, "depth_exact"), opened.depth_mm(sample, "depth_exact")
        )
        assert dataset.measured(sample) == opened.measured(sample)


@pytest.mark.parametrize("change", [{"seed": 43}, {"light": NOISY}, {"placement": "varied"}])
def test_what_decides_the_bytes_changes_them(opened, tmp_path, change):
    build(
        tmp_path / "other",
        tiny_settings(objects=("cork",), stored="single_shot", **change),
        workers=1,
    )
    dataset = DatasetFolder(tmp_path / "other")
    assert dataset.fingerprint != opened.fingerprint
    for sample in dataset.samples("train"):
        differing = (dataset.frame(sample, 0) != opened.frame(sample, 0)).mean()
        assert differing > (
            0.02 if "placement" in change else 0.2
        )  # elsewhere background and noise are the same
        moved = (
            dataset.depth_mm(sample, "depth_exact") != opened.depth_mm(sample, "depth_exact")
        ).any()
        assert moved == ("placement" in change)


def test_what_is_in_the_folder(tiny, opened):
    assert opened.splits == {
        "train": [f"{name}_{view}" for name in ("bowl", "cork") for view in VIEWS],
        "validation": [f"mug_{view}" for view in VIEWS],
        "test": [f"power_drill_{view}" for view in VIEWS],
    }
    assert opened.size == (TINY_SIZE, TINY_SIZE) and opened.configs == TINY_CONFIGS
    assert not list(tiny.rglob("*.tmp")) and not (tiny / ".build").exists()
    for name in TINY_OBJECTS:
        mesh = trimesh.load(tiny / "meshes" / f"{name}.ply")
        assert mesh.is_watertight
    content = (tiny / "manifest.json").read_text()
    assert str(tiny) not in content and "/" not in json.loads(content)["settings"]["frames"]


def test_every_view_has_its_object_in_range(opened):
    for sample in opened.samples("all"):
        exact, depth = opened.depth_mm(sample, "depth_exact"), opened.depth_mm(sample)
        inside = exact[exact > 0]
        assert inside.min() >= 1500 and inside.max() <= 2100
        assert 0.005 < (exact > 0).mean() < 0.4
        row = opened.measured(sample)
        assert (row["depth_min_mm"], row["depth_max_mm"]) == (
            depth[depth > 0].min(),
            depth[depth > 0].max(),
        )
        assert row["object_px"] == (depth > 0).sum()
        assert row["undecoded_px"] == ((exact > 0) & (depth == 0)).sum() < 0.1 * row["exact_px"]
        assert row["distance_mm"] == 1800
        assert not (depth > 0)[exact == 0].any()


def test_users_mesh_goes_the_same_way(tmp_path):
    path = tmp_path / "My Part.stl"
    trimesh.creation.icosphere(3, 0.1).export(path)
    mesh = single_mesh(path)
    settings = BuildSettings(
        paper_rig(TINY_SIZE), (mesh.name,), stored="single_shot", user_meshes=(mesh,)
    )
    build(tmp_path / "set", settings, workers=1)
    dataset = DatasetFolder(tmp_path / "set")
    assert dataset.splits == {"test": [f"my_part_{view}" for view in VIEWS]}
    for sample in dataset.samples("all"):
        exact = dataset.depth_mm(sample, "depth_exact")
        assert exact[exact > 0].min() == pytest.approx(1700, abs=0.5)
    # No path of the machine gets into the dataset, and a changed mesh makes another dataset.
    assert str(tmp_path) not in (tmp_path / "set" / "manifest.json").read_text()
    trimesh.creation.icosphere(3, 0.11).export(path)
    with pytest.raises(BuildError, match="user_meshes"):
        build(tmp_path / "set", replace(settings, user_meshes=(single_mesh(path),)), workers=1)


def test_object_that_does_not_fit_ends_the_build_by_name(tmp_path):
    path = tmp_path / "huge.stl"
    trimesh.creation.box((2, 2, 2)).export(path)
    mesh = single_mesh(path)
    settings = BuildSettings(
        paper_rig(TINY_SIZE), ("cork", "huge"), user_meshes=(mesh,), stored="single_shot"
    )
    with pytest.raises(MeshError, match=r"'huge'.*scale it"):
        build(
            tmp_path / "set", settings, workers=2
        )  # through a worker process, with the whole message


def test_a_view_without_an_object_pixel_ends_the_build_with_its_cause(tmp_path):
    """An object smaller than a pixel of the image, and the same in a light that leaves none to
    decode."""
    trimesh.creation.box((4e-4,) * 3).export(tmp_path / "tiny.stl")
    trimesh.creation.box((0.2,) * 3).export(tmp_path / "box.stl")
    (tmp_path / "dark.yaml").write_text("name: dark\ncamera: {exposure: 0.01}\n")
    line = f"build --size 224 --config single_shot --workers 1 --out {tmp_path}"
    said = refusal(fpp_bench, f"{line}/a --mesh {tmp_path}/tiny.stl")
    assert "object 'tiny' is on no pixel in view A0: it is 0.4 mm large" in said
    assert "scale it up" in said
    words = f"--mesh {tmp_path}/box.stl --light {tmp_path}/dark.yaml"
    said = refusal(fpp_bench, f"{line}/b", words)
    assert "sample 'box_A0': none of its" in said
    assert "(low modulation" in said and "--light" in said


# ---- plans and presets


def test_split_is_forty_five_five_by_object():
    parts = {split: [name for name in OBJECTS if split_of(name) == split] for split in SPLITS}
    assert [len(parts[split]) for split in SPLITS] == [40, 5, 5]
    assert {"power_drill", "magazine_stack", "container_bottle", "wooden_boards"} <= set(
        parts["test"]
    )
    assert set(VALIDATION_OBJECTS) <= set(OBJECTS) and set(TEST_OBJECTS) <= set(OBJECTS)
    assert len(set(OBJECTS)) == 50


def test_full_preset_is_the_papers_set():
    objects, size = PRESETS["full"]
    assembly = assembly_of(BuildSettings(paper_rig(size), objects))
    rows = {
        split: sum(len(p.samples) for p in assembly.plans if p.split == split) for split in SPLITS
    }
    assert rows == {"train": 240, "validation": 30, "test": 30}
    frames = stored_frames(PAPER_SEQUENCE, "all")
    assert len(frames) * sum(rows.values()) == 15_600
    assert assembly.manifest.row_bytes == 960 * 960 * (52 + 10)
    assert min(len(p.samples) for p in assembly.plans) >= 24  # rows of a record batch: hub.md


def test_mini_preset_has_every_split():
    objects, size = PRESETS["mini"]
    assert objects == MINI_OBJECTS and len(objects) >= 4
    assert {plan.split for plan in plan_build(BuildSettings(paper_rig(size), objects))} == set(
        SPLITS
    )


@pytest.mark.parametrize(
    ("stored", "count", "configs"),
    [
        ("single_shot", 1, {"single_shot"}),
        ("vertical", 19, {"single_shot", "first_frames", "vertical"}),
        ("first_frames", 2, {"single_shot", "first_frames"}),
        ("all", 52, set(TINY_CONFIGS)),
    ],
)
def test_groups_hold_every_frame_once(stored, count, configs):
    groups = stored_groups(PAPER_SEQUENCE, stored)
    stored_indices = [frame for frames in groups.values() for frame in frames]
    assert len(stored_indices) == len(set(stored_indices)) == count and 0 in stored_indices
    assert set(available_configs(PAPER_SEQUENCE, stored)) == configs


# ---- settings


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"objects": ()}, "no object"),
        ({"objects": ("mugg",)}, "did you mean 'mug'"),
        ({"objects": ("mug", "bowl", "mug")}, "'mug' is named twice"),
        ({"placement": "random"}, "fixed or varied"),
        ({"stored": "both"}, "single_shot"),
        ({"seed": -1}, "0 to 2"),
        ({"seed": 2**63}, "0 to 2"),
        ({"light": PAPER.changed("projector", focus_m=2.1, defocus_px=1.0)}, "focus_m"),
    ],
)
def test_bad_settings(change, message):
    with pytest.raises(BuildError, match=message):
        tiny_settings(**change)


def test_settings_are_in_one_order_whatever_was_given():
    meshes = UserMesh("zeta", "zeta.stl"), UserMesh("alpha", "alpha.stl")
    objects = ("zeta", "mug", "alpha", "bowl")
    settings = tiny_settings(objects=objects, user_meshes=meshes)
    reversed_settings = tiny_settings(objects=objects[::-1], user_meshes=meshes[::-1])
    assert settings == reversed_settings and settings.describe() == reversed_settings.describe()
    assert settings.objects == ("bowl", "mug", "alpha", "zeta")


# ---- the writer


def row(depth=None, frames=None):
    depth = np.full((8, 6), 1800, np.float32) if depth is None else depth
    return Row("bowl_A0", "bowl", "A0", frames or {0: np.zeros((8, 6), np.uint8)}, depth, depth)


def spoiled(value):
    depth = np.full((8, 6), 1800 if value else 0, np.float32)
    depth[3, 3] = value
    return row(depth)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "expected sample 'bowl_A0', got nothing"),
        (
            [row(frames={0: np.zeros((6, 8), np.uint8)})],
            r"frame_00: expected uint8 \(8, 6\), got uint8 \(6, 8\)",
        ),
        ([row(np.full((8, 6), 1800.0))], r"depth: expected float32 \(8, 6\), got float64"),
        ([spoiled(np.nan)], "bowl_A0.*NaN or infinite"),
        ([spoiled(np.inf)], "bowl_A0.*NaN or infinite"),
        ([spoiled(-1.0)], "bowl_A0.*negative"),
        ([spoiled(0.0)], "bowl_A0.*no pixel is above 0"),
    ],
)
def test_writer_takes_no_other_rows_and_no_bad_depth(tmp_path, rows, message):
    (plan,) = plan_shards("train", {"bowl": [("bowl_A0", "bowl", "A0")]})
    manifest = Manifest("generated", {}, {}, paper_rig().to_dict(), (8, 6), "single_shot", True)
    with pytest.raises(BuildError, match=message):
        ShardWriter(manifest).write(tmp_path, plan, rows)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
