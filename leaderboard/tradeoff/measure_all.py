"""Error against run time and against captured frames: every setting of every method on one machine, and what each stage
costs as its input grows.

A setting is measured once and stored; a stopped run continues where it stopped. A setting that can't be measured (a
frame is not stored, a package is not installed) says why in its row, and the others are measured.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from platform import python_version
from typing import Any

from fpp_ml_bench import __version__
from fpp_ml_bench.evaluation.result import HardwareInfo
from fpp_ml_bench.files import exclusive
from fpp_ml_bench.leaderboard.tradeoff.clock import Clock, Rules
from fpp_ml_bench.leaderboard.tradeoff.journal import Journal
from fpp_ml_bench.leaderboard.tradeoff.ladder import Ladder, time_ladder
from fpp_ml_bench.leaderboard.tradeoff.measure import Setting, measured
from fpp_ml_bench.leaderboard.tradeoff.points import COSTS, GROUPS, Tradeoff
from fpp_ml_bench.leaderboard.tradeoff.settings import (
    classical_settings,
    phase_settings,
    precision_settings,
    size_settings,
)
from fpp_ml_bench.leaderboard.tradeoff.views import StoredViews, choose_views
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.machine import describe_hardware

VIEWS_AN_OBJECT, QUICK_VIEWS = 2, 1
QUICK_RULES = {"runs": 5, "limit_s": 1.0}
Progress = Callable[[str], object]


@dataclass(frozen=True)
class TradeoffSettings:
    """Settings of a run: ``only`` these groups (of `GROUPS` and `COSTS`; empty: all), ``runs``: a folder with further
    trainings, ``widths`` of untrained UNets and ``views`` of each test object (None: the defaults)."""

    dataset: Path
    out: Path
    only: Sequence[str] = ()
    quick: bool = False
    threads: int = 1
    clock: Clock = "wall"
    views: int | None = None
    runs: Path | None = None
    widths: Sequence[int] | None = None

    @property
    def groups(self) -> tuple[str, ...]:
        """The groups to measure, in their fixed order."""
        return tuple(group for group in (*GROUPS, COSTS) if not self.only or group in self.only)

    @property
    def rules(self) -> Rules:
        """How often each setting is run."""
        return Rules(self.clock, self.threads, **(QUICK_RULES if self.quick else {}))  # type: ignore[arg-type]


@dataclass(frozen=True)
class Plan:
    """The settings and ladders to measure, and the views."""

    opened: DatasetFolder
    views: StoredViews
    settings: list[Setting]
    ladders: list[Ladder]

    def __len__(self) -> int:
        return len(self.settings) + len(self.ladders)


def planned(settings: TradeoffSettings) -> Plan:
    """The plan of a run; nothing is measured yet. Raises DatasetError for a folder that is no dataset or has no test
    split, WeightsError for a ``runs`` that is no folder."""
    opened = DatasetFolder(settings.dataset)
    views = choose_views(opened, settings.views or (QUICK_VIEWS if settings.quick else VIEWS_AN_OBJECT))
    planned_settings = [setting for group in settings.groups for setting in _settings(group, views, settings)]
    return Plan(opened, views, planned_settings, list(_ladders(views, settings)))


def _settings(group: str, views: StoredViews, settings: TradeoffSettings) -> Iterator[Setting]:
    if group == "classical":
        yield from classical_settings(views, settings.threads, settings.quick)
    elif group == "phase":
        yield from phase_settings(views, settings.quick)
    elif group == "precision":
        yield from precision_settings(views, settings.quick)
    elif group == "sizes":
        yield from size_settings(views.rig, settings.threads, settings.quick)
    elif group == "networks":
        from fpp_ml_bench.leaderboard.tradeoff.networks import network_settings

        yield from network_settings(views, settings.threads, settings.runs, settings.widths, settings.quick)


def _ladders(views: StoredViews, settings: TradeoffSettings) -> Iterator[Ladder]:
    if COSTS in settings.groups:
        from fpp_ml_bench.leaderboard.tradeoff.ladders import frame_ladders, pixel_ladders
        from fpp_ml_bench.leaderboard.tradeoff.ladders_rows import row_ladders

        yield from row_ladders(views.rig, settings.quick)
        yield from frame_ladders(views.rig, settings.quick)
        yield from pixel_ladders(views.rig, settings.quick)


def tradeoff(settings: TradeoffSettings, plan: Plan, progress: Progress = lambda done: None) -> Tradeoff:
    """Measure what ``settings.out`` lacks of ``plan``, calling ``progress`` with the key of each setting and ladder
    before it is measured.

    Raises BuildError when another process works in the same folder, SubmissionError for a folder with a run of other
    rules or of another machine.
    """
    about = _about(settings, plan)
    _limit_threads(settings.threads)
    with exclusive(settings.out / ".lock", settings.out, "measuring into this folder"):
        journal = Journal(settings.out, about)
        for setting in plan.settings:
            progress(setting.key)
            if setting.key not in journal.points:
                journal.add_point(measured(setting, settings.rules))
        for ladder in plan.ladders:
            progress(ladder.key)
            if ladder.key not in journal.growth:
                journal.add_growth(ladder.key, time_ladder(ladder, settings.rules))
    return Tradeoff(
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        dataset=plan.opened.path.resolve().name,
        fingerprint=plan.opened.fingerprint,
        image_size=list(plan.opened.size),
        target=plan.views.target,
        views=list(plan.views.names),
        settings={**asdict(settings.rules), "quick": settings.quick, "views_an_object": _views_an_object(plan)},
        hardware=HardwareInfo.model_validate(describe_hardware().to_dict()),
        software=_software(),
        sittings=journal.sittings,
        # Everything in this folder, so that a group measured on its own adds to the earlier ones.
        points=sorted(journal.points.values(), key=lambda point: GROUPS.index(point.group)),
        growth=[growth for growths in journal.growth.values() for growth in growths],
    )


def _views_an_object(plan: Plan) -> int:
    objects = plan.views.objects
    return max(objects.count(name) for name in objects)


def _about(settings: TradeoffSettings, plan: Plan) -> dict[str, Any]:
    """What two sittings of a run must share. Their groups may differ: a later sitting can add a group."""
    hardware = describe_hardware()
    return {
        "tradeoff": 1,
        "package": __version__,
        "dataset": plan.opened.fingerprint,
        "views": list(plan.views.names),
        "rules": asdict(settings.rules),
        "cpu": hardware.cpu,
        "cores": hardware.cores,
    }


def _limit_threads(threads: int) -> None:
    """Limit OpenCV, whose filters in the phase route take all threads by default; torch is limited elsewhere."""
    import cv2

    cv2.setNumThreads(threads)


def _software() -> dict[str, str]:
    versions = {"fpp_ml_bench": __version__, "python": python_version()}
    for package in ("numpy", "numba", "torch", "onnxruntime"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions
