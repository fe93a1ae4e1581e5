"""Two results of the same samples, sample by sample: the paired difference, its interval, a test,
and a sentence. Samples that are hard for both methods cancel in the difference. A comparison can
therefore tell two methods apart whose own intervals overlap."""

import statistics
from collections.abc import Sequence
from operator import attrgetter
from typing import Annotated

from pydantic import Field

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.metrics import METRICS, OBJECT_KEY, RANK_KEY, RANKED
from fpp_ml_bench.evaluation.result.model import Result
from fpp_ml_bench.evaluation.result.parts import Interval, ends
from fpp_ml_bench.evaluation.score.uncertainty import (
    FEWEST_OBJECTS,
    SIGNIFICANT,
    caution,
    object_interval,
    sign_flip_p,
)
from fpp_ml_bench.files import printable
from fpp_ml_bench.schema import Count, Share, StrictModel, Text
from fpp_ml_bench.style import interval_text, millimetres


class PairedSample(StrictModel):
    """Second minus first, in mm, for one sample; null where a pixel set is empty."""

    sample: Text
    object: Text
    differences: dict[Text, float | None]


class Difference(StrictModel):
    """Mean of second minus first in mm over the ``samples`` that both have, its 95% interval over
    ``objects``, and the p value of a sign-flip test of the objects' mean differences (null without
    any).

    ``lower`` and ``higher`` count the samples in which the second's error is smaller and larger."""

    mean_mm: float | None
    interval_mm: Interval
    sign_flip_p: Share | None
    samples: Count
    objects: Count
    lower: Count
    higher: Count

    @property
    def interval(self) -> tuple[float, float] | None:
        """The interval in mm; None where there is none."""
        return ends(self.interval_mm)

    @property
    def distinguishable(self) -> bool:
        """Whether 0 is outside the interval."""
        return self.interval is not None and not self.interval[0] <= 0 <= self.interval[1]


class Comparison(StrictModel):
    """``second`` against ``first``: a `Difference` for each headline key, and the differences of
    each sample."""

    first: Text
    second: Text
    truth: Text
    split: Text
    target: Text
    track: Text
    mode: Text
    differences: dict[Text, Difference]
    sentence: Annotated[str, Field(max_length=2000)]
    per_sample: list[PairedSample]


def compare(first: Result, second: Result) -> Comparison:
    """The paired comparison of two results. SubmissionError names everything in which their data
    differ."""
    _check_same_data(first, second)
    second_rows = {row.sample: row for row in second.per_sample}
    paired, charged = (
        [],
        all(result.metrics.two_sided_mae_mm is not None for result in (first, second)),
    )
    keys = [key for key in RANKED if charged or not METRICS[key].charged]
    for row in first.per_sample:
        pairs = {key: (getattr(row, key), getattr(second_rows[row.sample], key)) for key in keys}
        differences = {
            key: None if None in pair else pair[1] - pair[0] for key, pair in pairs.items()
        }
        paired.append(PairedSample(sample=row.sample, object=row.object, differences=differences))
    owners = [row.object for row in paired]
    summaries = {
        key: paired_difference([row.differences[key] for row in paired], owners) for key in keys
    }
    ranked_by = ("two-sided MAE", RANK_KEY) if charged else ("object MAE", OBJECT_KEY)
    names = printable(first.submission.name), printable(second.submission.name)
    if names[0] == names[1]:
        names = f"{names[0]} (first)", f"{names[1]} (second)"
    return Comparison(
        first=first.submission.name,
        second=second.submission.name,
        truth=first.dataset.truth,
        split=first.dataset.split,
        **{key: getattr(first, key) for key in ("target", "track", "mode")},
        differences=summaries,
        sentence=sentence(*names, ranked_by[0], summaries[ranked_by[1]]),
        per_sample=paired,
    )


def _check_same_data(first: Result, second: Result) -> None:
    a, b = first.dataset, second.dataset
    lines = []
    if a.truth != b.truth:
        lines.append(f"dataset: {printable(a.identity)} against {printable(b.identity)}")
    rules = {"split": "dataset.split", "target": "target", "track": "track", "mode": "mode"}
    for title, key in {**rules, "protocol": "protocol_version"}.items():
        value, other = attrgetter(key)(first), attrgetter(key)(second)
        lines += [f"{title}: {value} against {other}"] if value != other else []
    samples = [
        sorted((row.sample, row.object_pixels) for row in result.per_sample)
        for result in (first, second)
    ]
    if samples[0] != samples[1]:
        lines.append("samples: the samples differ")
    if lines:
        raise SubmissionError(
            "the two results can't be compared, they were not scored on the same data by the same "
            "rules; score both "
            "with the same fpp-eval options:\n  " + "\n  ".join(lines)
        )


def paired_difference(values: Sequence[float | None], owners: Sequence[str]) -> Difference:
    """The `Difference` of second minus first in mm, ``values`` by sample, None where a pixel set is
    empty; ``owners``: the object of each sample."""
    differences = [value for value in values if value is not None]
    interval = object_interval(values, owners)
    by_object: dict[str, list[float]] = {}
    for name, value in zip(owners, values, strict=True):
        if value is not None:
            by_object.setdefault(name, []).append(value)
    return Difference(
        mean_mm=statistics.fmean(differences) if differences else None,
        interval_mm=[None, None] if interval is None else list(interval),
        sign_flip_p=sign_flip_p([statistics.fmean(views) for views in by_object.values()])
        if by_object
        else None,
        samples=len(differences),
        objects=len(by_object),
        lower=sum(value < 0 for value in differences),
        higher=sum(value > 0 for value in differences),
    )


def sentence(first: str, second: str, error: str, difference: Difference) -> str:
    """The difference in an ``error`` as a sentence."""
    if difference.mean_mm is None:
        return f"No sample has an object in it, so the {error} says nothing."
    units = "objects" if difference.samples == difference.objects else "samples"
    if not difference.lower and not difference.higher:
        return f"{second} and {first} have the same {error} in all {difference.samples} {units}."
    size = f"{millimetres(abs(difference.mean_mm))} mm"
    word, count = (
        ("lower", difference.lower) if difference.mean_mm < 0 else ("higher", difference.higher)
    )
    views = f"{word} in {count} of {difference.samples} {units}"
    if difference.interval is None:
        no_interval = "with one object there is no interval, so nothing can be said beyond it"
        return (
            f"The {error} of {second} is {size} {word} than that of {first} on average, {views}; "
            f"{no_interval}."
        )
    p = 1.0 if difference.sign_flip_p is None else difference.sign_flip_p
    between = (
        f"{interval_text(difference.interval)} mm over {difference.objects} objects; sign-flip "
        f"test p = {p:.3g}"
    )
    few_objects = f" {warning}" if (warning := caution(difference.objects)) else ""
    if difference.distinguishable and p > SIGNIFICANT:
        level = f"{100 * SIGNIFICANT:.0f}%"
        reach = (
            f": {difference.objects} objects never reach {level}"
            if difference.objects < FEWEST_OBJECTS
            else ""
        )
        few_objects = f" The test does not confirm it at {level}{reach}.{few_objects}"
    if difference.distinguishable:
        by = f"by {size} on average (95% interval {between})"
        return f"{second} has a {word} {error} than {first}, {by}, {views}.{few_objects}"
    return (
        f"The {error} of {second} and {first} can't be distinguished: "
        f"{second} is {size} {word} on average ({views}), "
        f"but the 95% interval holds 0 ({between}).{few_objects}"
    )
