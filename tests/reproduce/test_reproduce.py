"""`fpp-bench reproduce` from trainings to tables, with trainings that take no time: what is made,
kept and refused."""

import json
import re
import shutil
from functools import cache

import numpy as np
import pytest
import torch
from conftest import fpp_bench, fpp_eval, printed, read_json, refusal
from scored_dataset import write_description

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.networks.model import build
from fpp_ml_bench.baselines.reproduce import plan, work
from fpp_ml_bench.baselines.reproduce.scores import (
    BINS_MM,
    SPLIT,
    histogram,
    read_scores,
    score_frames,
    scores_that_hold,
)
from fpp_ml_bench.baselines.reproduce.work import plan_state
from fpp_ml_bench.baselines.timing import time_method
from fpp_ml_bench.baselines.training import depth_training
from fpp_ml_bench.baselines.training.depth_training import model_config
from fpp_ml_bench.baselines.training.engine import claim_folder
from fpp_ml_bench.baselines.training.recipe import load_recipe
from fpp_ml_bench.baselines.training.weights import save_weights
from fpp_ml_bench.baselines.trivial import best_range_share
from fpp_ml_bench.errors import PredictionError, SubmissionError, TrainingError
from fpp_ml_bench.evaluation.result.file import read_result, write_json
from fpp_ml_bench.evaluation.score.check import Rules
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.leaderboard.ranking import rank
from fpp_ml_bench.leaderboard.rows import read_entry
from fpp_ml_bench.loaders.storage.store import DatasetFolder

pytestmark = pytest.mark.long

TABLE = "normalization"
NAMES = ("small-unet-raw-rmse", "small-unet-global-rmse", "small-unet-individual-rmse")
SEEDED = [f"{name}-seed_{seed}" for name in NAMES for seed in (1, 2)]


@cache
def _timing(folder):
    opened = DatasetFolder(folder)
    return time_method(opened, ClassicalMethod(opened.rig, steps=3), repeats=1)


def reused_timing(opened, method, split, repeats):
    """A timing of something else, for tests that are not about time."""
    return _timing(opened.path).model_copy(update={"frames": len(method.frames_used)})


@pytest.fixture(autouse=True)
def small(monkeypatch, opened, request):
    """Recipes at the tiny dataset's size, networks of width 1, 2 timed runs a method."""

    def tiny_recipe(name, preset="small"):
        recipe = load_recipe(name, preset)
        return recipe.model_copy(update={"size": opened.size[0], "width": 1})

    monkeypatch.setattr(plan, "load_recipe", tiny_recipe)
    monkeypatch.setattr(work, "REPEATS", 2)
    if "from_trainings" not in request.node.name:  # there the time is really measured
        monkeypatch.setattr(work, "time_method", reused_timing)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    assert torch.get_num_threads() == 2
    torch.set_num_threads(threads)


class Trainer:
    """Stands in for the engine: weights drawn from a seed, in the engine's own files. ``says`` maps
    a recipe's name to what happens instead of finishing."""

    def __init__(self) -> None:
        self.trained, self.says, self.seed = [], {}, 0

    def __call__(self, recipe, dataset, out, *, minutes=None, show=True):
        opened = DatasetFolder(dataset)
        data = depth_training.open_data(recipe, dataset)[0]
        claim_folder(out, {"recipe": recipe.to_dict(), "fingerprint": data.source.fingerprint})
        finished = depth_training.finished_run(out)
        if finished is not None:
            return finished
        outcome = self.says.get(recipe.name)
        if isinstance(outcome, BaseException):
            raise outcome
        if outcome == "out of time":
            return depth_training.TrainingRun(out, 1, 1, 1.0, finished=False)
        self.trained.append(recipe.name)
        torch.manual_seed(self.seed + recipe.seed)
        network = build(recipe.network, width=recipe.width)
        # Untrained, its output would be refused for its unit: a little around a depth that can be.
        with torch.no_grad():
            network.head.weight.mul_(0.01)
            network.head.bias.fill_(
                {"raw": 1500.0, "global": 1.5, "individual": 0.4}[recipe.normalisation]
            )
        save_weights(
            out / depth_training.WEIGHTS, network, model_config(recipe, network, opened, 3, {})
        )
        (out / depth_training.DONE).write_text(
            json.dumps({"epochs": 5, "best_epoch": 3, "seconds": 61.4})
        )
        return depth_training.finished_run(out)


@pytest.fixture
def trainer(monkeypatch):
    stand_in = Trainer()
    monkeypatch.setattr(work, "train", stand_in)
    return stand_in


@pytest.fixture
def unscored(monkeypatch):
    """Trainings only: nothing is predicted or scored."""
    monkeypatch.setattr(work, "_score", lambda *arguments: None)


@pytest.fixture
def run(tiny, tmp_path, trainer):
    """Run the command on the tiny dataset below ``tmp_path``."""
    options = ["--out", tmp_path / "runs", "--workers", 1]
    return lambda table, *words: fpp_bench("reproduce", table, tiny, *words, *options)


def test_from_trainings_to_a_table(run, trainer, tmp_path, tiny, capsys):
    assert run(TABLE) == 0
    below = tmp_path / "runs" / "small"
    assert trainer.trained == [name.removeprefix("small-") for name in (*NAMES, *SEEDED)]
    assert sorted(path.stem for path in (below / "rows").glob("*.json")) == sorted(
        (*NAMES, *SEEDED)
    )
    entries = {path.stem: read_entry(path) for path in (below / "rows").glob("*.json")}
    assert all(entry.is_row_file for entry in entries.values())
    tracks = {
        name: (entry.row.track, entry.row.mode, entry.row.target) for name, entry in entries.items()
    }
    assert tracks[NAMES[2]] == ("oracle range", "paper", "depth")
    assert {tracks[name] for name in (*NAMES[:2], *SEEDED[:4])} == {("metric", "standard", "depth")}
    assert all(entry.name.endswith("(small preset)") for entry in entries.values())
    assert [len(group.rows) for group in rank(entries.values())] == [6, 3]
    for name, entry in entries.items():
        assert entry.row.timing.parameters == sum(
            p.numel() for p in build("unet", width=1).parameters()
        )
        for folder in ("results", "rows"):
            files = below / folder / f"{name}.json", below / "predictions" / name
            assert fpp_eval("verify", *files, tiny) == 0
    text = (below / f"{TABLE}.md").read_text()
    lines = {
        line.split(" | ")[0].strip("| "): line
        for line in text.split("## ")[0].splitlines()
        if line.startswith("| ")
    }
    each = [entries[name].row.metrics.object_mae_mm for name in (NAMES[2], *SEEDED[-2:])]
    assert f"| oracle range | {np.mean(each):.2f} / " in lines["individual"]
    assert f"| {', '.join(f'{mae:.2f}' for mae in each)} |" in lines["individual"]
    assert "| 16.20 / 21.19 |" in lines["individual"]
    assert "| 5 | 61 |" in lines["raw (mm)"]
    assert "3 among the rows measured here" in text and "of different tracks" in text
    assert "reported by the paper" in capsys.readouterr().out


def stamps(folder):
    return {path.name: path.stat().st_mtime_ns for path in folder.glob("*.json")}


def test_only_missing_keeps_what_holds(run, trainer, tmp_path, capsys):
    assert run(TABLE) == 0
    rows = tmp_path / "runs" / "small" / "rows"
    first = stamps(rows)
    assert run(TABLE, "--only-missing") == 0 and stamps(rows) == first
    assert len(trainer.trained) == 9
    (rows / f"{NAMES[1]}.json").unlink()
    (rows / f"{NAMES[2]}.json").write_text("{")
    assert run(TABLE, "--only-missing") == 0
    changed = {
        name.removesuffix(".json") for name, stamp in stamps(rows).items() if first[name] != stamp
    }
    assert changed == {*NAMES[1:]}
    assert run(TABLE) == 0 and len(trainer.trained) == 9
    assert not set(stamps(rows).items()) & set(first.items())


def test_rows_of_other_weights_are_made_again_and_not_shown(run, trainer, tmp_path):
    assert run(TABLE) == 0
    below = tmp_path / "runs" / "small"

    def weights():
        row = read_entry(below / "rows" / f"{NAMES[2]}.json").row
        return row.submission.settings["weights_sha256"]

    weights_before = weights()
    (below / "unet-individual-rmse" / "done.json").unlink()
    trainer.says["unet-individual-rmse"] = "out of time"
    trainer.seed = 1
    assert run(TABLE, "--only-missing", "--minutes", "5") == 1
    assert "Not measured here: individual. To fill" in (below / f"{TABLE}.md").read_text()
    trainer.says.clear()
    assert run(TABLE, "--only-missing") == 0
    assert weights_before != weights() and len(trainer.trained) == 10


def test_rows_of_another_machine_are_shown_if_of_the_same_recipe(run, trainer, tmp_path):
    def lines():
        return re.findall(r"^\| individual \|.*", (below / f"{TABLE}.md").read_text(), re.M)

    below = tmp_path / "runs" / "small"
    assert run(TABLE) == 0
    made_here = lines()
    shutil.rmtree(below / "unet-individual-rmse")
    assert run(f"{TABLE}/raw") == 0 and len(trainer.trained) == 9
    assert len(made_here) == 3 and lines() == made_here
    row = below / "rows" / f"{NAMES[2]}.json"
    digest = read_entry(row).row.submission.settings["recipe_digest"]
    row.write_text(row.read_text().replace(digest, 64 * "0"))
    assert run(f"{TABLE}/raw") == 0
    assert "Not measured here: individual. To fill" in (below / f"{TABLE}.md").read_text()


def test_when_minutes_run_out_the_same_command_goes_on(run, trainer, unscored, tmp_path, capsys):
    trainer.says["unet-global-rmse"] = "out of time"
    assert run(TABLE, "--minutes", "5") == 1
    out = capsys.readouterr().out
    assert "Stopped after 5 minutes; the first that is not at its end: unet-global-rmse." in out
    assert "Continue with: fpp-bench reproduce normalization" in out
    assert "--only-missing --minutes 5" in out
    text = (tmp_path / "runs" / "small" / f"{TABLE}.md").read_text()
    assert (
        "Not measured here: raw, global, individual. To fill: `fpp-bench reproduce normalization"
        in text
    )
    trainer.says.clear()
    assert run(TABLE, "--only-missing", "--minutes", "5") == 0


def test_a_training_that_fails_does_not_stop_the_others(run, trainer, unscored, tmp_path, capsys):
    trainer.says["unet-global-rmse"] = TrainingError(
        "training diverged: loss is not finite in batch 3"
    )
    assert run(TABLE) == 2
    assert (
        "1 of 9 rows could not be made:\n  unet-global-rmse: training diverged"
        in capsys.readouterr().err
    )
    text = (tmp_path / "runs" / "small" / f"{TABLE}.md").read_text()
    assert "- global: training diverged" in text
    assert len(trainer.trained) == 8


def test_ctrl_c_leaves_what_is_done_and_a_table(run, trainer, unscored, tmp_path):
    trainer.says["unet-global-rmse"] = KeyboardInterrupt()
    assert run(TABLE) == 130
    assert (tmp_path / "runs" / "small" / f"{TABLE}.md").is_file()
    trainer.says.clear()
    assert run(TABLE, "--only-missing") == 0
    assert trainer.trained.count("unet-raw-rmse") == 1


def test_a_training_of_another_recipe_is_refused_before_any_work(run, trainer, tmp_path, capsys):
    out = tmp_path / "runs" / "small" / "unet-individual-rmse"
    out.mkdir(parents=True)
    recipe = plan.load_recipe("normalization/individual", "small")
    other = {**recipe.to_dict(), "batch": 8, "seed": 1}
    (out / "recipe.json").write_text(json.dumps({"recipe": other, "fingerprint": 64 * "0"}))
    assert run(TABLE) == 2
    error = capsys.readouterr().err
    assert (
        "batch (8 there, 4 in the recipe), seed (1 there, 42 in the recipe)" in error
        and f"mv {out}" in error
    )
    assert trainer.trained == []
    (out / "recipe.json").write_text("[]")
    assert run(TABLE) == 2 and "can't be read" in capsys.readouterr().err


def test_a_training_on_another_dataset_is_refused(run, trainer, unscored, tmp_path, capsys):
    assert run(TABLE) == 0 and run(TABLE) == 0
    path = tmp_path / "runs" / "small" / "unet-individual-rmse" / "recipe.json"
    path.write_text(json.dumps(read_json(path) | {"fingerprint": 64 * "a"}))
    assert run(TABLE) == 2
    assert (
        "is of aaaaaaaa; give that dataset as DATASET, or another --out" in capsys.readouterr().err
    )


def test_the_papers_preset_needs_a_gpu(run, trainer, unscored, monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert run(TABLE, "--preset", "paper", "--minutes", "10") == 2
    error = capsys.readouterr().err
    assert (
        "no CUDA GPU" in error
        and re.search(r"fpp-bench reproduce normalization \S+ --preset paper", error)
        and "--anyway" in error
    )
    assert trainer.trained == []
    assert run(TABLE, "--preset", "paper", "--anyway") == 0 and len(trainer.trained) == 3
    assert run(TABLE, "--preset", "paper") == 0  # nothing is left to train


def test_every_frame_is_scored_for_the_multi_frame_table(run, trainer, tmp_path, opened):
    assert run("multi_frame/vertical") == 0
    below = tmp_path / "runs" / "small"
    scores = read_scores(below / "scores" / "small-unet-individual-rmse-vertical.json")
    assert scores.frames == list(range(18, 36)) and scores.pairs == 18 * len(opened.samples("test"))
    result = read_result(below / "results" / "small-unet-individual-rmse-vertical.json")
    row = read_entry(below / "rows" / "small-unet-individual-rmse-vertical.json").row
    assert result.submission.frames_used == row.submission.frames_used == [18]
    assert scores.errors["object_mae_mm"] == pytest.approx(
        np.mean(list(scores.per_object.values())), rel=1e-9
    )
    table = (below / "multi_frame.md").read_text().split("## ")[0]
    lines = [line for line in table.splitlines() if line.startswith("| 18 vertical")]
    assert len(lines) == 2 and "its first frame only" in lines[1]
    assert (
        f"| {scores.errors['object_mae_mm']:.2f} / " in lines[0] and "| 12.36 / 16.94 |" in lines[0]
    )
    assert f"| {row.metrics.object_mae_mm:.2f} / " in lines[1] and "12.36" not in lines[1]
    for key in ("overall_mae_mm", "object_mae_mm"):
        assert sum(scores.counts[key]) == scores.pairs
    assert "(multi_frame.png)" in (below / "multi_frame.md").read_text()
    assert (below / "multi_frame.png").read_bytes().startswith(b"\x89PNG")
    first = stamps(below / "scores")
    shutil.rmtree(below / "unet-individual-rmse-vertical")
    assert run("multi_frame/vertical", "--only-missing") == 0  # made elsewhere by the same recipe
    assert stamps(below / "scores") == first and len(trainer.trained) == 1


RULES = Rules("depth", "mm", "object", "standard")
IDENTITY = {"recipe_digest": 64 * "b", "weights_sha256": 64 * "a"}


def test_files_of_scores_are_read_strictly(opened, tmp_path):
    def zeros(frame):
        return np.zeros(frame.shape, np.float32)

    recipe, samples = load_recipe("loss/rmse"), opened.samples(SPLIT)
    scores = score_frames(
        opened, zeros, [0, 3], RULES, samples, **IDENTITY | {"recipe_digest": recipe.digest}
    )
    path = tmp_path / "all.json"
    write_json(scores.model_dump(mode="json"), path)
    assert (
        read_scores(path) == scores == scores_that_hold(path, opened.fingerprint, recipe, 64 * "a")
    )
    assert scores_that_hold(path, opened.fingerprint, recipe, 64 * "b") is None
    assert scores_that_hold(path, opened.fingerprint, load_recipe("loss/l1")) is None
    assert scores.errors["background_mae_mm"] == 0 and scores.errors["object_mae_mm"] > 1500
    path.write_text(path.read_text().replace('"pairs"', '"pear"'))
    with pytest.raises(SubmissionError, match="pear"):
        read_scores(path)
    assert scores_that_hold(path, opened.fingerprint, recipe) is None
    with pytest.raises(PredictionError, match=r"frame 0.*not finite"):
        score_frames(opened, lambda f: zeros(f) + np.nan, [0], RULES, samples, **IDENTITY)


def test_histograms_are_numpys():
    errors = [2.0, 2.1, 30.0, 31.0, 999.0, None]
    counts = histogram(errors)
    assert counts == np.histogram(errors[:-1], BINS_MM)[0].tolist() and sum(counts) == 5
    assert histogram([0.0, 5000.0, None]) == [1, *[0] * 38, 1]
    assert histogram([]) == [0] * 40


def test_scores_of_one_frame_are_the_evaluators(opened, tmp_path):
    rng = np.random.default_rng(0)
    noise = {
        sample: rng.uniform(0.0, 1.0, opened.size).astype(np.float32)
        for sample in opened.samples(SPLIT)
    }
    waiting = iter(noise.values())
    folder = tmp_path / "predictions"
    folder.mkdir()
    write_description(folder, units="normalised", uses_ground_truth_range=True)
    for sample, values in noise.items():
        np.save(folder / f"{sample}.npy", values)
    result = evaluate(folder, opened, mode="paper")
    rules = Rules("depth", "normalised", "object", "paper")
    scores = score_frames(opened, lambda frame: next(waiting), [0], rules, list(noise), **IDENTITY)
    assert len(scores.errors) == 7
    for key, value in scores.errors.items():
        assert value == pytest.approx(getattr(result.metrics, key), rel=1e-12)


def test_every_object_is_left_out_once(run, trainer, tmp_path, opened):
    owners = {sample: sample.rpartition("_")[0] for sample in opened.samples("all")}
    parts = [depth_training.fold_samples(opened, (part, 3)) for part in range(3)]
    for splits in parts:
        assert sorted(sample for samples in splits.values() for sample in samples) == sorted(owners)
        of_split = [{owners[sample] for sample in samples} for samples in splits.values()]
        assert sum(map(len, of_split)) == len(set(owners.values())) and all(of_split)
    assert sorted(sample for splits in parts for sample in splits["test"]) == sorted(owners)
    assert run("loss/hybrid_l1_0.7", "--folds", "3") == 0
    names = [f"unet-individual-hybrid_l1_0.7-fold_{part}_of_3" for part in range(3)]
    assert trainer.trained == names
    below = tmp_path / "runs" / "small"
    scores = [read_scores(below / "scores" / f"small-{name}.json") for name in names]
    for splits, found in zip(parts, scores, strict=True):
        assert set(found.per_object) == {owners[sample] for sample in splits["test"]}
    assert not list((below / "rows").glob("*.json"))
    text = (below / "folds.md").read_text()
    mae = np.average(
        [found.errors["object_mae_mm"] for found in scores],
        weights=[found.pairs for found in scores],
    )
    line = next(line for line in text.splitlines() if "hybrid L1" in line)
    assert f"| {mae:.2f} / " in line and "| 14.54 / 17.88 |" in line
    assert "best constant in the given range (trivial)" in text
    assert "| oracle range |" in line
    # A table that the paper does not have.
    assert run("further/plain", "--folds", "3") == 0
    assert re.search(r"^\| further/plain.*\| metric \|", (below / "folds.md").read_text(), re.M)
    assert read_json(below / names[1] / "recipe.json")["recipe"]["fold"] == [1, 3]


def test_the_best_constant_is_best(opened):
    samples = opened.samples("train")
    best = best_range_share(opened, samples)

    def mae_mm(share):
        answer = np.full(opened.size, share, np.float32)
        rules = Rules("depth", "normalised", "valid", "paper")
        return score_frames(opened, lambda frame: answer, [0], rules, samples, **IDENTITY).errors[
            "object_mae_mm"
        ]

    assert 0 < best < 1 and mae_mm(best) < min(mae_mm(best - 0.02), mae_mm(best + 0.02))


def test_time_left_of_a_plan(tmp_path):
    recipes = [load_recipe(name) for name in ("loss/l1", "loss/rmse", "architecture/resunet")]
    folders = [tmp_path / str(number) for number in range(3)]
    assert plan_state(recipes, folders) == (0, 0.0)
    folders[0].mkdir()
    (folders[0] / "log.jsonl").write_text(3 * '{"seconds": 2.0}\n')
    epochs = recipes[0].epochs
    assert plan_state(recipes, folders) == (3, 2.0 * (3 * epochs - 3))
    folders[2].mkdir()
    (folders[2] / "log.jsonl").write_text('{"seconds": 5.0}\n')
    assert plan_state(recipes, folders) == (4, 2.0 * (2 * epochs - 3) + 5.0 * (epochs - 1))
    (folders[2] / "done.json").write_text("{}")  # a plateau ended it sooner
    assert plan_state(recipes, folders) == (3 + epochs, 2.0 * (2 * epochs - 3))


def test_list_and_help_do_not_train(trainer, tmp_path, monkeypatch):
    monkeypatch.setattr("fpp_ml_bench.cli.train.SHIPPED_ROWS", tmp_path / "none")
    listed = printed(fpp_bench, "reproduce", "--list")
    assert "34 trainings fill 30 rows; the rows of 0 trainings come with the package" in listed
    assert "Those of the other 34 are not measured yet: a training takes" in listed
    for words, problem in (
        ([], "expected a table"),
        (["nonsense"], "expected a table"),
        (["loss/l2"], "no row 'l2'"),
        (["loss/"], "no row ''"),
        ([TABLE, "--minutes", "nan"], "expected minutes above 0"),
    ):
        assert problem in refusal(fpp_bench, "reproduce", *words)
    assert trainer.trained == []


def test_rows_of_another_dataset_are_not_overwritten(run, tmp_path, tiny, capsys, trainer):
    assert run(TABLE) == 0
    rows = tmp_path / "runs" / "small" / "rows"
    path = rows / f"{NAMES[0]}.json"
    content = read_json(path)
    others = dict.fromkeys(content["dataset"]["content"], 32 * "b")
    content["dataset"]["content"] = others
    path.write_text(json.dumps(content))
    assert run(TABLE) == 2
    assert "is a row on other data (no named benchmark" in capsys.readouterr().err
    assert read_json(path)["dataset"]["content"] == others
