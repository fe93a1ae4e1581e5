"""``fpp-bench tradeoff``: error against run time and captured frames, and what each stage costs as its input grows."""

from pathlib import Path
from typing import Literal

from fpp_ml_bench.baselines import tradeoff
from fpp_ml_bench.cli.console import progress_bar, show
from fpp_ml_bench.cli.options import command, names, value, whole
from fpp_ml_bench.leaderboard import page
from fpp_ml_bench.options import argument, option

_GROUPS = ("classical", "phase", "networks", "precision", "sizes", "costs")


@command(
    """\
fpp-bench tradeoff data/full
fpp-bench tradeoff data/cpu224 --runs runs --out tradeoff-224
fpp-bench tradeoff data/mini --quick --only classical --only phase
fpp-bench tradeoff data/full --list
fpp-bench leaderboard --page page --tradeoff tradeoff/tradeoff.json
"""
)
def measure(
    *,
    dataset: Path = argument("dataset folder with all frames", "DATASET"),
    out: Path = option(
        Path("tradeoff"),
        "folder for the results, or the folder of a stopped run to continue (default: tradeoff)",
        "DIR",
    ),
    only: tuple[str, ...] = option(
        (),
        f"measure only this group; may be repeated: {', '.join(_GROUPS)} (default: all)",
        "GROUP",
        choices=_GROUPS,
        many=True,
    ),
    quick: bool = option(False, "fewer settings, views, runs and sizes"),
    listed: bool = option(False, "show what would be measured, and stop", flag="--list"),
    threads: int = option(1, "threads a method may use (default: 1)", "N", parse=whole(1, 1000)),
    clock: Literal["wall", "processor"] = option(
        "wall",
        "processor: processor time of this process, for a shared machine (default: wall)",
        choices=("wall", "processor"),
    ),
    views: int | None = option(None, "views of each test object (default: 2, quick: 1)", "N", parse=whole(1, 1000)),
    runs: Path | None = option(None, "also measure the networks trained below DIR", "DIR"),
    widths: tuple[int, ...] | None = option(
        None,
        "widths of untrained UNets to time, or none (default: 4,8,16,32; on large images 4,8)",
        "A,B",
        parse=value(
            "widths such as 4,8 or none",
            lambda text: tuple(int(width) for width in names(text) if text != "none"),
            lambda widths: all(1 <= width <= 1000 for width in widths),
        ),
    ),
) -> None:
    """Error against run time and frames for every method and setting on this machine, and how each cost grows.

    Measures what is missing, writes all files, prints fronts, growths and remarks."""
    asked = tradeoff.TradeoffSettings(
        dataset,
        out,
        only,
        quick,
        threads,
        clock,
        views,
        runs,
        widths,
    )
    plan = tradeoff.planned(asked, [page.board_ladder(quick)] if not only or "costs" in only else [])
    if listed:
        show(tradeoff.plan_table(plan))
        print(f"{len(plan.settings)} settings and {len(plan.ladders)} ladders of costs.")
        return
    with progress_bar("measuring", len(plan.settings) + len(plan.ladders), "settings") as advance:
        measurements = tradeoff.tradeoff(asked, plan, lambda key: advance(1))
    written = tradeoff.write_report(measurements, out)
    if measurements.points:
        show(tradeoff.front_table(measurements))
    if measurements.growth:
        show(tradeoff.growth_table(measurements.growth))
    for line in tradeoff.remarks(measurements):
        print(line)
    for path in written:
        print(f"Written: {path}")
