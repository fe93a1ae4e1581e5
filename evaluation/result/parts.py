"""The parts of ``result.json`` as strict models: scores, samples, objects, data, and what was scored with what."""

from typing import Annotated, Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from fpp_ml_bench.evaluation.protocol import METRICS
from fpp_ml_bench.evaluation.result.timing_block import HardwareInfo
from fpp_ml_bench.evaluation.schema import Count, NonNegative, Share, StrictModel, Text
from fpp_ml_bench.evaluation.score import ErrorStats
from fpp_ml_bench.loaders.storage import benchmark as benchmarks

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Interval = Annotated[list[float | None], Field(min_length=2, max_length=2)]


class Headline(StrictModel):
    """The paper's six errors in mm; null for a pixel set that is empty."""

    overall_mae_mm: NonNegative | None
    overall_rmse_mm: NonNegative | None
    object_mae_mm: NonNegative | None
    object_rmse_mm: NonNegative | None
    background_mae_mm: NonNegative | None
    background_rmse_mm: NonNegative | None


class Metrics(Headline):
    """All scores: errors in mm, shares of the object's pixels. PROTOCOL.md defines each."""

    object_interior_mae_mm: NonNegative | None
    object_interior_rmse_mm: NonNegative | None
    object_edge_mae_mm: NonNegative | None
    object_edge_rmse_mm: NonNegative | None
    object_valid_mae_mm: NonNegative | None
    object_interior_valid_mae_mm: NonNegative | None
    object_edge_share: Share | None
    object_missing_share: Share | None
    object_interior_missing_share: Share | None
    object_median_mm: NonNegative | None
    object_p95_mm: NonNegative | None
    object_max_mm: NonNegative | None
    object_within_1mm_share: Share | None
    object_within_2mm_share: Share | None
    object_within_5mm_share: Share | None
    object_within_10mm_share: Share | None
    object_bias_mm: float | None
    object_valid_bias_mm: float | None
    object_shift_free_mae_mm: NonNegative | None
    object_wide_band_mae_mm: NonNegative | None
    object_wide_interior_mae_mm: NonNegative | None
    object_wide_band_share: Share | None


class SampleResult(Metrics):
    """Scores of one sample, how many pixels each set has, and the hash of the prediction file they come from."""

    sample: Text
    object: Text
    prediction_sha256: Sha256
    object_pixels: Count
    background_pixels: Count

    def scores(self) -> dict[str, float | None]:
        return {key: getattr(self, key) for key in METRICS}

    def stats(self, pixels: str) -> ErrorStats:
        """Errors of the ``object`` or the ``background`` set."""
        count = getattr(self, f"{pixels}_pixels")
        return ErrorStats(count, getattr(self, f"{pixels}_mae_mm"), getattr(self, f"{pixels}_rmse_mm"))


class ObjectResult(StrictModel):
    """An object: mean and spread (sample standard deviation, n - 1) of every metric over its views."""

    object: Text
    samples: Annotated[int, Field(gt=0)]
    metrics: Metrics
    spread: dict[Text, NonNegative | None]


class Intervals(StrictModel):
    """Ends of the 95% interval of each headline mean in mm, from a bootstrap over objects; nulls below two objects."""

    overall_mae_mm: Interval
    overall_rmse_mm: Interval
    object_mae_mm: Interval
    object_rmse_mm: Interval
    background_mae_mm: Interval
    background_rmse_mm: Interval

    def __getitem__(self, key: str) -> list[float | None]:
        ends: list[float | None] = getattr(self, key)
        return ends

    def of(self, key: str) -> tuple[float, float] | None:
        """The interval of ``key``; None where there is none (not a headline key, or too few objects)."""
        low, high = getattr(self, key, (None, None))
        return None if low is None or high is None else (low, high)


class Bootstrap(StrictModel):
    """How the intervals were made."""

    method: Literal["expanded percentile"]
    over: Literal["objects"]
    resamples: Annotated[int, Field(gt=0)]
    confidence: Annotated[float, Field(gt=0, lt=1)]


class BenchmarkInfo(StrictModel):
    """Name and version of a benchmark; `fpp_ml_bench.loaders.storage.benchmark` lists those that this package knows."""

    name: Text
    version: Count


class DatasetInfo(StrictModel):
    """The data that was scored on. ``fingerprint`` identifies its bytes; ``name`` is only the folder's name.

    ``benchmark`` is absent for any other dataset than the named benchmarks. A name and version that this package knows
    with another fingerprint, or a fingerprint that it knows under another name or version, is refused.
    """

    name: Text
    fingerprint: Sha256
    benchmark: BenchmarkInfo | None = None
    split: Literal["train", "validation", "test", "all"]
    size: Annotated[list[Annotated[int, Field(gt=0)]], Field(min_length=2, max_length=2)]
    samples: Annotated[int, Field(gt=0)]

    @model_serializer(mode="wrap")
    def _without_absent(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        content: dict[str, Any] = handler(self)
        if self.benchmark is None:
            content.pop("benchmark", None)
        return content

    @model_validator(mode="after")
    def _consistent(self) -> "DatasetInfo":
        if self.benchmark is None:
            return self
        claim = self.benchmark.name, self.benchmark.version
        claimed = next((b for b in benchmarks.BENCHMARKS if (b.name, b.version) == claim), None)
        actual = benchmarks.benchmark_of(self.fingerprint)
        if claimed != actual:
            expected = f"; {claimed.title} has {claimed.fingerprint[:16]}" if claimed else ""
            raise ValueError(
                f"benchmark says {claim[0]} version {claim[1]}, but fingerprint {self.fingerprint[:16]} is "
                f"{actual.title if actual else 'not that benchmark'}{expected}"
            )
        return self

    @property
    def identity(self) -> str:
        """What identifies the data, for people: fingerprint, and name and version of the benchmark."""
        if self.benchmark is None:
            return dataset_identity(self.fingerprint)
        return f"{self.benchmark.name} version {self.benchmark.version}, fingerprint {self.fingerprint[:8]}"


def dataset_identity(fingerprint: str) -> str:
    """`DatasetInfo.identity` of a dataset with this fingerprint."""
    benchmark = benchmarks.benchmark_of(fingerprint)
    return f"{benchmark.title if benchmark else 'no named benchmark'}, fingerprint {fingerprint[:8]}"


class Environment(StrictModel):
    """Where and with what the scores were computed (not where the predictions were made: see ``submission``).

    ``git`` is the commit of the checkout this package ran from, null for an installed package. ``code_sha256`` covers
    the source of the scoring, so an edited checkout differs from its commit.
    """

    python: Text
    packages: dict[Text, Text] = Field(max_length=100)
    git: Annotated[str, Field(pattern=r"^[0-9a-f]{40,64}$")] | None
    code_sha256: Sha256
    hardware: HardwareInfo
