"""Whether a result says what its predictions give: everything scored again, every difference named."""

from pathlib import Path
from typing import Any

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.evaluator import ScoredDataset, evaluate
from fpp_ml_bench.evaluation.protocol import METRICS, PROTOCOL_VERSION
from fpp_ml_bench.evaluation.result import Result
from fpp_ml_bench.evaluation.result_checks import same
from fpp_ml_bench.evaluation.result_models import dataset_identity
from fpp_ml_bench.evaluation.text import printable

_TIME_KEYS = ("seconds_per_sample", "seconds_source", "hardware", "timing")
"""`fpp-bench time` may write these into a result later; run times can't be recomputed from predictions anyway."""


def differences(result: Result, folder: Path, dataset: ScoredDataset) -> list[str]:
    """What of ``result`` does not follow from the predictions in ``folder`` on ``dataset``, one line each; none: sound.

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
            f"dataset.fingerprint: {_shown(result.dataset.identity)} in the result, "
            f"{dataset_identity(dataset.fingerprint)} is what {printable(str(dataset.path), 200)} has"
        ]
    again = evaluate(folder, dataset, result.dataset.split, result.target, result.edge_band_px, result.mode)
    problems = [
        f"{name}: {_shown(one)} in the result, {_shown(two)} recomputed"
        for name, one, two in (
            ("dataset.size", result.dataset.size, again.dataset.size),
            ("dataset.samples", result.dataset.samples, again.dataset.samples),
            ("edge_jump_mm", result.edge_jump_mm, again.edge_jump_mm),
        )
        if one != two
    ]
    problems += _submission(result, again)
    stored = {row.sample: row for row in result.per_sample}
    if set(stored) != {row.sample for row in again.per_sample}:
        return [*problems, "per_sample: other samples than the split has"]
    for row in again.per_sample:
        problems += _sample(stored[row.sample], row)
    return problems


def _submission(result: Result, again: Result) -> list[str]:
    one, two = result.submission.model_dump(), again.submission.model_dump()
    return [
        f"submission.{key}: {_shown(one.get(key))} in the result, {_shown(two.get(key))} in submission.yaml"
        for key in dict.fromkeys((*one, *two))
        if key not in _TIME_KEYS and one.get(key) != two.get(key)
    ]


def _sample(stored: Any, again: Any) -> list[str]:
    exact = ("object", "prediction_sha256", "object_pixels", "background_pixels")
    problems = [
        f"{again.sample}: {key}: {_shown(getattr(stored, key))} in the result, {_shown(getattr(again, key))} recomputed"
        for key in exact
        if getattr(stored, key) != getattr(again, key)
    ]
    scale = again.object_mae_mm or 0.0
    for key in METRICS:
        one, two = getattr(stored, key), getattr(again, key)
        # Signed means and what is left of a shift are small differences of large numbers.
        dust = 1e-9 * scale if "bias" in key or "shift_free" in key else 0.0
        if not same(one, two, dust):
            problems.append(f"{again.sample}: {key}: {_shown(one)} in the result, {_shown(two)} recomputed")
    return problems


def _shown(value: object) -> str:
    return printable(value if isinstance(value, str) else repr(value), 80)
