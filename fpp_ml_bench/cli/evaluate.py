"""``fpp-eval``: score a folder of predictions against one split of a dataset; its subcommands work on results."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

from fpp_ml_bench.cli import CHECK_FAILED, OK, SPLITS, run_command
from fpp_ml_bench.cli.explain import add_explain_options, as_asked, explain
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation import report, result, score, submission
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX, MODES, TARGETS
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders import storage
from fpp_ml_bench.machine import prepare_process

SUMMARY = "Score a folder of predictions: MAE and RMSE in mm over the full grid, the object and the background."
EXAMPLES = (
    "fpp-eval predictions --dataset data/mini --split test --json result.json",
    "fpp-eval predictions --dataset data/mini --split test --target depth_exact --report report",
    "fpp-eval init predictions",
    "fpp-eval check predictions",
    "fpp-eval compare result.json leaderboard/rows/phase-net-vertical.json",
    "fpp-eval verify result.json predictions --dataset data/mini",
    "fpp-eval schema",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's arguments."""
    add = parser.add_argument
    add(
        "folder",
        type=Path,
        metavar="DIR",
        help="folder of submission.yaml and one {sample}.npy, .npz, .mat or 16-bit .png per sample, or one "
        "predictions.parquet or .arrow: depth (H, W), 0 = background, in the units that submission.yaml declares; "
        "every problem is listed by file, and then no JSON is written",
    )
    add("--dataset", type=Path, required=True, metavar="DATASET", help="folder of the dataset")
    add("--split", choices=SPLITS, default="test", help="samples to score (default: test)")
    add(
        "--target",
        choices=TARGETS,
        default=TARGETS[0],
        help="depth: decoded from the noisy frames, as in the paper (default); depth_exact: from the ray cast",
    )
    add(
        "--edge-band",
        type=_band,
        default=EDGE_BAND_PX,
        metavar="PX",
        help=f"object pixels nearer than this to a depth edge count as edge (default: {EDGE_BAND_PX})",
    )
    add(
        "--mode",
        choices=MODES,
        default=MODES[0],
        help="standard: void pixels (unlit or mixed) count in no set (default); paper: the paper's sets, without void, "
        "and its rule for normalised depth; never ranked with the others",
    )
    add("--json", type=Path, metavar="FILE", help="write the result here, per-sample scores included")
    add("--report", type=Path, metavar="OUT", help="write an HTML page with figures into this folder")
    add_explain_options(parser)


def _band(text: str) -> int:
    if not text.isdecimal() or int(text) > 1000:
        raise argparse.ArgumentTypeError(f"expected whole pixels from 0 to 1000, got {text!r}")
    return int(text)


def run(args: argparse.Namespace) -> int:
    """Score, write the JSON if requested, print the table. Raises FppBenchError for anything that can't be scored."""
    with as_asked(args):
        prepare_process()
        _check_outputs(args.json, args.report, args.folder)
        dataset = storage.DatasetFolder(args.dataset)
        scored = score.evaluate(
            args.folder,
            dataset,
            args.split,
            args.target,
            args.edge_band,
            args.mode,
            while_scoring=lambda: report.result_table,
        )
        if args.json is not None:
            result.write_result(scored, args.json)
        if args.report is not None:
            report.write_report(scored, dataset, args.folder, args.report)
        from fpp_ml_bench.cli.console import show  # imports rich, which --help must not

        show(report.result_table(scored))  # when all is written: printing ends where nobody reads any more
        for written in (args.json, args.report):
            if written is not None:
                print(f"Written: {written}")
        has_expected_bytes, sentence = storage.benchmark_sentence(dataset.manifest)
        if not has_expected_bytes:
            print(f"fpp-eval: warning: {dataset.path}: {sentence}", file=sys.stderr)
        explain(args, lambda: score.explain_eval(dataset, args.split, args.target, args.edge_band))
    return OK


def _check_outputs(file: Path | None, page: Path | None, folder: Path) -> None:
    """Refuse, before any work, what can't be written or would be an extra file among the predictions."""
    inside = "is inside the predictions folder, where it would be an extra file; move it"
    if file is not None:
        if file.is_dir():
            raise SubmissionError(f"--json {file}: expected a file to write, found a folder")
        if not file.absolute().parent.is_dir():
            raise SubmissionError(f"--json {file}: the folder {file.parent} does not exist; make it first")
        if file.absolute().parent.resolve() == folder.resolve():
            raise SubmissionError(f"--json {file}: {inside} out")
    if page is not None:
        if page.is_file():
            raise SubmissionError(f"--report {page}: expected a folder to write into, found a file")
        if page.resolve().is_relative_to(folder.resolve()):
            raise SubmissionError(f"--report {page}: {inside}")


def _compare_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("first", type=Path, metavar="A.json", help="a result of fpp-eval --json, or a row of the leaderboard")
    add(
        "second",
        type=Path,
        metavar="B.json",
        help="a result of another method on the same data, split, target and track",
    )
    add("--json", type=Path, metavar="FILE", help="write the comparison here, each sample's included")


def _compare(args: argparse.Namespace) -> int:
    """Print the table and the sentence. Raises SubmissionError for results that can't be compared."""
    from fpp_ml_bench.cli.console import show
    from fpp_ml_bench.leaderboard.rows import alike, read_scored

    comparison = report.compare(*alike(read_scored(args.first), read_scored(args.second)))
    if args.json is not None:
        result.write_json(comparison.model_dump(mode="json"), args.json)
    show(report.comparison_table(comparison))
    return OK


def _schema_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "file",
        nargs="?",
        choices=("result", "submission", "comparison"),
        default="result",
        help="result: what fpp-eval writes (default); submission: submission.yaml; comparison: fpp-eval compare --json",
    )


def _schema(args: argparse.Namespace) -> int:
    print(json.dumps(result.json_schema(args.file), indent=1))
    return OK


LISTED = 20
"""Differences that ``verify`` prints."""


def _verify_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("result", type=Path, metavar="RESULT.json", help="a result of fpp-eval --json, or a row of the leaderboard")
    add("folder", type=Path, metavar="DIR", help="the predictions it was made from")
    add("--dataset", type=Path, required=True, metavar="DATASET", help="folder of the dataset")


def _verify(args: argparse.Namespace) -> int:
    """Say verified or not, and what differs. Raises FppBenchError where nothing can be recomputed at all."""
    from fpp_ml_bench.leaderboard import rows

    scored = rows.read_scored(args.result)
    dataset = storage.DatasetFolder(args.dataset)
    if isinstance(scored, result.Result):
        problems = score.differences(scored, args.folder, dataset)
    else:
        problems = rows.differences(scored, args.folder, dataset)
    file = printable(str(args.result), 500)
    unchecked = f"not checked: {', '.join(rows.not_checked(scored))}: predictions don't tell them"
    if not problems:
        print(f"verified: {file} is what {scored.dataset.samples} predictions give\n{unchecked}")
        return OK
    print(f"not verified: {file} differs from what the predictions give in {len(problems)} places")
    for line in problems[:LISTED]:
        print(f"  {line}")
    if len(problems) > LISTED:
        print(f"  ... and {len(problems) - LISTED} more")
    print(unchecked)
    return CHECK_FAILED


def _init_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder of the predictions, made if absent")


def _init(args: argparse.Namespace) -> int:
    print(f"Written: {submission.write_template(args.folder)}")
    print(f"next: fill it in, write one {{sample}}.npy for each sample beside it, then: fpp-eval check {args.folder}")
    return OK


def _check_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("folder", type=Path, metavar="DIR", help="folder of predictions and submission.yaml")
    add("--dataset", type=Path, metavar="DATASET", help="check names, sizes and frames against this dataset, too")
    add("--split", choices=SPLITS, default="test", help="samples expected with --dataset (default: test)")


def _check(args: argparse.Namespace) -> int:
    """Say whether a submission would be scored, as far as its own files tell. Raises FppBenchError for no folder."""
    dataset = None if args.dataset is None else storage.DatasetFolder(args.dataset)
    checked = score.check_folder(args.folder, dataset, args.split)
    folder = printable(str(args.folder), 500)
    for note in checked.notes:
        print(f"fpp-eval: note: {note}", file=sys.stderr)
    if checked.problems:
        print(f"{folder} would be refused, {len(checked.problems)} problem{'s' * (len(checked.problems) > 1)}:")
        for line in checked.problems:
            print(f"  {line}")
        return CHECK_FAILED
    height, width = checked.size
    sigma = ", with an uncertainty" if checked.sigmas else ""
    against = "" if dataset is None else f" of split {args.split}"
    print(f"{folder}: {len(checked.samples)} samples{against}, {checked.form}, {width}x{height} px{sigma}; sound")
    if checked.description is not None:
        frames, track = len(checked.description.frames_used), checked.description.track
        print(f"submission.yaml: {track} track, {frames} {'frame' if frames == 1 else 'frames'}; sound")
    return OK


SUBCOMMANDS = {
    "init": SimpleNamespace(
        SUMMARY="Write a submission.yaml to fill in; one that is there is not overwritten.",
        EXAMPLES=("fpp-eval init predictions",),
        add_arguments=_init_arguments,
        run=_init,
    ),
    "check": SimpleNamespace(
        SUMMARY="Check a submission before it is scored, without ground truth: exit status 0 sound, 1 refused.",
        EXAMPLES=("fpp-eval check predictions", "fpp-eval check predictions --dataset data/mini --split test"),
        add_arguments=_check_arguments,
        run=_check,
    ),
    "compare": SimpleNamespace(
        SUMMARY="Compare two results of the same samples: paired differences, their 95% intervals, and a plain "
        "sentence.",
        EXAMPLES=("fpp-eval compare a.json b.json", "fpp-eval compare a.json b.json --json difference.json"),
        add_arguments=_compare_arguments,
        run=_compare,
    ),
    "verify": SimpleNamespace(
        SUMMARY="Score the predictions again and say whether the result or row is verified (exit status 0) or not (1).",
        EXAMPLES=(
            "fpp-eval verify result.json predictions --dataset data/mini",
            "fpp-eval verify leaderboard/rows/mine.json predictions --dataset data/full",
        ),
        add_arguments=_verify_arguments,
        run=_verify,
    ),
    "schema": SimpleNamespace(
        SUMMARY="Print the JSON Schema (2020-12) of result.json or of submission.yaml.",
        EXAMPLES=("fpp-eval schema > result.schema.json", "fpp-eval schema submission"),
        add_arguments=_schema_arguments,
        run=_schema,
    ),
}
"""First words that select a subcommand. A folder of such a name is given as ./compare."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of ``fpp-eval``: exit status 0, 1 where ``verify`` finds a difference, 2 with the error on stderr."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words and words[0] in SUBCOMMANDS:
        return run_command(SUBCOMMANDS[words[0]], f"fpp-eval {words[0]}", words[1:])
    return run_command(sys.modules[__name__], "fpp-eval", words)
