"""``result.json``: the scores of a submission on a split, as a strict model that checks itself. A result that was
edited by hand contradicts itself: averages, objects and intervals are recomputed from the per-sample scores whenever a
file is read, and overall is checked against object and background in every sample."""

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from fpp_ml_bench.evaluation import protocol
from fpp_ml_bench.evaluation.protocol import METRICS, FramesClass, Mode, SchemaVersion, Target, Track, scored_columns
from fpp_ml_bench.evaluation.result import parts
from fpp_ml_bench.evaluation.result.parts import Metrics, Reliance, Robustness, SampleResult
from fpp_ml_bench.evaluation.result.uncertainty import Uncertainty, uncertainty_of
from fpp_ml_bench.evaluation.score import ErrorStats, SigmaSample, combine, intervals_over_objects
from fpp_ml_bench.evaluation.submission import Submission
from fpp_ml_bench.loaders.storage import Counts, known_problem
from fpp_ml_bench.schema import Count, SparseModel, StrictModel, Text

AGREES = 1e-9
"""Relative difference up to which two computations of an average count as the same number."""

Scores = dict[str, float | None]


class Result(SparseModel):
    """Everything that `fpp-eval` computes. Deterministic but for ``created`` and the machine in ``environment``."""

    SPARSE = ("reliance", "robustness", "uncertainty")

    schema_version: SchemaVersion
    protocol_version: Annotated[str, Field(pattern=r"^[0-9]{1,4}\.[0-9]{1,4}\.[0-9]{1,4}$")]
    created: str
    submission: Submission
    dataset: parts.DatasetInfo
    target: Target
    mode: Mode
    frames_class: FramesClass
    edge_band_px: Annotated[int, Field(ge=0, le=1000)]
    edge_jump_mm: Annotated[float, Field(gt=0)]
    metrics: Metrics
    intervals: parts.Intervals
    median: Metrics
    pooled: parts.Headline
    samples_without_object: Count
    samples_without_background: Count
    per_object: list[parts.ObjectResult] = Field(max_length=100_000)
    per_sample: list[SampleResult] = Field(max_length=100_000)
    bootstrap: parts.Bootstrap
    seeds: dict[Text, Count]
    environment: parts.Environment
    reliance: Reliance | None = None
    robustness: dict[Literal["test", "unseen"], Robustness] | None = None
    uncertainty: Uncertainty | None = None

    @property
    def track(self) -> Track:
        return self.submission.track

    @property
    def timing(self) -> parts.Timing | None:
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
        count = len(self.per_sample)
        if count != self.dataset.samples:
            raise ValueError(f"per_sample holds {count} samples, dataset.samples says {self.dataset.samples}")
        if len({row.sample for row in self.per_sample}) != count:
            raise ValueError("per_sample names a sample twice")
        if self.reliance is not None:
            check_reliance(self.reliance, self.submission)
        if self.uncertainty is not None:
            self.uncertainty.check({row.sample: row for row in self.per_sample}, self.metrics)
        for name, block in (self.robustness or {}).items():
            _check_weights("robustness", block.weights_sha256, self.submission)
            if name != block.set:
                raise ValueError(f"robustness.{name} is that of the set {block.set}")
        if self.mode not in protocol.MODES:
            raise ValueError(f"protocol {self.protocol_version} has no mode {self.mode}")
        objects: dict[str, list[SampleResult]] = {}
        for row in self.per_sample:
            objects.setdefault(row.object, []).append(row)
        found = {
            name: Counts(len(rows), sum(r.object_pixels for r in rows), sum(r.void_pixels or 0 for r in rows))
            for name, rows in objects.items()
        }
        check_data(self.dataset, self.target, self.mode, self.submission.units, found)
        void = self.mode == "standard"
        for row in self.per_sample:
            _check_sample(row, height * width)
            _check_void(row, height * width, void, void and self.target == "depth_exact")
        stored = self.model_dump(include=set(derived := _derived(self.per_sample)))
        for key, computed in derived.items():
            _check_same(key, stored[key], computed)
        return self


class ArrayScores(StrictModel):
    """The scores that a `Result` has, of arrays in memory: without a submission and a dataset, so it is not ranked."""

    metrics: Metrics
    intervals: parts.Intervals
    median: Metrics
    pooled: parts.Headline
    samples_without_object: Count
    samples_without_background: Count
    per_object: list[parts.ObjectResult]
    per_sample: list[SampleResult]
    bootstrap: parts.Bootstrap
    seeds: dict[Text, Count]
    uncertainty: Uncertainty | None = None


def array_scores(rows: list[dict[str, Any]], stated: Mapping[str, SigmaSample]) -> ArrayScores:
    """`ArrayScores` from ``per_sample`` rows (keys of `SampleResult`) and the ``stated`` uncertainty of all or none."""
    per_sample = [SampleResult(**row) for row in rows]
    uncertainty = uncertainty_of(stated, {row.sample: row.object for row in per_sample}) if stated else None
    return ArrayScores(per_sample=per_sample, uncertainty=uncertainty, **_derived(per_sample))


def result_from_rows(rows: list[dict[str, Any]], **fields: Any) -> Result:
    """A `Result` from ``per_sample`` rows (keys of `SampleResult`) and the remaining keys; averages are made here."""
    per_sample, version = [SampleResult(**row) for row in rows], protocol.RESULT_SCHEMA_VERSION
    return Result(schema_version=version, per_sample=per_sample, **_derived(per_sample), **fields)


def _derived(per_sample: list[SampleResult]) -> dict[str, Any]:
    """Every key of `Result` that follows from the per-sample scores."""
    rows = [{key: getattr(row, key) for key in METRICS} for row in per_sample]
    objects = [row.object for row in per_sample]
    inside = combine(*(row.stats("object") for row in per_sample))
    outside = combine(*(row.stats("background") for row in per_sample))
    intervals = intervals_over_objects(rows, objects, protocol.HEADLINE)
    return {
        "metrics": over_samples(rows),
        "intervals": {key: [None, None] if ends is None else list(ends) for key, ends in intervals.items()},
        "median": over_samples(rows, statistics.median),
        "pooled": pooled(inside, outside),
        "samples_without_object": sum(row.object_pixels == 0 for row in per_sample),
        "samples_without_background": sum(row.background_pixels == 0 for row in per_sample),
        "per_object": [
            {
                "object": name,
                "samples": len(views := [row for row, owner in zip(rows, objects, strict=True) if owner == name]),
                "metrics": over_samples(views),
                "spread": over_samples(views, _deviation),
            }
            for name in dict.fromkeys(objects)
        ],
        "bootstrap": {
            "method": "expanded percentile",
            "over": "objects",
            "resamples": protocol.BOOTSTRAP_RESAMPLES,
            "confidence": protocol.CONFIDENCE,
        },
        "seeds": {"bootstrap": protocol.BOOTSTRAP_SEED},
    }


def over_samples(rows: Sequence[Scores], statistic: Callable[[list[float]], float | None] = statistics.fmean) -> Scores:
    """A statistic (plain mean, paper Section 5.3.2) of each metric over the samples that have it. Where none has it, it
    is None, or left out if it is one of `SINCE_2`."""
    columns = {key: [value for row in rows if (value := row.get(key)) is not None] for key in METRICS}
    columns = {key: values for key, values in columns.items() if values or key not in protocol.SINCE_2}
    return {key: statistic(values) if values else None for key, values in columns.items()}


def _deviation(values: list[float]) -> float | None:
    """Sample standard deviation (n - 1); None for fewer than two values."""
    if len(values) < 2:
        return None
    mean = statistics.fmean(values)
    largest = max(abs(value - mean) for value in values)
    if largest == 0:
        return 0.0
    # Scaled, so that deviations of 1e-200 or 1e200 mm can be squared.
    squares = math.fsum(((value - mean) / largest) ** 2 for value in values)
    return largest * math.sqrt(squares / (len(values) - 1))


def pooled(inside: ErrorStats, outside: ErrorStats) -> Scores:
    """Headline keys of one object set and one background set, every pixel with the same weight."""
    sets = {"overall": combine(inside, outside), "object": inside, "background": outside}
    return {f"{name}_{key}": getattr(stats, key) for name, stats in sets.items() for key in ("mae_mm", "rmse_mm")}


def _check_sample(row: SampleResult, pixels: int) -> None:
    """Refuse (ValueError) a sample whose sets do not make up its ``pixels`` or whose scores contradict each other."""
    if row.object_pixels + row.background_pixels + (row.void_pixels or 0) != pixels:
        raise ValueError(f"{row.sample}: object, background and void pixels do not add up to the image's {pixels}")
    sets = {name: row.stats(name) for name in ("object", "background")}
    for name, stats in sets.items():
        mae, rmse = stats.mae_mm, stats.rmse_mm
        if not (stats.pixels == 0) == (mae is None) == (rmse is None):
            raise ValueError(f"{row.sample}: {name} scores must be null exactly when the set is empty")
        if mae is not None and rmse is not None and rmse < mae * (1 - AGREES):
            raise ValueError(f"{row.sample}: {name} RMSE is below its MAE, which no error has")
    overall = combine(*sets.values())
    if not (same(row.overall_mae_mm, overall.mae_mm) and same(row.overall_rmse_mm, overall.rmse_mm)):
        raise ValueError(f"{row.sample}: overall scores do not follow from object and background")
    names = ("mae", "median", "p95", "max", "bias", "shift_free_mae", "rmse")
    values = [getattr(row, f"object_{name}_mm") for name in names]
    if any(value is None for value in values):
        if any(value is not None for value in values):
            raise ValueError(f"{row.sample}: the object's scores must be null all together, when the set is empty")
        return
    mae, median, p95, largest, bias, shift_free, rmse = values
    loose = 1 + AGREES
    if not (median <= p95 * loose and p95 <= largest * loose and rmse <= largest * loose):
        raise ValueError(f"{row.sample}: object median, 95th percentile, RMSE and maximum are out of order")
    if abs(bias) > mae * loose or shift_free > mae * loose:
        raise ValueError(f"{row.sample}: object bias or shift-free MAE is above the MAE, which no error has")


def _check_void(row: SampleResult, pixels: int, void: bool, unlit: bool) -> None:
    """Refuse (ValueError) a sample whose void or unlit pixels are missing, extra, or contradict their scores; ``void``,
    ``unlit``: whether the rules know them."""
    for name, known in (("void", void), ("unlit", unlit)):
        if (getattr(row, f"{name}_pixels") is not None) != known:
            raise ValueError(f"{row.sample}: {name}_pixels {'is missing' if known else 'is extra by these rules'}")
    if not same(row.void_share, None if row.void_pixels is None else row.void_pixels / pixels):
        raise ValueError(f"{row.sample}: void_share does not follow from void_pixels")
    if (row.unlit_pixels or 0) > (row.void_pixels or 0):
        raise ValueError(f"{row.sample}: unlit_pixels is above void_pixels")
    mae, rmse, share = row.unlit_mae_mm, row.unlit_rmse_mm, row.unlit_missing_share
    if not (mae is None) == (rmse is None) == (share is None) == (not row.unlit_pixels):
        raise ValueError(f"{row.sample}: unlit scores must be null exactly when there is no unlit pixel")
    if mae is not None and rmse is not None and rmse < mae * (1 - AGREES):
        raise ValueError(f"{row.sample}: unlit RMSE is below its MAE, which no error has")


def check_data(data: parts.DatasetInfo, target: str, mode: str, units: str, found: Mapping[str, Counts]) -> None:
    """Refuse (ValueError) a content of other columns than the rules read, and a named benchmark whose samples, objects
    or pixels are others than those ``found`` in a file."""
    splits = {name.partition("/")[0] for name in data.content}
    expected = [
        {f"{split}/{column}" for split in splits for column in scored_columns(target, mode, flags)}
        for flags in (True, False)
    ]
    if set(data.content) not in expected or (data.split != "all" and splits != {data.split}):
        columns = " or ".join(dict.fromkeys(", ".join(sorted(names)) for names in expected))
        raise ValueError(f"dataset.content: expected hashes of {columns}, got {', '.join(sorted(data.content))}")
    if (mode, units) == ("paper", "normalised"):  # whose mask lacks the object's nearest pixels (`scored_pair`)
        found = {name: counts._replace(object_px=None) for name, counts in found.items()}
    if problem := known_problem(data.content, data.split, target, mode, found):
        raise ValueError(problem)


def check_reliance(reliance: Reliance, submission: Submission) -> None:
    """Refuse (ValueError) a phase reliance of other weights or of another output than was scored."""
    units = submission.units
    _check_weights("reliance", reliance.weights_sha256, submission)
    if (reliance.units == "normalised") != (units == "normalised"):
        pair = f"an answer in {reliance.units}, scored was one in {units}"
        raise ValueError(f"reliance is that of {pair}; measure it again")


def _check_weights(part: str, measured: str | None, submission: Submission) -> None:
    """Refuse (ValueError) a part that was measured with other weights than were scored."""
    weights = submission.settings.get("weights_sha256")
    if weights != measured:
        pair = f"weights {str(measured)[:12]}, scored were {str(weights)[:12]}"
        raise ValueError(f"{part} was measured on {pair}; measure it again")


def _check_same(name: str, stored: Any, computed: Any) -> None:
    """Refuse (ValueError) a stored value, mapping or list that is not what the per-sample scores give."""
    if isinstance(computed, Mapping):
        if set(stored) != set(computed):
            raise ValueError(f"{name} does not hold the keys {', '.join(map(str, computed))}")
        for key in computed:
            _check_same(f"{name}.{key}", stored[key], computed[key])
    elif isinstance(computed, list):
        if len(stored) != len(computed):
            raise ValueError(f"{name} holds {len(stored)} entries, per_sample makes {len(computed)}")
        for index, (stored_item, computed_item) in enumerate(zip(stored, computed, strict=True)):
            _check_same(f"{name}.{index}", stored_item, computed_item)
    elif isinstance(computed, float) or computed is None:
        # A mean of signed values may cancel to rounding errors, which depend on the machine.
        if not same(stored, computed, rounding=1e-9 if name.endswith("bias_mm") else 0.0):
            raise ValueError(f"{name} does not follow from per_sample: {stored}, not {computed}")
    elif stored != computed and name.startswith("samples_without_"):
        raise ValueError(f"{name} is not the number of such samples, {computed}")
    elif stored != computed:
        raise ValueError(f"{name} does not follow from per_sample: {stored}, not {computed}")


def same(first: float | None, second: float | None, rounding: float = 0.0) -> bool:
    """Whether two numbers differ by at most `AGREES` relatively, or ``rounding``; None equals None only."""
    if first is None or second is None:
        return first is second
    return math.isclose(first, second, rel_tol=AGREES, abs_tol=rounding)
