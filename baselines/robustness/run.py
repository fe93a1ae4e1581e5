"""Measures a method axis by axis: predicts disturbed views in several processes, writes a file for each finished axis,
and summarises them: means by severity, the mean over all of them, and its interval."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from fpp_ml_bench import __version__
from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.baselines.robustness.axes import CLEAN, SETS, SetName, corruptions, score, severity_means
from fpp_ml_bench.baselines.robustness.scenes import Condition, FrameCache
from fpp_ml_bench.constants import sample_name
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.result.parts import Robustness, SeverityScores
from fpp_ml_bench.evaluation.score.uncertainty import object_interval
from fpp_ml_bench.files import LOCK_FILE, exclusive, read_json, write_atomically
from fpp_ml_bench.pool import mapping

QUICK_SEVERITIES = (1, 3, 5)
SEVERITIES = (1, 2, 3, 4, 5)
View = dict[str, Any]
"""A row of a view: sample, object, severity, seconds, and `SCORES`."""
Progress = Callable[[str, int], None]
Work = tuple[Method, Condition, FrameCache, tuple[str, ...]]
"""A method, the clean scene, rendered frames, and the views of each object."""


@dataclass(frozen=True)
class Setup:
    """A method on a set. ``quick``: one view of each object and three severities, for a look; ``rig``: one of
    `optics.NAMED_RIGS`, which projects what the method needs."""

    method: Method
    set_name: SetName
    size: int
    quick: bool = False
    rig: str = "paper"

    def __post_init__(self) -> None:
        if self.method.units != "mm":
            raise PredictionError(
                f"{self.method.title}: predicts normalised depth; robustness is measured in mm: give --range predicted"
            )

    @property
    def views(self) -> tuple[str, ...]:
        views = tuple(corruptions().views[self.set_name])
        return views[:1] if self.quick else views

    @property
    def severities(self) -> tuple[int, ...]:
        return QUICK_SEVERITIES if self.quick else SEVERITIES

    def axes(self, names: Sequence[str]) -> list[str]:
        """`CLEAN`, and those of ``names`` (all with none) that apply to the method and the set."""
        chosen, frames = corruptions().chosen(names), len(self.method.frames_used)
        return [CLEAN, *(name for name, axis in chosen.items() if axis.applies(SETS[self.set_name], frames))]

    def conditions(self, axis: str) -> list[Condition]:
        """Those of an axis of `corruptions`, or of `CLEAN`, on the objects of the set that it disturbs."""
        objects = tuple(SETS[self.set_name])
        if axis == CLEAN:
            return [Condition(CLEAN, 0, objects, self.size, self.rig)]
        disturbed = corruptions().axes[axis].seen_on(objects)
        return [Condition(axis, severity, disturbed, self.size, self.rig) for severity in self.severities]

    def key(self) -> dict[str, Any]:
        """What must be equal for two measurements to be parts of one."""
        threads = ("threads", "device")
        return {
            "fpp_ml_bench": __version__,
            "axes_version": corruptions().version,
            "set": self.set_name,
            "size": self.size,
            "quick": self.quick,
            "method": self.method.name,
            "title": self.method.title,
            "frames_used": list(self.method.frames_used),
            "settings": {key: value for key, value in self.method.settings.items() if key not in threads},
        }


def measure(
    setup: Setup,
    out: Path,
    axes: Sequence[str] = (),
    workers: int = 1,
    cache: Path | None = None,
    progress: Progress = lambda axis, views: None,
    cluster: str | None = None,
    saved: Callable[[], None] = lambda: None,
) -> dict[str, list[View]]:
    """The rows of every view by axis, and a file ``out/AXIS.json`` for each axis as soon as it is finished; files that
    an earlier run of the same setup left are read instead. Views are predicted and scored by so many processes, or by
    the Ray cluster at an address. ``progress`` is called with an axis and a number of views, ``saved`` after each file.
    Raises PredictionError for files of another setup, `BuildError` where another process is at it, `PoolError`."""
    with exclusive(out / LOCK_FILE, out, "measuring there"):
        files = {axis: out / f"{axis}.json" for axis in setup.axes(axes)}
        kept = {axis: _rows(file, setup.key()) for axis, file in files.items()}
        rows = {axis: found for axis, found in kept.items() if found is not None}
        for axis, found in rows.items():
            progress(axis, len(found))
        missing = [axis for axis in files if axis not in rows]
        frames = FrameCache(cache)
        work = setup.method, setup.conditions(CLEAN)[0], frames, setup.views
        if not missing:
            return rows
        with mapping(work, workers, cluster) as mapped:
            for axis in missing:
                tasks = [(condition, name) for condition in setup.conditions(axis) for name in condition.objects]
                frames.make_room(len(tasks) * len(setup.views) * len(setup.method.frames_used) * setup.size**2)
                rows[axis] = []
                for views in mapped(_measure_object, *zip(*tasks, strict=True)):
                    rows[axis] += views
                    progress(axis, len(views))
                content = {"setup": setup.key(), "axis": axis, "views": rows[axis]}
                write_atomically(files[axis], (json.dumps(content, indent=1) + "\n").encode())
                saved()
        return {axis: rows[axis] for axis in files}


def _measure_object(work: Work, condition: Condition, name: str) -> list[View]:
    """The rows of an object's views in a condition, in a worker process."""
    method, clean, cache, views = work
    rules, rows = corruptions(), []
    for view in views:
        frames, truth = cache.frames(condition, name, view, method.frames_used), cache.truth(clean, name, view)
        if method.uses_ground_truth_mask:
            frames = [None if frame is None else frame * (truth.depth_mm > 0) for frame in frames]
        started = perf_counter()
        answer = method.answer(frames)
        seconds = perf_counter() - started
        scores = score(answer.depth, answer.sigma_mm, truth, rules)
        place = {"sample": sample_name(name, view), "object": name, "severity": condition.severity}
        rows.append({**place, "seconds": round(seconds, 4), **scores})
    return rows


def read_axis(file: Path) -> dict[str, Any] | None:
    """What an axis's file holds: ``setup``, ``axis``, ``views``; None where there is none. PredictionError for a
    damaged one."""
    if not file.exists():
        return None
    try:
        content: dict[str, Any] = read_json(file, PredictionError)
        views = content["views"]
        complete = bool(views) and all({"sample", "object", "severity", "mae_mm"} <= row.keys() for row in views)
        complete = complete and isinstance(content["setup"], dict) and isinstance(content["axis"], str)
    except (ValueError, KeyError, TypeError, AttributeError):
        complete = False
    if not complete:
        raise PredictionError(f"{file}: damaged; delete it and run the same command again")
    return content


def _rows(file: Path, key: Mapping[str, Any]) -> list[View] | None:
    """Rows of an axis that an earlier run of the same setup finished; None where there are none."""
    content = read_axis(file)
    if content is None:
        return None
    wanted = json.loads(json.dumps(key))
    other = [name for name in wanted if content["setup"].get(name) != wanted[name]]
    if other:
        raise PredictionError(
            f"{file}: holds another measurement (other {', '.join(other)}); give another folder, or delete it"
        )
    views: list[View] = content["views"]
    return views


def robustness(setup: Setup, rows: Mapping[str, Sequence[View]]) -> Robustness:
    """The block of ``result.json``. Raises PredictionError for a quick look, and where an axis is missing."""
    missing = [axis for axis in setup.axes(()) if axis not in rows]
    if setup.quick or missing:
        lacking = "a --quick look" if setup.quick else f"without {', '.join(missing)}"
        raise PredictionError(f"robustness is a mean over all axes and severities, and this is {lacking}")
    means = {
        axis: [SeverityScores.model_validate(scores) for scores in severity_means(found).values()]
        for axis, found in rows.items()
    }
    (clean,), axes = means[CLEAN], {axis: scores for axis, scores in means.items() if axis != CLEAN}
    sha256 = setup.method.settings.get("weights_sha256")
    found = object_interval(*_shares_of_the_mean(rows))
    every = [scores.mae_mm for severities in axes.values() for scores in severities]
    return Robustness(
        version=corruptions().version,
        set=setup.set_name,
        mae_mm=sum(every) / len(every),
        interval=[None, None] if found is None else [max(found[0], 0.0), found[1]],
        clean=clean,
        axes=axes,
        samples=len(rows[CLEAN]),
        objects=len({row["object"] for row in rows[CLEAN]}),
        size_px=setup.size,
        weights_sha256=sha256 if isinstance(sha256, str) else None,
    )


def _shares_of_the_mean(rows: Mapping[str, Sequence[View]]) -> tuple[list[float], list[str]]:
    """For each sample what it adds to the mean over axes and severities, times the number of samples, and its object:
    the mean of these numbers is that mean, also where an axis disturbs a few objects only."""
    objects = {row["sample"]: row["object"] for row in rows[CLEAN]}
    sums = dict.fromkeys(objects, 0.0)
    conditions = 0
    for views in (views for axis, views in rows.items() if axis != CLEAN):
        for severity in sorted({row["severity"] for row in views}):
            found = [row for row in views if row["severity"] == severity]
            conditions += 1
            for row in found:
                sums[row["sample"]] += (row["mae_mm"] or 0.0) * len(objects) / len(found)
    return [total / conditions for total in sums.values()], list(objects.values())
