"""Whether the numbers of a result agree with one another."""

import math
from collections.abc import Mapping
from typing import Any

from fpp_ml_bench.evaluation.result.parts import SampleResult
from fpp_ml_bench.evaluation.result.reliance_block import Reliance
from fpp_ml_bench.evaluation.score import combine
from fpp_ml_bench.evaluation.submission import Submission

AGREES = 1e-9
"""Relative difference up to which two computations of an average count as the same number."""


def check_sample(row: SampleResult, pixels: int) -> None:
    """Refuse (ValueError) a sample whose sets do not make up its ``pixels`` or whose scores contradict each other."""
    if row.object_pixels + row.background_pixels != pixels:
        raise ValueError(f"{row.sample}: object and background pixels do not add up to the image's {pixels}")
    for name in ("object", "background"):
        stats = row.stats(name)
        if (stats.pixels == 0) != (stats.mae_mm is None) or (stats.pixels == 0) != (stats.rmse_mm is None):
            raise ValueError(f"{row.sample}: {name} scores must be null exactly when the set is empty")
        if stats.mae_mm is not None and stats.rmse_mm is not None and stats.rmse_mm < stats.mae_mm * (1 - AGREES):
            raise ValueError(f"{row.sample}: {name} RMSE is below its MAE, which no error has")
    overall = combine(row.stats("object"), row.stats("background"))
    if not (same(row.overall_mae_mm, overall.mae_mm) and same(row.overall_rmse_mm, overall.rmse_mm)):
        raise ValueError(f"{row.sample}: overall scores do not follow from object and background")
    _check_distribution(row)


def check_reliance(reliance: Reliance, submission: Submission) -> None:
    """Refuse (ValueError) a phase reliance of other weights or of another output than was scored."""
    weights = submission.settings.get("weights_sha256")
    if weights != reliance.weights_sha256:
        raise ValueError(
            f"reliance was measured on weights {str(reliance.weights_sha256)[:12]}, scored were {str(weights)[:12]}; "
            "measure it again"
        )
    if (reliance.units == "normalised") != (submission.units == "normalised"):
        raise ValueError(
            f"reliance is that of an answer in {reliance.units}, scored was one in {submission.units}; measure it again"
        )


def _check_distribution(row: SampleResult) -> None:
    names = ("object_mae_mm", "object_median_mm", "object_p95_mm", "object_max_mm", "object_bias_mm",
             "object_shift_free_mae_mm", "object_rmse_mm")  # fmt: skip
    values = [getattr(row, name) for name in names]
    if any(value is None for value in values):
        if any(value is not None for value in values):
            raise ValueError(f"{row.sample}: the object's scores must be null all together, when the set is empty")
        return
    mae, median, p95, largest, bias, shift_free, rmse = values
    loose = 1 + AGREES
    if not (median <= p95 * loose and p95 <= largest * loose and rmse <= largest * loose):
        raise ValueError(f"{row.sample}: object median, 95th percentile, RMSE and maximum are out of order")
    if abs(bias) > mae * loose or shift_free > mae * loose:
        raise ValueError(f"{row.sample}: object bias or shift-free MAE is above the MAE, which no error has")


def check_same(name: str, stored: Any, computed: Any) -> None:
    """Refuse (ValueError) a stored value, mapping or list that is not what the per-sample scores give."""
    if isinstance(computed, Mapping):
        if not isinstance(stored, Mapping) or set(stored) != set(computed):
            raise ValueError(f"{name} does not hold the keys {', '.join(map(str, computed))}")
        for key in computed:
            check_same(f"{name}.{key}", stored[key], computed[key])
    elif isinstance(computed, list):
        if len(stored) != len(computed):
            raise ValueError(f"{name} holds {len(stored)} entries, per_sample makes {len(computed)}")
        for index, (stored_item, computed_item) in enumerate(zip(stored, computed, strict=True)):
            check_same(f"{name}.{index}", stored_item, computed_item)
    elif isinstance(computed, float) or computed is None:
        # A mean of signed values may cancel to rounding errors, which depend on the machine.
        if not same(stored, computed, rounding=1e-9 if name.endswith("bias_mm") else 0.0):
            raise ValueError(f"{name} does not follow from per_sample: {stored}, not {computed}")
    elif stored != computed:
        if name.startswith("samples_without_"):
            raise ValueError(f"{name} is not the number of such samples, {computed}")
        raise ValueError(f"{name} does not follow from per_sample: {stored}, not {computed}")


def same(first: float | None, second: float | None, rounding: float = 0.0) -> bool:
    """Whether two numbers differ by at most `AGREES` relatively, or ``rounding``; None equals None only."""
    if first is None or second is None:
        return first is second
    return math.isclose(first, second, rel_tol=AGREES, abs_tol=rounding)
