"""``fpp-bench leaderboard``: rank result files, and show the paper's rows beside them."""

import argparse
from pathlib import Path

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import METRICS

SUMMARY = "Rank result files of fpp-eval: error and run time side by side, and the paper's rows apart."
EXAMPLES = (
    "fpp-bench leaderboard result.json other.json",
    "fpp-bench leaderboard results/ --sort object_rmse_mm --markdown table.md",
    "fpp-bench leaderboard --paper loss",
)
_TABLES = ("normalization", "background_removed", "multi_frame", "loss", "architecture", "all", "none")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's arguments."""
    parser.add_argument(
        "results", nargs="*", type=Path, metavar="RESULT.json",
        help="result files, or folders of them (default: the rows shipped with the package, ./result*.json and "
        "./results/*.json)",
    )  # fmt: skip
    parser.add_argument(
        "--sort", choices=(*METRICS, "seconds_per_sample", "frames_used"), default="object_mae_mm", metavar="KEY",
        help=f"what to rank by (default: object_mae_mm): seconds_per_sample, frames_used, {', '.join(METRICS)}",
    )  # fmt: skip
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables as Markdown too")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the ranking as JSON too")
    parser.add_argument(
        "--paper", nargs="?", choices=_TABLES, const="all", metavar="TABLE",
        help=f"tables the paper reports: {', '.join(_TABLES)} (default: architecture, normalization; alone: all)",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Print the tables and write what was asked for. Raises SubmissionError naming a file that is no sound result."""
    from fpp_ml_bench.evaluation.console import output_width, show
    from fpp_ml_bench.leaderboard.export import markdown, table_json
    from fpp_ml_bench.leaderboard.paper import chosen_tables
    from fpp_ml_bench.leaderboard.ranking import discover, expand, rank, read_entries
    from fpp_ml_bench.leaderboard.tables import group_tables, paper_rich_tables
    from fpp_ml_bench.loaders.manifest import write_atomically

    files = expand(args.results) if args.results else discover(Path.cwd())
    groups = rank(read_entries(files), args.sort)
    papers = chosen_tables(args.paper)
    for path, text in ((args.markdown, markdown), (args.json, table_json)):
        if path is None:
            continue
        try:
            write_atomically(path, text(groups, papers, args.sort).encode("utf-8"))
        except OSError as error:
            raise SubmissionError(f"{path} can't be written: {error.strerror}") from None
    show(*group_tables(groups, args.sort, output_width()), *paper_rich_tables(papers))
    return 0
