"""`load_dataset` and Hugging Face's own tools on the same folder: equal values, and `load_dataset`
copies nothing."""

import json
import pickle
import shutil
from pathlib import Path

import datasets
import numpy as np
import pyarrow as pa
import pytest
import torch
from conftest import TINY_CONFIGS, TINY_SIZE, tiny_settings
from synthetic import SyntheticRows, make

import fpp_ml_bench
from fpp_ml_bench.constants import OBJECTS, VIEWS, split_sample_name
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.loaders.render.builder import build
from fpp_ml_bench.loaders.sample import config_columns, features
from fpp_ml_bench.loaders.storage.shards import arrow_schema
from fpp_ml_bench.loaders.storage.store import DatasetFolder, load_dataset
from fpp_ml_bench.loaders.storage.verification import verify
from fpp_ml_bench.optics.sequence import PAPER_SEQUENCE

datasets.disable_progress_bars()


@pytest.mark.parametrize("config", TINY_CONFIGS)
def test_every_configuration_has_its_columns_in_order_and_their_values(tiny, opened, config):
    dataset = load_dataset(tiny, config, split="validation")
    frames = [f"frame_{i:02d}" for i in PAPER_SEQUENCE.config(config)]
    assert dataset.column_names == [
        "sample",
        "object",
        "view",
        "split",
        *frames,
        "depth",
        "depth_exact",
        "flags",
        "cover",
        "depth_min",
        "depth_max",
    ]
    assert len(dataset) == 6 and dataset.split == "validation"
    assert dataset["sample"][:] == opened.splits["validation"]
    row = dataset.with_format("numpy")[3]
    assert (row["sample"], row["object"], row["view"], row["split"]) == (
        "mug_A180",
        "mug",
        "A180",
        "validation",
    )
    for index in PAPER_SEQUENCE.config(config):
        np.testing.assert_array_equal(row[f"frame_{index:02d}"], opened.frame("mug_A180", index))
        assert dataset.features[f"frame_{index:02d}"] == datasets.Array2D(opened.size, "uint8")
    np.testing.assert_array_equal(row["depth"], opened.depth_mm("mug_A180"))
    np.testing.assert_array_equal(row["depth_exact"], opened.depth_mm("mug_A180", "depth_exact"))
    inside = row["depth"][row["depth"] > 0]
    assert (row["depth_min"], row["depth_max"]) == (inside.min(), inside.max())


def test_all_splits_at_once_and_the_lazy_name(tiny, opened):
    parts = fpp_ml_bench.load_dataset(tiny)
    assert isinstance(parts, datasets.DatasetDict)
    assert {split: part["sample"][:] for split, part in parts.items()} == opened.splits
    assert parts["train"].info.config_name == "single_shot"


def test_rows_of_several_shards_keep_their_order_every_way(tmp_path):
    """Nine objects of a split are two files of 30 and 24 rows."""
    folder = make(
        tmp_path / "set", {"train": OBJECTS[:9], "test": ("power_drill",)}, origin="imported"
    )
    folder_read = DatasetFolder(folder)
    assert [s.rows for s in folder_read.manifest.shards if s.split == "train"] == [30, 24]
    expected = [f"{name}_{view}" for name in OBJECTS[:9] for view in VIEWS]
    datasets_by_way = {
        "joined": load_dataset(folder, split="train"),
        "plain": datasets.load_dataset(str(folder), "single_shot", split="train"),
        "without its configuration": datasets.load_dataset(str(folder), split="train"),
        "in place": datasets.load_from_disk(str(folder))["train"],
    }
    assert datasets.get_dataset_split_names(str(folder), "single_shot") == ["train", "test"]
    for dataset in datasets_by_way.values():
        assert dataset.features == datasets_by_way["joined"].features
        assert dataset["sample"][:] == expected == folder_read.splits["train"]
        formatted = dataset.with_format("numpy")
        for row in (0, 29, 30, 53):
            for column in ("depth", "depth_exact"):
                np.testing.assert_array_equal(
                    formatted[row][column], folder_read.depth_mm(expected[row], column)
                )
            np.testing.assert_array_equal(
                formatted[row]["frame_00"], folder_read.frame(expected[row], 0)
            )
    alone = SyntheticRows().row(expected[30], *split_sample_name(expected[30]))
    np.testing.assert_array_equal(folder_read.frame(expected[30], 0), alone.frames[0])
    np.testing.assert_array_equal(folder_read.depth_mm(expected[30]), alone.depth_mm)


def test_memory_is_the_files_own_map(tiny):
    dataset = load_dataset(tiny, "all", split="train")
    maps = Path("/proc/self/maps").read_text().splitlines()
    for column in ("frame_00", "frame_10", "frame_30", "frame_51", "depth"):
        storage = dataset.data.column(column).chunk(0).storage
        buffer = storage.values.values.buffers()[1]
        holder = [
            line
            for line in maps
            if int(line.split("-")[0], 16)
            <= buffer.address
            < int(line.split()[0].split("-")[1], 16)
        ]
        assert len(holder) == 1 and str(tiny) in holder[0]


@pytest.mark.long
def test_new_data_in_the_same_folder_is_not_read_out_of_the_old_cache(tmp_path):
    folder = tmp_path / "set"
    frames = []
    for seed in (1, 2):
        build(folder, tiny_settings(objects=("cork",), stored="single_shot", seed=seed), workers=1)
        frames.append(np.array(datasets.load_dataset(str(folder), split="train")[0]["frame_00"]))
        np.testing.assert_array_equal(frames[-1], DatasetFolder(folder).frame("cork_A0", 0))
        shutil.rmtree(folder)
    assert (frames[0] != frames[1]).any()


def test_usual_operations(copied, opened):
    dataset = load_dataset(copied, "vertical", split="train")
    selected = dataset.shuffle(seed=3).select([4, 0])
    for row in selected.with_format("numpy"):
        np.testing.assert_array_equal(row["frame_20"], opened.frame(row["sample"], 20))
    filtered = dataset.filter(lambda view: view == "A60", input_columns="view")
    assert filtered["sample"][:] == ["bowl_A60", "cork_A60"]
    row = dataset.with_format("torch", columns=["frame_18", "depth"], dtype=torch.float32)[0]
    assert row["frame_18"].dtype == torch.float32
    assert row["frame_18"].shape == (TINY_SIZE, TINY_SIZE)
    again = pickle.loads(pickle.dumps(dataset)).with_format("numpy")[7]
    np.testing.assert_array_equal(again["depth"], opened.depth_mm(again["sample"]))
    assert verify(copied) == []  # `filter` leaves its cache beside the data, which is ignored


def test_fingerprints_follow_the_data(tiny, copied):
    def fingerprint(folder, config, split):
        return load_dataset(folder, config, split=split)._fingerprint

    first = fingerprint(tiny, "single_shot", "train")
    assert fingerprint(copied, "single_shot", "train") == first
    others = {fingerprint(tiny, "all", "train"), fingerprint(tiny, "single_shot", "test")}
    assert len(others | {first}) == 3


@pytest.mark.parametrize(("config", "exact"), [("single_shot", False), ("all", True)])
def test_schema_is_what_datasets_itself_would_write(config, exact):
    columns = config_columns(PAPER_SEQUENCE, config, exact)
    expected_features = datasets.Features(
        {name: datasets.Array2D((120, 160), "uint8") for name in columns}
    )
    for name in ("sample", "object", "view", "split"):
        expected_features[name] = datasets.Value("string")
    for name in ("depth_min", "depth_max"):
        expected_features[name] = datasets.Value("float32")
    for name in ("depth", "depth_exact") if exact else ("depth",):
        expected_features[name] = datasets.Array2D((120, 160), "float32")
    # Through a file, as a reader gets it: with `datasets` imported, the extension type comes from
    # the metadata.
    written = arrow_schema(features(columns, (120, 160))).serialize()
    schema, expected = pa.ipc.read_schema(written), expected_features.arrow_schema
    assert schema.equals(expected)
    stated, wanted = (json.loads(one.metadata[b"huggingface"]) for one in (schema, expected))
    assert stated == wanted
    assert datasets.Features.from_arrow_schema(schema) == expected_features
    assert datasets.Features.from_dict(features(columns, (120, 160))) == expected_features


@pytest.mark.parametrize(
    ("config", "split", "message"),
    [
        ("both", "train", "unknown configuration 'both'"),
        ("single_shot", "all", "expected one of train, validation, test, or None"),
    ],
)
def test_errors(tiny, config, split, message):
    with pytest.raises(DatasetError, match=message):
        load_dataset(tiny, config, split=split)


def test_configuration_that_is_not_stored(tmp_path):
    build(tmp_path / "set", tiny_settings(objects=("cork",), stored="horizontal"), workers=1)
    assert len(load_dataset(tmp_path / "set", "horizontal", split="train")) == 6
    assert list(load_dataset(tmp_path / "set", "single_shot")) == ["train"]
    with pytest.raises(
        DatasetError, match=r"'vertical' is not stored.*--config vertical or --config all"
    ):
        load_dataset(tmp_path / "set", "vertical", split="train")
    with pytest.raises(DatasetError, match="no such folder"):
        load_dataset(tmp_path / "none")
