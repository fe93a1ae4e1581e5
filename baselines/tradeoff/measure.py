"""Measuring every method on one machine: its error, and what it costs in time, frames and memory.

A point is a method with the options of one of its variants. Each is measured once and stored; a
stopped run continues where it stopped. A point that can't be measured says why, and the others are
measured.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path
from statistics import linear_regression, median
from time import perf_counter, process_time
from typing import Annotated, Any, Literal, get_args

import cv2
from pydantic import Field

from fpp_ml_bench import __version__
from fpp_ml_bench.baselines.method import Frames, Method, checked
from fpp_ml_bench.baselines.registry import (
    failure_in_file,
    find,
    load_method,
    methods,
    source_sha256,
)
from fpp_ml_bench.baselines.run import captured_frames
from fpp_ml_bench.baselines.timing import added_mib, check_batch, four_digits
from fpp_ml_bench.baselines.training.weights import open_weights, shipped_names, weights_path
from fpp_ml_bench.errors import DatasetError, FppBenchError, RigError, SubmissionError
from fpp_ml_bench.evaluation.result.file import write_json
from fpp_ml_bench.evaluation.result.parts import HardwareInfo
from fpp_ml_bench.evaluation.score.check import Rules
from fpp_ml_bench.evaluation.score.sample_scores import SampleScores, score_sample
from fpp_ml_bench.evaluation.score.uncertainty import mean_of
from fpp_ml_bench.files import LOCK_FILE, NAME_LIMIT, exclusive, printable, read_json
from fpp_ml_bench.loaders.render.meshes import solid_mesh
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.machine import describe_hardware
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.schema import (
    Count,
    NonNegative,
    Positive,
    Scalar,
    Share,
    StrictModel,
    Text,
    validate,
)

Cost = Literal["seconds", "frames", "working_memory_mib"]
COST_KEYS: tuple[Cost, ...] = get_args(Cost)
TRADEOFF_FILE = "tradeoff.json"
BATCH = 4
"""Views at most that are predicted in one batch, to see what a view costs among others."""
SHARES = (0.25, 0.5, 1.0)
"""Shares of the image's pixels at which a method is timed on a scene; four times as many where a
quarter of the pixels is too coarse for the fringes."""
OBJECT, VIEW = "power_drill", "A60"
"""That scene."""
RUNS, LIMIT_S = 5, 1.0
"""Timed runs of each view, fewer once these seconds are used up: a short run is timed badly."""
REASON_LENGTH = NAME_LIMIT - 3  # and "..."; what a file of the run may hold
_PACKAGE = f"{Path(__file__).resolve().parents[2]}/"
"""The package's folder, which is removed from messages that go into a result."""


class Point(StrictModel):
    """A ``method`` as `registry.find` takes it, with ``options``; ``source_sha256`` of the file
    that it comes from.

    ``seconds`` a view, the median, and a view of a batch of up to `BATCH`; ``working_memory_mib``
    that one prediction adds at its peak. ``object_mae_mm`` is the leaderboard's error, where an
    object pixel without a depth counts with its whole depth, and ``missing_share`` the share of
    such pixels, both means over the views. ``pixel_seconds``: on a scene at each of the run's
    ``pixels``. ``off_front_reason``: why it is on no front. ``failed``: why it, or its time at
    other sizes, could not be measured."""

    method: Text
    options: dict[Text, Scalar]
    source_sha256: Text | None = None
    title: Text | None = None
    software: dict[Text, Text] | None = None
    off_front_reason: Text | None = None
    frames: Count = 0
    seconds: Positive | None = None
    batch_seconds: Positive | None = None
    working_memory_mib: NonNegative | None = None
    object_mae_mm: NonNegative | None = None
    missing_share: Share | None = None
    pixel_seconds: list[Positive] | None = None
    failed: Text | None = None

    @property
    def key(self) -> str:
        """Tells it from the other points of a run."""
        return f"{self.method} {self.options}"

    @property
    def label(self) -> str:
        """The method's name and options, as short as a table needs them."""
        said = [
            name if value is True else f"{name}={value}" for name, value in self.options.items()
        ]
        return " ".join([Path(self.method).name, *said])


class Tradeoff(StrictModel):
    """A whole run: the data, its ``settings``, the machine, and the points."""

    tradeoff_schema_version: Literal["2.0.0"] = "2.0.0"
    dataset: Text
    fingerprint: Text
    image_size: Annotated[list[Count], Field(min_length=2, max_length=2)]
    target: Text
    views: list[Text]
    settings: dict[Text, Scalar]
    hardware: HardwareInfo
    pixels: list[Count]
    points: list[Point]

    def front(self, cost: Cost) -> list[Point]:
        """The points that no other beats in both ``cost`` and object MAE, the cheapest first. Of
        those that have both, above 0, and are not `Point.off_front_reason`."""
        points = [
            point
            for point in self.points
            if not point.off_front_reason and point.object_mae_mm and getattr(point, cost)
        ]
        return [
            points[i]
            for i in pareto_front([(getattr(p, cost), p.object_mae_mm or 0) for p in points])
        ]


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the ``points`` (cost, error) that no other beats (as good in both, better in one),
    by cost. Smaller is better. Points that are equal in both are all on the front or all off it."""
    front: list[int] = []
    for index in sorted(range(len(points)), key=points.__getitem__):
        if (
            not front
            or points[index][1] < points[front[-1]][1]
            or points[index] == points[front[-1]]
        ):
            front.append(index)
    return front


def power(costs: Iterable[tuple[float, float]]) -> float | None:
    """The power p of seconds = c amount^p by least squares of the logarithms of ``costs``, (amount,
    seconds); those with a 0 are left out. None where all amounts are equal."""
    known = [cost for cost in costs if all(cost)]
    logarithms = zip(*([math.log(value) for value in cost] for cost in known), strict=True)
    return (
        linear_regression(*logarithms).slope if len({amount for amount, _ in known}) > 1 else None
    )


def read_tradeoff(path: Path) -> Tradeoff:
    """A ``tradeoff.json``, read strictly. SubmissionError names the file and what is wrong with
    it."""
    content = read_json(path, SubmissionError, "measure again into another --out")
    return validate(
        Tradeoff,
        content,
        path,
        "file of this version's fpp-bench tradeoff (measure into another --out)",
    )


@dataclass
class Plan:
    """The ``points`` to measure, still without numbers, on ``views`` of a dataset, and where the
    results go. ``clock``: "wall", or "processor" for the processor time of this process, which
    other work on the machine does not change."""

    opened: DatasetFolder
    out: Path
    views: list[str]
    points: list[Point]
    threads: int
    clock: str

    @property
    def target(self) -> str:
        """What is scored against: the exact depth where it is known."""
        return "depth_exact" if self.opened.has_exact else "depth"

    @cached_property
    def rigs(self) -> list[Rig]:
        """The dataset's rig at each size that methods are timed at."""
        rig, times = self.opened.rig, 1
        try:
            rig.scaled(rig.camera.width // 2).check_sampling()
        except RigError:
            times = 4
        return [rig.scaled(round(rig.camera.width * math.sqrt(times * share))) for share in SHARES]

    @cached_property
    def scenes(self) -> list[Frames]:
        """All frames of the scene at each size, rendered into memory."""
        mesh, studios = (
            solid_mesh(OBJECT),
            [Studio(BuildSettings(rig, (OBJECT,))) for rig in self.rigs],
        )
        rows = [studio.photograph(mesh, VIEW) for studio in studios]
        return [[row.frames[index] for index in range(len(self.opened.sequence))] for row in rows]

    def load(self, point: Point, source: DatasetFolder | Rig) -> Method:
        """The method of ``point``, with the run's threads where it takes them."""
        has_threads = "threads" in {
            field.name for field in fields(find(point.method).method.Options)
        }
        options: dict[str, Any] = dict(point.options)
        if has_threads:
            options["threads"] = self.threads
        return load_method(point.method, source, **options)

    def timed(self, call: Callable[..., Any], *given: Any) -> tuple[float, Any]:
        """Median seconds of a call, of `RUNS` or of fewer once `LIMIT_S` is used up, after one that
        is not counted and whose result is the second value."""
        clock = perf_counter if self.clock == "wall" else process_time
        result, runs = call(*given), list[float]()
        while len(runs) < RUNS and sum(runs) < LIMIT_S:
            started = clock()
            call(*given)
            runs.append(clock() - started)
        return median(runs), result


def planned(
    dataset: Path,
    out: Path,
    names: Sequence[str] = (),
    views: int = 2,
    threads: int = 1,
    clock: str = "wall",
) -> Plan:
    """The plan of a run that measures methods by ``names`` as `registry.find` takes them, without
    any all that `registry.methods` lists and the shipped networks of the image's size, on ``views``
    of each test object. Raises `DatasetError` for a folder that is no dataset or has no test split,
    `PredictionError` for an unknown method."""
    opened, points = DatasetFolder(dataset), []
    for name in names or [*methods(), *_networks(opened.size)]:
        method, path = find(name).method, Path(name)
        digest = sha256(path.read_bytes()).hexdigest() if path.is_file() else source_sha256(method)
        variants = method.variants(opened.rig)
        if names and not variants:
            variants = [{}]  # it was asked for: the point says why it can't be measured
        points += [
            Point(method=name, options=dict(options), source_sha256=digest) for options in variants
        ]
    return Plan(opened, out, choose_views(opened, views), points, threads, clock)


def _networks(size: tuple[int, int]) -> list[str]:
    """Names of the shipped networks from image to depth that were trained for images of ``size``
    (H, W)."""
    names = shipped_names()
    return [name for name in names if open_weights(weights_path(name)).config.image_size == size]


def choose_views(opened: DatasetFolder, per_object: int, split: str = "test") -> list[str]:
    """``per_object`` views of each object of ``split``, spread over its views, in row order.
    `DatasetError` for a split without samples."""
    samples_by_object = opened.samples_by_object(split)
    if not samples_by_object:
        raise DatasetError(
            f"{opened.path}: split {split} holds no sample; there is nothing to measure"
        )
    chosen: list[str] = []
    for number, names in enumerate(samples_by_object.values()):
        # Each object begins one view later, so that the views differ between objects.
        places = {
            (number + place * len(names) // per_object) % len(names) for place in range(per_object)
        }
        chosen += [names[place] for place in sorted(places)]
    return chosen


def tradeoff(plan: Plan, progress: Callable[[str], object] = lambda label: None) -> Tradeoff:
    """Measure what the ``tradeoff.json`` in the plan's folder lacks, calling ``progress`` with the
    label of each point before it is measured; what it has of other methods stays. Raises BuildError
    when another process works in the same folder, SubmissionError for a file of other data,
    settings or of another machine."""
    path, opened = plan.out / TRADEOFF_FILE, plan.opened
    cv2.setNumThreads(plan.threads)  # the phase route's filters take all threads by default
    run = Tradeoff(
        dataset=opened.path.resolve().name,
        fingerprint=opened.fingerprint,
        image_size=list(opened.size),
        target=plan.target,
        views=plan.views,
        settings={"package": __version__, "threads": plan.threads, "clock": plan.clock},
        hardware=HardwareInfo.model_validate(describe_hardware().to_dict()),
        pixels=[rig.camera.width * rig.camera.height for rig in plan.rigs],
        points=[],
    )
    with exclusive(plan.out / LOCK_FILE, plan.out, "measuring into this folder"):
        points = {point.key: point for point in _points_before(path, run)}
        for wanted in plan.points:
            progress(wanted.label)
            earlier = points.get(wanted.key, wanted)
            # A point that failed is tried again: a package may have been installed since.
            if earlier.seconds is None or earlier.source_sha256 != wanted.source_sha256:
                points[wanted.key] = measured(plan, wanted)
            run = run.model_copy(update={"points": list(points.values())})
            write_json(run.model_dump(mode="json"), path)
    return run


def _points_before(path: Path, run: Tradeoff) -> list[Point]:
    """The points in the file ``path`` that ``run`` continues. SubmissionError for one of other
    data, settings or of another machine: costs are only compared within a run."""
    if not path.exists():
        return []
    earlier = read_tradeoff(path)
    for key in ("fingerprint", "views", "settings", "hardware"):
        there, here = getattr(earlier, key), getattr(run, key)
        if there != here:
            raise SubmissionError(
                f"{path}: holds a run with another {key} ({there} there, {here} now); costs are "
                f"only compared within "
                "one run: give another --out"
            )
    return earlier.points


def measured(plan: Plan, point: Point) -> Point:
    """``point`` with its numbers. An error of the package (a frame is not stored, weights are
    missing), or in the user's own file, becomes its ``failed``, and the run goes on."""
    figures = point.model_dump(include={"method", "options", "source_sha256"})
    try:
        method = plan.load(point, plan.opened)
        given = ["depth range"] * method.uses_ground_truth_range + [
            "object mask"
        ] * method.uses_ground_truth_mask
        if given or find(point.method).method.trivial:
            figures["off_front_reason"] = (
                f"given the view's {' and '.join(given)}" if given else "trivial"
            )
        figures |= _figures(plan, method)
        pixel_seconds = []
        for rig, frames in zip(plan.rigs, plan.scenes, strict=True):
            pixel_seconds.append(four_digits(plan.timed(plan.load(point, rig).answer, frames)[0]))
        figures["pixel_seconds"] = pixel_seconds
    except Exception as error:
        reason = str(error) if isinstance(error, FppBenchError) else failure_in_file(error)
        if reason is None:
            raise
        figures["failed"] = printable(
            " ".join(reason.split()).replace(_PACKAGE, ""), REASON_LENGTH
        )[:NAME_LIMIT]
    return Point(**figures)


def _figures(plan: Plan, method: Method) -> dict[str, Any]:
    """Errors, seconds and memory of ``method`` on the plan's views, as fields of a `Point`. Frames
    are in memory before the clock starts."""
    opened, rules = plan.opened, Rules(plan.target, method.units, method.range_rule, method.mode)
    seconds, scored = list[float](), list[SampleScores]()
    memory_mib = None
    for name in plan.views:
        frames = captured_frames(opened, method, name)
        run_s, answer = plan.timed(method.answer, frames)
        depth = checked(answer, opened.size, name).depth
        if not seconds:
            memory_mib = added_mib(partial(method.answer, frames))
        seconds.append(run_s)
        scored.append(score_sample(*rules.pair(depth, opened, name), void=rules.void(opened, name)))
    batch = [captured_frames(opened, method, name) for name in plan.views[:BATCH]]
    check_batch(method, batch)
    return {
        "title": method.title,
        "software": method.software,
        "frames": len(method.frames_used),
        "seconds": four_digits(median(seconds)),
        "batch_seconds": four_digits(plan.timed(method.predict_batch, batch)[0] / len(batch)),
        "working_memory_mib": memory_mib,
        "object_mae_mm": mean_of(sample.object.mae_mm for sample in scored),
        "missing_share": mean_of(
            sample.missing / sample.object.pixels for sample in scored if sample.object.pixels
        ),
    }
