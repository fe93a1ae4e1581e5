"""From scores of samples to scores of a split: plain mean over samples (the headline), median, and pixel-pooled."""

import statistics
from collections.abc import Iterable, Sequence

from fpp_ml_bench.evaluation.protocol import METRICS
from fpp_ml_bench.evaluation.scores import ErrorStats, SampleScores, combine

Scores = dict[str, float | None]


def mean_over_samples(rows: Sequence[Scores]) -> Scores:
    """Plain mean of each metric over the samples that have it (paper Section 5.3.2); None where no sample has."""
    return {key: statistics.fmean(values) if (values := _present(rows, key)) else None for key in METRICS}


def median_over_samples(rows: Sequence[Scores]) -> Scores:
    """Median of each metric over the samples that have it; None where no sample has."""
    return {key: statistics.median(values) if (values := _present(rows, key)) else None for key in METRICS}


def pooled(samples: Iterable[SampleScores]) -> Scores:
    """The six headline errors over all pixels of all samples at once, each pixel counted alike."""
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
