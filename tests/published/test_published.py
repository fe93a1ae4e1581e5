"""Importing published trees: which variant is read, in which frame order, and what is refused."""

import os
import shutil

import numpy as np
import pytest
import scipy.io
from published_trees import (
    FOLDERS,
    TRAINING,
    VIEWS,
    command,
    depth_of,
    depth_path,
    fringe_of,
    fringe_path,
    imported,
    info_path,
    make_tree,
    v73_bytes,
    write_mat,
    write_png,
)

from fpp_ml_bench.errors import BuildError, LayoutError, RigError
from fpp_ml_bench.loaders.published.importing import import_notes, plan_import
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig_file import save_rig

ALL_VARIANTS = ("raw", "global", "individual")


def refusal(tree, out):
    with pytest.raises(LayoutError) as caught:
        imported(tree, out)
    assert not (out / "manifest.json").exists()
    return str(caught.value)


def assert_holds_the_tree(dataset):
    assert dataset.splits == {
        "train": [f"bowl_{view}" for view in VIEWS],
        "validation": [f"mug_{view}" for view in VIEWS],
        "test": [f"{name}_{view}" for name in ("power_drill", "my_own_part") for view in VIEWS],
    }
    for sample in dataset.samples("all"):
        assert np.array_equal(dataset.frame(sample, 0), fringe_of(sample))
        assert dataset.depth_mm(sample).dtype == np.float32


def test_raw_depth_comes_in_bit_by_bit_with_the_published_split(tmp_path):
    dataset = imported(make_tree(tmp_path / "tree"), tmp_path / "out")
    assert_holds_the_tree(dataset)
    for sample in dataset.samples("all"):
        assert dataset.depth_mm(sample).tobytes() == depth_of(sample).tobytes()
    assert (
        dataset.configs == ("single_shot",)
        and not dataset.has_exact
        and dataset.manifest.origin == "imported"
    )
    settings = dataset.manifest.settings
    assert (
        settings["depth_from"] == FOLDERS["raw"]
        and settings["rig_assumed"]
        and settings["frame_order"] is None
    )
    assert dataset.rig == paper_rig(24)


def test_the_global_variant_alone_is_metres(tmp_path):
    dataset = imported(make_tree(tmp_path / "tree", ("global",)), tmp_path / "out")
    assert_holds_the_tree(dataset)
    for sample in dataset.samples(
        "all"
    ):  # two float32 roundings of 2**-24: to metres, and back to mm
        np.testing.assert_allclose(dataset.depth_mm(sample), depth_of(sample), rtol=2**-23, atol=0)
    assert dataset.manifest.settings["depth_from"] == FOLDERS["global"]


def test_the_individual_variant_alone_loses_only_the_pixels_at_least_depth(tmp_path):
    dataset = imported(make_tree(tmp_path / "tree", ("individual",)), tmp_path / "out")
    assert_holds_the_tree(dataset)
    for sample in dataset.samples("all"):
        expected = depth_of(sample)
        expected[expected == expected[expected > 0].min()] = 0
        assert np.array_equal(dataset.depth_mm(sample), expected)
    assert any("became background" in note for note in import_notes(dataset.manifest))


def test_variants_beside_each_other_are_checked_against_raw(tmp_path):
    dataset = imported(make_tree(tmp_path / "tree", ALL_VARIANTS), tmp_path / "out")
    assert dataset.depth_mm("mug_A0").tobytes() == depth_of("mug_A0").tobytes()
    assert dataset.manifest.settings["depth_checked_against"] == [
        FOLDERS["global"],
        FOLDERS["individual"],
    ]


def test_v73_files_double_depth_and_rgb_copies_read_the_same(tmp_path):
    tree = make_tree(tmp_path / "tree")
    depth_path(tree).write_bytes(v73_bytes(depthMap=depth_of("power_drill_A60")))
    write_mat(
        depth_path(tree, "val", "mug_A0"), False, depthMap=depth_of("mug_A0").astype(np.float64)
    )
    write_png(fringe_path(tree), np.repeat(fringe_of("power_drill_A60")[..., None], 3, axis=2))
    dataset = imported(tree, tmp_path / "out")
    assert_holds_the_tree(dataset)
    for sample in ("power_drill_A60", "mug_A0"):
        assert dataset.depth_mm(sample).tobytes() == depth_of(sample).tobytes()


def test_two_workers_write_what_one_writes_and_the_root_may_be_the_training_folder(tmp_path):
    tree = make_tree(tmp_path / "tree", info=True)
    single = imported(tree, tmp_path / "one")
    parallel = imported(tree / TRAINING, tmp_path / "two", workers=2)
    assert single.fingerprint == parallel.fingerprint


def test_dot_files_and_files_beside_the_folders_are_ignored(tmp_path):
    tree = make_tree(tmp_path / "tree")
    (tree / "README.md").write_text("a card")
    (fringe_path(tree).parent / ".DS_Store").write_text("")
    (tree / TRAINING / "training_data_bgremoved_depth_raw").mkdir()
    dataset = imported(tree, tmp_path / "out")
    assert dataset.manifest.settings["ignored"] == ["training_data_bgremoved_depth_raw"]


def test_an_own_rig_must_fit_the_images(tmp_path):
    tree = make_tree(tmp_path / "tree")
    assert (
        imported(tree, tmp_path / "out", rig=paper_rig(24)).manifest.settings["rig_assumed"]
        is False
    )
    with pytest.raises(RigError, match=r"48 x 48 px.*24 x 24"):
        plan_import(tree, rig=paper_rig(48))
    with pytest.raises(RigError, match="--rig"):
        plan_import(make_tree(tmp_path / "wide", size=(24, 20)))


def set_pixel(path, value):
    depth = depth_of(path.stem)
    depth[8, 12] = value
    write_mat(path, depthMap=depth)


def move(source, target):
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(source, target)


def move_object(tree):
    """mug's A0 view into train, fringe and depth: mug is in two splits then."""
    for path in (fringe_path, depth_path):
        move(path(tree, "val", "mug_A0"), path(tree, "train", "mug_A0"))


def move_to_test(tree, stem, variant):
    for path in (fringe_path, depth_path):
        move(path(tree, "val", stem, variant), path(tree, "test", stem, variant))


def link_to_nowhere(path):
    path.unlink()
    path.symlink_to("/nowhere.png")


def rgb_with_a_colour(tree):
    image = np.repeat(fringe_of("power_drill_A60")[..., None], 3, axis=2)
    image[3, 3, 0] ^= 1
    write_png(fringe_path(tree), image)


def remove_view(tree):
    fringe_path(tree).unlink()
    depth_path(tree).unlink()


def flip(path, position):
    content = bytearray(path.read_bytes())
    content[position] ^= 0x10
    path.write_bytes(content)


def cut(path):
    path.write_bytes(path.read_bytes()[:-30])


STEM = "power_drill_A60"
PNG, MAT = f"{STEM}.png", f"{STEM}.mat"
RAW = TRAINING / FOLDERS["raw"]


def png(tree, image, **place):
    write_png(fringe_path(tree, **place), image)


def mat(tree, variant="raw", **values):
    write_mat(depth_path(tree, variant=variant), **values)


BROKEN = {
    "object in two splits": (move_object, "train/fringe/mug_A0.png: object mug is in two splits"),
    "a view is missing": (remove_view, f"object power_drill lacks {STEM}"),
    "fringe without depth": (lambda t: depth_path(t).unlink(), f"{MAT}: is missing"),
    "depth without fringe": (lambda t: fringe_path(t).unlink(), f"{PNG}: is missing"),
    "extra file": (
        lambda t: (t / RAW / "test/fringe/notes.txt").write_text("x"),
        "notes.txt: does not belong",
    ),
    "extra folder": (lambda t: (t / RAW / "holdout").mkdir(), "holdout: does not belong"),
    "extra folder in a split": (
        lambda t: (t / RAW / "test/normals").mkdir(),
        "normals: does not belong",
    ),
    "no fringe folder": (
        lambda t: shutil.rmtree(t / RAW / "test/fringe"),
        "fringe: the folder is missing",
    ),
    "a view that is none": (
        lambda t: move(fringe_path(t), fringe_path(t, stem="drill_A45")),
        "drill_A45.png: expected",
    ),
    "a link to nowhere": (lambda t: link_to_nowhere(fringe_path(t)), PNG),
    "png cut off": (lambda t: cut(fringe_path(t)), f"{PNG}: the PNG is cut off"),
    "png damaged": (lambda t: flip(fringe_path(t), 200), f"{PNG}: the PNG is damaged"),
    "no png at all": (
        lambda t: fringe_path(t).write_bytes(b"P5 24 24 255 "),
        f"{PNG}: expected a PNG",
    ),
    "png of 16 bits": (
        lambda t: png(t, np.uint16(fringe_of(STEM))),
        f"{PNG}: expected an 8-bit PNG, got 16 bits",
    ),
    "png with alpha": (
        lambda t: png(t, np.zeros((24, 24, 4), np.uint8)),
        f"{PNG}: expected a grey PNG",
    ),
    "png in colour": (rgb_with_a_colour, f"{PNG}: an RGB image whose channels differ"),
    "png of another size": (lambda t: png(t, fringe_of(STEM)[:20]), f"{PNG}: expected 24 x 24 px"),
    "mat cut off": (lambda t: cut(depth_path(t)), f"{MAT}: a data element"),
    "wrong variable": (
        lambda t: mat(t, depthMapMeters=depth_of(STEM)),
        f"{MAT}: expected the variable depthMap, got depthMapMeters",
    ),
    "depth of another size": (
        lambda t: mat(t, depthMap=depth_of(STEM)[:, :20]),
        f"{MAT}: expected 24 x 24",
    ),
    "depth NaN": (lambda t: set_pixel(depth_path(t), np.nan), f"{MAT}: 1 pixels are NaN"),
    "depth negative": (lambda t: set_pixel(depth_path(t), -1), f"{MAT}: 1 pixels are negative"),
    "depth empty": (lambda t: mat(t, depthMap=np.zeros((24, 24))), f"{MAT}: no pixel is above 0"),
    "depth in cm": (
        lambda t: mat(t, depthMap=depth_of(STEM) / 10),
        "the file has another unit (times 10 it fits)",
    ),
    "depth with a mark": (
        lambda t: mat(t, depthMap=np.where(depth_of(STEM) > 0, depth_of(STEM), 65535)),
        f"{MAT}: 79% of the pixels are exactly 65535, far from all depths: a value for background?",
    ),
    "depth in tenths of a mm": (
        lambda t: mat(t, depthMap=np.uint16(10 * depth_of(STEM))),
        "the file has another unit (times 0.1 it fits)",
    ),
    "depth with -1": (
        lambda t: mat(t, depthMap=np.where(depth_of(STEM) > 0, depth_of(STEM), -1)),
        f"{MAT}: 79% of the pixels are exactly -1",
    ),
    "depth in metres": (lambda t: mat(t, depthMap=depth_of(STEM) / 1000), f"{MAT}: depths of 1.7"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_tree_is_refused_and_the_file_named(tmp_path, case):
    breaking, message = BROKEN[case]
    tree = make_tree(tmp_path / "tree")
    breaking(tree)
    assert message in refusal(tree, tmp_path / "out")


BROKEN_VARIANTS = {
    "metres in mm": (
        ("global",),
        lambda t: mat(t, "global", depthMapMeters=depth_of(STEM)),
        "so the file has another unit",
    ),
    "normalised above 1": (
        ("individual",),
        lambda t: mat(t, "individual", depthMapNormalized=depth_of(STEM)),
        "in [0, 1]",
    ),
    "variants disagree": (
        ("raw", "global"),
        lambda t: write_mat(
            depth_path(t, variant="global"),
            depthMapMeters=(depth_of(STEM) + (depth_of(STEM) > 0) * 0.05) / 1000,
        ),
        f"global_normalized/test/depth/{MAT}: differs from",
    ),
    "fringes of variants differ": (
        ("raw", "global"),
        lambda t: png(t, fringe_of("bowl_A0"), variant="global"),
        f"global_normalized/test/fringe/{PNG}: expected the same image as",
    ),
    "variants split differently": (
        ("raw", "global"),
        lambda t: move_to_test(t, "mug_A0", "global"),
        "global_normalized/val/fringe/mug_A0.png: is missing",
    ),
    "range disagrees": (
        ("raw", "individual"),
        lambda t: write_mat(info_path(t), depth_min=1700.0, depth_max=1900.0),
        f"{MAT}: gives 1700",
    ),
    "range upside down": (
        ("individual",),
        lambda t: write_mat(info_path(t), depth_min=1900.0, depth_max=1700.0),
        f"{MAT}: expected 0 < depth_min <= depth_max",
    ),
    "range missing": (
        ("individual",),
        lambda t: info_path(t).unlink(),
        f"info_depth_params/test/depth/{MAT}: is missing",
    ),
    "range folder missing": (
        ("individual",),
        lambda t: shutil.rmtree(t / TRAINING / "info_depth_params"),
        "info_depth_params: the folder is missing",
    ),
    "range of no sample": (
        ("individual",),
        lambda t: write_mat(info_path(t, stem="mug_A0"), depth_min=1.0, depth_max=2.0),
        "mug_A0.mat: belongs to no sample of this split",
    ),
    "range not a number": (
        ("individual",),
        lambda t: write_mat(info_path(t), depth_min=np.nan, depth_max=2.0),
        f"{MAT}: depth_min: expected a finite number",
    ),
}


@pytest.mark.parametrize("case", BROKEN_VARIANTS)
def test_variants_and_ranges_that_do_not_fit_together(tmp_path, case):
    variants, breaking, message = BROKEN_VARIANTS[case]
    tree = make_tree(tmp_path / "tree", variants)
    breaking(tree)
    assert message in refusal(tree, tmp_path / "out")


def test_all_wrong_files_of_all_splits_are_listed_together(tmp_path):
    tree = make_tree(tmp_path / "tree")
    cut(fringe_path(tree, "train", "bowl_A0"))
    set_pixel(depth_path(tree, "val", "mug_A120"), np.nan)
    write_mat(
        depth_path(tree, "test", "my_own_part_A300"), depthMapMeters=depth_of("my_own_part_A300")
    )
    message = refusal(tree, tmp_path / "out")
    assert "3 problems" in message
    for name in ("bowl_A0.png", "mug_A120.mat", "my_own_part_A300.mat"):
        assert message.count(name) == 1


def test_a_long_list_of_wrong_files_is_cut_with_their_count(tmp_path):
    tree = make_tree(tmp_path / "tree", splits={"train": tuple(f"object_{n}" for n in range(10))})
    for path in (tree / TRAINING / FOLDERS["raw"] / "train" / "depth").iterdir():
        path.write_bytes(b"")
    message = refusal(tree, tmp_path / "out").splitlines()
    assert (
        len(message) == 52
        and "60 problems" in message[0]
        and message[-1].strip() == "... and 10 more"
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda t: None, "no such folder"),
        (lambda t: t.mkdir(), "expected training_datasets/"),
        (
            lambda t: (t / "fpp_synthetic_dataset/mug/A0").mkdir(parents=True),
            "raw scans alone have no depth in mm",
        ),
        (
            lambda t: (t / TRAINING / "training_data_bgremoved_depth_raw").mkdir(parents=True),
            "only background-removed",
        ),
        (lambda t: (t / TRAINING / FOLDERS["raw"]).mkdir(parents=True), "holds no sample"),
    ],
)
def test_folders_that_are_no_published_tree(tmp_path, make, message):
    make(tmp_path / "tree")
    assert message in refusal(tmp_path / "tree", tmp_path / "out")


def test_an_interrupted_import_resumes_and_reads_a_changed_file_again(tmp_path, monkeypatch):
    tree = make_tree(tmp_path / "tree")
    expected = imported(tree, tmp_path / "whole").fingerprint
    reader = plan_import(tree).rows.__class__
    read = reader.read
    read_samples = []

    def interrupted(self, sample):
        if sample.split == "test":
            raise KeyboardInterrupt
        return read(self, sample)

    monkeypatch.setattr(reader, "read", interrupted)
    with pytest.raises(KeyboardInterrupt):
        imported(tree, tmp_path / "out")
    changed_file = depth_path(tree, "val", "mug_A0")
    content = changed_file.read_bytes()
    os.utime(changed_file, (0, 0))  # an old modification time does not hide a change
    write_mat(changed_file, depthMap=depth_of("mug_A0") + np.float32(1) * (depth_of("mug_A0") > 0))

    monkeypatch.setattr(
        reader,
        "read",
        lambda self, sample: (read_samples.append(sample.sample), read(self, sample))[1],
    )
    dataset = imported(tree, tmp_path / "out")
    assert (
        not any(sample.startswith("bowl") for sample in read_samples) and "mug_A0" in read_samples
    )
    assert dataset.depth_mm("mug_A0").max() == depth_of("mug_A0").max() + 1
    changed_file.write_bytes(content)
    shutil.rmtree(tmp_path / "out")
    assert imported(tree, tmp_path / "out").fingerprint == expected


def test_a_finished_import_is_left_alone_unless_the_tree_changed(tmp_path):
    tree = make_tree(tmp_path / "tree")
    dataset = imported(tree, tmp_path / "out")
    assert imported(tree, tmp_path / "out").fingerprint == dataset.fingerprint
    write_mat(depth_path(tree), depthMap=depth_of("bowl_A0"))
    with pytest.raises(BuildError, match=r"power_drill_A60\.mat changed"):
        imported(tree, tmp_path / "out")


def test_the_command_imports_and_prints_a_summary(tmp_path, capsys):
    tree = make_tree(tmp_path / "tree", ALL_VARIANTS)
    save_rig(paper_rig(24), tmp_path / "rig.yaml")
    assert (
        command(
            "import",
            tree,
            "--out",
            tmp_path / "out",
            "--workers",
            1,
            "--rig",
            tmp_path / "rig.yaml",
        )
        == 0
    )
    message = capsys.readouterr().out
    assert (
        "train 6, validation 6, test 12 samples" in message
        and f"depth taken from {FOLDERS['raw']}" in message
    )
    assert "assumed" not in message


@pytest.mark.parametrize(
    "words",
    [
        ("import", "tree", "--out", "out", "--frame-order", "sideways"),
        ("import", "tree", "--out", "out", "--rig", "nowhere.yaml"),
        ("import", "tree", "--out", "tree"),
        ("import", "tree", "--out", "a_file"),
        ("import", "broken", "--out", "out"),
    ],
)
def test_bad_input_to_the_command_is_a_message_and_status_2(tmp_path, monkeypatch, capsys, words):
    make_tree(tmp_path / "tree")
    cut(depth_path(make_tree(tmp_path / "broken")))
    (tmp_path / "a_file").write_text("")
    monkeypatch.chdir(tmp_path)
    assert command(*words) == 2
    message = capsys.readouterr().err
    assert "error:" in message and "Traceback" not in message
    assert not (tmp_path / "out" / "manifest.json").exists()


@pytest.mark.parametrize("mark", [65535, -1, np.nan])
def test_a_value_for_background_is_read_as_0(mark, tmp_path):
    plain, marked = make_tree(tmp_path / "plain"), make_tree(tmp_path / "marked")
    for file in (marked / RAW).rglob("*.mat"):
        depth = scipy.io.loadmat(file)["depthMap"]
        write_mat(file, depthMap=np.where(depth > 0, depth, np.float32(mark)))
    assert command("import", plain, "--out", tmp_path / "a", "--workers", 1) == 0
    assert command("import", marked, "--out", tmp_path / "b", "--workers", 1, "--nodata", mark) == 0
    assert DatasetFolder(tmp_path / "a").content == DatasetFolder(tmp_path / "b").content


def test_whole_numbers_are_said(tmp_path, capsys):
    tree = make_tree(tmp_path / "tree")
    assert command("import", tree, "--out", tmp_path / "a", "--workers", 1) == 0
    assert "warning" not in capsys.readouterr().err
    for file in (tree / RAW).rglob("*.mat"):
        write_mat(file, depthMap=np.uint16(np.rint(scipy.io.loadmat(file)["depthMap"])))
    assert command("import", tree, "--out", tmp_path / "b", "--workers", 1) == 0
    assert (
        "warning: the depth files hold whole numbers, so depth is rounded"
        in capsys.readouterr().err
    )
