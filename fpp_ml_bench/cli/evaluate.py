"""``fpp-eval``: score a folder of predictions against one split of a dataset; its subcommands work on results."""

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from fpp_ml_bench.cli import run_command
from fpp_ml_bench.cli.explain import add_explain_options, as_asked, explain
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX, MODES, TARGETS

SUMMARY = "Score a folder of predictions: MAE and RMSE in mm over the full grid, the object and the background."
EXAMPLES = (
    "fpp-eval predictions --dataset data/mini --split test --json result.json",
    "fpp-eval predictions --dataset data/mini --split test --target depth_exact --report report",
    "fpp-eval compare a.json b.json",
    "fpp-eval verify result.json predictions --dataset data/mini",
    "fpp-eval schema",
)
SUBCOMMANDS = {"compare": "eval_compare", "verify": "eval_verify", "schema": "eval_schema"}
"""First words that select a subcommand. A folder of such a name is given as ./compare."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's arguments."""
    parser.add_argument(
        "folder",
        type=Path,
        metavar="DIR",
        help="folder of submission.yaml and one {sample}.npy, .npz, .mat or 16-bit .png per sample, or one "
        "predictions.parquet or .arrow: depth (H, W), 0 = background, in the units that submission.yaml declares; "
        "every problem is listed by file, and then no JSON is written",
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
    parser.add_argument(
        "--mode",
        choices=MODES,
        default=MODES[0],
        help="standard: mm, object where depth is above 0 (default); paper-individual: the paper's rule for its "
        "individually normalised rows, for units: normalised only, never ranked with the others",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the result here, per-sample scores included")
    parser.add_argument("--report", type=Path, metavar="OUT", help="write an HTML page with figures into this folder")
    add_explain_options(parser)


def _band(text: str) -> int:
    if not text.isdecimal() or int(text) > 1000:
        raise argparse.ArgumentTypeError(f"expected whole pixels from 0 to 1000, got {text!r}")
    return int(text)


def run(args: argparse.Namespace) -> int:
    """Score, write the JSON if requested, print the table. Raises FppBenchError for anything that can't be scored."""
    with as_asked(args):
        return _run(args)


def _run(args: argparse.Namespace) -> int:
    from fpp_ml_bench.machine import prepare_process

    prepare_process()
    from fpp_ml_bench.evaluation.score import evaluate
    from fpp_ml_bench.loaders.storage import DatasetFolder

    if args.json is not None:
        _check_output(args.json, args.folder)
    if args.report is not None:
        _check_report(args.report, args.folder)
    dataset = DatasetFolder(args.dataset)
    result = evaluate(args.folder, dataset, args.split, args.target, args.edge_band, args.mode, _import_output)
    if args.json is not None:
        from fpp_ml_bench.evaluation.result import write_result

        write_result(result, args.json)
    from fpp_ml_bench.cli.console import show
    from fpp_ml_bench.evaluation.report import result_table

    show(result_table(result))
    if args.report is not None:
        from fpp_ml_bench.evaluation.report import write_report

        write_report(result, dataset, args.folder, args.report)
    for written in (args.json, args.report):
        if written is not None:
            print(f"Written: {written}")
    from fpp_ml_bench.loaders.storage import benchmark_sentence

    has_expected_bytes, sentence = benchmark_sentence(dataset.manifest)
    if not has_expected_bytes:
        print(f"fpp-eval: warning: {dataset.path}: {sentence}", file=sys.stderr)
    if args.explain or args.explain_json:
        from fpp_ml_bench.evaluation.score import explain_eval

        explain(args, lambda: explain_eval(dataset, args.split, args.target, args.edge_band))
    return 0


def _import_output() -> None:
    from fpp_ml_bench.evaluation.report import terminal  # noqa: F401


def _check_output(path: Path, folder: Path) -> None:
    """Refuse, before any work, a JSON file that can't be written or would be an extra file among the predictions."""
    if path.is_dir():
        raise SubmissionError(f"--json {path}: expected a file to write, found a folder")
    if not path.absolute().parent.is_dir():
        raise SubmissionError(f"--json {path}: the folder {path.parent} does not exist; make it first")
    if path.absolute().parent.resolve() == folder.resolve():
        raise SubmissionError(
            f"--json {path}: is inside the predictions folder, where it would be an extra file; move it out"
        )


def _check_report(path: Path, folder: Path) -> None:
    if path.is_file():
        raise SubmissionError(f"--report {path}: expected a folder to write into, found a file")
    if path.resolve().is_relative_to(folder.resolve()):
        raise SubmissionError(
            f"--report {path}: is inside the predictions folder, where it would be an extra file; move it"
        )


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of ``fpp-eval``: exit status 0, 1 where ``verify`` finds a difference, 2 with the error on stderr."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words and words[0] in SUBCOMMANDS:
        module = import_module(f"fpp_ml_bench.cli.{SUBCOMMANDS[words[0]]}")
        return run_command(module, f"fpp-eval {words[0]}", words[1:])
    return run_command(sys.modules[__name__], "fpp-eval", words)
