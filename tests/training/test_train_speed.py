"""The training benchmark's two ways: the same images, the same network, one pass each."""

import numpy as np
import pytest
import scipy.io
import train_speed
from conftest import TINY_SIZE, tiny_settings

from fpp_ml_bench.loaders.published.exporting import write_tree
from fpp_ml_bench.loaders.render.builder import build
from fpp_ml_bench.loaders.storage.store import DatasetFolder


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """One training object as a dataset and as the published tree."""
    folder = tmp_path_factory.mktemp("train_speed")
    build(
        folder / "dataset", tiny_settings(stored="single_shot", objects=("bowl", "mug")), workers=1
    )
    write_tree(DatasetFolder(folder / "dataset"), folder / "tree", ["train"], 1)
    return folder / "dataset", folder / "tree"


@pytest.fixture
def ways():
    yield train_speed
    train_speed._surroundings.close()


def job(ways, data, tmp_path, **changes):
    told = {"network": "unet", "size": TINY_SIZE, "width": 2, "batch": 2, "threads": None}
    return ways.Job(**{"data": data, "scratch": tmp_path, **told, **changes})


@pytest.mark.long
def test_both_ways_read_the_same_images(monkeypatch, ways, data):
    train_speed.check_same(*data)
    monkeypatch.setattr(ways.PngAndMat, "__len__", lambda self: 5)
    with pytest.raises(SystemExit, match="holds 6 training pairs, the exported tree 5"):
        train_speed.check_same(*data)


@pytest.mark.long
def test_a_difference_is_noticed(ways, data):
    dataset, tree = data
    reader = ways.PngAndMat(tree)
    content = reader.depths[2].read_bytes()
    depth = scipy.io.loadmat(reader.depths[2])["depthMapNormalized"]
    try:
        scipy.io.savemat(
            reader.depths[2], {"depthMapNormalized": np.where(depth > 0, depth + 0.001, 0)}
        )
        with pytest.raises(
            SystemExit, match=f"{reader.depths[2].stem}: the two ways read different numbers"
        ):
            train_speed.check_same(dataset, tree)
    finally:
        reader.depths[2].write_bytes(content)


@pytest.mark.long
def test_an_epoch_of_each(ways, data, tmp_path):
    """From the same weights, over the same six pairs in orders of their own: nearly the same
    loss."""
    dataset, tree = data
    losses = []
    for kind, folder in ((ways.Plain, tree), (ways.Ours, dataset)):
        ways.start(kind, job(ways, folder, tmp_path))
        epoch = ways.run_epoch(True)
        assert 0 < epoch.data < epoch.step and 0 < epoch.compute < epoch.step
        assert epoch.memory_gib > 0
        losses.append(epoch.loss)
    assert losses[0] == pytest.approx(losses[1], rel=0.02)
