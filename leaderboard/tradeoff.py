"""Error against run time and against captures: every setting of every method on one machine, and what each stage costs
as its input grows.

A setting is measured once and kept; a stopped run goes on. What can't be measured (a frame that is not stored, a
package that is not installed) says so in its row and keeps nothing else from being measured.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from platform import python_version
from typing import Any

from fpp_ml_bench import __version__
from fpp_ml_bench.evaluation.timing import HardwareInfo
from fpp_ml_bench.hardware import describe_hardware
from fpp_ml_bench.leaderboard.tradeoff_clock import Clock, Rules
from fpp_ml_bench.leaderboard.tradeoff_journal import Journal
from fpp_ml_bench.leaderboard.tradeoff_ladder import Ladder, climb
from fpp_ml_bench.leaderboard.tradeoff_measure import Setting, measured
from fpp_ml_bench.leaderboard.tradeoff_points import COSTS, GROUPS, Tradeoff
from fpp_ml_bench.leaderboard.tradeoff_settings import (
    classical_settings,
    phase_settings,
    precision_settings,
    size_settings,
)
from fpp_ml_bench.leaderboard.tradeoff_views import StoredViews, some_views
from fpp_ml_bench.loaders.folder_lock import exclusive
from fpp_ml_bench.loaders.store import DatasetFolder

VIEWS_AN_OBJECT, QUICK_VIEWS = 2, 1
QUICK_RULES = {"runs": 5, "limit_s": 1.0}
Progress = Callable[[str], object]


@dataclass(frozen=True)
class Wish:
    """What was asked for: ``only`` these groups (of `GROUPS` and `COSTS`; empty: all), ``runs`` with more trainings,
    ``widths`` of untrained UNets (None: the usual), ``views`` of each test object (None: the usual)."""

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
        """The groups asked for, in their order."""
        return tuple(group for group in (*GROUPS, COSTS) if not self.only or group in self.only)

    @property
    def rules(self) -> Rules:
        """How often each setting is run."""
        return Rules(self.clock, self.threads, **(QUICK_RULES if self.quick else {}))  # type: ignore[arg-type]


@dataclass(frozen=True)
class Plan:
    """What there is to measure."""

    opened: DatasetFolder
    views: StoredViews
    settings: list[Setting]
    ladders: list[Ladder]

    def __len__(self) -> int:
        return len(self.settings) + len(self.ladders)


def planned(wish: Wish) -> Plan:
    """Everything of ``wish``, nothing measured yet. Raises DatasetError for a folder that is no dataset or has no test
    split, WeightsError for runs that are none."""
    opened = DatasetFolder(wish.dataset)
    views = some_views(opened, wish.views or (QUICK_VIEWS if wish.quick else VIEWS_AN_OBJECT))
    settings = [setting for group in wish.groups for setting in _settings(group, views, wish)]
    return Plan(opened, views, settings, list(_ladders(views, wish)))


def _settings(group: str, views: StoredViews, wish: Wish) -> Iterator[Setting]:
    if group == "classical":
        yield from classical_settings(views, wish.threads, wish.quick)
    elif group == "phase":
        yield from phase_settings(views, wish.quick)
    elif group == "precision":
        yield from precision_settings(views, wish.quick)
    elif group == "sizes":
        yield from size_settings(views.rig, wish.threads, wish.quick)
    elif group == "networks":
        from fpp_ml_bench.leaderboard.tradeoff_networks import network_settings

        yield from network_settings(views, wish.threads, wish.runs, wish.widths, wish.quick)


def _ladders(views: StoredViews, wish: Wish) -> Iterator[Ladder]:
    if COSTS in wish.groups:
        from fpp_ml_bench.leaderboard.tradeoff_ladders import frame_ladders, pixel_ladders
        from fpp_ml_bench.leaderboard.tradeoff_ladders_rows import row_ladders

        yield from row_ladders(views.rig, wish.quick)
        yield from frame_ladders(views.rig, wish.quick)
        yield from pixel_ladders(views.rig, wish.quick)


def tradeoff(wish: Wish, plan: Plan, progress: Progress = lambda done: None) -> Tradeoff:
    """Measure what is missing of ``plan`` into ``wish.out``, calling ``progress`` with the name of each setting and
    ladder before its turn.

    Raises BuildError when another process works in the same folder, SubmissionError for a folder with a run of other
    rules or of another machine.
    """
    about = _about(wish, plan)
    _limit_threads(wish.threads)
    with exclusive(wish.out / ".lock", wish.out, "measuring into this folder"):
        journal = Journal(wish.out, about)
        for setting in plan.settings:
            progress(setting.key)
            if setting.key not in journal.points:
                journal.add_point(measured(setting, wish.rules))
        for ladder in plan.ladders:
            progress(ladder.key)
            if ladder.key not in journal.growth:
                journal.add_growth(ladder.key, climb(ladder, wish.rules))
    return Tradeoff(
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        dataset=plan.opened.path.resolve().name,
        fingerprint=plan.opened.fingerprint,
        image_size=list(plan.opened.size),
        target=plan.views.target,
        views=list(plan.views.names),
        settings={**asdict(wish.rules), "quick": wish.quick, "views_an_object": _views_an_object(plan)},
        hardware=HardwareInfo.model_validate(describe_hardware().to_dict()),
        software=_software(),
        sittings=journal.sittings,
        # All that this folder holds, so that a group measured on its own adds to those before.
        points=sorted(journal.points.values(), key=lambda point: GROUPS.index(point.group)),
        growth=[one for found in journal.growth.values() for one in found],
    )


def _views_an_object(plan: Plan) -> int:
    objects = plan.views.objects
    return max(objects.count(name) for name in objects)


def _about(wish: Wish, plan: Plan) -> dict[str, Any]:
    """What two sittings of one run must share. The groups need not be the same: one may be added to another."""
    machine = describe_hardware()
    return {
        "tradeoff": 1,
        "package": __version__,
        "dataset": plan.opened.fingerprint,
        "views": list(plan.views.names),
        "rules": asdict(wish.rules),
        "cpu": machine.cpu,
        "cores": machine.cores,
    }


def _limit_threads(threads: int) -> None:
    """OpenCV's threads, which the phase route's filters would take all of; torch's are set where torch is loaded."""
    import cv2

    cv2.setNumThreads(threads)


def _software() -> dict[str, str]:
    found = {"fpp_ml_bench": __version__, "python": python_version()}
    for package in ("numpy", "numba", "torch", "onnxruntime"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
