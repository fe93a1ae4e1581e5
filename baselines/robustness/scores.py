"""What a prediction of a disturbed scene is worth: errors with a fixed charge for silence, and honesty about them.

Scored are the object pixels of the undisturbed scene that are not void, against its exact depth. A pixel without an
answer is charged half an order, so that "I don't know" is better than a wrong order and worse than a right one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.robustness.axes import Corruptions
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.score import states_sigma
from fpp_ml_bench.loaders.sample import void_pixels

Scores = dict[str, float | None]
SCORES = ("mae_mm", "protocol_mae_mm", "wrong_share", "unanswered_share", "confident_share", "coverage")
"""Of a view: mean error with `Corruptions.unanswered_mm` for a pixel without an answer; the same with its whole depth,
as the protocol has it; shares of wrong orders and of pixels without an answer; of confident errors, and of pixels that
state a sigma, both None for a method that states none."""


@dataclass(frozen=True)
class Truth:
    """``depth_mm`` float32 (H, W) and ``scored`` bool (H, W) of an undisturbed view."""

    depth_mm: NDArray[np.float32]
    scored: NDArray[np.bool_]

    @classmethod
    def of(cls, depth_mm: NDArray[np.float32], flags: NDArray[np.uint8]) -> "Truth":
        return cls(depth_mm, object_mask(depth_mm) & ~void_pixels(flags))


def score(
    depth_mm: NDArray[np.floating], sigma_mm: NDArray[np.floating] | None, truth: Truth, rules: Corruptions
) -> Scores:
    """`SCORES` of a prediction (H, W) in mm, 0 or less without an answer (a network may go below 0), whose standard
    uncertainty is ``sigma_mm`` (H, W), above 0 where it is stated. Raises PredictionError for a depth that is not
    finite, a sigma that is not finite or below 0, and for another size."""
    for name, values in (("depth", depth_mm), ("sigma", sigma_mm)):
        if values is None:
            continue
        if values.shape != truth.depth_mm.shape:
            raise PredictionError(f"{name}: expected a map of {truth.depth_mm.shape}, got {values.shape}")
        if not np.isfinite(values).all() or (name == "sigma" and (values < 0).any()):
            raise PredictionError(f"{name}: expected finite mm, a sigma of 0 and more; the method is at fault")
    target = truth.depth_mm[truth.scored].astype(np.float64)
    if target.size == 0:
        return dict.fromkeys(SCORES)
    given = depth_mm[truth.scored].astype(np.float64)
    answered = given > 0
    error = np.abs(given - target)
    wrong = answered & (error > rules.wrong_order_mm)
    scores: Scores = {
        "mae_mm": float(np.where(answered, error, rules.unanswered_mm).mean()),
        "protocol_mae_mm": float(error.mean()),
        "wrong_share": float(wrong.mean()),
        "unanswered_share": float((~answered).mean()),
        "confident_share": None,
        "coverage": None,
    }
    if sigma_mm is not None:
        sigma = sigma_mm[truth.scored].astype(np.float64)
        stated = states_sigma(given, sigma)
        scores["confident_share"] = float((wrong & stated & (sigma < rules.confident_below * error)).mean())
        scores["coverage"] = float(stated.mean())
    return scores


def mean_scores(views: Sequence[Mapping[str, float | None]]) -> Scores:
    """Mean of each score over the views that have it."""
    means: Scores = {}
    for key in SCORES:
        values = [value for view in views if (value := view.get(key)) is not None]
        means[key] = float(np.mean(values)) if values else None
    return means
