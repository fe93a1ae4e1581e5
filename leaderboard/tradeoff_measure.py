"""One setting measured: seconds a view on frames in memory, and the error, by the leaderboard's scoring."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten

import numpy as np

from fpp_ml_bench.baselines.methods import Method
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.evaluation.protocol import Mode
from fpp_ml_bench.evaluation.scores import score_sample
from fpp_ml_bench.evaluation.text import NAME_LIMIT, printable
from fpp_ml_bench.evaluation.uncertainty import object_interval
from fpp_ml_bench.evaluation.units import scored_pair
from fpp_ml_bench.leaderboard.tradeoff_clock import Rules, load, pace_ms, spread
from fpp_ml_bench.leaderboard.tradeoff_points import Group, Point
from fpp_ml_bench.leaderboard.tradeoff_views import Views

_PACKAGE = Path(__file__).resolve().parents[1]
"""Where this package lies is nothing that a result need tell."""


@dataclass(frozen=True)
class Setting:
    """``make`` gives the method when its turn has come; ``views`` it is measured on. ``scored`` no: time alone, for a
    network that nobody trained."""

    key: str
    group: Group
    title: str
    make: Callable[[], Method]
    views: Views
    scored: bool = True
    note: str | None = None


def measured(setting: Setting, rules: Rules) -> Point:
    """The point of ``setting``. What refuses on purpose (a frame that is not stored, a package that is missing) becomes
    its ``failed``, and the run goes on."""
    about = {"key": setting.key, "group": setting.group, "title": setting.title, "note": setting.note, "load": load()}
    before = pace_ms(rules)
    try:
        found = _measured(setting, rules)
        pace = (before + pace_ms(rules)) / 2
        return Point.model_validate({**about, "pace_ms": float(f"{pace:.4g}"), **found})
    except FppBenchError as error:
        said = " ".join(str(error).split()).replace(f"{_PACKAGE}{os.sep}", "")
        reason = shorten(printable(said, 1000), NAME_LIMIT, placeholder=" ...")
        return Point.model_validate({**about, "failed": reason})


def _measured(setting: Setting, rules: Rules) -> dict[str, object]:
    """What the clock and the scoring say of ``setting``."""
    method, views = setting.make(), setting.views
    taken: list[float] = []
    scores: list[tuple[float | None, float | None, float]] = []
    for number, name in enumerate(views.names if setting.scored else views.names[:1]):
        frames = views.frames(method, name)
        if number == 0:
            for _ in range(rules.warm_up):
                if rules.once(lambda: method.predict(frames)) > rules.limit_s:  # noqa: B023  called at once
                    break
        depth: list[np.ndarray] = []
        taken.append(rules.once(lambda: depth.append(method.predict(frames))))  # noqa: B023
        if setting.scored:
            scores.append(_score(method, depth[0], views, name))
    taken = rules.extended(taken, lambda: method.predict(frames))
    middle, low, high = spread(taken)
    found: dict[str, object] = {
        "frames": len(method.frames_used),
        "image_px": int(depth[0].shape[1]),
        "runs": len(taken),
        "seconds": middle,
        "seconds_p5": low,
        "seconds_p95": high,
        "parameters": int(getattr(method, "parameters", 0)),
        "given": _given(method),
    }
    if scores:
        whole, valid, missing = ([row[place] for row in scores] for place in range(3))
        interval = object_interval(whole, views.objects)
        found |= {
            "object_mae_mm": _mean(whole),
            "interval_mm": None if interval is None else list(interval),
            "measured_mae_mm": _mean(valid),
            "missing_share": _mean(missing),
        }
    return found


def _score(method: Method, depth: np.ndarray, views: Views, name: str) -> tuple[float | None, float | None, float]:
    """Object MAE, that over measured pixels, and the share of object pixels without a depth."""
    mode: Mode = getattr(method, "mode", "standard")
    pair = scored_pair(depth, views.target_mm(name), getattr(method, "units", "mm"), mode, name)
    found = score_sample(*pair)
    pixels = found.object.pixels
    return found.object.mae_mm, found.valid.mae_mm, found.missing / pixels if pixels else 0.0


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known, dtype=np.float64)) if known else None


def _given(method: Method) -> str | None:
    told = ["depth range"] * method.uses_ground_truth_range
    told += ["object mask"] * bool(getattr(method, "uses_ground_truth_mask", False))
    return " and ".join(told) or None
