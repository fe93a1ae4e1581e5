"""Measures a method axis by axis: predicts disturbed views in several processes, writes a file for
each finished axis, and summarises them: means by severity, the mean over all of them, its interval,
and the page of all methods."""

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from fpp_ml_bench import __version__
from fpp_ml_bench.baselines.method import Method, checked
from fpp_ml_bench.baselines.robustness.axes import (
    CLEAN,
    SETS,
    Condition,
    FrameCache,
    SetName,
    corruptions,
    score,
    severity_means,
)
from fpp_ml_bench.constants import sample_name
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.result.parts import Robustness, SeverityScores
from fpp_ml_bench.evaluation.score.uncertainty import mean_of, object_interval
from fpp_ml_bench.files import LOCK_FILE, exclusive, read_json, write_atomically
from fpp_ml_bench.pool import mapping
from fpp_ml_bench.style import LINE, LINE_COLOURS, data_uri, page, panels, styled, with_legend

QUICK_SEVERITIES = (1, 3, 5)
"""Severities of a quick run: both ends and the middle show a curve's course."""
SEVERITIES = (1, 2, 3, 4, 5)
PAGE, CURVES = "index.html", "curves.png"
_DASHES = ("-", "--", ":")
View = dict[str, Any]
"""A row of a view: sample, object, severity, seconds, and `SCORES`."""
Work = tuple[Method, Condition, FrameCache, tuple[str, ...]]
"""A method, the clean scene, rendered frames, and the views of each object."""


@dataclass(frozen=True)
class Setup:
    """A method on a set, at an image size. ``quick``: one view of each object and three severities,
    for a look."""

    method: Method
    set_name: SetName
    size: int
    quick: bool = False

    def __post_init__(self) -> None:
        if self.method.units != "mm":
            raise PredictionError(
                f"{self.method.title}: predicts normalised depth; robustness is measured in mm, "
                f"which networks of raw "
                "or global normalisation predict"
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
        return [
            CLEAN,
            *(name for name, axis in chosen.items() if axis.applies(SETS[self.set_name], frames)),
        ]

    def conditions(self, axis: str) -> list[Condition]:
        """Those of an axis of `corruptions`, or of `CLEAN`, on the objects of the set that it
        disturbs."""
        objects, severities = tuple(SETS[self.set_name]), self.severities
        if axis == CLEAN:
            severities = (0,)
        else:
            objects = corruptions().axes[axis].seen_on(objects)
        rig = self.method.scenes_rig(self.method.settings)
        return [Condition(axis, severity, objects, self.size, rig) for severity in severities]

    @property
    def drawn(self) -> list[str]:
        """The axes that the lights which the method learned from disturbed too."""
        recipe = getattr(self.method.weights_config, "recipe", {})
        if "held_out" not in recipe:
            return []
        held_out, axes = recipe["held_out"], corruptions().axes.items()
        return [name for name, axis in axes if axis.drawn and name not in held_out]

    def key(self) -> dict[str, Any]:
        """What must be equal for two measurements to be parts of one."""
        return {
            "fpp_ml_bench": __version__,
            "axes_version": corruptions().version,
            "set": self.set_name,
            "size": self.size,
            "quick": self.quick,
            "method": self.method.name,
            "title": self.method.title,
            "frames_used": list(self.method.frames_used),
            "settings": self.method.settings_of_depth,
            "drawn": self.drawn,
        }


def measure(
    setup: Setup,
    out: Path,
    axes: Sequence[str] = (),
    workers: int = 1,
    cache: Path | None = None,
    progress: Callable[[int], None] = lambda views: None,
    cluster: str | None = None,
    saved: Callable[[], None] = lambda: None,
) -> dict[str, list[View]]:
    """The rows of every view by axis, and a file ``out/AXIS.json`` for each axis as soon as it is
    finished; files that an earlier run of the same setup left are read instead. Views are predicted
    and scored by so many processes, or by the Ray cluster at an address. ``progress`` is called
    with a number of views, ``saved`` after each file. Raises PredictionError for files of another
    setup, `BuildError` where another process is at it, `PoolError`."""
    with exclusive(out / LOCK_FILE, out, "measuring there"):
        files = {axis: out / f"{axis}.json" for axis in setup.axes(axes)}
        kept = {axis: read_axis(file, setup.key()) for axis, file in files.items()}
        rows = {axis: content["views"] for axis, content in kept.items() if content is not None}
        for kept_views in rows.values():
            progress(len(kept_views))
        missing = [axis for axis in files if axis not in rows]
        frames = FrameCache(cache)
        work = setup.method, setup.conditions(CLEAN)[0], frames, setup.views
        if not missing:
            return rows
        with mapping(work, workers, cluster) as mapped:
            for axis in missing:
                tasks = [
                    (condition, name)
                    for condition in setup.conditions(axis)
                    for name in condition.objects
                ]
                frames.make_room(
                    len(tasks) * len(setup.views) * len(setup.method.frames_used) * setup.size**2
                )
                rows[axis] = []
                for views in mapped(_measure_object, *zip(*tasks, strict=True)):
                    rows[axis] += views
                    progress(len(views))
                content = {"setup": setup.key(), "axis": axis, "views": rows[axis]}
                write_atomically(files[axis], (json.dumps(content, indent=1) + "\n").encode())
                saved()
        return {axis: rows[axis] for axis in files}


def _measure_object(work: Work, condition: Condition, name: str) -> list[View]:
    """The rows of an object's views in a condition, in a worker process."""
    method, clean, cache, views = work
    rules, charge_mm, rows = corruptions(), clean.settings.rig.half_range_mm, []
    for view in views:
        frames, truth = (
            cache.frames(condition, name, view, method.frames_used),
            cache.truth(clean, name, view),
        )
        if method.uses_ground_truth_mask:
            frames = [None if frame is None else frame * (truth.depth_mm > 0) for frame in frames]
        started = perf_counter()
        answer = method.answer(frames)
        seconds = perf_counter() - started
        checked(answer, truth.depth_mm.shape, method.title)
        scores = score(answer.depth, answer.sigma_mm, truth, rules, charge_mm)
        place = {"sample": sample_name(name, view), "object": name, "severity": condition.severity}
        rows.append({**place, "seconds": round(seconds, 4), **scores})
    return rows


def read_axis(file: Path, setup: Mapping[str, Any] | None = None) -> dict[str, Any] | None:
    """What an axis's file holds: ``setup``, ``axis``, ``views``; None where there is none.
    PredictionError for a damaged one, and for that of another ``setup``."""
    if not file.exists():
        return None
    try:
        content: dict[str, Any] = read_json(file, PredictionError)
        views = content["views"]
        complete = bool(views) and all(
            {"sample", "object", "severity", "mae_mm"} <= row.keys() for row in views
        )
        complete = (
            complete and isinstance(content["setup"], dict) and isinstance(content["axis"], str)
        )
    except (ValueError, KeyError, TypeError, AttributeError):
        complete = False
    if not complete:
        raise PredictionError(f"{file}: damaged; delete it and run the same command again")
    wanted = json.loads(json.dumps(setup or {}))
    if other := [name for name in wanted if content["setup"].get(name) != wanted[name]]:
        raise PredictionError(
            f"{file}: holds another measurement (other {', '.join(other)}); give another folder, "
            f"or delete it"
        )
    return content


def robustness(setup: Setup, rows: Mapping[str, Sequence[View]]) -> Robustness:
    """The block of ``result.json``. Raises PredictionError for a quick look, and where an axis is
    missing."""
    missing = [axis for axis in setup.axes(()) if axis not in rows]
    if setup.quick or missing:
        lacking = "a --quick look" if setup.quick else f"without {', '.join(missing)}"
        raise PredictionError(
            f"robustness is a mean over all axes and severities, and this is {lacking}"
        )
    axes = {
        axis: [SeverityScores.model_validate(scores) for scores in severity_means(views).values()]
        for axis, views in rows.items()
    }
    (clean,) = axes.pop(CLEAN)
    beside = {
        name: axes.pop(name)
        for name, axis in corruptions().axes.items()
        if axis.beside and name in axes
    }
    interval = object_interval(*_shares_of_the_mean({axis: rows[axis] for axis in (CLEAN, *axes)}))
    every = [scores.mae_mm for severities in axes.values() for scores in severities]
    return Robustness(
        version=corruptions().version,
        set=setup.set_name,
        mae_mm=sum(every) / len(every),
        interval=[None, None] if interval is None else [max(interval[0], 0.0), interval[1]],
        clean=clean,
        axes=axes,
        beside=beside,
        drawn=setup.drawn,
        samples=len(rows[CLEAN]),
        objects=len({row["object"] for row in rows[CLEAN]}),
        size_px=setup.size,
        weights_sha256=setup.method.weights_sha256,
    )


def _shares_of_the_mean(rows: Mapping[str, Sequence[View]]) -> tuple[list[float], list[str]]:
    """For each sample what it adds to the mean over axes and severities, times the number of
    samples, and its object: the mean of these numbers is that mean, also where an axis disturbs a
    few objects only."""
    objects = {row["sample"]: row["object"] for row in rows[CLEAN]}
    sums = dict.fromkeys(objects, 0.0)
    disturbed = [(axis, row) for axis, views in rows.items() if axis != CLEAN for row in views]
    sizes = Counter((axis, row["severity"]) for axis, row in disturbed)
    for axis, row in disturbed:
        sums[row["sample"]] += (row["mae_mm"] or 0.0) * len(objects) / sizes[axis, row["severity"]]
    return [total / len(sizes) for total in sums.values()], list(objects.values())


@dataclass(frozen=True)
class Measured:
    """A method's folder: what was measured, and mean scores by axis and severity."""

    folder: Path
    setup: dict[str, Any]
    means: dict[str, dict[int, dict[str, float | None]]]

    def mean(self, key: str = "mae_mm", axis: str | None = None) -> float | None:
        """Mean of a score over the severities of an axis, or of all that count, that were measured;
        None where one is unknown."""
        counted = (name for name, corruption in corruptions().axes.items() if not corruption.beside)
        axes = set(counted) if axis is None else {axis}
        values = [
            scores[key] for name, by in self.means.items() if name in axes for scores in by.values()
        ]
        return None if None in values else mean_of(values)


def read_measured(out: Path) -> list[Measured]:
    """Every method below ``out``, the best first. PredictionError for a damaged file."""
    measured = []
    for folder in sorted(path for path in out.iterdir() if path.is_dir()):
        files = [folder / f"{axis}.json" for axis in (CLEAN, *corruptions().axes)]
        contents = [content for file in files if (content := read_axis(file)) is not None]
        if contents:
            means = {content["axis"]: severity_means(content["views"]) for content in contents}
            measured.append(Measured(folder, contents[0]["setup"], means))
    return sorted(measured, key=lambda method: (method.mean() is None, method.mean() or 0.0))


def write_page(out: Path) -> Path:
    """Curves and page of all methods below ``out``; the page's path."""
    measured = read_measured(out)
    curves = draw_curves(measured)
    write_atomically(out / CURVES, curves)
    content = page(
        "fpp_ml_bench.baselines.robustness",
        "robustness.html",
        "Robustness: FPP-ML-Bench",
        methods=measured,
        axes=corruptions().axes,
        rules=corruptions(),
        curves=data_uri(curves),
        clean=CLEAN,
    )
    write_atomically(out / PAGE, content)
    return out / PAGE


@styled
def draw_curves(measured: Sequence[Measured]) -> bytes:
    """A panel for each axis: mean error against severity, a line a method; PNG."""
    rules = corruptions()
    axes = {
        name: axis
        for name, axis in rules.axes.items()
        if any(name in method.means for method in measured)
    }
    drawn, panels_of = panels([f"{name}, {axis.unit}" for name, axis in axes.items()], 4, 3.3, 2.9)
    for panel, (name, axis) in zip(panels_of, axes.items(), strict=True):
        for number, method in enumerate(measured):
            if name not in method.means:
                continue
            points = {0: method.means.get(CLEAN, {}).get(0, {}), **method.means[name]}
            label = method.setup["title"] + (", unseen" if method.setup["set"] == "unseen" else "")
            label += " (quick)" if method.setup["quick"] else ""
            style = "o" + _DASHES[number // len(LINE_COLOURS) % len(_DASHES)]
            errors = np.array([scores.get("mae_mm") for scores in points.values()], dtype=float)
            colour = LINE_COLOURS[number % len(LINE_COLOURS)]
            panel.plot(list(points), errors, style, color=colour, label=label, **LINE)
        panel.set(
            xticks=range(6), xticklabels=["clean", *(f"{value:g}" for value in axis.severities)]
        )
        panel.set(yscale="log", ylim=(0.1, 1000), ylabel="two-sided MAE, mm")
    return with_legend(drawn, 3)
