"""``fpp-bench tradeoff``: error against run time, frames and memory, and how the time grows.
``fpp-bench stability``: ill-conditioned and extreme cases against higher precision and theoretical
bounds."""

from itertools import groupby
from pathlib import Path
from typing import Literal

from rich.text import Text

from fpp_ml_bench.baselines.stability.cases import GROUPS, all_cases, document, run_cases, summary
from fpp_ml_bench.baselines.stability.cases import write_report as write_stability
from fpp_ml_bench.baselines.tradeoff.measure import planned
from fpp_ml_bench.baselines.tradeoff.measure import tradeoff as run_tradeoff
from fpp_ml_bench.baselines.tradeoff.report import growth_table, point_table, remarks, write_report
from fpp_ml_bench.cli import CHECK_FAILED, OK
from fpp_ml_bench.cli.console import progress_bar, show
from fpp_ml_bench.cli.options import command, new_file, new_folder, whole
from fpp_ml_bench.evaluation.result.file import write_json
from fpp_ml_bench.options import argument, option
from fpp_ml_bench.tables import Table


@command(
    """\
fpp-bench tradeoff data/full
fpp-bench tradeoff data/mini --quick --method phase --method mine.py:Mine
fpp-bench tradeoff data/full --list
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
        "measure only this method: a name, file.py:Class, or weights; may be repeated. What the "
        "folder holds of others "
        "stays (default: every method, and the shipped networks of the image's size)",
        "METHOD",
        parse=str,
        many=True,
    ),
    views: int | None = option(
        None, "views of each test object (default: 2, quick: 1)", "N", parse=whole(1, 1000)
    ),
    quick: bool = option(False, "one view of each test object"),
    listed: bool = option(False, "show what would be measured, and stop", flag="--list"),
    threads: int = option(1, "threads a method may use (default: 1)", "N", parse=whole(1, 1000)),
    clock: Literal["wall", "processor"] = option(
        "wall",
        "processor: processor time of this process, for a shared machine (default: wall)",
    ),
) -> None:
    """Error against run time, frames and memory for every method on this machine, and how the time
    grows.

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


@command(
    """\
fpp-bench stability
fpp-bench stability --out stability --quick
fpp-bench stability --group phase --group metrics --json -
fpp-bench stability --list
"""
)
def check(
    *,
    group: tuple[str, ...] = option(
        tuple(GROUPS),
        f"run only this group; can be repeated: {', '.join(GROUPS)} (default: all)",
        "GROUP",
        choices=tuple(GROUPS),
        many=True,
    ),
    out: Path | None = option(
        None, "write stability.json and stability.png here", "DIR", parse=new_folder
    ),
    json: Path | None = option(
        None,
        "write the run as JSON; - is standard output, without the table",
        "FILE",
        parse=new_file,
    ),
    quick: bool = option(False, "leave out the case that needs gigabytes (10 million triangles)"),
    listed: bool = option(False, "list the cases and their bounds, and run none", flag="--list"),
) -> int:
    """Check ill-conditioned and extreme cases against references of higher precision and
    theoretical bounds.

    The status is 1 if any FAILs."""
    groups = [name for name in GROUPS if name in group]
    cases = all_cases(groups, quick=quick)
    if listed:
        for (name, family), members in groupby(cases, lambda case: (case.group, case.family)):
            case, *others = members
            show(
                Text(
                    f"{name}: {family} ({1 + len(others)}): {case.computes}; against "
                    f"{case.reference}"
                )
            )
            show(Text(f"    bound: {case.predicts}"))
        show(Text(f"{len(cases)} cases"))
        return OK
    with progress_bar("stability", len(cases), "cases") as advance:
        rows = run_cases(cases, lambda _: advance(1))
    written = [] if out is None else write_stability(rows, out)
    if json is not None:
        write_json(document(rows), json)
    numbers = "cases", "within bound", "flagged", "FAIL", "largest error / bound", "CPU s"
    table = Table("group", numbers=numbers, elsewhere="--json FILE")
    for name, part in summary(rows).items():
        *counts, ratio, cpu_s = part.values()
        table.add_row(
            name, *map(str, counts), "-" if ratio is None else f"{ratio:.2g}", f"{cpu_s:.1f}"
        )
    failed = [row for row in rows if row.verdict == "FAIL"]
    show(table, *(Text(f"FAIL {row.case.group}: {row.case.name}: {row.against}") for row in failed))
    for path in written:
        show(f"Written: {path}")
    return CHECK_FAILED if failed else OK
