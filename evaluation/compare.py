"""Two results of the same samples, sample by sample: the paired difference, how sure it is, and what that means.

Pairing takes out what both methods find hard. It can therefore tell two methods apart whose own intervals overlap.
"""

import statistics
from typing import Annotated, Any

from pydantic import Field

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.numbers import millimetres
from fpp_ml_bench.evaluation.protocol import HEADLINE
from fpp_ml_bench.evaluation.result import Result
from fpp_ml_bench.evaluation.result_models import Interval
from fpp_ml_bench.evaluation.schema import Count, StrictModel, Text
from fpp_ml_bench.evaluation.text import printable
from fpp_ml_bench.evaluation.uncertainty import caution, object_interval

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
        """Whether the interval leaves 0 out."""
        low, high = self.interval_mm
        return low is not None and high is not None and not low <= 0 <= high


class Comparison(StrictModel):
    """``second`` against ``first``: one `Difference` for each headline key, and each sample's own."""

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
    """The paired comparison of two results. SubmissionError, naming all of it, where they are not of the same data."""
    _check_same_data(first, second)
    others = {row.sample: row for row in second.per_sample}
    paired = [
        PairedSample(
            sample=row.sample,
            object=row.object,
            differences={key: _difference(getattr(row, key), getattr(others[row.sample], key)) for key in HEADLINE},
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
        "dataset": (first.dataset.fingerprint[:16], second.dataset.fingerprint[:16]),
        "split": (first.dataset.split, second.dataset.split),
        "target": (first.target, second.target),
        "track": (first.track, second.track),
        "mode": (first.mode, second.mode),
        "protocol": (first.protocol_version, second.protocol_version),
        "samples": (_samples(first), _samples(second)),
    }
    other = [
        f"{name}: the samples differ" if name == "samples" else f"{name}: {one} against {two}"
        for name, (one, two) in pairs.items()
        if one != two
    ]
    if other:
        lines = "\n  ".join(other)
        raise SubmissionError(
            "the two results can't be compared, they were not scored on the same data by the same rules; score both "
            f"with the same fpp-eval options:\n  {lines}"
        )


def _samples(result: Result) -> list[tuple[str, int]]:
    return sorted((row.sample, row.object_pixels) for row in result.per_sample)


def _difference(one: float | None, two: float | None) -> float | None:
    return None if one is None or two is None else two - one


def _summary(paired: list[PairedSample], key: str) -> Difference:
    values = [row.differences[key] for row in paired]
    known = [value for value in values if value is not None]
    interval = object_interval(values, [row.object for row in paired])
    return Difference(
        mean_mm=statistics.fmean(known) if known else None,
        interval_mm=[None, None] if interval is None else list(interval),
        samples=len(known),
        objects=len({row.object for row, value in zip(paired, values, strict=True) if value is not None}),
        lower=sum(value < 0 for value in known),
        higher=sum(value > 0 for value in known),
    )


def sentence(first: str, second: str, found: Difference) -> str:
    """What the difference in object MAE means, in words."""
    if found.mean_mm is None:
        return "No sample has an object in it, so object MAE says nothing."
    if not found.lower and not found.higher:
        return f"{second} and {first} have the same object MAE in all {found.samples} samples."
    size = f"{millimetres(abs(found.mean_mm))} mm"
    word = "lower" if found.mean_mm < 0 else "higher"
    count = found.lower if found.mean_mm < 0 else found.higher
    views = f"{word} in {count} of {found.samples} samples"
    low, high = found.interval_mm
    if low is None or high is None:
        return (
            f"{second} has an object MAE {size} {word} than {first} on average, {views}; with one object there is no "
            "interval, so nothing can be said beyond it."
        )
    ends = f"{_signed(low)} to {_signed(high)} mm over {found.objects} objects"
    few = f" {said}" if (said := caution(found.objects)) else ""
    if found.told_apart:
        return (
            f"{second} has a {word} object MAE than {first}, by {size} on average (95% interval {ends}), {views}.{few}"
        )
    return (
        f"The object MAE of {second} and {first} can't be told apart: {second} is {size} {word} on average ({views}), "
        f"but the 95% interval, {ends}, holds 0.{few}"
    )


def _signed(value: float) -> str:
    return ("-" if value < 0 else "") + millimetres(abs(value))
