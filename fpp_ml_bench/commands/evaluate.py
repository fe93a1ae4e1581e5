"""``fpp-eval``: score a folder of predictions against one split of a dataset."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from fpp_ml_bench.commands import run_command
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX, TARGETS

SUMMARY = "Score a folder of predictions: MAE and RMSE in mm over the full grid, the object and the background."
EXAMPLES = (
    "fpp-eval predictions --dataset data/mini --split test --json result.json",
    "fpp-eval predictions --dataset data/mini --split test --target depth_exact",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's arguments."""
    parser.add_argument(
        "folder",
        type=Path,
        metavar="DIR",
        help="folder of submission.yaml and one {sample}.npy per sample, float (H, W) depth in mm, 0 = background; "
        "whatever is wrong with it is listed file by file, and no JSON is written",
    )
    parser.add_argument("--dataset", type=Path, required=True, metavar="DATASET", help="folder of the dataset")
    parser.add_argument(
        "--split",
        choices=("train", "validation", "test", "all"),
        default="test",
        help="samples to score (default: test)",
    )
    parser.add_argument(
        "--target",
        choices=TARGETS,
        default=TARGETS[0],
        help="depth: decoded from the noisy frames, as in the paper (default); depth_exact: from the ray cast",
    )
    parser.add_argument(
        "--edge-band",
        type=_band,
        default=EDGE_BAND_PX,
        metavar="PX",
        help=f"object pixels nearer than this to a depth edge count as edge (default: {EDGE_BAND_PX})",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the result here, per-sample scores included")


def _band(text: str) -> int:
    if not text.isdecimal() or int(text) > 1000:
        raise argparse.ArgumentTypeError(f"expected whole pixels from 0 to 1000, got {text!r}")
    return int(text)


def run(args: argparse.Namespace) -> int:
    """Score, write the JSON if asked to, print the table. Raises FppBenchError for anything that can't be scored."""
    from fpp_ml_bench.evaluation.evaluator import evaluate
    from fpp_ml_bench.loaders.store import DatasetFolder

    if args.json is not None:
        _check_output(args.json, args.folder)
    result = evaluate(args.folder, DatasetFolder(args.dataset), args.split, args.target, args.edge_band)
    if args.json is not None:
        from fpp_ml_bench.evaluation.result_io import write_result

        write_result(result, args.json)
    from fpp_ml_bench.evaluation.console import show
    from fpp_ml_bench.evaluation.table import result_table

    show(result_table(result))
    if args.json is not None:
        print(f"Written: {args.json}")
    return 0


def _check_output(path: Path, folder: Path) -> None:
    """Refuse, before any work, a JSON file that can't be written or would make the predictions unscorable."""
    if path.is_dir():
        raise SubmissionError(f"--json {path}: expected a file to write, found a folder")
    if not path.absolute().parent.is_dir():
        raise SubmissionError(f"--json {path}: the folder {path.parent} does not exist; make it first")
    if path.absolute().parent.resolve() == folder.resolve():
        raise SubmissionError(
            f"--json {path}: lies among the predictions, where it would be an extra file; move it out"
        )


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of ``fpp-eval``: exit status 0, or 2 with the error on stderr."""
    return run_command(sys.modules[__name__], "fpp-eval", sys.argv[1:] if argv is None else argv)
