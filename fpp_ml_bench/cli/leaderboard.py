"""``fpp-bench leaderboard``: rank result files, and show the paper's rows apart."""

import argparse
from pathlib import Path
from typing import Any

from fpp_ml_bench import leaderboard
from fpp_ml_bench.baselines import tradeoff
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation import result
from fpp_ml_bench.evaluation.metrics import METRICS
from fpp_ml_bench.leaderboard import page

SUMMARY = "Rank result files: error and run time side by side, as a table and a static page."
EXAMPLES = (
    "fpp-bench leaderboard result.json second.json",
    "fpp-bench leaderboard results/ --sort object_rmse_mm --markdown table.md",
    "fpp-bench leaderboard --pairs --paper none",
    "fpp-bench leaderboard --csv leaderboard.csv",
    "fpp-bench leaderboard --paper loss",
    "fpp-bench leaderboard --page page",
    "fpp-bench leaderboard result.json --row leaderboard/rows/mine.json",
)
_TABLES = ("normalization", "background_removed", "multi_frame", "loss", "architecture", "oracle_order", "all", "none")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "results",
        nargs="*",
        type=Path,
        metavar="RESULT.json",
        help="result files, or folders of them (default: the rows shipped with the package, ./result*.json and "
        "./results/*.json)",
    )
    add(
        "--sort",
        choices=(*METRICS, "seconds_per_sample", "frames_used"),
        default="object_mae_mm",
        metavar="KEY",
        help=f"what to rank by (default: object_mae_mm): seconds_per_sample, frames_used, {', '.join(METRICS)}",
    )
    one_file: dict[str, Any] = {"type": Path, "metavar": "FILE"}
    add("--markdown", **one_file, help="also write the tables as Markdown")
    add("--json", **one_file, help="also write the ranking as JSON, with the tests of all pairs")
    add("--csv", **one_file, help="also write a line for each row, with all digits")
    add(
        "--pairs",
        action="store_true",
        help="also print every pair of ranked rows: difference, interval, p value, who is behind",
    )
    add(
        "--paper",
        nargs="?",
        choices=_TABLES,
        const="all",
        metavar="TABLE",
        help=f"tables of the paper and of others: {', '.join(_TABLES)} (default: architecture, normalization, "
        "oracle_order, in the terminal only where no results are named; without TABLE: all)",
    )
    add(
        "--page",
        type=Path,
        metavar="DIR",
        help="write the static page of the shipped rows, or of those given: index.html and a page for each submission",
    )
    add(
        "--tradeoff",
        **one_file,
        help="with --page: the tradeoff.json to show on it (default, for the shipped rows: the file that ships)",
    )
    add(
        "--row",
        **one_file,
        help="make a row file for the leaderboard of the given result, and print what a maintainer adds to "
        "leaderboard/vouched.txt to vouch for it",
    )


def run(args: argparse.Namespace) -> int:
    """Rank, write the requested files, print the tables. Raises SubmissionError naming a file that is not valid."""
    from fpp_ml_bench.cli.console import show

    if args.tradeoff is not None and args.page is None:
        raise SubmissionError("--tradeoff adds settings to a page; give it with --page DIR")
    if args.page is not None and args.sort != "object_mae_mm":
        raise SubmissionError("--page is by object_mae_mm, and a click sorts it otherwise; leave out --sort")
    if args.row is not None:
        if len(args.results) != 1:
            raise SubmissionError(f"--row makes a row of one result, {len(args.results)} were given")
        row = leaderboard.read_entry(args.results[0]).row
        data = leaderboard.write_row(row, args.row)
        print(f"{args.row}: {len(data):,} bytes, self-reported until a maintainer adds to leaderboard/vouched.txt:")
        print(leaderboard.vouching_line(row, data, "measured", "THE COMMAND THAT MAKES IT AGAIN"))
        return 0
    # A page holds the shipped rows or the named files, never results that happen to be in the current folder.
    unnamed = leaderboard.discover(Path.cwd()) if args.page is None else leaderboard.shipped_rows()
    entries = leaderboard.read_entries(leaderboard.expand(args.results) if args.results else unnamed)
    groups, papers = leaderboard.rank(entries, args.sort), leaderboard.chosen_tables(args.paper)
    for path, text in ((args.markdown, leaderboard.markdown), (args.json, leaderboard.table_json)):
        if path is not None:
            result.write_file(text(groups, papers, args.sort).encode("utf-8"), path)
    if args.csv is not None:
        result.write_file(leaderboard.table_csv(groups).encode("utf-8"), args.csv)
    if args.page is not None:
        shipped = None if args.results else tradeoff.shipped_tradeoff()
        settings = shipped if args.tradeoff is None else tradeoff.read_tradeoff(args.tradeoff)
        written = page.write_page(groups, papers, args.page, settings)
        print(f"{args.page}: {len(written)} files; open {written[0]}")
        return 0
    not_shown = len(papers) if args.results and args.paper is None else 0
    tables = leaderboard.group_tables(groups, args.sort, args.pairs)
    show(*tables, *leaderboard.paper_rich_tables(papers[not_shown:]))
    if not_shown:
        print(
            f"Not shown: {not_shown} tables that others reported on other data (--paper), and the leaderboard's own "
            f"{len(leaderboard.shipped_rows())} rows (fpp-bench leaderboard without a file)."
        )
    return 0
