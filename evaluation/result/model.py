"""``result.json``: the scores of a submission on a split, as a strict model that checks itself. A
result that was edited by hand contradicts itself: averages, objects and intervals are recomputed
from the per-sample scores whenever a file is read, and overall is checked against object and
background in every sample."""

import math
import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from functools import partial
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from fpp_ml_bench.evaluation import protocol
from fpp_ml_bench.evaluation.metrics import METRICS, RANKED, UNCERTAINTY, Metric
from fpp_ml_bench.evaluation.protocol import (
    COVERED,
    LEFT_OUT,
    NOMINAL,
    SURE_LEFT_OUT,
    FramesClass,
    Mode,
    SchemaVersion,
    Target,
    Track,
    scored_columns,
)
from fpp_ml_bench.evaluation.result import parts
from fpp_ml_bench.evaluation.result.parts import (
    AGREES,
    Metrics,
    Reliability,
    Reliance,
    Robustness,
    SampleResult,
    SigmaScores,
    Sparsification,
    TrackScores,
    Uncertainty,
)
from fpp_ml_bench.evaluation.score.sample_scores import ErrorStats, Scored, SigmaSample, combine
from fpp_ml_bench.evaluation.score.uncertainty import intervals_over_objects
from fpp_ml_bench.evaluation.submission.description import Submission
from fpp_ml_bench.loaders.storage.benchmark import Counts, known_problem
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.schema import Count, SparseModel, StrictModel, Text

Scores = dict[str, float | None]


class _Rules(StrictModel):
    """What was scored, and by which rules."""

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
    charge_mm: parts.Charge = None


class _Scores(StrictModel):
    """The scores of a split, and what they were computed with."""

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


class ArrayScores(_Scores):
    """The scores that a `Result` has, of arrays in memory: without a submission and a dataset, so
    it is not ranked."""

    uncertainty: Uncertainty | None = None


class Result(SparseModel, _Scores, _Rules):
    """Everything that `fpp-eval` computes. Deterministic but for ``created`` and the machine in
    ``environment``."""

    SPARSE = ("reliance", "robustness", "rigs", "uncertainty", "charge_mm")

    environment: parts.Environment
    reliance: Reliance | None = None
    robustness: dict[Literal["test", "unseen"], Robustness] | None = None
    rigs: TrackScores | None = None
    uncertainty: Uncertainty | None = None

    @property
    def track(self) -> Track:
        return self.submission.track

    @property
    def timing(self) -> parts.Timing | None:
        """What `fpp-bench time` measured, or what the submission reports; None where it reports
        nothing."""
        return self.submission.timing

    @field_validator("created")
    @classmethod
    def _is_a_time(cls, value: str) -> str:
        if len(value) > 40 or datetime.fromisoformat(value).tzinfo is None:
            raise ValueError(
                "expected an ISO 8601 time with its offset, like 2026-01-31T12:00:00+00:00"
            )
        return value

    @model_validator(mode="after")
    def _consistent(self) -> "Result":
        height, width = self.dataset.size
        count = len(self.per_sample)
        if count != self.dataset.samples:
            raise ValueError(
                f"per_sample holds {count} samples, dataset.samples says {self.dataset.samples}"
            )
        if len({row.sample for row in self.per_sample}) != count:
            raise ValueError("per_sample names a sample twice")
        if self.reliance is not None:
            check_reliance(self.reliance, self.submission)
        if self.uncertainty is not None:
            _check_uncertainty(
                self.uncertainty, {row.sample: row for row in self.per_sample}, self.metrics
            )
        if self.rigs is not None:
            _check_weights("rigs", self.rigs.weights_sha256, self.submission)
            if self.rigs.method != self.submission.method:
                raise ValueError(f"rigs is that of the method {self.rigs.method}")
        for name, block in (self.robustness or {}).items():
            _check_weights("robustness", block.weights_sha256, self.submission)
            if name != block.set:
                raise ValueError(f"robustness.{name} is that of the set {block.set}")
        objects: dict[str, list[SampleResult]] = {}
        for row in self.per_sample:
            objects.setdefault(row.object, []).append(row)
        counts = {
            name: Counts(
                len(rows),
                sum(r.object_pixels for r in rows),
                sum(r.void_pixels or 0 for r in rows),
                sum(not r.object_pixels or not r.background_pixels for r in rows),
            )
            for name, rows in objects.items()
        }
        check_data(self.dataset, self.target, self.mode, self.submission.units, counts)
        check_charge(self.charge_mm, self.dataset, self.mode)
        void = self.mode == "standard"
        for row in self.per_sample:
            known = {"void": void, "unlit": void and self.target == "depth_exact"}
            _check_sample(row, height * width, known, self.charge_mm)
        follows = derived(self.per_sample)
        _check_same("", self.model_dump(include=set(follows)), follows)
        return self


def scores_of(scored: Sequence[Scored]) -> dict[str, Any]:
    """Every key of `ArrayScores` from ``scored`` samples, of which all state an uncertainty or none
    does."""
    per_sample = [
        SampleResult(sample=sample.name, object=sample.object, **sample.row) for sample in scored
    ]
    stated = {sample.name: sample.stated for sample in scored if sample.stated is not None}
    owners = {sample.name: sample.object for sample in scored}
    uncertainty = uncertainty_of(stated, owners) if stated else None
    return {"per_sample": per_sample, "uncertainty": uncertainty, **derived(per_sample)}


def derived(per_sample: list[SampleResult]) -> dict[str, Any]:
    """Every key of `Result` that follows from the per-sample scores."""
    rows = [{key: getattr(row, key) for key in METRICS} for row in per_sample]
    objects = [row.object for row in per_sample]
    inside = combine(*(row.stats("object") for row in per_sample))
    outside = combine(*(row.stats("background") for row in per_sample))
    means = over_samples(rows)
    intervals = intervals_over_objects(rows, objects, [key for key in RANKED if key in means])
    return {
        "metrics": means,
        "intervals": {
            key: [None, None] if ends is None else list(ends) for key, ends in intervals.items()
        },
        "median": over_samples(rows, statistics.median),
        "pooled": pooled(inside, outside),
        "samples_without_object": sum(row.object_pixels == 0 for row in per_sample),
        "samples_without_background": sum(row.background_pixels == 0 for row in per_sample),
        "per_object": [
            {
                "object": name,
                "samples": len(
                    views := [
                        row for row, owner in zip(rows, objects, strict=True) if owner == name
                    ]
                ),
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


def over_samples(
    rows: Iterable[Scores],
    statistic: Callable[[list[float]], float | None] = statistics.fmean,
    metrics: Mapping[str, Metric] = METRICS,
) -> Scores:
    """A statistic (plain mean, paper Section 5.3.2) of each metric over the samples that have it.
    Where none has it, it is None, or left out if a file may leave it out."""
    rows = list(rows)
    columns = {
        key: [value for row in rows if (value := row.get(key)) is not None] for key in metrics
    }
    columns = {
        key: values for key, values in columns.items() if values or not metrics[key].optional
    }
    return {key: statistic(values) if values else None for key, values in columns.items()}


def _deviation(values: list[float]) -> float | None:
    """Sample standard deviation (n - 1); None for fewer than two values."""
    return statistics.stdev(values) if len(values) > 1 else None


def pooled(inside: ErrorStats, outside: ErrorStats) -> Scores:
    """Headline keys of one object set and one background set, every pixel with the same weight."""
    sets = {"overall": combine(inside, outside), "object": inside, "background": outside}
    return {
        f"{name}_{key}": getattr(stats, key)
        for name, stats in sets.items()
        for key in ("mae_mm", "rmse_mm")
    }


def _check_sample(
    row: SampleResult, pixels: int, known: Mapping[str, bool], charge_mm: float | None
) -> None:
    """Refuse (ValueError) a sample whose sets do not make up its ``pixels`` or whose scores
    contradict each other, its sets or the charge; ``known``: whether the rules know void and unlit
    pixels."""
    counts = {name: getattr(row, f"{name}_pixels") for name in ("object", "background", *known)}
    sets = {name: count or 0 for name, count in counts.items()}
    if sets["object"] + sets["background"] + sets["void"] != pixels:
        raise ValueError(
            f"{row.sample}: object, background and void pixels do not add up to the image's "
            f"{pixels}"
        )
    for name, by_rules in known.items():
        if (counts[name] is not None) != by_rules:
            raise ValueError(
                f"{row.sample}: {name}_pixels "
                f"{'is missing' if by_rules else 'is extra by these rules'}"
            )
    if not same(row.void_share, None if counts["void"] is None else sets["void"] / pixels):
        raise ValueError(f"{row.sample}: void_share does not follow from void_pixels")
    if sets["unlit"] > sets["void"]:
        raise ValueError(f"{row.sample}: unlit_pixels is above void_pixels")
    for name in ("object", "background", "unlit"):
        if (getattr(row, f"{name}_mae_mm") is None) != (sets[name] == 0):
            raise ValueError(
                f"{row.sample}: {name} scores must be null exactly when the set is empty"
            )
    if problem := row.problem(1, AGREES, charge_mm):
        raise ValueError(f"{row.sample}: {problem}")
    if (row.invented_share or 0.0) * sets["object"] > sets["background"] * (1 + AGREES):
        raise ValueError(f"{row.sample}: invented_share is of more pixels than the background has")
    overall = combine(row.stats("object"), row.stats("background"))
    if not (
        same(row.overall_mae_mm, overall.mae_mm) and same(row.overall_rmse_mm, overall.rmse_mm)
    ):
        raise ValueError(f"{row.sample}: overall scores do not follow from object and background")


def check_data(
    data: parts.DatasetInfo, target: str, mode: str, units: str, file_counts: Mapping[str, Counts]
) -> None:
    """Refuse (ValueError) a content of other columns than the rules read, and a named benchmark
    whose samples, objects or pixels are others than ``file_counts``, those of a file."""
    splits = {name.partition("/")[0] for name in data.content}
    expected = [
        {f"{split}/{column}" for split in splits for column in scored_columns(target, mode, flags)}
        for flags in (True, False)
    ]
    if set(data.content) not in expected or (data.split != "all" and splits != {data.split}):
        columns = " or ".join(dict.fromkeys(", ".join(sorted(names)) for names in expected))
        raise ValueError(
            f"dataset.content: expected hashes of {columns}, got {', '.join(sorted(data.content))}"
        )
    if (mode, units) == (
        "paper",
        "normalised",
    ):  # whose mask lacks the object's nearest pixels (`scored_pair`)
        file_counts = {
            name: counts._replace(object_px=None) for name, counts in file_counts.items()
        }
    if problem := known_problem(data.content, data.split, target, mode, file_counts):
        raise ValueError(problem)


def check_charge(charge_mm: float | None, data: parts.DatasetInfo, mode: str) -> None:
    """Refuse (ValueError) a charge that the mode or the benchmark does not have."""
    if (charge_mm is None) != (mode == "paper"):
        raise ValueError(
            f"charge_mm: expected {'none' if mode == 'paper' else 'one'} in {mode} mode, got "
            f"{charge_mm}"
        )
    expected_mm = paper_rig().half_range_mm
    if charge_mm is not None and data.known is not None and charge_mm != expected_mm:
        raise ValueError(
            f"charge_mm: that of {data.known.title} is {expected_mm:g}, got {charge_mm}"
        )


def check_reliance(reliance: Reliance, submission: Submission) -> None:
    """Refuse (ValueError) a phase reliance of other weights or of another output than was
    scored."""
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


def disagreements(
    stored: object,
    computed: object,
    name: str = "",
    rounding: float = 0.0,
    cancelling: float = 1e-9,
    digits: int | None = None,
) -> Iterator[tuple[str, object, object]]:
    """Name, stored and computed value of everything in two plain contents that is not the same.
    ``rounding``: absolute difference up to which two numbers count as the same; ``cancelling``:
    that of scores which are a small difference of large numbers, so that it depends on the machine;
    ``digits``: significant ones of the stored numbers."""
    if isinstance(stored, Mapping) and isinstance(computed, Mapping):
        for key in dict.fromkeys((*stored, *computed)):
            metric = METRICS.get(key) or UNCERTAINTY.get(key)
            limit = cancelling if metric is not None and metric.cancels else rounding
            where = f"{name}.{key}" if name else str(key)
            pair = stored.get(key), computed.get(key)
            if pair == (None, None) and not (key in stored and key in computed):
                yield where, *pair
            yield from disagreements(*pair, where, limit, cancelling, digits)
    elif isinstance(stored, list) and isinstance(computed, list):
        if len(stored) != len(computed):
            yield name, f"{len(stored)} entries", f"{len(computed)}"
        for index, pair in enumerate(zip(stored, computed, strict=False)):
            yield from disagreements(*pair, f"{name}.{index}", rounding, cancelling, digits)
    elif not (
        stored == computed
        or (
            isinstance(stored, float)
            and isinstance(computed, float | int | None)
            and same(stored, computed, rounding, digits)
        )
    ):
        yield name, stored, computed


def _check_same(name: str, stored: object, computed: object, rounding: float = 0.0) -> None:
    """Refuse (ValueError) a stored value, mapping or list that is not what the per-sample scores
    give."""
    for where, value, expected in disagreements(stored, computed, name, rounding):
        if value is None and expected is None:
            raise ValueError(
                f"{where} is null where per_sample gives no such key, or is missing where it gives "
                f"null"
            )
        if where.startswith("samples_without_"):
            raise ValueError(f"{where} is not the number of such samples, {expected}")
        raise ValueError(f"{where} does not follow from per_sample: {value}, not {expected}")


def uncertainty_of(samples: Mapping[str, SigmaSample], owners: Mapping[str, str]) -> Uncertainty:
    """The block of the scored ``samples`` by name; ``owners``: the object of each."""
    per_sample = {name: sample.scores for name, sample in samples.items()}
    observed = [sample.observed for sample in samples.values() if sample.observed is not None]
    curves = [sample.curves for sample in samples.values() if sample.curves is not None]
    names = curves[0] if curves else ()
    means = {
        "left_out": list(LEFT_OUT),
        **{name: _mean_curve([of[name] for of in curves]) for name in names},
    }
    return Uncertainty(
        **_uncertainty_means(per_sample, owners),
        per_sample={name: SigmaScores(**scores) for name, scores in per_sample.items()},
        reliability=Reliability(nominal=list(NOMINAL), observed=_mean_curve(observed))
        if observed
        else None,
        sparsification=Sparsification(**means) if curves else None,
    )


def _mean_curve(curves: list[list[float]]) -> list[float]:
    return [statistics.fmean(values) for values in zip(*curves, strict=True)]


def _uncertainty_means(
    per_sample: Mapping[str, Scores], owners: Mapping[str, str]
) -> dict[str, Any]:
    """The keys of `Uncertainty` that are means over samples, and over the views of each object."""
    views: dict[str, list[Scores]] = {}
    for sample, scores in per_sample.items():
        views.setdefault(owners[sample], []).append(scores)
    mean = partial(over_samples, metrics=UNCERTAINTY)
    return {
        "metrics": mean(per_sample.values()),
        "per_object": {name: mean(rows) for name, rows in views.items()},
    }


def _check_uncertainty(
    block: Uncertainty, rows: Mapping[str, SampleResult], metrics: Metrics
) -> None:
    """Refuse (ValueError) a block of other samples than ``rows``, or that contradicts itself or
    ``metrics``."""
    if set(block.per_sample) != set(rows):
        raise ValueError("uncertainty.per_sample: other samples than per_sample has")
    for sample, scores in block.per_sample.items():
        if (scores.unstated_share is None) != (rows[sample].object_pixels == 0):
            raise ValueError(
                f"uncertainty.per_sample.{sample} must have scores exactly where there is an object"
            )
        covered = [getattr(scores, f"coverage_{percent}") for percent in COVERED]
        if None not in covered and covered != sorted(covered):
            raise ValueError(
                f"uncertainty.per_sample.{sample}: a wider interval holds less than a narrower one"
            )
    stored = block.model_dump(include={"metrics", "per_object", "per_sample"})
    follows = _uncertainty_means(
        stored.pop("per_sample"), {sample: row.object for sample, row in rows.items()}
    )
    if set(block.per_object) != set(follows["per_object"]):
        raise ValueError("uncertainty.per_object: other objects than per_sample has")
    reliability, curves = block.reliability, block.sparsification
    if (reliability is None) != (block.metrics.coverage_68 is None):
        raise ValueError(
            "uncertainty.reliability must be there exactly where some pixel states an uncertainty"
        )
    if (curves is None) != (block.metrics.ause_mae_mm is None):
        raise ValueError(
            "uncertainty.sparsification must be there exactly where there is an object"
        )
    facts = [(name, stored[name], follows[name]) for name in follows]
    if reliability is not None:
        facts.append(("reliability.nominal", reliability.nominal, list(NOMINAL)))
        for percent in COVERED:
            observed = reliability.observed[NOMINAL.index(percent / 100)]
            facts.append(
                (
                    f"reliability at {percent}%",
                    observed,
                    getattr(block.metrics, f"coverage_{percent}"),
                )
            )
    roundings = {}
    if curves is not None:
        facts.append(("sparsification.left_out", curves.left_out, list(LEFT_OUT)))
        for error in ("mae_mm", "rmse_mm"):
            by_sigma, best = getattr(curves, error), getattr(curves, f"best_{error}")
            whole = getattr(metrics, f"object_{error}")
            if metrics.two_sided_mae_mm is not None:  # which charges what the object's errors don't
                whole = metrics.two_sided_mae_mm if error == "mae_mm" else by_sigma[0]
            sure, area = (getattr(block.metrics, f"{name}_{error}") for name in ("sure", "ause"))
            gap = math.fsum(
                first - second for first, second in zip(by_sigma, best, strict=True)
            ) / len(LEFT_OUT)
            facts += [
                (f"sparsification.{error}.0", by_sigma[0], whole),
                (f"sparsification.best_{error}.0", best[0], whole),
                (f"sparsification.{error}", by_sigma[LEFT_OUT.index(SURE_LEFT_OUT)], sure),
                (f"metrics.ause_{error}", area, max(gap, 0.0)),
            ]
            roundings[f"metrics.ause_{error}"] = AGREES * (whole or 0.0)
    for name, value, expected in facts:
        rounding = max(roundings.get(name, 0.0), 1e-12)  # a likelihood may be near 0
        _check_same(f"uncertainty.{name}", value, expected, rounding)


def same(
    first: float | None, second: float | None, rounding: float = 0.0, digits: int | None = None
) -> bool:
    """Whether two numbers differ by at most `AGREES` relatively, or ``rounding``, and half a unit
    of the last of ``digits``; None equals None only."""
    if first is None or second is None:
        return first is second
    if digits is not None and second:
        rounding += 0.5 * 10.0 ** (math.floor(math.log10(abs(second))) + 1 - digits) + AGREES * abs(
            second
        )
    return math.isclose(first, second, rel_tol=AGREES, abs_tol=rounding)
