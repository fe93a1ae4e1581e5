"""What of a result does not follow from predictions: they are scored again, and every number is
compared.

A method run again on another machine does not give the same bytes: processors add float32 numbers
in another order, so phases differ in the last digits, and a few pixels that stand between two
orders, or between object and background, change sides. Nobody can tell such predictions from others
by their hash, but their errors hardly differ: `of_processors` says whether they stay within a
bound.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation import protocol
from fpp_ml_bench.evaluation.metrics import RANKED
from fpp_ml_bench.evaluation.result.model import Result, disagreements
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.submission.prediction_files import SUBMISSION_FILE
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.storage.store import DatasetFolder

Difference = tuple[str, object, object]
"""Name, stored value and the one that was computed again."""
PROCESSOR_ERROR = 1e-3
"""Relative difference of a score that processors may make."""
PROCESSOR_PIXELS = 1e-4
"""Share of an object's or sample's pixels that may change sides, each by the far end of the working
range at most. On an Intel and an AMD processor, fringe-net's background MAE of one object is 2.485
and 2.431 mm, which is 3e-5 of its pixels; object MAE is equal to 1e-4."""
PROCESSOR_MEAN_PIXELS = 3e-5
"""The same in means over all samples, where the changes of one cancel those of another."""
MOST_BY_PIXEL = 50.0
"""What a pixel can change in a score that is no error in mm: the negative log-likelihood, the
steepest of them."""
_HASHES = "prediction_sha256", "predictions_sha256", "sigma_sha256"
_SCORES = "metrics", "intervals", "per_object", "uncertainty"
_COMPARED: dict[str, Any] = {
    "dataset": {"size", "samples", "content", "code"},
    **dict.fromkeys(("frames_class", "edge_jump_mm", "submission", "per_sample"), True),
    "uncertainty": {"reliability", "sparsification", "per_sample"},
}
"""What of a result is compared; the rest follows from it, or is its time and place."""
_RUN_TIME = {"submission": {"seconds_per_sample", "seconds_source", "hardware", "timing"}}
"""`fpp-bench time` may write these into a result later; run times can't be recomputed from
predictions."""


class Verified(NamedTuple):
    """``lines``: what does not follow from the predictions, one for each difference;
    ``processors``: whether that is no more than what other processors change in the predictions of
    the same method."""

    lines: list[str]
    processors: bool = False


def differences(scored: Result, folder: Path, dataset: DatasetFolder) -> Verified:
    """What of a result does not follow from the predictions in ``folder`` on ``dataset``.
    Everything is scored again. Time and place of scoring and the method's run time are not
    compared. Raises what `evaluate` raises, and SubmissionError for a result of another protocol
    version, which this one can't recompute."""
    if scored.protocol_version != protocol.PROTOCOL_VERSION:
        raise SubmissionError(
            f"the result was scored by protocol {scored.protocol_version}, this is "
            f"{protocol.PROTOCOL_VERSION}; verify "
            "it with the version of fpp-ml-bench that its environment names, or score the "
            "predictions again"
        )
    here = printable(str(dataset.path), 200)
    for key, digest in scored.dataset.content.items():
        if dataset.content.get(key) != digest:
            scored_on = f"{digest} of {_value_text(scored.dataset.identity)} in the result"
            return Verified(
                [
                    f"dataset.content.{key}: {scored_on}, {dataset.content.get(key, 'none')} is "
                    f"what {here} has"
                ]
            )
    again = evaluate(
        folder, dataset, scored.dataset.split, scored.target, scored.edge_band_px, scored.mode
    )
    stored, computed = (
        result.model_dump(include=_COMPARED, exclude=_RUN_TIME) for result in (scored, again)
    )
    rows, again_rows = (
        {row["sample"]: row for row in part.pop("per_sample")} for part in (stored, computed)
    )
    block, again_block = (part.pop("uncertainty", None) for part in (stored, computed))
    deviations = list(disagreements(stored, computed))
    if rows.keys() != again_rows.keys():
        return Verified(
            [*difference_lines(deviations), "per_sample: other samples than the split has"]
        )
    for sample, row in again_rows.items():
        differing = disagreements(
            rows[sample], row, cancelling=1e-9 * (row["object_mae_mm"] or 0.0)
        )
        # Other predictions explain all the rest.
        first = sorted(differing, key=lambda difference: difference[0] not in _HASHES)
        deviations += [(f"{sample}: {name}", before, now) for name, before, now in first]
    if (block is None) != (again_block is None):
        said = [
            "there is none" if part is None else "there is one" for part in (block, again_block)
        ]
        return Verified(
            [
                *difference_lines(deviations),
                f"uncertainty: {said[0]} in the result, {said[1]} recomputed",
            ]
        )
    deviations += disagreements(block, again_block, "uncertainty", rounding=1e-12)  # nll is near 0
    means = [
        (f"metrics.{key}", *(getattr(result.metrics, key) for result in (scored, again)))
        for key in RANKED
    ]
    means = [difference for difference in means if difference[1] is not None]
    return Verified(
        difference_lines(deviations),
        of_processors([*deviations, *means], dataset.rig.working_range_mm[1]),
    )


def of_processors(deviations: Sequence[Difference], far_mm: float) -> bool:
    """Whether the differences of a result or row are hashes of predictions, and scores that differ
    by no more than `PROCESSOR_ERROR` and what `PROCESSOR_PIXELS` can change, ``far_mm`` each; means
    by `PROCESSOR_MEAN_PIXELS`. Scores that differ where the predictions do not are no work of a
    processor."""
    changed = {_place(name) for name, *_ in deviations if name.split(": ")[-1] in _HASHES}
    return bool(changed) and all(
        name.split(": ")[-1] in _HASHES
        or (
            (": " not in name or _place(name) in changed)
            and _within(name, stored, computed, far_mm)
        )
        for name, stored, computed in deviations
    )


def _place(name: str) -> str:
    """The sample of a difference; nothing for a row, whose hash is that of all its predictions."""
    return name.split(": ")[0] if ": " in name else ""


def _within(name: str, stored: object, computed: object, far_mm: float) -> bool:
    of_sample = ": " in name
    words = [word for word in name.split(": ")[-1].split(".") if not word.isdigit()]
    if not (
        isinstance(stored, float)
        and isinstance(computed, float)
        and (of_sample or words[0] in _SCORES)
    ):
        return False
    key, of_means = (
        words[-1],
        not of_sample and words[0] != "per_object" and "per_sample" not in words,
    )
    if key == "object_max_mm":
        return True  # one pixel is enough
    pixels, cost = (
        PROCESSOR_MEAN_PIXELS if of_means else PROCESSOR_PIXELS,
        far_mm if key.endswith("_mm") else MOST_BY_PIXEL,
    )
    if "rmse" in key:
        return bool(
            abs(stored**2 - computed**2) <= 2 * PROCESSOR_ERROR * stored**2 + pixels * cost**2
        )
    return bool(abs(stored - computed) <= PROCESSOR_ERROR * abs(stored) + pixels * cost)


def difference_lines(deviations: Iterable[Difference], file: str = "result") -> list[str]:
    """The `disagreements` of a ``file``, a line each."""
    return [
        f"{name}: {_value_text(stored)} in the {file}, {_value_text(value)} "
        + (f"in {SUBMISSION_FILE}" if name.startswith("submission.") else "recomputed")
        for name, stored, value in deviations
    ]


def _value_text(value: object) -> str:
    return printable(value if isinstance(value, str) else repr(value), 80)
