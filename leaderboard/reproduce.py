"""Regenerating the paper's tables: train, predict, time, score, write rows and a Markdown table; skip what is done.

Trainings are never thrown away: a finished one is used, a stopped one taken up, one of another recipe refused.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import shorten
from time import perf_counter

from fpp_ml_bench.baselines.model import Model, load
from fpp_ml_bench.baselines.training.engine import TrainingRun, train
from fpp_ml_bench.baselines.training.validation import SCORING
from fpp_ml_bench.errors import PredictionError, SubmissionError, TrainingError, WeightsError
from fpp_ml_bench.leaderboard.reproduce_data import the_dataset
from fpp_ml_bench.leaderboard.reproduce_frames import all_frames_that_hold, score_all_frames, write_all_frames
from fpp_ml_bench.leaderboard.reproduce_lines import MAIN_KEY, table_lines
from fpp_ml_bench.leaderboard.reproduce_method import named_method
from fpp_ml_bench.leaderboard.reproduce_order import orderings
from fpp_ml_bench.leaderboard.reproduce_plan import Folders, Job, planned, variants
from fpp_ml_bench.leaderboard.reproduce_row import make_row, row_that_holds
from fpp_ml_bench.leaderboard.reproduce_table import table_markdown
from fpp_ml_bench.leaderboard.reproduce_training import (
    check_machine,
    check_run_folders,
    finished_weights,
    is_trained,
)
from fpp_ml_bench.loaders.folder_lock import exclusive
from fpp_ml_bench.loaders.manifest import write_atomically
from fpp_ml_bench.loaders.store import DatasetFolder

Say = Callable[[str], object]
REASON_LENGTH = 400


@dataclass(frozen=True)
class Wish:
    """What was asked for. ``minutes`` bounds the whole run; ``command`` is what goes on with it; ``anyway`` trains the
    paper's preset without a GPU; ``only_missing`` keeps rows that hold; ``show`` is the engine's progress on stderr."""

    tables: Sequence[str]
    folders: Folders
    command: str
    data: Path | None = None
    only_missing: bool = False
    minutes: float | None = None
    anyway: bool = False
    show: bool = True
    say: Say = print


@dataclass
class Outcome:
    """``stopped``: the recipe at which the minutes ran out, None when all was done; ``failed``: recipe name to why."""

    opened: DatasetFolder
    jobs: list[Job]
    tables: list[Path] = field(default_factory=list)
    stopped: str | None = None
    failed: dict[str, str] = field(default_factory=dict)


def reproduce(wish: Wish) -> Outcome:
    """Do what is missing of the tables, and write them. Interrupted at any time, the same call goes on.

    A training that diverges, or whose predictions can't be scored, does not keep the others from running
    (`Outcome.failed`).
    Raises TrainingError for a training folder of another recipe, or the paper's preset without a GPU; DatasetError for
    a dataset of another size or fingerprint; BuildError when another process works in the same folder; and what
    predicting and scoring raise.
    """
    folders = wish.folders
    jobs = planned(wish.tables, folders.preset)
    check_run_folders(jobs, folders)
    check_machine(jobs, folders, wish.anyway, wish.command)
    with exclusive(folders.runs / "lock", folders.runs, "reproducing into this folder"):
        opened = the_dataset(wish.data, jobs, folders, wish.say)
        outcome = Outcome(opened, jobs)
        try:
            _work(wish, outcome)
        finally:
            for table in wish.tables:
                outcome.tables.append(_write_table(table, wish, outcome))
    return outcome


def _work(wish: Wish, outcome: Outcome) -> None:
    """Every job in turn, until the minutes run out."""
    jobs, folders = outcome.jobs, wish.folders
    started = perf_counter()
    taken: list[float] = []
    for number, job in enumerate(jobs, 1):
        left = None if wish.minutes is None else wish.minutes - (perf_counter() - started) / 60
        trained = is_trained(folders.training(job.recipe))
        if left is not None and left <= 0:
            outcome.stopped = job.recipe.name
            return
        rows = ", ".join(place.recipe_name for place in job.places)
        wish.say(f"[{number}/{len(jobs)}] {job.recipe.name} ({rows}){_time_left(taken, jobs[number - 1 :], folders)}")
        began = perf_counter()
        try:
            run = train(job.recipe, outcome.opened.path, folders.training(job.recipe), minutes=left, show=wish.show)
            if not run.finished:
                outcome.stopped = job.recipe.name
                return
            _score(job, run, wish, outcome.opened)
        except (TrainingError, PredictionError, WeightsError) as error:
            # What is wrong with one training need not be wrong with the others, and they take hours.
            outcome.failed[job.recipe.name] = shorten(" ".join(str(error).split()), REASON_LENGTH, placeholder=" ...")
            wish.say(f"  failed, its rows stay as they are: {error}")
        if not trained:
            taken.append(perf_counter() - began)


def _time_left(taken: Sequence[float], jobs: Sequence[Job], folders: Folders) -> str:
    """From the mean of the trainings done in this call."""
    untrained = sum(not is_trained(folders.training(job.recipe)) for job in jobs)
    if not taken or not untrained:
        return ""
    return f", about {untrained * sum(taken) / len(taken) / 60:.0f} min left for {untrained} trainings"


def _score(job: Job, run: TrainingRun, wish: Wish, opened: DatasetFolder) -> None:
    """Weights with heads, rows and scores on all frames of one training; what holds is kept if so wished."""
    folders, recipe = wish.folders, job.recipe
    model = load(finished_weights(job, run, opened, folders, wish.only_missing))
    if job.all_frames:
        _score_all_frames(job, model, wish, opened)
    for variant in variants(recipe):
        name = folders.row_name(recipe, variant)
        if wish.only_missing and row_that_holds(folders.row(recipe, variant), opened, model.sha256) is not None:
            wish.say(f"  {name}: holds, kept")
            continue
        with _threads_kept():
            entry = make_row(opened, named_method(job, variant, model, run), name, folders)
        value = entry.value(MAIN_KEY)
        wish.say(f"  {name}: object MAE {'-' if value is None else f'{value:.2f} mm'}, {entry.result.track} track")


def _score_all_frames(job: Job, model: Model, wish: Wish, opened: DatasetFolder) -> None:
    """All frames of the training's configuration, by the rule of the oracle range, as in the paper."""
    path = wish.folders.all_frames(job.recipe)
    if wish.only_missing and all_frames_that_hold(path, opened.fingerprint, model.sha256) is not None:
        return
    found = score_all_frames(
        opened,
        lambda frame: model.predict_representation([frame])[0],
        opened.sequence.config(job.recipe.data_config),
        *SCORING[job.recipe.normalisation],
        job.recipe.name,
        model.sha256,
    )
    write_all_frames(found, path)
    value = found.metrics.object_mae_mm
    wish.say(f"  {path.stem}: object MAE {'-' if value is None else f'{value:.2f} mm'} on {found.pairs} pairs")


@contextmanager
def _threads_kept() -> Iterator[None]:
    """A method of a network sets torch's threads for the whole process; the next training wants them all again."""
    import torch

    before = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _write_table(table: str, wish: Wish, outcome: Outcome) -> Path:
    path = wish.folders.table(table)
    lines = table_lines(table, outcome.jobs, wish.folders, outcome.opened)
    text = table_markdown(table, lines, orderings(lines), wish.folders.preset, wish.command, outcome.failed)
    try:
        write_atomically(path, text.encode("utf-8"))
    except OSError as error:
        raise SubmissionError(f"{path} can't be written: {error.strerror}") from None
    return path
