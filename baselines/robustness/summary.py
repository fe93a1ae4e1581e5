"""From rows of views to a method's robustness: means by severity, the mean over all of them, and its interval."""

from collections.abc import Mapping, Sequence

from fpp_ml_bench.baselines.robustness.axes import CLEAN, corruptions
from fpp_ml_bench.baselines.robustness.run import Setup, View
from fpp_ml_bench.baselines.robustness.scores import mean_scores
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.result import Robustness, SeverityScores
from fpp_ml_bench.evaluation.score import object_interval


def by_severity(rows: Sequence[View]) -> dict[int, SeverityScores]:
    """Means over the views of each severity."""
    severities = sorted({row["severity"] for row in rows})
    return {
        severity: SeverityScores.model_validate(mean_scores([row for row in rows if row["severity"] == severity]))
        for severity in severities
    }


def robustness(setup: Setup, rows: Mapping[str, Sequence[View]]) -> Robustness:
    """The block of ``result.json``. Raises PredictionError for a quick look, and where an axis is missing."""
    missing = [axis for axis in setup.axes(()) if axis not in rows]
    if setup.quick or missing:
        lacking = "a --quick look" if setup.quick else f"without {', '.join(missing)}"
        raise PredictionError(f"robustness is a mean over all axes and severities, and this is {lacking}")
    clean = list(rows[CLEAN])
    axes = {axis: list(by_severity(found).values()) for axis, found in rows.items() if axis != CLEAN}
    sha256 = setup.method.settings.get("weights_sha256")
    sums, objects = _shares_of_the_mean(setup, rows)
    found = object_interval(sums, objects)
    every = [scores.mae_mm for severities in axes.values() for scores in severities]
    return Robustness(
        version=corruptions().version,
        set=setup.set_name,
        mae_mm=sum(every) / len(every),
        interval=[None, None] if found is None else [max(found[0], 0.0), found[1]],
        clean=by_severity(clean)[0],
        axes=axes,
        samples=len(clean),
        objects=len({row["object"] for row in clean}),
        size_px=setup.size,
        weights_sha256=sha256 if isinstance(sha256, str) else None,
    )


def _shares_of_the_mean(setup: Setup, rows: Mapping[str, Sequence[View]]) -> tuple[list[float], list[str]]:
    """For each sample what it adds to the mean over axes and severities, times the number of samples, and its object:
    the mean of these numbers is that mean, also where an axis disturbs a few objects only."""
    objects = {row["sample"]: row["object"] for row in rows[CLEAN]}
    sums = dict.fromkeys(objects, 0.0)
    conditions = 0
    for axis in (axis for axis in rows if axis != CLEAN):
        for severity in sorted({row["severity"] for row in rows[axis]}):
            found = [row for row in rows[axis] if row["severity"] == severity]
            conditions += 1
            for row in found:
                sums[row["sample"]] += (row["mae_mm"] or 0.0) * len(objects) / len(found)
    return [total / conditions for total in sums.values()], list(objects.values())
