"""The torchmetrics metric: the evaluator's numbers whatever the batches, the order and the number
of processes."""

import numpy as np
import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as spawning
from scored_dataset import disk_depth

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation import DepthScores
from fpp_ml_bench.evaluation.result.model import over_samples
from fpp_ml_bench.evaluation.score.sample_scores import score_sample
from fpp_ml_bench.evaluation.score.torch_metric import KEYS

SIZE, SAMPLES, CHARGE_MM = (40, 48), 11, 300.0


def data():
    """Predictions and targets (N, H, W), one sample without object, one without background, missing
    pixels."""
    rng = np.random.default_rng(5)
    target = np.stack([disk_depth(SIZE, seed) for seed in range(SAMPLES)])
    target[3] = 0.0
    target[4] = 1800.0
    prediction = (target + rng.normal(0, 3, target.shape)) * (rng.random(target.shape) < 0.95)
    return prediction.astype(np.float32), target


def scored(batches, order=None):
    prediction, target = data()
    metric = DepthScores(charge_mm=CHARGE_MM)
    order = np.arange(SAMPLES) if order is None else order
    for part in np.array_split(order, batches):
        metric.update(torch.from_numpy(prediction[part]), torch.from_numpy(target[part]))
    return computed(metric)


def computed(metric):
    return {key: float(value) for key, value in metric.compute().items()}


def assert_same(scores, expected):
    for key in KEYS:
        assert scores[key] == pytest.approx(expected[key], rel=1e-12, abs=1e-13), key


def test_same_numbers_as_the_evaluator():
    prediction, target = data()
    void = np.random.default_rng(1).random(target.shape) < 0.1
    maps = zip(prediction, target, void, strict=True)
    rows = [score_sample(p, t, void=v, charge_mm=CHARGE_MM).metrics() for p, t, v in maps]
    metric = DepthScores(charge_mm=CHARGE_MM)
    metric.update(*map(torch.from_numpy, (prediction, target, void)))
    assert_same(computed(metric), over_samples(rows))


def test_batches_and_order_change_nothing():
    shuffled = np.random.default_rng(4).permutation(SAMPLES)
    assert_same(scored(4, shuffled), scored(1))


def _process(rank, address, folder):
    dist.init_process_group("gloo", init_method=address, rank=rank, world_size=2)
    prediction, target = data()
    metric = DepthScores(charge_mm=CHARGE_MM)
    indices = range(7) if rank == 0 else range(7, SAMPLES)  # unequal shares
    for index in indices:
        metric.update(*(torch.from_numpy(maps[[index]]) for maps in (prediction, target)))
    scores = computed(metric)
    metric.reset()  # rank 1 gets no sample, as in a short last epoch
    if rank == 0:
        metric.update(torch.from_numpy(prediction), torch.from_numpy(target))
    scores_of_rank_0 = computed(metric)
    torch.save([scores, scores_of_rank_0], f"{folder}/{rank}.pt")
    dist.destroy_process_group()


def _other_process(number, address, folder):
    _process(1 + number, address, folder)


@pytest.mark.processes
def test_two_processes_give_the_same_numbers(tmp_path):
    together = (f"file://{tmp_path}/meet", str(tmp_path))
    other = spawning.spawn(_other_process, args=together, join=False)
    _process(0, *together)
    other.join()
    expected = scored(1)
    for rank in (0, 1):
        scores, scores_of_rank_0 = torch.load(tmp_path / f"{rank}.pt")
        assert_same(scores, expected)
        assert_same(scores_of_rank_0, expected)


def test_state_stays_in_float64():
    metric = DepthScores(charge_mm=CHARGE_MM).half().float()
    prediction, target = data()
    metric.update(torch.from_numpy(prediction)[:, None], torch.from_numpy(target)[:, None])
    assert metric.sums.dtype == metric.compute()["object_mae_mm"].dtype == torch.float64
    assert_same(computed(metric), scored(1))
    metric.reset()
    assert float(metric.counts.sum()) == 0


def test_an_empty_set_is_no_score_and_never_zero():
    metric = DepthScores()
    metric.update(torch.ones(1, 4, 5), torch.zeros(1, 4, 5))
    scores = metric.compute()
    assert float(scores["background_mae_mm"]) == 1.0 and torch.isnan(scores["object_mae_mm"])


def test_forward_gives_the_batch_and_keeps_the_whole():
    prediction, target = map(torch.from_numpy, data())
    metric = DepthScores(charge_mm=CHARGE_MM)
    first = metric(prediction[:2], target[:2])
    metric(prediction[2:], target[2:])
    alone = DepthScores()
    alone.update(prediction[:2], target[:2])
    assert float(first["object_mae_mm"]) == float(alone.compute()["object_mae_mm"])
    assert_same(computed(metric), scored(1))


DEPTH = torch.full((1, 8, 10), 1800.0)
CORNER = torch.arange(80).view(1, 8, 10) < 40
BATCHES = {
    "void as uint8": (
        {},
        (DEPTH, DEPTH, (DEPTH > 0).to(torch.uint8)),
        "void: expected bool.* got torch.uint8",
    ),
    "void of another shape": ({}, (DEPTH, DEPTH, DEPTH[0] > 0), "void: expected .1, 8, 10."),
    "an array": ({}, (DEPTH.numpy(), DEPTH), "prediction: expected a tensor, got ndarray"),
    "both in metres": (
        {},
        (DEPTH / 1000, DEPTH / 1000),
        "the largest depth is 1.8, which could be metres",
    ),
    "NaN": ({}, (DEPTH * np.nan, DEPTH), "the prediction holds 80 NaN"),
    "another shape": ({}, (DEPTH[:, 1:], DEPTH), "expected a prediction of the target's shape"),
    "whole numbers": ({}, (DEPTH.long(), DEPTH), "int64"),
    "a single map": ({}, (DEPTH[0], DEPTH[0]), r"\(B, H, W\)"),
    "a mark for no surface": (
        {},
        (torch.where(CORNER, 65504.0, DEPTH), DEPTH.masked_fill(CORNER, 0.0)),
        "as nodata",
    ),
    "unknown units": ({"units": "inch"}, None, "units: expected mm or m"),
}


@pytest.mark.parametrize("case", BATCHES)
def test_what_could_mean_something_else_is_refused(case):
    options, batch, message = BATCHES[case]
    with pytest.raises(PredictionError, match=message):
        DepthScores(**options).update(*batch)


def test_units_and_a_mark_for_no_surface_that_are_said_are_taken():
    metres, untrained = DepthScores(units="m"), DepthScores(units="mm")
    metres.update(DEPTH / 1000 + 0.002, DEPTH / 1000)
    assert float(metres.compute()["object_mae_mm"]) == pytest.approx(
        2.0, rel=1e-4
    )  # float32 metres
    untrained.update(torch.full_like(DEPTH, 1.0), DEPTH)
    assert float(untrained.compute()["object_mae_mm"]) == 1799.0
    marked = DepthScores(nodata=65504.0)
    marked.update(*(torch.where(CORNER, 65504.0, depth) for depth in (DEPTH + 2, DEPTH)))
    assert float(marked.compute()["object_mae_mm"]) == 2.0
    assert float(marked.compute()["background_mae_mm"]) == 0.0


def test_gradients_are_not_held():
    metric = DepthScores()
    metric.update(DEPTH.clone().requires_grad_(), DEPTH)
    assert not metric.sums.requires_grad


def test_what_a_void_pixel_holds_does_not_matter():
    target, prediction = DEPTH.clone(), DEPTH + 2
    target[0, 0], prediction[0, 1] = float("nan"), float("nan")
    void = target.isnan() | prediction.isnan()
    metric = DepthScores()
    metric.update(prediction, target, void)
    assert float(metric.compute()["object_mae_mm"]) == 2.0
    with pytest.raises(PredictionError, match="targets: expected finite mm"):
        metric.update(prediction, target)
    metric.update(prediction, target, torch.ones_like(void))  # no pixel counts
    assert float(metric.compute()["object_mae_mm"]) == 2.0
