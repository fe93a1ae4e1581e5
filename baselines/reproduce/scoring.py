"""Predicting, timing and scoring a trained network for a row, and its scores on every frame.

In the paper's multi-frame table (Section 5.4) scores are averages over all (view, frame) pairs of a condition's test
set. Here each sample's score is the mean over its frames, and the headline the mean over samples: the same number, for
every sample has the same frames, and the interval can then be taken over objects. The rules are the evaluator's own
(`scored_pair`, `score_sample`).
"""

import shutil
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fpp_ml_bench.baselines.networks.network_method import NetworkMethod
from fpp_ml_bench.baselines.reproduce.plan import Folders
from fpp_ml_bench.baselines.run import predict_split
from fpp_ml_bench.baselines.timing import time_method, write_timing
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.depth import RangeRule
from fpp_ml_bench.errors import PredictionError, SubmissionError
from fpp_ml_bench.evaluation.metrics import HEADLINE
from fpp_ml_bench.evaluation.protocol import PROTOCOL_VERSION, Mode, Units
from fpp_ml_bench.evaluation.result.file import read_json, write_result
from fpp_ml_bench.evaluation.result.model import Result
from fpp_ml_bench.evaluation.result.parts import Headline, Intervals, Sha256
from fpp_ml_bench.evaluation.score.check import scored_pair
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.score.sample_scores import score_sample
from fpp_ml_bench.evaluation.score.uncertainty import intervals_over_objects
from fpp_ml_bench.evaluation.submission.prediction_files import SUBMISSION_FILE
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.schema import Count, StrictModel, Text, validate

MAIN_KEY = "object_mae_mm"
SPLIT, TARGET = "test", "depth"
REPEATS = 20
Scores = dict[str, float | None]


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


class FrameMean(StrictModel):
    """Mean over samples for one frame of the sequence."""

    frame: Count
    metrics: Headline


class SampleMean(StrictModel):
    """Mean over frames for one sample."""

    sample: Text
    object: Text
    metrics: Headline


class AllFrames(StrictModel):
    """The six errors over all pairs of ``frames`` and test samples, with what they were computed from."""

    schema_version: Literal["1.0.0"]
    protocol_version: Text
    recipe: Text
    fingerprint: Sha256
    weights_sha256: Sha256
    mode: Mode
    frames: list[Count]
    pairs: Annotated[int, Field(gt=0)]
    metrics: Headline
    intervals: Intervals
    per_frame: list[FrameMean]
    per_sample: list[SampleMean]


def score_all_frames(
    opened: DatasetFolder,
    predict: Callable[[NDArray[np.uint8]], NDArray[np.float32]],
    frames: Sequence[int],
    scoring: tuple[Units, Mode],
    about: Mapping[str, str],
    rule: RangeRule = "object",
) -> AllFrames:
    """Score ``predict`` (a frame (H, W) in, depth (H, W) in the units of ``scoring`` out, normalised by
    ``rule``) on every test sample and frame. ``about``: ``recipe`` and ``weights_sha256`` of the network. Raises
    PredictionError for a prediction that is not finite, and what `scored_pair` raises."""
    samples = opened.samples(SPLIT)
    scores: dict[tuple[str, int], Scores] = {}
    for sample in samples:
        target_mm = opened.target_mm(sample)
        void = opened.void(sample) if scoring[1] == "standard" else None
        left_out = opened.left_out(sample, rule)
        for frame in frames:
            values = predict(opened.frame(sample, frame))
            if not np.isfinite(values).all():
                raise PredictionError(f"{sample}, frame {frame}: the network gave values that are not finite")
            pair = scored_pair(values, target_mm, *scoring, sample, left_out)
            metrics = score_sample(*pair, void=void).metrics()
            scores[sample, frame] = {key: metrics[key] for key in HEADLINE}
    rows = [_mean([scores[sample, frame] for frame in frames]) for sample in samples]
    of_frames = [_mean([scores[sample, frame] for sample in samples]) for frame in frames]
    objects = [split_sample_name(sample)[0] for sample in samples]
    ends = intervals_over_objects(rows, objects, HEADLINE)
    return AllFrames(
        schema_version="1.0.0",
        protocol_version=PROTOCOL_VERSION,
        fingerprint=opened.fingerprint,
        mode=scoring[1],
        frames=list(frames),
        pairs=len(scores),
        metrics=Headline(**_mean(rows)),
        intervals=Intervals(**{key: list(interval or (None, None)) for key, interval in ends.items()}),
        per_frame=[FrameMean(frame=f, metrics=Headline(**row)) for f, row in zip(frames, of_frames, strict=True)],
        per_sample=[
            SampleMean(sample=sample, object=name, metrics=Headline(**row))
            for sample, name, row in zip(samples, objects, rows, strict=True)
        ],
        **about,
    )


def _mean(rows: Sequence[Scores]) -> Scores:
    """Plain mean of each headline score over the rows that have it."""
    values_by_key = {key: [value for row in rows if (value := row[key]) is not None] for key in HEADLINE}
    return {key: statistics.fmean(values) if values else None for key, values in values_by_key.items()}


def read_all_frames(path: Path) -> AllFrames:
    """Read strictly; SubmissionError names the file and what is wrong with it."""
    return validate(AllFrames, read_json(path), path, "file of scores on all frames")


def all_frames_that_hold(path: Path, fingerprint: str, weights_sha256: str) -> AllFrames | None:
    """The scores in ``path`` if valid and of this dataset, these weights and the current protocol; else None."""
    try:
        scores = read_all_frames(path)
    except SubmissionError:
        return None
    key = (fingerprint, weights_sha256, PROTOCOL_VERSION)
    return scores if (scores.fingerprint, scores.weights_sha256, scores.protocol_version) == key else None
