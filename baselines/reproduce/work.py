"""Regenerating the paper's tables: train, predict, time, score, write rows and a Markdown table; skip what is done.

No training is ever deleted: a finished training is used, a stopped one continued, one of another recipe refused.

In the paper's multi-frame table (Section 5.4) scores are averages over all (view, frame) pairs of a condition's test
set. Here each sample's score is the mean over its frames, and the headline the mean over samples: the same number, for
every sample has the same frames, and the interval can then be taken over objects. The rules are the evaluator's own
(`Rules`, `score_sample`).
"""

import json
import shlex
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from textwrap import shorten
from time import perf_counter
from types import ModuleType
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from fpp_ml_bench.baselines.method import Setting
from fpp_ml_bench.baselines.networks.base import torch_threads
from fpp_ml_bench.baselines.networks.model import Model, load
from fpp_ml_bench.baselines.networks.network_method import NetworkMethod
from fpp_ml_bench.baselines.networks.range_heads import save_with_heads
from fpp_ml_bench.baselines.reproduce import plan
from fpp_ml_bench.baselines.reproduce.plan import Folders, Job, Report, variants
from fpp_ml_bench.baselines.run import predict_split
from fpp_ml_bench.baselines.timing import time_method, write_timing
from fpp_ml_bench.baselines.training.depth_training import DONE, SCORING, WEIGHTS, TrainingRun, train
from fpp_ml_bench.baselines.training.engine import RECIPE
from fpp_ml_bench.baselines.training.recipe import Recipe
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.errors import DatasetError, PredictionError, SubmissionError, TrainingError, WeightsError
from fpp_ml_bench.evaluation.metrics import HEADLINE
from fpp_ml_bench.evaluation.protocol import PROTOCOL_VERSION
from fpp_ml_bench.evaluation.result.file import write_json, write_result
from fpp_ml_bench.evaluation.result.model import Result
from fpp_ml_bench.evaluation.result.parts import Headline, Intervals, Sha256
from fpp_ml_bench.evaluation.score.check import Rules
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.score.sample_scores import score_sample
from fpp_ml_bench.evaluation.score.uncertainty import intervals_over_objects, mean_of
from fpp_ml_bench.evaluation.submission.prediction_files import SUBMISSION_FILE
from fpp_ml_bench.files import exclusive, read_json, write_atomically
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.schema import Count, StrictModel, Text, validate
from fpp_ml_bench.style import millimetres

PAPER_PRESET = "paper"
REASON_LENGTH = 400
MAIN_KEY = "object_mae_mm"
SPLIT, TARGET = "test", "depth"
REPEATS = 20
Scores = dict[str, float | None]


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
    wanted = [job for job in jobs if not settings.row or f"{settings.tables[0]}/{settings.row}" in job.rows]
    check_run_folders(wanted, folders)
    check_machine(wanted, folders, settings.anyway, settings.command)
    with exclusive(folders.runs / "lock", folders.runs, "reproducing into this folder"):
        opened = plan.open_dataset(settings.data, jobs, folders, settings.report)
        check_run_folders(wanted, folders, opened)
        outcome = Outcome(opened, jobs)
        try:
            _work(settings, outcome, wanted)
        finally:
            for table in settings.tables:
                outcome.tables.append(settings.leaderboard.write_table(table, settings, outcome))
    return outcome


def _work(settings: ReproduceSettings, outcome: Outcome, jobs: Sequence[Job]) -> None:
    """Every job in turn, until the minutes run out."""
    started = perf_counter()
    for number, job in enumerate(jobs, 1):
        name, out = job.recipe.name, settings.folders.training(job.recipe)
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
            result = score_method(opened, method, path, folders)
        settings.leaderboard.write_measured(result, path)
        settings.report(
            f"  {path.stem}: object MAE {millimetres(result.metrics.object_mae_mm)} mm, {result.track} track"
        )


def _score_all_frames(recipe: Recipe, model: Model, settings: ReproduceSettings, opened: DatasetFolder) -> None:
    """All frames of the training's configuration, by the rule of the oracle range, as in the paper."""
    path = settings.folders.all_frames(recipe)
    if settings.only_missing and all_frames_that_hold(path, opened.fingerprint, model.sha256) is not None:
        return
    units, mode = SCORING[recipe.normalisation]
    scores = score_all_frames(
        opened,
        lambda frame: model.predict_representation([frame])[0],
        opened.sequence.config(recipe.frames),
        Rules(TARGET, units, model.config.range_rule, mode),
        model.sha256,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(scores.model_dump(mode="json"), path)
    settings.report(f"  {path.stem}: object MAE {millimetres(scores.metrics.object_mae_mm)} mm on {scores.pairs} pairs")


def is_trained(out: Path) -> bool:
    """Whether a training folder holds a finished training."""
    return (out / DONE).is_file()


def state_of(out: Path) -> str:
    """``trained``, ``begun`` or ``missing``."""
    return "trained" if is_trained(out) else "begun" if out.is_dir() and any(out.iterdir()) else "missing"


def check_run_folders(jobs: Sequence[Job], folders: Folders, opened: DatasetFolder | None = None) -> None:
    """Refuse, before hours of work, a training folder of another recipe: TrainingError names the folder, the settings
    that differ and the cure. With the dataset, also that of another one: DatasetError names both."""
    for job in jobs:
        path = folders.training(job.recipe) / RECIPE
        if not path.is_file():
            continue
        stored = _stored(path)
        try:
            differs = plan.differing(job.recipe.to_dict(), stored["recipe"], "{1} there, {0} in the recipe")
        except (KeyError, TypeError, AttributeError) as error:
            raise TrainingError(f"{path}: expected the recipe of a training, it can't be read ({error})") from None
        if differs:
            out = shlex.quote(str(path.parent))
            raise TrainingError(
                f"{path.parent}: holds a training of another recipe, {job.rows[0]} differs in {differs}; to keep both, "
                f"mv {out} {out}-before, or give another --out"
            )
        trained_on = str(stored.get("fingerprint"))
        if opened is not None and trained_on != opened.fingerprint:
            raise DatasetError(
                f"{opened.path}: has fingerprint {opened.fingerprint[:8]}, but the training in {path.parent} is of "
                f"{trained_on[:8]}; give that dataset as DATASET, or another --out"
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


def score_method(opened: DatasetFolder, method: NetworkMethod, row: Path, folders: Folders) -> Result:
    """Predict the test split, time the method, score against the decoded depth (as in the paper). Files of an earlier
    run are replaced at the end: an interrupted run leaves nothing that is taken for finished. Raises what predicting,
    timing and scoring raise."""
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


class SampleMean(StrictModel):
    """Mean over frames for one sample."""

    sample: Text
    object: Text
    metrics: Headline


class AllFrames(StrictModel):
    """The six errors over all ``pairs`` of ``frames`` and test samples, with what they were computed from."""

    schema_version: Literal["2.0.0"] = "2.0.0"
    protocol_version: Text = PROTOCOL_VERSION
    fingerprint: Sha256
    weights_sha256: Sha256
    frames: list[Count]
    pairs: Annotated[int, Field(gt=0)]
    metrics: Headline
    intervals: Intervals
    per_sample: list[SampleMean]


def score_all_frames(
    opened: DatasetFolder,
    predict: Callable[[NDArray[np.uint8]], NDArray[np.float32]],
    frames: Sequence[int],
    rules: Rules,
    weights_sha256: str,
) -> AllFrames:
    """Score ``predict`` (a frame (H, W) in, depth (H, W) out) by ``rules`` on every test sample and frame;
    ``weights_sha256``: of the network. Raises PredictionError for a prediction that is not finite, and what
    `Rules.pair` raises."""
    samples = opened.samples(SPLIT)
    rows: list[Scores] = []
    for sample in samples:
        void = rules.void(opened, sample)
        scores: list[Scores] = []
        for frame in frames:
            values = predict(opened.frame(sample, frame))
            if not np.isfinite(values).all():
                raise PredictionError(f"{sample}, frame {frame}: the network gave values that are not finite")
            scores.append(score_sample(*rules.pair(values, opened, sample), void=void).metrics())
        rows.append(_mean(scores))
    objects = [split_sample_name(sample)[0] for sample in samples]
    ends = intervals_over_objects(rows, objects, HEADLINE)
    return AllFrames(
        fingerprint=opened.fingerprint,
        weights_sha256=weights_sha256,
        frames=list(frames),
        pairs=len(samples) * len(frames),
        metrics=Headline(**_mean(rows)),
        intervals=Intervals(**{key: list(interval or (None, None)) for key, interval in ends.items()}),
        per_sample=[
            SampleMean(sample=sample, object=name, metrics=Headline(**row))
            for sample, name, row in zip(samples, objects, rows, strict=True)
        ],
    )


def _mean(rows: Sequence[Scores]) -> Scores:
    """Plain mean of each headline score over the rows that have it."""
    return {key: mean_of(row[key] for row in rows) for key in HEADLINE}


def read_all_frames(path: Path) -> AllFrames:
    """Read strictly; SubmissionError names the file and what is wrong with it."""
    return validate(
        AllFrames, read_json(path, SubmissionError, "run the command again"), path, "file of scores on all frames"
    )


def all_frames_that_hold(path: Path, fingerprint: str, weights_sha256: str) -> AllFrames | None:
    """The scores in ``path`` if valid and of this dataset, these weights and the current protocol; else None."""
    try:
        scores = read_all_frames(path)
    except SubmissionError:
        return None
    key = (fingerprint, weights_sha256, PROTOCOL_VERSION)
    return scores if (scores.fingerprint, scores.weights_sha256, scores.protocol_version) == key else None
