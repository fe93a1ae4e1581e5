"""Two results of the same samples, sample by sample: the paired difference, its interval, and a sentence about it.

Samples that are hard for both methods cancel in the difference. A comparison can therefore tell two methods apart whose
own intervals overlap.
"""

import statistics
from typing import Annotated, Any

from pydantic import Field
from rich.console import Group
from rich.table import Table
from rich.text import Text as RichText

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import HEADLINE
from fpp_ml_bench.evaluation.report.numbers import interval_text, millimetres, signed
from fpp_ml_bench.evaluation.result import DatasetInfo, Interval, Result
from fpp_ml_bench.evaluation.schema import Count, StrictModel, Text
from fpp_ml_bench.evaluation.score import caution, object_interval
from fpp_ml_bench.files import printable

MAIN_KEY = "object_mae_mm"


class PairedSample(StrictModel):
    """Second minus first, in mm, for one sample; null where a pixel set is empty."""

    sample: Text
    object: Text
    differences: dict[Text, float | None]


class Difference(StrictModel):
    """Mean of second minus first in mm over the ``samples`` that both have, its 95% interval over ``objects``.

    ``lower`` and ``higher`` count the samples in which the second's error is smaller and larger.
    """

    mean_mm: float | None
    interval_mm: Interval
    samples: Count
    objects: Count
    lower: Count
    higher: Count

    @property
    def told_apart(self) -> bool:
        """Whether 0 is outside the interval."""
        low, high = self.interval_mm
        return low is not None and high is not None and not low <= 0 <= high


class Comparison(StrictModel):
    """``second`` against ``first``: a `Difference` for each headline key, and the differences of each sample."""

    first: Text
    second: Text
    fingerprint: Text
    split: Text
    target: Text
    track: Text
    mode: Text
    differences: dict[Text, Difference]
    sentence: Annotated[str, Field(max_length=2000)]
    per_sample: list[PairedSample]


def compare(first: Result, second: Result) -> Comparison:
    """The paired comparison of two results. SubmissionError names everything in which their data differ."""
    _check_same_data(first, second)
    second_rows = {row.sample: row for row in second.per_sample}
    paired = [
        PairedSample(
            sample=row.sample,
            object=row.object,
            differences={
                key: _difference(getattr(row, key), getattr(second_rows[row.sample], key)) for key in HEADLINE
            },
        )
        for row in first.per_sample
    ]
    differences = {key: _summary(paired, key) for key in HEADLINE}
    names = printable(first.submission.name), printable(second.submission.name)
    if names[0] == names[1]:
        names = f"{names[0]} (first)", f"{names[1]} (second)"
    return Comparison(
        first=first.submission.name,
        second=second.submission.name,
        fingerprint=first.dataset.fingerprint,
        split=first.dataset.split,
        target=first.target,
        track=first.track,
        mode=first.mode,
        differences=differences,
        sentence=sentence(*names, differences[MAIN_KEY]),
        per_sample=paired,
    )


def _check_same_data(first: Result, second: Result) -> None:
    pairs: dict[str, tuple[Any, Any]] = {
        "split": (first.dataset.split, second.dataset.split),
        "target": (first.target, second.target),
        "track": (first.track, second.track),
        "mode": (first.mode, second.mode),
        "protocol": (first.protocol_version, second.protocol_version),
    }
    lines = [f"{key}: {a} against {b}" for key, (a, b) in pairs.items() if a != b]
    if not _same_dataset(first.dataset, second.dataset):
        lines.insert(0, f"dataset: {printable(first.dataset.identity)} against {printable(second.dataset.identity)}")
    if _samples(first) != _samples(second):
        lines.append("samples: the samples differ")
    if lines:
        raise SubmissionError(
            "the two results can't be compared, they were not scored on the same data by the same rules; score both "
            "with the same fpp-eval options:\n  " + "\n  ".join(lines)
        )


def _same_dataset(first: DatasetInfo, second: DatasetInfo) -> bool:
    """Whether both have the same fingerprint and do not name two different benchmarks."""
    named = {info.benchmark for info in (first, second) if info.benchmark is not None}
    return first.fingerprint == second.fingerprint and len(named) < 2


def _samples(result: Result) -> list[tuple[str, int]]:
    return sorted((row.sample, row.object_pixels) for row in result.per_sample)


def _difference(first: float | None, second: float | None) -> float | None:
    return None if first is None or second is None else second - first


def _summary(paired: list[PairedSample], key: str) -> Difference:
    values = [row.differences[key] for row in paired]
    differences = [value for value in values if value is not None]
    interval = object_interval(values, [row.object for row in paired])
    return Difference(
        mean_mm=statistics.fmean(differences) if differences else None,
        interval_mm=[None, None] if interval is None else list(interval),
        samples=len(differences),
        objects=len({row.object for row, value in zip(paired, values, strict=True) if value is not None}),
        lower=sum(value < 0 for value in differences),
        higher=sum(value > 0 for value in differences),
    )


def sentence(first: str, second: str, difference: Difference) -> str:
    """The difference in object MAE as a sentence."""
    if difference.mean_mm is None:
        return "No sample has an object in it, so object MAE says nothing."
    if not difference.lower and not difference.higher:
        return f"{second} and {first} have the same object MAE in all {difference.samples} samples."
    size = f"{millimetres(abs(difference.mean_mm))} mm"
    word = "lower" if difference.mean_mm < 0 else "higher"
    count = difference.lower if difference.mean_mm < 0 else difference.higher
    views = f"{word} in {count} of {difference.samples} samples"
    low, high = difference.interval_mm
    if low is None or high is None:
        return (
            f"{second} has an object MAE {size} {word} than {first} on average, {views}; with one object there is no "
            "interval, so nothing can be said beyond it."
        )
    ends = f"{_signed(low)} to {_signed(high)} mm over {difference.objects} objects"
    few_objects = f" {warning}" if (warning := caution(difference.objects)) else ""
    if difference.told_apart:
        return (
            f"{second} has a {word} object MAE than {first}, by {size} on average (95% interval {ends}), "
            f"{views}.{few_objects}"
        )
    return (
        f"The object MAE of {second} and {first} can't be told apart: {second} is {size} {word} on average ({views}), "
        f"but the 95% interval, {ends}, holds 0.{few_objects}"
    )


def _signed(value: float) -> str:
    return ("-" if value < 0 else "") + millimetres(abs(value))


def comparison_table(comparison: Comparison) -> Group:
    """The comparison as rich tables; every text from a submission is shown as plain text, never as markup."""
    table = Table(caption="mm; mean of second - first over samples, 95% interval over objects", caption_justify="left")
    table.add_column("Error")
    for heading in ("Second - first", "95% interval", "Second lower in", "Second higher in", "Samples", "Objects"):
        table.add_column(heading, justify="right", no_wrap=True)
    for key, row in comparison.differences.items():
        low, high = row.interval_mm
        ends = None if low is None or high is None else (low, high)
        pixels, error = key.removesuffix("_mm").split("_")
        table.add_row(
            f"{pixels} {error.upper()}", signed(row.mean_mm), interval_text(ends), str(row.lower), str(row.higher),
            str(row.samples), str(row.objects), style="bold" if row.told_apart else None,
        )  # fmt: skip
    title = RichText(
        f"\nfirst:  {printable(comparison.first)}\nsecond: {printable(comparison.second)}\n"
        f"{comparison.split} split ({comparison.fingerprint[:8]}), against {comparison.target}, "
        f"{comparison.track} track\n"
    )
    return Group(title, table, RichText(f"{comparison.sentence}\n"))
