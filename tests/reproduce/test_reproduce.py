"""`fpp-bench reproduce` from trainings to tables, with trainings that take no time: what is made, kept and refused."""

import json
import re
import shutil
from functools import cache

import numpy as np
import pytest
import torch

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.networks.model import build
from fpp_ml_bench.baselines.reproduce import plan, work
from fpp_ml_bench.baselines.reproduce.work import (
    SPLIT,
    all_frames_that_hold,
    read_all_frames,
    score_all_frames,
)
from fpp_ml_bench.baselines.timing import time_method
from fpp_ml_bench.baselines.training import depth_training
from fpp_ml_bench.baselines.training.depth_training import model_config
from fpp_ml_bench.baselines.training.engine import claim_folder
from fpp_ml_bench.baselines.training.recipe import load_recipe
from fpp_ml_bench.baselines.training.weights import save_weights
from fpp_ml_bench.cli import main
from fpp_ml_bench.cli import main_eval as fpp_eval
from fpp_ml_bench.errors import PredictionError, SubmissionError, TrainingError
from fpp_ml_bench.evaluation.result.file import read_result, write_json
from fpp_ml_bench.evaluation.score.check import Rules
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.leaderboard.ranking import rank, read_entries
from fpp_ml_bench.leaderboard.rows import read_entry
from fpp_ml_bench.loaders.storage.store import DatasetFolder

TABLE = "normalization"
NAMES = ("cpu-unet-raw-rmse", "cpu-unet-global-rmse", "cpu-unet-individual-rmse")
TWINS = tuple(f"cpu-unet-individual-rmse-range-{source}" for source in ("predicted", "mean"))


@cache
def _timing(folder):
    opened = DatasetFolder(folder)
    return time_method(opened, ClassicalMethod(opened.rig, steps=3), repeats=1)


def reused_timing(opened, method, split, repeats):
    """A timing of something else, for tests that are not about time."""
    return _timing(opened.path).model_copy(update={"frames": len(method.frames_used)})


@pytest.fixture(autouse=True)
def small(monkeypatch, opened, request):
    """Recipes at the tiny dataset's size, networks of width 1, 2 timed runs a method, heads of few pairs."""

    def tiny_recipe(name, preset="cpu"):
        recipe = load_recipe(name, preset)
        return recipe.model_copy(update={"size": opened.size[0], "width": 1})

    monkeypatch.setattr(plan, "load_recipe", tiny_recipe)
    monkeypatch.setattr(work, "REPEATS", 2)
    for constant in ("TRAIN_PAIRS", "VALIDATION_PAIRS", "PIXELS"):
        monkeypatch.setattr(f"fpp_ml_bench.baselines.networks.range_heads.{constant}", 4)
    if "from_trainings" not in request.node.name:  # there the time is really measured
        monkeypatch.setattr(work, "time_method", reused_timing)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    assert torch.get_num_threads() == 2
    torch.set_num_threads(threads)


class Trainer:
    """Stands in for the engine: weights drawn from a seed, in the engine's own files. ``says`` maps a recipe's name to
    what happens instead of finishing."""

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
        torch.manual_seed(self.seed)
        network = build(recipe.network, width=recipe.width)
        # Untrained, its output would be refused for its unit: a little around a depth that can be.
        with torch.no_grad():
            network.head.weight.mul_(0.01)
            network.head.bias.fill_({"raw": 1500.0, "global": 1.5, "individual": 0.4}[recipe.normalisation])
        save_weights(out / depth_training.WEIGHTS, network, model_config(recipe, network, opened, 3, {}))
        (out / depth_training.DONE).write_text(json.dumps({"epochs": 5, "best_epoch": 3, "seconds": 61.4}))
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
    return lambda *words: main(
        ["reproduce", words[0], str(tiny), *map(str, words[1:]), "--out", str(tmp_path / "runs")]
    )


def test_from_trainings_to_a_table(run, trainer, tmp_path, tiny, capsys):
    assert run(TABLE) == 0
    below = tmp_path / "runs" / "cpu"
    assert trainer.trained == [name.removeprefix("cpu-") for name in NAMES]
    assert sorted(path.stem for path in (below / "rows").glob("*.json")) == sorted((*NAMES, *TWINS))
    entries = {path.stem: read_entry(path) for path in (below / "rows").glob("*.json")}
    assert all(entry.is_row_file for entry in entries.values())
    tracks = {name: (entry.row.track, entry.row.mode, entry.row.target) for name, entry in entries.items()}
    assert tracks[NAMES[2]] == ("oracle range", "paper", "depth")
    assert {tracks[name] for name in (*NAMES[:2], *TWINS)} == {("metric", "standard", "depth")}
    assert all(entry.name.endswith("(cpu preset)") for entry in entries.values())
    assert [len(group.rows) for group in rank(entries.values())] == [4, 1]
    for name, entry in entries.items():
        assert entry.row.timing.parameters == sum(p.numel() for p in build("unet", width=1).parameters())
        for folder in ("results", "rows"):
            files = str(below / folder / f"{name}.json"), str(below / "predictions" / name)
            assert fpp_eval(["verify", *files, str(tiny)]) == 0
    text = (below / f"{TABLE}.md").read_text()
    lines = {
        line.split(" | ")[0].strip("| "): line for line in text.split("## ")[0].splitlines() if line.startswith("| ")
    }
    mae = entries[NAMES[2]].row.metrics.object_mae_mm
    assert f"| oracle range | {mae:.2f} / " in lines["individual"] and "| 16.20 / 21.19 |" in lines["individual"]
    assert f" {entries[TWINS[0]].row.metrics.object_mae_mm:.2f} / " in lines["individual"]
    assert "| 5 | 61 |" in lines["raw (mm)"]
    assert "3 among the rows measured here" in text and "of different tracks" in text
    assert "reported by the paper" in capsys.readouterr().out


def stamps(folder):
    return {path.name: path.stat().st_mtime_ns for path in folder.glob("*.json")}


def test_only_missing_keeps_what_holds(run, trainer, tmp_path, capsys):
    assert run(TABLE) == 0
    rows = tmp_path / "runs" / "cpu" / "rows"
    first = stamps(rows)
    assert run(TABLE, "--only-missing") == 0 and stamps(rows) == first
    assert len(trainer.trained) == 3
    (rows / f"{NAMES[1]}.json").unlink()
    (rows / f"{TWINS[0]}.json").write_text("{")
    assert run(TABLE, "--only-missing") == 0
    changed = {name.removesuffix(".json") for name, stamp in stamps(rows).items() if first[name] != stamp}
    assert changed == {NAMES[1], TWINS[0]}
    assert run(TABLE) == 0 and len(trainer.trained) == 3
    assert not set(stamps(rows).items()) & set(first.items())


def test_rows_of_other_weights_are_made_again_and_not_shown(run, trainer, tmp_path):
    assert run(TABLE) == 0
    below = tmp_path / "runs" / "cpu"
    weights_before = read_entry(below / "rows" / f"{TWINS[0]}.json").row.submission.settings["weights_sha256"]
    training = below / "unet-individual-rmse"
    for path in training.iterdir():
        path.unlink()
    trainer.says["unet-individual-rmse"] = "out of time"
    trainer.seed = 1
    assert run(TABLE, "--only-missing", "--minutes", "5") == 1
    assert "Not measured here: individual. To fill" in (below / f"{TABLE}.md").read_text()
    trainer.says.clear()
    assert run(TABLE, "--only-missing") == 0
    weights_after = read_entry(below / "rows" / f"{TWINS[0]}.json").row.submission.settings["weights_sha256"]
    assert weights_before != weights_after and len(trainer.trained) == 4


def test_rows_of_another_machine_are_shown_if_of_the_same_recipe(run, trainer, tmp_path):
    def lines():
        return [line for line in (below / f"{TABLE}.md").read_text().splitlines() if line.startswith("| individual |")]

    below = tmp_path / "runs" / "cpu"
    assert run(TABLE) == 0
    made_here = lines()
    shutil.rmtree(below / "unet-individual-rmse")
    assert run(f"{TABLE}/raw") == 0 and len(trainer.trained) == 3
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
    assert "Stopped at unet-global-rmse after 5 minutes. Continue with: fpp-bench reproduce normalization" in out
    assert "--only-missing --minutes 5" in out
    text = (tmp_path / "runs" / "cpu" / f"{TABLE}.md").read_text()
    assert "Not measured here: raw, global, individual. To fill: `fpp-bench reproduce normalization" in text
    trainer.says.clear()
    assert run(TABLE, "--only-missing", "--minutes", "5") == 0


def test_a_training_that_fails_does_not_stop_the_others(run, trainer, unscored, tmp_path, capsys):
    trainer.says["unet-global-rmse"] = TrainingError("training diverged: loss is not finite in batch 3")
    assert run(TABLE) == 2
    assert "1 of 3 rows could not be made:\n  unet-global-rmse: training diverged" in capsys.readouterr().err
    text = (tmp_path / "runs" / "cpu" / f"{TABLE}.md").read_text()
    assert "- global: training diverged" in text
    assert len(trainer.trained) == 2


def test_ctrl_c_leaves_what_is_done_and_a_table(run, trainer, unscored, tmp_path):
    trainer.says["unet-global-rmse"] = KeyboardInterrupt()
    assert run(TABLE) == 130
    assert (tmp_path / "runs" / "cpu" / f"{TABLE}.md").is_file()
    trainer.says.clear()
    assert run(TABLE, "--only-missing") == 0
    assert trainer.trained.count("unet-raw-rmse") == 1


def test_a_training_of_another_recipe_is_refused_before_any_work(run, trainer, tmp_path, capsys):
    out = tmp_path / "runs" / "cpu" / "unet-individual-rmse"
    out.mkdir(parents=True)
    recipe = plan.load_recipe("normalization/individual", "cpu")
    other = {**recipe.to_dict(), "batch": 8, "seed": 1}
    (out / "recipe.json").write_text(json.dumps({"recipe": other, "fingerprint": 64 * "0"}))
    assert run(TABLE) == 2
    error = capsys.readouterr().err
    assert "batch (8 there, 4 in the recipe), seed (1 there, 42 in the recipe)" in error and f"mv {out}" in error
    assert trainer.trained == []
    (out / "recipe.json").write_text("[]")
    assert run(TABLE) == 2 and "can't be read" in capsys.readouterr().err


def test_a_training_on_another_dataset_is_refused(run, trainer, unscored, tmp_path, capsys):
    assert run(TABLE) == 0 and run(TABLE) == 0
    path = tmp_path / "runs" / "cpu" / "unet-individual-rmse" / "recipe.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"fingerprint": 64 * "a"}))
    assert run(TABLE) == 2
    assert "is of aaaaaaaa; give that dataset as DATASET, or another --out" in capsys.readouterr().err


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
    below = tmp_path / "runs" / "cpu"
    scores = read_all_frames(below / "all-frames" / "cpu-unet-individual-rmse-vertical-all-frames.json")
    assert scores.frames == list(range(18, 36)) and scores.pairs == 18 * len(opened.samples("test"))
    result = read_result(below / "results" / "cpu-unet-individual-rmse-vertical.json")
    row = read_entry(below / "rows" / "cpu-unet-individual-rmse-vertical.json").row
    assert result.submission.frames_used == row.submission.frames_used == [18]
    for key in ("object_mae_mm", "overall_rmse_mm", "background_mae_mm"):
        per_sample = [getattr(part.metrics, key) for part in scores.per_sample]
        assert getattr(scores.metrics, key) == pytest.approx(np.mean(per_sample), rel=1e-9)
    table = (below / "multi_frame.md").read_text().split("## ")[0]
    lines = [line for line in table.splitlines() if line.startswith("| 18 vertical")]
    assert len(lines) == 2 and "its first frame only" in lines[1]
    assert f"| {scores.metrics.object_mae_mm:.2f} / " in lines[0] and "| 12.36 / 16.94 |" in lines[0]
    assert f"| {row.metrics.object_mae_mm:.2f} / " in lines[1] and "12.36" not in lines[1]


def test_all_frames_files_are_read_strictly(opened, tmp_path):
    def zeros(frame):
        return np.zeros(frame.shape, np.float32)

    scores = score_all_frames(opened, zeros, [0, 3], Rules("depth", "mm", "object", "standard"), 64 * "a")
    path = tmp_path / "all.json"
    write_json(scores.model_dump(mode="json"), path)
    assert read_all_frames(path) == scores == all_frames_that_hold(path, opened.fingerprint, 64 * "a")
    assert all_frames_that_hold(path, opened.fingerprint, 64 * "b") is None
    assert scores.metrics.background_mae_mm == 0 and scores.metrics.object_mae_mm > 1500
    path.write_text(path.read_text().replace('"pairs"', '"pear"'))
    with pytest.raises(SubmissionError, match="pear"):
        read_all_frames(path)
    assert all_frames_that_hold(path, opened.fingerprint, 64 * "a") is None
    with pytest.raises(PredictionError, match=r"frame 0.*not finite"):
        score_all_frames(opened, lambda f: zeros(f) + np.nan, [0], Rules("depth", "mm", "object", "standard"), 64 * "a")


def test_all_frames_of_one_frame_is_the_evaluators_score(opened, tmp_path):
    rng = np.random.default_rng(0)
    noise = {sample: rng.uniform(0.0, 1.0, opened.size).astype(np.float32) for sample in opened.samples(SPLIT)}
    waiting = iter(noise.values())
    folder = tmp_path / "predictions"
    folder.mkdir()
    from scored_dataset import write_description

    write_description(folder, units="normalised", uses_ground_truth_range=True)
    for sample, values in noise.items():
        np.save(folder / f"{sample}.npy", values)
    result = evaluate(folder, opened, mode="paper")
    scores = score_all_frames(
        opened, lambda frame: next(waiting), [0], Rules("depth", "normalised", "object", "paper"), 64 * "a"
    )
    for key, value in scores.metrics:
        assert value == pytest.approx(getattr(result.metrics, key), rel=1e-12)


def test_list_and_help_do_not_train(run, trainer, capsys, tmp_path, monkeypatch):
    assert main(["reproduce", "normalization", "--preset", "cpu-long", "--list"]) == 0
    listed = capsys.readouterr().out
    assert "3 trainings fill 3 rows; 3 of them come with the package" in listed and "42.2 mm, version 2" in listed
    monkeypatch.setattr("fpp_ml_bench.leaderboard.rows.SHIPPED_ROWS", tmp_path / "none")
    assert main(["reproduce", "--list"]) == 0
    listed = capsys.readouterr().out
    assert "26 trainings fill 30 rows; 0 of them come with the package" in listed
    assert "The other 30 are not measured yet: a training takes" in listed
    assert main(["reproduce"]) == 2
    assert "expected a table" in capsys.readouterr().err
    for table, problem in (("nonsense", "expected a table"), ("loss/l2", "no row 'l2'"), ("loss/", "no row ''")):
        assert main(["reproduce", table]) == 2
        assert problem in capsys.readouterr().err
    for words in ([TABLE, "--minutes", "0"], [TABLE, "--minutes", "nan"]):
        assert main(["reproduce", *words]) == 2
        assert "expected minutes above 0" in capsys.readouterr().err
    assert trainer.trained == []


def test_one_row_of_a_table(run, trainer, unscored, tmp_path):
    assert run(f"{TABLE}/global") == 0
    assert trainer.trained == ["unet-global-rmse"]
    text = (tmp_path / "runs" / "cpu" / f"{TABLE}.md").read_text()
    assert re.search(rf"raw, global, individual\. To fill: `fpp-bench reproduce {TABLE} \S+ --preset cpu", text)


def test_rows_of_another_dataset_are_not_overwritten(run, tmp_path, tiny, capsys, trainer):
    assert run(TABLE) == 0
    rows = tmp_path / "runs" / "cpu" / "rows"
    path = rows / f"{NAMES[0]}.json"
    content = json.loads(path.read_text())
    others = dict.fromkeys(content["dataset"]["content"], 32 * "b")
    content["dataset"]["content"] = others
    path.write_text(json.dumps(content))
    assert run(TABLE) == 2
    assert "is a row on other data (no named benchmark" in capsys.readouterr().err
    assert json.loads(path.read_text())["dataset"]["content"] == others


def test_names_are_unique_in_every_group(run, trainer, tmp_path):
    assert run("background_removed") == 0
    paths = sorted((tmp_path / "runs" / "cpu" / "rows").glob("*.json"))
    assert [path.stem for path in paths] == [
        f"cpu-unet-{kind}-rmse-bgremoved" for kind in ("global", "individual", "raw")
    ]
    tracks = {entry.row.track for entry in read_entries(paths)}
    assert tracks == {"oracle mask", "oracle range + mask"}
    assert "no twins there" in (tmp_path / "runs" / "cpu" / "background_removed.md").read_text()
