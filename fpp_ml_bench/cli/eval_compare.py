"""``fpp-eval compare``: two results, sample by sample."""

import argparse
from pathlib import Path

SUMMARY = "Compare two results of the same samples: paired differences, their 95% intervals, and a plain sentence."
EXAMPLES = (
    "fpp-eval compare a.json b.json",
    "fpp-eval compare a.json b.json --json difference.json",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's arguments."""
    parser.add_argument("first", type=Path, metavar="A.json", help="a result of fpp-eval --json")
    parser.add_argument(
        "second",
        type=Path,
        metavar="B.json",
        help="a result of another method on the same data, split, target and track",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the comparison here, each sample's included")


def run(args: argparse.Namespace) -> int:
    """Print the table and the sentence. Raises SubmissionError for results that can't be compared."""
    from fpp_ml_bench.cli.console import show
    from fpp_ml_bench.evaluation.report import compare, comparison_table
    from fpp_ml_bench.evaluation.result import read_result, write_json

    comparison = compare(read_result(args.first), read_result(args.second))
    if args.json is not None:
        write_json(comparison.model_dump(mode="json"), args.json)
    show(comparison_table(comparison))
    return 0
