"""Whether a result follows from its predictions: everything is scored again, every difference is named."""

from pathlib import Path

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import METRICS, PROTOCOL_VERSION
from fpp_ml_bench.evaluation.result import Result, SampleResult, dataset_identity, same
from fpp_ml_bench.evaluation.score.evaluator import ScoredDataset, evaluate
from fpp_ml_bench.files import printable

_TIME_KEYS = ("seconds_per_sample", "seconds_source", "hardware", "timing")
"""`fpp-bench time` may write these into a result later; run times can't be recomputed from predictions."""


def differences(result: Result, folder: Path, dataset: ScoredDataset) -> list[str]:
    """What of ``result`` does not follow from the predictions in ``folder`` on ``dataset``, a line for each difference.

    Time and place of scoring and the method's run time are not compared. Raises what `evaluate` raises, and
    SubmissionError for a result of another protocol version, which this version can't recompute.
    """
    if result.protocol_version != PROTOCOL_VERSION:
        raise SubmissionError(
            f"the result was scored by protocol {result.protocol_version}, this is {PROTOCOL_VERSION}; verify it with "
            "the version of fpp-ml-bench that its environment names, or score the predictions again"
        )
    if result.dataset.fingerprint != dataset.fingerprint:
        return [
            f"dataset.fingerprint: {_value_text(result.dataset.identity)} in the result, "
            f"{dataset_identity(dataset.fingerprint)} is what {printable(str(dataset.path), 200)} has"
        ]
    recomputed = evaluate(folder, dataset, result.dataset.split, result.target, result.edge_band_px, result.mode)
    problems = [
        f"{name}: {_value_text(stored)} in the result, {_value_text(value)} recomputed"
        for name, stored, value in (
            ("dataset.size", result.dataset.size, recomputed.dataset.size),
            ("dataset.samples", result.dataset.samples, recomputed.dataset.samples),
            ("edge_jump_mm", result.edge_jump_mm, recomputed.edge_jump_mm),
        )
        if stored != value
    ]
    problems += _submission_differences(result, recomputed)
    stored_rows = {row.sample: row for row in result.per_sample}
    if set(stored_rows) != {row.sample for row in recomputed.per_sample}:
        return [*problems, "per_sample: other samples than the split has"]
    for row in recomputed.per_sample:
        problems += _sample_differences(stored_rows[row.sample], row)
    return problems


def _submission_differences(result: Result, recomputed: Result) -> list[str]:
    stored, described = result.submission.model_dump(), recomputed.submission.model_dump()
    return [
        f"submission.{key}: {_value_text(stored.get(key))} in the result, {_value_text(described.get(key))} in "
        "submission.yaml"
        for key in dict.fromkeys((*stored, *described))
        if key not in _TIME_KEYS and stored.get(key) != described.get(key)
    ]


def _sample_differences(stored: SampleResult, recomputed: SampleResult) -> list[str]:
    exact = ("object", "prediction_sha256", "object_pixels", "background_pixels")
    keys = [key for key in exact if getattr(stored, key) != getattr(recomputed, key)]
    object_mae_mm = recomputed.object_mae_mm or 0.0
    for key in METRICS:
        # Signed means and the error without an offset are small differences of large numbers.
        rounding_mm = 1e-9 * object_mae_mm if "bias" in key or "shift_free" in key else 0.0
        if not same(getattr(stored, key), getattr(recomputed, key), rounding_mm):
            keys.append(key)
    return [
        f"{recomputed.sample}: {key}: {_value_text(getattr(stored, key))} in the result, "
        f"{_value_text(getattr(recomputed, key))} recomputed"
        for key in keys
    ]


def _value_text(value: object) -> str:
    return printable(value if isinstance(value, str) else repr(value), 80)
