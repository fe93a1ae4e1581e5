"""``fpp-bench stability``: ill-conditioned and extreme cases against higher precision and theoretical bounds."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from fpp_ml_bench.baselines import stability
from fpp_ml_bench.cli import CHECK_FAILED, OK
from fpp_ml_bench.errors import StabilityError

SUMMARY = "Check ill-conditioned and extreme cases against references of higher precision and theoretical bounds."
EXAMPLES = (
    "fpp-bench stability",
    "fpp-bench stability --out stability --quick",
    "fpp-bench stability --group phase --group metrics --json",
    "fpp-bench stability --list",
)
_GROUPS = ("phase", "order", "triangulation", "rig", "normalisation", "metrics", "networks", "scenes", "crossed")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--group",
        action="append",
        choices=_GROUPS,
        metavar="GROUP",
        help=f"run only this group; can be repeated: {', '.join(_GROUPS)} (default: all)",
    )
    add("--out", type=Path, metavar="DIR", help="write index.html, stability.json and stability.png here")
    add("--json", action="store_true", help="print the run as JSON instead of a table")
    add("--quick", action="store_true", help="leave out the case that needs gigabytes (10 million triangles)")
    add("--list", action="store_true", help="list the cases and their bounds, and run none")


def run(args: argparse.Namespace) -> int:
    """Run the cases; 1 if any FAILs."""
    from fpp_ml_bench.cli.console import progress_bar, show

    groups = [group for group in _GROUPS if group in (args.group or _GROUPS)]
    if args.out is not None and args.out.exists() and not args.out.is_dir():
        raise StabilityError(f"--out {args.out}: expected a folder or a new path, got a file")
    cases = stability.all_cases(groups, quick=args.quick)
    if args.list:
        return _list(cases)
    with progress_bar("stability", len(cases), "cases") as advance:
        rows = stability.run_cases(cases, lambda _: advance(1))
    written = [] if args.out is None else stability.write_report(rows, args.out)
    if args.json:
        print(json.dumps(stability.document(rows), indent=1, allow_nan=False))
    else:
        _show(rows)
        for path in written:
            show(f"Written: {path}")
    return CHECK_FAILED if any(row.verdict is stability.Verdict.FAIL for row in rows) else OK


def _show(rows: Sequence[stability.Row]) -> None:
    from rich.text import Text

    from fpp_ml_bench.cli.console import show
    from fpp_ml_bench.tables import Table

    numbers = "cases", "within bound", "flagged", "FAIL", "largest error / bound", "CPU s"
    table = Table("group", numbers=numbers, elsewhere="--json")
    for group, part in stability.summary(rows).items():
        *counts, ratio, cpu_s = part.values()
        text = ratio if isinstance(ratio, str) else stability.short(ratio)
        table.add_row(group, *map(str, counts), text, f"{cpu_s:.1f}")
    show(table)
    for row in rows:
        if row.verdict is stability.Verdict.FAIL:
            show(Text(f"FAIL {row.case.group}: {row.case.name}: {row.against}"))


def _list(cases: Sequence[stability.Case]) -> int:
    from rich.text import Text

    from fpp_ml_bench.cli.console import show

    for (group, family), members in groupby(cases, lambda case: (case.group, case.family)):
        case, *others = members
        show(Text(f"{group}: {family} ({1 + len(others)}): {case.computes}; against {case.reference}"))
        show(Text(f"    bound: {case.predicts}"))
    show(Text(f"{len(cases)} cases"))
    return OK
