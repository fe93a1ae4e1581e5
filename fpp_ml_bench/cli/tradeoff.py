"""``fpp-bench tradeoff``: error against run time, frames and memory, and how the time grows."""

from pathlib import Path
from typing import Literal

from fpp_ml_bench.baselines.tradeoff.measure import planned
from fpp_ml_bench.baselines.tradeoff.measure import tradeoff as run_tradeoff
from fpp_ml_bench.baselines.tradeoff.report import growth_table, point_table, remarks, write_report
from fpp_ml_bench.cli.console import progress_bar, show
from fpp_ml_bench.cli.options import command, whole
from fpp_ml_bench.options import argument, option


@command(
    """\
fpp-bench tradeoff data/full
fpp-bench tradeoff data/mini --quick --method phase --method mine.py:Mine
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
    method: tuple[str, ...] = option(
        (),
        "measure only this method: a name, file.py:Class, or weights; may be repeated. What the folder holds of others "
        "stays (default: every method, and the shipped networks of the image's size)",
        "METHOD",
        parse=str,
        many=True,
    ),
    views: int | None = option(None, "views of each test object (default: 2, quick: 1)", "N", parse=whole(1, 1000)),
    quick: bool = option(False, "one view of each test object"),
    listed: bool = option(False, "show what would be measured, and stop", flag="--list"),
    threads: int = option(1, "threads a method may use (default: 1)", "N", parse=whole(1, 1000)),
    clock: Literal["wall", "processor"] = option(
        "wall",
        "processor: processor time of this process, for a shared machine (default: wall)",
    ),
) -> None:
    """Error against run time, frames and memory for every method on this machine, and how the time grows.

    Measures what is missing, writes all files, prints both tables and remarks."""
    plan = planned(dataset, out, method, views or (1 if quick else 2), threads, clock)
    if listed:
        for point in plan.points:
            print(point.label)
        print(f"{len(plan.points)} points on {len(plan.views)} views.")
        return
    with progress_bar("measuring", len(plan.points), "points") as advance:
        measured = run_tradeoff(plan, lambda label: advance(1))
    written = write_report(measured, out)
    show(point_table(measured), growth_table(measured))
    for line in remarks(measured):
        print(line)
    for path in written:
        print(f"Written: {path}")
