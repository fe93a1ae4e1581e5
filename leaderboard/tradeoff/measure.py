"""Measuring a setting: seconds per view on frames in memory, and the error by the leaderboard's scoring."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten

import numpy as np

from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.evaluation.protocol import Mode
from fpp_ml_bench.evaluation.score import object_interval, score_sample, scored_pair
from fpp_ml_bench.files import NAME_LIMIT, printable
from fpp_ml_bench.leaderboard.tradeoff.clock import Rules, load, pace_ms, spread
from fpp_ml_bench.leaderboard.tradeoff.points import Group, Point
from fpp_ml_bench.leaderboard.tradeoff.views import Views

_PACKAGE = Path(__file__).resolve().parents[2]
"""The package's folder, which is removed from messages that go into a result."""


@dataclass(frozen=True)
class Setting:
    """``make`` builds the method when the setting is measured, on ``views``. ``scored`` False: time alone, for an
    untrained network."""

    key: str
    group: Group
    title: str
    make: Callable[[], Method]
    views: Views
    scored: bool = True
    note: str | None = None


def measured(setting: Setting, rules: Rules) -> Point:
    """The point of ``setting``. An error of the package (a frame is not stored, a package is missing) becomes its
    ``failed``, and the run goes on."""
    description = {
        "key": setting.key,
        "group": setting.group,
        "title": setting.title,
        "note": setting.note,
        "load": load(),
    }
    pace_before = pace_ms(rules)
    try:
        figures = _measured(setting, rules)
        pace = (pace_before + pace_ms(rules)) / 2
        return Point.model_validate({**description, "pace_ms": float(f"{pace:.4g}"), **figures})
    except FppBenchError as error:
        message = " ".join(str(error).split()).replace(f"{_PACKAGE}{os.sep}", "")
        reason = shorten(printable(message, 1000), NAME_LIMIT, placeholder=" ...")
        return Point.model_validate({**description, "failed": reason})


def _measured(setting: Setting, rules: Rules) -> dict[str, object]:
    """Times and scores of ``setting``, as fields of a `Point`."""
    method, views = setting.make(), setting.views
    seconds: list[float] = []
    scores: list[tuple[float | None, float | None, float]] = []
    for number, name in enumerate(views.names if setting.scored else views.names[:1]):
        frames = views.frames(method, name)
        if number == 0:
            for _ in range(rules.warm_up):
                if rules.seconds_of(lambda: method.predict(frames)) > rules.limit_s:  # noqa: B023  called at once
                    break
        depth: list[np.ndarray] = []
        seconds.append(rules.seconds_of(lambda: depth.append(method.predict(frames))))  # noqa: B023
        if setting.scored:
            scores.append(_score(method, depth[0], views, name))
    seconds = rules.extended(seconds, lambda: method.predict(frames))
    middle, low, high = spread(seconds)
    figures: dict[str, object] = {
        "frames": len(method.frames_used),
        "image_px": int(depth[0].shape[1]),
        "runs": len(seconds),
        "seconds": middle,
        "seconds_p5": low,
        "seconds_p95": high,
        "parameters": method.parameters,
        "given": _given(method),
    }
    if scores:
        object_mae, valid_mae, missing = ([row[column] for row in scores] for column in range(3))
        interval = object_interval(object_mae, views.objects)
        figures |= {
            "object_mae_mm": _mean(object_mae),
            "interval_mm": None if interval is None else list(interval),
            "measured_mae_mm": _mean(valid_mae),
            "missing_share": _mean(missing),
        }
    return figures


def _score(method: Method, depth: np.ndarray, views: Views, name: str) -> tuple[float | None, float | None, float]:
    """Object MAE, the MAE over measured object pixels, and the share of object pixels without a depth."""
    mode: Mode = method.mode
    pair = scored_pair(depth, views.target_mm(name), method.units, mode, name)
    sample_scores = score_sample(*pair)
    pixels = sample_scores.object.pixels
    return sample_scores.object.mae_mm, sample_scores.valid.mae_mm, sample_scores.missing / pixels if pixels else 0.0


def _mean(values: list[float | None]) -> float | None:
    numbers = [value for value in values if value is not None]
    return float(np.mean(numbers, dtype=np.float64)) if numbers else None


def _given(method: Method) -> str | None:
    given = ["depth range"] * method.uses_ground_truth_range
    given += ["object mask"] * method.uses_ground_truth_mask
    return " and ".join(given) or None
