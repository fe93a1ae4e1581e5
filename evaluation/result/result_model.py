"""``result.json``: the scores of a submission on a split, as a strict model that checks itself.

A result that was edited by hand contradicts itself: averages, objects and intervals are recomputed from the per-sample
scores whenever a file is read, and overall is checked against object and background in every sample.
"""

from datetime import datetime
from typing import Annotated, Any

from pydantic import Field, SerializerFunctionWrapHandler, field_validator, model_serializer, model_validator

from fpp_ml_bench.evaluation.protocol import (
    BOOTSTRAP_RESAMPLES,
    BOOTSTRAP_SEED,
    CONFIDENCE,
    HEADLINE,
    RESULT_SCHEMA_VERSION,
    Mode,
    SchemaVersion,
    Target,
    Track,
)
from fpp_ml_bench.evaluation.result.checks import check_reliance, check_same, check_sample
from fpp_ml_bench.evaluation.result.parts import (
    Bootstrap,
    DatasetInfo,
    Environment,
    Headline,
    Intervals,
    Metrics,
    ObjectResult,
    SampleResult,
)
from fpp_ml_bench.evaluation.result.reliance_block import Reliance
from fpp_ml_bench.evaluation.result.summary import mean_over_samples, median_over_samples, per_object, pooled_scores
from fpp_ml_bench.evaluation.result.timing_block import Timing
from fpp_ml_bench.evaluation.schema import Count, StrictModel, Text
from fpp_ml_bench.evaluation.score import combine, intervals_over_objects
from fpp_ml_bench.evaluation.submission import Submission


class Result(StrictModel):
    """Everything that `fpp-eval` computes. Deterministic but for ``created`` and the machine in ``environment``."""

    schema_version: SchemaVersion
    protocol_version: Annotated[str, Field(pattern=r"^[0-9]{1,4}\.[0-9]{1,4}\.[0-9]{1,4}$")]
    created: str
    submission: Submission
    dataset: DatasetInfo
    target: Target
    mode: Mode
    edge_band_px: Annotated[int, Field(ge=0, le=1000)]
    edge_jump_mm: Annotated[float, Field(gt=0)]
    metrics: Metrics
    intervals: Intervals
    median: Metrics
    pooled: Headline
    samples_without_object: Count
    samples_without_background: Count
    per_object: list[ObjectResult] = Field(max_length=100_000)
    per_sample: list[SampleResult] = Field(max_length=100_000)
    bootstrap: Bootstrap
    seeds: dict[Text, Count]
    environment: Environment
    reliance: Reliance | None = None

    @model_serializer(mode="wrap")
    def _without_absent(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # Absent where it was not measured, so that files without this key stay as they are.
        content: dict[str, Any] = handler(self)
        if self.reliance is None:
            content.pop("reliance", None)
        return content

    @property
    def track(self) -> Track:
        return self.submission.track

    @property
    def timing(self) -> Timing | None:
        """What `fpp-bench time` measured, or what the submission reports; None where it reports nothing."""
        return self.submission.timing

    @field_validator("created")
    @classmethod
    def _is_a_time(cls, value: str) -> str:
        if len(value) > 40 or datetime.fromisoformat(value).tzinfo is None:
            raise ValueError("expected an ISO 8601 time with its offset, like 2026-01-31T12:00:00+00:00")
        return value

    @model_validator(mode="after")
    def _consistent(self) -> "Result":
        height, width = self.dataset.size
        if len(self.per_sample) != self.dataset.samples:
            raise ValueError(
                f"per_sample holds {len(self.per_sample)} samples, dataset.samples says {self.dataset.samples}"
            )
        if len({row.sample for row in self.per_sample}) != len(self.per_sample):
            raise ValueError("per_sample names a sample twice")
        if self.mode == "paper-individual" and not self.submission.uses_ground_truth_range:
            raise ValueError("mode paper-individual needs the sample's depth range, so its track is oracle range")
        if self.reliance is not None:
            check_reliance(self.reliance, self.submission)
        for row in self.per_sample:
            check_sample(row, height * width)
        stored = self.model_dump(include=set(derived := _derived(self.per_sample)))
        for key, computed in derived.items():
            check_same(key, stored[key], computed)
        return self


def _derived(per_sample: list[SampleResult]) -> dict[str, Any]:
    """Every key of `Result` that follows from the per-sample scores."""
    rows, objects = [row.scores() for row in per_sample], [row.object for row in per_sample]
    inside = combine(*(row.stats("object") for row in per_sample))
    outside = combine(*(row.stats("background") for row in per_sample))
    intervals = intervals_over_objects(rows, objects, HEADLINE)
    return {
        "metrics": mean_over_samples(rows),
        "intervals": {key: [None, None] if ends is None else list(ends) for key, ends in intervals.items()},
        "median": median_over_samples(rows),
        "pooled": pooled_scores(inside, outside),
        "samples_without_object": sum(row.object_pixels == 0 for row in per_sample),
        "samples_without_background": sum(row.background_pixels == 0 for row in per_sample),
        "per_object": per_object(rows, objects),
        "bootstrap": {
            "method": "expanded percentile",
            "over": "objects",
            "resamples": BOOTSTRAP_RESAMPLES,
            "confidence": CONFIDENCE,
        },
        "seeds": {"bootstrap": BOOTSTRAP_SEED},
    }


def result_from_rows(rows: list[dict[str, Any]], **fields: Any) -> Result:
    """A `Result` from ``per_sample`` rows (keys of `SampleResult`) and the remaining keys; averages are made here."""
    per_sample = [SampleResult(**row) for row in rows]
    return Result(schema_version=RESULT_SCHEMA_VERSION, per_sample=per_sample, **_derived(per_sample), **fields)
