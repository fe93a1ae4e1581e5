"""Exports: the published tree, which imports back bit by bit, and Parquet that plain ``datasets``
opens."""

import shutil
import subprocess
import sys
from pathlib import Path

import datasets
import numpy as np
import pytest
import scipy.io
import trimesh
from conftest import (
    TINY_CONFIGS,
    TINY_OBJECTS,
    file_bytes,
    fpp_bench,
    printed,
    read_image,
    refusal,
)
from published_trees import imported, write_png
from scored_dataset import make_dataset, write_predictions

from fpp_ml_bench.errors import BuildError, DatasetError, LayoutError, PredictionError
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.files import whole_folder
from fpp_ml_bench.loaders.published.exporting import chosen_splits, export
from fpp_ml_bench.loaders.published.importing import import_notes
from fpp_ml_bench.loaders.published.order import FrameOrder, parse_order
from fpp_ml_bench.loaders.sample import config_columns
from fpp_ml_bench.optics.sequence import PAPER_SEQUENCE

pytestmark = pytest.mark.long

TRAINING = Path("training_datasets")
SCANS = Path("fpp_synthetic_dataset")
NAMES = {"train": "train", "validation": "val", "test": "test"}
SAMPLE = "power_drill_A60"
PIXELS = 176 * 176


@pytest.fixture(scope="module")
def tree(opened, tmp_path_factory):
    """The tiny dataset as a published tree."""
    out = tmp_path_factory.mktemp("export") / "tree"
    export(opened, out, ["mat"], chosen_splits(opened, "all"), threads=2)
    return out


@pytest.fixture(scope="module")
def returned(tree, tmp_path_factory):
    """The same tree, imported again."""
    return imported(tree, tmp_path_factory.mktemp("import") / "dataset")


@pytest.fixture(scope="module")
def test_tree(opened, tmp_path_factory):
    """The test split alone with raw scans; broken copies are made from it."""
    out = tmp_path_factory.mktemp("export") / "test"
    export(opened, out, ["mat"], ["test"])
    return out


def test_the_tree_comes_back_bit_by_bit_with_the_same_split(opened, returned):
    assert returned.splits == opened.splits and returned.configs == TINY_CONFIGS
    for sample in opened.samples("all"):
        assert returned.depth_mm(sample).tobytes() == opened.depth_mm(sample).tobytes()
        frames = opened.frames(sample, range(52))
        np.testing.assert_array_equal(returned.frames(sample, range(52)), frames)
    assert returned.manifest.settings["frame_order"] == "paper"


def test_files_and_variables_are_those_of_the_published_layout(opened, tree):
    folders = [
        f"training_data_{removed}depth_{variant}"
        for removed in ("", "bgremoved_")
        for variant in ("raw", "global_normalized", "individual_normalized")
    ]
    assert sorted(path.name for path in (tree / TRAINING).iterdir()) == sorted(
        [*folders, "info_depth_params"]
    )
    for split, samples in opened.splits.items():
        for folder in folders:
            for kind, suffix in (("fringe", "png"), ("depth", "mat")):
                names = {
                    path.name for path in (tree / TRAINING / folder / NAMES[split] / kind).iterdir()
                }
                assert names == {f"{sample}.{suffix}" for sample in samples}
    depth, frame = opened.depth_mm(SAMPLE).astype(np.float64), opened.frame(SAMPLE, 0)
    low, high = depth[depth > 0].min(), depth.max()
    expected = {
        "raw": ("depthMap", depth),
        "global_normalized": ("depthMapMeters", depth / 1000),
        "individual_normalized": (
            "depthMapNormalized",
            np.where(depth > 0, (depth - low) / (high - low), 0),
        ),
    }
    for variant, (variable, values) in expected.items():
        for removed, image in (("", frame), ("bgremoved_", np.where(depth > 0, frame, 0))):
            folder = tree / TRAINING / f"training_data_{removed}depth_{variant}" / "test"
            stored = scipy.io.loadmat(folder / f"depth/{SAMPLE}.mat")[variable]
            np.testing.assert_allclose(stored, values, rtol=1e-12)
            assert np.array_equal(read_image(folder / f"fringe/{SAMPLE}.png"), image)
    info = scipy.io.loadmat(tree / TRAINING / f"info_depth_params/test/depth/{SAMPLE}.mat")
    assert (info["depth_min"], info["depth_max"]) == ([[low]], [[high]])


def test_raw_scans_hold_52_frames_and_phases_that_belong_together(opened, tree):
    folder = tree / SCANS / "power_drill" / "A60"
    assert len(list(folder.iterdir())) == 54
    for index in range(52):
        assert np.array_equal(read_image(folder / f"A_{index}.png"), opened.frame(SAMPLE, index))
    wrapped = scipy.io.loadmat(folder / "wrapped_phase.mat")["wph"]
    unwrapped = scipy.io.loadmat(folder / "unwrapped_phase.mat")["uph"]
    decoded = np.isfinite(unwrapped)
    assert decoded.mean() > 0.8 and np.abs(wrapped).max() <= np.float32(np.pi)
    turns = (unwrapped[decoded].astype(np.float64) - wrapped[decoded]) / (2 * np.pi)
    # Each phase is rounded once to float32, by at most 2**-24 of the largest value.
    np.testing.assert_allclose(
        turns, np.round(turns), rtol=0, atol=2**-23 * unwrapped[decoded].max() / (2 * np.pi)
    )
    # The paper's Eq. 2, directly, where the fringes are bright.
    shifts = 2 * np.pi * np.arange(18) / 18
    stack = np.stack(opened.frames(SAMPLE, range(18))).astype(np.float64)
    expected = -np.arctan2(
        np.tensordot(np.sin(shifts), stack, 1), np.tensordot(np.cos(shifts), stack, 1)
    )
    difference = np.angle(np.exp(1j * (wrapped - expected)))[decoded]
    # float64 rounded once to float32, with a factor 2 to spare.
    assert np.abs(difference).max() < 2**-23 * np.pi


def test_two_exports_are_equal_byte_by_byte_whatever_the_threads(opened, tmp_path):
    for threads in (1, 3):
        export(opened, tmp_path / str(threads), ["mat"], ["validation"], threads)
    assert file_bytes(tmp_path / "1") == file_bytes(tmp_path / "3")


def reordered(tree, order):
    """Rename the files of all raw scans to another order."""
    for folder in (path for path in (tree / SCANS).glob("*/*") if path.is_dir()):
        contents = {i: (folder / f"A_{i}.png").read_bytes() for i in range(52)}
        for number, frame in enumerate(order.frames(PAPER_SEQUENCE)):
            (folder / f"A_{number}.png").write_bytes(contents[frame.index])


def scan_folder(tree):
    return tree / SCANS / "power_drill" / "A60"


def swap(first, second):
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)


BROKEN_SCANS = {
    "frame missing": (lambda f: (f / "A_7.png").unlink(), "A_7.png: is missing"),
    "frame too many": (
        lambda f: shutil.copy(f / "A_7.png", f / "A_52.png"),
        "A_52.png: does not belong here",
    ),
    "view missing": (lambda f: shutil.rmtree(f), "A60: the raw scan is missing"),
    "scan without depth": (
        lambda f: shutil.copytree(f, f.parents[1] / "mug/A60"),
        "A60: a raw scan without depth",
    ),
    "no view at all": (lambda f: (f.parent / "A45").mkdir(), "A45: does not belong here"),
    "frame of another size": (
        lambda f: write_png(f / "A_9.png", np.zeros((88, 88), np.uint8)),
        "A_9.png: expected 176 x 176 px",
    ),
    "not the single-shot frame": (
        lambda f: shutil.copy(f / "A_1.png", f / "A_0.png"),
        "A_0.png: differs from",
    ),
    "two frames exchanged": (
        lambda f: swap(f / "A_20.png", f / "A_23.png"),
        "A_20.png: expected vertical sinusoid",
    ),
    "one view in another order": (
        lambda f: swap(f / "A_50.png", f / "A_51.png"),
        "has the order paper+white-first",
    ),
}


@pytest.mark.parametrize("case", BROKEN_SCANS)
def test_a_broken_raw_scan_is_refused_and_named(test_tree, tmp_path, case):
    breaking, message = BROKEN_SCANS[case]
    shutil.copytree(test_tree, tmp_path / "tree")
    breaking(scan_folder(tmp_path / "tree"))
    with pytest.raises(LayoutError) as caught:
        imported(tmp_path / "tree", tmp_path / "out")
    assert message in str(caught.value) and not (tmp_path / "out" / "manifest.json").exists()


def test_another_frame_order_is_detected_undone_and_reported(opened, test_tree, tmp_path):
    tree = tmp_path / "tree"
    shutil.copytree(test_tree, tree)
    order = parse_order("vertical-first+white-first")
    reordered(tree, order)
    for path in (tree / TRAINING).glob("training_data_depth_*/test/fringe/*.png"):
        name, view = path.stem.rsplit("_", 1)
        shutil.copy(tree / SCANS / name / view / "A_0.png", path)
    dataset = imported(tree, tmp_path / "out")
    assert dataset.manifest.settings["frame_order"] == order.name
    np.testing.assert_array_equal(
        dataset.frames(SAMPLE, range(52)), opened.frames(SAMPLE, range(52))
    )
    assert any(
        "is a vertical fringe, stored in column frame_18" in note
        for note in import_notes(dataset.manifest)
    )
    with pytest.raises(
        LayoutError, match=r"not in frame order paper, it has the order vertical-first\+white-first"
    ):
        imported(tree, tmp_path / "other", frame_order=FrameOrder().name)


@pytest.fixture(scope="module")
def parquet(opened, tmp_path_factory):
    out = tmp_path_factory.mktemp("export") / "parquet"
    export(opened, out, ["parquet"], chosen_splits(opened, "all"))
    return out


@pytest.mark.parametrize("config", TINY_CONFIGS)
def test_plain_datasets_opens_every_configuration_of_the_parquet(opened, parquet, config):
    loaded = datasets.load_dataset(str(parquet), config)
    columns = config_columns(opened.sequence, config, True)
    frames = opened.sequence.config(config)
    assert list(loaded) == list(opened.splits)
    for split, samples in opened.splits.items():
        part = loaded[split]
        assert part.column_names == columns and part["sample"] == samples
        assert part.features["frame_00" if 0 in frames else "frame_18"] == datasets.Array2D(
            (176, 176), "uint8"
        )
        assert part.features["depth"] == datasets.Array2D((176, 176), "float32")
        # Only the configuration's own columns went into the cache.
        cached = sum(Path(file["filename"]).stat().st_size for file in part.cache_files)
        pixels = len(samples) * PIXELS * (len(frames) + 10)
        assert pixels < cached < 1.02 * pixels + 60_000
    rows = loaded["test"].with_format("numpy")
    for row, sample in zip(rows, opened.samples("test"), strict=True):
        assert row["depth"].tobytes() == opened.depth_mm(sample).tobytes()
        assert row["depth_exact"].tobytes() == opened.depth_mm(sample, "depth_exact").tobytes()
        assert row["depth_min"] == opened.measured(sample)["depth_min_mm"]
        for index in frames:
            assert np.array_equal(row[f"frame_{index:02d}"], opened.frame(sample, index))


def test_no_pixel_is_stored_twice_and_the_default_is_single_shot(opened, parquet):
    import pyarrow.parquet as pq

    stored = {}
    for path in parquet.rglob("*.parquet"):
        names = pq.read_schema(path).names
        assert len(names) == len(set(names))
        stored[path.name] = pq.ParquetFile(path).metadata.num_rows
    assert sum(stored.values()) == len(opened.samples("all"))
    assert datasets.load_dataset(str(parquet), split="test").column_names[4] == "frame_00"


def test_parquet_of_one_split_and_of_another_in_the_same_place_do_not_share_a_cache(
    opened, tmp_path
):
    for split in ("validation", "test"):
        export(opened, tmp_path / "out", ["parquet"], [split])
        loaded = datasets.load_dataset(str(tmp_path / "out"), "single_shot")
        assert list(loaded) == [split] and loaded[split]["sample"] == opened.samples(split)
        shutil.rmtree(tmp_path / "out")


def test_an_imported_dataset_exports_too(returned, tmp_path):
    export(returned, tmp_path / "out", ["parquet"], ["test"])
    loaded = datasets.load_dataset(str(tmp_path / "out"), "vertical", split="test")
    assert "depth_exact" not in loaded.column_names and len(loaded) == 6
    with pytest.raises(DatasetError, match="imported datasets have no meshes"):
        export(returned, tmp_path / "meshes", ["meshes"], ["test"])
    assert not (tmp_path / "meshes").exists()


def test_several_forms_each_get_a_folder(tiny, tmp_path):
    said = printed(fpp_bench, f"export {tiny} --out {tmp_path}/out --meshes --patterns")
    assert "meshes, patterns of 24 samples" in said
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"meshes", "patterns"}
    assert {path.stem for path in (tmp_path / "out/meshes").iterdir()} == set(TINY_OBJECTS)
    assert trimesh.load(tmp_path / "out/meshes/mug.ply").is_watertight
    assert len(list((tmp_path / "out/patterns").glob("A_*.png"))) == 52


def test_one_form_and_one_split_go_straight_into_the_folder(tiny, tmp_path):
    (tmp_path / "out").mkdir()
    assert fpp_bench(f"export {tiny} --out {tmp_path}/out --meshes --split test") == 0
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["power_drill.ply"]


def test_a_full_disk_leaves_nothing_and_a_second_try_succeeds(opened, tmp_path, monkeypatch):
    out = tmp_path / "deep" / "out"
    written, write = [], Path.write_bytes

    def full(path, content):
        written.append(path)
        if len(written) > 20:
            raise OSError(28, "No space left on device")
        return write(path, content)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(BuildError, match="No space left on device"):
        export(opened, out, ["mat"], ["test"], threads=2)
    assert list(out.parent.iterdir()) == []
    monkeypatch.undo()
    (out.parent / ".out.unfinished" / "half").mkdir(parents=True)  # what a killed export leaves
    export(opened, out, ["mat"], ["test"])
    assert {path.name for path in out.parent.iterdir()} == {"out"}
    assert {path.name for path in out.iterdir()} == {TRAINING.name, SCANS.name}


def test_two_exports_into_one_folder_and_folders_that_hold_something(opened, tmp_path):
    with whole_folder(tmp_path / "out", "exporting there", BuildError):
        with pytest.raises(BuildError, match="another process"):
            export(opened, tmp_path / "out", ["patterns"], ["test"])
        assert not (tmp_path / "out").exists()
    assert list((tmp_path / "out").iterdir()) == []
    (tmp_path / "out" / "mine.txt").write_text("keep")
    with pytest.raises(BuildError, match="not empty"):
        export(opened, tmp_path / "out", ["patterns"], ["test"])
    assert (tmp_path / "out" / "mine.txt").read_text() == "keep"
    with pytest.raises(BuildError, match="in the dataset itself"):
        export(opened, opened.path / "export", ["patterns"], ["test"])


@pytest.mark.parametrize(
    "words",
    [
        "DATA --out out",
        "nowhere --out out --mat",
        "DATA --out file --mat",
        "DATA --out DATA --parquet",
        "DATA --out out --parquet --split val",
    ],
)
def test_bad_input_to_the_command_is_a_message_and_status_2(tiny, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    assert "error:" in refusal(fpp_bench, "export", words.replace("DATA", str(tiny)))
    assert not Path("out").exists()


READ_ROWS = """
import sys, mlcroissant, numpy as np
read = mlcroissant.Dataset(sys.argv[1] + "/croissant.json")
assert not read.metadata.ctx.issues.report()
assert read.metadata.data_limitations and read.metadata.data_use_cases
rows = list(read.records("test-rows"))
depths = {row["test-rows/sample"].decode(): row["test-rows/depth"] for row in rows}
np.savez(sys.argv[1] + "/read.npz", **{name: np.array(list(d)) for name, d in depths.items()})
"""


def test_croissant_metadata_is_valid_and_reads_the_rows(tmp_path):
    """In a process of its own: where ``datasets`` is imported, its types of arrays stop pandas, by
    which mlcroissant reads."""
    dataset = make_dataset(tmp_path / "dataset", size=(12, 16))
    export(dataset, tmp_path / "out", ["parquet"], ["test"])
    words = [sys.executable, "-c", READ_ROWS, str(tmp_path / "out")]
    subprocess.run(words, check=True, capture_output=True, timeout=120)
    with np.load(tmp_path / "out" / "read.npz") as read:
        assert list(read) == dataset.samples("test")
        assert all(np.array_equal(read[name], dataset.depth_mm(name)) for name in read)


def test_depth_maps_are_read_back_by_opencv_and_scored(opened, tmp_path):
    predictions = write_predictions(tmp_path / "predictions", opened, "test", offset_mm=3.0)
    export_maps = f"export {opened.path} --split test --maps"
    assert fpp_bench(f"{export_maps} pfm,png,ply --out {tmp_path}/truth") == 0
    unit_mm = float((tmp_path / "truth" / "png_scale.txt").read_text().split()[0])
    for sample in opened.samples("test"):
        truth = read_image(tmp_path / "truth" / f"{sample}.pfm")
        levels = read_image(tmp_path / "truth" / f"{sample}.png")
        assert np.array_equal(truth, opened.depth_mm(sample)) and levels.dtype == np.uint16
        assert np.abs(levels * unit_mm - truth).max() <= unit_mm / 2 * 1.001
        cloud = trimesh.load(tmp_path / "truth" / f"{sample}.ply")
        assert len(cloud.vertices) == np.count_nonzero(truth)
    again = tmp_path / "again"
    made = f"--predictions {predictions} --out {again}"
    assert fpp_bench(export_maps, "pfm", made) == 0
    shutil.copyfile(predictions / "submission.yaml", again / "submission.yaml")
    scores = [evaluate(folder, opened, "test").metrics for folder in (predictions, again)]
    assert scores[0].object_mae_mm == pytest.approx(scores[1].object_mae_mm, rel=1e-6) != 0
    (again / f"{opened.samples('test')[0]}.pfm").write_bytes(b"Pf\n176 176\n-1.0\n1234")
    with pytest.raises(PredictionError, match="holds 4 bytes of values, expected 123904"):
        evaluate(again, opened, "test")
    said = refusal(fpp_bench, f"{export_maps} exr --out {tmp_path}/none")
    assert "expected some of pfm, png, ply" in said
    assert "--predictions: needs --maps" in refusal(fpp_bench, "export", opened.path, made)
