"""The trivial methods: a constant depth, and the depth of the nearest training image."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import fpp_bench
from scored_dataset import make_dataset, noise_scene

from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.baselines.run import predict_split
from fpp_ml_bench.baselines.trivial import ConstantMethod, NearestMethod
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.named_rigs import paper_rig

SIZE = (96, 96)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder, views = tmp_path_factory.mktemp("data") / "tiny", ("A0", "A60", "A120", "A180")
    made = make_dataset(folder, SIZE, views=views, scene=noise_scene(SIZE))
    replace(made.manifest, rig=paper_rig(96).to_dict()).write(made.path)  # the rig of such images
    return DatasetFolder(made.path)


def test_the_nearest_of_the_training_images_by_another_computation(dataset):
    method = NearestMethod(paper_rig(96), training=dataset)
    training = {
        sample: dataset.frame(sample, 0).astype(float) for sample in dataset.samples("train")
    }
    chosen = set()
    for sample in dataset.samples("test"):
        image = dataset.frame(sample, 0).astype(float)
        nearest = min(training, key=lambda name: float(((training[name] - image) ** 2).mean()))
        np.testing.assert_array_equal(
            method.predict([dataset.frame(sample, 0)]), dataset.depth_mm(nearest)
        )
        chosen.add(nearest)
    assert len(chosen) > 1
    for sample in training:  # its own image is the nearest
        np.testing.assert_array_equal(
            method.predict([dataset.frame(sample, 0)]), dataset.depth_mm(sample)
        )


def test_it_runs_over_a_split_and_says_what_it_used(dataset, tmp_path):
    assert fpp_bench("predict", "nearest", dataset.path, "--out", tmp_path / "p") == 0
    text = (tmp_path / "p" / "submission.yaml").read_text()
    assert "method: nearest" in text and f"training_fingerprint: {dataset.fingerprint}" in text
    assert (
        f"learned_from:\n  data: train-split\n  versions:\n  - dataset {dataset.fingerprint[:8]}\n"
        in text
    )
    predict_split(
        dataset, NearestMethod(dataset.rig, training=dataset.path), "test", tmp_path / "q"
    )
    assert len(list((tmp_path / "q").glob("*.npy"))) == 8


def test_what_can_not_be_searched_or_placed_is_refused(dataset):
    with pytest.raises(PredictionError, match="needs the training split"):
        load_method("nearest", paper_rig(96))
    with pytest.raises(PredictionError, match=r"expected training images of 48x48 px"):
        load_method("nearest", paper_rig(48), training=dataset)
    with pytest.raises(PredictionError, match="at 'nowhere': expected standoff"):
        load_method("constant", paper_rig(96), at="nowhere")
    with pytest.raises(PredictionError, match="nearest needs frame 0"):
        NearestMethod(paper_rig(96), training=dataset).predict([None])


@pytest.mark.parametrize(
    ("at", "depth_mm"),
    [("standoff", 1800.0), ("middle", 1800.0), ("training-mean", 1743.75), (5.0, 5.0)],
)
def test_a_constant_is_one_depth(at, depth_mm):
    depth = ConstantMethod(paper_rig(16), at=at).predict([])
    assert (
        depth.shape == (16, 16)
        and depth.dtype == np.float32
        and np.unique(depth).tolist() == [depth_mm]
    )


@pytest.mark.parametrize(("at", "share"), [("range-middle", 0.5), ("range-training", 0.294)])
def test_a_constant_that_is_told_the_range_is_a_share_of_it(at, share, dataset, tmp_path):
    method = ConstantMethod(dataset.rig, at=at)
    assert (
        np.unique(method.predict([])).tolist() == [np.float32(share)]
        and method.units == "normalised"
    )
    assert method.learned_from["data"] == ("none" if at == "range-middle" else "train-split")
    predict_split(dataset, method, "test", tmp_path / "p")
    result = evaluate(tmp_path / "p", dataset, mode="paper")
    assert result.track == "oracle range"
    for row in result.per_sample:
        depth = dataset.depth_mm(row.sample).astype(np.float64)
        kept = depth[(depth > 0) & ~dataset.void(row.sample)]
        low, high = kept.min(), kept.max()
        error = np.abs(depth[depth > 0] - (low + np.float32(share) * (high - low)))
        assert row.object_mae_mm == pytest.approx(error.mean(), rel=1e-6)
