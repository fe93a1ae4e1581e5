"""A row file: what the leaderboard needs of a result of ``fpp-eval``, in at most 12 KB, as a strict
model that checks itself. Its means of objects are all that ranks need; the whole result is
published elsewhere and found by its hash."""

import json
import math
import re
import unicodedata
from collections.abc import Iterable, Iterator
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from fpp_ml_bench.constants import WORKING_RANGE_MM
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation import protocol
from fpp_ml_bench.evaluation.metrics import RANKED
from fpp_ml_bench.evaluation.protocol import FramesClass, Mode, Target, Track
from fpp_ml_bench.evaluation.result.file import result_json, write_file
from fpp_ml_bench.evaluation.result.model import Result, check_charge, check_data, check_reliance
from fpp_ml_bench.evaluation.result.parts import (
    AxesVersion,
    BenchmarkInfo,
    Charge,
    DatasetInfo,
    DatasetScores,
    HardwareInfo,
    Headline,
    Interval,
    Intervals,
    Metrics,
    ObjectResult,
    Reliance,
    Robustness,
    Sha256,
    Timing,
    TrackScores,
    Uncertainty,
    Whole,
    can_mix,
    check_measured,
    exceeds,
)
from fpp_ml_bench.evaluation.score.uncertainty import object_interval
from fpp_ml_bench.evaluation.submission.description import Submission
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.storage.benchmark import Counts
from fpp_ml_bench.schema import Count, NonNegative, Share, SparseModel, StrictModel, Text, validate

ROW_SCHEMA_VERSION = "3.0.0"
LARGEST_ROW_BYTES = 12_000
DIGITS = 5
"""Significant digits of the means of a row."""
_ROUNDED = 5.005e-5
"""Relative error of a number that is rounded to `DIGITS`, at most."""
ROUNDED_TWICE = 2 * _ROUNDED
"""Relative difference between a rounded mean of errors and a mean of rounded errors, at most."""
_MARKS = ("Mn", "Me")
"""Categories of the combining characters that are drawn on a letter."""
# Default-ignorable code points that are no format characters, which no text of a submission may
# hold anyway, blanks that are no spaces, and code points that each font shows as it likes.
_INVISIBLE = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180d\u180f\u2065\u2800\u3164\ufe00-\ufe0f\uffa0\ufff0-\ufff8\ufffc"
    "\ue000-\uf8ff\U00013440-\U00013455\U00016fe4\U0001d159\U000e0000-\U0010ffff]"
)
_DIACRITICS = re.compile("[\u0300-\u036f\u1ab0-\u1aff\u1dc0-\u1dff\u20d0-\u20ff\ufe20-\ufe2f]")
_TWINS = (
    "aаαɑᴀⲁ bвьβʙᏼꓐ cсϲᴄⲥᏟꓚ dԁᴅᎠꓓᏧꓒđ eеєεҽᴇᎬꓰⲉ fғꜰꓝ gɡԍցɢᏀꓖ hһнհʜᎻꓧⲏħ jјϳյᴊᎫꓙ kкκᴋᏦꓗⲕ mмᴍᎷꓟⲙ "
    "nпոɴꓠⲛ "
    "l1i|іιıɩɪǀӏןוا∣│׀ɨłƚʟլᎥᏞꓡꓲⵏ١۱ⲓ o0оοᴏօσסهⲟⵔꓳ০०੦૦௦౦೦൦๐໐၀٥۵ø pрρᴘᏢꓑⲣ qԛզգ rгʀᏒꓣᴦⲅ sѕꜱտᏚᏕꓢ "
    "tтτᴛᎢꓔⲧŧ "
    "uսᴜꓴ vѵᴠᏙꓦ wԝωաᴡᏔᏯꓪѡ xхχꓫⲭ yуγүʏᎩꓬⲩყ zζᴢᏃꓜ 3зӡʒ 6б -‐‒–—―−⁃˗ '’‘ʼʹ′`´ ,‚، .·•‧∙⋅ !ǃ"
)
"""Small characters that look the same, or whose capitals do, behind the one that stands for all of
them: out of Unicode's confusables (UTS 39), those of a Latin letter, figure or sign."""
_TWIN_OF = {ord(twin): group[0] for group in _TWINS.split() for twin in group}


class ObjectMeans(Headline, SparseModel):
    """An object: means over its ``samples`` views of the errors of `RANKED`, in mm, and over all
    views how many pixels count. ``without_object`` and ``without_background``: views whose set is
    empty, which are in no mean of it."""

    SPARSE: ClassVar[tuple[str, ...]] = ("two_sided_mae_mm", "without_object", "without_background")

    two_sided_mae_mm: NonNegative | None = None
    object: Text
    samples: Whole
    object_pixels: Count
    background_pixels: Count
    void_pixels: Count
    without_object: Count = 0
    without_background: Count = 0

    @property
    def sample(self) -> str:
        """In a comparison of rows, an object stands for its samples."""
        return self.object

    def views(self, key: str) -> int:
        """How many views the mean ``key`` is over."""
        if key.startswith("background"):
            return self.samples - self.without_background
        return self.samples - (0 if key.startswith("overall") else self.without_object)


class RowUncertainty(StrictModel):
    """Of a stated uncertainty: share of object pixels within the stated 95% interval, to which
    those that state none do not belong; AUSE, and MAE and RMSE of the surest 95% of all object
    pixels, in mm, null in older files; the rules are in PROTOCOL.md."""

    within_95_share: Share | None = None
    ause_mae_mm: NonNegative | None = None
    sure_mae_mm: NonNegative | None = None
    sure_rmse_mm: NonNegative | None = None


class RowRobustness(StrictModel):
    """`Robustness` in brief: ``clean_mae_mm`` is that of the undisturbed scene, ``axes`` and
    ``beside`` are means over severities."""

    version: AxesVersion
    mae_mm: NonNegative
    interval: Interval
    clean_mae_mm: NonNegative
    axes: Annotated[dict[Text, NonNegative], Field(min_length=1)]
    beside: dict[Text, NonNegative]
    drawn: list[Text]
    samples: Whole
    objects: Whole
    size_px: Whole

    @model_validator(mode="after")
    def _consistent(self) -> "RowRobustness":
        if not math.isclose(self.mae_mm, fmean(self.axes.values()), rel_tol=ROUNDED_TWICE):
            raise ValueError("mae_mm does not follow from axes")
        check_measured(self.interval, self.samples, self.objects)
        return self


class RowTrack(StrictModel):
    """`TrackScores` in brief: by light the means over the rigs that have an answer and the error of
    the worst; the error of each dataset, and the names of those without an answer."""

    benchmark: BenchmarkInfo
    mean: Annotated[dict[Text, DatasetScores], Field(min_length=1, max_length=10)]
    worst_per_mille: dict[Text, NonNegative]
    per_mille: Annotated[dict[Text, NonNegative], Field(min_length=1, max_length=100)]
    refused: list[Text]

    @model_validator(mode="after")
    def _consistent(self) -> "RowTrack":
        if self.mean.keys() != self.worst_per_mille.keys():
            raise ValueError("worst_per_mille: expected the lights of mean")
        if both := self.per_mille.keys() & set(self.refused):
            raise ValueError(f"{min(both)} has an error, and is among the refused")
        return self


class Row(SparseModel):
    """What is ranked of a result. Means have `DIGITS` significant digits. ``submission`` has its
    run time only in ``timing`` where that is there. ``predictions_sha256`` is over the sorted
    hashes of the prediction files; ``result_sha256`` finds the full result, wherever it is
    published."""

    SPARSE = ("uncertainty", "reliance", "robustness", "rigs", "charge_mm")

    row_schema_version: Literal["3.0.0"]
    submission: Submission
    frames_class: FramesClass
    dataset: DatasetInfo
    target: Target
    mode: Mode
    edge_band_px: Annotated[int, Field(ge=0, le=1000)]
    charge_mm: Charge = None
    protocol_version: Annotated[str, Field(pattern=r"^[0-9]{1,4}\.[0-9]{1,4}\.[0-9]{1,4}$")]
    created: Annotated[str, Field(pattern=r"^[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9:.+Z-]{8,30}$")]
    package: Text
    git: Annotated[str, Field(pattern=r"^[0-9a-f]{40,64}$")] | None
    code_sha256: Sha256
    predictions_sha256: Sha256
    result_sha256: Sha256
    metrics: Metrics
    intervals: Intervals
    per_object: Annotated[list[ObjectMeans], Field(min_length=1, max_length=1000)]
    uncertainty: RowUncertainty | None = None
    reliance: Reliance | None = None
    robustness: dict[Literal["test", "unseen"], RowRobustness] | None = None
    rigs: RowTrack | None = None

    @property
    def per_sample(self) -> list[ObjectMeans]:
        """What a comparison of rows takes for samples."""
        return self.per_object

    @property
    def track(self) -> Track:
        return self.submission.track

    @property
    def timing(self) -> Timing | None:
        """What `fpp-bench time` measured, or what the submission reports; None where it reports
        nothing."""
        return self.submission.timing

    @property
    def hardware(self) -> HardwareInfo | None:
        """The machine that the time was taken on; None where there is no time."""
        return self.submission.hardware if self.timing is None else self.timing.hardware

    @model_validator(mode="after")
    def _consistent(self) -> "Row":
        if problem := name_problem(self.submission.name):
            raise ValueError(f"submission.name: {problem}")
        if (self.frames_class == protocol.FRAMES_CLASSES[0]) != (
            len(self.submission.frames_used) == 1
        ):
            raise ValueError(
                f"frames_class is {self.frames_class}, of {len(self.submission.frames_used)} "
                f"frames_used"
            )
        if len({part.object for part in self.per_object}) != len(self.per_object):
            raise ValueError("per_object names an object twice")
        if (samples := sum(part.samples for part in self.per_object)) != self.dataset.samples:
            raise ValueError(
                f"per_object holds {samples} samples, dataset.samples says {self.dataset.samples}"
            )
        if samples > protocol.MOST_SAMPLES:
            raise ValueError(
                f"dataset.samples: expected at most {protocol.MOST_SAMPLES}, got {samples}"
            )
        benchmark = self.dataset.known
        if benchmark is not None and self.dataset.size != benchmark.image_size:
            expected = f"{benchmark.title} has images of {benchmark.image_size}"
            raise ValueError(f"dataset.size: {expected}, got {self.dataset.size}")
        pixels = self.dataset.size[0] * self.dataset.size[1]
        for part in self.per_object:
            _check_object(part, pixels)
        for key in RANKED:
            _check_follows(
                f"metrics.{key}", getattr(self.metrics, key), mean_over(self.per_object, key)
            )
            ends = interval_over(self.per_object, key) or (None, None)
            for stored, computed in zip(self.intervals.of(key) or (None, None), ends, strict=True):
                _check_follows(f"intervals.{key}", stored, computed)
        void = sum(part.void_pixels for part in self.per_object) / (samples * pixels)
        _check_follows(
            "metrics.void_share", self.metrics.void_share, void if self.mode == "standard" else None
        )
        if (
            problem := self.metrics.problem(samples, _ROUNDED, self.charge_mm)
            or self._other_problem()
        ):
            raise ValueError(f"metrics: {problem}")
        if self.protocol_version == protocol.PROTOCOL_VERSION:
            counts = {
                p.object: Counts(
                    p.samples,
                    p.object_pixels,
                    p.void_pixels,
                    p.without_object + p.without_background,
                )
                for p in self.per_object
            }
            check_data(self.dataset, self.target, self.mode, self.submission.units, counts)
            check_charge(self.charge_mm, self.dataset, self.mode)
        if self.reliance is not None:
            check_reliance(self.reliance, self.submission)
        return self

    def _other_problem(self) -> str | None:
        """What of a stated uncertainty, and of the error beside the depth range, contradicts the
        object's errors."""
        scores, sure = self.metrics, self.uncertainty or RowUncertainty()
        if scores.object_mae_mm is None:
            return None
        left_out = protocol.SURE_LEFT_OUT, 1 - protocol.SURE_LEFT_OUT
        unsure = max(scores.object_max_mm, self.charge_mm or 0.0)
        wholes = scores.object_mae_mm, scores.object_rmse_mm
        if self.charge_mm is not None:
            wholes = scores.two_sided_mae_mm, None
        for power, (name, whole) in enumerate(zip(("mae", "rmse"), wholes, strict=True), start=1):
            value = getattr(sure, f"sure_{name}_mm")
            if None not in (whole, value) and not can_mix(
                whole, (0.0, unsure), value, left_out, power, _ROUNDED
            ):
                return (
                    f"the error of all pixels does not follow from uncertainty.sure_{name}_mm and "
                    f"the largest one"
                )
        share, (near, far) = scores.object_mae_range_share, WORKING_RANGE_MM
        if (
            self.dataset.known
            and share is not None
            and exceeds(scores.object_mae_mm, share * (far - near), _ROUNDED)
        ):
            return (
                f"object_mae_range_share: no object of the benchmark is deeper than {far - near:g} "
                f"mm"
            )
        return None


def _check_follows(name: str, stored: float | None, computed: float | None) -> None:
    """Refuse (ValueError) a value that is not the ``computed`` one but for rounding."""
    missing = (stored is None) != (computed is None)
    if missing or not math.isclose(stored or 0.0, computed or 0.0, rel_tol=ROUNDED_TWICE):
        raise ValueError(f"{name} does not follow from per_object: {stored}, not {computed}")


def _check_object(part: ObjectMeans, pixels: int) -> None:
    """Refuse (ValueError) an object whose sets do not make up ``pixels`` a view, or whose scores
    contradict them."""
    name = printable(part.object)
    if part.object_pixels + part.background_pixels + part.void_pixels != part.samples * pixels:
        raise ValueError(
            f"{name}: object, background and void pixels do not add up to {part.samples} images"
        )
    for pixel_set in protocol.PIXEL_SETS:
        mae, rmse = (getattr(part, f"{pixel_set}_{error}_mm") for error in ("mae", "rmse"))
        count = getattr(part, f"{pixel_set}_pixels", part.object_pixels + part.background_pixels)
        if not (count == 0) == (mae is None) == (rmse is None):
            raise ValueError(
                f"{name}: {pixel_set} scores must be null exactly when the set is empty"
            )
        if count and not part.views(pixel_set) <= count <= part.views(pixel_set) * pixels:
            views = part.views(pixel_set)
            raise ValueError(
                f"{name}: {count} {pixel_set} pixels are not those of {views} views, or no view "
                f"has the set"
            )
        if mae is not None and exceeds(mae, rmse, _ROUNDED):
            raise ValueError(f"{name}: {pixel_set} RMSE is below its MAE, which no error has")
    scored = max(pixels - part.void_pixels, 1)  # of a view, at least
    shares = part.object_pixels / scored, part.background_pixels / scored
    for power, error in enumerate(("mae", "rmse"), start=1):
        whole, inside, outside = (
            getattr(part, f"{pixel_set}_{error}_mm") or 0.0 for pixel_set in protocol.PIXEL_SETS
        )
        if not can_mix(whole, (inside, inside), outside, shares, power, _ROUNDED):
            raise ValueError(
                f"{name}: overall {error.upper()} does not follow from object, background and "
                f"their pixels"
            )


def mean_over(objects: Iterable[ObjectMeans], key: str) -> float | None:
    """Mean of a headline score over the views of ``objects``; None where no view has it."""
    means = list(view_means(objects, key))
    return fmean(value for _, value in means) if means else None


def interval_over(objects: Iterable[ObjectMeans], key: str) -> tuple[float, float] | None:
    """The 95% interval of `mean_over`, from a bootstrap over objects."""
    means = list(view_means(objects, key))
    return object_interval([value for _, value in means], [name for name, _ in means])


def view_means(objects: Iterable[ObjectMeans], key: str) -> Iterator[tuple[str, float]]:
    """An object's name and mean for each of its views: the bootstrap needs no more of them than
    their sum."""
    for part in objects:
        if (mean := getattr(part, key)) is not None:
            yield from [(part.object, mean)] * part.views(key)


def name_key(name: str) -> str:
    """What two names share that look the same: compatible forms and twins of other scripts,
    ignoring diacritics, letter case, spaces, and dots at the ends."""
    key = unicodedata.normalize("NFKD", name).casefold().translate(_TWIN_OF)
    key = _DIACRITICS.sub("", key).replace("rn", "m").replace("vv", "w")
    return " ".join(key.split()).strip(". ")


def looks_like(name: str, other: str) -> bool:
    """Whether ``name`` has the `name_key` of ``other``, or one that differs in letters only, less
    than half of them, that are no Latin ones: `_TWINS` does not have all scripts."""
    key, of_other = name_key(name), name_key(other)
    if key == of_other or key.isascii() or len(key) != len(of_other):
        return key == of_other
    foreign = [first for first, second in zip(key, of_other, strict=True) if first != second]
    return 2 * len(foreign) < len(key) and not any(letter.isascii() for letter in foreign)


def name_problem(name: str) -> str | None:
    """Why a method can't be called ``name``; None where it can."""
    if ignorable := _INVISIBLE.search(name):
        return f"expected visible characters, got U+{ord(ignorable[0]):04X}, which shows nothing"
    # In this form a letter that a language writes with two marks has none.
    for first, second in pairwise(unicodedata.normalize("NFC", name)):
        of_first, of_second = map(unicodedata.category, (first, second))
        if of_second in _MARKS and (of_first in _MARKS or unicodedata.decomposition(first)):
            return f"expected at most one mark on a letter, got U+{ord(second):04X} on another mark"
    return None


def row_content(result: Result, digits: int | None = DIGITS) -> dict[str, Any]:
    """The content of a `Row` of ``result``; with ``digits`` None nothing is rounded."""
    described, about = result.submission.model_dump(mode="json"), result.environment
    if result.timing is not None:  # it names the same time, machine and software
        described |= dict.fromkeys(("seconds_per_sample", "seconds_source", "hardware"))
        described["software"] = {} if result.timing.software else described["software"]
    kept = {
        "dataset",
        "frames_class",
        "target",
        "mode",
        "edge_band_px",
        "charge_mm",
        "protocol_version",
        "created",
    }
    hashes = sorted(sample.prediction_sha256 for sample in result.per_sample)
    content = {
        "row_schema_version": ROW_SCHEMA_VERSION,
        "submission": described,
        **result.model_dump(mode="json", include=kept),
        "package": about.packages["fpp_ml_bench"],
        "git": about.git,
        "code_sha256": about.code_sha256,
        "predictions_sha256": sha256("\n".join(hashes).encode()).hexdigest(),
        "result_sha256": sha256(result_json(result)).hexdigest(),
        **rounded(result.model_dump(mode="json", include={"metrics", "intervals"}), digits),
        "per_object": [rounded(_object_means(result, part), digits) for part in result.per_object],
    }
    if result.uncertainty is not None:
        content["uncertainty"] = rounded(_uncertainty(result.uncertainty), digits)
    if result.reliance is not None:
        content["reliance"] = in_brief(result.reliance)
    if result.robustness is not None:
        content["robustness"] = {name: in_brief(block) for name, block in result.robustness.items()}
    if result.rigs is not None:
        content["rigs"] = in_brief(result.rigs)
    return content


def row_of(result: Result, path: Path) -> Row:
    """The row of ``result``, which is in the file ``path``. SubmissionError for what can't be a
    row."""
    return validate(Row, row_content(result), path, "result for the leaderboard")


def _object_means(result: Result, part: ObjectResult) -> dict[str, Any]:
    views = [sample for sample in result.per_sample if sample.object == part.object]
    counts = {
        name: [getattr(v, f"{name}_pixels") or 0 for v in views]
        for name in ("object", "background", "void")
    }
    return {
        "object": part.object,
        "samples": part.samples,
        **{f"{name}_pixels": sum(numbers) for name, numbers in counts.items()},
        **{f"without_{name}": counts[name].count(0) for name in ("object", "background")},
        **part.metrics.model_dump(include=set(RANKED)),
    }


def _uncertainty(block: Uncertainty) -> dict[str, float | None]:
    samples = [scores for scores in block.per_sample.values() if scores.unstated_share is not None]
    covered = [
        (scores.coverage_95 or 0.0) * (1 - (scores.unstated_share or 0.0)) for scores in samples
    ]
    errors = {
        key: getattr(block.metrics, key) for key in ("ause_mae_mm", "sure_mae_mm", "sure_rmse_mm")
    }
    return {"within_95_share": fmean(covered) if covered else None, **errors}


def in_brief(block: Reliance | Robustness | TrackScores) -> dict[str, Any]:
    """What a row holds of a block: a reliance in four digits, of a robustness the content of a
    `RowRobustness`, of a track that of a `RowTrack`."""
    content = block.model_dump(mode="json")
    if isinstance(block, TrackScores):
        content = {
            "benchmark": content["benchmark"],
            "mean": {light: block.mean(light).model_dump() for light in block.lights},
            "worst_per_mille": {
                light: block.datasets[block.worst(light)].per_mille for light in block.lights
            },
            "per_mille": {name: scores.per_mille for name, scores in block.datasets.items()},
            "refused": sorted(block.refused),
        }
        return rounded(content, 4)  # type: ignore[no-any-return]
    if isinstance(block, Robustness):
        axes, beside = (
            {name: fmean(scores.mae_mm for scores in axis) for name, axis in part.items()}
            for part in (block.axes, block.beside)
        )
        content |= {"clean_mae_mm": block.clean.mae_mm, "axes": axes, "beside": beside}
        content = {key: content[key] for key in RowRobustness.model_fields}
    return rounded(content, DIGITS if isinstance(block, Robustness) else 4)  # type: ignore[no-any-return]


def rounded(value: Any, digits: int | None) -> Any:
    """``value`` with every fraction in it rounded to significant ``digits``."""
    if isinstance(value, dict):
        return {key: rounded(inner, digits) for key, inner in value.items()}
    if isinstance(value, list):
        return [rounded(inner, digits) for inner in value]
    return (
        float(f"{value:.{digits}g}") if isinstance(value, float) and digits is not None else value
    )


def row_json(row: Row) -> bytes:
    """The bytes of a row file: JSON with a line for each key."""
    content = row.model_dump(mode="json").items()
    lines = [
        f'"{key}": {json.dumps(value, ensure_ascii=False, allow_nan=False)}'
        for key, value in content
    ]
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode()


def write_row(row: Row, path: Path) -> bytes:
    """Write a row file; its bytes. SubmissionError for a row that is too large, or an unwritable
    path."""
    data = row_json(row)
    check_size(data, path)
    write_file(data, path)
    return data


def check_size(data: bytes, path: Path) -> None:
    """Refuse (SubmissionError) a row file of more than `LARGEST_ROW_BYTES`."""
    if len(data) > LARGEST_ROW_BYTES:
        raise SubmissionError(
            f"{printable(path)}: the row has {len(data):,} bytes, expected at most "
            f"{LARGEST_ROW_BYTES:,}; "
            "shorten settings, software or seeds in submission.yaml, and score again"
        )


def processor(hardware: HardwareInfo) -> str:
    """A processor and how many of its cores there are, in words."""
    return f"{hardware.cpu}, {'1 core' if hardware.cores == 1 else f'{hardware.cores} cores'}"
