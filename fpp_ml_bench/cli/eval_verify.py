"""``fpp-eval verify``: does a result follow from its predictions?"""

import argparse
from pathlib import Path

SUMMARY = "Score the predictions again and say whether the result is verified (exit status 0) or not (1)."
EXAMPLES = ("fpp-eval verify result.json predictions --dataset data/mini",)
LISTED = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's arguments."""
    parser.add_argument("result", type=Path, metavar="RESULT.json", help="a result of fpp-eval --json")
    parser.add_argument("folder", type=Path, metavar="DIR", help="the predictions it was made from")
    parser.add_argument("--dataset", type=Path, required=True, metavar="DATASET", help="folder of the dataset")


def run(args: argparse.Namespace) -> int:
    """Say verified or not, and what differs. Raises FppBenchError where nothing can be recomputed at all."""
    from fpp_ml_bench.cli import CHECK_FAILED
    from fpp_ml_bench.evaluation.result import read_result
    from fpp_ml_bench.evaluation.score import differences
    from fpp_ml_bench.files import printable
    from fpp_ml_bench.loaders.storage import DatasetFolder

    result = read_result(args.result)
    problems = differences(result, args.folder, DatasetFolder(args.dataset))
    file = printable(str(args.result), 500)
    if not problems:
        print(f"verified: {file} is what {len(result.per_sample)} predictions give")
        return 0
    print(f"not verified: {file} differs from what the predictions give in {len(problems)} places")
    for line in problems[:LISTED]:
        print(f"  {line}")
    if len(problems) > LISTED:
        print(f"  ... and {len(problems) - LISTED} more")
    return CHECK_FAILED
