"""``fpp-eval``: score a folder of predictions against one split of a dataset, and work on
results."""

import sys
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING

from fpp_ml_bench.cli import CHECK_FAILED, OK
from fpp_ml_bench.cli.options import SPLITS, Explain, command, new_file, new_folder, value
from fpp_ml_bench.errors import DatasetError, SubmissionError
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX, MODES, TARGETS
from fpp_ml_bench.files import printable
from fpp_ml_bench.machine import prepare_process
from fpp_ml_bench.options import argument, option

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.storage.store import DatasetFolder

LISTED = 20
"""Differences that ``verify`` prints."""


@command(
    """\
fpp-eval predictions --json result.json
fpp-eval predictions data/mini --split test --target depth_exact --report report
fpp-eval predictions-rigs data/rigs --json rigs.json      a table of all rigs, per mille of depth
"""
)
def score_folder(
    *,
    predictions: Path = argument(
        "folder of submission.yaml and one {sample}.npy, .npz, .mat or 16-bit .png per sample, or "
        "one "
        "predictions.parquet or .arrow: depth (H, W), 0 = background, in the units that "
        "submission.yaml declares; "
        "every problem is listed by file, and then no JSON is written",
        "PREDICTIONS",
    ),
    dataset: Path | None = argument(
        "folder of the dataset (default: the one that fpp-bench predict read, by submission.yaml), or "
        "of several, of a track of rigs, whose predictions are in folders of the same names",
        "DATASET",
        None,
    ),
    split: str | None = option(
        None,
        "samples to score (default: those that were predicted by submission.yaml, else test)",
        choices=SPLITS,
    ),
    target: str = option(
        TARGETS[0],
        "depth: decoded from the noisy frames, as in the paper (default); depth_exact: from the "
        "ray cast",
        choices=TARGETS,
    ),
    edge_band: int = option(
        EDGE_BAND_PX,
        f"object pixels nearer than this to a depth edge count as edge (default: {EDGE_BAND_PX})",
        "PX",
        parse=value("whole pixels from 0 to 1000", int, lambda band: 0 <= band <= 1000),
    ),
    mode: str = option(
        MODES[0],
        "standard: void pixels (unlit or mixed) count in no set (default); paper: the paper's "
        "sets, without void, and "
        "its rule for normalised depth; never ranked with the others",
        choices=MODES,
    ),
    json: Path | None = option(
        None,
        "write the result here, per-sample scores included; - is standard output",
        "FILE",
        parse=new_file,
    ),
    page: Path | None = option(
        None,
        "write an HTML page with figures into this folder",
        "DIR",
        flag="--report",
        parse=new_folder,
    ),
    into: Path | None = option(
        None,
        "of a track of rigs: write its scores into this result or leaderboard row of the same "
        "method (.json)",
        "FILE",
    ),
    account: Explain,
) -> None:
    """Score a folder of predictions: MAE and RMSE in mm over the full grid, the object and the
    background.

    Raises FppBenchError for anything that can't be scored."""
    from fpp_ml_bench.evaluation.result.file import write_result
    from fpp_ml_bench.evaluation.score.evaluator import evaluate as evaluate_folder
    from fpp_ml_bench.evaluation.score.evaluator import explain_eval
    from fpp_ml_bench.loaders.storage.benchmark import benchmark_sentence
    from fpp_ml_bench.loaders.storage.manifest import datasets_below

    prepare_process()
    _check_outputs(json, page, predictions)
    if dataset is not None and (datasets := datasets_below(dataset)):
        _score_track(predictions, datasets, json, page, into)
        return
    if into is not None:
        raise SubmissionError(
            f"--into {into}: is for the scores of a track of rigs; use --json FILE"
        )
    opened, split = scored_data(predictions, dataset, split)
    notes: list[str] = []
    scored = evaluate_folder(predictions, opened, split, target, edge_band, mode, say=notes.append)
    if json is not None:
        write_result(scored, json)
    if page is not None:
        from fpp_ml_bench.evaluation.report.report_page import write_report  # draws with matplotlib

        write_report(scored, opened, predictions, page)
    from fpp_ml_bench.cli.console import show  # imports rich, which --help must not
    from fpp_ml_bench.evaluation.report.terminal import result_table

    show(result_table(scored))  # when all is written: printing ends where nobody reads any more
    for written in (json, page):
        if written is not None:
            print(f"Written: {written}")
    has_expected_bytes, sentence = benchmark_sentence(opened.manifest)
    if not has_expected_bytes:
        print(f"fpp-eval: warning: {opened.path}: {sentence}", file=sys.stderr)
    for note in notes:
        print(f"fpp-eval: note: {note}", file=sys.stderr)
    account.say(lambda: explain_eval(opened, split, target))


def _score_track(
    predictions: Path,
    datasets: dict[str, Path],
    json: Path | None,
    page: Path | None,
    into: Path | None,
) -> None:
    """Score a folder of predictions of several rigs. A file that can't take the scores is refused
    before anything is scored."""
    from fpp_ml_bench.cli.console import progress_bar, show
    from fpp_ml_bench.evaluation.result.file import write_json
    from fpp_ml_bench.evaluation.score.track import score_track, track_table
    from fpp_ml_bench.leaderboard.rows import read_entry, write_block

    if page is not None:
        raise SubmissionError(
            f"--report {page}: is of one dataset; give one of {', '.join(datasets)} and its "
            f"predictions"
        )
    entry = None if into is None else read_entry(into)
    with progress_bar("scoring", len(datasets), "datasets") as advance:
        scores = score_track(predictions, datasets, advance)
    if json is not None:
        write_json(scores.model_dump(mode="json"), json)
    if entry is not None:
        write_block(entry, scores)
    show(track_table(scores))
    for name, reason in scores.refused.items():
        print(f"{name}: refused. {reason}")
    for written in (json, into):
        if written is not None:
            print(f"Written: {written}")


def scored_data(folder: Path, place: Path | None, split: str | None) -> "tuple[DatasetFolder, str]":
    """The dataset in ``place`` and the ``split`` to score; where they are not given, those that
    ``folder`` was predicted from, by its submission.yaml. Raises `SubmissionError` where that does
    not say, and `DatasetError` where the dataset is gone; whether it is still the same is checked
    when it is scored."""
    from fpp_ml_bench.evaluation.submission.prediction_files import (
        SUBMISSION_FILE,
        predictions_folder,
        read_plain,
    )
    from fpp_ml_bench.loaders.storage.store import DatasetFolder

    shown, predicted_from = printable(str(folder), 500), Path()
    predictions_folder(folder)
    give = f"give the dataset: fpp-eval {shown} DATASET"
    try:  # by hand: pydantic, which takes long to import, checks the file while the first samples are scored
        predicted = read_plain(folder).get("predicted") or {}
        predicted_from, split = Path(predicted["dataset"]), split or str(predicted["split"])
    except SubmissionError as error:
        if place is None:
            raise SubmissionError(f"{error}; {give}") from None
    except (AttributeError, KeyError, TypeError):
        if place is None:
            file = SUBMISSION_FILE
            raise SubmissionError(
                f"{shown}: {file} does not say (predicted:) what was predicted; {give}"
            ) from None
    if place is not None:
        return DatasetFolder(place), split or "test"
    try:
        dataset = DatasetFolder(predicted_from)
    except DatasetError as error:
        raise DatasetError(
            f"{error}. {shown} was predicted from there; if the data was moved, {give}"
        ) from None
    return dataset, split or "test"


def _check_outputs(file: Path | None, page: Path | None, folder: Path) -> None:
    """Refuse, before any work, what would be an extra file among the predictions."""
    inside = "is inside the predictions folder, where it would be an extra file; move it"
    if file is not None and file.absolute().parent.resolve() == folder.resolve():
        raise SubmissionError(f"--json {file}: {inside} out")
    if page is not None and page.resolve().is_relative_to(folder.resolve()):
        raise SubmissionError(f"--report {page}: {inside}")


@command(
    """\
fpp-eval init predictions
"""
)
def init(
    *,
    predictions: Path = argument("folder of the predictions, made if absent", "PREDICTIONS"),
) -> None:
    """Write a submission.yaml to fill in; one that is there is not overwritten."""
    from fpp_ml_bench.evaluation.submission.description import write_template

    print(f"Written: {write_template(predictions)}")
    print(
        f"next: fill it in, write one {{sample}}.npy for each sample beside it, then: fpp-eval "
        f"check {predictions}"
    )


@command(
    """\
fpp-eval check predictions
fpp-eval check predictions data/mini --split test
"""
)
def check(
    *,
    predictions: Path = argument("folder of predictions and submission.yaml", "PREDICTIONS"),
    dataset: Path | None = argument(
        "check names, sizes and frames against this dataset, too", "DATASET", None
    ),
    split: str = option("test", "samples expected with DATASET (default: test)", choices=SPLITS),
) -> int:
    """Check a submission before it is scored, without ground truth: exit status 0 sound, 1 refused.

    Raises FppBenchError for no folder."""
    from fpp_ml_bench.evaluation.score.check import check_folder
    from fpp_ml_bench.loaders.storage.store import DatasetFolder

    opened = None if dataset is None else DatasetFolder(dataset)
    checked = check_folder(predictions, opened, split)
    folder = printable(str(predictions), 500)
    for note in checked.notes:
        print(f"fpp-eval: note: {note}", file=sys.stderr)
    if checked.problems:
        print(
            f"{folder} would be refused, {len(checked.problems)} "
            f"problem{'s' * (len(checked.problems) > 1)}:"
        )
        for line in checked.problems:
            print(f"  {line}")
        return CHECK_FAILED
    height, width = checked.size
    listing, sigma = checked.listing, ", with an uncertainty" if checked.listing.sigmas else ""
    against = "" if dataset is None else f" of split {split}"
    print(
        f"{folder}: {len(listing.present)} samples{against}, {listing.form}, {width}x{height} "
        f"px{sigma}; sound"
    )
    if checked.description is not None:
        frames, track = len(checked.description.frames_used), checked.description.track
        print(
            f"submission.yaml: {track} track, {frames} {'frame' if frames == 1 else 'frames'}; "
            f"sound"
        )
    return OK


@command(
    """\
fpp-eval compare a.json b.json
fpp-eval compare a.json b.json --json difference.json
"""
)
def compare(
    *,
    first: Path = argument("a result of fpp-eval --json, or a row of the leaderboard", "A.json"),
    second: Path = argument(
        "a result of another method on the same data, split, target and track", "B.json"
    ),
    json: Path | None = option(
        None,
        "write the comparison here, each sample's included; - is standard output",
        "FILE",
        parse=new_file,
    ),
) -> None:
    """Compare two results of the same samples: paired differences, their 95% intervals, and a
    sentence on them.

    Raises SubmissionError for results that can't be compared."""
    from fpp_ml_bench.cli.console import show
    from fpp_ml_bench.evaluation.report.comparison import compare as compare_results
    from fpp_ml_bench.evaluation.report.terminal import comparison_table
    from fpp_ml_bench.evaluation.result.file import write_json
    from fpp_ml_bench.leaderboard.rows import alike, read_scored

    comparison = compare_results(*alike(read_scored(first), read_scored(second)))
    if json is not None:
        write_json(comparison.model_dump(mode="json"), json)
    show(comparison_table(comparison))


@command(
    """\
fpp-eval verify result.json predictions data/mini
fpp-eval verify leaderboard/rows/mine.json predictions data/full
"""
)
def verify(
    *,
    file: Path = argument(
        "a result of fpp-eval --json, or a row of the leaderboard", "RESULT.json"
    ),
    predictions: Path = argument("the predictions it was made from", "PREDICTIONS"),
    dataset: Path = argument("folder of the dataset", "DATASET"),
) -> int:
    """Score the predictions again and say whether the result or row is verified, or the same within
    what processors change (exit status 0), or not the same (1).

    Raises FppBenchError where nothing can be recomputed at all."""
    from fpp_ml_bench.evaluation.result.model import Result
    from fpp_ml_bench.evaluation.score import verification
    from fpp_ml_bench.leaderboard import rows
    from fpp_ml_bench.loaders.storage.store import DatasetFolder

    scored, opened = rows.read_scored(file), DatasetFolder(dataset)
    differences = verification.differences if isinstance(scored, Result) else rows.differences
    comparison, shown = differences(scored, predictions, opened), printable(str(file), 500)  # type: ignore[arg-type]
    problems, samples = comparison.lines, scored.dataset.samples
    unchecked = f"not checked: {', '.join(rows.not_checked(scored))}: predictions don't tell them"
    if not problems:
        print(f"verified: {shown} is what {samples} predictions give\n{unchecked}")
        return OK
    if comparison.processors:
        print(
            f"the same within what processors change: {shown} and what {samples} predictions give. "
            f"These are other "
            f"predictions, but each error differs by at most {verification.PROCESSOR_ERROR:.1%} "
            f"and what "
            f"{verification.PROCESSOR_PIXELS:.2%} of the pixels can make, and their means by what "
            f"{verification.PROCESSOR_MEAN_PIXELS:.3%} can\n{unchecked}"
        )
        return OK
    print(f"not the same: {shown} differs from what the predictions give in {len(problems)} places")
    for line in problems[:LISTED]:
        print(f"  {line}")
    if len(problems) > LISTED:
        print(f"  ... and {len(problems) - LISTED} more")
    print(unchecked)
    return CHECK_FAILED


@command(
    """\
fpp-eval schema > result.schema.json
fpp-eval schema submission
"""
)
def schema(
    *,
    file: str = argument(
        "result: what fpp-eval writes (default); submission: submission.yaml; comparison: fpp-eval "
        "compare --json",
        "result|submission|comparison",
        "result",
        choices=("result", "submission", "comparison"),
    ),
) -> None:
    """Print the JSON Schema (2020-12) of result.json or of submission.yaml."""
    from fpp_ml_bench.evaluation.result.file import json_schema

    print(dumps(json_schema(file), indent=1))
