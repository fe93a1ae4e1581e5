"""From scores of samples to scores of a split: mean over samples (the headline), median, pixel-pooled, objects."""

import math
import statistics
from collections.abc import Iterable, Sequence
from typing import Any

from fpp_ml_bench.evaluation.protocol import METRICS
from fpp_ml_bench.evaluation.score import ErrorStats, SampleScores, combine

Scores = dict[str, float | None]


def mean_over_samples(rows: Sequence[Scores]) -> Scores:
    """Plain mean of each metric over the samples that have it (paper Section 5.3.2); None where no sample has."""
    return {key: statistics.fmean(values) if (values := _present(rows, key)) else None for key in METRICS}


def median_over_samples(rows: Sequence[Scores]) -> Scores:
    """Median of each metric over the samples that have it; None where no sample has."""
    return {key: statistics.median(values) if (values := _present(rows, key)) else None for key in METRICS}


def spread_over_samples(rows: Sequence[Scores]) -> Scores:
    """Sample standard deviation (n - 1) of each metric over the samples that have it; None for fewer than two."""
    return {key: _deviation(_present(rows, key)) for key in METRICS}


def _deviation(values: list[float]) -> float | None:
    if len(values) < 2:
        return None
    mean = statistics.fmean(values)
    largest = max(abs(value - mean) for value in values)
    if largest == 0:
        return 0.0
    # Scaled, so that deviations of 1e-200 or 1e200 mm can be squared.
    squares = math.fsum(((value - mean) / largest) ** 2 for value in values)
    return largest * math.sqrt(squares / (len(values) - 1))


def per_object(rows: Sequence[Scores], objects: Sequence[str]) -> list[dict[str, Any]]:
    """Each object's number of samples, mean and spread of every metric over its views, in order of appearance."""
    summaries = []
    for name in dict.fromkeys(objects):
        views = [row for row, owner in zip(rows, objects, strict=True) if owner == name]
        summaries.append(
            {
                "object": name,
                "samples": len(views),
                "metrics": mean_over_samples(views),
                "spread": spread_over_samples(views),
            }
        )
    return summaries


def pooled(samples: Iterable[SampleScores]) -> Scores:
    """The six headline errors over all pixels of all samples at once, every pixel with the same weight."""
    samples = list(samples)
    inside = combine(*(s.object for s in samples))
    outside = combine(*(s.background for s in samples))
    return pooled_scores(inside, outside)


def pooled_scores(inside: ErrorStats, outside: ErrorStats) -> Scores:
    """Headline keys of one object set and one background set."""
    named = {"overall": combine(inside, outside), "object": inside, "background": outside}
    return {
        f"{name}_{error}_mm": value
        for name, stats in named.items()
        for error, value in (("mae", stats.mae_mm), ("rmse", stats.rmse_mm))
    }


def _present(rows: Sequence[Scores], key: str) -> list[float]:
    return [value for row in rows if (value := row[key]) is not None]
