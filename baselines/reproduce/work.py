"""Regenerating the paper's tables: train, predict, time, score, write rows and a Markdown table; skip what is done.

No training is ever deleted: a finished training is used, a stopped one continued, one of another recipe refused.
"""

import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from textwrap import shorten
from time import perf_counter
from types import ModuleType
from typing import Any

import torch

from fpp_ml_bench.baselines.method import Setting
from fpp_ml_bench.baselines.networks.base import torch_threads
from fpp_ml_bench.baselines.networks.model import Model, load
from fpp_ml_bench.baselines.networks.network_method import NetworkMethod
from fpp_ml_bench.baselines.networks.range_heads import save_with_heads
from fpp_ml_bench.baselines.reproduce import plan, scoring
from fpp_ml_bench.baselines.reproduce.plan import Folders, Job, Report, variants
from fpp_ml_bench.baselines.training.depth_training import DONE, SCORING, WEIGHTS, TrainingRun, train
from fpp_ml_bench.baselines.training.engine import RECIPE
from fpp_ml_bench.baselines.training.recipe import Recipe
from fpp_ml_bench.errors import PredictionError, TrainingError, WeightsError
from fpp_ml_bench.evaluation.result.file import write_json
from fpp_ml_bench.files import exclusive, read_json, write_atomically
from fpp_ml_bench.loaders.storage.store import DatasetFolder

PAPER_PRESET = "paper"
REASON_LENGTH = 400


@dataclass(frozen=True)
class ReproduceSettings:
    """Settings of a run. ``leaderboard`` (`fpp_ml_bench.leaderboard.reproduced`) keeps the rows; ``minutes`` limits the
    whole run; ``command`` continues it; ``anyway`` trains the paper's preset without a GPU; ``only_missing`` keeps rows
    that are up to date; ``report`` takes a line of progress; ``row``: the only row of the table to make, "" for all."""

    tables: Sequence[str]
    folders: Folders
    command: str
    leaderboard: ModuleType
    data: Path | None = None
    only_missing: bool = False
    minutes: float | None = None
    anyway: bool = False
    report: Report = print
    row: str = ""

    def wants(self, job: Job) -> bool:
        """Whether a job is to be done."""
        return not self.row or f"{self.tables[0]}/{self.row}" in job.rows


@dataclass
class Outcome:
    """``stopped``: the recipe at which the minutes ran out, None when all was done; ``failed``: recipe name to why."""

    opened: DatasetFolder
    jobs: list[Job]
    tables: list[Path] = field(default_factory=list)
    stopped: str | None = None
    failed: dict[str, str] = field(default_factory=dict)


def reproduce(settings: ReproduceSettings) -> Outcome:
    """Do what the tables lack, and write them. After an interruption the same call continues.

    A training that diverges, or whose predictions can't be scored, does not keep the others from running
    (`Outcome.failed`). Raises TrainingError for a training folder of another recipe, or the paper's preset without a
    GPU; DatasetError for a dataset of another size or fingerprint; BuildError when another process works in the same
    folder; and what predicting and scoring raise."""
    folders = settings.folders
    jobs = plan.planned(settings.tables, folders.preset)
    wanted = [job for job in jobs if settings.wants(job)]
    check_run_folders(wanted, folders)
    check_machine(wanted, folders, settings.anyway, settings.command)
    with exclusive(folders.runs / "lock", folders.runs, "reproducing into this folder"):
        opened = plan.open_dataset(settings.data, jobs, folders, settings.report)
        outcome = Outcome(opened, jobs)
        try:
            _work(settings, outcome)
        finally:
            for table in settings.tables:
                outcome.tables.append(settings.leaderboard.write_table(table, settings, outcome))
    return outcome


def _work(settings: ReproduceSettings, outcome: Outcome) -> None:
    """Every job in turn, until the minutes run out."""
    folders = settings.folders
    jobs = [job for job in outcome.jobs if settings.wants(job)]
    started = perf_counter()
    for number, job in enumerate(jobs, 1):
        name, out = job.recipe.name, folders.training(job.recipe)
        minutes_left = None if settings.minutes is None else settings.minutes - (perf_counter() - started) / 60
        if minutes_left is not None and minutes_left <= 0:
            outcome.stopped = name
            return
        settings.report(f"[{number}/{len(jobs)}] {name} ({', '.join(job.rows)})")
        try:
            run = train(job.recipe, outcome.opened.path, out, minutes=minutes_left)
            if not run.finished:
                outcome.stopped = name
                return
            _score(job, run, settings, outcome.opened)
        except (TrainingError, PredictionError, WeightsError) as error:
            # The other trainings, which take hours, may still succeed.
            outcome.failed[name] = shorten(" ".join(str(error).split()), REASON_LENGTH, placeholder=" ...")
            settings.report(f"  failed, its rows stay as they are: {error}")


def _score(job: Job, run: TrainingRun, settings: ReproduceSettings, opened: DatasetFolder) -> None:
    """Weights with range heads, rows, and scores on all frames of a training; up-to-date rows are kept with
    ``only_missing``."""
    folders, recipe = settings.folders, job.recipe
    model = load(finished_weights(recipe, run, opened, folders, settings.only_missing))
    if job.all_frames:
        _score_all_frames(recipe, model, settings, opened)
    about: dict[str, Setting] = {"recipe_digest": recipe.digest, "epochs_trained": run.epochs}
    about["training_seconds"] = round(run.seconds, 1)
    for depth_range in variants(recipe):
        path = folders.row(recipe, depth_range)
        if settings.only_missing and settings.leaderboard.row_that_holds(path, opened, model.sha256) is not None:
            settings.report(f"  {path.stem}: holds, kept")
            continue
        # A network's method sets torch's threads for the whole process; the next training needs its own.
        with torch_threads(torch.get_num_threads()):
            method = NetworkMethod(model, depth_range, remark=f"{recipe.preset} preset", about=about)
            settings.leaderboard.check_row_is_of(path, opened)
            result = scoring.score_method(opened, method, path, folders)
        settings.leaderboard.write_measured(result, path)
        settings.report(f"  {path.stem}: object MAE {_mm(result.metrics.object_mae_mm)}, {result.track} track")


def _score_all_frames(recipe: Recipe, model: Model, settings: ReproduceSettings, opened: DatasetFolder) -> None:
    """All frames of the training's configuration, by the rule of the oracle range, as in the paper."""
    path = settings.folders.all_frames(recipe)
    if settings.only_missing and scoring.all_frames_that_hold(path, opened.fingerprint, model.sha256) is not None:
        return
    frames, about = opened.sequence.config(recipe.frames), {"recipe": recipe.name, "weights_sha256": model.sha256}
    scores = scoring.score_all_frames(
        opened,
        lambda frame: model.predict_representation([frame])[0],
        frames,
        SCORING[recipe.normalisation],
        about,
        model.config.range_rule,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(scores.model_dump(mode="json"), path)
    settings.report(f"  {path.stem}: object MAE {_mm(scores.metrics.object_mae_mm)} on {scores.pairs} pairs")


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} mm"


def is_trained(out: Path) -> bool:
    """Whether a training folder holds a finished training."""
    return (out / DONE).is_file()


def state_of(out: Path) -> str:
    """``trained``, ``begun`` or ``missing``."""
    return "trained" if is_trained(out) else "begun" if out.is_dir() and any(out.iterdir()) else "missing"


def check_run_folders(jobs: Sequence[Job], folders: Folders) -> None:
    """Refuse, before hours of work, a training folder of another recipe: TrainingError names the folder, the settings
    that differ and the cure."""
    for job in jobs:
        path = folders.training(job.recipe) / RECIPE
        if not path.is_file():
            continue
        try:
            differs = plan.differing(job.recipe.to_dict(), _stored(path)["recipe"], "{1} there, {0} in the recipe")
        except (KeyError, TypeError, AttributeError) as error:
            raise TrainingError(f"{path}: expected the recipe of a training, it can't be read ({error})") from None
        if differs:
            out = shlex.quote(str(path.parent))
            raise TrainingError(
                f"{path.parent}: holds a training of another recipe, {job.rows[0]} differs in {differs}; to keep both, "
                f"mv {out} {out}-before, or give another --out"
            )


def check_machine(jobs: Sequence[Job], folders: Folders, anyway: bool, command: str) -> None:
    """Refuse the paper's preset without a GPU where something is left to train. TrainingError with the command."""
    untrained = [job for job in jobs if not is_trained(folders.training(job.recipe))]
    if folders.preset != PAPER_PRESET or anyway or not untrained or torch.cuda.is_available():
        return
    size = untrained[0].recipe.size
    raise TrainingError(
        f"preset {PAPER_PRESET} trains networks of full width on {size} x {size} px until the rate has reached its "
        f"minimum, and PyTorch sees no CUDA GPU here, where that would take weeks; nothing was started, and no row "
        f"will be estimated. On a machine with a GPU run, as often as its time allows:\n  {command}\n"
        "or add --anyway to train on this processor all the same"
    )


def finished_weights(recipe: Recipe, run: TrainingRun, opened: DatasetFolder, folders: Folders, keep: bool) -> Path:
    """The weights file to score and to ship: the best epoch's, with range heads where a row needs them. ``keep``: one
    that was made from the same weights is used as it is."""
    target, source = folders.weights(recipe), file_sha256(run.weights)
    if keep and _made_from(target, source):
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    if "predicted" in variants(recipe):
        save_with_heads(run.weights, opened.path, target)
    else:
        write_atomically(target, run.weights.read_bytes())
    content = json.dumps({"made_from_sha256": source, "sha256": file_sha256(target)})
    write_atomically(target.with_suffix(".json"), f"{content}\n".encode())
    return target


def current_weights(recipe: Recipe, folders: Folders) -> Path | None:
    """The file that `finished_weights` made from the finished training; None while there is none."""
    out, target = folders.training(recipe), folders.weights(recipe)
    if not is_trained(out) or not (out / WEIGHTS).is_file():
        return None
    try:
        of_recipe = _stored(out / RECIPE)["recipe"] == recipe.to_dict()
    except (TrainingError, KeyError, TypeError):
        return None
    return target if of_recipe and _made_from(target, file_sha256(out / WEIGHTS)) else None


def _made_from(target: Path, source: str) -> bool:
    """Whether ``target`` is what its record says was made from weights of this hash."""
    try:
        return bool(_stored(target.with_suffix(".json")) == {"made_from_sha256": source, "sha256": file_sha256(target)})
    except (OSError, TrainingError):
        return False


def _stored(path: Path) -> Any:
    return read_json(path, TrainingError, "give another --out, or remove it")


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, 64 hex digits."""
    return sha256(path.read_bytes()).hexdigest()
