"""``fpp-bench predict``: run a method over a split."""

import argparse
from pathlib import Path

from fpp_ml_bench import baselines
from fpp_ml_bench.cli import SPLITS
from fpp_ml_bench.cli.explain import add_explain_options, as_asked, explain
from fpp_ml_bench.cli.method_options import METHOD_HELP, add_method_options, chosen_method
from fpp_ml_bench.loaders import storage
from fpp_ml_bench.machine import limit_threads
from fpp_ml_bench.remote import place, working_copy

SUMMARY = "Run a method over a split and write predictions that fpp-eval scores."
EXAMPLES = (
    "fpp-bench predict classical data/mini --split test --out predictions",
    "fpp-bench predict classical data/mini --split test --steps 4 --direction vertical --out predictions-4",
    "fpp-bench predict unet.safetensors data/mini --range oracle --out predictions-oracle",
    "fpp-bench predict phase data/mini --frames 3 --out predictions-3",
    "fpp-bench predict phase data/mini --error-mm 3 --out predictions-fewest     frames chosen scene by scene",
    "fpp-eval predictions --dataset data/mini --split test --target depth_exact --json result.json",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("method", metavar="METHOD", help=METHOD_HELP)
    add("dataset", type=Path, metavar="DATASET", help="dataset folder")
    add("--split", default="test", choices=SPLITS, help="default: test")
    add(
        "--out",
        type=place,
        required=True,
        metavar="DIR",
        help="new or empty folder, or a URL, written at the end; a run that was stopped continues",
    )
    add_method_options(parser)
    add_explain_options(parser)


def run(args: argparse.Namespace) -> int:
    from fpp_ml_bench.cli.console import progress_bar

    limit_threads(args.threads)
    with as_asked(args):
        opened = storage.DatasetFolder(args.dataset)
        method = chosen_method(args, opened)
        samples = len(opened.samples(args.split))
        bar = progress_bar(f"{args.method}, {args.split}", samples, "samples")
        with working_copy(args.out) as (out, _), bar as advance:
            finished = baselines.predict_split(opened, method, args.split, out, advance)
        print(
            f"{args.out}: {finished.samples} predictions by {method.title}; {len(method.frames_used)} frames and "
            f"{finished.seconds_per_sample:.3f} s a sample (median)"
        )
        how = f"--dataset {args.dataset} --split {args.split}{_scoring(method, opened)}"
        if isinstance(args.out, Path):
            print(f"next: fpp-eval {args.out} {how} --json result.json")
        else:
            print(f"next: copy {args.out} to a disk, then: fpp-eval COPY {how} --json result.json")
        explain(args, lambda: baselines.explain_predict(opened, method, args.split))
    return 0


def _scoring(method: "baselines.Method", opened: "storage.DatasetFolder") -> str:
    """Options of fpp-eval that make the method's row: a network is scored against the decoded depth that it learnt
    from, but against that depth the process that made it would score 0."""
    target = method.target if opened.has_exact else "depth"
    mode = "" if method.mode == "standard" else f" --mode {method.mode}"
    return mode + ("" if target == "depth" else f" --target {target}")
