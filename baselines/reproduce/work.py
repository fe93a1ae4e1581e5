"""Regenerating the paper's tables: train, predict, time, score, write rows and a Markdown table;
skip what is done.

Trainings run beside each other, one on each core. Then all is scored, one after the other: a time
that is taken beside a training is wrong. No training is ever deleted: a finished training is used,
a stopped one continued, one of another recipe refused. Weights that come with the package stand for
the training of their recipe.
"""

import json
import shlex
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from statistics import fmean
from textwrap import shorten
from threading import Event, Thread
from time import time
from typing import Any, Protocol

import torch

from fpp_ml_bench.baselines.method import Setting
from fpp_ml_bench.baselines.networks.base import torch_threads
from fpp_ml_bench.baselines.networks.model import load
from fpp_ml_bench.baselines.networks.network_method import NetworkMethod
from fpp_ml_bench.baselines.reproduce import plan
from fpp_ml_bench.baselines.reproduce.plan import Folders, Job, Report
from fpp_ml_bench.baselines.reproduce.scores import (
    MAIN_KEY,
    SPLIT,
    TARGET,
    score_frames,
    scores_that_hold,
)
from fpp_ml_bench.baselines.run import predict_split
from fpp_ml_bench.baselines.timing import time_method, write_timing
from fpp_ml_bench.baselines.training.depth_training import (
    DONE,
    SCORING,
    WEIGHTS,
    TrainingRun,
    fold_samples,
    train,
)
from fpp_ml_bench.baselines.training.engine import LOG_FILE, RECIPE, Display
from fpp_ml_bench.baselines.training.recipe import Recipe, table_rows
from fpp_ml_bench.baselines.training.weights import SHIPPED, SUFFIX, open_weights
from fpp_ml_bench.errors import DatasetError, PredictionError, TrainingError, WeightsError
from fpp_ml_bench.evaluation.result.file import write_json, write_result
from fpp_ml_bench.evaluation.result.model import Result
from fpp_ml_bench.evaluation.score.check import Rules
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.submission.prediction_files import SUBMISSION_FILE
from fpp_ml_bench.files import exclusive, read_json
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.pool import mapping
from fpp_ml_bench.style import millimetres

PAPER_PRESET = "paper"
REASON_LENGTH = 400
REPEATS = 20
LOOK_EVERY_S = 2.0
"""How often the bar of several trainings reads their logs."""


class Keeper(Protocol):
    """What keeps the rows of a run, the module `fpp_ml_bench.leaderboard.reproduced`: this room may
    not import it."""

    def write_measured(self, result: Result, path: Path) -> None: ...
    def row_that_holds(
        self, path: Path, opened: DatasetFolder, value: str, setting: str = ...
    ) -> object | None: ...
    def check_row_is_of(self, path: Path, opened: DatasetFolder) -> None: ...
    def write_table(
        self, table: str, settings: "ReproduceSettings", outcome: "Outcome"
    ) -> Path: ...


@dataclass(frozen=True)
class ReproduceSettings:
    """Settings of a run. ``leaderboard`` keeps the rows; ``minutes`` limits the trainings;
    ``command`` continues it; ``anyway`` trains the paper's preset without a GPU; ``only_missing``
    keeps rows that are up to date; ``report`` takes a line of progress; ``row``: the only row of
    the table to make, "" for all; ``from_scratch``: train even where weights come with the package;
    ``workers``: trainings beside each other; ``folds``: cross-validate the rows of the tables, with
    so many parts."""

    tables: Sequence[str]
    folders: Folders
    command: str
    leaderboard: Keeper
    data: Path | None = None
    only_missing: bool = False
    minutes: float | None = None
    anyway: bool = False
    report: Report = print
    row: str = ""
    from_scratch: bool = False
    workers: int = 1
    folds: int | None = None


@dataclass
class Outcome:
    """``stopped``: the first recipe whose training is not at its end, None when all was done;
    ``failed``: recipe name to why."""

    opened: DatasetFolder
    jobs: list[Job]
    tables: list[Path] = field(default_factory=list)
    stopped: str | None = None
    failed: dict[str, str] = field(default_factory=dict)


def reproduce(settings: ReproduceSettings) -> Outcome:
    """Do what the tables lack, and write them. After an interruption the same call continues.

    A training that diverges, or whose predictions can't be scored, does not keep the others from
    running (`Outcome.failed`). Raises TrainingError for a training folder of another recipe, or the
    paper's preset without a GPU; DatasetError for a dataset of another size or fingerprint;
    BuildError when another process works in the same folder; and what predicting and scoring
    raise."""
    folders, tables = settings.folders, list(settings.tables)
    names = [f"{table}/{row}" for table in tables for row in table_rows(table)]
    chosen = [f"{tables[0]}/{settings.row}"] if settings.row else names
    if settings.folds is not None:
        names = chosen = chosen if len(tables) == 1 else list(plan.FOLD_ROWS)
        tables = [plan.FOLDS]
    jobs = plan.planned(names, folders.preset, settings.folds)
    wanted = [job for job in jobs if not set(chosen).isdisjoint(job.rows)]
    check_run_folders(wanted, folders)
    check_machine(wanted, folders, settings.anyway, settings.command)
    with exclusive(folders.runs / "lock", folders.runs, "reproducing into this folder"):
        opened = plan.open_dataset(settings.data, jobs, folders, settings.report)
        check_run_folders(wanted, folders, opened)
        outcome = Outcome(opened, jobs)
        try:
            _work(settings, outcome, wanted)
        finally:
            for table in tables:
                outcome.tables.append(settings.leaderboard.write_table(table, settings, outcome))
    return outcome


def _work(settings: ReproduceSettings, outcome: Outcome, jobs: Sequence[Job]) -> None:
    """Train what has no weights, until the minutes run out; score what has."""
    opened, folders = outcome.opened, settings.folders
    untouched = (
        []
        if settings.from_scratch
        else [job for job in jobs if state_of(folders.training(job.recipe)) == MISSING]
    )
    done = [job for job in untouched if settings.only_missing and _rows_hold(job, settings, opened)]
    shipped = {
        job.recipe.name: path
        for job in untouched
        if (path := shipped_weights(job.recipe, opened)) is not None
    }
    left = [job for job in jobs if job not in done]
    to_train = [job for job in left if job.recipe.name not in shipped]
    runs = dict(
        zip(
            (job.recipe.name for job in to_train),
            _trained(to_train, settings, opened.path),
            strict=True,
        )
    )
    for number, job in enumerate(left, 1):
        name, run = job.recipe.name, runs.get(job.recipe.name)
        settings.report(f"[{number}/{len(left)}] {name} ({', '.join(job.rows)})")
        try:
            if isinstance(run, TrainingError):
                raise run
            if run is not None and run.finished:
                about: dict[str, Setting] = {
                    "epochs_trained": run.epochs,
                    "training_seconds": round(run.seconds, 1),
                }
                _score(job, run.weights, about, settings, opened)
            elif name in shipped:
                _score(job, shipped[name], {}, settings, opened)
            else:
                outcome.stopped = outcome.stopped or name
                settings.report("  not at its end yet")
        except (TrainingError, PredictionError, WeightsError) as error:
            # The other trainings, which take hours, may still succeed.
            outcome.failed[name] = shorten(
                " ".join(str(error).split()), REASON_LENGTH, placeholder=" ..."
            )
            settings.report(f"  failed, its rows stay as they are: {error}")


def _rows_hold(job: Job, settings: ReproduceSettings, opened: DatasetFolder) -> bool:
    """Whether all that the job gives is there already, made elsewhere by the same recipe on the
    same data."""
    recipe, folders = job.recipe, settings.folders
    if (
        job.has_scores
        and scores_that_hold(folders.scores(recipe), opened.fingerprint, recipe) is None
    ):
        return False
    row = folders.row(recipe)
    return (
        recipe.fold is not None
        or settings.leaderboard.row_that_holds(row, opened, recipe.digest, "recipe_digest")
        is not None
    )


def shipped_weights(recipe: Recipe, opened: DatasetFolder) -> Path | None:
    """The weights that come with the package and are of exactly this recipe and dataset; None
    without."""
    path = SHIPPED / f"{recipe.name}{SUFFIX}"
    if not path.is_file():
        return None
    config = open_weights(path).config
    same = (config.recipe, config.dataset_fingerprint) == (recipe.to_dict(), opened.fingerprint)
    return path if same else None


@dataclass(frozen=True)
class Trainings:
    """What a process that trains is given. ``deadline``: seconds since 1970 at which it stops;
    ``show``: progress."""

    dataset: Path
    deadline: float | None
    show: bool

    def train(self, recipe: Recipe, out: Path) -> TrainingRun | TrainingError | None:
        """Train; None where no time is left for it, an error where it fails."""
        minutes = None if self.deadline is None else (self.deadline - time()) / 60
        if minutes is not None and minutes <= 0 and not is_trained(out):
            return None
        try:
            return train(recipe, self.dataset, out, minutes=minutes, show=self.show)
        except (TrainingError, PredictionError, WeightsError) as error:
            return TrainingError(str(error))


def _trained(
    jobs: Sequence[Job], settings: ReproduceSettings, dataset: Path
) -> list[TrainingRun | TrainingError | None]:
    """The trainings of ``jobs``, one on each core, or one after the other in this process for one
    worker."""
    if not jobs:
        return []
    recipes, folders = (
        [job.recipe for job in jobs],
        [settings.folders.training(job.recipe) for job in jobs],
    )
    workers = min(settings.workers, len(jobs))
    deadline = None if settings.minutes is None else time() + 60 * settings.minutes
    with (
        mapping(Trainings(dataset, deadline, workers == 1), workers) as mapped,
        _progress(recipes, folders, workers),
    ):
        return list(mapped(Trainings.train, recipes, folders))


@contextmanager
def _progress(recipes: Sequence[Recipe], folders: Sequence[Path], workers: int) -> Iterator[None]:
    """A bar over the epochs of trainings in other processes, read from their logs, with the time
    that is left. With one worker each training shows its own."""
    if workers == 1:
        yield
        return
    ended = Event()
    with Display(
        f"{len(recipes)} trainings", sum(recipe.epochs for recipe in recipes), True
    ) as display:
        display.columns = display.columns[:-2]

        def follow() -> None:
            while not ended.wait(LOOK_EVERY_S):
                epochs, seconds = plan_state(recipes, folders)
                display.at(
                    epochs,
                    f"{sum(map(is_trained, folders))} finished, {seconds / workers / 3600:.1f} h "
                    f"left",
                )

        thread = Thread(target=follow, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()


def plan_state(recipes: Sequence[Recipe], folders: Sequence[Path]) -> tuple[int, float]:
    """Epochs done of all trainings, and the seconds on one core that the others take: as long as
    those of the same training, else of the same network, else of all so far; 0 before the first."""
    logs = [_epoch_seconds(folder) for folder in folders]
    done, left_s = 0, 0.0
    for recipe, folder, own in zip(recipes, folders, logs, strict=True):
        left = 0 if is_trained(folder) else max(recipe.epochs - len(own), 0)
        alike = [
            s
            for other, log in zip(recipes, logs, strict=True)
            if other.network == recipe.network
            for s in log
        ]
        known = own or alike or [s for log in logs for s in log]
        done, left_s = done + recipe.epochs - left, left_s + left * (fmean(known) if known else 0.0)
    return done, left_s


def _epoch_seconds(folder: Path) -> list[float]:
    log = folder / LOG_FILE
    return (
        [json.loads(line)["seconds"] for line in log.read_text().splitlines()]
        if log.is_file()
        else []
    )


def _score(
    job: Job,
    weights: Path,
    about: dict[str, Setting],
    settings: ReproduceSettings,
    opened: DatasetFolder,
) -> None:
    """The row of a training's weights, and its scores beside it; with ``only_missing`` what is up
    to date is kept. A training of a cross-validation has seen objects of the test split, so it is
    no row."""
    folders, recipe, model = settings.folders, job.recipe, load(weights)
    path = folders.scores(recipe)
    if job.has_scores and not (
        settings.only_missing and scores_that_hold(path, opened.fingerprint, recipe, model.sha256)
    ):
        units, mode = SCORING[recipe.normalisation]
        scores = score_frames(
            opened,
            lambda frame: model.predict_representation([frame])[0],
            opened.sequence.config(recipe.frames),
            Rules(TARGET, units, model.config.range_rule, mode),
            opened.samples(SPLIT)
            if recipe.fold is None
            else fold_samples(opened, recipe.fold)[SPLIT],
            recipe_digest=recipe.digest,
            weights_sha256=model.sha256,
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(scores.model_dump(mode="json"), path)
        settings.report(
            f"  {path.stem}: object MAE {millimetres(scores.errors[MAIN_KEY])} mm on "
            f"{scores.pairs} pairs"
        )
    if recipe.fold is not None:
        return
    path = folders.row(recipe)
    if (
        settings.only_missing
        and settings.leaderboard.row_that_holds(path, opened, model.sha256) is not None
    ):
        settings.report(f"  {path.stem}: holds, kept")
        return
    # A network's method sets torch's threads for the whole process; the next one needs its own.
    with torch_threads(torch.get_num_threads()):
        details = {"recipe_digest": recipe.digest, **about}
        method = NetworkMethod(model, remark=f"{recipe.preset} preset", about=details)
        settings.leaderboard.check_row_is_of(path, opened)
        result = score_method(opened, method, path, folders)
    settings.leaderboard.write_measured(result, path)
    settings.report(
        f"  {path.stem}: object MAE {millimetres(result.metrics.object_mae_mm)} mm, {result.track} "
        f"track"
    )


def is_trained(out: Path) -> bool:
    """Whether a training folder holds a finished training."""
    return (out / DONE).is_file()


MISSING = "missing"


def state_of(out: Path) -> str:
    """``trained``, ``begun`` or ``missing``."""
    return (
        "trained"
        if is_trained(out)
        else "begun"
        if out.is_dir() and any(out.iterdir())
        else MISSING
    )


def check_run_folders(
    jobs: Sequence[Job], folders: Folders, opened: DatasetFolder | None = None
) -> None:
    """Refuse, before hours of work, a training folder of another recipe: TrainingError names the
    folder, the settings that differ and the cure. With the dataset, also that of another one:
    DatasetError names both."""
    for job in jobs:
        path = folders.training(job.recipe) / RECIPE
        if not path.is_file():
            continue
        stored = _stored(path)
        try:
            differs = plan.differing(
                job.recipe.to_dict(), stored["recipe"], "{1} there, {0} in the recipe"
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise TrainingError(
                f"{path}: expected the recipe of a training, it can't be read ({error})"
            ) from None
        if differs:
            out = shlex.quote(str(path.parent))
            raise TrainingError(
                f"{path.parent}: holds a training of another recipe, {job.rows[0]} differs in "
                f"{differs}; to keep both, "
                f"mv {out} {out}-before, or give another --out"
            )
        trained_on = str(stored.get("fingerprint"))
        if opened is not None and trained_on != opened.fingerprint:
            raise DatasetError(
                f"{opened.path}: has fingerprint {opened.fingerprint[:8]}, but the training in "
                f"{path.parent} is of "
                f"{trained_on[:8]}; give that dataset as DATASET, or another --out"
            )


def check_machine(jobs: Sequence[Job], folders: Folders, anyway: bool, command: str) -> None:
    """Refuse the paper's preset without a GPU where something is left to train. TrainingError with
    the command."""
    untrained = [job for job in jobs if not is_trained(folders.training(job.recipe))]
    if folders.preset != PAPER_PRESET or anyway or not untrained or torch.cuda.is_available():
        return
    size = untrained[0].recipe.size
    raise TrainingError(
        f"preset {PAPER_PRESET} trains networks of full width on {size} x {size} px until the rate "
        f"has reached its "
        f"minimum, and PyTorch sees no CUDA GPU here, where that would take weeks; nothing was "
        f"started, and no row "
        f"will be estimated. On a machine with a GPU run, as often as its time allows:\n  "
        f"{command}\n"
        "or add --anyway to train on this processor all the same"
    )


def current_weights(recipe: Recipe, folders: Folders) -> Path | None:
    """Best weights of the finished training, the file to ship; None while there are none."""
    out = folders.training(recipe)
    if not is_trained(out) or not (out / WEIGHTS).is_file():
        return None
    try:
        of_recipe = _stored(out / RECIPE)["recipe"] == recipe.to_dict()
    except (TrainingError, KeyError, TypeError):
        return None
    return out / WEIGHTS if of_recipe else None


def _stored(path: Path) -> Any:
    return read_json(path, TrainingError, "give another --out, or remove it")


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, 64 hex digits."""
    return sha256(path.read_bytes()).hexdigest()


def score_method(
    opened: DatasetFolder, method: NetworkMethod, row: Path, folders: Folders
) -> Result:
    """Predict the test split, time the method, score against the decoded depth (as in the paper).
    Files of an earlier run are replaced at the end: an interrupted run leaves nothing that is taken
    for finished. Raises what predicting, timing and scoring raise."""
    name = row.stem
    predictions, results = folders.runs / "predictions" / name, folders.runs / "results"
    making = predictions.with_name(f"{name}.making")
    shutil.rmtree(making, ignore_errors=True)
    predict_split(opened, method, SPLIT, making)
    write_timing(making / SUBMISSION_FILE, time_method(opened, method, SPLIT, repeats=REPEATS))
    result = evaluate(making, opened, SPLIT, TARGET, mode=method.mode)
    for folder in (folders.rows, results):
        folder.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(predictions, ignore_errors=True)
    making.rename(predictions)
    write_result(result, results / f"{name}.json")
    return result
