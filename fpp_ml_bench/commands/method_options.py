"""Options that choose a method's settings: the same for ``predict`` and ``time``."""

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.methods import Method
    from fpp_ml_bench.loaders.store import DatasetFolder


def add_method_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--threads`` and the options of each method."""
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="threads a sample (default: 1)")
    classical = parser.add_argument_group("classical")
    classical.add_argument("--steps", type=int, metavar="N", help="phase steps a direction, 3 to 18 (default: all)")
    classical.add_argument(
        "--direction",
        choices=("horizontal", "vertical", "both"),
        default="both",
        help="fringes to use: one direction is enough for a depth (default: both)",
    )


def chosen_method(args: argparse.Namespace, opened: "DatasetFolder") -> "Method":
    """The method that ``args`` name, for the rig of ``opened``. Raises FppBenchError for one that there is not."""
    from fpp_ml_bench.baselines.methods import METHODS, method
    from fpp_ml_bench.errors import PredictionError

    if args.method not in METHODS:
        raise PredictionError(f"unknown method {args.method!r}; there are {', '.join(METHODS)}")
    if args.threads < 1:
        raise PredictionError(f"--threads {args.threads}: expected 1 or more")
    steps = opened.sequence.steps if args.steps is None else args.steps
    return method(args.method, opened.rig, direction=args.direction, steps=steps, threads=args.threads)
