"""Importing published trees: which variant is read, in which frame order, and what is refused."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from conftest import flip, fpp_bench, printed, refusal
from published_trees import (
    FOLDERS,
    TRAINING,
    VIEWS,
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


def problems(tree, out):
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
    assert dataset.configs == ("single_shot",) and not dataset.has_exact
    settings = dataset.manifest.settings
    assert dataset.manifest.origin == "imported" and settings["rig_assumed"]
    assert settings["depth_from"] == FOLDERS["raw"] and settings["frame_order"] is None
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
    depth_path(tree).write_bytes(v73_bytes(depthMap=DEPTH))
    double = depth_of("mug_A0").astype(np.float64)
    write_mat(depth_path(tree, "val", "mug_A0"), False, depthMap=double)
    write_png(fringe_path(tree), rgb())
    dataset = imported(tree, tmp_path / "out")
    assert_holds_the_tree(dataset)
    for sample in ("power_drill_A60", "mug_A0"):
        assert dataset.depth_mm(sample).tobytes() == depth_of(sample).tobytes()


@pytest.mark.long
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
    settings = imported(tree, tmp_path / "out", rig=paper_rig(24)).manifest.settings
    assert settings["rig_assumed"] is False
    with pytest.raises(RigError, match=r"48 x 48 px.*24 x 24"):
        plan_import(tree, rig=paper_rig(48))
    with pytest.raises(RigError, match="--rig"):
        plan_import(make_tree(tmp_path / "wide", size=(24, 20)))


def move(source, target):
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(source, target)


def move_sample(tree, stem, target, variant="raw"):
    """Fringe and depth of a validation sample into another split."""
    for path in (fringe_path, depth_path):
        move(path(tree, "val", stem, variant), path(tree, target, stem, variant))


def link_to_nowhere(path):
    path.unlink()
    path.symlink_to("/nowhere.png")


def cut(path):
    path.write_bytes(path.read_bytes()[:-30])


STEM = "power_drill_A60"
PNG, MAT = f"{STEM}.png", f"{STEM}.mat"
RAW = TRAINING / FOLDERS["raw"]
DEPTH, FRINGE = depth_of(STEM), fringe_of(STEM)


def pixel(value):
    depth = DEPTH.copy()
    depth[8, 12] = value
    return depth


def rgb(change=0):
    image = np.repeat(FRINGE[..., None], 3, axis=2)
    image[3, 3, 0] ^= change
    return image


def png(image):
    return lambda path: write_png(path, image)


def mat(**values):
    return lambda path: write_mat(path, **values)


def view(tree):
    return fringe_path(tree), depth_path(tree)


BROKEN = {
    "object in two splits": (
        Path,
        lambda tree: move_sample(tree, "mug_A0", "train"),
        "train/fringe/mug_A0.png: object mug is in two splits",
    ),
    "a view is missing": (
        view,
        lambda paths: [path.unlink() for path in paths],
        f"object power_drill lacks {STEM}",
    ),
    "fringe without depth": (depth_path, Path.unlink, f"{MAT}: is missing"),
    "depth without fringe": (fringe_path, Path.unlink, f"{PNG}: is missing"),
    "extra file": ("test/fringe/notes.txt", Path.touch, "notes.txt: does not belong"),
    "extra folder": ("holdout", Path.mkdir, "holdout: does not belong"),
    "extra folder in a split": ("test/normals", Path.mkdir, "normals: does not belong"),
    "no fringe folder": ("test/fringe", shutil.rmtree, "fringe: the folder is missing"),
    "a view that is none": (
        fringe_path,
        lambda path: path.rename(path.with_name("drill_A45.png")),
        "drill_A45.png: expected",
    ),
    "a link to nowhere": (fringe_path, link_to_nowhere, PNG),
    "png cut off": (fringe_path, cut, f"{PNG}: the PNG is cut off"),
    "png damaged": (fringe_path, flip, f"{PNG}: the PNG is damaged"),
    "no png at all": (
        fringe_path,
        lambda path: path.write_bytes(b"P5 24 24 255 "),
        f"{PNG}: expected a PNG",
    ),
    "png of 16 bits": (
        fringe_path,
        png(np.uint16(FRINGE)),
        f"{PNG}: expected an 8-bit PNG, got 16 bits",
    ),
    "png with alpha": (
        fringe_path,
        png(np.zeros((24, 24, 4), np.uint8)),
        f"{PNG}: expected a grey PNG",
    ),
    "png in colour": (fringe_path, png(rgb(1)), f"{PNG}: an RGB image whose channels differ"),
    "png of another size": (fringe_path, png(FRINGE[:20]), f"{PNG}: expected 24 x 24 px"),
    "mat cut off": (depth_path, cut, f"{MAT}: a data element"),
    "wrong variable": (
        depth_path,
        mat(depthMapMeters=DEPTH),
        f"{MAT}: expected the variable depthMap, got depthMapMeters",
    ),
    "depth of another size": (
        depth_path,
        mat(depthMap=DEPTH[:, :20]),
        f"{MAT}: expected 24 x 24",
    ),
    "depth NaN": (depth_path, mat(depthMap=pixel(np.nan)), f"{MAT}: 1 pixels are NaN"),
    "depth negative": (depth_path, mat(depthMap=pixel(-1)), f"{MAT}: 1 pixels are negative"),
    "depth empty": (depth_path, mat(depthMap=0 * DEPTH), f"{MAT}: no pixel is above 0"),
    "depth in cm": (
        depth_path,
        mat(depthMap=DEPTH / 10),
        "the file has another unit (times 10 it fits)",
    ),
    "depth with a mark": (
        depth_path,
        mat(depthMap=np.where(DEPTH > 0, DEPTH, 65535)),
        f"{MAT}: 79% of the pixels are exactly 65535, far from all depths: a value for background?",
    ),
    "depth in tenths of a mm": (
        depth_path,
        mat(depthMap=np.uint16(10 * DEPTH)),
        "the file has another unit (times 0.1 it fits)",
    ),
    "depth with -1": (
        depth_path,
        mat(depthMap=np.where(DEPTH > 0, DEPTH, -1)),
        f"{MAT}: 79% of the pixels are exactly -1",
    ),
    "depth in metres": (depth_path, mat(depthMap=DEPTH / 1000), f"{MAT}: depths of 1.7"),
}
"""What is changed, how, and what is said of it."""


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_tree_is_refused_and_the_file_named(tmp_path, case):
    place, change, message = BROKEN[case]
    tree = make_tree(tmp_path / "tree")
    change(tree / RAW / place if isinstance(place, str) else place(tree))
    assert message in problems(tree, tmp_path / "out")


def in_info(stem=STEM):
    return lambda tree, variant: info_path(tree, stem=stem)


BROKEN_VARIANTS = {
    "metres in mm": (
        ["global"],
        depth_path,
        mat(depthMapMeters=DEPTH),
        "so the file has another unit",
    ),
    "normalised above 1": (
        ["individual"],
        depth_path,
        mat(depthMapNormalized=DEPTH),
        "in [0, 1]",
    ),
    "variants disagree": (
        ["raw", "global"],
        depth_path,
        mat(depthMapMeters=(DEPTH + (DEPTH > 0) * 0.05) / 1000),
        f"global_normalized/test/depth/{MAT}: differs from",
    ),
    "fringes of variants differ": (
        ["raw", "global"],
        fringe_path,
        png(fringe_of("bowl_A0")),
        f"global_normalized/test/fringe/{PNG}: expected the same image as",
    ),
    "variants split differently": (
        ["raw", "global"],
        lambda tree, variant: tree,
        lambda tree: move_sample(tree, "mug_A0", "test", "global"),
        "global_normalized/val/fringe/mug_A0.png: is missing",
    ),
    "range disagrees": (
        ["raw", "individual"],
        in_info(),
        mat(depth_min=1700.0, depth_max=1900.0),
        f"{MAT}: gives 1700",
    ),
    "range upside down": (
        ["individual"],
        in_info(),
        mat(depth_min=1900.0, depth_max=1700.0),
        f"{MAT}: expected 0 < depth_min <= depth_max",
    ),
    "range missing": (
        ["individual"],
        in_info(),
        Path.unlink,
        f"info_depth_params/test/depth/{MAT}: is missing",
    ),
    "range folder missing": (
        ["individual"],
        lambda tree, variant: tree / TRAINING / "info_depth_params",
        shutil.rmtree,
        "info_depth_params: the folder is missing",
    ),
    "range of no sample": (
        ["individual"],
        in_info("mug_A0"),
        mat(depth_min=1.0, depth_max=2.0),
        "mug_A0.mat: belongs to no sample of this split",
    ),
    "range not a number": (
        ["individual"],
        in_info(),
        mat(depth_min=np.nan, depth_max=2.0),
        f"{MAT}: depth_min: expected a finite number",
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("case", BROKEN_VARIANTS)
def test_variants_and_ranges_that_do_not_fit_together(tmp_path, case):
    variants, place, change, message = BROKEN_VARIANTS[case]
    tree = make_tree(tmp_path / "tree", variants)
    change(place(tree, variant=variants[-1]))
    assert message in problems(tree, tmp_path / "out")


def test_all_wrong_files_of_all_splits_are_listed_together(tmp_path):
    tree = make_tree(tmp_path / "tree")
    cut(fringe_path(tree, "train", "bowl_A0"))
    write_mat(depth_path(tree, "val", "mug_A120"), depthMap=pixel(np.nan))
    write_mat(depth_path(tree, "test", "my_own_part_A300"), depthMapMeters=DEPTH)
    message = problems(tree, tmp_path / "out")
    assert "3 problems" in message
    for name in ("bowl_A0.png", "mug_A120.mat", "my_own_part_A300.mat"):
        assert message.count(name) == 1


def test_a_long_list_of_wrong_files_is_cut_with_their_count(tmp_path):
    tree = make_tree(tmp_path / "tree", splits={"train": tuple(f"object_{n}" for n in range(10))})
    for path in (tree / TRAINING / FOLDERS["raw"] / "train" / "depth").iterdir():
        path.write_bytes(b"")
    message = problems(tree, tmp_path / "out").splitlines()
    assert len(message) == 52 and "60 problems" in message[0]
    assert message[-1].strip() == "... and 10 more"


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
    assert message in problems(tmp_path / "tree", tmp_path / "out")


def test_an_interrupted_import_resumes_and_reads_a_changed_file_again(tmp_path, monkeypatch):
    tree = make_tree(tmp_path / "tree")
    expected = imported(tree, tmp_path / "whole").fingerprint
    reader = plan_import(tree).rows.__class__
    read, read_samples = reader.read, []

    def interrupted(self, sample):
        if sample.split == "test" and not read_samples:
            raise KeyboardInterrupt
        return read(self, sample)
        return read(self, sample)

    monkeypatch.setattr(reader, "read", interrupted)
    with pytest.raises(KeyboardInterrupt):
        imported(tree, tmp_path / "out")
    changed_file = depth_path(tree, "val", "mug_A0")
    content = changed_file.read_bytes()
    os.utime(changed_file, (0, 0))  # an old modification time does not hide a change
    write_mat(changed_file, depthMap=depth_of("mug_A0") + np.float32(1) * (depth_of("mug_A0") > 0))

    def noted(self, sample):
        read_samples.append(sample.sample)
        return read(self, sample)

    monkeypatch.setattr(reader, "read", noted)
    dataset = imported(tree, tmp_path / "out")
    assert "mug_A0" in read_samples
    assert not any(sample.startswith("bowl") for sample in read_samples)
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


def test_the_command_imports_and_prints_a_summary(tmp_path):
    tree = make_tree(tmp_path / "tree", ALL_VARIANTS)
    save_rig(paper_rig(24), tmp_path / "rig.yaml")
    line = f"import {tree} --out {tmp_path}/out --workers 1 --rig {tmp_path}/rig.yaml"
    message = printed(fpp_bench, line)
    assert "train 6, validation 6, test 12 samples" in message
    assert f"depth taken from {FOLDERS['raw']}" in message and "assumed" not in message


@pytest.mark.long
@pytest.mark.parametrize(
    "words",
    [
        "tree --out out --frame-order sideways",
        "tree --out out --rig nowhere.yaml",
        "tree --out tree",
        "tree --out a_file",
        "broken --out out",
    ],
)
def test_bad_input_to_the_command_is_a_message_and_status_2(tmp_path, monkeypatch, words):
    make_tree(tmp_path / "tree")
    cut(depth_path(make_tree(tmp_path / "broken")))
    (tmp_path / "a_file").write_text("")
    monkeypatch.chdir(tmp_path)
    assert "error:" in refusal(fpp_bench, "import", words)
    assert not (tmp_path / "out" / "manifest.json").exists()


@pytest.mark.long
@pytest.mark.parametrize("mark", [65535, -1, np.nan])
def test_a_value_for_background_is_read_as_0(mark, tmp_path):
    plain, marked = make_tree(tmp_path / "plain"), make_tree(tmp_path / "marked")
    for file in (marked / RAW).rglob("*.mat"):
        depth = scipy.io.loadmat(file)["depthMap"]
        write_mat(file, depthMap=np.where(depth > 0, depth, np.float32(mark)))
    line = f"--workers 1 --out {tmp_path}"
    assert fpp_bench("import", plain, f"{line}/a") == 0
    assert fpp_bench("import", marked, f"{line}/b --nodata", mark) == 0
    assert DatasetFolder(tmp_path / "a").content == DatasetFolder(tmp_path / "b").content


def test_whole_numbers_are_said(tmp_path, capsys):
    tree = make_tree(tmp_path / "tree")
    line = f"import {tree} --workers 1 --out {tmp_path}"
    assert fpp_bench(f"{line}/a") == 0
    assert "warning" not in capsys.readouterr().err
    for file in (tree / RAW).rglob("*.mat"):
        write_mat(file, depthMap=np.uint16(np.rint(scipy.io.loadmat(file)["depthMap"])))
    assert fpp_bench(f"{line}/b") == 0
    said = "warning: the depth files hold whole numbers, so depth is rounded"
    assert said in capsys.readouterr().err
