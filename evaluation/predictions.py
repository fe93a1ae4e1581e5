"""Checks of a prediction's values before it is scored."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.evaluation.protocol import LARGEST_MM, Units
from fpp_ml_bench.evaluation.units import unit_problem

MM_PER_UNIT = {"mm": 1.0, "m": 1000.0, "normalised": 1000.0}
"""Upper bound in mm of one declared unit; for normalised depth, that no working range is above 1 m."""


def value_problems(
    prediction: NDArray[np.floating[Any]], target_mm: NDArray[np.floating[Any]], target_max_mm: float, units: Units
) -> list[str]:
    """What is wrong with the values of a prediction (H, W) in ``units``; usually an empty list.

    ``target_max_mm`` is the largest value of ``target_mm`` (H, W).
    """
    low, high = float(prediction.min()), float(prediction.max())
    problems = []
    finite = prediction
    if not np.isfinite([low, high]).all():  # min and max carry NaN through
        nans, infinities = int(np.isnan(prediction).sum()), int(np.isinf(prediction).sum())
        counts = [f"{n} {word}" for n, word in ((nans, "NaN"), (infinities, "infinite")) if n]
        problems.append(f"holds {' and '.join(counts)} of {prediction.size} values; write 0 where nothing was measured")
        finite_pixels = np.isfinite(prediction)
        if not finite_pixels.any():
            return problems
        finite = np.where(finite_pixels, prediction, prediction.dtype.type(0))
        low, high = float(finite.min()), float(finite.max())
    largest = LARGEST_MM / MM_PER_UNIT[units]
    if max(high, -low) > largest:
        problems.append(
            f"holds values up to {max(high, -low):.3g} {units} in magnitude; the limit is {largest:g}; write 0 where "
            "nothing was measured"
        )
    wrong_unit = unit_problem(finite, target_mm, units, high, target_max_mm)
    return [*problems, wrong_unit] if wrong_unit else problems
