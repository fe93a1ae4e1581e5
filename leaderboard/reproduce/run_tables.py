"""Regenerating the paper's tables: train, predict, time, score, write rows and a Markdown table; skip what is done.

No training is ever deleted: a finished training is used, a stopped one continued, one of another recipe refused.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import shorten
from time import perf_counter

from fpp_ml_bench.baselines.networks import Model, load
from fpp_ml_bench.baselines.training import SCORING, TrainingRun, train
from fpp_ml_bench.errors import PredictionError, SubmissionError, TrainingError, WeightsError
from fpp_ml_bench.files import exclusive, write_atomically
from fpp_ml_bench.leaderboard.reproduce.data import open_dataset
from fpp_ml_bench.leaderboard.reproduce.frames import all_frames_that_hold, score_all_frames, write_all_frames
from fpp_ml_bench.leaderboard.reproduce.lines import MAIN_KEY, table_lines
from fpp_ml_bench.leaderboard.reproduce.paper_order import orderings
from fpp_ml_bench.leaderboard.reproduce.plan import Folders, Job, planned, variants
from fpp_ml_bench.leaderboard.reproduce.row import make_row, row_that_holds
from fpp_ml_bench.leaderboard.reproduce.scored_methods import named_method
from fpp_ml_bench.leaderboard.reproduce.table import table_markdown
from fpp_ml_bench.leaderboard.reproduce.train_row import check_machine, check_run_folders, finished_weights, is_trained
from fpp_ml_bench.loaders.storage import DatasetFolder

Report = Callable[[str], object]
REASON_LENGTH = 400


@dataclass(frozen=True)
class ReproduceSettings:
    """Settings of a run. ``minutes`` limits the whole run; ``command`` continues it; ``anyway`` trains the paper's
    preset without a GPU; ``only_missing`` keeps rows that are up to date; ``show``: the engine's progress on stderr;
    ``report`` takes a line of progress."""

    tables: Sequence[str]
    folders: Folders
    command: str
    data: Path | None = None
    only_missing: bool = False
    minutes: float | None = None
    anyway: bool = False
    show: bool = True
    report: Report = print


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
    (`Outcome.failed`).
    Raises TrainingError for a training folder of another recipe, or the paper's preset without a GPU; DatasetError for
    a dataset of another size or fingerprint; BuildError when another process works in the same folder; and what
    predicting and scoring raise.
    """
    folders = settings.folders
    jobs = planned(settings.tables, folders.preset)
    check_run_folders(jobs, folders)
    check_machine(jobs, folders, settings.anyway, settings.command)
    with exclusive(folders.runs / "lock", folders.runs, "reproducing into this folder"):
        opened = open_dataset(settings.data, jobs, folders, settings.report)
        outcome = Outcome(opened, jobs)
        try:
            _work(settings, outcome)
        finally:
            for table in settings.tables:
                outcome.tables.append(_write_table(table, settings, outcome))
    return outcome


def _work(settings: ReproduceSettings, outcome: Outcome) -> None:
    """Every job in turn, until the minutes run out."""
    jobs, folders = outcome.jobs, settings.folders
    started = perf_counter()
    training_seconds: list[float] = []
    for number, job in enumerate(jobs, 1):
        minutes_left = None if settings.minutes is None else settings.minutes - (perf_counter() - started) / 60
        trained = is_trained(folders.training(job.recipe))
        if minutes_left is not None and minutes_left <= 0:
            outcome.stopped = job.recipe.name
            return
        rows = ", ".join(place.recipe_name for place in job.places)
        settings.report(
            f"[{number}/{len(jobs)}] {job.recipe.name} ({rows})"
            f"{_time_left(training_seconds, jobs[number - 1 :], folders)}"
        )
        began = perf_counter()
        try:
            run = train(
                job.recipe, outcome.opened.path, folders.training(job.recipe), minutes=minutes_left, show=settings.show
            )
            if not run.finished:
                outcome.stopped = job.recipe.name
                return
            _score(job, run, settings, outcome.opened)
        except (TrainingError, PredictionError, WeightsError) as error:
            # The other trainings, which take hours, may still succeed.
            outcome.failed[job.recipe.name] = shorten(" ".join(str(error).split()), REASON_LENGTH, placeholder=" ...")
            settings.report(f"  failed, its rows stay as they are: {error}")
        if not trained:
            training_seconds.append(perf_counter() - began)


def _time_left(training_seconds: Sequence[float], jobs: Sequence[Job], folders: Folders) -> str:
    """Words on the time that is left, estimated from the mean of the trainings of this call."""
    untrained = sum(not is_trained(folders.training(job.recipe)) for job in jobs)
    if not training_seconds or not untrained:
        return ""
    minutes = untrained * sum(training_seconds) / len(training_seconds) / 60
    return f", about {minutes:.0f} min left for {untrained} trainings"


def _score(job: Job, run: TrainingRun, settings: ReproduceSettings, opened: DatasetFolder) -> None:
    """Weights with range heads, rows, and scores on all frames of a training; up-to-date rows are kept with
    ``only_missing``."""
    folders, recipe = settings.folders, job.recipe
    model = load(finished_weights(job, run, opened, folders, settings.only_missing))
    if job.all_frames:
        _score_all_frames(job, model, settings, opened)
    for variant in variants(recipe):
        name = folders.row_name(recipe, variant)
        if settings.only_missing and row_that_holds(folders.row(recipe, variant), opened, model.sha256) is not None:
            settings.report(f"  {name}: holds, kept")
            continue
        with _restored_threads():
            entry = make_row(opened, named_method(job, variant, model, run), name, folders)
        value = entry.value(MAIN_KEY)
        settings.report(
            f"  {name}: object MAE {'-' if value is None else f'{value:.2f} mm'}, {entry.result.track} track"
        )


def _score_all_frames(job: Job, model: Model, settings: ReproduceSettings, opened: DatasetFolder) -> None:
    """All frames of the training's configuration, by the rule of the oracle range, as in the paper."""
    path = settings.folders.all_frames(job.recipe)
    if settings.only_missing and all_frames_that_hold(path, opened.fingerprint, model.sha256) is not None:
        return
    scores = score_all_frames(
        opened,
        lambda frame: model.predict_representation([frame])[0],
        opened.sequence.config(job.recipe.data_config),
        *SCORING[job.recipe.normalisation],
        job.recipe.name,
        model.sha256,
    )
    write_all_frames(scores, path)
    value = scores.metrics.object_mae_mm
    settings.report(f"  {path.stem}: object MAE {'-' if value is None else f'{value:.2f} mm'} on {scores.pairs} pairs")


@contextmanager
def _restored_threads() -> Iterator[None]:
    """A network's method sets torch's threads for the whole process; restore them for the next training."""
    import torch

    threads = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _write_table(table: str, settings: ReproduceSettings, outcome: Outcome) -> Path:
    path = settings.folders.table(table)
    lines = table_lines(table, outcome.jobs, settings.folders, outcome.opened)
    text = table_markdown(table, lines, orderings(lines), settings.folders.preset, settings.command, outcome.failed)
    try:
        write_atomically(path, text.encode("utf-8"))
    except OSError as error:
        raise SubmissionError(f"{path} can't be written: {error.strerror}") from None
    return path
