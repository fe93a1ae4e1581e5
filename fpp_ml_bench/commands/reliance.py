"""``fpp-bench reliance``: how far a method's answers follow the fringe's phase, as one number, into its result."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from fpp_ml_bench.commands.method_options import METHOD_HELP, add_method_options, chosen_method

if TYPE_CHECKING:
    from rich.table import Table

    from fpp_ml_bench.evaluation.reliance import Reliance

SUMMARY = "Measure phase reliance: does an answer follow the fringe's phase, or the object's outline?"
EXAMPLES = (
    "fpp-bench reliance classical data/cpu224",
    "fpp-bench reliance phase data/cpu224 --fringe vertical",
    "fpp-bench reliance unet-individual-rmse data/cpu224 --range oracle --into result.json",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's arguments."""
    parser.add_argument("method", metavar="METHOD", help=METHOD_HELP)
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="dataset folder; its test objects are changed")
    parser.add_argument(
        "--views", type=int, default=2, metavar="N", help="samples of each test object, 1 to 6 (default: 2)"
    )
    parser.add_argument(
        "--into", type=Path, metavar="FILE",
        help="put it into this result of the same method, or leaderboard row (.json)",
    )  # fmt: skip
    parser.add_argument("--json", type=Path, metavar="FILE", help="write it here")
    add_method_options(parser)


def run(args: argparse.Namespace) -> int:
    """Measure, write what was asked for, print. Raises FppBenchError before measuring for a file that can't take it."""
    from fpp_ml_bench.linear_algebra import limit_threads

    limit_threads(args.threads)
    from fpp_ml_bench.baselines.diagnostics.counterfactual_scenes import SceneBook
    from fpp_ml_bench.baselines.diagnostics.reliance_measure import measure
    from fpp_ml_bench.commands.console import progress_bar
    from fpp_ml_bench.errors import PredictionError
    from fpp_ml_bench.evaluation.console import show
    from fpp_ml_bench.evaluation.result_io import write_json
    from fpp_ml_bench.leaderboard.reliance import check_same_method, write_reliance
    from fpp_ml_bench.leaderboard.rows import read_entry
    from fpp_ml_bench.loaders.store import DatasetFolder

    if not 1 <= args.views <= 6:
        raise PredictionError(f"--views {args.views}: expected 1 to 6, an object has six views")
    opened = DatasetFolder(args.dataset)
    method = chosen_method(args, opened)
    entry = None if args.into is None else read_entry(args.into)
    if entry is not None:
        check_same_method(entry, method)
    book = SceneBook(opened, args.views)
    before = 0
    with progress_bar(f"asking {args.method}", len(book.chosen), "samples") as advance:

        def progress(done: int, total: int, doing: str = "") -> None:
            nonlocal before
            advance(done - before)
            before = done

        sha256 = method.settings.get("weights_sha256")
        found, _ = measure(method, book, sha256 if isinstance(sha256, str) else None, progress)
    if args.json is not None:
        write_json(found.model_dump(mode="json"), args.json)
    if entry is not None:
        write_reliance(entry, found)
    show(_table(method.title, found))
    return 0


def _table(title: str, found: "Reliance") -> "Table":
    from rich.table import Table
    from rich.text import Text

    from fpp_ml_bench.evaluation.reliance import PART_TITLES

    table = Table(title=Text(f"{title}: {found.samples} samples of {found.objects} objects"), title_justify="left")
    table.add_column("")
    table.add_column("value", justify="right")
    low, high = found.interval
    span = "" if low is None or high is None else f" ({low:.2f} to {high:.2f})"
    table.add_row("phase reliance, 0 to 1", f"{found.score:.3f}{span}")
    if found.order_free_score is not None:
        table.add_row("  whole periods aside", f"{found.order_free_score:.3f}")
    for key, words in PART_TITLES.items():
        value = getattr(found.parts, key)
        if value is not None:
            table.add_row(words, f"{value:.3f}")
    return table
