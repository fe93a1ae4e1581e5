"""Void pixels count in no set, and unlit ones are a set of their own."""

import numpy as np
import pytest
from scored_dataset import make_dataset, write_predictions

from fpp_ml_bench.evaluation.metrics import HEADLINE, METRICS
from fpp_ml_bench.evaluation.report.terminal import result_table
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.score.sample_scores import score_sample
from fpp_ml_bench.loaders.sample import Flag, void_pixels


def flagged(depth):
    """Unlit: four rows through the disk. Mixed: its left border and the background beside it.
    Interreflection: all."""
    flags = np.full(depth.shape, Flag.INTERREFLECTION, np.uint8)
    flags[14:18][depth[14:18] > 0] |= np.uint8(Flag.UNLIT)
    border = (depth > 0) != np.roll(depth > 0, 1, axis=1)
    flags[border] |= np.uint8(Flag.MIXED)
    return flags


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return make_dataset(tmp_path_factory.mktemp("data") / "tiny", flagged=flagged)


def test_surface_that_was_not_decoded_is_void_too():
    flags = np.array([0, 0, 0, Flag.MIXED], np.uint8)
    depth_mm, exact_mm = (
        np.array([1800.0, 0.0, 0.0, 1800.0]),
        np.array([1800.5, 1800.5, 0.0, 1800.5]),
    )
    assert void_pixels(flags, depth_mm, exact_mm).tolist() == [False, True, False, True]


def test_the_papers_sets_know_no_void(dataset, tmp_path):
    folder = write_predictions(tmp_path / "p", dataset, noise_mm=2.0)
    result = evaluate(folder, dataset, mode="paper")
    for row in result.per_sample:
        scores = score_sample(
            np.load(folder / f"{row.sample}.npy"), dataset.depth_mm(row.sample)
        ).metrics()
        assert [getattr(row, key) for key in HEADLINE] == [scores[key] for key in HEADLINE]
        assert row.void_pixels is None and row.void_share is None
    optional = {key for key, metric in METRICS.items() if metric.optional}
    assert optional & set(result.metrics.model_dump()) == {"object_mae_range_share"}


def test_unlit_pixels_are_scored_against_their_exact_depth(dataset, tmp_path):
    folder = write_predictions(tmp_path / "p", dataset)
    for sample in dataset.samples("test"):
        exact, path = dataset.unlit_mm(sample), folder / f"{sample}.npy"
        np.save(path, np.where(exact > 0, exact + np.float32(3), np.load(path)))
    result = evaluate(folder, dataset, target="depth_exact")
    metrics = result.metrics
    assert (metrics.unlit_mae_mm, metrics.unlit_rmse_mm, metrics.unlit_valid_mae_mm) == (
        3.0,
        3.0,
        3.0,
    )
    assert metrics.unlit_missing_share == 0.0 and metrics.object_mae_mm == 0.5
    assert "Unlit pixels: MAE 3.000" in result_table(result).renderables[2].plain


def test_data_without_flags_have_none(tmp_path):
    data = make_dataset(tmp_path / "data", exact=False)
    result = evaluate(write_predictions(tmp_path / "p", data), data)
    assert result.metrics.void_share == 0.0 and {row.void_pixels for row in result.per_sample} == {
        0
    }
