"""``fpp-bench tradeoff``: error against run time, frames and memory, and how the time grows."""

import argparse
from pathlib import Path

from fpp_ml_bench.baselines import tradeoff
from fpp_ml_bench.cli import count
from fpp_ml_bench.machine import limit_threads

SUMMARY = "Error against run time, frames and memory for every method on this machine, and how the time grows."
EXAMPLES = (
    "fpp-bench tradeoff data/full",
    "fpp-bench tradeoff data/mini --quick --method phase --method mine.py:Mine",
    "fpp-bench tradeoff data/full --list",
    "fpp-bench leaderboard --page page --tradeoff tradeoff/tradeoff.json",
)


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
        "--method",
        action="append",
        default=[],
        metavar="METHOD",
        help="measure only this method: a name, file.py:Class, or weights; may be repeated. What the folder holds of "
        "others stays (default: every method, and the shipped networks of the image's size)",
    )
    add("--views", type=count(1000), metavar="N", help="views of each test object (default: 2, quick: 1)")
    add("--quick", action="store_true", help="one view of each test object")
    add("--list", action="store_true", help="show what would be measured, and stop")
    add("--threads", type=count(1000), default=1, metavar="N", help="threads a method may use (default: 1)")
    add(
        "--clock",
        choices=("wall", "processor"),
        default="wall",
        help="processor: processor time of this process, for a shared machine (default: wall)",
    )


def run(args: argparse.Namespace) -> int:
    """Measure what is missing, write all files, print both tables and remarks."""
    limit_threads(args.threads)  # before NumPy is loaded
    from fpp_ml_bench.cli.console import progress_bar, show

    views = args.views or (1 if args.quick else 2)
    plan = tradeoff.planned(args.dataset, args.out, args.method, views, args.threads, args.clock)
    if args.list:
        for point in plan.points:
            print(point.label)
        print(f"{len(plan.points)} points on {len(plan.views)} views.")
        return 0
    with progress_bar("measuring", len(plan.points), "points") as advance:
        measured = tradeoff.tradeoff(plan, lambda label: advance(1))
    written = tradeoff.write_report(measured, args.out)
    show(*tradeoff.rich_tables(measured))
    for line in tradeoff.remarks(measured):
        print(line)
    for path in written:
        print(f"Written: {path}")
    return 0
