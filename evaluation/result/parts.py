"""The parts of ``result.json`` as strict models: scores, data, what was scored with what, run time,
phase reliance, robustness, a stated uncertainty."""

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from hashlib import sha256
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, model_validator

from fpp_ml_bench.evaluation.metrics import (
    BOUNDS,
    HEADLINE,
    METRICS,
    MIXTURES,
    RANKED,
    UNCERTAINTY,
    Metric,
)
from fpp_ml_bench.evaluation.protocol import LEFT_OUT, NOMINAL, WITHIN_MM
from fpp_ml_bench.evaluation.score.sample_scores import ErrorStats
from fpp_ml_bench.files import LARGEST
from fpp_ml_bench.loaders.storage import benchmark as benchmarks
from fpp_ml_bench.schema import (
    Count,
    NonNegative,
    Positive,
    Reason,
    Share,
    SparseModel,
    StrictModel,
    Text,
)

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Whole = Annotated[int, Field(gt=0)]
Interval = Annotated[list[float | None], Field(min_length=2, max_length=2)]
Charge = Annotated[float, Field(gt=0)] | None
"""What a missing or invented pixel costs in the two-sided scores, mm; None by rules without
them."""
AGREES = 1e-9
"""Relative difference up to which two computations of an average count as the same number."""
LEAST = 1e-300
"""Differences below this are no contradiction: so small numbers have fewer digits."""
OPTIONAL = tuple(key for key, metric in METRICS.items() if metric.optional)
"""Scores whose keys are not written where no sample has them."""


def exceeds(less: float, more: float, rounding: float) -> bool:
    """Whether ``less`` is above ``more``, both with an error of ``rounding`` times themselves."""
    return less > more * (1 + 2 * rounding) + LEAST


def can_mix(
    whole: float,
    first: tuple[float, float],
    second: float,
    most: tuple[float, float],
    power: int,
    rounding: float,
) -> bool:
    """Whether ``whole`` can be the mean over views of the error of a set, where those of its two
    parts have the means ``first`` (at least, at most) and ``second``, and no view has more than the
    shares ``most`` of its pixels in them; ``power``: 1 for MAE, 2 for RMSE."""
    of_first, of_second = (min(share, 1.0) for share in most)
    # The error of a view is a norm of its parts: its mean is at least the norm of their means, and
    # at most their sum.
    least = ((1 - of_second) * first[0] ** power + (1 - of_first) * second**power) ** (1 / power)
    largest = of_first ** (1 / power) * first[1] + of_second ** (1 / power) * second
    return not exceeds(least, whole, rounding) and not exceeds(whole, largest, rounding)


def ends(interval: Sequence[float | None]) -> tuple[float, float] | None:
    """The two ends; None where there is no interval."""
    low, high = interval
    return None if low is None or high is None else (low, high)


_TYPES: dict[str, Any] = {
    "mm": NonNegative | None,
    "signed mm": float | None,
    "share": Share | None,
    "ratio": NonNegative | None,
    "nats": float | None,
}
"""What a score of each unit may be."""


def _fields(metrics: Iterable[Metric]) -> dict[str, Any]:
    """A field for each metric, as the annotations from which pydantic makes a model: written out
    here, a new metric would be two entries."""
    types = ((metric, _TYPES[metric.unit]) for metric in metrics)
    return {
        metric.key: Annotated[kind, Field(default=None)] if metric.optional else kind
        for metric, kind in types
    }


class Scores(StrictModel):
    """A model with a field for each metric of a kind."""

    if TYPE_CHECKING:

        def __getattr__(self, key: str) -> Any: ...


class Headline(Scores):
    """The paper's six errors in mm; null for a pixel set that is empty."""

    __annotations__ = _fields(METRICS[key] for key in HEADLINE)


class Metrics(Headline, SparseModel):
    """All scores: errors in mm, shares of pixels. PROTOCOL.md defines each. Those that may be null
    by default are not written where there are none: no unlit pixels are scored, or the rules know
    no void."""

    SPARSE = OPTIONAL
    __annotations__ = _fields(METRICS[key] for key in METRICS if key not in HEADLINE)

    def problem(self, views: int, rounding: float, charge_mm: float | None = None) -> str | None:
        """Why no errors have these scores, which are means over at most ``views`` samples, each
        with an error of ``rounding`` times itself; None where some have. ``charge_mm``: that of the
        two-sided scores."""
        for key, metric in METRICS.items():
            if metric.over and (getattr(self, key) is None) != (
                getattr(self, f"{metric.over}_mae_mm") is None
            ):
                return (
                    f"{metric.over} scores must be null exactly when the set is empty, and then "
                    f"null all together"
                )
        return next(self._contradictions(views, rounding), None) or self._charged_otherwise(
            rounding, charge_mm
        )

    def _charged_otherwise(self, rounding: float, charge_mm: float | None) -> str | None:
        """What of the two-sided scores does not follow from the errors and the charge. Without the
        charges, which are the same for means, they are errors of measured pixels: less than those
        of all, whatever was missing."""
        charged = [getattr(self, key) for key, metric in METRICS.items() if metric.charged]
        known = charge_mm is not None and self.object_mae_mm is not None
        if any((score is None) == known for score in charged):
            return (
                f"the two-sided scores must be there exactly where there is a charge, which is "
                f"{charge_mm} mm"
            )
        if charge_mm is None or self.object_mae_mm is None:
            return None
        charge = charge_mm * (self.object_missing_share + self.invented_share)
        measured, slack = (
            self.two_sided_mae_mm - charge,
            2 * rounding * (self.two_sided_mae_mm + charge) + LEAST,
        )
        if measured < -slack or measured > self.object_mae_mm + slack:
            return (
                "two_sided_mae_mm does not follow from the charge, the missing and the invented "
                "pixels"
            )
        return None

    def _contradictions(self, views: int, rounding: float) -> Iterator[str]:
        known = {key: abs(value) for key in METRICS if (value := getattr(self, key)) is not None}
        for key, bound, factor, why in BOUNDS:
            if (
                key in known
                and bound in known
                and exceeds(known[key], factor * known[bound], rounding)
            ):
                yield why
        last_digit = rounding / 10  # of a share near 1
        for key, first, second, share in MIXTURES:
            if key in known:
                shares = views * known[share], views * (1 - known[share] + last_digit)
                unknown = known["object_max_mm"] if key == "object_mae_mm" else LARGEST
                low, high = (known.get(first, 0.0),) * 2 if first else (0.0, unknown)
                power = 2 if "rmse" in key else 1
                if not can_mix(
                    known[key], (low, high), known.get(second, 0.0), shares, power, rounding
                ):
                    yield f"{key} does not follow from those of its parts and {share}"
        if self.object_mae_mm is None:
            return
        mae, rmse, median, p95, largest = (
            known[f"object_{k}_mm"] for k in ("mae", "rmse", "median", "p95", "max")
        )
        if exceeds(mae, 0.5 * median + 0.45 * p95 + 0.05 * largest, rounding):
            yield "object MAE is above what median, 95th percentile and maximum allow"
        if exceeds(rmse, math.sqrt(mae) * math.sqrt(largest), rounding):
            yield "object RMSE is above what MAE and maximum allow"
        for limit in WITHIN_MM:
            beyond = 1 - known[f"object_within_{limit}mm_share"]
            most = views * (beyond + last_digit) * largest
            pairs = (
                (limit * (beyond - last_digit), mae),
                (mae, limit + most),
                (median, limit + 2 * most),
            )
            if any(
                exceeds(less, more, rounding) for less, more in (*pairs, (p95, limit + 20 * most))
            ):
                yield f"object_within_{limit}mm_share contradicts the errors"


class SampleResult(Metrics):
    """Scores of one sample, how many pixels each set has, and the hash of the prediction file they
    come from. ``void_pixels`` is absent by rules without void, ``unlit_pixels`` where the unlit
    ones are not scored."""

    SPARSE = (*OPTIONAL, "void_pixels", "unlit_pixels")

    sample: Text
    object: Text
    prediction_sha256: Sha256
    object_pixels: Count
    background_pixels: Count
    void_pixels: Count | None = None
    unlit_pixels: Count | None = None

    def stats(self, pixels: str) -> ErrorStats:
        """Errors of the ``object`` or the ``background`` set."""
        count = getattr(self, f"{pixels}_pixels")
        return ErrorStats(
            count, getattr(self, f"{pixels}_mae_mm"), getattr(self, f"{pixels}_rmse_mm")
        )


class ObjectResult(StrictModel):
    """An object: mean and spread (sample standard deviation, n - 1) of every metric over its
    views."""

    object: Text
    samples: Whole
    metrics: Metrics
    spread: dict[Text, NonNegative | None]


class Intervals(Scores, SparseModel):
    """Ends of the 95% interval of the means of `RANKED` in mm, from a bootstrap over objects; nulls
    below two objects."""

    SPARSE = tuple(key for key in RANKED if METRICS[key].optional)
    __annotations__ = dict.fromkeys(HEADLINE, Interval) | dict.fromkeys(
        SPARSE, Annotated[Interval | None, Field(default=None)]
    )

    def of(self, key: str) -> tuple[float, float] | None:
        """The interval of ``key``; None where there is none (no key of `RANKED`, no such score, or
        too few objects)."""
        return ends(getattr(self, key, None) or (None, None))


class Bootstrap(StrictModel):
    """How the intervals were made."""

    method: Literal["expanded percentile"]
    over: Literal["objects"]
    resamples: Whole
    confidence: Annotated[float, Field(gt=0, lt=1)]


class BenchmarkInfo(StrictModel):
    """Name and version of a benchmark; `fpp_ml_bench.loaders.storage.benchmark` lists those that
    this package knows."""

    name: Text
    version: Count


Content = dict[
    Annotated[str, Field(pattern=r"^(train|validation|test)/[a-z_0-9]{1,40}$")],
    Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")],
]


class DatasetInfo(SparseModel):
    """The data that was scored on; ``name`` is only the folder's name. ``content``: hashes of the
    decoded values that the scores depend on, by ``split/column``
    (`fpp_ml_bench.loaders.storage.benchmark`). ``code``: what the projector showed, ``phase
    shift``, ``crossed`` or ``Gray code``.

    ``benchmark`` is absent for any other dataset than the named benchmarks. A name and version
    whose content is another one is refused. ``real``: name of the set of public captures that it
    says it is (`fpp-bench import --real`)."""

    SPARSE = ("benchmark", "real")

    name: Text
    content: Annotated[Content, Field(min_length=1, max_length=9)]
    code: Text
    benchmark: BenchmarkInfo | None = None
    real: Text | None = None
    split: Literal["train", "validation", "test", "all"]
    size: Annotated[list[Whole], Field(min_length=2, max_length=2)]
    samples: Whole

    @model_validator(mode="after")
    def _consistent(self) -> "DatasetInfo":
        if self.benchmark is None:
            return self
        claim, actual = f"{self.benchmark.name} version {self.benchmark.version}", self.known
        if actual is None or claim != actual.title:
            verdict = f"is that of {actual.title}" if actual else "is not that benchmark's"
            raise ValueError(f"benchmark says {claim}, but content {verdict}")
        return self

    @property
    def known(self) -> benchmarks.Benchmark | None:
        """The benchmark whose scenes these are, whatever was projected."""
        return benchmarks.benchmark_of(self.content)

    @property
    def truth(self) -> str:
        """What two results share that were scored on the same scenes, whatever was projected: a
        hash over ``content``, 32 hex digits."""
        return sha256(json.dumps(self.content, sort_keys=True).encode()).hexdigest()[:32]

    @property
    def identity(self) -> str:
        """What identifies the data, for people: name and version of the benchmark, and the start of
        `truth`."""
        named, benchmark = "no named benchmark", self.benchmark
        if benchmark is not None:
            named = f"{benchmark.name} version {benchmark.version}"
        return f"{named}, content {self.truth[:8]}"


class HardwareInfo(StrictModel):
    """The machine a time was measured on, as `fpp_ml_bench.machine.describe_hardware` puts it."""

    cpu: Text
    cores: Count
    memory_gib: NonNegative
    gpu: Text | None
    platform: Text


class Environment(StrictModel):
    """Where and with what the scores were computed (not where the predictions were made: see
    ``submission``).

    ``git`` is the commit of the checkout this package ran from, null for an installed package.
    ``code_sha256`` covers the source of the scoring, so an edited checkout differs from its
    commit."""

    python: Text
    packages: dict[Text, Text] = Field(max_length=100)
    git: Annotated[str, Field(pattern=r"^[0-9a-f]{40,64}$")] | None
    code_sha256: Sha256
    hardware: HardwareInfo


class Timing(StrictModel):
    """How long a method takes on images of ``image_size`` (H, W) px, and what it needs.

    Latency is that of one image at batch 1 after warm-up, frames in memory: the median, 5th and
    95th percentile over ``repeats`` runs, in ms. Throughput is in images per second with ``batch``
    images at once (``batched`` says whether the method takes them together or one after another).
    ``peak_memory_mib`` is the largest resident set of the whole process, ``working_memory_mib``
    what predicting one image adds to it, ``gpu_memory_mib`` the most that was allocated on the GPU;
    null where unknown. ``frames`` is the number of captures that one depth map costs."""

    provenance: Literal["measured", "self-reported"]
    latency_median_ms: Positive
    latency_p5_ms: Positive
    latency_p95_ms: Positive
    repeats: Whole
    batch: Whole
    batched: bool
    throughput_per_s: Positive
    peak_memory_mib: NonNegative | None
    working_memory_mib: NonNegative | None
    gpu_memory_mib: NonNegative | None
    parameters: Count
    frames: Count
    image_size: Annotated[list[Whole], Field(min_length=2, max_length=2)]
    device: Text
    hardware: HardwareInfo
    software: dict[Text, Text] = Field(default_factory=dict, max_length=100)

    @model_validator(mode="after")
    def _ordered(self) -> "Timing":
        if not self.latency_p5_ms <= self.latency_median_ms <= self.latency_p95_ms:
            raise ValueError("expected latency_p5_ms <= latency_median_ms <= latency_p95_ms")
        return self


RelianceVersion = Literal["1.0.0"]
RELIANCE_VERSION: RelianceVersion = "1.0.0"
"""Version of the score's definition and of the scenes; scores of different versions are not
compared."""


class RelianceParts(StrictModel):
    """The parts of the score, and further measurements; means over samples, null where a part can't
    be measured.

    ``follows_*``: how far the answer follows, in [0, 1], when a surface moves within its outline.
    ``phase``: only the phase is that of the moved surface, every pixel keeps its brightness (part
    of the score). ``light``: only the brightness is. ``both``: both, as a camera would see it.
    ``constant``: the phase alone, moved by a constant. ``change_*``: how much the answer changes,
    relative to the change that the phase asks for: with another outline (part of the score),
    without fringes inside or outside the object, with fringes of the other direction or of another
    pitch. ``answered_*``: share of the object's pixels that have an answer in that case.
    ``order_free_*``: the same, allowing whole periods."""

    follows_phase: Annotated[
        Share | None, "follows the phase, within the object, brightness unchanged"
    ]
    follows_light: Annotated[Share | None, "follows the brightness, phase unchanged"]
    follows_both: Annotated[Share | None, "follows a moved surface as it would be photographed"]
    follows_constant: Annotated[Share | None, "follows the phase when all of the object moves"]
    change_outline: Annotated[NonNegative | None, "changes with another outline"]
    change_no_fringe_inside: Annotated[
        NonNegative | None, "changes without fringes inside the object"
    ]
    change_no_fringe_outside: Annotated[
        NonNegative | None, "changes without fringes outside the object"
    ]
    change_other_direction: Annotated[
        NonNegative | None, "changes with fringes of the other direction"
    ]
    change_other_pitch: Annotated[NonNegative | None, "changes with fringes of another pitch"]
    answered_no_fringe_inside: Annotated[Share | None, "share answered without fringes inside"]
    answered_no_fringe_outside: Annotated[Share | None, "share answered without fringes outside"]
    order_free_follows_phase: Annotated[Share | None, "follows the phase, without whole periods"]
    order_free_change_outline: Annotated[
        NonNegative | None, "changes with another outline, without whole periods"
    ]

    def titled(self) -> dict[str, float | None]:
        """Each part by what it is in words."""
        return {
            str(field.metadata[0]): getattr(self, name)
            for name, field in type(self).model_fields.items()
        }


class Reliance(StrictModel):
    """The phase-reliance score in [0, 1] with its 95% interval (bootstrap over objects; nulls below
    two objects).

    ``order_free_score`` allows whole periods and is null where the answer is not in mm. ``units``
    are those of the answer that was held against the truth; ``weights_sha256`` of a network is that
    of its weights file."""

    version: RelianceVersion
    score: Share
    interval: Interval
    order_free_score: Share | None
    parts: RelianceParts
    units: Literal["mm", "normalised"]
    direction: Literal["horizontal", "vertical", "crossed"]
    samples: Whole
    objects: Whole
    dataset_fingerprint: Sha256
    protocol_version: Text
    weights_sha256: Sha256 | None

    @model_validator(mode="after")
    def _consistent(self) -> "Reliance":
        check_measured(self.interval, self.samples, self.objects, 1.0)
        return self


class SeverityScores(StrictModel):
    """Means over the views of a severity. ``mae_mm`` is the protocol's two-sided MAE,
    ``answered_mae_mm`` that of the object's pixels with an answer. Shares of the scored pixels: of
    wrong orders, of pixels without an answer, of confident errors and of pixels that state a sigma
    (null both where a method states none); ``invented_share`` is background with an answer, over
    the scored pixels. ``sure_mae_mm`` and ``sure_rmse_mm`` are of the surest 95%, as in the
    protocol; null where the method states no sigma."""

    mae_mm: NonNegative
    wrong_share: Share
    unanswered_share: Share
    invented_share: NonNegative
    answered_mae_mm: NonNegative | None
    confident_share: Share | None
    coverage: Share | None
    sure_mae_mm: NonNegative | None
    sure_rmse_mm: NonNegative | None


AxesVersion = Annotated[int, Field(ge=4)]
FiveSeverities = Annotated[list[SeverityScores], Field(min_length=5, max_length=5)]


class Robustness(StrictModel):
    """What disturbed scenes do to a method: ``mae_mm`` is the mean over ``axes`` and their five
    severities, with its 95% interval (bootstrap over objects; nulls below two objects); ``clean``
    is the undisturbed scene. ``beside``: axes that do not count in the mean. ``drawn``: those that
    the training's lights disturbed too. ``version`` is that of the axes; before 4 a missed pixel
    cost less and an invented one nothing."""

    version: AxesVersion
    set: Literal["test", "unseen"]
    mae_mm: NonNegative
    interval: Interval
    clean: SeverityScores
    axes: Annotated[dict[Text, FiveSeverities], Field(min_length=1)]
    beside: dict[Text, FiveSeverities] = Field(default_factory=dict)
    drawn: list[Text]
    samples: Whole
    objects: Whole
    size_px: Whole
    weights_sha256: Sha256 | None

    @property
    def ratio(self) -> float | None:
        """``mae_mm`` over that of the clean scene."""
        return self.mae_mm / self.clean.mae_mm if self.clean.mae_mm else None

    def mean(self, key: str) -> float | None:
        """Mean of a score over axes and severities; None where there is none."""
        values = [getattr(scores, key) for axis in self.axes.values() for scores in axis]
        return None if None in values else math.fsum(values) / len(values)

    @model_validator(mode="after")
    def _consistent(self) -> "Robustness":
        if not math.isclose(self.mae_mm, self.mean("mae_mm") or 0.0, rel_tol=1e-9, abs_tol=1e-12):
            raise ValueError("mae_mm does not follow from axes")
        check_measured(self.interval, self.samples, self.objects)
        return self


class DatasetScores(StrictModel):
    """A method on one dataset of a track, means over its samples against the exact depth. ``mae_mm``
    is the protocol's two-sided MAE; ``per_mille``: of the rig's standoff; ``projector_px``: as far
    as a change of depth by it moves the pattern's image at the standoff; ``of_decoded``: over the
    MAE of the depth that the dataset's many frames decode, where they do, null for a perfect one;
    ``answered_per_mille``: MAE of the object's pixels with an answer, null without any.
    Shares of the object's pixels: missing, and invented ones of the background over them."""

    light: Text
    mae_mm: NonNegative
    per_mille: NonNegative
    answered_per_mille: NonNegative | None
    projector_px: NonNegative
    of_decoded: NonNegative | None
    missing_share: Share
    invented_share: NonNegative


class TrackScores(StrictModel):
    """A method on rigs in lights: ``datasets`` by name, and by name why it has no answer to the
    ``refused`` ones. ``benchmark`` is the track where all its datasets have the content of one that
    is named, null for others."""

    benchmark: BenchmarkInfo | None
    name: Text
    method: Text
    weights_sha256: Sha256 | None
    datasets: Annotated[dict[Text, DatasetScores], Field(min_length=1, max_length=1000)]
    refused: dict[Text, Reason]

    @property
    def title(self) -> str:
        known = self.benchmark
        return f"{known.name} version {known.version}" if known else "no named track"

    @property
    def lights(self) -> list[str]:
        """The lights that have a score, in the order of the datasets."""
        return list(dict.fromkeys(scores.light for scores in self.datasets.values()))

    def mean(self, light: str) -> DatasetScores:
        """Mean over the rigs that have an answer in ``light``; one of `lights`."""
        rows = [scores for scores in self.datasets.values() if scores.light == light]
        means: dict[str, Any] = {"light": light}
        for key in DatasetScores.model_fields.keys() - {"light"}:
            values = [value for row in rows if (value := getattr(row, key)) is not None]
            means[key] = math.fsum(values) / len(values) if values else None
        return DatasetScores(**means)

    def worst(self, light: str) -> str:
        """The dataset in ``light``, one of `lights`, of the largest error per mille."""
        of_light = {name: row for name, row in self.datasets.items() if row.light == light}
        return max(of_light, key=lambda name: of_light[name].per_mille)

    @model_validator(mode="after")
    def _consistent(self) -> "TrackScores":
        if both := sorted(self.datasets.keys() & self.refused.keys()):
            raise ValueError(f"{both[0]} has scores, and a reason why it has none")
        return self


def check_measured(
    interval: Sequence[float | None], samples: int, objects: int, most: float = math.inf
) -> None:
    """Refuse (ValueError) an interval that is none, and more objects than samples."""
    if interval.count(None) == 1:
        raise ValueError("interval: expected two numbers or two nulls")
    if (pair := ends(interval)) and not 0 <= pair[0] <= pair[1] <= most:
        raise ValueError(
            f"interval: expected 0 <= low <= high{'' if most == math.inf else f' <= {most:g}'}"
        )
    if objects > samples:
        raise ValueError("objects is above samples")


class SigmaScores(Scores):
    """Scores of a stated uncertainty; null where no object pixel states one, or where there is no
    object. The rules are in PROTOCOL.md."""

    __annotations__ = _fields(UNCERTAINTY.values())


class Reliability(StrictModel):
    """``observed``: mean over samples of the share of pixels within the interval that should hold
    ``nominal``."""

    nominal: list[Share]
    observed: Annotated[list[Share], Field(min_length=len(NOMINAL), max_length=len(NOMINAL))]


_Curve = Annotated[list[NonNegative], Field(min_length=len(LEFT_OUT), max_length=len(LEFT_OUT))]


class Sparsification(StrictModel):
    """Means over samples of the errors in mm of the object pixels that remain after the share
    ``left_out``: the least sure by sigma, and for ``best_*`` the worst by their error."""

    left_out: list[Share]
    mae_mm: _Curve
    best_mae_mm: _Curve
    rmse_mm: _Curve
    best_rmse_mm: _Curve


class Uncertainty(StrictModel):
    """``metrics`` is the mean over the samples that have a score, ``per_object`` over the views of
    each object."""

    metrics: SigmaScores
    per_object: dict[Text, SigmaScores] = Field(max_length=100_000)
    per_sample: dict[Text, SigmaScores] = Field(max_length=100_000)
    reliability: Reliability | None
    sparsification: Sparsification | None
