"""What `fpp-bench tradeoff` measures, as strict models: a point for each setting, a growth for each stage, fronts; and
the journal from which a stopped run continues.

``object_mae_mm`` is the leaderboard's error: an object pixel without a depth counts with its whole depth.
``measured_mae_mm`` is over the pixels that got a depth, and ``missing_share`` is the share that did not.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import Field

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.result import HardwareInfo, read_json, write_json
from fpp_ml_bench.schema import Count, NonNegative, Positive, Scalar, Share, StrictModel, Text, validate

Group = Literal["classical", "phase", "networks", "precision", "sizes"]
GROUPS: tuple[Group, ...] = get_args(Group)
COSTS = "costs"
"""The group of `Growth`, which compares no methods."""
Cost = Literal["seconds", "frames"]
COST_KEYS: tuple[Cost, ...] = get_args(Cost)
ErrorKey = Literal["object_mae_mm", "measured_mae_mm"]
SLOWED = 1.25
"""A setting is marked when the machine ran slower by this factor beside it than in the run's median."""
MOST_LEFT_OUT = 0.05
"""Share of the object's pixels without a depth up to which an error over the others is compared."""
TRADEOFF_FILE, JOURNAL = "tradeoff.json", "measured.json"


class Point(StrictModel):
    """A setting: ``seconds`` per view (median, 5th, 95th percentile over ``runs``), errors in mm as means over views.
    ``interval_mm``: 95% interval of ``object_mae_mm``, from a bootstrap over objects. ``given``: what the method was
    told about the views that it is scored on. ``failed``: why there is no measurement; there are no numbers then.
    ``pace_ms``: time of a fixed piece of work measured beside it, ``load``: the system's one-minute load average."""

    key: Text
    group: Group
    title: Text
    frames: Count = 0
    image_px: Count = 0
    runs: Count = 0
    seconds: Positive | None = None
    seconds_p5: Positive | None = None
    seconds_p95: Positive | None = None
    object_mae_mm: NonNegative | None = None
    interval_mm: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    measured_mae_mm: NonNegative | None = None
    missing_share: Share | None = None
    parameters: Count = 0
    given: Text | None = None
    note: Text | None = None
    failed: Text | None = None
    pace_ms: Positive | None = None
    load: NonNegative | None = None

    @property
    def ms(self) -> tuple[float, float, float]:
        """Median, 5th and 95th percentile of the time per view in ms, 0 where it is not known."""
        return 1000 * (self.seconds or 0), 1000 * (self.seconds_p5 or 0), 1000 * (self.seconds_p95 or 0)


class Growth(StrictModel):
    """Seconds of one stage (the least of several runs) at ``amounts`` of pixels, frames, objects or rows, and the
    fitted power: see `fpp_ml_bench.baselines.tradeoff.ladders`."""

    stage: Text
    over: Text
    amounts: list[Positive]
    seconds: list[Positive]
    exponent: float
    low: float
    high: float
    tail: float
    flag: Text | None = None


class Tradeoff(StrictModel):
    """A whole run: the data, the rules and options (``settings``), the machine, and the results. ``sittings``: how
    often it was started or continued; times of different sittings may differ by more than the pace shows."""

    tradeoff_schema_version: Literal["1.0.0"] = "1.0.0"
    created: Text
    dataset: Text
    fingerprint: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    image_size: Annotated[list[Count], Field(min_length=2, max_length=2)]
    target: Text
    views: list[Text]
    settings: dict[Text, Scalar]
    hardware: HardwareInfo
    software: dict[Text, Text]
    sittings: Count
    points: list[Point]
    growth: list[Growth]

    @property
    def pace_ms(self) -> list[float]:
        """The pace beside each point, ascending."""
        return sorted(point.pace_ms for point in self.points if point.pace_ms is not None)

    @property
    def loads(self) -> list[float]:
        """The system's load beside each point, ascending."""
        return sorted(point.load for point in self.points if point.load is not None)

    @property
    def clock(self) -> str:
        """What the times are of, in words."""
        return "processor time" if self.settings.get("clock") == "processor" else "wall-clock time"

    def slowed(self, point: Point) -> bool:
        """Whether the machine was slower beside ``point`` by the factor `SLOWED` than in the run's median."""
        paces = self.pace_ms
        return point.pace_ms is not None and point.pace_ms > SLOWED * paces[len(paces) // 2]

    def comparable(self, error: ErrorKey = "object_mae_mm") -> list[Point]:
        """Points that may be on a front: measured on the dataset's own views, with an error above 0, told nothing. The
        precisions repeat the classical method's arithmetic and are left out; for the error over measured pixels, so are
        points that leave out more than `MOST_LEFT_OUT` of the object: that must not gain them anything."""
        points = [point for point in self.points if point.group not in ("precision", "sizes") and not point.given]
        if error == "measured_mae_mm":
            points = [point for point in points if (point.missing_share or 0) <= MOST_LEFT_OUT]
        return [point for point in points if point.seconds and getattr(point, error)]

    def front(self, cost: Cost = "seconds", error: ErrorKey = "object_mae_mm") -> list[Point]:
        """The comparable points that no other beats in both cost and error, the cheapest first."""
        points = sorted(self.comparable(error), key=lambda point: point.key)
        return [points[i] for i in pareto_front([(float(getattr(p, cost)), getattr(p, error)) for p in points])]


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the ``points`` (cost, error) that no other beats (as good in both, better in one), by cost. Smaller is
    better. Points that are equal in both are all on the front or all off it."""
    front: list[int] = []
    for index in sorted(range(len(points)), key=points.__getitem__):
        if not front or points[index][1] < points[front[-1]][1] or points[index] == points[front[-1]]:
            front.append(index)
    return front


def read_tradeoff(path: Path) -> Tradeoff:
    """A ``tradeoff.json``, read strictly. SubmissionError names the file and what is wrong with it."""
    return validate(Tradeoff, read_json(path), path, "tradeoff file")


def shipped_tradeoff() -> Tradeoff:
    """The trade-off that ships with the package and is shown on the leaderboard's page."""
    return read_tradeoff(Path(__file__).with_name(TRADEOFF_FILE))


class Journal(StrictModel):
    """What the run that ``about`` describes has measured: points by key, growth by ladder, and how often it was
    started."""

    about: dict[Text, Any]
    sittings: Count = 1
    points: dict[Text, Point] = Field(default_factory=dict)
    growth: dict[Text, list[Growth]] = Field(default_factory=dict)

    @classmethod
    def of(cls, path: Path, about: dict[str, Any]) -> "Journal":
        """The journal in ``path`` for another sitting, or a new one. Points that failed are forgotten: a package may
        have been installed since. SubmissionError for one of other rules or of another machine: times are only
        compared within a run."""
        if not path.exists():
            return cls(about=about)
        try:
            earlier: Journal = validate(cls, read_json(path), path, "journal of a trade-off")
        except SubmissionError as error:
            expected = "expected what a run of fpp-bench tradeoff left: give another --out"
            raise SubmissionError(f"{error}; {expected}") from None
        first = earlier.about
        if differs := sorted(key for key in {**first, **about} if first.get(key) != about.get(key)):
            key = differs[0]
            raise SubmissionError(
                f"{path}: holds a run with another {', '.join(differs)} ({key}: {first.get(key)!r} there, "
                f"{about.get(key)!r} now); times are only compared within one run: give another --out"
            )
        measured = {key: point for key, point in earlier.points.items() if point.failed is None}
        return earlier.model_copy(update={"points": measured, "sittings": earlier.sittings + 1})

    def write(self, path: Path) -> None:
        write_json(self.model_dump(mode="json", exclude_none=True), path)
