"""``result.json``: one submission's scores on one split, as a strict model that checks itself.

A result that was edited by hand contradicts itself: the averages are recomputed from the per-sample scores whenever a
file is read, and overall is checked against object and background in every sample.
"""

import math
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from fpp_ml_bench.evaluation.protocol import HEADLINE, METRICS, RESULT_SCHEMA_VERSION, SchemaVersion, Target, Track
from fpp_ml_bench.evaluation.schema import Count, NonNegative, Share, StrictModel, Text
from fpp_ml_bench.evaluation.scores import ErrorStats, combine
from fpp_ml_bench.evaluation.submission import Submission
from fpp_ml_bench.evaluation.summary import mean_over_samples, median_over_samples, pooled_scores
from fpp_ml_bench.evaluation.timing import HardwareInfo, Timing

AGREES = 1e-9
"""Relative difference at which two computations of one average still count as the same number."""

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Headline(StrictModel):
    """The paper's six errors in mm; null for a pixel set that is empty."""

    overall_mae_mm: NonNegative | None
    overall_rmse_mm: NonNegative | None
    object_mae_mm: NonNegative | None
    object_rmse_mm: NonNegative | None
    background_mae_mm: NonNegative | None
    background_rmse_mm: NonNegative | None


class Metrics(Headline):
    """The headline and what stands beside it: errors in mm, shares of the object's pixels."""

    object_interior_mae_mm: NonNegative | None
    object_interior_rmse_mm: NonNegative | None
    object_edge_mae_mm: NonNegative | None
    object_edge_rmse_mm: NonNegative | None
    object_valid_mae_mm: NonNegative | None
    object_interior_valid_mae_mm: NonNegative | None
    object_edge_share: Share | None
    object_missing_share: Share | None
    object_interior_missing_share: Share | None


class SampleResult(Metrics):
    """Scores of one sample, how many pixels each set has, and the hash of the prediction file they come from."""

    sample: Text
    prediction_sha256: Sha256
    object_pixels: Count
    background_pixels: Count

    def scores(self) -> dict[str, float | None]:
        return {key: getattr(self, key) for key in METRICS}

    def stats(self, pixels: str) -> ErrorStats:
        """Errors of the ``object`` or the ``background`` set."""
        count = getattr(self, f"{pixels}_pixels")
        return ErrorStats(count, getattr(self, f"{pixels}_mae_mm"), getattr(self, f"{pixels}_rmse_mm"))


class DatasetInfo(StrictModel):
    """What was scored on. ``fingerprint`` identifies the data to the byte; ``name`` is only the folder's name."""

    name: Text
    fingerprint: Sha256
    split: Literal["train", "validation", "test", "all"]
    size: Annotated[list[Annotated[int, Field(gt=0)]], Field(min_length=2, max_length=2)]
    samples: Annotated[int, Field(gt=0)]


class Environment(StrictModel):
    """Where and with what the scores were computed (not where the predictions were made: see ``submission``)."""

    python: Text
    packages: dict[Text, Text] = Field(max_length=100)
    hardware: HardwareInfo


class Result(StrictModel):
    """Everything `fpp-eval` found out. Deterministic but for ``created`` and the machine in ``environment``."""

    schema_version: SchemaVersion
    protocol_version: Annotated[str, Field(pattern=r"^[0-9]{1,4}\.[0-9]{1,4}\.[0-9]{1,4}$")]
    created: str
    submission: Submission
    dataset: DatasetInfo
    target: Target
    edge_band_px: Annotated[int, Field(ge=0, le=1000)]
    edge_jump_mm: Annotated[float, Field(gt=0)]
    metrics: Metrics
    median: Metrics
    pooled: Headline
    samples_without_object: Count
    samples_without_background: Count
    per_sample: list[SampleResult] = Field(max_length=100_000)
    environment: Environment

    @property
    def track(self) -> Track:
        return self.submission.track

    @property
    def timing(self) -> Timing | None:
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
        for row in self.per_sample:
            _check_sample(row, height * width)
        rows = [row.scores() for row in self.per_sample]
        inside = combine(*(row.stats("object") for row in self.per_sample))
        outside = combine(*(row.stats("background") for row in self.per_sample))
        _check_equal("metrics", self.metrics, mean_over_samples(rows))
        _check_equal("median", self.median, median_over_samples(rows))
        _check_equal("pooled", self.pooled, pooled_scores(inside, outside))
        for pixels in ("object", "background"):
            empty = sum(getattr(row, f"{pixels}_pixels") == 0 for row in self.per_sample)
            if getattr(self, f"samples_without_{pixels}") != empty:
                raise ValueError(f"samples_without_{pixels} is not the number of such samples, {empty}")
        return self


def _check_sample(row: SampleResult, pixels: int) -> None:
    if row.object_pixels + row.background_pixels != pixels:
        raise ValueError(f"{row.sample}: object and background pixels do not add up to the image's {pixels}")
    for name in ("object", "background"):
        stats = row.stats(name)
        if (stats.pixels == 0) != (stats.mae_mm is None) or (stats.pixels == 0) != (stats.rmse_mm is None):
            raise ValueError(f"{row.sample}: {name} scores must be null exactly when the set is empty")
        if stats.mae_mm is not None and stats.rmse_mm is not None and stats.rmse_mm < stats.mae_mm * (1 - AGREES):
            raise ValueError(f"{row.sample}: {name} RMSE is below its MAE, which no error has")
    overall = combine(row.stats("object"), row.stats("background"))
    if not (_same(row.overall_mae_mm, overall.mae_mm) and _same(row.overall_rmse_mm, overall.rmse_mm)):
        raise ValueError(f"{row.sample}: overall scores do not follow from object and background")


def _check_equal(name: str, stored: Headline, computed: dict[str, float | None]) -> None:
    for key in METRICS if isinstance(stored, Metrics) else HEADLINE:
        if not _same(getattr(stored, key), computed[key]):
            raise ValueError(
                f"{name}.{key} does not follow from per_sample: {getattr(stored, key)}, not {computed[key]}"
            )


def _same(one: float | None, other: float | None) -> bool:
    if one is None or other is None:
        return one is other
    return math.isclose(one, other, rel_tol=AGREES)


def result_from_rows(rows: list[dict[str, Any]], **about: Any) -> Result:
    """A `Result` from ``per_sample`` rows (keys of `SampleResult`) and the remaining keys; averages are made here."""
    per_sample = [SampleResult(**row) for row in rows]
    scores = [row.scores() for row in per_sample]
    inside = combine(*(row.stats("object") for row in per_sample))
    outside = combine(*(row.stats("background") for row in per_sample))
    return Result(
        schema_version=RESULT_SCHEMA_VERSION,
        metrics=Metrics(**mean_over_samples(scores)),
        median=Metrics(**median_over_samples(scores)),
        pooled=Headline(**pooled_scores(inside, outside)),
        samples_without_object=sum(row.object_pixels == 0 for row in per_sample),
        samples_without_background=sum(row.background_pixels == 0 for row in per_sample),
        per_sample=per_sample,
        **about,
    )
