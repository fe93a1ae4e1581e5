"""The training engine: same bits again, same bits after a kill, and a stop where there must be
one."""

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import TINY_SIZE, read_json

from fpp_ml_bench.baselines.networks.model import load
from fpp_ml_bench.baselines.training.depth_training import (
    DONE,
    WEIGHTS,
    at_minimum,
    epoch_order,
    rate_after,
    spread,
    train,
)
from fpp_ml_bench.baselines.training.engine import (
    CHECKPOINT,
    CURVE_FILE,
    Display,
    read_checkpoint,
    reproducible,
    save_checkpoint,
)
from fpp_ml_bench.baselines.training.recipe import Linear, Plateau, load_recipe, recipe_from_dict
from fpp_ml_bench.depth import denormalise
from fpp_ml_bench.errors import TrainingError
from fpp_ml_bench.evaluation.result.model import over_samples
from fpp_ml_bench.evaluation.score.sample_scores import score_sample
from fpp_ml_bench.loaders.training import FringeDepthDataset


def small(name="normalization/individual", **changes):
    """A shipped recipe cut down to seconds."""
    content = load_recipe(name, "small").to_dict()
    content |= {
        "size": TINY_SIZE,
        "width": 2,
        "max_epochs": 3,
        "pairs_per_epoch": 4,
        "validation_pairs": 2,
        "batch": 2,
    }
    return recipe_from_dict({**content, **changes})


def curve_of(run):
    """The log without what depends on the clock."""
    records = [json.loads(line) for line in run.log.read_text().splitlines()]
    return [{key: value for key, value in record.items() if key != "seconds"} for record in records]


@pytest.fixture(scope="module")
def trained(tiny):
    """Trains on the tiny dataset into a folder, by default by `small`."""

    def act(folder, recipe=None, **options):
        return train(recipe or small(), tiny, folder, **{"show": False, **options})

    return act


@pytest.fixture(scope="module")
def uninterrupted(trained, tmp_path_factory):
    return trained(tmp_path_factory.mktemp("training") / "run")


def test_what_a_training_leaves(uninterrupted, trained):
    assert uninterrupted.finished and uninterrupted.epochs == 3
    names = {path.name for path in uninterrupted.weights.parent.iterdir()}
    assert names == {WEIGHTS, CHECKPOINT, DONE, CURVE_FILE, "recipe.json", "log.jsonl"}
    records = curve_of(uninterrupted)
    assert [record["epoch"] for record in records] == [1, 2, 3]
    best = min(records, key=lambda record: record["validation_loss"])
    assert uninterrupted.best_epoch == best["epoch"]
    model = load(uninterrupted.weights)
    assert model.config.epoch == best["epoch"]
    assert model.config.recipe == small().to_dict()
    assert uninterrupted.curve.read_bytes().startswith(b"\x89PNG")
    assert trained(uninterrupted.weights.parent) == uninterrupted


@pytest.mark.long
def test_the_same_bits_again(uninterrupted, tmp_path, trained):
    again = trained(tmp_path / "run")
    assert again.weights.read_bytes() == uninterrupted.weights.read_bytes()
    assert curve_of(again) == curve_of(uninterrupted)
    of_another_seed = trained(tmp_path / "other", small(seed=43, max_epochs=1))
    assert curve_of(of_another_seed) != curve_of(uninterrupted)[:1]


def test_faded_gradients_are_zero_within_a_training_only():
    """Floats below 1e-38 cost a processor many times as much as others; gradients fade into
    them."""
    faded = torch.full((64,), 1e-39)
    with reproducible(cpu=True):
        assert not (faded * 0.5).any()
    assert (faded * 0.5 > 0).all()


@pytest.mark.processes
@pytest.mark.parametrize("batch_of_the_kill", [0, 3])
def test_killed_and_resumed_is_uninterrupted(
    uninterrupted, tmp_path, monkeypatch, batch_of_the_kill, trained
):
    batches = []

    def kill(self):
        batches.append(1)
        if len(batches) == batch_of_the_kill + 1:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Display, "step", kill)
        trained(tmp_path / "run")
    resumed = trained(tmp_path / "run")
    assert resumed.weights.read_bytes() == uninterrupted.weights.read_bytes()
    assert curve_of(resumed) == curve_of(uninterrupted)


@pytest.mark.long
def test_a_gan_paused_is_the_same_too(tmp_path, trained):
    recipe = small("architecture/pix2pix", max_epochs=2, options={"levels": 4})
    whole = trained(tmp_path / "whole", recipe)
    paused = trained(tmp_path / "paused", recipe, minutes=1e-6)
    assert not paused.finished and paused.epochs == 1 and not (tmp_path / "paused" / DONE).exists()
    resumed = trained(tmp_path / "paused", recipe)
    assert resumed.finished and resumed.weights.read_bytes() == whole.weights.read_bytes()
    assert curve_of(resumed) == curve_of(whole)
    assert {"discriminator", "feature_matching", "hybrid_l1"} <= set(curve_of(whole)[0])


@pytest.mark.long
@pytest.mark.parametrize("name", ["guided", "physics"])
def test_further_directions_train(name, tmp_path, trained):
    (record,) = curve_of(trained(tmp_path / "run", small(f"further/{name}", max_epochs=1)))
    assert ("further" in record) == (name == "physics")
    assert all(np.isfinite(value) for value in record.values())


def validation_of(weights, dataset, recipe):
    """What a log must say of ``weights``, by `score_sample` and NumPy: the mean loss and the scores
    in mm."""
    data = FringeDepthDataset(dataset, "validation", recipe.frames, recipe.normalisation)
    model, rows, losses = load(weights), [], []
    for index in spread(len(data), recipe.validation_pairs):
        item = data[index]
        values = model.predict_representation(item.fringe.numpy())[0]
        target = data.source.depth_mm(data.samples[int(item.row)]).astype(np.float64)
        low, high = (float(v) for v in item.depth_range_mm)
        if recipe.normalisation == "individual":
            prediction = denormalise(values, "individual", low, high) - np.where(
                target > 0, 0.0, low
            )
        else:
            prediction = denormalise(values, recipe.normalisation, low, high)
        void = (
            None
            if recipe.normalisation == "individual"
            else data.source.void(data.samples[int(item.row)])
        )
        rows.append(score_sample(prediction, target, void=void).metrics())
        losses.append(
            math.sqrt(
                float(((values - item.depth[0].numpy()).astype(np.float64) ** 2).mean()) + 1e-8
            )
        )
    return np.mean(losses), over_samples(rows)


SCORES = ("object_mae_mm", "background_mae_mm", "overall_mae_mm")
FLOAT32 = 1e-5
"""The same float32 network with another batch size or number of threads: its sums of up to 300
terms, rounded to 6e-8 each and added up in another order, differ by about 6e-8 sqrt(300) = 1e-6 of
the output's scale a layer."""


@pytest.mark.long
@pytest.mark.parametrize("normalisation", ["raw", "global", "individual"])
def test_the_validation_score_is_the_evaluators(tiny, tmp_path, normalisation, trained):
    recipe = small(f"normalization/{normalisation}", max_epochs=1, validation_pairs=None)
    run = trained(tmp_path / "run", recipe)
    loss, scores = validation_of(run.weights, tiny, recipe)
    logged = curve_of(run)[0]
    for key in SCORES:
        assert logged[key] == pytest.approx(scores[key], rel=FLOAT32), key
    assert logged["validation_loss"] == pytest.approx(loss, rel=FLOAT32)


@pytest.mark.long
def test_many_frames_and_bf16(tmp_path, trained):
    recipe = small("multi_frame/vertical", precision="bf16", max_epochs=1)
    run = trained(tmp_path / "run", recipe, show=True)
    assert run.finished and math.isfinite(curve_of(run)[0]["training_loss"])
    assert load(run.weights).config.data_config == "vertical"


def test_divergence_names_the_batch(tmp_path, trained):
    rule = {"name": "rmsprop", "learning_rate": 1e30, "alpha": 0.99, "weight_decay": 1e-5}
    with pytest.raises(
        TrainingError, match=r"training diverged: loss .* in epoch 1, batch 2, samples \w+_A\d+"
    ):
        trained(tmp_path / "run", small(optimizer=rule))


def test_a_validation_loss_that_runs_away_ends_it(tmp_path, trained):
    """The step between the last look at the training loss and the validation was the fatal one."""
    rule = {"name": "rmsprop", "learning_rate": 1e9, "alpha": 0.99, "weight_decay": 1e-5}
    with pytest.raises(TrainingError, match="the validation loss after epoch 1"):
        trained(tmp_path / "run", small(optimizer=rule, pairs_per_epoch=2))
    assert not (tmp_path / "run" / WEIGHTS).exists()


@pytest.mark.processes
def test_two_processes_agree(tiny, tmp_path):
    """accelerate's launcher on two processors: one set of files, and a log that both have a part
    in."""
    (tmp_path / "mine.yaml").write_text(
        f"extends: loss/l1\nsize: {TINY_SIZE}\nwidth: 2\nmax_epochs: 1\nbatch: 2\n"
        "pairs_per_epoch: 4\nvalidation_pairs: 3\n"
    )
    code = "from accelerate.commands.launch import main; main()"
    options = "--cpu --num_processes 2 --num_machines 1 --mixed_precision no --dynamo_backend no "
    options += "--main_process_port 0 -m fpp_ml_bench train"
    files = [tmp_path / "mine.yaml", tiny, "--out", tmp_path / "run"]
    done = subprocess.run(
        [sys.executable, "-c", code, *options.split(), *map(str, files)],
        cwd=Path(__file__).resolve().parent.parent,
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert names == {WEIGHTS, CHECKPOINT, DONE, CURVE_FILE, "recipe.json", "log.jsonl"}
    record = read_json(tmp_path / "run" / "log.jsonl")
    assert math.isfinite(record["validation_loss"])
    scores = validation_of(
        tmp_path / "run" / WEIGHTS, tiny, load_recipe(tmp_path / "mine.yaml", "small")
    )[1]
    for key in SCORES:  # means over the three pairs of both processes
        assert record[key] == pytest.approx(scores[key], rel=FLOAT32), key


def test_nothing_that_is_not_finite_is_kept(tmp_path, monkeypatch, trained):
    """A network whose training looks sound and whose answer in validation is not."""
    from fpp_ml_bench.baselines.networks.unet import UNet

    forward = UNet.forward
    monkeypatch.setattr(
        UNet, "forward", lambda self, x: forward(self, x) * (1.0 if self.training else math.nan)
    )
    with pytest.raises(TrainingError, match=r"the network's answer to \w+_A\d+ is not finite"):
        trained(tmp_path / "run")
    assert not (tmp_path / "run" / WEIGHTS).exists()


def test_refusals(uninterrupted, tmp_path, trained):
    folder = tmp_path / "run"
    shutil.copytree(uninterrupted.weights.parent, folder)
    with pytest.raises(
        TrainingError, match="differs in normalisation, optimizer; give another folder"
    ):
        trained(folder, small("normalization/raw"))
    with pytest.raises(
        TrainingError, match=rf"{TINY_SIZE} px, recipe .* expects 192 x 192; build the size"
    ):
        trained(tmp_path / "other", small(size=192))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("precious")
    with pytest.raises(TrainingError, match=r"holds files but no recipe\.json"):
        trained(tmp_path / "mine")
    (folder / DONE).write_text("{")
    with pytest.raises(TrainingError, match="is damaged; delete it"):
        trained(folder)
    (folder / DONE).unlink()
    content = bytearray((folder / CHECKPOINT).read_bytes())
    content[-100] ^= 1
    (folder / CHECKPOINT).write_bytes(content)
    with pytest.raises(TrainingError, match="does not match its own checksum"):
        trained(folder)
    (folder / CHECKPOINT).write_bytes(content[:1000])
    with pytest.raises(TrainingError, match=r"damaged .*delete .* to train again"):
        trained(folder)
    shutil.copy(uninterrupted.weights, folder / CHECKPOINT)
    with pytest.raises(
        TrainingError, match="expected weights of fpp-ml-bench training, got format 'fpp-ml-bench'"
    ):
        trained(folder)


def test_an_epoch_is_a_permutation_and_rounds_are_fair():
    assert sorted(epoch_order(12, None, 42, 3)) == list(range(12))
    assert epoch_order(12, None, 42, 3) != epoch_order(12, None, 42, 4)
    assert epoch_order(12, None, 42, 3) == epoch_order(12, None, 42, 3)
    for pairs, drawn in ((12, 4), (12, 5), (7, 7), (5, 9)):
        walked = [index for epoch in range(24) for index in epoch_order(pairs, drawn, 42, epoch)]
        counts = np.bincount(walked, minlength=pairs)
        assert counts.max() - counts.min() <= 1
        assert len(walked) == 24 * min(pairs, drawn)


def test_validation_pairs_come_evenly_from_views_and_frames():
    for frames in (1, 18, 36, 52):
        chosen = spread(30 * frames, 30)
        assert [index // frames for index in chosen] == list(range(30))
        assert len({index % frames for index in chosen}) >= min(frames, 15)
    assert spread(5, None) == spread(5, 9) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("factor", [0.5, 0.1])
def test_training_ends_when_the_rate_is_at_its_minimum(factor):
    """1e-4 x 0.1 x 0.1 is 1.0000000000000002e-06: a plain comparison with 1e-6 would never be
    true."""
    rule = Plateau(name="plateau", factor=factor, patience=10, minimum=1e-6)
    epochs = 0
    while not at_minimum(rule, rate_after(rule, 1e-4, [1.0] * epochs)):
        epochs += 1
        assert epochs < 200
    # The first epoch sets the best; every 11 bad ones after it lower the rate.
    assert epochs == 1 + 11 * math.ceil(math.log(1e-2) / math.log(factor) - 1e-9)


@pytest.mark.parametrize("patience", [0, 2, 10])
def test_a_plateau_is_torchs(patience):
    holder = torch.optim.SGD([torch.zeros(1)], lr=1e-4)
    rule = Plateau(name="plateau", factor=0.3, patience=patience, minimum=2e-6)
    torchs = torch.optim.lr_scheduler.ReduceLROnPlateau(
        holder, factor=0.3, patience=patience, min_lr=2e-6, eps=0.0
    )
    losses = (
        np.random.default_rng(patience).uniform(0.99, 1.0, 200) * np.linspace(1, 0.95, 200)
    ).tolist()
    for epoch, loss in enumerate(losses, 1):
        holder.step()
        torchs.step(loss)
        assert rate_after(rule, 1e-4, losses[:epoch]) == holder.param_groups[0]["lr"]


def test_a_linear_schedule_is_constant_and_then_falls_to_zero():
    rule, rates = Linear(name="linear", constant=2, decay=4), []
    while not at_minimum(rule, rate := rate_after(rule, 1e-4, [0.0] * len(rates))):
        rates.append(rate)
    assert rates == pytest.approx([1e-4, 1e-4, 1e-4, 0.75e-4, 0.5e-4, 0.25e-4])


@pytest.mark.long
def test_the_rule_of_the_range_is_recorded_and_a_run_of_another_is_not_continued(tmp_path, trained):
    """Runs of before the rule hold none; their range was that of all object pixels."""
    recipe = small("normalization/individual", max_epochs=2)
    paused = trained(tmp_path / "run", recipe, minutes=1e-6)
    assert load(paused.weights).config.range_rule == "valid"
    tensors, state = read_checkpoint(tmp_path / "run" / CHECKPOINT)
    assert state.pop("range_rule") == "valid"
    save_checkpoint(tmp_path / "run" / CHECKPOINT, tensors, state)
    with pytest.raises(
        TrainingError, match="another recipe, dataset or depth range; give a new folder"
    ):
        trained(tmp_path / "run", recipe)
