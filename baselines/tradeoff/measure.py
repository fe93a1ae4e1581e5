"""Measuring every setting of every method on one machine, and what each stage costs as its input grows.

A setting is measured once and stored; a stopped run continues where it stopped. A setting that can't be measured says
why in its row, and the others are measured. Times are taken on frames in memory: warm-up, bounded runs, their spread,
and the machine's pace beside each setting.
"""

import os
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from platform import python_version
from statistics import median
from textwrap import shorten
from time import perf_counter, process_time
from typing import Any, Literal, TypeVar

import cv2
import numpy as np
from scipy.special import stdtrit

from fpp_ml_bench import __version__
from fpp_ml_bench.baselines.tradeoff.ladders import Ladder
from fpp_ml_bench.baselines.tradeoff.points import GROUPS, JOURNAL, Growth, Journal, Point, Tradeoff
from fpp_ml_bench.baselines.tradeoff.settings import Plan, Setting, TradeoffSettings
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.evaluation.result import HardwareInfo
from fpp_ml_bench.evaluation.score import object_interval, score_sample, scored_pair
from fpp_ml_bench.files import LOCK_FILE, NAME_LIMIT, exclusive, printable
from fpp_ml_bench.machine import describe_hardware

T = TypeVar("T")

PACE_VALUES, PACE_RUNS = 100_000, 5
"""Numbers that the pace is measured with: about 10 ms of sorting and arctangents, in and out of the cache."""
ROUNDS, LEAST_ROUNDS, LIMIT_S = 40, 2, 4.0
"""Rounds over all rungs of a ladder, fewer (but two) once the seconds are used up. The least time of each rung counts:
other work on the machine can only add to it. Rounds spread a busy minute over all rungs."""
LINEAR_LIMIT = 1.3
"""Every stage goes through its input once, so its power should be 1, or less with a fixed cost. Input that no longer
fits the caches adds some tenths; a second loop over the input gives 2."""
TAIL_POINTS, CONFIDENCE = 3, 0.95
_PACKAGE = Path(__file__).resolve().parents[2]
"""The package's folder, which is removed from messages that go into a result."""


@dataclass(frozen=True)
class Rules:
    """Timed ``runs`` of each setting, fewer (but ``least``) once ``limit_s`` is used up, after ``warm_up`` runs.
    ``clock``: wall-clock time, or the time that processors worked for this process. For one thread that waits for
    nothing both agree on an idle machine; on a shared machine only processor time stays the same."""

    clock: Literal["wall", "processor"] = "wall"
    threads: int = 1
    runs: int = 15
    least: int = 3
    limit_s: float = 3.0
    warm_up: int = 2

    def timed(self, call: Callable[[], T]) -> tuple[float, T]:
        """Seconds of a single run of ``call``, and what it returned."""
        clock = perf_counter if self.clock == "wall" else process_time
        started = clock()
        result = call()
        return clock() - started, result


def pace_ms(rules: Rules) -> float:
    """Median milliseconds that a fixed piece of work takes now. Other load, clock frequency and temperature change it:
    times of two settings are comparable where their paces agree."""
    values = np.random.Generator(np.random.PCG64(7)).random(PACE_VALUES)
    return 1000 * median(rules.timed(lambda: np.arctan2(np.sort(values), values))[0] for _ in range(PACE_RUNS))


def measured(setting: Setting, rules: Rules) -> Point:
    """The point of ``setting``. An error of the package (a frame is not stored, a package is missing) becomes its
    ``failed``, and the run goes on."""
    about: dict[str, Any] = {name: getattr(setting, name) for name in ("key", "group", "title", "note")}
    with suppress(OSError):  # where the system does not provide it
        about["load"] = round(os.getloadavg()[0], 2)
    pace_before = pace_ms(rules)
    try:
        figures = _figures(setting, rules)
    except FppBenchError as error:
        message = " ".join(str(error).split()).replace(f"{_PACKAGE}{os.sep}", "")
        return Point(**about, failed=shorten(printable(message, 1000), NAME_LIMIT, placeholder=" ..."))
    pace = (pace_before + pace_ms(rules)) / 2
    return Point(**about, pace_ms=float(f"{pace:.4g}"), **figures)


def _figures(setting: Setting, rules: Rules) -> dict[str, Any]:
    """Times and scores of ``setting``, as fields of a `Point`."""
    method, views = setting.make(), setting.views
    seconds: list[float] = []
    scores: list[tuple[float | None, ...]] = []
    for number, name in enumerate(views.names if setting.scored else views.names[:1]):
        predict = partial(method.predict, views.frames(method, name))
        for _ in range(rules.warm_up if number == 0 else 0):
            if rules.timed(predict)[0] > rules.limit_s:
                break
        run_s, depth = rules.timed(predict)
        seconds.append(run_s)
        if setting.scored:
            void = views.void(name) if method.mode == "standard" else None
            left_out = views.left_out(name, method.range_rule)
            pair = scored_pair(depth, views.target_mm(name), method.units, method.mode, name, left_out)
            sample = score_sample(*pair, void=void)
            missing_share = sample.missing / max(sample.object.pixels, 1)
            scores.append((sample.object.mae_mm, sample.valid.mae_mm, missing_share))
    # A run longer than the limit is not repeated.
    while len(seconds) < rules.runs and (len(seconds) < rules.least or sum(seconds) < rules.limit_s):
        if min(seconds) > rules.limit_s:
            break
        seconds.append(rules.timed(predict)[0])
    low, middle, high = (float(f"{float(np.percentile(seconds, q)):.4g}") for q in (5, 50, 95))
    given = ["depth range"] * method.uses_ground_truth_range + ["object mask"] * method.uses_ground_truth_mask
    figures: dict[str, Any] = {
        "frames": len(method.frames_used),
        "image_px": int(depth.shape[1]),
        "runs": len(seconds),
        "seconds": middle,
        "seconds_p5": low,
        "seconds_p95": high,
        "parameters": method.parameters,
        "given": " and ".join(given) or None,
    }
    if scores:
        object_mae, valid_mae, missing = zip(*scores, strict=True)
        interval = object_interval(list(object_mae), [split_sample_name(name)[0] for name in views.names])
        figures |= {
            "object_mae_mm": _mean(object_mae),
            "interval_mm": None if interval is None else list(interval),
            "measured_mae_mm": _mean(valid_mae),
            "missing_share": _mean(missing),
        }
    return figures


def _mean(values: Sequence[float | None]) -> float | None:
    numbers = [value for value in values if value is not None]
    return float(np.mean(numbers, dtype=np.float64)) if numbers else None


def time_ladder(ladder: Ladder, rules: Rules = Rules()) -> list[Growth]:
    """The growth of the ladder's stage and of each part of it that its runs time themselves, the slowest first. Runs
    time their parts by the wall clock, so parts are left out where ``rules`` use the processor clock. A stage counts
    where every rung has it, with a time that a clock can tell from 0."""
    least: list[dict[str, float]] = [{} for _ in ladder.steps]
    with tempfile.TemporaryDirectory(prefix="fpp-bench-costs-") as folder:
        rungs = []
        for step in ladder.steps:
            (own := Path(folder) / str(step)).mkdir()
            rungs.append(ladder.prepare(step, own))
        for rung in rungs[:2]:  # compiled code and caches; also the second, because some code runs only on larger input
            rung.run()
        total_s = 0.0
        for number in range(ROUNDS):
            for rung, best in zip(rungs, least, strict=True):
                run_s, result = rules.timed(rung.run)
                total_s += run_s
                stages = {ladder.stage: run_s}
                if isinstance(result, dict) and rules.clock == "wall":
                    stages |= {f"{ladder.stage}: {part}": seconds for part, seconds in result.items()}
                for name, seconds in stages.items():
                    best[name] = min(seconds, best.get(name, float("inf")))
            if number + 1 >= LEAST_ROUNDS and total_s > LIMIT_S * rules.limit_s / Rules.limit_s:
                break
    amounts = [rung.amount for rung in rungs]
    of_all = [stage for stage in least[0] if all(best.get(stage, 0.0) > 1e-6 for best in least)]
    growths = [growth(stage, ladder.over, amounts, [best[stage] for best in least]) for stage in of_all]
    return sorted(growths, key=lambda stage_growth: -stage_growth.seconds[-1])


def growth(stage: str, over: str, amounts: Sequence[float], seconds: Sequence[float]) -> Growth:
    """The power p of seconds = c amount^p by least squares of the logarithms, its 95% interval by Student's t over the
    residuals, and the power over the largest amounts alone (``tail``), where a fixed cost no longer hides a steep term.
    A power above `LINEAR_LIMIT` is flagged, over all amounts or over the largest. Where the interval includes the
    limit, the flag says that the times do not prove it."""
    x, y = np.log(amounts), np.log(seconds)
    (slope, _), covariance = np.polyfit(x, y, 1, cov=True)
    half = stdtrit(len(x) - 2, 0.5 + CONFIDENCE / 2) * np.sqrt(covariance[0, 0])
    low, high = float(slope - half), float(slope + half)
    exponent, tail = round(float(slope), 10), round(float(np.polyfit(x[-TAIL_POINTS:], y[-TAIL_POINTS:], 1)[0]), 10)
    flag = None
    if exponent > LINEAR_LIMIT:
        proven = low > LINEAR_LIMIT
        flag = "steeper than linear" if proven else "perhaps steeper than linear: times scatter, run it again"
    elif tail > LINEAR_LIMIT:
        flag = "steeper than linear at the largest amounts"
    return Growth(
        stage=stage,
        over=over,
        amounts=[float(a) for a in amounts],
        seconds=[float(f"{s:.4g}") for s in seconds],
        exponent=round(exponent, 3),
        low=round(low, 3),
        high=round(high, 3),
        tail=round(tail, 3),
        flag=flag,
    )


def tradeoff(settings: TradeoffSettings, plan: Plan, progress: Callable[[str], object] = lambda key: None) -> Tradeoff:
    """Measure what ``settings.out`` lacks of ``plan``, calling ``progress`` with the key of each setting and ladder
    before it is measured. Raises BuildError when another process works in the same folder, SubmissionError for a folder
    with a run of other rules or of another machine."""
    fewer: dict[str, Any] = {"runs": 5, "limit_s": 1.0} if settings.quick else {}
    rules = Rules(settings.clock, settings.threads, **fewer)
    hardware, views = describe_hardware(), list(plan.views.names)
    # What two sittings of a run must share. Their groups may differ: a later sitting can add a group.
    about = {
        "tradeoff": 2,
        "package": __version__,
        "dataset": plan.opened.fingerprint,
        "views": views,
        "rules": asdict(rules),
        "cpu": hardware.cpu,
        "cores": hardware.cores,
    }
    cv2.setNumThreads(settings.threads)  # the phase route's filters take all threads by default; torch: see networks
    with exclusive(settings.out / LOCK_FILE, settings.out, "measuring into this folder"):
        path = settings.out / JOURNAL
        journal = Journal.of(path, about)
        journal.write(path)
        for setting in plan.settings:
            progress(setting.key)
            if setting.key not in journal.points:
                journal.points[setting.key] = measured(setting, rules)
                journal.write(path)
        for ladder in plan.ladders:
            progress(ladder.key)
            if ladder.key not in journal.growth:
                journal.growth[ladder.key] = time_ladder(ladder, rules)
                journal.write(path)
    per_object = max(Counter(split_sample_name(name)[0] for name in views).values())
    versions = {}
    for package in ("numpy", "numba", "torch", "onnxruntime"):
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return Tradeoff(
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        dataset=plan.opened.path.resolve().name,
        fingerprint=plan.opened.fingerprint,
        image_size=list(plan.opened.size),
        target=plan.views.target,
        views=views,
        settings={**asdict(rules), "quick": settings.quick, "views_an_object": per_object},
        hardware=HardwareInfo.model_validate(hardware.to_dict()),
        software={"fpp_ml_bench": __version__, "python": python_version(), **versions},
        sittings=journal.sittings,
        # Everything in this folder, so that a group measured on its own adds to the earlier ones.
        points=sorted(journal.points.values(), key=lambda point: GROUPS.index(point.group)),
        growth=[growth for growths in journal.growth.values() for growth in growths],
    )
