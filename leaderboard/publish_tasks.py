"""The tasks of the Hub's benchmark pages, and a score for which higher is better.

The Hub ranks by the greatest value and knows no unit. So an error becomes a score between 0 and 100,

    score = 100 / (1 + object MAE / 10 mm),

which falls strictly with the error (0 mm: 100; 1 mm: 90.9; 10 mm: 50; 100 mm: 9.1); the millimetres are in the notes.
Own definition; 10 mm is the widest tolerance that this benchmark counts pixels within.
"""

from dataclasses import dataclass

from fpp_ml_bench.errors import PublishError
from fpp_ml_bench.evaluation.protocol import Track
from fpp_ml_bench.evaluation.result import Result
from fpp_ml_bench.loaders.sample import SINGLE_SHOT_FRAME
from fpp_ml_bench.optics import CONFIGS

BENCHMARK = "FPP-ML-Bench"
FRAMEWORK = "fpp-ml-bench"
SPLIT = "test"
TARGET = "depth"
MODE = "standard"
SCORE_HALF_MM = 10.0
SCORE_TEXT = "score = 100 / (1 + object MAE / 10 mm), higher is better"
_SCORE_DIGITS = 6


@dataclass(frozen=True)
class Task:
    """A ranking on the Hub: results of other tracks, or with more frames, have their own."""

    id: str
    single_shot: bool
    track: Track


TASKS = (
    Task("single_shot_depth", True, "metric"),
    Task("single_shot_depth_oracle_range", True, "oracle range"),
    Task("multi_frame_depth", False, "metric"),
    Task("multi_frame_depth_oracle_range", False, "oracle range"),
)


def score(object_mae_mm: float) -> float:
    """Score in [0, 100] of an object MAE in mm (0 or more); 6 decimals."""
    return round(100.0 / (1.0 + object_mae_mm / SCORE_HALF_MM), _SCORE_DIGITS)


def tasks_of(configs: tuple[str, ...]) -> list[dict[str, str]]:
    """``tasks`` of ``eval.yaml`` for a dataset that serves ``configs``: the widest of them has the other frames."""
    widest = max(configs, key=CONFIGS.index)
    return [
        {"id": task.id, "config": CONFIGS[0] if task.single_shot else widest, "split": SPLIT}
        for task in TASKS if task.single_shot or widest != CONFIGS[0]
    ]  # fmt: skip


def task_of(result: Result, name: str) -> Task:
    """The task that a result belongs to; `PublishError`, naming the file ``name``, where it belongs to none."""
    if (result.dataset.split, result.target, result.mode) != (SPLIT, TARGET, MODE):
        raise PublishError(
            f"{name}: the Hub's benchmark is scored on the {SPLIT} split against {TARGET} in {MODE} mode, this result "
            f"on {result.dataset.split} against {result.target} in {result.mode} mode; score the predictions so first"
        )
    if result.submission.uses_ground_truth_mask:
        raise PublishError(
            f"{name}: the Hub's benchmark has no task for the {result.track} track (the method was given the object "
            "mask of the test samples); publish a result of a method that finds the object itself"
        )
    single = set(result.submission.frames_used) <= {SINGLE_SHOT_FRAME}
    return next(task for task in TASKS if (task.single_shot, task.track) == (single, result.track))
