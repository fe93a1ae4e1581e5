"""Staging results as ``.eval_results/*.yaml`` of a model's repository, from which the Hub fills its benchmark table.

Only numbers and fixed words of a result are published, no text that its author wrote.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from fpp_ml_bench.errors import PublishError
from fpp_ml_bench.evaluation.report import millimetres, percent
from fpp_ml_bench.evaluation.result import Result
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.publish_tasks import BENCHMARK, SCORE_TEXT, score, task_of
from fpp_ml_bench.leaderboard.rows import read_entry
from fpp_ml_bench.loaders.hub import Publication

FOLDER = ".eval_results"


def stage_results(
    paths: Sequence[Path], repo: str, dataset_repo: str, published: Mapping[str, Any], revision: str, folder: Path,
    source_url: str | None = None,
) -> Publication:  # fmt: skip
    """Write a file for each result into ``folder``; it replaces an earlier result of the same task.

    ``published`` is what the dataset's mark file says at ``revision``: a result scored on other data is refused, as is
    a result of another split or target, or without an object score (`PublishError`).
    """
    from huggingface_hub import eval_result_entries_to_yaml

    if source_url is not None and (urlsplit(source_url).scheme != "https" or not urlsplit(source_url).netloc):
        raise PublishError(f"--source-url: expected an https address, got {printable(source_url, 120)!r}")
    named: dict[str, Path] = {}
    (folder / FOLDER).mkdir()
    for path in paths:
        result, file = read_entry(path).result, printable(str(path), 300)
        if result.dataset.fingerprint != published.get("fingerprint"):
            fingerprint, published_fingerprint = (
                result.dataset.fingerprint[:12],
                printable(published.get("fingerprint"), 12),
            )
            raise PublishError(
                f"{file}: was scored on other data (fingerprint {fingerprint}) than {dataset_repo} holds "
                f"({published_fingerprint}); score the predictions on that dataset, or publish this one"
            )
        task = task_of(result, file)
        if task.id in named:
            raise PublishError(
                f"{printable(str(named[task.id]), 300)} and {file} are both results of {task.id}; a model has one of "
                "each, publish the other with its own model repository"
            )
        named[task.id] = path
        entry = _entry(result, file, task.id, dataset_repo, revision, source_url)
        name = f"{task.id}--{dataset_repo.replace('/', '--')}.yaml"
        (folder / FOLDER / name).write_bytes(_yaml(eval_result_entries_to_yaml([entry])).encode())
    return Publication("model", repo, folder, f"{BENCHMARK} results: {', '.join(named)}", must_exist=True)


def _yaml(content: Any) -> str:
    import yaml

    text: str = yaml.safe_dump(content, sort_keys=False, width=110, allow_unicode=False)
    return text


def _entry(result: Result, file: str, task: str, dataset_repo: str, revision: str, source_url: str | None) -> Any:
    from huggingface_hub import EvalResultEntry

    error_mm = result.metrics.object_mae_mm
    if error_mm is None:
        raise PublishError(f"{file}: has no object score (no sample shows an object), so there is nothing to rank by")
    return EvalResultEntry(
        dataset_id=dataset_repo,
        task_id=task,
        value=score(error_mm),
        dataset_revision=revision,
        date=result.created[:10],
        source_url=source_url,
        source_name=f"{BENCHMARK} leaderboard" if source_url is not None else None,
        notes=_notes(result),
    )


def _notes(result: Result) -> str:
    metrics, submission = result.metrics, result.submission
    ends = result.intervals.of("object_mae_mm")
    interval = f" (95% interval {millimetres(ends[0])} to {millimetres(ends[1])})" if ends is not None else ""
    frames = len(submission.frames_used)
    time = ""
    if submission.seconds_per_sample is not None:
        time = f"; {submission.seconds_per_sample:.4g} s per sample, {submission.seconds_source}"
    missing = percent(metrics.object_missing_share)
    return (
        f"{SCORE_TEXT}. Object MAE {millimetres(metrics.object_mae_mm)} mm{interval}, RMSE "
        f"{millimetres(metrics.object_rmse_mm)} mm; overall MAE {millimetres(metrics.overall_mae_mm)} mm; object "
        f"pixels missing {missing}; {result.dataset.samples} samples of {result.dataset.split}, {result.track} track, "
        f"{frames} {'frame' if frames == 1 else 'frames'}{time}; protocol {result.protocol_version}, dataset "
        f"{result.dataset.fingerprint[:12]}"
    )
