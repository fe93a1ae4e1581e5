"""``fpp-eval schema``: the JSON Schema of the files this package reads and writes."""

import argparse

SUMMARY = "Print the JSON Schema (2020-12) of result.json or of submission.yaml."
EXAMPLES = ("fpp-eval schema > result.schema.json", "fpp-eval schema submission")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's arguments."""
    parser.add_argument(
        "file",
        nargs="?",
        choices=("result", "submission", "comparison"),
        default="result",
        help="result: what fpp-eval writes (default); submission: submission.yaml; comparison: fpp-eval compare --json",
    )


def run(args: argparse.Namespace) -> int:
    """Print the schema to standard output."""
    import json

    from fpp_ml_bench.evaluation.result import json_schema

    print(json.dumps(json_schema(args.file), indent=1))
    return 0
