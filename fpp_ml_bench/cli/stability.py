"""``fpp-bench stability``: ill-conditioned and extreme cases against higher precision and theoretical bounds."""

from itertools import groupby
from pathlib import Path

from rich.text import Text

from fpp_ml_bench.baselines.stability.cases import GROUPS, all_cases, document, run_cases, summary, write_report
from fpp_ml_bench.cli import CHECK_FAILED, OK
from fpp_ml_bench.cli.console import progress_bar, show
from fpp_ml_bench.cli.options import command
from fpp_ml_bench.errors import StabilityError
from fpp_ml_bench.evaluation.result.file import write_json
from fpp_ml_bench.options import option
from fpp_ml_bench.tables import Table


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
    out: Path | None = option(None, "write stability.json and stability.png here", "DIR"),
    json: Path | None = option(None, "write the run as JSON; - is standard output, without the table", "FILE"),
    quick: bool = option(False, "leave out the case that needs gigabytes (10 million triangles)"),
    listed: bool = option(False, "list the cases and their bounds, and run none", flag="--list"),
) -> int:
    """Check ill-conditioned and extreme cases against references of higher precision and theoretical bounds.

    The status is 1 if any FAILs."""
    groups = [name for name in GROUPS if name in group]
    if out is not None and out.exists() and not out.is_dir():
        raise StabilityError(f"--out {out}: expected a folder or a new path, got a file")
    cases = all_cases(groups, quick=quick)
    if listed:
        for (name, family), members in groupby(cases, lambda case: (case.group, case.family)):
            case, *others = members
            show(Text(f"{name}: {family} ({1 + len(others)}): {case.computes}; against {case.reference}"))
            show(Text(f"    bound: {case.predicts}"))
        show(Text(f"{len(cases)} cases"))
        return OK
    with progress_bar("stability", len(cases), "cases") as advance:
        rows = run_cases(cases, lambda _: advance(1))
    written = [] if out is None else write_report(rows, out)
    if json is not None:
        write_json(document(rows), json)
    numbers = "cases", "within bound", "flagged", "FAIL", "largest error / bound", "CPU s"
    table = Table("group", numbers=numbers, elsewhere="--json FILE")
    for name, part in summary(rows).items():
        *counts, ratio, cpu_s = part.values()
        table.add_row(name, *map(str, counts), "-" if ratio is None else f"{ratio:.2g}", f"{cpu_s:.1f}")
    failed = [row for row in rows if row.verdict == "FAIL"]
    show(table, *(Text(f"FAIL {row.case.group}: {row.case.name}: {row.against}") for row in failed))
    for path in written:
        show(f"Written: {path}")
    return CHECK_FAILED if failed else OK
