"""Training pairs: how many, which, and that every tensor is what the paper's equations give in
float64."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from conftest import TINY_CONFIGS
from synthetic import make
from torch.utils.data import DataLoader

from fpp_ml_bench.constants import FULL_SIZE, OBJECTS
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.loaders.render.builder import plan_build
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.training import FringeDepthDataset
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.sequence import PAPER_SEQUENCE


def paper(depth_mm, name, counted=True):
    """Section 3.3 in float64, from nothing but the depth map; the range is that of the pixels
    ``counted``."""
    d = depth_mm.astype(np.float64)
    if name == "raw":
        return d
    if name == "global":
        return d / 1000
    ends = d[(d > 0) & counted]
    low, high = ends.min(), ends.max()
    return np.where(d > 0, ((d - low) / (high - low)).clip(0, 1), 0)


@pytest.mark.parametrize(
    ("config", "pairs"),
    [
        ("single_shot", 240),
        ("horizontal", 4320),
        ("vertical", 4320),
        ("sinusoidal", 8640),
        ("all", 12480),
    ],
)
def test_full_set_has_the_papers_training_pairs(tiny, config, pairs):
    """By arithmetic on the full set's plan; the dataset's own length on rows of that many
    samples."""
    plans = plan_build(BuildSettings(paper_rig(FULL_SIZE), OBJECTS))
    rows = [sample for plan in plans if plan.split == "train" for sample, _, _ in plan.samples]
    assert len(rows) * len(PAPER_SEQUENCE.config(config)) == pairs
    dataset = FringeDepthDataset(tiny, "train", config)
    dataset.samples = rows
    assert len(dataset) == pairs
    assert dataset.pair(pairs - 1) == (239, PAPER_SEQUENCE.config(config)[-1])


@pytest.mark.parametrize("config", TINY_CONFIGS)
def test_pairs_are_all_frames_of_a_row_then_the_next(tiny, config):
    dataset = FringeDepthDataset(tiny, "train", config)
    frames = PAPER_SEQUENCE.config(config)
    expected = [(row, frame) for row in range(12) for frame in frames]
    assert [dataset.pair(i) for i in range(len(dataset))] == expected
    assert dataset.pair(-1) == expected[-1]
    for index in (len(dataset), -len(dataset) - 1):
        with pytest.raises(IndexError):
            dataset.pair(index)
        with pytest.raises(IndexError):
            dataset[index]


@pytest.mark.parametrize("normalisation", ["raw", "global", "individual"])
@pytest.mark.parametrize(("background_removed", "rule"), [(False, "object"), (True, "valid")])
def test_tensors_are_the_papers(tiny, opened, normalisation, background_removed, rule):
    """By the rule ``valid`` the range is that of the pixels that are not void; depths beyond it are
    cut to it."""
    dataset = FringeDepthDataset(tiny, "test", "vertical", normalisation, background_removed, rule)
    for index in (0, 17, 40, 107):
        item = dataset[index]
        row, frame = divmod(index, 18)
        sample = opened.splits["test"][row]
        depth = opened.depth_mm(sample)
        fringe = opened.frame(sample, 18 + frame).astype(np.float64) / 255
        if background_removed:
            fringe = np.where(depth > 0, fringe, 0)
        assert item.fringe.dtype == item.depth.dtype == torch.float32
        assert item.fringe.shape == item.depth.shape == (1, *opened.size)
        np.testing.assert_allclose(item.fringe[0].numpy(), fringe, rtol=2**-23)
        counted = ~opened.void(sample) if rule == "valid" else np.full(depth.shape, True)
        np.testing.assert_allclose(
            item.depth[0].numpy(), paper(depth, normalisation, counted), rtol=2**-22
        )
        inside = depth[(depth > 0) & counted]
        assert item.depth_range_mm.tolist() == [inside.min(), inside.max()]
        assert (inside.size < np.count_nonzero(depth)) == (rule == "valid")
        assert (int(item.row), int(item.frame)) == (row, 18 + frame)
        assert item.fringe.min() >= 0 and item.fringe.max() <= 1
        if background_removed:
            assert (item.fringe[0].numpy()[depth == 0] == 0).all()


def test_flat_sample_is_zero_throughout(tiny, monkeypatch):
    dataset = FringeDepthDataset(tiny, "validation")
    flat = np.zeros(dataset.source.size, np.float32)
    flat[50:90, 60:80] = 1800
    source = SimpleNamespace(
        size=dataset.source.size,
        frame=dataset.source.frame,
        depth_mm=lambda sample: flat,
        measured=lambda sample: {"depth_min_mm": 1800.0, "depth_max_mm": 1800.0},
        void=lambda sample: flat < 0,
    )
    dataset.source = source
    item = dataset[0]
    assert (item.depth == 0).all() and torch.isfinite(item.depth).all()


def test_batches_reuse_one_buffer_and_hold_what_items_hold(tiny):
    dataset = FringeDepthDataset(tiny, "train", "horizontal")
    order = [5, 100, 3, 3, 215, 0, 77]
    places, seen = set(), 0
    for number, batch in enumerate(dataset.batches(3, order)):
        places.add((batch.fringe.data_ptr(), batch.depth.data_ptr()))
        expected = order[3 * number : 3 * number + 3]
        assert len(batch.fringe) == len(expected)
        for place, index in enumerate(expected):
            item = dataset[index]
            for batched, alone in zip(batch, item, strict=True):
                assert torch.equal(batched[place], alone)
        seen += len(expected)
    assert seen == 7 and len(places) == 1
    assert sum(len(b.row) for b in dataset.batches(50)) == 216
    buffer = dataset.empty(2)
    assert dataset.read([1, 2], buffer) is buffer
    with pytest.raises(ValueError, match="holds 2 items, expected 3"):
        dataset.read([1, 2, 3], buffer)


def test_items_own_their_memory(tiny):
    dataset = FringeDepthDataset(tiny, "train")
    first = dataset[0]
    copy = first.fringe.clone()
    first.depth.zero_()
    dataset[1]
    assert torch.equal(first.fringe, copy)
    assert dataset[0].depth.max() == 1  # the file is untouched


@pytest.mark.long
def test_data_loader_gives_the_same_batches_from_a_spawned_worker(tiny):
    dataset = FringeDepthDataset(tiny, "validation", "single_shot", "individual", True)
    loader = DataLoader(dataset, batch_size=4, num_workers=1, multiprocessing_context="spawn")
    batches = list(loader)
    assert [len(b.row) for b in batches] == [4, 2]
    assert batches[0].fringe.shape == (4, 1, *dataset.source.size)
    for index in range(6):
        batch, place = batches[index // 4], index % 4
        assert int(batch.row[place]) == index
        assert torch.equal(batch.depth[place], dataset[index].depth)
        assert torch.equal(batch.fringe[place], dataset[index].fringe)


def test_configuration_that_is_not_stored(tmp_path):
    with pytest.raises(DatasetError, match="no configuration 'all'; there are single_shot"):
        FringeDepthDataset(make(tmp_path / "set"), "train", "all")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"split": "val"}, "no split 'val'"),
        ({"config": "both"}, "no configuration 'both'"),
        ({"normalisation": "zscore"}, "unknown normalisation 'zscore'"),
    ],
)
def test_errors(tiny, options, says):
    with pytest.raises(DatasetError, match=says):
        FringeDepthDataset(**{"folder": tiny, "split": "train", **options})
