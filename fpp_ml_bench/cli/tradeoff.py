"""``fpp-bench tradeoff``: error against run time and captured frames, and what each stage costs as its input grows."""

import argparse
from pathlib import Path

from fpp_ml_bench.baselines import tradeoff
from fpp_ml_bench.cli import count
from fpp_ml_bench.leaderboard import page
from fpp_ml_bench.machine import limit_threads

SUMMARY = "Error against run time and frames for every method and setting on this machine, and how each cost grows."
EXAMPLES = (
    "fpp-bench tradeoff data/full",
    "fpp-bench tradeoff data/cpu224 --runs runs --out tradeoff-224",
    "fpp-bench tradeoff data/mini --quick --only classical --only phase",
    "fpp-bench tradeoff data/full --list",
    "fpp-bench leaderboard --page page --tradeoff tradeoff/tradeoff.json",
)
_GROUPS = ("classical", "phase", "networks", "precision", "sizes", "costs")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("dataset", type=Path, metavar="DATASET", help="dataset folder with all frames")
    add(
        "--out",
        type=Path,
        default=Path("tradeoff"),
        metavar="DIR",
        help="folder for the results, or the folder of a stopped run to continue (default: tradeoff)",
    )
    add(
        "--only",
        action="append",
        choices=_GROUPS,
        default=[],
        metavar="GROUP",
        help=f"measure only this group; may be repeated: {', '.join(_GROUPS)} (default: all)",
    )
    add("--quick", action="store_true", help="fewer settings, views, runs and sizes")
    add("--list", action="store_true", help="show what would be measured, and stop")
    add("--threads", type=count(1000), default=1, metavar="N", help="threads a method may use (default: 1)")
    add(
        "--clock",
        choices=("wall", "processor"),
        default="wall",
        help="processor: processor time of this process, for a shared machine (default: wall)",
    )
    add("--views", type=count(1000), metavar="N", help="views of each test object (default: 2, quick: 1)")
    add("--runs", type=Path, metavar="DIR", help="also measure the networks trained below DIR")
    add(
        "--widths",
        type=count(1000),
        nargs="*",
        metavar="W",
        help="widths of untrained UNets to time (default: 4 8 16 32; on large images 4 8)",
    )


def run(args: argparse.Namespace) -> int:
    """Measure what is missing, write all files, print fronts, growths and remarks."""
    limit_threads(args.threads)  # before NumPy is loaded
    from fpp_ml_bench.cli.console import progress_bar, show

    settings = tradeoff.TradeoffSettings(
        args.dataset,
        args.out,
        tuple(args.only),
        args.quick,
        args.threads,
        args.clock,
        args.views,
        args.runs,
        args.widths,
    )
    plan = tradeoff.planned(settings, [page.board_ladder(args.quick)] if not args.only or "costs" in args.only else [])
    if args.list:
        show(tradeoff.plan_table(plan))
        print(f"{len(plan.settings)} settings and {len(plan.ladders)} ladders of costs.")
        return 0
    with progress_bar("measuring", len(plan.settings) + len(plan.ladders), "settings") as advance:
        measurements = tradeoff.tradeoff(settings, plan, lambda key: advance(1))
    written = tradeoff.write_report(measurements, args.out)
    if measurements.points:
        show(tradeoff.front_table(measurements))
    if measurements.growth:
        show(tradeoff.growth_table(measurements.growth))
    for line in tradeoff.remarks(measurements):
        print(line)
    for path in written:
        print(f"Written: {path}")
    return 0
