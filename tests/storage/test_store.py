"""Reading images: the right pixels, read-only, and helpful errors."""

import gc
import os
import pickle
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from scored_dataset import make_dataset

from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.loaders.sample import DATA_GROUP, column_hash, image_hash
from fpp_ml_bench.loaders.storage.manifest import read_manifest
from fpp_ml_bench.loaders.storage.store import DatasetFolder, OpenShard, load_dataset
from fpp_ml_bench.optics.sequence import PAPER_SEQUENCE

ROOT = Path(__file__).resolve().parent.parent


def test_a_method_is_given_no_truth_outside_the_training_split(tiny, opened):
    """Not by any name, also in another process; frames, names and what identifies the data stay."""
    given = opened.without_truth()
    assert given.without_truth() is given and given.fingerprint == opened.fingerprint
    assert given.splits == opened.splits
    for seen in (given, pickle.loads(pickle.dumps(given))):
        for look in (seen.depth_mm, seen.void, seen.flags, seen.unlit_mm):
            with pytest.raises(
                DatasetError,
                match="is truth of the validation split, and methods are given that of the",
            ):
                look("mug_A60")
        with pytest.raises(DatasetError, match="is truth of the test split"):
            seen.depth_mm(opened.samples("test")[0], "depth_exact")
        assert set(seen.measured("mug_A60")) == {"sample", "object", "view"}
        for shard in seen.manifest.shards:
            names = [name for name, _ in seen.opened(shard).types]
            assert shard.split == "train" or not any(
                name.startswith(("depth", "flags", "cover")) for name in names
            )
        np.testing.assert_array_equal(seen.frame("mug_A60", 20), opened.frame("mug_A60", 20))
        learned = opened.samples("train")[0]
        np.testing.assert_array_equal(seen.depth_mm(learned), opened.depth_mm(learned))
        assert seen.measured(learned) == opened.measured(learned)
    assert "depth_min_mm" in opened.measured("mug_A60")


def test_images_are_read_only_and_read_once_for_a_sample(opened):
    view = opened.frame("mug_A60", 20)
    assert opened.frame("mug_A60", 20) is view
    with pytest.raises(ValueError, match="read-only"):
        view[0, 0] = 1
    assert not opened.depth_mm("mug_A60").flags.writeable
    opened.depth_mm("cork_A0")
    assert opened.frame("mug_A60", 20) is not view
    np.testing.assert_array_equal(opened.frame("mug_A60", 20), view)


def test_a_view_outlives_the_folder_object(tiny):
    dataset = DatasetFolder(tiny)
    view, copy = dataset.depth_mm("cork_A0"), dataset.depth_mm("cork_A0").copy()
    del dataset
    gc.collect()
    np.testing.assert_array_equal(view, copy)


def test_frames_in_the_order_of_the_indices(opened):
    stack = opened.frames("bowl_A0", [51, 0, 18])
    for frame, index in zip(stack, (51, 0, 18), strict=True):
        np.testing.assert_array_equal(frame, opened.frame("bowl_A0", index))


def test_void_is_of_the_decoded_depth_or_of_scene_and_light_alone(opened):
    for sample in opened.samples("all"):
        depth, exact = (opened.depth_mm(sample, column) for column in ("depth", "depth_exact"))
        flags = opened.flags(sample)
        for column, stored in (("depth", depth), ("depth_exact", exact)):
            assert np.shares_memory(opened.depth_mm(sample, column), stored)
            assert stored.dtype == np.float32
        unlit_or_mixed = (flags & 3) > 0
        np.testing.assert_array_equal(
            opened.void(sample), unlit_or_mixed | ((exact > 0) & (depth == 0))
        )
        np.testing.assert_array_equal(
            opened.void(sample, "depth_exact"), (flags & (1 | 2 | 4 | 16)) > 0
        )
        # What is neither void nor unmeasurable, the full sequence decodes.
        scored = (exact > 0) & ~opened.void(sample, "depth_exact")
        assert (depth[scored] == 0).mean() < 2e-3


def test_names_splits_and_what_was_measured(opened):
    assert opened.samples("all") == [
        s for split in ("train", "validation", "test") for s in opened.splits[split]
    ]
    assert opened.split_of_sample("mug_A300") == "validation"
    assert opened.measured("cork_A120")["object"] == "cork"
    assert len(opened.fingerprint) == 64 and opened.has_exact
    assert opened.sequence == PAPER_SEQUENCE and opened.rig.sequence == PAPER_SEQUENCE
    names = opened.samples("train")
    names.clear()
    assert len(opened.samples("train")) == 12


def test_pickles_by_path(opened):
    content = pickle.dumps(opened)
    assert len(content) < 1000
    again = pickle.loads(content)
    np.testing.assert_array_equal(again.frame("mug_A0", 3), opened.frame("mug_A0", 3))
    assert not np.shares_memory(again.frame("mug_A0", 3), opened.frame("mug_A0", 3))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda d: d.frame("mug_A61", 0), "no sample 'mug_A61'; did you mean 'mug_A"),
        (lambda d: d.frame("mug_A60", 52), "frame 52 is not stored"),
        (lambda d: d.frame("mug_A60", -1), "frame -1 is not stored"),
        (
            lambda d: d.depth_mm("mug_A60", "depth_min"),
            "unknown depth column 'depth_min'; there are depth and depth_exact",
        ),
        (lambda d: d.samples("val"), "no split 'val'; there are train, validation, test and all"),
    ],
)
def test_errors_of_reading(opened, call, message):
    with pytest.raises(DatasetError, match=message):
        call(opened)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: None, "no such folder; build one with"),
        (lambda p: p.mkdir(), "no manifest.json there"),
        (lambda p: (p / ".build").mkdir(parents=True), "not finished"),
        (lambda p: (p.mkdir(), (p / "manifest.json").write_text("{")), "damaged"),
        (
            lambda p: (
                p.mkdir(),
                (p / "manifest.json").write_text('{"fingerprint": 1, "schema_version": "9.0"}'),
            ),
            "9.0",
        ),
    ],
)
def test_folders_that_are_no_dataset(tmp_path, make, message):
    folder = tmp_path / "x"
    make(folder)
    with pytest.raises(DatasetError, match=message) as caught:
        DatasetFolder(folder)
    assert str(folder) in str(caught.value)


def test_missing_and_cut_shards_are_noticed_when_opening(copied):
    shard = copied / read_manifest(copied).shards[3].path
    content = shard.read_bytes()
    shard.write_bytes(content[:-1])
    with pytest.raises(
        DatasetError, match=f"has {len(content) - 1} bytes, expected {len(content)}"
    ):
        DatasetFolder(copied)
    shard.unlink()
    with pytest.raises(DatasetError, match="is missing"):
        DatasetFolder(copied)


def test_same_length_but_no_arrow_is_an_error_not_a_crash(copied):
    shard = next(
        s for s in read_manifest(copied).shards if s.split == "train" and s.group == DATA_GROUP
    )
    path = copied / shard.path
    opened = DatasetFolder(copied)
    path.write_bytes(b"\0" * shard.bytes)
    with pytest.raises(DatasetError, match="verify"):
        opened.depth_mm("cork_A0")


@pytest.mark.processes
def test_reading_imports_neither_torch_nor_datasets_nor_pandas(tiny):
    code = (
        "import sys; from fpp_ml_bench.loaders.storage.store import DatasetFolder; d = "
        "DatasetFolder(sys.argv[1]);"
        "d.depth_mm('mug_A0').sum(); d.frame('mug_A0', 30).sum();"
        "print([m for m in ('torch', 'datasets', 'pandas', 'scipy', 'trimesh', 'numba') if m in "
        "sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tiny)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "[]"


def test_content_is_of_the_decoded_values_and_not_of_the_files(tmp_path, opened):
    """The same images in other shards, in another order and with other paths have the same content;
    a changed bit has another, a float that is written as another zero too."""
    image = opened.depth_mm("bowl_A0")
    image_hashes = {
        image_hash(same) for same in (image, np.asfortranarray(image), image.astype(">f4"))
    }
    assert image_hashes == {image_hash(image)}
    assert image_hashes.isdisjoint({image_hash(image.T), image_hash(-image)})
    hashes = {sample: image_hash(opened.depth_mm(sample)) for sample in opened.samples("train")}
    for given in (hashes, dict(reversed(hashes.items()))):
        assert opened.content["train/depth"] == column_hash(given)
    assert opened.content_hash("train", "depth", hashes) == ("train/depth", column_hash(hashes))
    first, second = list(hashes)[:2]
    swapped = {**hashes, first: hashes[second], second: hashes[first]}
    with pytest.raises(DatasetError, match=r"depth of split train is not what manifest\.json says"):
        opened.content_hash("train", "depth", swapped)
    assert set(opened.content) == {
        f"{split}/{column}"
        for split in opened.splits
        for column in (
            *(frame.column for frame in opened.sequence.frames),
            "depth",
            "depth_exact",
            "flags",
            "cover",
        )
    }


# ---- shards of strangers


def shard_parts(tmp_path):
    """A file of a dataset in a new folder, and the size of its images."""
    dataset = make_dataset(tmp_path / "set")
    shard = next(shard for shard in dataset.manifest.shards if shard.split == "test")
    return dataset.path / shard.path, dataset.manifest.size


def changed(path, column, buffer, place, value):
    """Write another int32 into a buffer of offsets of a column, which pyarrow itself does not look
    at."""
    content = bytearray(path.read_bytes())
    memory = pa.py_buffer(bytes(content))
    stored = pa.ipc.open_stream(memory).read_next_batch().column(column).buffers()[buffer]
    offsets, start = np.frombuffer(stored, np.int32).copy(), stored.address - memory.address
    offsets[place] = value
    content[start : start + offsets.nbytes] = offsets.tobytes()
    path.write_bytes(content)


@pytest.mark.parametrize("value", [2**31 - 1, -1])
@pytest.mark.parametrize("column, buffer", [("sample", 1), ("depth", 1), ("depth", 3)])
def test_offsets_that_lead_elsewhere_are_refused(tmp_path, column, buffer, value):
    path, size = shard_parts(tmp_path)
    OpenShard(path, size).check()
    changed(path, column, buffer, -1, value)
    with pytest.raises(DatasetError, match=rf"{path}: column {column} .*; run: fpp-bench verify"):
        OpenShard(path, size).check()
    with pytest.raises(DatasetError, match=f"column {column}"):
        load_dataset(tmp_path / "set", split="test")


def written_anew(path, change, **options):
    """Write a shard's batch again, changed, or by other options."""
    batch = pa.ipc.open_stream(pa.py_buffer(path.read_bytes())).read_next_batch()
    columns = change({name: batch.column(name) for name in batch.schema.names})
    table = pa.table(columns)
    with pa.ipc.new_stream(path, table.schema, options=pa.ipc.IpcWriteOptions(**options)) as stream:
        stream.write_table(table)


@pytest.mark.parametrize(
    "change, options",
    [
        (lambda columns: columns, {"compression": "lz4"}),
        (
            lambda columns: {
                **columns,
                "depth": pa.nulls(len(columns["depth"]), columns["depth"].type),
            },
            {},
        ),
        (lambda columns: {**columns, "depth": columns["sample"].dictionary_encode()}, {}),
        (lambda columns: {**columns, "depth": columns["sample"]}, {}),
        (lambda columns: {**columns, "depth": pa.array([[[[1.0]]]] * len(columns["sample"]))}, {}),
        (lambda columns: {name: column for name, column in columns.items() if name != "depth"}, {}),
    ],
    ids=["lz4", "nulls", "dictionary", "text", "deeper", "missing"],
)
def test_shards_of_another_form_are_refused(tmp_path, change, options):
    path, size = shard_parts(tmp_path)
    written_anew(path, change, **options)
    with pytest.raises(DatasetError, match=str(path)):
        OpenShard(path, size).image("depth", 0)


def test_damaged_metadata_are_read_or_refused(tmp_path):
    """In one process: none of them may end it."""
    path, size = shard_parts(tmp_path)
    whole, chance, refused = path.read_bytes(), random.Random(0), 0
    ends = [3000, len(whole)]
    for number in range(200):
        content = bytearray(whole)
        for _ in range(chance.randrange(1, 4)):
            content[chance.randrange(ends[number % 2])] = chance.randrange(256)
        path.write_bytes(content)
        try:
            shard = OpenShard(path, size)
            shard.check()
            for row in range(shard.rows):
                shard.image("depth", row)
        except DatasetError:
            refused += 1
    assert 50 < refused < 200


def test_a_pipe_in_the_place_of_a_shard_is_refused_at_once(tmp_path):
    path, size = shard_parts(tmp_path)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(DatasetError, match="is not a regular file"):
        OpenShard(path, size)
