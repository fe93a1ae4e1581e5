"""``fpp-bench reliance``: how far a method's predictions follow the fringe's phase, as a score from 0 to 1."""

import argparse
from pathlib import Path

from rich.text import Text

from fpp_ml_bench.baselines import diagnostics
from fpp_ml_bench.cli.console import progress_bar, show
from fpp_ml_bench.cli.method_options import METHOD_HELP, add_method_options, chosen_method
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation import result
from fpp_ml_bench.loaders import storage
from fpp_ml_bench.machine import limit_threads
from fpp_ml_bench.tables import Table

SUMMARY = "Measure phase reliance: does the predicted depth follow the fringe's phase, or the object's outline?"
EXAMPLES = (
    "fpp-bench reliance classical data/cpu224",
    "fpp-bench reliance phase data/cpu224 --fringe vertical",
    "fpp-bench reliance unet-individual-rmse data/cpu224 --range oracle --into result.json",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("method", metavar="METHOD", help=METHOD_HELP)
    add("dataset", type=Path, metavar="DATASET", help="dataset folder; scenes are made from its test objects")
    add("--views", type=int, default=2, metavar="N", help="samples of each test object, 1 to 6 (default: 2)")
    add(
        "--into",
        type=Path,
        metavar="FILE",
        help="write the score into this result or leaderboard row of the same method (.json)",
    )
    add("--json", type=Path, metavar="FILE", help="write the score and its parts to this file")
    add_method_options(parser)


def run(args: argparse.Namespace) -> int:
    """Measure, write, print. A file that can't take the score raises FppBenchError before measuring."""
    limit_threads(args.threads)  # before NumPy is loaded
    from fpp_ml_bench.leaderboard.rows import check_same_method, read_entry, write_reliance

    if not 1 <= args.views <= 6:
        raise PredictionError(f"--views {args.views}: expected 1 to 6, an object has six views")
    dataset = storage.DatasetFolder(args.dataset)
    method = chosen_method(args, dataset)
    entry = None if args.into is None else read_entry(args.into)
    if entry is not None:
        check_same_method(entry, method)
    scene_set = diagnostics.SceneSet(dataset, args.views)
    found = method.settings.get("weights_sha256")
    sha256 = found if isinstance(found, str) else None
    with progress_bar(f"reliance of {args.method}", len(scene_set.samples), "samples") as advance:
        # Called before each sample, so the first call is for none.
        reliance, _ = diagnostics.measure(method, scene_set, sha256, lambda done, total, sample: advance(min(done, 1)))
    if args.json is not None:
        result.write_json(reliance.model_dump(mode="json"), args.json)
    if entry is not None:
        write_reliance(entry, reliance)
    moved = [value for key, value in reliance.parts if not key.startswith("answered")]
    if any(moved):
        show(_table(method.title, reliance))
    else:
        print(
            f"{method.title}: gives the same answer whatever phase, light and outline of {reliance.samples} samples "
            "are, so it reads nothing of them. Phase reliance 0."
        )
    return 0


def _table(title: str, reliance: "result.Reliance") -> Table:
    heading = Text(f"{title}: {reliance.samples} samples of {reliance.objects} objects")
    table = Table("", numbers=("value",), title=heading)
    low, high = reliance.interval
    interval = "" if low is None or high is None else f" ({low:.2f} to {high:.2f})"
    table.add_row("phase reliance, 0 to 1", f"{reliance.score:.3f}{interval}")
    if reliance.order_free_score is not None:
        table.add_row("  whole periods aside", f"{reliance.order_free_score:.3f}")
    for key, words in result.PART_TITLES.items():
        value = getattr(reliance.parts, key)
        if value is not None:
            table.add_row(words, f"{value:.3f}")
    return table
