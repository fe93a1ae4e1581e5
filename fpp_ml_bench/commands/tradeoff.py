"""``fpp-bench tradeoff``: error against run time and captures, and what each stage costs as its input grows."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fpp_ml_bench.leaderboard.tradeoff import Plan, Wish

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
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="dataset folder with all frames")
    parser.add_argument(
        "--out", type=Path, default=Path("tradeoff"), metavar="DIR",
        help="folder for the results, or of a stopped run to go on with (default: tradeoff)",
    )  # fmt: skip
    parser.add_argument(
        "--only", action="append", choices=_GROUPS, default=[], metavar="GROUP",
        help=f"this group alone, may be given again: {', '.join(_GROUPS)} (default: all)",
    )  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="fewer settings, views, runs and sizes")
    parser.add_argument("--list", action="store_true", help="show what would be measured, measure nothing")
    parser.add_argument("--threads", type=_count, default=1, metavar="N", help="threads a method may use (default: 1)")
    parser.add_argument(
        "--clock", choices=("wall", "processor"), default="wall",
        help="processor: time that this process got, for a machine that others use too (default: wall)",
    )  # fmt: skip
    parser.add_argument("--views", type=_count, metavar="N", help="views of each test object (default: 2, quick: 1)")
    parser.add_argument("--runs", type=Path, metavar="DIR", help="measure the networks trained below DIR too")
    parser.add_argument(
        "--widths", type=_count, nargs="*", metavar="W",
        help="widths of untrained UNets to time (default: 4 8 16 32; on large images 4 8)",
    )  # fmt: skip


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 1000:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1 to 1000, got {text!r}")
    return int(text)


def run(args: argparse.Namespace) -> int:
    """Measure what is missing, write everything, print fronts, growths and what to know of them."""
    from fpp_ml_bench.linear_algebra import limit_threads

    limit_threads(args.threads)
    from fpp_ml_bench.commands.console import progress_bar
    from fpp_ml_bench.evaluation.console import show
    from fpp_ml_bench.leaderboard.tradeoff import Wish, planned, tradeoff
    from fpp_ml_bench.leaderboard.tradeoff_report import front_table, growth_table, remarks, write_report

    wish = Wish(
        args.dataset, args.out, tuple(args.only), args.quick, args.threads, args.clock, args.views, args.runs,
        args.widths,
    )  # fmt: skip
    plan = planned(wish)
    if args.list:
        return _list(wish, plan)
    with progress_bar("measuring", len(plan), "settings") as advance:
        found = tradeoff(wish, plan, lambda key: advance(1))
    written = write_report(found, args.out)
    if found.points:
        show(front_table(found))
    if found.growth:
        show(growth_table(found.growth))
    for line in remarks(found):
        print(line)
    for path in written:
        print(f"Written: {path}")
    return 0


def _list(wish: "Wish", plan: "Plan") -> int:
    from rich.table import Table

    from fpp_ml_bench.evaluation.console import show

    table = Table(title=f"{wish.dataset}: {len(plan.views.names)} views", title_justify="left")
    for title in ("Group", "Setting", "Note"):
        table.add_column(title, overflow="fold")
    for setting in plan.settings:
        table.add_row(setting.group, setting.title, setting.note or "")
    for ladder in plan.ladders:
        table.add_row("costs", ladder.key, f"{len(ladder.steps)} steps from {ladder.steps[0]} to {ladder.steps[-1]}")
    show(table)
    print(f"{len(plan.settings)} settings and {len(plan.ladders)} ladders of costs.")
    return 0
