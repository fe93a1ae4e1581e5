"""The block ``uncertainty`` of ``result.json``: scores of a stated uncertainty, its reliability and sparsification."""

import math
import statistics
from collections.abc import Iterable, Mapping
from typing import Annotated

from pydantic import Field

from fpp_ml_bench.evaluation.protocol import COVERED, LEFT_OUT, NOMINAL, SURE_LEFT_OUT, UNCERTAINTY
from fpp_ml_bench.evaluation.result.parts import Metrics, SampleResult
from fpp_ml_bench.evaluation.score import SigmaSample
from fpp_ml_bench.schema import NonNegative, Share, StrictModel, Text

_AGREES = 1e-9


class SigmaScores(StrictModel):
    """Scores of a stated uncertainty; null where no object pixel states one, or where there is no object. The rules are
    in PROTOCOL.md."""

    coverage_68: Share | None
    coverage_95: Share | None
    coverage_99: Share | None
    sigma_mean_mm: NonNegative | None
    sigma_median_mm: NonNegative | None
    nll: float | None
    ause_mae_mm: NonNegative | None
    ause_rmse_mm: NonNegative | None
    sure_mae_mm: NonNegative | None
    sure_rmse_mm: NonNegative | None
    unstated_share: Share | None


class Reliability(StrictModel):
    """``observed``: mean over samples of the share of pixels within the interval that should hold ``nominal``."""

    nominal: list[Share]
    observed: Annotated[list[Share], Field(min_length=len(NOMINAL), max_length=len(NOMINAL))]


_Curve = Annotated[list[NonNegative], Field(min_length=len(LEFT_OUT), max_length=len(LEFT_OUT))]


class Sparsification(StrictModel):
    """Means over samples of the errors in mm of the object pixels that remain after the share ``left_out``: the least
    sure by sigma, and for ``best_*`` the worst by their error."""

    left_out: list[Share]
    mae_mm: _Curve
    best_mae_mm: _Curve
    rmse_mm: _Curve
    best_rmse_mm: _Curve


class Uncertainty(StrictModel):
    """``metrics`` is the mean over the samples that have a score, ``per_object`` over the views of each object."""

    metrics: SigmaScores
    per_object: dict[Text, SigmaScores] = Field(max_length=100_000)
    per_sample: dict[Text, SigmaScores] = Field(max_length=100_000)
    reliability: Reliability | None
    sparsification: Sparsification | None

    def check(self, rows: Mapping[str, SampleResult], metrics: Metrics) -> None:
        """Refuse (ValueError) a block of other samples than ``rows``, or that contradicts itself or ``metrics``."""
        if set(self.per_sample) != set(rows):
            raise ValueError("uncertainty.per_sample: other samples than per_sample has")
        for sample, scores in self.per_sample.items():
            if (scores.unstated_share is None) != (rows[sample].object_pixels == 0):
                raise ValueError(f"uncertainty.per_sample.{sample} must have scores exactly where there is an object")
            covered = [getattr(scores, f"coverage_{percent}") for percent in COVERED]
            if None not in covered and covered != sorted(covered):
                raise ValueError(f"uncertainty.per_sample.{sample}: a wider interval holds less than a narrower one")
        owners = {sample: row.object for sample, row in rows.items()}
        derived = {"metrics": _mean(self.per_sample.values())} | {
            f"per_object.{name}": scores for name, scores in _per_object(self.per_sample, owners).items()
        }
        stored = {"metrics": self.metrics} | {f"per_object.{name}": own for name, own in self.per_object.items()}
        if set(stored) != set(derived):
            raise ValueError("uncertainty.per_object: other objects than per_sample has")
        for name, scores in derived.items():
            for key in UNCERTAINTY:
                _agree(f"{name}.{key}", getattr(stored[name], key), getattr(scores, key))
        if (self.reliability is None) != (self.metrics.coverage_68 is None):
            raise ValueError("uncertainty.reliability must be there exactly where some pixel states an uncertainty")
        if (self.sparsification is None) != (self.metrics.ause_mae_mm is None):
            raise ValueError("uncertainty.sparsification must be there exactly where there is an object")
        if (reliability := self.reliability) is not None:
            if reliability.nominal != list(NOMINAL):
                raise ValueError(f"uncertainty.reliability.nominal: expected {', '.join(map(str, NOMINAL))}")
            for percent in COVERED:
                observed = reliability.observed[NOMINAL.index(percent / 100)]
                _agree(f"reliability at {percent}%", observed, getattr(self.metrics, f"coverage_{percent}"))
        if self.sparsification is not None:
            self._check_curves(self.sparsification, metrics)

    def _check_curves(self, curves: Sparsification, metrics: Metrics) -> None:
        if curves.left_out != list(LEFT_OUT):
            raise ValueError("uncertainty.sparsification.left_out: expected 0 to 0.95 in steps of 0.05")
        for error in ("mae_mm", "rmse_mm"):
            by_sigma, best = getattr(curves, error), getattr(curves, f"best_{error}")
            whole = getattr(metrics, f"object_{error}")
            for name, curve in ((error, by_sigma), (f"best_{error}", best)):
                _agree(f"sparsification.{name}.0", curve[0], whole)
            sure, area = (getattr(self.metrics, f"{name}_{error}") for name in ("sure", "ause"))
            _agree(f"sparsification.{error}", by_sigma[LEFT_OUT.index(SURE_LEFT_OUT)], sure)
            gap = math.fsum(first - second for first, second in zip(by_sigma, best, strict=True)) / len(LEFT_OUT)
            _agree(f"metrics.ause_{error}", area, max(gap, 0.0), _AGREES * (whole or 0.0))


def uncertainty_of(samples: Mapping[str, SigmaSample], owners: Mapping[str, str]) -> Uncertainty:
    """The block of the scored ``samples`` by name; ``owners``: the object of each."""
    per_sample = {name: SigmaScores(**sample.scores) for name, sample in samples.items()}
    observed = [sample.observed for sample in samples.values() if sample.observed is not None]
    curves = [sample.curves for sample in samples.values() if sample.curves is not None]
    return Uncertainty(
        metrics=_mean(per_sample.values()),
        per_object=_per_object(per_sample, owners),
        per_sample=per_sample,
        reliability=Reliability(nominal=list(NOMINAL), observed=_mean_curve(observed)) if observed else None,
        sparsification=Sparsification(
            left_out=list(LEFT_OUT), **{name: _mean_curve([of[name] for of in curves]) for name in curves[0]}
        )
        if curves
        else None,
    )


def _mean_curve(curves: list[list[float]]) -> list[float]:
    return [statistics.fmean(values) for values in zip(*curves, strict=True)]


def _mean(rows: Iterable[SigmaScores]) -> SigmaScores:
    rows = list(rows)
    columns = {key: [value for row in rows if (value := getattr(row, key)) is not None] for key in UNCERTAINTY}
    return SigmaScores(**{key: statistics.fmean(values) if values else None for key, values in columns.items()})


def _per_object(per_sample: Mapping[str, SigmaScores], owners: Mapping[str, str]) -> dict[str, SigmaScores]:
    views: dict[str, list[SigmaScores]] = {}
    for sample, scores in per_sample.items():
        views.setdefault(owners[sample], []).append(scores)
    return {name: _mean(scores) for name, scores in views.items()}


def _agree(name: str, stored: float | None, computed: float | None, rounding: float = 0.0) -> None:
    if stored is None or computed is None:
        agrees = stored is computed
    else:  # a likelihood may be near 0
        agrees = math.isclose(stored, computed, rel_tol=_AGREES, abs_tol=max(rounding, 1e-12))
    if not agrees:
        raise ValueError(f"uncertainty.{name} does not follow from the other scores: {stored}, not {computed}")
